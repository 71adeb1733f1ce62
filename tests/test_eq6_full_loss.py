"""Eq. (6), Sec. III-F: the weighted sum of all terms, averaged over the batch.

    L = lambda_1 (L_CD + L_ds) + lambda_2 (L_rec + L_fs) + lambda_3 L_inv
"""
import numpy as np
import pytest
from autograd import grad
from helpers import assert_close, assert_float32, assert_gradient, assert_value

pytestmark = pytest.mark.eq6

NAMES = ["chamfer", "distance_smoothness", "photometric", "flow_smoothness", "inverse"]


def test_two_pokes_and_two_terms_by_hand():
    from hind4sight_min.losses import full_loss
    terms = {"chamfer": np.array([1.0, 3]), "inverse": np.array([10.0, 50])}
    assert_value(full_loss(terms, {"chamfer": 2.0, "inverse": 0.5}), 19.0, {  # (2 * 4 + 0.5 * 60) / 2
        "sum over the batch instead of its mean": 38.0, "weights ignored": 32.0, "the mean over the terms": 9.5,
        "the weights with each other's terms": 61.0})


def test_full_loss_and_its_gradient_against_the_plain_sum():
    from hind4sight_min.losses import full_loss
    rng = np.random.default_rng(0)
    terms = {name: rng.random(4) + 1 for name in NAMES}
    weights = dict(zip(reversed(NAMES), [2.0, 0.3, 0.0, 5.0, 0.7]))  # by name, not by position
    assert_close(full_loss(terms, weights), sum(weights[name] * terms[name][b] for name in NAMES for b in range(4)) / 4)
    gradients = grad(full_loss)(terms, weights)
    for name in NAMES:
        assert_close(gradients[name], np.full(4, weights[name] / 4), f"gradient of {name}: its weight over the batch")
        step = {**terms, name: terms[name] + [0, 1e-6, 0, 0]}
        difference = (full_loss(step, weights) - full_loss(terms, weights)) / 1e-6
        assert_close(gradients[name][1], difference, f"gradient of {name}", rtol=1e-5, atol=1e-6)
    single = {name: term.astype(np.float32) for name, term in terms.items()}
    assert full_loss(single, weights).dtype == grad(full_loss)(single, weights)["inverse"].dtype == np.float32


# --- not in the paper ---------------------------------------------------------------------------------------------

def test_a_point_between_background_and_motion_costs_by_hand():
    from hind4sight_min.losses import binary_mask_loss
    masks = np.array([[[1.0, 0, 0], [0, 1, 0]], [[0.5, 0.5, 0], [0.6, 0.2, 0.2]]])
    assert_value(binary_mask_loss(masks), [0, 0.25 + 0.24], {
        "every mask, not the background's alone": [0, 0.5 + 0.24 + 0.16 + 0.16], "the mean over points": [0, 0.245]})
    softer = np.random.default_rng(0).dirichlet(np.ones(3), (2, 5))
    assert_gradient(binary_mask_loss, 0, softer)
    assert_float32(binary_mask_loss, 0, softer)


# --- the weights --------------------------------------------------------------------------------------------------

def test_the_papers_weights_are_its_three_lambdas():
    from hind4sight_min.losses import PAPER_WEIGHTS
    assert PAPER_WEIGHTS == {"chamfer": 1e5, "distance_smoothness": 1e5,  # lambda_1: L_3D = L_CD + L_ds
                             "photometric": 1e3, "flow_smoothness": 1e3,  # lambda_2: L_2D = L_rec + L_fs
                             "inverse": 1.0}  # lambda_3


def test_a_missing_weight_is_zero_and_so_is_an_ablation():
    from hind4sight_min.losses import full_loss
    terms = {"chamfer": np.array([2.0, 4]), "photometric": np.array([5.0, 9])}
    expected = full_loss(terms, {"chamfer": 10.0, "photometric": 0.0})
    assert_value(expected, 30.0, {"a weight of 0 taken as none given": 37.0})
    assert_value(full_loss(terms, {"chamfer": 10.0}), 30.0, {"a missing weight taken as 1": 37.0})


@pytest.mark.parametrize("terms, weights", [
    ({}, {}), ({}, {"chamfer": 1.0}),  # no term at all
    ({"chamfer": 1.0}, {"chamfr": 1.0}),  # a misspelt term must not drop out silently
    ({"chamfer": 1.0}, {"chamfer": 1.0, "inverse": 1.0})])  # a weight of a term that is not there
def test_weights_of_other_terms_are_refused(terms, weights):
    from hind4sight_min.losses import full_loss
    with pytest.raises(ValueError, match="weights: expected some of the terms"):
        full_loss({name: np.full(2, value) for name, value in terms.items()}, weights)
