"""Collection: which pokes are kept, what a shard promises, folders that grow shard by shard."""
import shutil
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hind4sight_min.geometry import unproject
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.sim import collection
from hind4sight_min.sim.arena import Arena, Settings
from hind4sight_min.sim.collection import collect, collect_shard
from hind4sight_min.sim.objects import HELD_OUT
from hind4sight_min.sim.truth import load_truth, true_scene_flow

pytest.importorskip("pybullet", reason="pybullet is not installed")
SMALL = Settings(width=32, height=24)  # the fastest pictures in which objects can still be seen


@pytest.mark.parametrize("expected, second, labels_before, labels, at_rest", [
    ("kept", (-0.24, 0.24, 0.0), (0, 1, 2), (2, 0, 1), True), ("left_arena", (0.26, 0, 0), (0, 1, 2), (0, 1, 2), True),
    ("left_arena", (0, -0.26, 0), (0, 1, 2), (0, 1, 1), False), ("left_arena", (0, 0, -0.01), (1, 2), (1, 2), True),
    ("not_at_rest", (0, 0, 0), (0, 1, 2), (0, 1, 2), False),
    ("out_of_view", (0, 0, 0), (0, 1, 2), (0, 1, 1), True), ("out_of_view", (0, 0, 0), (0, 0, 2), (0, 1, 2), True)])
def test_reasons_to_drop_a_poke(expected, second, labels_before, labels, at_rest):
    poses = np.zeros((7, 7), np.float32)
    poses[1, :3] = second
    before, after = ((None, None, np.array([each]), poses) for each in (labels_before, labels))
    assert collection._outcome(before, after, 2, at_rest, Settings()) == expected


def test_dropped_pokes_are_counted_and_not_kept(monkeypatch):
    ends, real = iter([(0.4, 0, 0.03), None, (0, 0, 1.5), (0, 0, 7.0), None, None]), Arena.poke

    def poke(self, *drawn):
        rest, end = real(self, *drawn), next(ends)
        if end:  # put an object there: beyond the walls, out of sight, or where it falls for long
            self.bullet.resetBasePositionAndOrientation(self.bodies[0], end, [0, 0, 0, 1])
        return self.settle() if end == (0, 0, 7.0) else rest
    monkeypatch.setattr(Arena, "poke", poke)
    interactions, truth = collect_shard(SMALL, 0, 0, 3)
    assert interactions.meta["counts"] == {"kept": 3, "left_arena": 1, "out_of_view": 1, "not_at_rest": 1,
                                           "no_free_start": 0}
    assert len(interactions) == len(truth.labels) == 3
    # After a dropped poke comes a new scene, so the first poke kept is followed by other objects.
    assert np.abs(truth.poses_before[1] - truth.poses_after[0]).max() > 0.01
    np.testing.assert_array_equal(truth.poses_before[2], truth.poses_after[1])


@pytest.fixture(scope="module")
def shard():
    """Twelve pokes in two scenes, in pictures sharp enough to measure in."""
    return collect_shard(Settings(width=128, height=96), 5, 0, 12)


@pytest.mark.parametrize("changed", [{}, dict(width=96, height=72), dict(HELD_OUT, width=32, height=24)], ids=str)
def test_a_shard_keeps_its_promises(changed):
    settings = Settings(**changed)
    interactions, truth = collect_shard(settings, 0, 0, 5)
    assert interactions.settings == settings.plain
    assert interactions.meta["counts"]["kept"] == len(interactions) == len(truth.labels) == 5
    assert interactions.depth_before.shape == truth.labels.shape == (5, settings.height, settings.width)
    travel = interactions.pokes[:, :2] - interactions.starts
    length = np.linalg.norm(travel, axis=1)
    assert length.min() > settings.poke_length[0] - 1e-6 and length.max() < settings.poke_length[1] + 1e-6
    np.testing.assert_allclose(np.arctan2(travel[:, 1], travel[:, 0]), interactions.pokes[:, 2], atol=1e-5)
    moved = np.linalg.norm(truth.poses_after - truth.poses_before, axis=-1).max(axis=1)
    assert (moved > 0.005).mean() > 0.5, "most pokes miss"
    still = (truth.labels == 0) & (np.abs(interactions.depth_before - interactions.empty_depth) < 1e-5)
    assert still.sum() == (truth.labels == 0).sum(), "the finger is in the picture"
    assert np.mean(np.abs(interactions.depth_after - interactions.depth_before)[still] < 1e-5) > 0.95


def test_true_flow_carries_the_objects_onto_the_cloud_after_the_poke(shard):
    interactions, truth = shard
    with_flow, without = [], []
    clouds = (unproject(depth, interactions.camera) for depth in (interactions.depth_before, interactions.depth_after))
    for i, (points, after) in enumerate(zip(*clouds)):
        flow = true_scene_flow(points, truth.labels[i], truth.poses_before[i], truth.poses_after[i])
        moving, tree = np.linalg.norm(flow, axis=-1) > 0.01, cKDTree(after.reshape(-1, 3))
        with_flow += tree.query((points + flow)[moving])[0].tolist()
        without += tree.query(points[moving])[0].tolist()
    assert len(with_flow) > 500
    assert np.median(with_flow) < 0.004 and np.quantile(with_flow, 0.9) < 0.008  # pixels lie 5 mm apart
    assert np.median(without) > 2 * np.median(with_flow)


def test_pokes_of_a_scene_follow_each_other_and_scenes_last_as_long_as_the_settings_say(shard):
    interactions, truth = shard
    assert sum(interactions.meta["counts"].values()) == 12, "a dropped poke would shift the scenes: take another seed"
    for i in range(1, 12):
        follows = np.array_equal(truth.poses_before[i], truth.poses_after[i - 1])
        assert follows == (i % 6 != 0)
        assert np.array_equal(interactions.depth_before[i], interactions.depth_after[i - 1]) == follows


@pytest.fixture(scope="module", autouse=True)
def short_shards():
    """Shards of 5 pokes. Worker processes are told their shard's size, so this reaches them too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collection, "SHARD_POKES", 5)
        yield


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """Twelve pokes in three shards: (folder, what `collect` returned, what it reported on the way)."""
    folder, reports = tmp_path_factory.mktemp("collected") / "train", []
    result = collect(folder, 12, 3, SMALL, progress=lambda *report: reports.append(report))
    return folder, result, reports


@pytest.fixture
def copied(collected, tmp_path):
    """A copy of that folder to spoil."""
    return shutil.copytree(collected[0], tmp_path / "copy")


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_collect_writes_shards_and_reports(collected):
    folder, result, reports = collected
    assert sorted(contents(folder)) == ["collection.json", *(f"shard_000{i}{end}" for i in range(3)
                                                             for end in (".npz", ".truth.npz"))]
    assert len(load_interactions(folder)) == len(load_truth(folder).labels) == 12
    assert reports == [(5, 12), (10, 12), (12, 12)]
    assert result["kept"] == 12 and len(result) == 5
    pokes = load_interactions(folder).pokes
    np.testing.assert_array_equal(pokes[5:10], collect_shard(SMALL, 3, 1, 5)[0].pokes)
    assert not (pokes[:5] == pokes[5:10]).all(), "all shards are the same"


def test_the_number_of_processes_does_not_change_a_byte_and_the_seed_does(collected, tmp_path):
    reports = []
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:  # as any executor
        result = collect(tmp_path / "two", 12, 3, SMALL, pool.map, lambda *report: reports.append(report))
    assert contents(tmp_path / "two") == contents(collected[0])
    assert result == collected[1] and reports == collected[2]
    collect(tmp_path / "other", 5, 4, SMALL)
    assert contents(tmp_path / "other")["shard_0000.npz"] != contents(collected[0])["shard_0000.npz"]


def test_parts_are_collected_at_once_and_what_is_missing_afterwards(collected, tmp_path):
    reports = []
    with ThreadPoolExecutor(3) as pool:  # each as a process of an array would
        found = pool.map(lambda i: collect(tmp_path / "parts", 12, 3, SMALL, part=(i, 4)), (1, 2, 4))
    assert [counts["kept"] for counts in found] == [5, 5, 0], "there are three shards"
    left = collect(tmp_path / "parts", 12, 3, SMALL, part=(1, 2), progress=lambda *report: reports.append(report))
    assert left["kept"] == 7 and reports == [(7, 7)] and contents(tmp_path / "parts") == contents(collected[0])


@pytest.mark.parametrize("lost", [[], ["shard_0001.npz", "shard_0001.truth.npz"], ["shard_0002.npz"],
                                  ["shard_0001.truth.npz"]], ids=str)
def test_collecting_again_makes_only_what_is_missing(collected, copied, monkeypatch, lost):
    for name in lost:
        (copied / name).unlink()
    made, reports, real = [], [], collection.collect_shard
    monkeypatch.setattr(collection, "collect_shard", lambda *job: made.append(job[2]) or real(*job))
    result = collect(copied, 12, 3, SMALL, progress=lambda *report: reports.append(report))
    assert contents(copied) == contents(collected[0]) and result == collected[1]
    assert made == [int(name[9]) for name in lost[:1]] and reports == [(12, 12)] * len(made)


@pytest.mark.parametrize("lost, changed", [
    ("none", dict(seed=4)), ("none", dict(settings=Settings())), ("none", dict(pokes=11)), ("none", dict(pokes=5)),
    ("0000", dict(pokes=10)), ("0001", dict(pokes=5)), ("truth", dict(seed=4))], ids=str)  # training needs no truth
def test_a_folder_with_other_data_is_refused_and_left_alone(copied, lost, changed):
    for path in copied.glob(f"*{lost}*"):
        path.unlink()
    before = contents(copied)
    with pytest.raises(ValueError, match="copy.shard_.*: holds data of another seed, other settings or another number"):
        collect(copied, **{**dict(pokes=12, seed=3, settings=SMALL), **changed})
    assert contents(copied) == before
