"""Points that the user marks on a picture, and where they are after a poke. Paper: Sec. IV-G, "user marked object
points"; how they are found again is not in the paper.
"""
import numpy as np
from scipy.spatial import cKDTree

from .. import as_arrays


def points_at(pixels, scene, camera):
    """The points (M, 3) m, arena, of a Scene of one picture that the user marked at pixels (M, 2), (x right, y down).

    Raises ValueError for a mark outside the picture or on the background.
    """
    pixels, = as_arrays("*", marks=pixels)
    if pixels.ndim != 2 or pixels.shape[1] != 2 or not len(pixels):
        raise ValueError(f"marks: expected (M, 2) pixels, at least one, got shape {pixels.shape}")
    found = []
    for x, y in pixels:
        column, row = (int(np.rint(value)) if np.isfinite(value) else -1 for value in (x, y))
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            raise ValueError(f"marks: ({x:g}, {y:g}) lies outside the {camera.width} x {camera.height} picture")
        if not scene.occupied[0, row * camera.width + column]:
            raise ValueError(f"marks: ({x:g}, {y:g}) lies on the background, not on an object")
        found.append(scene.points[0, row * camera.width + column])
    return np.array(found, np.float32)


def at_height(pixels, heights, camera):
    """Where, (M, 2) m, the rays through pixels (M, 2) are at these heights (M,) m. Not in the paper."""
    pose = camera.arena_from_camera
    rays = np.column_stack([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))])
    rays = rays @ pose[:3, :3].T
    return pose[:2, 3] + rays[:, :2] * ((heights - pose[2, 3]) / rays[:, 2])[:, None]


def places_at(pixels, heights, camera, settings):
    """Where on the arena, (M, 2) m, something of these heights (M,) m is that the camera sees at pixels (M, 2).

    Raises ValueError where that is outside the picture or the walls: a goal there cannot be met.
    """
    pixels, = as_arrays("*", goals=pixels)
    if pixels.shape != (len(heights), 2) or not np.isfinite(pixels).all():
        raise ValueError(f"goals: expected ({len(heights)}, 2) finite pixels, one per mark, got shape {pixels.shape}")
    places = at_height(pixels, heights, camera)
    for (x, y), place in zip(pixels, places):
        if not (0 <= x <= camera.width - 1 and 0 <= y <= camera.height - 1):
            raise ValueError(f"goals: ({x:g}, {y:g}) lies outside the {camera.width} x {camera.height} picture")
        if np.abs(place).max() > settings["arena"] / 2:
            raise ValueError(f"goals: ({x:g}, {y:g}) lies outside the walls, where no object can get")
    return places


COLOUR = 0.10  # m: how far apart black and white count when points are matched by place and colour
NEAR_MARK = 0.055  # m: most of what is seen of an object is nearer to a mark in its middle


def follow(view, prediction, next_scene):
    """Where the marked points are after a poke that the robot has carried out, (M, 3) m. Not in the paper.

    The model says which points belong to a mark's object (its mask) and where they went; iterated closest points, by
    place and colour, in the plane of the table, correct that by what is seen. view: before; prediction: of `predict`
    for the view's Scene and the poke; next_scene: the Scene after.
    """
    pixels = len(view.cloud) - view.marked
    cloud, occupied, moved = view.cloud[:pixels], view.occupied[:pixels], prediction.points[0]
    masks, colours = prediction.masks[0].argmax(axis=1), COLOUR * view.scene.images.reshape(-1, 3)
    seen = next_scene.occupied[0]
    tree = cKDTree(np.column_stack([next_scene.points[0], COLOUR * next_scene.images.reshape(-1, 3)])[seen])
    result = []
    for mark in range(pixels, len(view.cloud)):
        near = np.linalg.norm(cloud - view.cloud[mark], axis=1)
        own = occupied & (near < NEAR_MARK) & (masks[:pixels] == masks[mark])
        if masks[mark] == 0 or own.sum() < 8:
            own = occupied & (near < NEAR_MARK / 2)
        if own.sum() < 3 or not seen.any():  # nothing to match: believe the model
            result.append(moved[mark])
            continue
        turn, shift = _register(cloud[own], moved[:pixels][own], colours[own], tree)
        there = turn * complex(*view.cloud[mark, :2]) + shift
        result.append([there.real, there.imag, view.cloud[mark, 2]])
    return np.array(result, np.float32).reshape(-1, 3)


def _register(points, where, colours, tree, rounds=15, kept=0.85):
    """The planar motion of points (n, 3), at first guessed to go to `where`, that best fits those in `tree`; the worst
    sixth is left out as hidden. -> turn, shift: complex numbers, so that z = x + iy goes to turn z + shift.
    """
    here = points[:, 0] + 1j * points[:, 1]
    for _ in range(rounds):
        distance, nearest = tree.query(np.column_stack([where, colours]))
        best = np.argsort(distance)[:max(3, int(kept * len(distance)))]
        source, target = here[best], tree.data[nearest[best], 0] + 1j * tree.data[nearest[best], 1]
        turn = np.exp(1j * np.angle(np.vdot(source - source.mean(), target - target.mean())))  # the best in closed form
        shift = target.mean() - turn * source.mean()
        there = turn * here + shift
        where = np.column_stack([there.real, there.imag, points[:, 2]])
    return turn, shift
