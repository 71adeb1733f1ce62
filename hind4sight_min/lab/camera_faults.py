"""What real cameras do wrong beside noise, and what a robot does about it before it looks: missing depth is filled in,
a pose that is not quite right corrected by the empty arena's table and walls. Not in the paper, whose depth is complete
and whose pose is known.
"""
from dataclasses import replace
from numbers import Real

import numpy as np

from .. import as_arrays
from ..geometry import rigid, so3_exp, unproject
from ..training import unsupervised
from .noise import MOST_NOISE, add_depth_noise, smoothed

# --- the faults -------------------------------------------------------------------------------------------------

STEP = 0.02  # m; an edge, where depth differs by more from one pixel to another beside it
RIM_WIDTH, SHADOW_WIDTH = 0.01, 0.02  # m on the table
ONE_SIDED = "rims", "shadow"


def lose_depth(depth, rng, camera, missing):
    """Pictures with some of their depth missing, of each kind named.

    missing: of a share in (0, 1), that every pixel is lost with; "rims", what of an object borders on what lies
    farther; "shadow", what lies farther and borders on an object, where the projector does not reach. Both on one side,
    left or right, as with a projector beside the camera; at least a pixel wide. depth (..., H, W) m, 0 = missing ->
    the same shape and dtype. Raises ValueError for any other kind.
    """
    depth, = as_arrays("*HW", depth=depth)
    side, lost = rng.choice([-1, 1]), np.zeros(depth.shape, bool)

    def beside(offset):
        columns = np.clip(np.arange(depth.shape[-1]) + offset, 0, depth.shape[-1] - 1)
        return depth[..., columns]

    def pixels(metres):
        return range(1, 1 + max(1, round(metres / camera.pixel_size)))

    for kind in missing:
        if kind == "rims":
            lost |= np.any([beside(side * k) - depth > STEP for k in pixels(RIM_WIDTH)], axis=0)
        elif kind == "shadow":
            lost |= np.any([depth - beside(-side * k) > STEP for k in pixels(SHADOW_WIDTH)], axis=0)
        elif isinstance(kind, (float, np.floating)) and 0 < kind < 1:
            lost |= rng.random(depth.shape) < kind
        else:
            raise ValueError("missing: expected a share above 0 and below 1, or one of "
                             f"{', '.join(ONE_SIDED)}, got {kind}")
    return np.where(lost, 0, depth)


def wrong_pose(camera, turn, shift):
    """The camera as one takes it to be whose pose is off: by a rotation vector `turn` (3,) rad about its own axes, x to
    the right, so that x alone is pitch, and by `shift` (3,) m in the arena.
    """
    pose = camera.arena_from_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ so3_exp(np.asarray(turn, float))
    pose[:3, 3] += shift
    return replace(camera, arena_from_camera=pose)


def somewhere(rng, length):
    """A vector (3,) of a length, in any direction."""
    vector = rng.standard_normal(3)
    return length * vector / np.linalg.norm(vector)


def with_faults(interactions, rng, depth_noise=0.0, missing=(), pitch_error=0.0, pose_error=()):
    """The same pokes as a camera with faults shows them. A record in, a record out.

    depth_noise: SD in m, see `add_depth_noise`. missing: see `lose_depth`; before and after on one side. pitch_error:
    by how many degrees the camera is taken to look too far up. pose_error: (degrees, m), a rotation about any axis and
    a shift in any direction, drawn once for all these pokes: a camera stands still. The empty arena is known without
    noise, as a mean of many pictures, but from the same wrong pose. Raises ValueError for what no camera does.
    """
    if np.shape(pose_error) not in ((0,), (2,)):
        raise ValueError(f"pose_error: expected (degrees, m), got {pose_error}")
    (degrees, metres), missing = pose_error if len(pose_error) else (0, 0), np.atleast_1d(np.array(missing, object))
    for name, value, most, unit in (
            ("depth_noise", depth_noise, MOST_NOISE, "m"), ("pose_error", metres, 1, "m"),
            ("pitch_error", pitch_error, 45, "degrees"), ("pose_error", degrees, 45, "degrees")):
        if not (isinstance(value, Real) and abs(value) <= most):
            raise ValueError(f"{name}: expected at most {most} {unit}, got {value}")
    pictures = np.stack([interactions.depth_before, interactions.depth_after])
    seen = np.stack([add_depth_noise(each, rng, depth_noise) for each in pictures]) if depth_noise else pictures
    if len(missing):
        seen = np.where(lose_depth(pictures, rng, interactions.camera, missing) > 0, seen, 0)
    turn, shift = somewhere(rng, np.radians(degrees)), somewhere(rng, metres)
    camera = wrong_pose(interactions.camera, turn + [np.radians(pitch_error), 0, 0], shift)
    return replace(interactions, depth_before=seen[0], depth_after=seen[1], camera=camera)


# --- what a robot does about them --------------------------------------------------------------------------------

TABLE = 0.05, 0.25  # m around z = 0 in which the table is looked for, and the share of the pixels that must be there


def level(camera, empty_depth):
    """The camera with its pose turned and raised until the table of the empty arena (H, W) m is level, at z = 0.

    A wrong pitch, a wrong height and half of a wrong roll show in the empty picture and vanish; a shift along the table
    and a turn about the vertical do not show. The table is the plane that half of the points near z = 0 lie nearest to
    (least trimmed squares): the walls do not bend it. Raises ValueError where too few points are near z = 0.
    """
    empty_depth, = as_arrays("HW", empty_depth=empty_depth)
    points = unproject(empty_depth.astype(float), camera)[empty_depth > 0]
    near = points[np.abs(points[:, 2]) < TABLE[0]]
    if len(near) < TABLE[1] * empty_depth.size:
        raise ValueError(f"empty_depth: expected the table within {TABLE[0]:g} m of z = 0 in {TABLE[1]:.0%} of the "
                         f"pixels, got {len(near) / empty_depth.size:.0%}; is the camera's pose right?")
    design, away = np.column_stack([near[:, :2], np.ones(len(near))]), np.abs(near[:, 2] - np.median(near[:, 2]))
    for _ in range(10):
        on = away <= np.median(away)
        plane = np.linalg.lstsq(design[on], near[on, 2], rcond=None)[0]  # z = a x + b y + c
        away = np.abs(near[:, 2] - design @ plane)
    normal = np.array([-plane[0], -plane[1], 1]) / np.hypot(1, np.hypot(*plane[:2]))
    axis = np.cross(normal, [0, 0, 1])  # as long as the sine of the angle
    sine = np.linalg.norm(axis)
    pose, eye = camera.arena_from_camera.copy(), camera.arena_from_camera[:3, 3]
    pose[:3, :3] = so3_exp(axis * (np.arcsin(sine) / sine if sine else 1)) @ pose[:3, :3]
    pose[2, 3] = normal @ (eye - [0, 0, plane[2]])  # the eye's distance from the table
    return replace(camera, arena_from_camera=pose)


WALL = 0.02, 0.035  # m: how thick the simulator's walls are, and how far from where they stand they are looked for


def along_walls(camera, empty_depth, settings):
    """A level camera turned about the vertical and shifted along the table until the walls of the empty arena (H, W) m
    stand where the settings have them.

    Every point of a wall lies arena / 2 to arena / 2 + WALL from the middle, along x or along y: Gauss-Newton steps on
    what is missing to that. What is as high as the walls and near there is taken for one.
    """
    near, far = settings["arena"] / 2, settings["arena"] / 2 + WALL[0]
    points = unproject(empty_depth.astype(float), camera)[empty_depth > 0]
    height, out = points[:, 2] / settings["wall_height"], np.abs(points[:, :2]).max(axis=1)
    walls = points[(height > 0.3) & (height < 1.5) & (out > near - WALL[1]) & (out < far + WALL[1])]
    moved = np.eye(4)
    for _ in range(10):
        xy = rigid(walls, moved)[:, :2]
        out = np.abs(xy).max(axis=1)
        missing = np.maximum(near - out, 0) + np.minimum(far - out, 0)
        outwards = np.sign(xy) * (np.abs(xy) == out[:, None]) * (missing != 0)[:, None]
        slopes = np.column_stack([outwards, outwards[:, 1] * xy[:, 0] - outwards[:, 0] * xy[:, 1]])
        dx, dy, turn = np.linalg.lstsq(slopes, missing, rcond=None)[0]
        step = np.eye(4)
        step[:3, :3], step[:2, 3] = so3_exp(np.array([0, 0, turn])), (dx, dy)
        moved = step @ moved
    return replace(camera, arena_from_camera=moved @ camera.arena_from_camera)


def prepared(interactions):
    """Pokes as a robot with a real camera gives them to the model: depth smooth, holes filled, and the pose corrected
    by the empty arena, as far as that shows it. A record in, a record out.
    """
    empty, settings = interactions.empty_depth, interactions.settings
    camera = level(interactions.camera, empty)
    if settings.get("wall_height"):
        camera = along_walls(camera, empty, settings)
    seen = smoothed(interactions, interactions.depth_before, interactions.depth_after)
    return replace(interactions, **seen, camera=camera)


# --- training ----------------------------------------------------------------------------------------------------

# The faults of `with_faults`, and which share of the chunks comes with each: what costs the most comes most often.
TRAINED = {"depth_noise": (0.01, 0.75), "missing": ((0.3, *ONE_SIDED), 0.25), "pose_error": ((1.0, 0.01), 0.5)}


def under_faults(params, recipe, interactions, rng, objective=unsupervised):
    """A training objective on pictures with faults, drawn anew in every step: for `training.train`.

    Every fault of TRAINED comes with its share of the chunks, so that the model also knows a camera without it.
    """
    drawn = {name: value for name, (value, share) in TRAINED.items() if rng.random() < share}
    return objective(params, recipe, prepared(with_faults(interactions, rng, **drawn)), rng)
