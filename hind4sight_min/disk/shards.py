"""Data sets: a folder of shards `shard_0000.npz`, each describing itself (camera, units, seed, simulator settings,
format version). Beside each lies a `shard_0000.truth.npz` with what the simulator knows: sim/truth.py reads it, nothing
here does.
"""
import zlib
from pathlib import Path

import numpy as np

from ..geometry import Camera
from ..interactions import PER_POKE, Interactions
from .files import load_npz, plain, save_npz

FORMAT = "hind4sight_min interactions 1"
DEPTH_UNIT = 1e-4  # m per count of the stored uint16 depth: 0.1 mm, up to 6.5 m


def counts_of(depth):
    """Depth in m as it is stored, uint16: 0, missing, for what does not fit."""
    counts = np.round(depth / DEPTH_UNIT)
    return np.where((counts > 0) & (counts <= 65535), counts, 0).astype(np.uint16)


def stamp(interactions):
    """What tells a data set from any other, plain JSON types: its seed, its settings, how many pokes it has and a
    checksum of them, the same in memory and on disk.
    """
    checksum = 0
    for name in PER_POKE:
        for each in getattr(interactions, name):  # one by one: a copy of everything would not fit
            each = counts_of(each) if name.startswith("depth") else each.astype(each.dtype.newbyteorder("<"))
            checksum = zlib.crc32(np.ascontiguousarray(each), checksum)
    return {"seed": interactions.meta.get("seed"), "settings": interactions.settings, "pokes": len(interactions),
            "checksum": checksum}


def check_same_data(name, old, new):
    """Raise ValueError that says which entry differs unless two results of `stamp` are the same; None is not known."""
    for entry in new if old else ():
        if old.get(entry) != plain(new[entry]):
            raise ValueError(f"{name}: expected the data it was made with, of {entry} {old.get(entry)}, "
                             f"got {new[entry]}")


def save_shard(path, interactions):
    """Write one shard, whole or not at all."""
    meta = {**interactions.meta, "format": FORMAT, "camera": interactions.camera.plain,
            "units": {"depth": DEPTH_UNIT, "pokes": "m, m, rad", "starts": "m"}}
    arrays = {name: getattr(interactions, name) for name in (*PER_POKE, "empty_depth")}
    for name in ("depth_before", "depth_after", "empty_depth"):
        arrays[name] = counts_of(arrays[name])
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


def parts_of(folder):
    """The shards of a folder, in order, one after the other -> Interactions. Raises ValueError unless they are of one
    data set: of the same camera and empty arena, and collected with the same seed and settings.
    """
    first = None
    for path in shards_in(folder):
        part = load_shard(path)
        first = first or part
        for name in ("camera", "settings", "seed"):
            if part.meta.get(name) != first.meta.get(name):
                raise ValueError(f"{path}: of another data set than the folder's first shard: its {name} differs")
        if not np.array_equal(part.empty_depth, first.empty_depth):
            raise ValueError(f"{path}: of another data set than the folder's first shard: its empty arena differs")
        yield part


def load_interactions(folder):
    """All shards of a folder, joined -> Interactions. Raises ValueError as `parts_of`."""
    parts = [*parts_of(folder)]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in PER_POKE}
    return Interactions(**joined, empty_depth=parts[0].empty_depth, camera=parts[0].camera, meta=parts[0].meta)
