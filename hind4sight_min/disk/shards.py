"""Data sets: a folder of shards `shard_0000.npz`, each describing itself (camera, units, seed, simulator settings,
format version). Beside each lies a `shard_0000.truth.npz` with what the simulator knows: sim/truth.py reads it, nothing
here does.
"""
from pathlib import Path

import numpy as np

from ..geometry import Camera
from ..interactions import PER_POKE, Interactions
from .files import load_npz, save_npz

FORMAT = "hind4sight_min interactions 1"
DEPTH_UNIT = 1e-4  # m per count of the stored uint16 depth: 0.1 mm, up to 6.5 m


def save_shard(path, interactions):
    """Write one shard, whole or not at all."""
    meta = {**interactions.meta, "format": FORMAT, "camera": interactions.camera.plain,
            "units": {"depth": DEPTH_UNIT, "pokes": "m, m, rad", "starts": "m"}}
    arrays = {name: getattr(interactions, name) for name in (*PER_POKE, "empty_depth")}
    for name in ("depth_before", "depth_after", "empty_depth"):
        arrays[name] = np.clip(np.round(arrays[name] / DEPTH_UNIT), 0, 65535).astype(np.uint16)
    save_npz(path, arrays, meta)


def load_shard(path):
    """One shard -> Interactions. Raises ValueError naming the file and what is wrong with it."""
    arrays, meta = load_npz(path, FORMAT)
    try:
        camera = Camera(**meta["camera"])
        for name in ("depth_before", "depth_after", "empty_depth"):
            arrays[name] = arrays[name].astype(np.float32) * np.float32(meta["units"]["depth"])
        return Interactions(**arrays, camera=camera, meta=meta)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def find_shards(folder):
    """The shards of a data set, in order, without their truth files; none where there is no folder."""
    return sorted(path for path in Path(folder).glob("shard_*.npz") if not path.name.endswith(".truth.npz"))


def shards_in(folder):
    """The same; raises ValueError if there is none."""
    shards = find_shards(folder)
    if not shards:
        raise ValueError(f"{folder}: no shard_*.npz there; 'hind4sight collect' makes them")
    return shards


def load_interactions(folder):
    """All shards of a folder, joined -> Interactions. Raises ValueError unless they share camera, arena and grid."""
    paths = shards_in(folder)
    parts = [load_shard(path) for path in paths]
    first = parts[0]
    for path, part in zip(paths, parts):
        same = all(part.settings[name] == first.settings[name] for name in ("arena", "cell"))
        if (part.meta["camera"] != first.meta["camera"] or not same
                or not np.array_equal(part.empty_depth, first.empty_depth)):
            raise ValueError(f"{path}: another camera, arena or grid than the folder's first shard")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in PER_POKE}
    return Interactions(**joined, empty_depth=first.empty_depth, camera=first.camera, meta=first.meta)
