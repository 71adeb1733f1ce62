"""The record of one poke, shards of them on disk, and the paper's two noise models.

A data set is a folder of shards `shard_0000.npz`, each describing itself (camera, units, seed, simulator
settings, format version), and beside each a `shard_0000.truth.npz` with what the simulator knows but
the robot does not see. Training reads only the former; evaluation also reads the latter.
"""
import json
import os
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from .geometry import Camera, unproject

FORMAT = "hind4sight_min interactions 1"
DEPTH_UNIT = 1e-4  # m per count of the stored uint16 depth: 0.1 mm, up to 6.5 m


@dataclass
class Interactions:
    """M pokes as the robot sees them. Paper: Sec. IV-A.

    rgb_before, rgb_after: (M, H, W, 3) uint8. depth_before, depth_after: (M, H, W) float32 m, 0 = missing.
    pokes: (M, 3) float32, u = (a_x, a_y, a_theta): target on the arena plane in m, direction in rad.
    starts: (M, 2) float32 m, where the finger came down. empty_depth: (H, W) float32 m, the empty arena.
    camera: the camera of this image size. meta: settings, seed, counts (plain JSON types).
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
        settings = self.meta.get("settings")
        for name in ("arena", "cell"):
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
        picked = {name: getattr(self, name)[rows] for name in
                  ("rgb_before", "rgb_after", "depth_before", "depth_after", "pokes", "starts")}
        return Interactions(**picked, empty_depth=self.empty_depth, camera=self.camera, meta=self.meta)

    @property
    def grid_shape(self):
        """(rows, columns) of the arena's grid of cells; rows run along y, columns along x."""
        return grid_shape(self.meta["settings"])


@dataclass
class Truth:
    """What the simulator knows of M pokes. For evaluation (and the supervised baseline) only.

    labels: (M, H, W) uint8 before the poke, 0 = background, i + 1 = object i.
    poses_before, poses_after: (M, 7, 7) float32, arena, per object (x, y, z, qx, qy, qz, qw); unused rows 0.
    """
    labels: np.ndarray
    poses_before: np.ndarray
    poses_after: np.ndarray

    def __getitem__(self, rows):
        return Truth(self.labels[rows], self.poses_before[rows], self.poses_after[rows])


def points_and_validity(depth, camera):
    """Depth (..., H, W) m -> points (..., H, W, 3) m in the arena frame, and validity (..., H, W) bool."""
    return unproject(depth, camera), depth > 0


OCCUPIED = 0.008  # m: background subtraction takes what is nearer than the empty arena by more for an object


def occupied_pixels(depth, empty_depth, threshold=OCCUPIED):
    """Background subtraction: (..., H, W) bool, where something stands in the arena. Paper: Sec. IV-A.

    depth, empty_depth (..., H, W) m. A pixel counts when it is nearer than the empty arena by more than `threshold` m.
    """
    return (depth > 0) & (empty_depth > 0) & (empty_depth - depth > threshold)


def prominence(depth, empty_depth):
    """How far the highest of each pixel and its eight neighbours stands out: (..., H, W) m, 0 where there is no depth.

    depth, empty_depth (..., H, W) m. What stands out is nearer than the empty arena. Not in the paper: with the
    neighbours the rims of objects, and the table next to them, stand out as well.
    """
    rise = np.where((depth > 0) & (empty_depth > 0), empty_depth - depth, 0).astype(np.float32)
    around = np.ones((3, 3), np.uint8)
    return np.reshape([cv2.dilate(each, around) for each in rise.reshape(-1, *depth.shape[-2:])], depth.shape)


def standing(depth, empty_depth, camera, settings, threshold=OCCUPIED):
    """The picture's points (..., H, W, 3) m, arena, and which of them are of something that stands inside the walls,
    (..., H, W) bool: `occupied_pixels`, less the walls.
    """
    points = unproject(depth, camera)
    inside = np.abs(points[..., :2]).max(axis=-1) < settings["arena"] / 2
    return points, inside & occupied_pixels(depth, empty_depth, threshold)


def rotation_from_quaternion(quaternions):
    """Unit quaternions (..., 4), (x, y, z, w) as in Bullet -> rotation matrices (..., 3, 3)."""
    x, y, z, w = np.moveaxis(np.asarray(quaternions, float), -1, 0)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
            2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
            2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    return np.stack(rows, axis=-1).reshape(x.shape + (3, 3))


def true_scene_flow(points, labels, pose_before, pose_after):
    """Scene flow of one interaction from the objects' poses. Paper: Sec. IV-C.

    flow = R_a R_b^T (p - t_b) + t_a - p  for a point p on an object, 0 on the background.
    points (H, W, 3) m arena, labels (H, W), poses (7, 7) -> (H, W, 3) float32 m.
    """
    flow = np.zeros(points.shape, np.float32)
    before, after = (rotation_from_quaternion(pose[:, 3:]) for pose in (pose_before, pose_after))
    for index in np.unique(labels[labels > 0]) - 1:
        here = labels == index + 1
        local = (points[here] - pose_before[index, :3]) @ before[index]
        flow[here] = local @ after[index].T + pose_after[index, :3] - points[here]
    return flow


# --- the arena's grid ------------------------------------------------------------------------------

def grid_shape(settings):
    """(rows, columns) of the arena's grid of cells, from the simulator's settings."""
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


# --- the paper's two noises (Sec. IV-B) --------------------------------------------------------------

def add_depth_noise(depth, rng, standard_deviation=0.01):
    """Gaussian depth noise that grows with depth. Paper: Sec. IV-B, "SD of 1 cm, scaled by the depth".

    The SD is `standard_deviation` metres at each picture's median depth, and proportional to depth.
    depth (..., H, W) m -> the same shape and dtype; missing pixels (0) stay missing.
    """
    if not 0 <= standard_deviation < float("inf"):
        raise ValueError(f"standard_deviation: expected a number of metres >= 0, got {standard_deviation}")
    valid = depth > 0
    pictures = depth.reshape(-1, *depth.shape[-2:])
    median = np.array([np.median(each[each > 0]) if each.any() else 1.0 for each in pictures], depth.dtype)
    scale = standard_deviation / median.reshape(depth.shape[:-2] + (1, 1))
    noisy = depth * (1 + scale * rng.standard_normal(depth.shape))
    return np.where(valid, np.maximum(noisy, DEPTH_UNIT), 0).astype(depth.dtype)


SMOOTHING = 3, 3.0, 0.15, 0.02  # radius in px, and what counts as near: SDs in px, of colours in [0, 1], in m


def smooth_depth(depth, empty_depth, images):
    """Take noise out of depth pictures with the help of the colours: a joint bilateral filter. Not in the paper.

    In the difference to the empty arena the table is flat at 0 and objects are islands some cm high. There each pixel
    becomes a mean of those around it, weighted by how near they are: in the picture, in colour, and in a first guess of
    the difference, a bilateral filter of it alone. Of 1 cm of noise that leaves 2 mm on the table and 7 on objects.
    depth (..., H, W) m, 0 = missing, which stays and counts for nobody; empty_depth (..., H, W) m, complete;
    images (..., H, W, 3) uint8 -> the shape and dtype of depth.
    """
    radius, px, colour, metres = SMOOTHING
    height, width = depth.shape[-2:]
    seen = (depth > 0).astype(np.float32).reshape(-1, height, width)
    difference = seen * (depth - empty_depth).astype(np.float32).reshape(seen.shape)
    guess = np.stack([cv2.bilateralFilter(each, 5, 0.025, 1.5) for each in difference]) / np.float32(metres)
    red_green_blue = np.moveaxis(images.reshape(-1, height, width, 3), -1, 0) / np.float32(255 * colour)
    # With a rim, where nothing is seen, a shift is an offset in flat arrays: twice as fast.
    rim = (0, 0), (0, radius), (0, radius)
    seen, difference, *guides = (np.pad(each, rim).ravel() for each in (seen, difference, guess, *red_green_blue))
    total, weight = difference.copy(), seen.copy()
    for dv in range(radius + 1):
        for du in range(-radius if dv else 1, radius + 1):  # each pair of pixels once, for both
            offset = dv * (width + radius) + du
            here, there = slice(None, -offset), slice(offset, None)
            apart = np.float32((dv ** 2 + du ** 2) / px ** 2)  # squared, in standard deviations
            for guide in guides:
                apart = apart + np.square(guide[here] - guide[there])
            near = np.exp(-apart / 2)
            total[here] += near * difference[there]
            total[there] += near * difference[here]
            weight[here] += near * seen[there]
            weight[there] += near * seen[here]
    smooth = (total / np.maximum(weight, 1e-6)).reshape(-1, height + radius, width + radius)[:, :height, :width]
    return np.where(depth > 0, empty_depth + smooth.reshape(depth.shape), 0).astype(depth.dtype)


def associate_with_noise(depth, rng, window, threshold=0.10):
    """Spurious data association: each pixel is taken for another one near it. Paper: Sec. IV-B.

    Every pixel draws one pixel of the window x window square around it; the draw counts if it lies in the
    picture, has depth, and differs in depth by at most `threshold` metres; otherwise the pixel keeps itself.
    depth (H, W) m -> (H, W) int: the flat index each pixel is associated with.
    """
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window: expected an odd number of pixels >= 1, got {window}")
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    shift = rng.integers(-(window // 2), window // 2 + 1, size=(2, height, width))
    v_new, u_new = v + shift[0], u + shift[1]
    inside = (v_new >= 0) & (v_new < height) & (u_new >= 0) & (u_new < width)
    v_new, u_new = np.where(inside, v_new, v), np.where(inside, u_new, u)
    other = depth[v_new, u_new]
    good = (other > 0) & (depth > 0) & (np.abs(other - depth) <= threshold)
    return np.where(good, v_new * width + u_new, v * width + u)


# --- files -------------------------------------------------------------------------------------------

@contextmanager
def whole_file(path):
    """A temporary path that takes the place of `path` when the block ends well, and vanishes when it does not."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")  # the ending stays: libraries go by it
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path, text):
    """Write a text file, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text)


def write_json(path, figures):
    """Write plain JSON types, whole or not at all; nothing for no path."""
    if path:
        write_text(path, json.dumps(figures, indent=2, sort_keys=True) + "\n")


def save_npz(path, arrays, meta):
    """Write arrays and one JSON text to a compressed .npz, whole or not at all."""
    with whole_file(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, meta=np.array(json.dumps(meta, sort_keys=True)), **arrays)


def load_npz(path, format):
    """Read what `save_npz` wrote: (dict of arrays, meta). Raises ValueError naming the file if it is damaged."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        meta = dict(json.loads(str(arrays.pop("meta"))))
    except MemoryError:
        raise
    except Exception as error:  # damage can surface as almost anything: zlib, zipfile, struct, NumPy, JSON
        raise ValueError(f"{path}: damaged or not one of our files ({error or type(error).__name__})") from None
    if meta.get("format") != format:
        raise ValueError(f"{path}: expected format {format!r}, got {meta.get('format')!r}")
    return arrays, meta


def truth_path(shard):
    """The truth file that belongs to a shard."""
    return Path(shard).with_suffix("").with_suffix(".truth.npz")


def save_shard(path, interactions, truth):
    """Write one shard and its truth file (each whole or not at all; the truth first, so a shard has one)."""
    meta = {**interactions.meta, "format": FORMAT, "camera": asdict(interactions.camera),
            "units": {"depth": DEPTH_UNIT, "pokes": "m, m, rad", "starts": "m"}}
    meta["camera"]["arena_from_camera"] = interactions.camera.arena_from_camera.tolist()

    def counts(depth):
        return np.clip(np.round(depth / DEPTH_UNIT), 0, 65535).astype(np.uint16)

    save_npz(truth_path(path), {"labels": truth.labels, "poses_before": truth.poses_before,
                                "poses_after": truth.poses_after}, {"format": FORMAT})
    save_npz(path, {"rgb_before": interactions.rgb_before, "rgb_after": interactions.rgb_after,
                    "depth_before": counts(interactions.depth_before), "depth_after": counts(interactions.depth_after),
                    "pokes": interactions.pokes, "starts": interactions.starts,
                    "empty_depth": counts(interactions.empty_depth)}, meta)


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
    parts = [load_shard(path) for path in shards_in(folder)]
    first = parts[0]
    for path, part in zip(shards_in(folder), parts):
        same = all(part.meta["settings"][name] == first.meta["settings"][name] for name in ("arena", "cell"))
        if (part.meta["camera"] != first.meta["camera"] or not same
                or not np.array_equal(part.empty_depth, first.empty_depth)):
            raise ValueError(f"{path}: another camera, arena or grid than the folder's first shard")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in
              ("rgb_before", "rgb_after", "depth_before", "depth_after", "pokes", "starts")}
    return Interactions(**joined, empty_depth=parts[0].empty_depth, camera=parts[0].camera, meta=parts[0].meta)


def load_truth(folder):
    """The truth of all shards of a folder, joined -> Truth, in the order of `load_interactions`."""
    parts = []
    for shard in shards_in(folder):
        path, pictures = truth_path(shard), load_shard(shard).depth_before.shape
        part, _ = load_npz(path, FORMAT)
        poses = (pictures[0], 7, 7)
        for name, shape in (("labels", pictures), ("poses_before", poses), ("poses_after", poses)):
            found = part[name].shape if name in part else "nothing"
            if found != shape:
                raise ValueError(f"{path}: {name}: expected shape {shape}, got {found}")
        parts.append(part)
    return Truth(*(np.concatenate([part[name] for part in parts])
                   for name in ("labels", "poses_before", "poses_after")))
