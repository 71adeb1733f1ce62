"""L_inv = L_act + L_sim, Sec. III-E: which poke led from one state to the next, and what it made of the state.

L_act is the cross entropy of two heat-maps over the arena's cells, where the poke starts and where it ends; L_sim the
L1 distance of the predicted and the observed embedding of the next state, the mean over its width.
"""
import numpy as np
import pytest
from helpers import assert_close, assert_float32, assert_gradient, assert_value, gradient_of
from scipy.special import log_softmax, softmax

pytestmark = pytest.mark.inverse


# --- by hand ------------------------------------------------------------------------------------------------------

def test_cross_entropy_of_a_heatmap_by_hand():
    from hind4sight_min.losses import heatmap_cross_entropy
    logits = np.log([[1.0, 2, 5], [1, 1, 2]])  # probabilities 1/8, 2/8, 5/8 and 1/4, 1/4, 1/2
    assert_value(heatmap_cross_entropy(logits, np.array([2, 0])), [np.log(8 / 5), np.log(4)], {
        "the sign": [np.log(5 / 8), -np.log(4)], "cells counted from 1": [np.log(4), np.log(2)],
        "softmax over the interactions": [np.log(7 / 5), np.log(2)], "without the logarithm": [5 / 8, 1 / 4],
        "softmax forgotten": [-np.log(5), 0], "the mean over the cells": [np.log(8 / 5) / 3, np.log(4) / 3],
        "logarithm of base 2": [np.log2(8 / 5), 2]})
    assert_close(heatmap_cross_entropy(np.zeros((1, 4)), np.array([3])), [np.log(4)], "one of four cells, by chance")


def test_embedding_loss_by_hand():
    from hind4sight_min.losses import embedding_loss
    predicted, observed = np.array([[1.0, 2, 3, 0], [0, 0, 0, 8]]), np.array([[2.0, 0, 3, 0], [0, 0, 0, 4]])
    assert_value(embedding_loss(predicted, observed), [0.75, 1], {
        "the sum over the embedding": [3, 4], "squared": [1.25, 4], "L2": [5 ** 0.5, 4], "without |.|": [0.25, 1]})


def test_inverse_loss_by_hand():
    from hind4sight_min.losses import inverse_loss
    start_logits, end_logits = np.log([[1.0, 3]]), np.log([[1.0, 9]])
    predicted, observed = np.array([[1.0, 2]]), np.array([[0.0, 0]])
    found = inverse_loss(start_logits, end_logits, np.array([0]), np.array([1]), predicted, observed)
    start, end, similar = np.log(4), np.log(10 / 9), 1.5
    assert_value(found, [start + end + similar], {
        "the start's heat-map with the end's cell, and vice versa": [np.log(4 / 3) + np.log(10) + similar],
        "L_act of the start only": [start + similar], "L_act of the end only": [end + similar],
        "L_act the mean of both heat-maps": [(start + end) / 2 + similar], "L_sim forgotten": [start + end],
        "L_sim subtracted": [start + end - similar], "both heat-maps with the start": [start + np.log(10) + similar]})


# --- against SciPy ------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("shift", [0.0, 1e4, -1e4])  # adding a number to all logits changes nothing
def test_cross_entropy_and_its_gradient_match_scipy(shift):
    from hind4sight_min.losses import heatmap_cross_entropy
    rng = np.random.default_rng(0)
    logits, cells, weights = rng.normal(size=(3, 7)) + shift, np.array([4, 0, 6]), np.array([1, -2, 0.5])
    expected = -log_softmax(logits, axis=1)[np.arange(3), cells]
    assert_close(heatmap_cross_entropy(logits, cells), expected, "exp of a large number: subtract the largest logit")
    found = gradient_of(heatmap_cross_entropy, 0, weights, logits, cells)
    assert_close(found, weights[:, None] * (softmax(logits, axis=1) - np.eye(7)[cells]), "softmax minus one-hot")
    if not shift:
        assert_gradient(heatmap_cross_entropy, 0, logits, cells)
        assert_float32(heatmap_cross_entropy, 0, logits, cells)


def inverse_inputs():
    rng = np.random.default_rng(2)
    return (*rng.normal(size=(2, 3, 7)), np.array([4, 0, 6]), np.array([1, 5, 2]), *rng.normal(size=(2, 3, 5)))


@pytest.mark.parametrize("argnum, name", [(0, "start logits"), (1, "end logits"), (4, "predicted embedding"),
                                          (5, "next embedding")])
def test_gradient_of_the_inverse_loss(argnum, name):
    from hind4sight_min.losses import inverse_loss
    assert_gradient(inverse_loss, argnum, *inverse_inputs(), hint=f"with respect to the {name}")
    assert_float32(inverse_loss, argnum, *inverse_inputs())
