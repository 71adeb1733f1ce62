"""Eq. (4), Sec. III-D: neighbouring pixels move alike, except across an edge of the image.

    L_fs = sum |grad U| e^{-|grad I_t|} + |grad V| e^{-|grad I_t|}

|grad I| is the mean over the channels of I in [0, 1], times EDGE_SHARPNESS = 40 (losses.py says why).
"""
import numpy as np
import pytest
from helpers import assert_close, assert_float32, assert_gradient, assert_value, loop_smoothness

pytestmark = pytest.mark.eq4

B, H, W = 2, 4, 6
N = H * W


def loss_of(flow, images, valid=None):
    from hind4sight_min.losses import flow_smoothness_loss
    return flow_smoothness_loss(flow, images, np.ones((len(flow), flow.shape[1] * flow.shape[2]), bool)
                                if valid is None else valid)


# --- by hand ------------------------------------------------------------------------------------------------------

def test_one_pixel_that_moves_by_hand():
    # 3 x 3 pixels of one colour. Only the middle one moves, U = 2, V = -3: four steps of 2 in U and four of 3 in V.
    flow = np.zeros((1, 3, 3, 2))
    flow[0, 1, 1] = [2, -3]
    assert_value(loss_of(flow, np.full((1, 3, 3, 3), 0.5)), [20], {
        "mean over the pixels": [20 / 9], "steps along one axis only": [10], "U only": [8], "V only": [12],
        "squared": [52], "without the absolute value": [0], "the length of (U, V), not |U| + |V|": [4 * 13 ** 0.5],
        "mean over U and V": [10], "second derivatives": [40]})
    flow[0, 1, 1], flow[0, 0, 1] = 0, [2, -3]  # in the first row it has three neighbours: pictures do not wrap around
    assert_value(loss_of(flow, np.full((1, 3, 3, 3), 0.5)), [15], {"neighbours across the picture's rim": [20]})


def test_a_step_at_an_edge_of_the_image_is_cheap_by_hand():
    flow, images = np.zeros((1, 2, 4, 2)), np.full((1, 2, 4, 3), 0.5)
    flow[:, :, 2:] = [1, 2]  # a step between columns 1 and 2, two pixels high: 2 * (1 + 2)
    images[:, :, 2:] += [0.05, 0, 0.1]  # an edge at the same place, 0.05 in the mean over the channels
    assert_value(loss_of(flow, images), [6 * np.exp(-40 * 0.05)], {
        "images ignored": [6], "e^{+|grad I|}": [6 * np.exp(2)], "|grad I| summed over the channels": [6 * np.exp(-6)],
        "EDGE_SHARPNESS forgotten": [6 * np.exp(-0.05)], "the largest channel": [6 * np.exp(-4)]})
    images = np.full((1, 2, 4, 3), 0.5)
    images[:, 1:] = 0.9  # an edge between the rows, and one between other columns
    images[:, :, 3:] = 0.1
    assert_value(loss_of(flow, images), [6], {"the gradients of I along x and y swapped": [6 * np.exp(-16)]})


def test_edge_weights_by_hand():
    from hind4sight_min.losses import edge_weights
    images = np.array([0, 0.1, 0.3, 0.2, 0.25, 0.2]).reshape(1, 2, 3, 1)
    across, down = edge_weights(images)
    assert_value(across, [np.exp([[-4, -8], [-2, -2]])], {
        "|.| forgotten": [np.exp([[-4, -8], [-2, 2]])], "EDGE_SHARPNESS": [np.exp([[-0.1, -0.2], [-0.05, -0.05]])]})
    assert_value(down, [np.exp([[-8, -6, -4]])], {"EDGE_SHARPNESS forgotten": [np.exp([[-0.2, -0.15, -0.1]])]})


# --- against a loop over neighbours -------------------------------------------------------------------------------

def test_flow_smoothness_and_its_gradient_match_a_loop():
    rng = np.random.default_rng(1)
    flow, images, valid = rng.normal(size=(B, H, W, 2)), rng.uniform(0, 0.08, (B, H, W, 3)), rng.random((B, N)) < 0.8
    assert_close(loss_of(flow, images, valid), loop_smoothness(flow, images, valid),
                 "edges, valid or a row of neighbours?")
    gradient, _ = assert_gradient(loss_of, 0, flow, images, valid)
    assert not gradient.reshape(B, N, -1)[~valid].any(), "a pixel without depth is pulled at"
    assert_float32(loss_of, 0, flow, images, valid)


# --- pitfalls -----------------------------------------------------------------------------------------------------

def test_a_constant_flow_costs_nothing_and_has_no_gradient_to_speak_of():
    from autograd import elementwise_grad
    flow, images = np.zeros((1, H, W, 2)) + [3, -1], np.random.default_rng(2).random((1, H, W, 3))
    assert_close(loss_of(flow, images), [0.0])
    assert_close(elementwise_grad(loss_of)(flow, images), 0 * flow, "|x| has no slope at 0: 0, not NaN")


def test_a_step_counts_where_both_neighbours_have_depth():
    flow, images = np.zeros((1, 1, 4, 2)), np.zeros((1, 1, 4, 3))
    flow[0, 0, :, 0] = [0, 1, 3, 7]  # steps of 1, 2 and 4
    for valid, expected in (([1, 1, 1, 1], 7), ([1, 1, 1, 0], 3), ([1, 0, 1, 1], 4), ([0, 1, 1, 0], 2),
                            ([1, 0, 1, 0], 0)):
        assert_value(loss_of(flow, images, np.array([valid], bool)), [expected], {
            "valid ignored": [7], "one neighbour with depth is enough": [7]})
