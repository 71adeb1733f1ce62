"""Photographs show what the model sees, in more pixels: of the arena as it is, and of recorded pokes again."""
import cv2
import numpy as np
import pytest

from hind4sight_min.sim import photographs as module
from hind4sight_min.sim.arena import Arena, Settings
from hind4sight_min.sim.collection import collect_shard

SMALL, TIMES = Settings(width=32, height=24), 4


def apart(photograph, picture):
    """How far a photograph, made as small as a picture, is from it, on average, of 255."""
    small = cv2.resize(photograph, picture.shape[1::-1], interpolation=cv2.INTER_AREA)
    return np.abs(small - picture.astype(float)).mean()


@pytest.fixture(scope="module")
def recorded():
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    return collect_shard(SMALL, 3, 0, 8)


def test_a_photograph_is_of_what_the_camera_sees_and_changes_nothing():
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    with Arena(SMALL, np.random.default_rng(0)) as arena:
        arena.new_scene()
        before, poses = arena.observe()[0], arena.poses()
        there = poses.copy()
        there[0, :2] += 0.04  # m
        photograph = arena.photograph(width=TIMES * 32)
        assert photograph.shape == (TIMES * 24, TIMES * 32, 3)
        for shift in (-2, 2):  # half a pixel of the model's
            assert apart(photograph, before) < 0.6 * apart(np.roll(photograph, shift, axis=1), before), "beside it"
        moved = arena.photograph(there, TIMES * 32)
        assert np.array_equal(arena.poses(), poses) and np.array_equal(arena.observe()[0], before), "not put back"
        arena.move_to(there)
        assert apart(moved, arena.observe()[0]) < 0.6 * apart(moved, before)


def test_recorded_pokes_are_photographed_again(recorded):
    interactions, truth = recorded
    motion = np.linalg.norm((truth.poses_after - truth.poses_before)[..., :3], axis=2).max(axis=1)
    row = int(motion.argmax())
    found = module.photographs(interactions, truth, [0, row], TIMES * 32)
    assert sorted(found) == sorted({0, row})
    for photograph, picture, other in zip(found[row], (interactions.rgb_before[row], interactions.rgb_after[row]),
                                          (interactions.rgb_after[row], interactions.rgb_before[row])):
        assert apart(photograph, picture) < min(1.5, 0.7 * apart(photograph, other)), "before taken for after?"


@pytest.mark.parametrize("meta", [{"settings": {"arena": 0.5, "cell": 0.025}, "seed": 3},
                                  {"settings": {"arena": 0.5, "cell": 0.025, "lens": 1}, "seed": 3, "shard": 0}])
def test_pokes_of_elsewhere_have_none(recorded, meta):
    interactions, truth = recorded
    assert module.photographs(interactions, None, [0]) == {}, "nobody knows where the objects were"
    interactions = interactions[:]
    interactions.meta = meta
    assert module.photographs(interactions, truth, [0]) == {}


def test_kept_photographs_are_found_by_the_picture_they_belong_to(recorded, tmp_path, monkeypatch):
    interactions, truth = recorded
    found = module.photographs(interactions, truth, [2], TIMES * 32)
    module.keep(tmp_path / "kept.npz", interactions, found)
    monkeypatch.setattr(module, "shipped", lambda _: tmp_path / "kept.npz")
    kept = module.photographs(interactions, None, range(8))
    assert 2 in kept and 7 not in kept
    for picture, again in zip(found[2], kept[2]):
        assert np.abs(picture - again.astype(float)).mean() < 4, "blue and red swapped?"
