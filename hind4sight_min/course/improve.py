"""Grading of assignment 8: what the student's code is given, and the score of what it says."""
from dataclasses import replace

import numpy as np

from ..disk.files import data_small
from ..disk.shards import load_interactions
from ..interactions import PER_POKE
from ..lab.evaluation import ratio_of, scenes_of_pokes, true_motion
from ..sim.truth import load_truth
from .assignments.a8_improve import BASELINE, MINUTES, TARGET
from .sandbox import Limits

LIMITS = Limits(cpu=60 * MINUTES, wall=180.0 * MINUTES, memory=3 << 30, processes=1, answer=256 << 20)
FARTHEST = 10.0  # m; squares of what is far more are no numbers


def asked(folder):
    """The pokes to predict -> Interactions, Truth: of each scene of a folder the first, or all shipped test pokes.

    Not in the paper: grading. The pictures before a scene's second poke are those after its first, so whoever is given
    both need not predict. The shipped ones are no secret.
    """
    shipped = data_small() / "test"
    pokes, truth = load_interactions(folder or shipped), load_truth(folder or shipped)
    rows = np.unique(scenes_of_pokes(truth), return_index=True)[1] if folder else slice(None)
    return pokes[rows], truth[rows]


def question(folder, seed):
    """Training pokes, and the pokes to predict without what came of them -> the arguments of `worker.improve`.

    Not in the paper: grading. Nothing but the simulator's settings goes along: with its seed, pokes can be repeated.
    """
    pokes, _ = asked(folder)
    blind = replace(pokes, rgb_after=pokes.rgb_before, depth_after=pokes.depth_before)

    def plain(data):
        arrays = {name: getattr(data, name) for name in (*PER_POKE, "empty_depth")}
        return {**arrays, "camera": data.camera.plain, "meta": {"settings": data.settings}}
    return {"interactions": plain(load_interactions(data_small() / "train")), "pokes": plain(blind), "seed": seed}


def score(flow, folder):
    """A predicted scene flow of all pokes (M, N, 3), m -> flow_mse_ratio as `evaluation.summary` has it, its SE.

    Not in the paper: grading. Raises ValueError for another shape, and for what is no number.
    """
    pokes, truth = asked(folder)
    expected = (len(pokes), pokes.camera.height * pokes.camera.width, 3)
    if not isinstance(flow, np.ndarray) or flow.shape != expected or flow.dtype.kind != "f":
        raise ValueError(f"predict: expected floating-point numbers of shape {expected}, got "
                         f"{getattr(flow, 'dtype', type(flow).__name__)} {getattr(flow, 'shape', '')}")
    if not (np.abs(flow) < FARTHEST).all():
        raise ValueError(f"predict: expected less than {FARTHEST:g} m everywhere, got more, NaN or infinity")
    squared, motion = np.zeros(len(pokes)), np.zeros(len(pokes))
    for row in range(len(pokes)):
        true, _, moving = true_motion(pokes, truth, row)
        squared[row] = np.sum((flow[row] - true)[moving].astype(float) ** 2)
        motion[row] = np.sum(true[moving] ** 2)
    return ratio_of(squared, motion, scenes_of_pokes(truth))


def share_of(ratio):
    """Of the points: none at the starter's ratio, all at the target, in between on the line from one to the other."""
    return float(np.clip((BASELINE - ratio) / (BASELINE - TARGET), 0, 1))
