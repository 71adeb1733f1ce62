"""Real cameras: from what one recorded to what a model sees. Not in the paper, whose camera is a simulator's.

Pictures lose their lens distortion and become small, holes in the depth stay holes, and the camera's pose is found in
the picture of the empty table. A camera that cannot show a model its arena is refused.
"""
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ..disk.recordings import EMPTY, load_recording
from ..disk.shards import SHARD_POKES, find_shards, save_shard
from ..geometry import Camera, project, unproject
from ..interactions import MOST_DEPTH, Interactions
from ..scene import look, scene_of

COARSEST = 2.0  # times the pixels that a model was trained with


def check_camera(camera, trained=None):
    """Raise ValueError naming the field that keeps a camera from showing a model its arena.

    A model sees points in arena coordinates, so any other camera will do whose pose is known: above the table, the
    arena's middle in its picture, its pixels fine enough. trained: the camera of the training, if there was one.
    """
    (x, y), above, ahead = project(np.zeros(3), camera), camera.arena_from_camera[2, 3], camera.camera_from_arena[2, 3]
    if above <= 0:
        raise ValueError(f"camera: arena_from_camera: expected a camera above the table, got one at z = {above:.3g} m")
    if ahead <= 0 or not (0 <= x < camera.width and 0 <= y < camera.height):
        raise ValueError("camera: arena_from_camera: expected the arena's middle in the picture, got it at "
                         f"({x:.0f}, {y:.0f}) of {camera.width} x {camera.height} px, {ahead:.3g} m ahead")
    limit = COARSEST * trained.pixel_size if trained else np.inf
    if camera.pixel_size > limit:
        raise ValueError(f"camera: fx: expected pixels of at most {1e3 * limit:.0f} mm on the table, "
                         f"{COARSEST:g} times those of the training, got {1e3 * camera.pixel_size:.0f} mm")


# --- smaller pictures without distortion --------------------------------------------------------------------------

SEEN = 0.5  # of a block: with depth in less of it a pixel has none
FLAT = 0.01  # m: what lies nearer to the plane of the table is of it, and two points so near on one surface


@dataclass(frozen=True)
class Sampling:
    """How a smaller picture without distortion is made: each pixel from a block of fine ones, those from the recorded.

    matrix (3, 3): its intrinsics. maps: x and y, (H block, W block) float32, of the fine pixels in the recorded
    picture. block: fine pixels along the side of a pixel.
    """
    matrix: np.ndarray
    maps: tuple
    block: int

    def colour(self, picture):
        """(h, w, 3) uint8 -> (H, W, 3): the mean of every block."""
        fine, (height, width) = cv2.remap(picture, *self.maps, cv2.INTER_LINEAR), self.maps[0].shape
        return cv2.resize(fine, (width // self.block, height // self.block), interpolation=cv2.INTER_AREA)

    def depth(self, picture):
        """(h, w) m, 0 = missing -> (H, W): the median of every block, but of two middle ones that are FLAT apart the
        nearer, for their mean would lie between object and table. Missing where less than SEEN of it has depth.
        """
        fine, side = cv2.remap(picture, *self.maps, cv2.INTER_NEAREST), self.block
        height, width = np.array(fine.shape) // side
        blocks = fine.reshape(height, side, width, side).swapaxes(1, 2).reshape(height, width, -1)
        seen = (blocks > 0).sum(axis=2)
        ordered = np.sort(np.where(blocks > 0, blocks, np.inf), axis=2)
        near, far = (np.take_along_axis(ordered, np.maximum(middle, 0)[..., None] // 2, axis=2)[..., 0]
                     for middle in (seen - 1, seen))
        median = np.where(far < near + FLAT, (near + far) / 2, near)
        return np.where(seen >= SEEN * side ** 2, median, 0).astype(np.float32)


def sampling_of(recording, size):
    """The Sampling that makes pictures of `size` (W, H) px from those of a recording: from their middle, as much of it
    as has that form. Raises ValueError for a size larger than theirs.
    """
    size, recorded, matrix = np.array(size), np.array([recording.width, recording.height]), recording.camera_matrix
    if size.min() < 16 or (size > recorded).any():
        raise ValueError("size: expected 16 x 16 px to {} x {} as recorded, got {} x {}".format(*recorded, *size))
    factor = (recorded / size).min()
    block, corner = int(np.ceil(factor)), (recorded - factor * size) / 2

    def scaled(factor):  # a pixel's middle has whole coordinates, so a picture begins at -1/2
        smaller = np.diag([1 / factor, 1 / factor, 1]) @ matrix
        smaller[:2, 2] += 0.5 / factor - 0.5 - corner / factor
        return smaller
    maps = cv2.initUndistortRectifyMap(matrix, recording.distortion, None, scaled(factor / block),
                                       (block * size).tolist(), cv2.CV_32FC1)
    return Sampling(scaled(factor), maps, block)


LEAST_DEPTH = 0.1  # m: hardly a camera sees nearer


def metres_of(name, counts, unit):
    """Depth as recorded, uint16, times its unit -> float32 m; beyond what a shard can hold it becomes missing.

    Raises ValueError where half of it is not to be believed: the unit is wrong then, or the picture.
    """
    depth = counts.astype(np.float32) * np.float32(unit)
    middle = float(np.median(depth[counts > 0])) if counts.any() else 0.0
    if not LEAST_DEPTH <= middle <= MOST_DEPTH:
        raise ValueError(f"{name}: expected depths of {LEAST_DEPTH} to {MOST_DEPTH} m, got a median of {middle:.4g} m "
                         f"with a depth_unit of {unit:g} m")
    return np.where(depth <= MOST_DEPTH, depth, np.float32(0))


# --- the pose -----------------------------------------------------------------------------------------------------

LEAST_TABLE = 0.25  # of the empty picture's points, and they of its pixels


def rigid_pose(matrix):
    """A pose (4, 4) whose rotation is orthonormal to 1e-3, as after printing -> with the nearest true rotation.

    Raises ValueError for any other matrix.
    """
    rotation = matrix[:3, :3]
    if not (np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
            and np.array_equal(matrix[3], [0, 0, 0, 1])):
        raise ValueError("arena_from_camera: expected a rotation, orthonormal to 0.001, and a translation, above "
                         f"0 0 0 1, got {matrix.tolist()}")
    pose = matrix.copy()
    if not np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-9):
        pose[:3, :3] = Rotation.from_matrix(rotation).as_matrix()
    return pose


def fit_plane(points, rng, tries=500):
    """The plane in which most of the points (N, 3) m lie, within FLAT: RANSAC, then least squares.

    -> its normal (3,), a point of it (3,) m, and the share of the points that lie in it.
    """
    corners, some = points[rng.integers(len(points), size=(tries, 3))], rng.permutation(points)[:2000]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    away = np.abs(some @ normals.T - np.sum(normals * corners[:, 0], axis=1))
    best = np.where(normals.any(axis=1), (away < FLAT).sum(axis=0), 0).argmax()
    normal, middle = normals[best], corners[best, 0]
    for _ in range(50):  # until nothing changes: after 5 it still depends on the draws
        inside = np.abs((points - middle) @ normal) < FLAT
        middle = points[inside].mean(axis=0)
        normal = np.linalg.eigh(np.cov(points[inside].T))[1][:, 0]
    return normal, middle, inside.mean()


def table_pose(empty_depth, matrix, ray):
    """The camera's pose from what it sees of the empty table: arena_from_camera (4, 4), and which share of the points
    lies in the table.

    z is the table's normal, x the camera's right, the origin where the ray (3,), camera axes, meets the table.
    empty_depth (H, W) m; matrix (3, 3): its intrinsics. Raises ValueError where no table is found there.
    """
    seen = np.mean(empty_depth > 0)
    if seen < LEAST_TABLE:  # few points lie in a plane wherever they are
        raise ValueError(f"{EMPTY}.png: expected depth in {LEAST_TABLE:.0%} of it to find the table, got {seen:.0%}; "
                         "give arena_from_camera")
    camera = Camera(*empty_depth.shape[::-1], matrix[0, 0], matrix[1, 1], *matrix[:2, 2], np.eye(4))
    normal, middle, share = fit_plane(unproject(empty_depth.astype(float), camera)[empty_depth > 0],
                                      np.random.default_rng(0))
    normal = -np.sign(normal @ middle) * normal  # towards the camera
    if share < LEAST_TABLE or normal @ ray > -0.1 * np.linalg.norm(ray):
        raise ValueError(f"{EMPTY}.png: expected a table under the origin, got {share:.0%} of the points in a plane of "
                         f"normal {normal.round(2).tolist()}, camera axes; give arena_from_camera")
    right = np.array([1.0, 0, 0]) - normal[0] * normal
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(normal, right), normal
    pose[:3, 3] = -pose[:3, :3] @ ray * (normal @ middle) / (normal @ ray)
    return pose, share


def filled(empty_depth, camera):
    """The empty picture (H, W) m with the depth of the table in holes that the table surrounds; other holes stay.

    Background subtraction has to know what was there: in a hole nothing stands out.
    """
    pose = camera.arena_from_camera
    down = (unproject(np.ones(empty_depth.shape), camera) - pose[:3, 3])[..., 2]  # by every pixel's ray, per m of depth
    table = np.where(down < 0, -pose[2, 3] / np.minimum(down, -1e-9), np.inf)
    holes = cv2.connectedComponents((empty_depth == 0).astype(np.uint8))[1]  # their numbers, 0 elsewhere
    rims = np.where(empty_depth > 0, cv2.dilate(holes.astype(np.float32), np.ones((3, 3))), 0).astype(int).ravel()
    flat = (np.abs(empty_depth - table) < FLAT).ravel()
    share = np.bincount(rims, flat, holes.max() + 1) / np.maximum(np.bincount(rims, None, holes.max() + 1), 1)
    fill = (holes > 0) & (share[holes] > 0.9) & (table < MOST_DEPTH)
    return np.where(fill, table, empty_depth).astype(np.float32)


# --- the import ---------------------------------------------------------------------------------------------------

def camera_of(recording, sampling, empty_depth):
    """The Camera of the smaller pictures, with the pose as recorded or as the small empty picture (H, W) m shows it,
    and the share of that picture's points in the table, NaN where nobody looked.

    Raises ValueError as `table_pose`, `rigid_pose` and `check_camera` do.
    """
    pose, share, pixel = recording.arena_from_camera, np.nan, recording.origin
    if pose is None:
        pixel = np.array([recording.width - 1, recording.height - 1]) / 2 if pixel is None else pixel
        ray = cv2.undistortPoints(pixel.reshape(1, 1, 2), recording.camera_matrix, recording.distortion)
        pose, share = table_pose(empty_depth, sampling.matrix, np.append(ray, 1))
    (fx, _, cx), (_, fy, cy), _ = sampling.matrix
    camera = Camera(*empty_depth.shape[::-1], fx, fy, cx, cy, rigid_pose(pose))
    check_camera(camera)
    return camera, share


def import_recording(folder, out, size=(64, 48), progress=None):
    """Make a data set in `out` of the recording in `folder`, with pictures of `size` (W, H) px.

    -> a dict of what was found: pokes; camera; table, the share of the empty picture in it, if the pose is from there;
    missing, the share of pixels without depth; met, that of the pokes that end where something stands.
    progress(done, total) is called after every shard. Raises ValueError naming the file or the field that is wrong,
    also where nothing stands at any poke; then nothing new is left in `out`.
    """
    recording, written, missing, met = load_recording(folder), [], [], []
    if find_shards(out):
        raise ValueError(f"{out}: expected a folder without pokes, got {find_shards(out)[0].name} in it")
    names, sampling = recording.names, sampling_of(recording, size)

    def colour_of(name):
        return sampling.colour(recording.picture(name))

    def depth_of(name):
        path = recording.folder / f"{name}.png"
        depth = sampling.depth(metres_of(path, recording.picture(name), recording.depth_unit))
        if not depth.any():
            raise ValueError(f"{path}: expected depth in {SEEN:.0%} of some small pixel, got none")
        return depth
    empty_depth = depth_of(EMPTY)
    camera, share = camera_of(recording, sampling, empty_depth)
    empty_depth, meta = filled(empty_depth, camera), {"settings": recording.settings, "seed": recording.seed}
    try:
        for first in range(0, len(names), SHARD_POKES):
            rows = slice(first, first + SHARD_POKES)
            pictures = [np.stack([read(name + what) for name in names[rows]]) for read, what in (
                (colour_of, "_before"), (colour_of, "_after"), (depth_of, "_before_depth"), (depth_of, "_after_depth"))]
            part = Interactions(*pictures, recording.pokes[rows], recording.starts[rows], empty_depth, camera, meta)
            written.append(Path(out) / f"shard_{first // SHARD_POKES:04d}.npz")
            save_shard(written[-1], part)
            missing += [np.mean(depth == 0) for depth in pictures[2:]]
            for before, poke in zip(part.depth_before, part.pokes):
                scene = scene_of(before[None], part.rgb_before[:1], empty_depth, camera, recording.settings["arena"])
                met.append(bool(look(scene, poke[None])[1].any()))
            if progress:
                progress(len(met), len(names))
        if not any(met):
            raise ValueError(f"{folder}: expected pokes that end where something stands, got none; is "
                             "arena_from_camera this camera's, and are the pokes in arena coordinates?")
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise
    return {"pokes": len(met), "camera": camera, "table": share, "missing": float(np.mean(missing)),
            "met": float(np.mean(met))}
