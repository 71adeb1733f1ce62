"""Camera and rigid motion

A depth picture is a point cloud, and a poke moves the points of each object rigidly: a rotation and a translation.

**The camera.** Pixel (u, v), u to the right and v down, at depth Z *along the optical axis* shows the point

    X = (u - cx) Z / fx,    Y = (v - cy) Z / fy,    Z

of the camera's frame (x right, y down, z forward). The pose `arena_from_camera`, a 4 x 4 matrix [R, T; 0, 1], takes it
to the arena's frame (z up, origin in the middle of the table): R p + T. Projection goes the other way. Points nearer
than MIN_DEPTH, or behind the camera, are projected as if at MIN_DEPTH: a wild prediction gives a large pixel, never an
infinite one. The *optical flow* of a motion is by how many pixels the projected point moves.

**Rotation.** A rotation vector w is an axis times an angle t = |w|. Rodrigues' formula makes a matrix of it:

    R = I + a [w]x + b [w]x^2,    a = sin(t) / t,    b = (1 - cos t) / t^2,    [w]x v = w x v

At t = 0 both are limits, 1 and 1/2, and neither a value nor a gradient may be NaN there: `np.sinc`, and the half angle,
help, and so does a tiny number under the root.

**The transform layer, Eq. (1).** Each point belongs to mask k with weight m^k, and moves by the weighted mean

    P' = sum_k m^k (R^k P + T^k).

**The poke's frame.** The model sees everything from the poke u = (a_x, a_y, a_theta): origin at its target on the
table, x along its direction, so that p_arena = Q p_poke + o, with Q a turn by a_theta about z.

Paper: Sec. III-A (Eq. 1) and III-C; tutorials/01_point_clouds.py and tutorials/02_rigid_motion.py.
"""
from dataclasses import replace

import autograd.numpy as anp
import numpy as np

from ...geometry import (CROSS, Camera, optical_flow, poke_axes, poke_frame, project, rigid, so3_exp, transform_layer,
                         unproject)
from ..task import Task, single

DOWN = np.array([[1.0, 0, 0, 0.2], [0, -1, 0, 0.1], [0, 0, -1, 2], [0, 0, 0, 1]])  # a camera 2 m above, looking down


def posed(rng):
    """The pose of a camera somewhere above the table, a little tilted."""
    pose = DOWN.copy()
    pose[:3, :3] = pose[:3, :3] @ so3_exp(rng.uniform(-0.4, 0.4, 3))
    pose[:3, 3] += rng.uniform(-0.3, 0.3, 3)
    return pose


def camera_of(intrinsics, pose, size=(4, 3)):
    return Camera(*size, *(float(each) for each in intrinsics), pose)


def at(camera, pose):
    return replace(camera, arena_from_camera=pose)


# --- unproject ---

def depth_cases(rng):
    by_hand = {"depth": np.array([[2.0, 1], [1, 3]]), "intrinsics": np.array([2.0, 4, 0.5, 0]), "pose": DOWN}
    drawn = [{"depth": rng.uniform(0.5, 2, (2, 3, 4)), "intrinsics": np.array([5.0, 6, 1.3, 1.2]), "pose": posed(rng)}
             for _ in range(2)]
    return [by_hand, drawn[0], {**drawn[1], "depth": drawn[1]["depth"].astype(np.float32)}]


def from_depth(function, depth, intrinsics, pose):
    return function(depth, camera_of(intrinsics, pose, depth.shape[:-3:-1]))


def along_the_ray(depth, camera):
    rays = unproject(np.ones(depth.shape, depth.dtype), at(camera, np.eye(4)))
    return unproject(depth / np.linalg.norm(rays, axis=-1), camera)


# --- project ---

def point_cases(rng):
    points = np.array([[[0.2, 0.1, 0], [0.7, 0.1, 0], [0.2, 0.6, 1]]])
    by_hand = {"points": points, "intrinsics": np.array([2.0, 4, 1, 3]), "pose": DOWN}
    drawn = [{"points": rng.uniform(-0.6, 0.6, (2, 5, 3)), "intrinsics": np.array([5.0, 6, 1.3, 1.2]),
              "pose": posed(rng)} for _ in range(2)]
    drawn[0]["points"][0, 0] = drawn[0]["pose"][:3, 3] + [0.1, 0.05, 0.3]  # behind the camera
    return [by_hand, drawn[0], {**drawn[1], "points": drawn[1]["points"].astype(np.float32)}]


def of_points(function, points, intrinsics, pose):
    return function(points, camera_of(intrinsics, pose))


def without_least_depth(points, camera):
    local = rigid(points, camera.camera_from_arena)
    pixels = local[..., :2] / local[..., 2:] * np.array([camera.fx, camera.fy], points.dtype)
    return pixels + np.array([camera.cx, camera.cy], points.dtype)


# --- optical flow ---

def motion_cases(rng):
    cases = point_cases(rng)
    for case in cases:
        points = case["points"]
        moved = np.array([0.5, -0.25, 0]) if case is cases[0] else rng.uniform(-0.2, 0.2, points.shape)
        case["predicted"] = (points + moved).astype(points.dtype)
    return cases


def of_motion(function, points, predicted, intrinsics, pose):
    return function(points, predicted, camera_of(intrinsics, pose))


# --- rotations ---

def rotation_cases(rng):
    drawn = rng.uniform(-2, 2, (2, 4, 3))
    drawn[0, 0] = 0  # nothing turns
    return [{"rotation_vector": each} for each in (np.array([0, 0, np.pi / 2]), drawn[0])] + [
        single({"rotation_vector": drawn[1]})]


def rodrigues(w, a, b):
    cross = anp.reshape(anp.matmul(w, CROSS.astype(w.dtype)), w.shape + (3,))
    t = anp.sqrt(anp.sum(w * w, axis=-1))[..., None, None]
    return np.eye(3, dtype=w.dtype) + a(t) * cross + b(t) * anp.matmul(cross, cross)


# --- the transform layer ---

def layer_cases(rng):
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    by_hand = {"points": np.array([[[1.0, 0, 0], [0, 2, 0]]]), "masks": np.array([[[0, 1], [0.5, 0.5]]]),
               "rotations": np.array([[np.eye(3), quarter]]), "translations": np.array([[[0.0, 0, 0], [3, 0, 0]]])}

    def drawn():
        masks = rng.random((2, 5, 4))
        return {"points": rng.normal(size=(2, 5, 3)), "masks": masks / masks.sum(axis=2, keepdims=True),
                "rotations": so3_exp(rng.normal(size=(2, 4, 3))), "translations": rng.normal(size=(2, 4, 3))}
    return [by_hand, drawn(), single(drawn())]


def translated_first(points, masks, rotations, translations):
    moved = anp.einsum("bkij,bnkj->bnki", rotations, points[:, :, None] + translations[:, None])
    return anp.sum(masks[..., None] * moved, axis=2)


# --- the poke's frame ---

def poke_cases(rng):
    by_hand = {"points": np.array([[[0.1, 0.2, 0.05], [0.3, 0.2, 0]]]), "pokes": np.array([[0.1, 0.1, np.pi / 2]])}
    drawn = [{"points": rng.uniform(-0.3, 0.3, (3, 4, 3)), "pokes": rng.uniform(-1, 1, (3, 3)) * [0.2, 0.2, 3]}
             for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


TASKS = (
    Task("1.1", "geometry.unproject", "Depth picture to points in the arena", 20, 30, depth_cases, from_depth,
         gradient=("depth",), mistakes={
             "The points are still in the camera's frame":
                 lambda depth, camera: unproject(depth, at(camera, np.eye(4))),
             "arena_from_camera was inverted":
                 lambda depth, camera: unproject(depth, at(camera, camera.camera_from_arena)),
             "fx and fy swapped":
                 lambda depth, camera: unproject(depth, replace(camera, fx=camera.fy, fy=camera.fx)),
             "The picture's middle instead of the principal point (cx, cy)":
                 lambda depth, camera: unproject(depth, replace(camera, cx=camera.width / 2, cy=camera.height / 2)),
             "Depth is along the optical axis, not along each pixel's ray": along_the_ray},
         notes="Of the camera, intrinsics are fx, fy, cx, cy, and pose is arena_from_camera."),
    Task("1.2", "geometry.project", "Points to pixels, never infinite", 20, 20, point_cases, of_points,
         gradient=("points",), mistakes={
             "The points were not brought into the camera's frame":
                 lambda points, camera: project(points, at(camera, np.eye(4))),
             "arena_from_camera instead of camera_from_arena":
                 lambda points, camera: project(points, at(camera, camera.camera_from_arena)),
             "fx for both axes": lambda points, camera: project(points, replace(camera, fy=camera.fx)),
             "The principal point (cx, cy) was not added":
                 lambda points, camera: project(points, replace(camera, cx=0.0, cy=0.0)),
             "x and y swapped": lambda points, camera: project(points, camera)[..., ::-1],
             "Right but for points behind the camera: Z must be at least MIN_DEPTH": without_least_depth}),
    Task("1.3", "geometry.optical_flow", "By how many pixels a motion moves each point", 10, 5, motion_cases, of_motion,
         gradient=("points", "predicted"), mistakes={
             "Minus the flow": lambda points, predicted, camera: optical_flow(predicted, points, camera),
             "x and y swapped": lambda points, predicted, camera: optical_flow(points, predicted, camera)[..., ::-1],
             "Where the points end, not by how much they moved":
                 lambda points, predicted, camera: project(predicted, camera),
             "The motion was projected as if it were a point":
                 lambda points, predicted, camera: project(predicted - points, camera)}),
    Task("1.4", "geometry.so3_exp", "Rodrigues' formula, also where nothing turns", 20, 40, rotation_cases,
         gradient=("rotation_vector",), mistakes={
             "Turned the other way: the sign of [w]x": lambda w: so3_exp(-w),
             "NaN where nothing turns: sin(t) / t is 0 / 0 at t = 0":
                 lambda w: rodrigues(w, lambda t: anp.sin(t) / t, lambda t: (1 - anp.cos(t)) / t ** 2),
             "Only the small-angle part I + [w]x": lambda w: rodrigues(w, lambda t: 1.0, lambda t: 0.0),
             "np.sinc(x) is sin(pi x) / (pi x)": lambda w: rodrigues(w, anp.sinc, lambda t: anp.sinc(t / 2) ** 2 / 2)},
         notes="The product of w with `CROSS`, (3, 9), makes [w]x, row by row."),
    Task("1.5", "geometry.transform_layer", "Every point moved by the masks' mean motion, Eq. (1)", 20, 30, layer_cases,
         gradient=("points", "masks", "rotations", "translations"), mistakes={
             "R transposed: rows times R instead of R times columns":
                 lambda p, m, r, t: transform_layer(p, m, anp.swapaxes(r, 2, 3), t),
             "The translation is missing": lambda p, m, r, t: transform_layer(p, m, r, 0 * t),
             "Translated first, then rotated": translated_first,
             "The translations are not weighted by the masks":
                 lambda p, m, r, t: transform_layer(p, m, r, 0 * t) + anp.sum(t, 1)[:, None],
             "The motion was added to the point, which R P + T holds already":
                 lambda p, m, r, t: p + transform_layer(p, m, r, t)}),
    Task("1.6", "geometry.poke_frame", "Points as each poke sees them", 10, 15, poke_cases, mistakes={
        "Turned the other way: the inverse of Q is its transpose":
            lambda points, pokes: poke_frame(points, pokes * [1, 1, -1]).astype(points.dtype),
        "Turned before it was shifted":
            lambda points, pokes: np.matmul(points, poke_axes(pokes)[0]) - poke_axes(pokes)[1][:, None],
        "Not shifted to the target": lambda points, pokes: np.matmul(points, poke_axes(pokes)[0])},
         notes="`poke_axes` gives Q and o."),
)
TESTS = ("eq1_transform",)
