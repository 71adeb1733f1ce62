"""Eq. (2), Sec. III-B: the Chamfer distance of the predicted cloud P' and the observed one P.

    D_{P'->P}(i) = min_j |P'_i - P_j|^2,   D_{P->P'}(j) = min_i |P'_i - P_j|^2,   L_CD = sum (D_{P'->P} + D_{P->P'})

Squared, both ways, summed: others average the points, or go one way, or do not square.
"""
import autograd.numpy as anp
import numpy as np
import pytest
from helpers import assert_close, assert_float32, assert_gradient, assert_value, gradient_of

pytestmark = pytest.mark.eq2


def on_a_line(*x):
    """One cloud (1, N, 3) of points on the x axis."""
    return np.array([[[value, 0, 0] for value in x]], float)


def all_valid(cloud):
    return np.ones(cloud.shape[:2], bool)


def chamfer(predicted, observed, valid_predicted=None, valid_observed=None):
    from hind4sight_min.losses import chamfer_loss, distance_maps
    return chamfer_loss(*distance_maps(predicted, observed,
                                       all_valid(predicted) if valid_predicted is None else valid_predicted,
                                       all_valid(observed) if valid_observed is None else valid_observed))


# --- the whole of it, by hand -------------------------------------------------------------------------------------

def test_two_points_against_two_by_hand():
    # P' = {0, 1}, P = {3, 8}.  P' -> P: 3^2 + 2^2 = 13;  P -> P': 2^2 + 7^2 = 53.
    assert_value(chamfer(on_a_line(0, 1), on_a_line(3, 8)), [66], {
        "one direction only (P' -> P)": [13], "one direction only (P -> P')": [53], "mean instead of sum": [33],
        "not squared": [14], "not squared, the mean": [7], "each point with its own number, not the nearest": [116]})


def test_gradient_of_two_points_against_two_by_hand():
    predicted, observed = on_a_line(0, 1), on_a_line(3, 8)
    assert_value(gradient_of(chamfer, 0, 1.0, predicted, observed)[0, :, 0], [2 * -3, 2 * -2 + 2 * -2 + 2 * -7], {
        "the wrong sign": [6, 22], "the factor 2 of the square, or a mean over 2 points": [-3, -11],
        "D_{P->P'} does not pull on P'": [-6, -4], "D_{P'->P} does not pull on P'": [0, -18],
        "a point that is nearest to several keeps only the last of them": [-6, -4 - 14]})
    assert_value(gradient_of(chamfer, 1, 1.0, predicted, observed)[0, :, 0], [2 * 3 + 2 * 2 + 2 * 2, 2 * 7], {
        "D_{P'->P} does not pull on P": [4, 14], "D_{P->P'} does not pull on P": [10, 0], "the wrong sign": [-14, -14]})


def test_chamfer_loss_sums_both_maps_for_each_interaction():
    from hind4sight_min.losses import chamfer_loss
    maps = np.array([[1.0, 2], [3, 4]]), np.array([[10.0, 20], [30, 40]])
    assert_value(chamfer_loss(*maps), [33, 77], {
        "one map only": [3, 7], "the mean over the pixels": [16.5, 38.5], "summed over the interactions": [44, 66]})
    for argnum in (0, 1):
        assert_gradient(chamfer_loss, argnum, *maps)
        assert_float32(chamfer_loss, argnum, *maps)


# --- the nearest neighbour ----------------------------------------------------------------------------------------

def brute_force(queries, references, valid):
    """Squared distances (B, N) over all pairs."""
    pairs = ((queries[:, :, None] - references[:, None]) ** 2).sum(axis=3)
    return np.where(valid[:, None], pairs, np.inf).min(axis=2)


@pytest.mark.parametrize("references", [14, 20])  # other than the queries, and as many
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_nearest_squared_distances_match_brute_force(references, share):
    from hind4sight_min.ops import nearest_squared_distances
    rng = np.random.default_rng(1)
    queries, references = rng.normal(size=(3, 20, 3)), rng.normal(size=(3, references, 3))
    queries[:, :6] = references[:, :6]  # points that never moved
    queries[:, 3:6] += 2 * np.eye(3)  # or moved along one axis only
    valid = rng.random(references.shape[:2]) < share
    expected = brute_force(queries, references, valid)
    assert_close(nearest_squared_distances(queries, references, valid), expected, "squared? only valid references?")
    for argnum in (0, 1):
        assert_gradient(nearest_squared_distances, argnum, queries, references, valid)
        assert_float32(nearest_squared_distances, argnum, queries, references, valid)


def test_the_clouds_of_a_batch_do_not_see_each_other():
    from hind4sight_min.ops import nearest_squared_distances
    queries = np.array([[[0.0, 0, 0]], [[5, 0, 0]]])
    references = queries[::-1] + [0, 1, 0]  # the other cloud's reference would be nearer
    assert_value(nearest_squared_distances(queries, references, np.ones((2, 1), bool)), [[26], [26]], {
        "neighbours sought in the whole batch": [[1], [1]]})


# --- pixels without depth, and pixels that only one frame shows ---------------------------------------------------

@pytest.mark.parametrize("share", [1.0, 0.6])
def test_distance_maps_match_brute_force_and_live_each_on_its_own_grid(share):
    from hind4sight_min.losses import distance_maps
    rng = np.random.default_rng(2)
    clouds, valid = rng.normal(size=(2, 2, 12, 3)), rng.random((2, 2, 12)) < share
    found = distance_maps(*clouds, *valid)
    for here, there, name in ((0, 1, "D_{P'->P}, on the grid of frame t"), (1, 0, "D_{P->P'}, on that of frame t+1")):
        expected = np.where(valid[here], brute_force(clouds[here], clouds[there], valid[there]), 0)
        assert_close(found[here], expected, f"{name}: the two maps, or their two masks, swapped?")
        gradient, _ = assert_gradient(lambda *args: anp.stack(distance_maps(*args)), here, *clouds, *valid)
        assert not gradient[~valid[here]].any(), "a point that does not count has a gradient"


@pytest.mark.parametrize("hole_in", [0, 1])
def test_points_without_depth_neither_attract_nor_cost(hole_in):
    from hind4sight_min.losses import distance_maps
    clouds = [on_a_line(0, 1, 2), on_a_line(5, 6, 7)]
    clouds[hole_in][0, 1] = clouds[1 - hole_in][0].mean(axis=0)  # a pixel without depth, in the middle of the others
    valid = np.ones((2, 1, 3), bool)
    valid[hole_in, 0, 1] = False
    expected = [[[25, 0, 9]], [[9, 16, 25]]] if hole_in == 0 else [[[25, 16, 9]], [[9, 0, 25]]]
    for found, wanted, grid in zip(distance_maps(*clouds, *valid), expected, "t t+1".split()):
        assert_close(found, wanted, f"frame {grid}: valid forgotten? (it attracts where it must not, or costs)")


def test_what_only_one_frame_shows_is_not_compared():
    # Pixels: table twice; table that the object covers; object twice; table that it uncovers; without depth.
    from hind4sight_min.losses import seen_in_both
    occupied, next_occupied = np.array([[[0, 0, 1, 1, 0]], [[0, 1, 1, 0, 0]]], bool)
    valid = np.array([[True, True, True, True, False]])
    assert_value(seen_in_both(valid, valid, occupied, next_occupied), [[[1, 0, 1, 1, 0]], [[1, 1, 1, 0, 0]]], {
        "the two frames swapped": [[[1, 1, 1, 0, 0]], [[1, 0, 1, 1, 0]]],
        "only where nothing changed": [[[1, 0, 1, 0, 0]], [[1, 0, 1, 0, 0]]],
        "pixels without depth counted": [[[1, 0, 1, 1, 1]], [[1, 1, 1, 0, 1]]],
        "every pixel with depth": [[[1, 1, 1, 1, 0]], [[1, 1, 1, 1, 0]]]})
    _, next_seen = seen_in_both(valid, ~valid, occupied, next_occupied)
    assert_value(next_seen, [[0, 0, 0, 0, 1]], {"valid of the other frame": [[1, 1, 1, 0, 0]]})


@pytest.mark.parametrize("case, named", [("nan", "queries, references.*finite"), ("none", "valid.*at least one")])
def test_nan_and_a_cloud_without_depth_are_refused(case, named):
    predicted, observed = np.ones((2, 2, 4, 3))
    predicted[1, 2, 0] = np.nan if case == "nan" else 1
    valid = np.array([[True] * 4, [case == "nan"] * 4])
    with pytest.raises(ValueError, match=named):
        chamfer(predicted, observed, valid, valid)
