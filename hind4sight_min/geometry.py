"""Pinhole camera, rigid motion, the transform layer (Eq. 1) and the projection layer.

Frames: *arena* (z up, origin in the middle of the table surface) and *camera* (OpenCV: x right, y down, z forward).
Units: metres, radians, pixels (a pixel's centre has integer coordinates). What the losses go through is
differentiable by autograd; float32 in gives float32 out.
"""
from dataclasses import asdict, dataclass

import autograd.numpy as anp
import numpy as np

from . import as_arrays, check_number, check_whole
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
    arena_from_camera: np.ndarray

    def __post_init__(self):
        for name in ("width", "height"):
            check_whole(f"camera: {name}", getattr(self, name), 1)
        for name in ("fx", "fy", "cx", "cy"):
            check_number(f"camera: {name}", getattr(self, name), above=0 if name in ("fx", "fy") else -np.inf)
        pose = np.array(*as_arrays("*", arena_from_camera=self.arena_from_camera), float)
        if pose.shape != (4, 4):
            raise ValueError(f"camera: arena_from_camera must be (4, 4), got {pose.shape}")
        rotation = pose[:3, :3]
        if not (np.isfinite(pose).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
                and np.linalg.det(rotation) > 0 and np.allclose(pose[3], [0, 0, 0, 1])):
            raise ValueError("camera: arena_from_camera is not a rigid transform (rotation and translation)")
        object.__setattr__(self, "arena_from_camera", pose)

    @property
    def camera_from_arena(self):
        """(4, 4) float64: maps arena points to camera points."""
        return np.linalg.inv(self.arena_from_camera)

    @property
    def plain(self):
        """The camera as plain numbers and lists, for files: Camera(**plain) is the same one."""
        return {**asdict(self), "arena_from_camera": self.arena_from_camera.tolist()}

    @property
    def pixel_size(self):
        """How wide a pixel is, in m, at the distance of the arena's origin: turns metres into pixels."""
        return float(np.linalg.norm(self.arena_from_camera[:3, 3])) / self.fx


def rigid(points, transform):
    """R p + T: one (4, 4) transform of points (..., 3), in their dtype. Raises ValueError for what are no points."""
    points, = as_arrays("*3", points=points)
    matrix = transform.astype(points.dtype)
    return anp.matmul(points, matrix[:3, :3].T) + matrix[:3, 3]


def unproject(depth, camera):
    """Depth picture to an organised point cloud in the arena frame: the inverse of `project`.

    Paper: Sec. III-A, "raw point cloud P_t = (X_t, Y_t, Z_t)".
    X = (u - cx) Z / fx,  Y = (v - cy) Z / fy, then arena_from_camera.
    depth (..., H, W) m along the optical axis -> points (..., H, W, 3) m. Pixels without depth (0)
    become points at the camera: carry `depth > 0` along as the validity mask.
    Raises ValueError for another picture size and for whole-number depth (convert it to metres first).
    """
    depth, = as_arrays("*", depth=depth)
    if depth.shape[-2:] != (camera.height, camera.width):
        raise ValueError(f"depth: expected (..., {camera.height}, {camera.width}) as the camera says, "
                         f"got {depth.shape}")
    u = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(depth.dtype)
    v = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(depth.dtype)
    points_camera = anp.stack([depth * u, depth * v[:, None], depth], axis=-1)
    return rigid(points_camera, camera.arena_from_camera)


MIN_DEPTH = 0.05  # m; points nearer than this (or behind the camera) are projected as if at this depth


def project(points_arena, camera):
    """Points (..., 3) m, arena -> pixel positions (..., 2), (x right, y down).

    x = fx X / Z + cx,  y = fy Y / Z + cy  in camera coordinates, with Z at least MIN_DEPTH, so that a
    wild prediction gives a large finite pixel, never an infinite one.
    """
    points_camera = rigid(points_arena, camera.camera_from_arena)
    z = anp.maximum(take(points_camera, (..., slice(2, 3))), MIN_DEPTH)
    focal = np.array([camera.fx, camera.fy], points_camera.dtype)
    centre = np.array([camera.cx, camera.cy], points_camera.dtype)
    return take(points_camera, (..., slice(0, 2))) / z * focal + centre


def optical_flow(points, predicted, camera):
    """The projection layer: scene flow to optical flow.

    Paper: Sec. III-C.  U = x_{t+1} - x,  V = y_{t+1} - y.
    points, predicted (..., 3) m, arena -> flow (..., 2) px, (U, V).
    """
    return project(predicted, camera) - project(points, camera)


# [w]x, so that [w]x v = w x v, as a linear function of w: (3, 9), row i is the matrix of the i-th unit vector.
CROSS = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0],
                  [0, 0, 1, 0, 0, 0, -1, 0, 0],
                  [0, -1, 0, 1, 0, 0, 0, 0, 0]], float)


def so3_exp(rotation_vector):
    """Rotation vectors (..., 3) rad -> rotation matrices (..., 3, 3): Rodrigues' formula.

    Paper: Sec. III-A, [R, T] in SE(3).
    R = I + a [w]x + b [w]x^2,  a = sin(t) / t,  b = (1 - cos t) / t^2 = (sin(t/2) / (t/2))^2 / 2,  t = |w|.
    Both as sinc, which is 1 at t = 0, and b of the half angle, for (1 - cos t) / t^2 is 0 in float32 from t = 1e-4
    down. The 1e-12 keeps the root's derivative finite at w = 0.
    """
    w = anp.matmul(rotation_vector, CROSS.astype(rotation_vector.dtype))
    w = anp.reshape(w, rotation_vector.shape + (3,))
    t = anp.sqrt(anp.sum(rotation_vector * rotation_vector, axis=-1) + rotation_vector.dtype.type(1e-12))
    t = anp.reshape(t, t.shape + (1, 1))
    half = anp.sinc(t / (2 * np.pi))
    return np.eye(3, dtype=w.dtype) + anp.sinc(t / np.pi) * w + half * half / 2 * anp.matmul(w, w)


def transform_layer(points, masks, rotations, translations):
    """The transform layer: every point moved by the mask-weighted mean of K rigid motions.

    Paper: Eq. (1), Sec. III-A.  P' = sum_k m_k (R_k P + T_k).
    points (B, N, 3) m; masks (B, N, K), summing to 1 over K; rotations (B, K, 3, 3); translations (B, K, 3) m.
    Returns the predicted points (B, N, 3) m. Raises ValueError for other shapes.
    """
    points, masks, rotations, translations = as_arrays(
        "BN3 BNK BK33 BK3", points=points, masks=masks, rotations=rotations, translations=translations)
    batch, count = points.shape[0], masks.shape[-1]
    moved = (anp.matmul(anp.reshape(points, (batch, 1, -1, 3)), anp.swapaxes(rotations, 2, 3))
             + anp.reshape(translations, (batch, count, 1, 3)))  # (B, K, N, 3): R_k P + T_k
    weights = anp.reshape(anp.swapaxes(masks, 1, 2), (batch, count, -1, 1))
    return anp.sum(weights * moved, axis=1)  # Eq. (1)


def poke_axes(pokes):
    """Pokes (B, 3) -> axes Q (B, 3, 3), origins o (B, 3) m: p_arena = Q p_poke + o, x along it, o its target."""
    c, s, zero, one = np.cos(pokes[:, 2]), np.sin(pokes[:, 2]), 0 * pokes[:, 2], 0 * pokes[:, 2] + 1
    axes = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    return axes, np.stack([pokes[:, 0], pokes[:, 1], zero], axis=-1)


def poke_frame(points, pokes):
    """Points (B, N, 3) m, arena -> the same in each poke's frame."""
    axes, origins = poke_axes(pokes.astype(points.dtype))
    return np.matmul(points - origins[:, None], axes)
