"""The record of one poke, shards of them on disk, and the arena's grid of cells.

A data set is a folder of shards `shard_0000.npz`, each describing itself (camera, units, seed, simulator settings,
format version). Beside each lies a `shard_0000.truth.npz` with what the simulator knows and the robot does not see:
that is read by sim/truth.py, which no file here imports.
"""
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from .files import load_npz, save_npz
from .geometry import Camera

FORMAT = "hind4sight_min interactions 1"
DEPTH_UNIT = 1e-4  # m per count of the stored uint16 depth: 0.1 mm, up to 6.5 m


@dataclass
class Interactions:
    """M pokes as the robot sees them. Paper: Sec. IV-A.

    rgb_before, rgb_after: (M, H, W, 3) uint8. depth_before, depth_after: (M, H, W) float32 m, 0 = missing.
    pokes: (M, 3) float32, u = (a_x, a_y, a_theta): target on the arena plane in m, direction in rad.
    starts: (M, 2) float32 m, where the finger came down. empty_depth: (H, W) float32 m, the empty arena.
    camera: the camera of this image size. meta: settings, seed, counts (plain JSON types); meta["settings"] has the
    side of the "arena" and of a "cell" in m.
    Raises ValueError naming the field whose shape, type or values are not these.
    """
    rgb_before: np.ndarray
    rgb_after: np.ndarray
    depth_before: np.ndarray
    depth_after: np.ndarray
    pokes: np.ndarray
    starts: np.ndarray
    empty_depth: np.ndarray
    camera: Camera
    meta: dict

    def __post_init__(self):
        count, size = len(self.pokes), (self.camera.height, self.camera.width)
        for name in ("arena", "cell"):
            settings = self.meta.get("settings")
            if not (isinstance(settings, dict) and 0 < settings.get(name, 0) < float("inf")):
                raise ValueError(f"meta: expected settings with a positive {name!r} in m")
        expected = {"rgb_before": (count, *size, 3), "rgb_after": (count, *size, 3),
                    "depth_before": (count, *size), "depth_after": (count, *size),
                    "pokes": (count, 3), "starts": (count, 2), "empty_depth": size}
        for name, shape in expected.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {value.shape}")
            kind = np.uint8 if name.startswith("rgb") else np.floating
            if not np.issubdtype(value.dtype, kind):
                raise ValueError(f"{name}: expected {'uint8' if kind is np.uint8 else 'floating-point numbers'}, "
                                 f"got {value.dtype}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")

    def __len__(self):
        return len(self.pokes)

    def __getitem__(self, rows):
        """The interactions at `rows` (a slice or an index array), same camera and meta."""
        if np.ndim(rows) == 0 and not isinstance(rows, slice):
            raise TypeError(f"rows: expected a slice or an index array, got {rows!r}")
        picked = {name: getattr(self, name)[rows] for name in PER_POKE}
        return Interactions(**picked, empty_depth=self.empty_depth, camera=self.camera, meta=self.meta)

    @property
    def settings(self):
        """The settings of the arena these pokes were made in, as the simulator's Settings: a dict."""
        return self.meta["settings"]


PER_POKE = ("rgb_before", "rgb_after", "depth_before", "depth_after", "pokes", "starts")


# --- the arena's grid of cells: heat-maps live on it, and pokes are drawn on it ----------------------------------

def grid_shape(settings):
    """(rows, columns) of the arena's grid of cells; rows run along y, columns along x."""
    cells = int(round(settings["arena"] / settings["cell"]))
    return cells, cells


def cells_of(xy, settings):
    """Positions (..., 2) m on the arena plane -> flat cell index (...) int; outside is clipped to the rim."""
    rows, columns = grid_shape(settings)
    cell = np.floor((np.asarray(xy) + settings["arena"] / 2) / settings["cell"]).astype(int)
    column, row = np.clip(cell[..., 0], 0, columns - 1), np.clip(cell[..., 1], 0, rows - 1)
    return row * columns + column


def cell_centres(settings):
    """(rows * columns, 2) float: the centre of every cell, in the order of `cells_of`, m."""
    rows, columns = grid_shape(settings)
    y, x = np.mgrid[:rows, :columns]
    return (np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5) * settings["cell"] - settings["arena"] / 2


def occupied_grid(clouds, occupied, settings):
    """Which cells objects stand in. Paper: Sec. IV-A.

    clouds (J, N, 3) m, arena; occupied (N,) bool: points of objects -> (J, rows, columns) bool.
    """
    grid = np.zeros((len(clouds), *grid_shape(settings)), bool)
    cells = cells_of(clouds[:, occupied, :2], settings)
    grid.reshape(len(clouds), -1)[np.arange(len(clouds))[:, None], cells] = True
    return grid


def with_neighbours(grid):
    """The cells of grids (J, rows, columns) bool and their eight neighbours each."""
    return np.stack([cv2.dilate(each.astype(np.uint8), np.ones((3, 3), np.uint8)) for each in grid]) > 0


def finger_fits(places, grid, settings):
    """Where the finger may come down: not on or next to an occupied cell, and clear of the walls. Paper: Sec. IV-A.

    places (J, L, 2) m on the arena plane; grid (J, rows, columns) bool, occupied cells -> (J, L) bool.
    """
    taken = with_neighbours(grid).reshape(len(grid), -1)
    inside = np.abs(places).max(axis=2) < settings["arena"] / 2 - settings["finger_radius"]
    return inside & ~taken[np.arange(len(grid))[:, None], cells_of(places, settings)]


# --- shards on disk -----------------------------------------------------------------------------------

def save_shard(path, interactions):
    """Write one shard, whole or not at all."""
    meta = {**interactions.meta, "format": FORMAT, "camera": asdict(interactions.camera),
            "units": {"depth": DEPTH_UNIT, "pokes": "m, m, rad", "starts": "m"}}
    meta["camera"]["arena_from_camera"] = interactions.camera.arena_from_camera.tolist()
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
    """The shards of a data set, in order. Raises ValueError if there is none."""
    if not Path(folder).is_dir():
        raise ValueError(f"{folder}: no such folder")
    shards = find_shards(folder)
    if not shards:
        raise ValueError(f"{folder}: no shard_*.npz in it; 'hind4sight collect' makes them")
    return shards


def load_interactions(folder):
    """All shards of a folder, joined -> Interactions. They must share camera, arena and grid."""
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
