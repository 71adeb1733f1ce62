"""Eq. (5), Sec. III-D: the two distance maps of Eq. (2) are smooth, except across an edge of the image.

    L_ds = sum |grad D_{P->P'}| e^{-|grad I_{t+1}|} + |grad D_{P'->P}| e^{-|grad I_t|}

Each map with the image, and the mask, of its own grid: D_{P'->P} lives on frame t's, D_{P->P'} on frame t+1's.
"""
import numpy as np
import pytest
from helpers import assert_close, assert_float32, assert_gradient, assert_value, loop_smoothness

pytestmark = pytest.mark.eq5

B, H, W = 2, 4, 6
N = H * W


def loss_of(*args):
    from hind4sight_min.losses import distance_smoothness_loss
    return distance_smoothness_loss(*args)


# --- by hand ------------------------------------------------------------------------------------------------------

def one_row(*values):
    return np.array([values], float)


def picture(*values):
    """One grey row (1, 1, W, 3)."""
    return np.array(values, float)[None, None, :, None] * np.ones(3)


def test_one_row_of_pixels_by_hand():
    map_predicted, map_observed = one_row(0, 1, 1), one_row(0, 0, 10)  # steps of 1 and of 10
    images, next_images = picture(0, 0.05, 0.05), picture(0.5, 0.5, 0.6)  # each has an edge at its own map's step
    valid = np.ones((1, 3), bool)
    assert_value(loss_of(map_predicted, map_observed, images, next_images, valid, valid),
                 [np.exp(-2) + 10 * np.exp(-4)], {
        "the images swapped": [11], "one map only (P' -> P)": [np.exp(-2)],
        "one map only (P -> P')": [10 * np.exp(-4)], "I_{t+1} for both maps": [1 + 10 * np.exp(-4)],
        "I_t for both maps": [np.exp(-2) + 10], "mean over the pixels": [(np.exp(-2) + 10 * np.exp(-4)) / 3],
        "e^{+|grad I|}": [np.exp(2) + 10 * np.exp(4)], "squared": [np.exp(-2) + 100 * np.exp(-4)],
        "EDGE_SHARPNESS forgotten": [np.exp(-0.05) + 10 * np.exp(-0.1)]})


def test_pixels_without_depth_by_hand():
    flat, both = picture(0, 0, 0), (one_row(0, 1, 3), one_row(0, 10, 40))  # steps of 1, 2 and of 10, 30
    valid, next_valid = np.array([[True, True, False]]), np.array([[False, True, True]])
    assert_value(loss_of(*both, flat, flat, valid, next_valid), [1 + 30], {
        "the masks swapped": [2 + 10], "one mask for both maps (frame t's)": [1 + 10],
        "one mask for both maps (frame t+1's)": [2 + 30], "masks ignored": [43],
        "only steps that count in both frames": [0]})


def test_the_maps_are_pictures_row_by_row():
    maps, flat, valid = np.zeros((2, 1, 6)), np.zeros((1, 2, 3, 3)), np.ones((1, 6), bool)
    maps[0, 0, 2] = 1  # the last pixel of the first of two rows: one neighbour in its row, one below, none after
    assert_value(loss_of(*maps, flat, flat, valid, valid), [2], {
        "the rows strung together": [3], "height and width swapped": [3], "one axis only": [1]})


# --- against a loop over neighbours -------------------------------------------------------------------------------

def random_inputs():
    rng = np.random.default_rng(0)
    return (*rng.random((2, B, N)), *rng.uniform(0, 0.08, (2, B, H, W, 3)), *(rng.random((2, B, N)) < 0.8))


def test_distance_smoothness_matches_a_loop():
    map_predicted, map_observed, images, next_images, valid, next_valid = inputs = random_inputs()
    expected = (loop_smoothness(map_predicted.reshape(B, H, W, 1), images, valid)
                + loop_smoothness(map_observed.reshape(B, H, W, 1), next_images, next_valid))
    assert_close(loss_of(*inputs), expected, "which image and which mask goes with which map?")


@pytest.mark.parametrize("argnum, name", [(0, "D_{P'->P}"), (1, "D_{P->P'}")])
def test_gradient_of_distance_smoothness(argnum, name):
    inputs = random_inputs()
    gradient, _ = assert_gradient(loss_of, argnum, *inputs, hint=f"with respect to {name}")
    assert not gradient[~inputs[4 + argnum]].any(), f"a pixel of {name} without depth is pulled at"
    assert_float32(loss_of, argnum, *inputs)
