"""The paper's two noises, Sec. IV-B, whose they are, and the smoothing of noisy depth."""
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chisquare
from tiny import camera, tiny_pokes

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

def test_every_picture_has_noise_of_its_own_before_and_after_in_a_batch_and_at_every_step(monkeypatch):
    monkeypatch.setattr(noise, "smooth_depth", lambda depth, *_: depth)  # so that the noise is seen
    data, seen, rng = tiny_pokes(), [], np.random.default_rng(0)
    same = np.repeat(data.depth_before[:1], 7, axis=0)
    data = replace(data, depth_before=same, depth_after=same.copy())
    for _ in range(2):  # steps
        noise.under_noise(None, None, data, rng, 0.01, lambda params, recipe, noisy, rng: seen.append(noisy))
    pictures = np.stack([(noisy.depth_before, noisy.depth_after) for noisy in seen])
    found = (pictures - same[0]).reshape(28, -1)
    assert found.std(axis=1) == pytest.approx(0.01, rel=0.25)
    shared = np.abs(np.corrcoef(found) - np.eye(28)).max()
    assert shared < 0.4, f"pictures share their noise: correlation {shared:.2f}"
    for name in ("rgb_before", "rgb_after", "pokes", "empty_depth"):
        assert getattr(seen[0], name) is getattr(data, name), f"{name}: only depth is noisy"


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

@pytest.mark.parametrize("focal, reach, first", [(80.0, 3, 2), (50.0, 2, 1)])  # px: the same in metres
def test_smooth_depth_against_the_sum_by_hand(focal, reach, first):
    rng, cam = np.random.default_rng(2), camera(16, 12, focal)
    px = 0.027 / cam.pixel_size
    assert round(px) == reach and round(px * 2 / 3) == first
    empty = np.float32(0.8) + np.linspace(0, 0.2, 12 * 16, dtype=np.float32).reshape(12, 16)
    depth = empty - 0.04 * (rng.random((2, 12, 16)) < 0.3) + rng.normal(0, 0.01, (2, 12, 16))
    depth[0, 4, 6] = 0  # missing
    images = rng.integers(0, 90, (2, 12, 16, 3)).astype(np.uint8)
    difference = np.where(depth > 0, depth - empty, 0)

    def mean(i, row, column, guess=None):
        """The weighted mean of what is seen around a pixel."""
        dv, du = np.mgrid[:12, :16] - np.array([row, column])[:, None, None]
        apart = ((images[i] / 255.0 - images[i, row, column] / 255.0) ** 2).sum(axis=2) / 0.15 ** 2
        apart += (dv ** 2 + du ** 2) / px ** 2
        if guess is not None:
            apart += (guess[i] - guess[i, row, column]) ** 2 / 0.02 ** 2
        weights = np.exp(-apart / 2) * (np.maximum(abs(dv), abs(du)) <= reach) * (depth[i] > 0)
        return (weights * difference[i]).sum() / weights.sum()
    filled = difference.copy()
    filled[0, 4, 6] = mean(0, 4, 6)
    guess = np.empty_like(difference)  # a bilateral filter; its neighbourhood is a disc, the picture goes on mirrored
    for i, row, column in np.ndindex(2, 12, 16):
        dv, du = np.mgrid[-first:first + 1, -first:first + 1]
        patch = np.pad(filled[i], first, mode="reflect")[row:, column:][:2 * first + 1, :2 * first + 1]
        weights = np.exp(-(dv ** 2 + du ** 2) / (2 * (px / 2) ** 2)
                         - (patch - filled[i, row, column]) ** 2 / (2 * 0.025 ** 2))
        weights *= dv ** 2 + du ** 2 <= first ** 2
        guess[i, row, column] = (weights * patch).sum() / weights.sum()
    found = smooth_depth(depth, empty, images, cam)
    assert found.dtype == depth.dtype
    for i, row, column in ((0, 4, 5), (0, 4, 6), (1, 7, 9), (1, 11, 0), (0, 0, 14)):
        expected = empty[row, column] + mean(i, row, column, guess)
        assert abs(found[i, row, column] - expected) < 2e-5 < 1e-3 < abs(found[i, row, column] - depth[i, row, column])
