"""The record of pokes as the robot sees them, and the arena's grid of cells.

On disk it is a folder of shards (disk/shards.py). What the simulator knows of a poke and the robot does not see is a
record of its own (sim/truth.py), which nothing in the core can read.
"""
from dataclasses import dataclass

import cv2
import numpy as np

from . import as_arrays, check_number
from .geometry import Camera

PER_POKE = ("rgb_before", "rgb_after", "depth_before", "depth_after", "pokes", "starts")
MOST_DEPTH = 6.5  # m: what is beyond does not fit into a shard


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
        count, size = len(*as_arrays("M3", pokes=self.pokes)), (self.camera.height, self.camera.width)
        settings = self.meta.get("settings") if isinstance(self.meta, dict) else None
        for name in ("arena", "cell"):
            check_number(f"meta: expected settings with a positive {name!r} in m",
                         settings.get(name) if isinstance(settings, dict) else None, above=0)
        if not 1 <= settings["arena"] / settings["cell"] <= 500:
            raise ValueError(f"meta: expected 1 to 500 cells along the arena, got a 'cell' of {settings['cell']} m")
        expected = {"rgb_before": (count, *size, 3), "rgb_after": (count, *size, 3),
                    "depth_before": (count, *size), "depth_after": (count, *size),
                    "pokes": (count, 3), "starts": (count, 2), "empty_depth": size}
        for name, shape in expected.items():
            value, = as_arrays("*", **{name: getattr(self, name)})
            setattr(self, name, value)
            if value.shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
            if "depth" in name and not (value.min(initial=0) >= 0 and value.max(initial=0) <= MOST_DEPTH):
                raise ValueError(f"{name}: expected 0 (missing) to {MOST_DEPTH} m, got {value.min():g} to "
                                 f"{value.max():g}")
            if name in ("depth_before", "depth_after") and not (value.max(axis=(1, 2)) > 0).all():
                raise ValueError(f"{name}: expected depth in every picture, got none in row "
                                 f"{value.max(axis=(1, 2)).argmin()}")

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
