"""Checkpoints: all of a training run, so that a resumed run is the same run."""
from dataclasses import asdict

import numpy as np

from .. import check_whole
from ..geometry import Camera
from ..networks import Sizes, init_parameters
from ..training import Recipe, Run
from .files import load_npz, save_npz

FORMAT = "hind4sight_min checkpoint 6"
MOST_BYTES = 200e6  # the largest Sizes, with the optimiser's state


def save_run(path, run, resumable=True):
    """Write a checkpoint, whole or not at all. Without the optimiser's state it is a third of the size."""
    arrays = {"vector": run.vector}
    if resumable:
        arrays.update(first_moment=run.first_moment, second_moment=run.second_moment)
    save_npz(path, arrays, {"format": FORMAT, "recipe": asdict(run.recipe), "layout": run.layout, "step": run.step,
                            "run": run.meta})


def load_run(path):
    """Read a checkpoint -> Run. Raises ValueError naming the file and what is wrong, the layer too if one differs."""
    arrays, meta = load_npz(path, FORMAT, MOST_BYTES)
    try:
        check_whole("step", meta["step"], 0)
        for name, kind in (("log", list), ("sums", dict), ("seconds", float), ("settings", dict), ("camera", dict)):
            if not isinstance(meta["run"].get(name, kind()), kind):
                raise ValueError(f"run: {name}: expected a {kind.__name__}, got {meta['run'][name]!r}")
        if "camera" in meta["run"]:
            Camera(**meta["run"]["camera"])
        recipe = Recipe(**{**meta["recipe"], "sizes": Sizes(**meta["recipe"]["sizes"])})
        template = init_parameters(recipe.sizes, np.random.default_rng(0))
        layout, found = {name: value.shape for name, value in template.items()}, meta["layout"]
        for name in {**layout, **found}:
            if list(layout.get(name, ())) != found.get(name, []):
                raise ValueError(f"{name}: this network has a layer of shape {layout.get(name)}, the checkpoint "
                                 f"{found.get(name)}")
        size = sum(value.size for value in template.values())
        for name, value in arrays.items():
            if value.shape != (size,) or value.dtype != np.float32 or not np.isfinite(value).all():
                raise ValueError(f"{name}: expected {size} finite float32 numbers, got {value.dtype} of shape "
                                 f"{value.shape}")
        moments = (arrays.get(name, np.zeros(size, np.float32)) for name in ("first_moment", "second_moment"))
        return Run(recipe, layout, arrays["vector"], *moments, meta["step"], meta["run"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: {str(error)[:300]}") from None
