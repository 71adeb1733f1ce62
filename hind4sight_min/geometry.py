"""Pinhole camera, rigid motion, the transform layer (Eq. 1) and the projection layer.

Frames: *arena* (z up, origin in the middle of the table surface) and *camera* (OpenCV: x right,
y down, z forward). Units: metres, radians, pixels (a pixel's centre has integer coordinates).
What the losses go through is differentiable by autograd; float32 in gives float32 out.
"""
from dataclasses import dataclass

import autograd.numpy as np
import numpy as onp
from autograd.extend import defvjp, defvjp_argnums, primitive

from .ops import take


@dataclass(frozen=True, eq=False)  # the pose is an array: it has no one-word equality
class Camera:
    """A fixed pinhole camera without lens distortion.

    width, height: image size in pixels. fx, fy, cx, cy: intrinsics in pixels *of this image size*.
    arena_from_camera: (4, 4) float64, the camera's pose: maps camera points to arena points.
    Raises ValueError for sizes, intrinsics or a pose that no camera can have.
    """
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    arena_from_camera: onp.ndarray

    def __post_init__(self):
        if not all(isinstance(size, (int, onp.integer)) and size >= 1 for size in (self.width, self.height)):
            raise ValueError(f"camera: expected a positive whole image size, got {self.width} x {self.height}")
        intrinsics = onp.array([self.fx, self.fy, self.cx, self.cy], float)
        if not onp.isfinite(intrinsics).all() or self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"camera: expected finite intrinsics with fx, fy > 0, got {intrinsics.tolist()}")
        pose = onp.array(self.arena_from_camera, float)
        if pose.shape != (4, 4):
            raise ValueError(f"camera: arena_from_camera must be (4, 4), got {pose.shape}")
        rotation = pose[:3, :3]
        if not (onp.isfinite(pose).all() and onp.allclose(rotation @ rotation.T, onp.eye(3), atol=1e-5)
                and onp.linalg.det(rotation) > 0 and onp.allclose(pose[3], [0, 0, 0, 1])):
            raise ValueError("camera: arena_from_camera is not a rigid transform (rotation and translation)")
        object.__setattr__(self, "arena_from_camera", pose)

    @property
    def camera_from_arena(self):
        """(4, 4) float64: maps arena points to camera points."""
        return onp.linalg.inv(self.arena_from_camera)

    @property
    def is_mirror_symmetric(self):
        """True when the image flipped left-right shows the arena mirrored at its plane x = 0, seen from y < 0."""
        right, position = self.arena_from_camera[:3, 0], self.arena_from_camera[:3, 3]
        return bool(onp.allclose(right, [1, 0, 0], atol=1e-6) and abs(position[0]) < 1e-6
                    and abs(self.cx - (self.width - 1) / 2) < 1e-6)


def look_at(eye, target):
    """Camera pose (4, 4) arena_from_camera at `eye`, looking at `target` (both (3,), m, arena), z up.

    Not in the paper: it only says that the camera is fixed.
    Raises ValueError when it would look straight up or down, where "right" is not defined.
    """
    eye, target = onp.asarray(eye, float), onp.asarray(target, float)
    forward = target - eye
    right = onp.cross(forward, [0.0, 0.0, 1.0])
    if not onp.linalg.norm(right) > 1e-9:
        raise ValueError(f"eye, target: expected two points not one above the other, got {eye}, {target}")
    forward, right = forward / onp.linalg.norm(forward), right / onp.linalg.norm(right)
    pose = onp.eye(4)
    pose[:3] = onp.stack([right, onp.cross(forward, right), forward, eye], axis=1)
    return pose


def rigid(points, transform):
    """Apply one (4, 4) transform to points (..., 3): R p + T, in the dtype of the points.

    Raises ValueError for whole-number points, whose dtype would cut the transform down to whole numbers too.
    """
    if not onp.issubdtype(points.dtype, onp.floating):
        raise ValueError(f"points: expected floating-point metres, got {points.dtype}")
    matrix = transform.astype(points.dtype)
    return np.matmul(points, matrix[:3, :3].T) + matrix[:3, 3]  # ten times as fast as np.dot on a stack of clouds


def unproject(depth, camera):
    """Depth picture to an organised point cloud in the arena frame: the inverse of `project`.

    Paper: Sec. III-A, "raw point cloud P_t = (X_t, Y_t, Z_t)".
    X = (u - cx) Z / fx,  Y = (v - cy) Z / fy, then arena_from_camera.
    depth (..., H, W) m along the optical axis -> points (..., H, W, 3) m. Pixels without depth (0)
    become points at the camera: carry `depth > 0` along as the validity mask.
    Raises ValueError for another picture size and for whole-number depth (convert it to metres first).
    """
    if not onp.issubdtype(depth.dtype, onp.floating):
        raise ValueError(f"depth: expected floating-point metres, got {depth.dtype}")
    if depth.shape[-2:] != (camera.height, camera.width):
        raise ValueError(f"depth: expected (..., {camera.height}, {camera.width}) as the camera says, "
                         f"got {depth.shape}")
    u = (onp.arange(camera.width) - camera.cx) / camera.fx
    v = (onp.arange(camera.height) - camera.cy) / camera.fy
    dtype = depth.dtype
    points_camera = np.stack([depth * u.astype(dtype), depth * v.astype(dtype)[:, None], depth], axis=-1)
    return rigid(points_camera, camera.arena_from_camera)


MIN_DEPTH = 0.05  # m; points nearer than this (or behind the camera) are projected as if at this depth


def project(points_arena, camera):
    """Points (..., 3) m, arena -> pixel positions (..., 2), (x right, y down).

    x = fx X / Z + cx,  y = fy Y / Z + cy  in camera coordinates, with Z at least MIN_DEPTH, so that a
    wild prediction gives a large finite pixel, never an infinite one.
    """
    points_camera = rigid(points_arena, camera.camera_from_arena)
    z = np.maximum(take(points_camera, (..., slice(2, 3))), MIN_DEPTH)
    focal = onp.array([camera.fx, camera.fy], points_arena.dtype)
    centre = onp.array([camera.cx, camera.cy], points_arena.dtype)
    return take(points_camera, (..., slice(0, 2))) / z * focal + centre


def optical_flow(points, predicted, camera):
    """The projection layer: scene flow to optical flow.

    Paper: Sec. III-C.  U = x_{t+1} - x,  V = y_{t+1} - y.
    points, predicted (..., 3) m, arena -> flow (..., 2) px, (U, V).
    """
    return project(predicted, camera) - project(points, camera)


@primitive
def so3_exp(rotation_vector):
    """Rotation vectors (..., 3) rad -> rotation matrices (..., 3, 3): Rodrigues' formula.

    R = I + a [w]x + b [w]x^2,  a = sin(t)/t,  b = (1 - cos t)/t^2,  t = |w|. Paper: Sec. III-A, [R, T] in SE(3).
    """
    a, b, _ = _so3_coefficients(rotation_vector)
    w = _cross_matrix(rotation_vector)
    return onp.eye(3, dtype=w.dtype) + a[..., None, None] * w + b[..., None, None] * onp.matmul(w, w)


def _so3_coefficients(w):
    """a = sin(t)/t, b = (1 - cos t)/t^2, c = (t - sin t)/t^3 at t = |w|: below t = 1e-2 their Taylor series."""
    square = onp.sum(w * w, axis=-1)
    small = square < 1e-4
    t = onp.sqrt(onp.where(small, 1, square))  # a safe t, so that nothing is divided by zero
    return (onp.where(small, 1 - square / 6 + square ** 2 / 120, onp.sin(t) / t),
            # as a half angle it keeps its digits in float32, where (1 - cos t)/t^2 is 0 from t = 1e-4 down
            onp.where(small, 0.5 - square / 24 + square ** 2 / 720, 2 * (onp.sin(t / 2) / t) ** 2),
            onp.where(small, 1 / 6 - square / 120 + square ** 2 / 5040, (t - onp.sin(t)) / t ** 3))


def _cross_matrix(w):
    """[w]x, so that [w]x v = w x v.  (..., 3) -> (..., 3, 3)."""
    x, y, z, zero = w[..., 0], w[..., 1], w[..., 2], onp.zeros_like(w[..., 0])
    return onp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(w.shape + (3,))


def _so3_exp_vjp(ans, w):
    """dR = [J dw]x R with the left Jacobian J = I + b [w]x + c [w]x^2."""
    _, b, c = (value[..., None] for value in _so3_coefficients(w))

    def vjp(g):
        m = onp.matmul(ans, onp.swapaxes(g, -1, -2))  # sum(g * [v]x R) = v . axial
        axial = onp.stack([m[..., 1, 2] - m[..., 2, 1], m[..., 2, 0] - m[..., 0, 2], m[..., 0, 1] - m[..., 1, 0]],
                          axis=-1)
        once = onp.cross(w, axial)
        return axial - b * once + c * onp.cross(w, once)  # J^T axial
    return vjp


defvjp(so3_exp, _so3_exp_vjp)


@primitive
def transform_layer(points, masks, rotations, translations):
    """The transform layer: every point moved by the mask-weighted mean of K rigid motions.

    Paper: Eq. (1), Sec. III-A.  P' = sum_k m_k (R_k P + T_k).
    points (B, N, 3) m; masks (B, N, K), summing to 1 over K; rotations (B, K, 3, 3); translations (B, K, 3) m.
    Returns the predicted points (B, N, 3) m. Raises ValueError for other shapes.

    The K motions are blended first, one (3, 4) matrix per point, by one matrix product:
    sum_k m_k (R_k P + T_k) = (sum_k m_k R_k) P + sum_k m_k T_k.
    """
    batch, count = points.shape[0], masks.shape[-1]
    if points.ndim != 3 or masks.shape != points.shape[:2] + (count,) or rotations.shape != (batch, count, 3, 3) \
            or translations.shape != (batch, count, 3):
        raise ValueError("transform_layer: expected points (B, N, 3), masks (B, N, K), rotations (B, K, 3, 3), "
                         f"translations (B, K, 3), got {points.shape}, {masks.shape}, {rotations.shape}, "
                         f"{translations.shape}")
    blended = onp.matmul(masks, _motions_as_rows(rotations, translations))  # (B, N, 12)
    matrices = blended[..., :9].reshape(points.shape + (3,))
    return onp.einsum("bnij,bnj->bni", matrices, points) + blended[..., 9:]  # Eq. (1)


def _motions_as_rows(rotations, translations):
    return onp.concatenate([rotations.reshape(translations.shape[:2] + (9,)), translations], axis=2)  # (B, K, 12)


def _transform_layer_vjp(argnums, ans, args, kwargs):
    points, masks, rotations, translations = args
    motions = _motions_as_rows(rotations, translations)

    def vjp(g):
        # A point's pull on its blended motion: on the matrix g P^T, on the translation g.
        pull = onp.concatenate([(g[..., None] * points[..., None, :]).reshape(g.shape[:2] + (9,)), g], axis=2)
        on_motions = onp.matmul(onp.swapaxes(masks, 1, 2), pull)  # (B, K, 12)
        matrices = onp.matmul(masks, motions[..., :9]).reshape(points.shape + (3,)) if 0 in argnums else None
        gradients = (lambda: onp.einsum("bnij,bni->bnj", matrices, g),
                     lambda: onp.matmul(pull, onp.swapaxes(motions, 1, 2)),
                     lambda: on_motions[..., :9].reshape(rotations.shape),
                     lambda: on_motions[..., 9:])
        return [gradients[argnum]() for argnum in argnums]
    return vjp


defvjp_argnums(transform_layer, _transform_layer_vjp)


# --- which points of a cloud cannot be near each other (speed: see ops.nearest_squared_distances) ------------------

def ray_spacing(points, camera):
    """How far each point of a depth picture is from every other one, at least: each lies on a pixel's ray of its own.

    |p - eye| times the sine of the smallest angle between two rays. For directions (x, y, 1) and (x + h, y + k, 1) the
    sine is at least |(h, k)| / (|(x, y, 1)| |(x + h, y + k, 1)|).  points (..., 3) m, arena -> (...) m.
    """
    corner = [max(centre, size - 1 - centre) / focal for centre, size, focal in
              ((camera.cx, camera.width, camera.fx), (camera.cy, camera.height, camera.fy))]
    sine = 1 / max(camera.fx, camera.fy) / (1 + corner[0] ** 2 + corner[1] ** 2)
    offsets = points - camera.arena_from_camera[:3, 3].astype(points.dtype)
    return onp.sqrt(onp.einsum("...d,...d->...", offsets, offsets)) * points.dtype.type(sine)


STILL = 5e-4  # m; what moved less stayed, for `free_radius`


def free_radius(points, predicted, spacing):
    """A radius around each predicted point in which no other predicted point lies.

    Two points that stayed are as far apart as before, less twice what they may have moved; one that stayed is as far
    from those that moved as from the box around them. Of a point that moved we know nothing: 0.
    points, predicted (B, N, 3) m; spacing (B, N) m, `ray_spacing` of `points` -> (B, N) m.
    """
    motion = predicted - points
    moved = onp.einsum("bnd,bnd->bn", motion, motion) > STILL ** 2
    radius = onp.where(moved, 0, onp.maximum(spacing - 2 * STILL, 0))
    for i in onp.flatnonzero(moved.any(axis=1)):
        movers = predicted[i, moved[i]]
        outside = onp.maximum(onp.maximum(movers.min(axis=0) - predicted[i], predicted[i] - movers.max(axis=0)), 0)
        radius[i] = onp.minimum(radius[i], onp.sqrt(onp.einsum("nd,nd->n", outside, outside)))
    return radius
