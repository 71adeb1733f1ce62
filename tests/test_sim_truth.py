"""The simulator's truth: rotations, true scene flow, and the truth files beside the shards."""
import numpy as np
import pytest
import tiny
from scipy.spatial.transform import Rotation

from hind4sight_min.disk.files import load_npz, save_npz
from hind4sight_min.disk.shards import FORMAT, save_shard
from hind4sight_min.sim.truth import Truth, load_truth, save_truth, true_scene_flow, truth_path


def write(folder, index=0, count=3):
    """A shard and its truth in `folder` -> the truth."""
    rng, path = np.random.default_rng(index), folder / f"shard_{index:04d}.npz"
    poses = rng.normal(size=(2, count, 7, 7)).astype(np.float32)
    truth = Truth(rng.integers(0, 8, (count, 12, 16), np.uint8), *poses)
    save_truth(path, truth)
    save_shard(path, tiny.tiny_pokes(count, index))
    return truth


def test_true_scene_flow_against_scipy_point_by_point():
    rng = np.random.default_rng(1)
    points, labels = rng.uniform(-0.2, 0.2, (9, 11, 3)), rng.integers(0, 5, (9, 11), np.uint8)
    before, after = (np.concatenate([rng.uniform(-0.2, 0.2, (7, 3)), Rotation.random(7, rng).as_quat()], axis=1)
                     for _ in range(2))
    expected = np.zeros((9, 11, 3))
    for v, u in zip(*np.nonzero(labels)):
        i = labels[v, u] - 1
        motion = Rotation.from_quat(after[i, 3:]) * Rotation.from_quat(before[i, 3:]).inv()
        expected[v, u] = motion.apply(points[v, u] - before[i, :3]) + after[i, :3] - points[v, u]
    flow = true_scene_flow(points, labels, before, after)
    assert flow.dtype == np.float32
    np.testing.assert_allclose(flow, expected, atol=1e-6, err_msg="w first, not last? R_b, not its inverse?")
    assert (flow[labels == 0] == 0).all() and (np.abs(flow[labels > 0]).max(axis=-1) > 0.01).all()
    np.testing.assert_allclose(true_scene_flow(points, labels, before, before), 0, atol=1e-6)  # nothing moved


def test_truth_comes_back_as_it_was_in_the_order_of_the_shards(tmp_path):
    parts = {index: write(tmp_path, index, count) for index, count in ((11, 2), (1, 3), (0, 4))}
    joined = load_truth(tmp_path)
    for name in vars(joined):
        expected = np.concatenate([getattr(parts[index], name) for index in (0, 1, 11)])
        np.testing.assert_array_equal(getattr(joined, name), expected, strict=True)
        np.testing.assert_array_equal(getattr(joined[[5, 1]], name), expected[[5, 1]])


def change(path, name, count):
    """Keep the array's first `count` rows; of 0 rows, no array."""
    arrays = load_npz(path, FORMAT)[0]
    rows = arrays.pop(name)[:count]
    save_npz(path, {**arrays, name: rows} if count else arrays, {"format": FORMAT})


@pytest.mark.parametrize("damage, word", [
    (lambda path: path.unlink(), "no such file"),
    (lambda path: path.write_bytes(path.read_bytes()[:-40]), "damaged"),
    (lambda path: save_npz(path, {}, {"format": "other"}), "'other'"),
    (lambda path: change(path, "labels", 0), "labels: .*nothing"),
    (lambda path: change(path, "labels", 2), "labels: .*got .2, "),  # would shift every later shard's labels
    (lambda path: change(path, "poses_before", 2), "poses_before: .*got .2, "),
    (lambda path: change(path, "poses_after", 0), "poses_after: .*nothing")])
def test_truth_that_does_not_fit_its_shard_is_refused(tmp_path, damage, word):
    write(tmp_path)
    damage(truth_path(tmp_path / "shard_0000.npz"))
    with pytest.raises(ValueError, match=f"shard_0000.truth.npz: .*{word}"):
        load_truth(tmp_path)
