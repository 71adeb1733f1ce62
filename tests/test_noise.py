"""The paper's two noises, Sec. IV-B, whose they are, and the smoothing of noisy depth."""
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.stats import chisquare
from tiny import TINY, camera, random_run, tiny_pokes

from hind4sight_min import training
from hind4sight_min.lab import noise
from hind4sight_min.lab.noise import add_depth_noise, associate_with_noise, smooth_depth, with_depth_noise


# --- depth noise ------------------------------------------------------------------------------------------

def two_levels():
    """Depth with its median at 0.5 m, a quarter of the valid pixels at 1 m, and more than half of them missing."""
    depth = np.full((200, 200), 0.5, np.float32)
    depth[:50], depth[190:], depth[:, ::2] = 1.0, 0, 0
    return depth


def test_depth_noise_grows_with_depth():
    depth = two_levels()
    found = add_depth_noise(depth, np.random.default_rng(0)).astype(float) - depth
    for level, expected in ((0.5, 0.01), (1.0, 0.02)):  # 1 cm at the median, proportional to depth
        here = found[depth == level]
        assert here.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * here.size)), \
            f"SD at {level} m: not scaled by depth over its median, or the median counts missing pixels?"
        assert abs(here.mean()) < 4 * expected / np.sqrt(here.size)
        assert np.mean(np.abs(here) > 1.96 * expected) == pytest.approx(0.05, abs=0.01), "not Gaussian"
    relative = found[:190, 1::2] / depth[:190, 1::2]  # what is not missing
    assert abs(np.corrcoef(relative[:, 1:].ravel(), relative[:, :-1].ravel())[0, 1]) < 0.03, "neighbours share noise"
    near, far = np.full((60, 60), 0.5), np.full((60, 60), 1.0)
    found = add_depth_noise(np.stack([near, far, far]), np.random.default_rng(0)) - np.stack([near, far, far])
    np.testing.assert_allclose(found.std(axis=(1, 2)), 0.01, rtol=0.06, err_msg="each picture has its own median")


def test_depth_noise_keeps_missing_pixels_dtype_and_input_and_repeats():
    depth = two_levels()
    before = depth.copy()
    for deviation in (0.01, 2.0):  # never a negative depth, never a new missing pixel
        noisy, again = (add_depth_noise(depth, np.random.default_rng(0), deviation) for _ in range(2))
        assert noisy.dtype == np.float32
        np.testing.assert_array_equal(noisy > 0, depth > 0)
        np.testing.assert_array_equal(again, noisy)
    np.testing.assert_array_equal(depth, before)
    np.testing.assert_array_equal(add_depth_noise(0 * depth, np.random.default_rng(0)), 0 * depth)


@pytest.mark.parametrize("function, bad, named", [
    *[(lambda bad: add_depth_noise(two_levels(), np.random.default_rng(0), bad), bad, "standard_deviation")
      for bad in (-0.01, float("nan"), np.inf)],
    *[(lambda bad: associate_with_noise(np.ones((4, 5)), np.random.default_rng(0), bad), bad, f"window.*{bad}")
      for bad in (0, 2, -3)]])
def test_refusals(function, bad, named):
    with pytest.raises(ValueError, match=named):
        function(bad)


# --- whose noise it is ---------------------------------------------------------------------------------------

@pytest.fixture
def same_pictures(monkeypatch):
    """Twelve pokes with one and the same depth picture, before and after; and no smoothing, so that noise is seen."""
    monkeypatch.setattr(noise, "smooth_depth", lambda depth, *_: depth)
    data = tiny_pokes(12)
    same = np.repeat(data.depth_before[:1], 12, axis=0)
    return replace(data, depth_before=same, depth_after=same.copy())


def assert_noise_of_its_own(pictures, clean, whose):
    found = np.reshape(pictures, (len(pictures), -1)) - clean.ravel()
    assert found.std(axis=1) == pytest.approx(0.01, rel=0.25), f"{whose}: SD"
    shared = np.abs(np.corrcoef(found) - np.eye(len(found))).max()
    assert shared < 0.4, f"{whose} share their noise: correlation {shared:.2f}"


def test_every_picture_of_a_batch_has_noise_of_its_own(same_pictures):
    seen = with_depth_noise(same_pictures, 0.01, np.random.default_rng(0))
    assert_noise_of_its_own([*seen.depth_before, *seen.depth_after], same_pictures.depth_before[0],
                            "before, after and the pokes of a batch")
    for name in ("rgb_before", "rgb_after", "pokes", "empty_depth"):
        assert getattr(seen, name) is getattr(same_pictures, name), f"{name}: only depth is noisy"


def test_every_step_and_every_chunk_has_noise_of_its_own(same_pictures):
    seen = []

    def watched(params, recipe, interactions, rng):
        seen.extend(interactions.depth_before)
        return training.unsupervised(params, recipe, interactions, rng)
    objective = partial(noise.under_noise, standard_deviation=0.01, objective=watched)
    training.train(same_pictures, random_run(replace(TINY, batch=10, steps=3)), objective)
    assert len(seen) == 30
    assert_noise_of_its_own(seen, same_pictures.depth_before[0], "steps, or chunks of a step,")


def test_noisy_depth_is_smoothed_in_both_frames():
    data = tiny_pokes()
    seen = with_depth_noise(data, 0.01, np.random.default_rng(3))
    rng = np.random.default_rng(3)
    for name in ("before", "after"):
        noisy = add_depth_noise(getattr(data, f"depth_{name}"), rng, 0.01)
        expected = smooth_depth(noisy, data.empty_depth, getattr(data, f"rgb_{name}"), data.camera)
        np.testing.assert_array_equal(getattr(seen, f"depth_{name}"), expected)
        assert np.abs(expected - noisy).max() > 0.005


# --- association noise ------------------------------------------------------------------------------------

@pytest.mark.parametrize("window", [3, 5, 9])
def test_association_is_uniform_over_the_window(window):
    depth = np.full((60, 70), 0.7, np.float32)
    found = associate_with_noise(depth, np.random.default_rng(2), window)
    v, u = np.mgrid[:60, :70]
    half = window // 2
    down, right = (shift[half:-half, half:-half] for shift in (found // 70 - v, found % 70 - u))
    assert np.abs(down).max() == np.abs(right).max() == half, "a window of n pixels reaches (n - 1) / 2 to each side"
    counts = np.bincount(((down + half) * window + right + half).ravel(), minlength=window ** 2)
    assert chisquare(counts).pvalue > 1e-3


def test_association_crosses_no_edge_of_the_depth_and_no_missing_pixel():
    depth = np.full((40, 40), 0.5)
    depth[:, 10:20], depth[:, 20:30], depth[:, 30:] = 0.5625, 0.6875, 0.5  # steps of 6.25, 12.5 and 18.75 cm
    for threshold, step in ((0.10, 0.0625), (0.125, 0.125)):  # at most: exactly the threshold still counts
        chosen = depth.ravel()[associate_with_noise(depth, np.random.default_rng(1), 7, threshold)]
        assert np.abs(chosen - depth).max() == step
    rng = np.random.default_rng(3)
    depth = rng.uniform(0.02, 0.06, (40, 50))  # so near that missing (0) passes the depth gate
    depth[rng.random(depth.shape) < 0.3] = 0
    found, own, missing = associate_with_noise(depth, rng, 5), np.arange(depth.size).reshape(40, 50), depth == 0
    np.testing.assert_array_equal(found[missing], own[missing])
    assert (depth.ravel()[found[~missing]] > 0).all() and (found != own)[~missing].mean() > 0.5


# --- smoothing --------------------------------------------------------------------------------------------

def test_smooth_depth_against_the_sum_by_hand():
    rng, cam = np.random.default_rng(2), camera(16, 12, 80.0)
    px = 0.027 / cam.pixel_size
    assert round(px) == 3 and round(px * 2 / 3) == 2
    empty = np.float32(0.8) + np.linspace(0, 0.2, 12 * 16, dtype=np.float32).reshape(12, 16)
    depth = empty - 0.04 * (rng.random((2, 12, 16)) < 0.3) + rng.normal(0, 0.01, (2, 12, 16))
    depth[0, 4, 6] = 0  # missing
    images = rng.integers(0, 90, (2, 12, 16, 3)).astype(np.uint8)
    difference = np.where(depth > 0, depth - empty, 0)
    guess = np.empty_like(difference)  # a bilateral filter; its neighbourhood is a disc, the picture goes on mirrored
    for i, row, column in np.ndindex(2, 12, 16):
        patch, (dv, du) = np.pad(difference[i], 2, mode="reflect")[row:row + 5, column:column + 5], np.mgrid[-2:3, -2:3]
        weights = np.exp(-(dv ** 2 + du ** 2) / (2 * (px / 2) ** 2)
                         - (patch - difference[i, row, column]) ** 2 / (2 * 0.025 ** 2)) * (dv ** 2 + du ** 2 <= 4)
        guess[i, row, column] = (weights * patch).sum() / weights.sum()
    found = smooth_depth(depth, empty, images, cam)
    assert found.dtype == depth.dtype and found[0, 4, 6] == 0
    for i, row, column in ((0, 4, 5), (1, 7, 9), (1, 11, 0), (0, 0, 14)):
        dv, du = np.mgrid[:12, :16] - np.array([row, column])[:, None, None]
        colour = ((images[i] / 255.0 - images[i, row, column] / 255.0) ** 2).sum(axis=2)
        weights = np.exp(-(dv ** 2 + du ** 2) / (2 * px ** 2) - colour / (2 * 0.15 ** 2)
                         - (guess[i] - guess[i, row, column]) ** 2 / (2 * 0.02 ** 2))
        weights *= (np.maximum(abs(dv), abs(du)) <= 3) & (depth[i] > 0)
        expected = empty[row, column] + (weights * difference[i]).sum() / weights.sum()
        assert abs(found[i, row, column] - expected) < 2e-5 < 1e-3 < abs(found[i, row, column] - depth[i, row, column])


def test_smoothing_is_the_same_in_metres_whatever_the_size_of_the_picture():
    left = []
    for scale in (1, 2):  # waves 8 cm long and 2 mm high on the table
        cam = camera(64 * scale, 48 * scale, 80.0 * scale)
        waves = 0.002 * np.sin(2 * np.pi * np.arange(cam.width) * cam.pixel_size / 0.08)
        empty, images = np.full((cam.height, cam.width), 0.8), np.full((1, cam.height, cam.width, 3), 140, np.uint8)
        smooth = smooth_depth((empty + waves)[None], empty, images, cam)[0] - empty
        middle = np.s_[cam.height // 2, cam.width // 4:-cam.width // 4]
        left.append(smooth[middle] @ np.broadcast_to(waves, smooth.shape)[middle] / np.sum(waves[middle[1]] ** 2))
    # The reach is a whole number of pixels; a filter of as many pixels at both sizes leaves 0.31 and 0.78.
    assert 0.1 < left[0] < 0.6 and left[1] == pytest.approx(left[0], rel=0.25), f"left of the waves: {left}"
