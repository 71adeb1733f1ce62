"""What the simulator knows of its pokes and the robot does not see. sim/collection.py writes it, lab/ reads it, to
measure, to set goals and to supervise SE3-Nets; nothing in the core, which trains and plans, can (tests/test_house.py).
"""
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from .. import as_arrays
from ..disk.files import load_npz, save_npz
from ..disk.shards import FORMAT, check_same_data, load_shard, shards_in, stamp


@dataclass
class Truth:
    """What the simulator knows of M pokes. For evaluation (and the supervised baseline) only.

    labels: (M, H, W) uint8 before the poke, 0 = background, i + 1 = object i.
    poses_before, poses_after: (M, 7, 7) float32, arena, per object (x, y, z, qx, qy, qz, qw); unused rows 0.
    Raises ValueError for other shapes, labels beyond 7, and poses that are none.
    """
    labels: np.ndarray
    poses_before: np.ndarray
    poses_after: np.ndarray

    def __post_init__(self):
        self.labels, = as_arrays("MHW", labels=self.labels)
        if not (0 <= self.labels.min(initial=0) and self.labels.max(initial=0) <= 7):
            raise ValueError(f"labels: expected 0 to 7, got {self.labels.min()} to {self.labels.max()}")
        used = np.arange(7) < self.labels.max(axis=(1, 2), initial=0)[:, None]
        for name in ("poses_before", "poses_after"):
            poses, = as_arrays("*", **{name: getattr(self, name)})
            setattr(self, name, poses)
            if poses.shape != (len(self.labels), 7, 7):
                raise ValueError(f"{name}: expected shape {(len(self.labels), 7, 7)}, got {poses.shape}")
            if not np.isfinite(poses).all():
                raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
            if not (np.linalg.norm(poses[used][:, 3:], axis=1) > 0).all():
                raise ValueError(f"{name}: expected a quaternion for every object, got one that is 0")

    def __getitem__(self, rows):
        return Truth(self.labels[rows], self.poses_before[rows], self.poses_after[rows])


def true_scene_flow(points, labels, pose_before, pose_after):
    """Scene flow of one interaction from the objects' poses. Paper: Sec. IV-C.

    flow = R_a R_b^T (p - t_b) + t_a - p  for a point p on an object, 0 on the background.
    points (H, W, 3) m arena, labels (H, W), poses (7, 7) -> (H, W, 3) float32 m.
    """
    flow = np.zeros(points.shape, np.float32)
    for label in np.unique(labels[labels > 0]):
        here, before, after = labels == label, pose_before[label - 1], pose_after[label - 1]
        local = Rotation.from_quat(before[3:]).inv().apply(points[here] - before[:3])
        flow[here] = Rotation.from_quat(after[3:]).apply(local) + after[:3] - points[here]
    return flow


# --- files ---------------------------------------------------------------------------------------------------

def truth_path(shard):
    """The truth file that belongs to a shard."""
    return Path(shard).with_suffix("").with_suffix(".truth.npz")


def save_truth(shard, truth, interactions=None):
    """Write the truth file of a shard, whole or not at all; with its pokes it says to which ones it belongs."""
    save_npz(truth_path(shard), dict(vars(truth)),
             {"format": FORMAT, "of": None if interactions is None else stamp(interactions)})


def load_truth(folder):
    """The truth of all shards of a folder, joined -> Truth, in the order of `load_interactions`.

    Raises ValueError naming the file that is not its shard's or not what a Truth holds.
    """
    parts = []
    for shard in shards_in(folder):
        path, interactions = truth_path(shard), load_shard(shard)
        pictures, (part, meta) = interactions.depth_before.shape, load_npz(path, FORMAT)
        check_same_data(path, meta.get("of"), stamp(interactions))
        poses = (pictures[0], 7, 7)
        for name, shape in (("labels", pictures), ("poses_before", poses), ("poses_after", poses)):
            found = part[name].shape if name in part else "nothing"
            if found != shape:
                raise ValueError(f"{path}: {name}: expected shape {shape}, got {found}")
        try:
            parts.append(Truth(**{name: part[name] for name in ("labels", "poses_before", "poses_after")}))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    return Truth(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def find_truth(folder):
    """The truth of a folder's shards, None where none of them has any: of a robot's pokes nobody knows it."""
    return load_truth(folder) if any(truth_path(shard).exists() for shard in shards_in(folder)) else None
