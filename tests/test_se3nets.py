"""SE3-Nets, the supervised baseline: its loss, its targets, and whose truth they are made of."""
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers import assert_gradient
from tiny import TINY, random_run, still_truth, tiny_pokes

from hind4sight_min import training
from hind4sight_min.geometry import unproject
from hind4sight_min.lab import se3nets
from hind4sight_min.lab.noise import with_depth_noise
from hind4sight_min.lab.processes import parallel_map
from hind4sight_min.lab.se3nets import Supervised, association_loss, supervised, true_targets


def moved_blocks(count=7):
    """Tiny pokes and a truth in which each one's block, object 1, moves along x, by another centimetre in every row."""
    data = tiny_pokes(count)
    truth = still_truth(data.empty_depth - data.depth_before > 0.01)
    truth.poses_after[:, 0, 0] = 0.01 * np.arange(1, count + 1)
    return Supervised(data, truth)


def expected_loss(data):
    """What predicting no motion costs, (B,) m^2: the squared motion of the block's nine points."""
    return 9 * data.truth.poses_after[:, 0, 0] ** 2


def test_association_loss_is_the_sum_of_squares_over_valid_points():
    rng = np.random.default_rng(0)
    predicted, targets = rng.normal(size=(2, 2, 6, 3))
    valid = rng.random((2, 6)) < 0.6
    by_hand = [sum(np.sum((predicted[b, n] - targets[b, n]) ** 2) for n in range(6) if valid[b, n]) for b in (0, 1)]
    np.testing.assert_allclose(association_loss(predicted, targets, valid), by_hand, rtol=1e-12)
    assert_gradient(association_loss, 0, predicted, targets, valid)


def test_exact_targets_are_the_true_motion_from_where_the_model_sees_a_point():
    data = moved_blocks()
    data.truth.poses_after[:, 0, 3:] = [0, 0, np.sin(0.2), np.cos(0.2)]  # a turn by 0.4 rad besides
    seen = with_depth_noise(data.interactions, 0.01, np.random.default_rng(0))
    points, clean = (unproject(each.depth_before, data.camera).reshape(7, -1, 3) for each in (seen, data.interactions))
    targets = true_targets(data, points, seen.depth_before, 1, np.random.default_rng(0))
    turn = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    motion = (clean @ turn.T + data.truth.poses_after[:, :1, :3] - clean) * (data.truth.labels.reshape(7, -1, 1) == 1)
    np.testing.assert_allclose(targets - points, motion, atol=1e-6, err_msg="the motion of the noisy points?")
    assert (motion[..., 0] != 0).sum() == 63


def test_association_noise_takes_points_for_others_near_them():
    data = moved_blocks()
    depth = data.interactions.depth_before
    points = unproject(depth, data.camera).reshape(7, -1, 3)
    exact, noisy = (true_targets(data, points, depth, window, np.random.default_rng(0)).reshape(7, 12, 16, 3)
                    for window in (1, 3))
    for b, v, u in np.ndindex(7, 12, 16):
        near = exact[b, max(v - 1, 0):v + 2, max(u - 1, 0):u + 2].reshape(-1, 3)
        assert (near == noisy[b, v, u]).all(axis=1).any()
    changed = (noisy != exact).any(axis=3)
    assert 0.7 < changed.mean() < 0.95
    assert (changed[0] != changed[1]).any() and (changed[1] != changed[2]).any(), "pictures share their draws"


def test_every_row_is_trained_with_its_own_truth():
    data = moved_blocks()
    run = training.start_run(replace(TINY, batch=5, weights=se3nets.WEIGHTS), data.interactions)  # as yet: no motion
    rows = training.rows_of_step(run.recipe, 7, 0)
    assert not np.array_equal(rows, np.arange(5))
    terms = training.training_step(data, run, supervised)
    assert terms["association"] == pytest.approx(expected_loss(data)[rows].mean(), rel=0.02), "the truth of other rows?"
    assert expected_loss(data)[:5].mean() != pytest.approx(terms["association"], rel=0.05)


def test_noise_and_window_reach_the_objective():
    data, run = moved_blocks(), random_run()

    def loss(seed=0, **options):
        return supervised(run.params, run.recipe, data, np.random.default_rng(seed), **options)["association"]
    np.testing.assert_array_equal(loss(), loss(seed=1))
    for options in ({"window": 3}, {"depth_noise": 0.01}):
        assert (loss(**options) != loss()).all(), options
        assert (loss(seed=1, **options) != loss(**options)).any(), options
        np.testing.assert_array_equal(loss(**options), loss(**options))


def test_it_learns_the_same_on_two_processes():
    data, objective = moved_blocks(), partial(supervised, window=3, depth_noise=0.002)
    recipe = replace(TINY, batch=12, steps=12, weights=se3nets.WEIGHTS, learning_rate=1e-2)  # two chunks, one larger
    with parallel_map(2) as parallel:
        assert list(parallel(divmod, range(5), [3] * 5)) == [divmod(n, 3) for n in range(5)], "calls out of order"
        alone, together = (training.train(data, training.start_run(recipe, data.interactions), objective, how)
                           for how in (map, parallel))
    np.testing.assert_array_equal(together.vector, alone.vector)
    found = supervised(alone.params, recipe, data, np.random.default_rng(0))["association"]
    assert found.sum() < 0.8 * expected_loss(data).sum(), "it did not learn"
