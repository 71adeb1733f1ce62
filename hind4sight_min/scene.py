"""What the robot sees: a picture, prepared once, and where in it the model looks.

Lengths here are metres on the table, never counts of pixels or points, so that a picture of another size shows the
model the same.
"""
from dataclasses import dataclass

import cv2
import numpy as np

from .geometry import project, unproject
from .ops import at_rows


@dataclass(frozen=True)
class Scene:
    """B pictures, prepared by `scene_of`: N points each, row by row. Planning appends the points that the user marked.

    points (B, N, 3) float32 m, arena. valid (B, N) bool: has depth. occupied (B, N) bool: of an object, Sec. IV-A.
    stands_out (B, N) bool: nearer than the empty arena by more than OCCUPIED, or within RIM of a point that is.
    images (B, H, W, 3) float32 in [0, 1], N = H W but for marks; None where planning moved the points. arena: side, m.
    """
    points: np.ndarray
    valid: np.ndarray
    occupied: np.ndarray
    stands_out: np.ndarray
    images: np.ndarray = None
    arena: float = np.inf


OCCUPIED = 0.008  # m: background subtraction takes what is nearer than the empty arena by more for an object
RIM = 0.009  # m: what lies so near to it, in the picture, still stands out


def scene_of(depth, rgb, empty_depth, camera, arena):
    """Prepare B pictures -> Scene.

    Background subtraction, Sec. IV-A: what stands nearer than the empty arena by more than OCCUPIED, inside the walls,
    is an object's. depth (B, H, W) float m, 0 = missing; rgb (B, H, W, 3) uint8; empty_depth (H, W) m; arena: side, m.
    """
    points = unproject(depth, camera)
    near = (depth > 0) & (empty_depth > 0) & (empty_depth - depth > OCCUPIED)
    inside = (np.abs(points[..., 0]) < arena / 2) & (np.abs(points[..., 1]) < arena / 2)
    reach = max(1, round(RIM / camera.pixel_size))
    around = np.ones((2 * reach + 1,) * 2, np.uint8)
    stands_out = np.stack([cv2.dilate(each, around) for each in near.astype(np.uint8)]) > 0
    flat = depth.shape[0], -1
    return Scene(points.reshape(*flat, 3), depth.reshape(flat) > 0, (near & inside).reshape(flat),
                 stands_out.reshape(flat), rgb.astype(np.float32) / 255, arena)


# --- where the model looks ----------------------------------------------------------------------------------------

AHEAD = 0.02  # m: things roll on, so the middle of what a poke can move lies past its target
REACH = 0.14  # m: and this far around it


def box_of(pokes):
    """The box on the table around where each poke (B, 3) ends: its middle (B, 2) m; it reaches REACH to all sides."""
    return pokes[:, :2] + AHEAD * np.stack([np.cos(pokes[:, 2]), np.sin(pokes[:, 2])], axis=1)


def look(scene, pokes):
    """Where the forward model looks: the points that stand out, near where the poke ends.

    Not in the paper. All other points are background that stays; what motion this loses is in docs/extending.md.
    pokes (B, 3) -> rows (B, M) int, in order, and which of them count, (B, M) bool: M is what the fullest of the
    B scenes needs, and the others' rows are filled up with points that do not count.
    """
    away = np.abs(scene.points[..., :2] - box_of(pokes)[:, None].astype(np.float32)) < REACH
    seen = scene.valid & scene.stands_out & away[..., 0] & away[..., 1]
    count = max(1, seen.sum(axis=1).max())
    rows = np.argsort(~seen, axis=1, kind="stable")[:, :count]  # a stable sort keeps the points' order
    return rows, np.take_along_axis(seen, rows, axis=1)


TALL = 0.07  # m: the tallest object


def crop(scene, pokes, camera):
    """The part of each picture that shows the box around where its poke ends: for speed in training alone.

    Outside of it nothing moves, so losses there do not depend on the model. The flow U = x' - x stays right, for the
    principal point cancels. All B parts have the size of the largest.
    """
    middle, corners = box_of(pokes), np.array([[x, y, z] for x in (-REACH, REACH) for y in (-REACH, REACH)
                                               for z in (0, TALL)])
    corners = corners + np.pad(middle, ((0, 0), (0, 1)))[:, None]
    pixels, picture = project(corners, camera), np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=1)), 0, picture - 1).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=1)), 0, picture - 1).astype(int)
    columns, rows = (high - low).max(axis=0) + 1
    left, top = np.minimum(low, picture - [columns, rows]).T

    def cut(pictures):  # (B, H, W, ...) -> (B, rows, columns, ...)
        return np.stack([each[y:y + rows, x:x + columns] for each, x, y in zip(pictures, left, top)])
    shape = len(pokes), camera.height, camera.width
    flat = {name: cut(value.reshape(*shape, *value.shape[2:])).reshape(len(pokes), -1, *value.shape[2:])
            for name, value in vars(scene).items() if name not in ("images", "arena")}
    return Scene(**flat, images=cut(scene.images), arena=scene.arena)


# --- what changed: the evidence of a poke, for the inverse model --------------------------------------------------

CHANGED = 1 / 24  # of the picture's points: a poke changes about a hundred of 64 x 48


def most_changed(before, after):
    """Where two Scenes of the same camera differ, pixel by pixel. Not in the paper.

    -> the M most changed points before and after, (B, M, 3) each, and their weights (B, M), summing to 1 (0 where
    nothing changed). The weight is |P_{t+1} - P_t|^4: the power keeps the many small differences of a noisy depth
    picture from outvoting the few large ones.
    """
    change = np.sum((after.points - before.points) ** 2, axis=2) ** 2 * (before.valid & after.valid)
    count = round(CHANGED * change.shape[1])
    rows = np.argsort(-change, axis=1, kind="stable")[:, :count]
    weights = np.take_along_axis(change, rows, axis=1)
    weights = weights / (weights.sum(axis=1, keepdims=True) + np.finfo(change.dtype).tiny)
    return before.points[at_rows(rows)], after.points[at_rows(rows)], weights
