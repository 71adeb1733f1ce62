"""Data sets: a folder of shards `shard_0000.npz`, each describing itself (camera, units, seed, simulator settings,
format version). Beside each lies a `shard_0000.truth.npz` with what the simulator knows: sim/truth.py reads it, nothing
here does.
"""
import os
import tempfile
import zlib
from itertools import chain
from pathlib import Path

import numpy as np

from ..geometry import Camera
from ..interactions import MOST_DEPTH, PER_POKE, Interactions
from .files import load_npz, plain, save_npz

FORMAT = "hind4sight_min interactions 1"
SHARD_POKES = 100  # a simulated shard is one world, so that the data do not depend on who collects it
DEPTH_UNIT = 1e-4  # m per count of the stored uint16 depth: 0.1 mm, up to 6.5 m


def counts_of(depth):
    """Depth in m as it is stored, uint16: 0, missing, for what does not fit."""
    counts = np.round(depth / DEPTH_UNIT)
    return np.where((counts > 0) & (counts <= MOST_DEPTH / DEPTH_UNIT), counts, 0).astype(np.uint16)


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
        known = old.get(entry) if isinstance(old, dict) else old
        if known != plain(new[entry]):
            raise ValueError(f"{name}: expected the data it was made with, of {entry} {str(known)[:300]}, "
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
            if arrays[name].dtype.kind != "u":
                raise ValueError(f"{name}: expected counts, uint16, got {arrays[name].dtype}")
            arrays[name] = arrays[name].astype(np.float32) * np.float32(meta["units"]["depth"])
        return Interactions(**arrays, camera=camera, meta=meta)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: {str(error)[:300]}") from None


def find_shards(folder):
    """The shards of a data set, in order, without their truth files; none where there is no folder."""
    return sorted(path for path in Path(folder).glob("shard_*.npz") if not path.name.endswith(".truth.npz"))


def shards_in(folder):
    """The shards of a data set, as `find_shards`. Raises ValueError if there is none."""
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
        if not len(part):
            raise ValueError(f"{path}: expected a poke at least, got none")
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


# --- more pokes than fit into memory ------------------------------------------------------------------------------

class RowsOnDisk:
    """An array (M, ...) in a temporary file, gone with it, whose rows are read when they are asked for."""

    def __init__(self, shape, dtype):
        self.file, self.shape, self.dtype = tempfile.TemporaryFile(), (0, *shape), dtype

    def __del__(self):
        self.file.close()

    def append(self, rows):
        """Write rows (m, ...) behind those that are there. Raises OSError naming the folder of temporary files."""
        try:
            self.file.write(np.ascontiguousarray(rows, self.dtype))
            self.file.flush()
        except OSError as error:
            raise OSError(f"{tempfile.gettempdir()}: could not be written: {error.strerror}; TMPDIR can name another "
                          "folder") from None
        self.shape = len(self) + len(rows), *self.shape[1:]

    def __len__(self):
        return self.shape[0]

    def __getitem__(self, rows):
        """The rows at a number, a slice or an index array, as an array of NumPy's."""
        every = range(len(self)) if isinstance(rows, (int, np.integer, slice)) else np.arange(len(self))
        rows = np.asarray(every[rows])
        picked = np.empty((rows.size, *self.shape[1:]), self.dtype)
        for row, each in zip(rows.flat, picked):
            content = os.pread(self.file.fileno(), each.nbytes, int(row) * each.nbytes)
            each[...] = np.frombuffer(content, self.dtype).reshape(each.shape)
        return picked.reshape(*rows.shape, *self.shape[1:])


class StreamedInteractions(Interactions):
    """Interactions whose pictures are RowsOnDisk, so that any number of pokes takes the same memory."""

    def __post_init__(self):
        """Every shard was judged when it was read."""


def stream_interactions(folder):
    """All shards of a folder, their pictures unpacked into temporary files (at 64 x 48 pixels 43 kB a poke) ->
    StreamedInteractions: to train on, row by row the same as `load_interactions`. Raises ValueError as `parts_of`.
    """
    parts = parts_of(folder)
    first = next(parts)
    joined = {name: [] if name in ("pokes", "starts") else RowsOnDisk(getattr(first, name).shape[1:],
                                                                     getattr(first, name).dtype) for name in PER_POKE}
    for part in chain([first], parts):
        for name, rows in joined.items():
            rows.append(getattr(part, name))
    joined.update((name, np.concatenate(joined[name])) for name in ("pokes", "starts"))
    return StreamedInteractions(**joined, empty_depth=first.empty_depth, camera=first.camera, meta=first.meta)
