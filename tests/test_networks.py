"""The encoder, the forward model and the inverse model of Fig. 3."""
import numpy as np
import pytest
from autograd import grad
from scipy.spatial.transform import Rotation
from tiny import SIZES, random_run, tiny_pokes

from hind4sight_min import networks
from hind4sight_min.geometry import poke_axes
from hind4sight_min.networks import (encode, first_met, forward_model, height_map, init_parameters, inverse_model,
                                     predict, softmax, state_embedding, wall_map)
from hind4sight_min.scene import look
from hind4sight_min.training import scenes_of


def cloud(rng, batch=2, count=40, dtype=np.float64):
    points = rng.uniform(-0.2, 0.2, (batch, count, 3))
    points[..., 2] = rng.uniform(0.0, 0.06, (batch, count))
    pokes = np.column_stack([rng.uniform(-0.1, 0.1, (batch, 2)), rng.uniform(-3, 3, batch)])
    return points.astype(dtype), np.ones((batch, count), bool), pokes.astype(dtype)


def random_parameters(rng, dtype=np.float64):
    """Away from the identity initialisation, so that every output depends on every parameter."""
    return {name: (value + 0.2 * rng.standard_normal(value.shape)).astype(dtype)
            for name, value in init_parameters(SIZES, rng, dtype).items()}


def evidence(rng, points):
    """Clouds before and after, and weights, as scene.most_changed gives them."""
    return points, points + 0.02 * rng.standard_normal(points.shape), rng.dirichlet(np.ones(40), 2)


def test_an_untrained_model_predicts_background_and_no_motion():  # Sec. III-G
    rng = np.random.default_rng(0)
    points, valid, pokes = cloud(rng, dtype=np.float32)
    prediction = forward_model(init_parameters(SIZES, rng), SIZES, points, valid, pokes)
    assert prediction.points.dtype == prediction.masks.dtype == np.float32
    np.testing.assert_allclose(prediction.points, points, atol=1e-6)
    background = 1 / (1 + 2 / np.e)  # of logits 0, -1, -1
    np.testing.assert_allclose(prediction.masks[..., 0], background, atol=0.25, err_msg="masks begin by chance")
    np.testing.assert_allclose(prediction.rotations, np.broadcast_to(np.eye(3), (2, 3, 3, 3)), atol=1e-6)


def test_masks_are_a_distribution_and_the_background_never_moves():
    rng = np.random.default_rng(1)
    points, valid, pokes = cloud(rng)
    prediction = forward_model(random_parameters(rng), SIZES, points, valid, pokes)
    np.testing.assert_allclose(prediction.masks.sum(axis=2), 1)
    assert prediction.masks.shape == (2, 40, 3) and (prediction.masks > 0).all()
    np.testing.assert_array_equal(prediction.rotations[:, 0], np.broadcast_to(np.eye(3), (2, 3, 3)))
    assert not prediction.translations[:, 0].any()
    assert np.abs(prediction.points - points).max() > 1e-3  # the other masks do move
    np.testing.assert_allclose(softmax(np.array([1000.0, 1001, 999])), softmax(np.array([1.0, 2, 0])))


def test_a_mask_pushed_to_nothing_keeps_a_gradient():
    rng = np.random.default_rng(2)
    points, valid, pokes = cloud(rng)
    params = random_parameters(rng)
    params["mask_b"] = params["mask_b"] - 20

    def moved(bias):
        return forward_model({**params, "mask_b": bias}, SIZES, points, valid, pokes).masks[..., 1:].sum()
    assert np.abs(grad(moved)(params["mask_b"])).min() > 1e-6


def test_the_forward_model_turns_with_the_arena_except_for_its_arena_features():
    # Points, poke and prediction turned together about z: the poke frame must not notice.
    rng = np.random.default_rng(3)
    points, valid, pokes = cloud(rng)
    params = random_parameters(rng)
    params["trunk_0_w"][20:] = 0  # what comes from the encoder is tied to the arena: switch it off
    before = forward_model(params, SIZES, points, valid, pokes)
    turn, _ = poke_axes(np.array([[0, 0, 0.7]]))
    turned_pokes = np.column_stack([pokes[:, :2] @ turn[0, :2, :2].T, pokes[:, 2] + 0.7])
    after = forward_model(params, SIZES, points @ turn[0].T, valid, turned_pokes)
    np.testing.assert_allclose(after.points, before.points @ turn[0].T, atol=1e-10)
    np.testing.assert_allclose(after.masks, before.masks, atol=1e-10)


@pytest.mark.parametrize("name", sorted(init_parameters(SIZES, np.random.default_rng(0))))
def test_gradient_of_every_parameter_against_finite_differences(name):
    rng = np.random.default_rng(5)
    points, valid, pokes = cloud(rng)
    params, cells, seen = random_parameters(rng), rng.uniform(-0.2, 0.2, (7, 2)), evidence(rng, points)
    readout = [rng.standard_normal(shape) for shape in ((2, 40, 3), (2, 7), (2, 7))]

    def scalar(value):
        p = {**params, name: value}
        prediction = forward_model(p, SIZES, points, valid, pokes)
        return sum((a * b).sum() for a, b in zip((prediction.points, *inverse_model(p, *seen, cells)), readout))

    direction = rng.standard_normal(params[name].shape)
    step = 1e-7  # small: with kinks and max-pooling a longer step may cross a kink
    expected = (scalar(params[name] + step * direction) - scalar(params[name] - step * direction)) / (2 * step)
    assert abs(expected) > 1e-6
    np.testing.assert_allclose((grad(scalar)(params[name]) * direction).sum(), expected, rtol=1e-4)


def test_the_state_embedding_is_the_sum_over_objects_and_its_gradient_stops_at_the_encoder():
    rng = np.random.default_rng(8)  # where its gradient goes on, to masks and motions, test_training asks
    points, _, _ = cloud(rng)
    params, occupied = random_parameters(rng), points[..., 2] > 0.03
    for b in range(2):
        expected = sum(encode(params, points[b, n]) for n in np.flatnonzero(occupied[b]))
        np.testing.assert_allclose(state_embedding(params, points, occupied)[b], networks.STATE_GAIN * expected)
    weights = grad(lambda w: state_embedding({**params, "encoder_2_w": w}, points, occupied).sum() + w.sum())
    np.testing.assert_array_equal(weights(params["encoder_2_w"]), np.ones((6, 6)))  # that would fall silent


def test_a_motion_turns_about_the_pokes_target_and_then_shifts():
    rng = np.random.default_rng(0)
    points, valid, pokes = cloud(rng)
    params = random_parameters(rng)
    params["motion_3_w"] = 0 * params["motion_3_w"]
    params["motion_3_b"] = np.array([0.4, -0.2, 0.6, 1, -2, 9])  # in units of 5 mm and 0.1 rad
    found = forward_model(params, SIZES, points, valid, pokes)
    np.testing.assert_allclose(found.translations[:, 1:], np.tile([0.002, -0.001, 0.003], (2, 2, 1)), atol=1e-8)
    turns = Rotation.from_matrix(found.rotations[:, 1:].reshape(-1, 3, 3)).as_rotvec()
    np.testing.assert_allclose(turns, np.tile([0.1, -0.2, 0.9], (4, 1)), atol=1e-6)


def test_predict_moves_what_the_model_looks_at_and_leaves_the_rest():
    data, run = tiny_pokes(), random_run()
    scene, _ = scenes_of(data)
    found = predict(run.params, SIZES, scene, data.pokes)
    rows, seen = look(scene, data.pokes)
    assert not seen.all()
    for i in range(len(data)):
        part = rows[i, seen[i]]
        alone = forward_model(run.params, SIZES, scene.points[[i]][:, part], np.ones((1, len(part)), bool),
                              data.pokes[[i]], data.settings["arena"])
        np.testing.assert_allclose(found.points[i, part], alone.points[0], atol=1e-6)
        np.testing.assert_allclose(found.masks[i, part], alone.masks[0], atol=1e-5)
        others = np.setdiff1d(np.arange(scene.points.shape[1]), part)
        np.testing.assert_array_equal(found.points[i, others], scene.points[i, others])
        np.testing.assert_array_equal(found.masks[i, others], np.eye(3)[np.zeros(len(others), int)])
    assert np.abs(found.points - scene.points).max() > 1e-3


def test_the_inverse_model_moves_with_the_change():
    # The same change 7 cm further on is the same poke 7 cm further on, seen on cells 7 cm further on.
    rng = np.random.default_rng(8)
    before, after, weights = evidence(rng, cloud(rng)[0])
    params, cells = random_parameters(rng), rng.uniform(-0.2, 0.2, (7, 2))
    params["change_1_w"][41:] = 0  # what comes from the encoder is tied to the arena: switch it off
    first = inverse_model(params, before, after, weights, cells)
    shift = np.array([0.07, -0.03, 0])
    second = inverse_model(params, before + shift, after + shift, weights, cells + shift[:2])
    np.testing.assert_allclose(second, first, atol=1e-9)


def test_the_inverse_model_gives_the_start_first_and_then_the_end():
    rng = np.random.default_rng(8)
    params, cells, seen = random_parameters(rng), rng.uniform(-0.2, 0.2, (7, 2)), evidence(rng, cloud(rng)[0])
    start, end = inverse_model(params, *seen, cells)
    params["heatmaps_b"] = params["heatmaps_b"] + [0, 5.0]  # of the end alone
    again, shifted = inverse_model(params, *seen, cells)
    np.testing.assert_allclose(again, start, err_msg="the two maps are swapped")
    np.testing.assert_allclose(shifted, end + 5)


def test_the_height_map_against_a_loop_over_points():
    rng = np.random.default_rng(10)
    local, valid = rng.uniform(-0.18, 0.18, (2, 200, 3)), rng.random((2, 200)) < 0.8
    count, total = np.zeros((2, 14, 10)), np.zeros((2, 14, 10))
    for b, n in np.argwhere(valid):
        x, y = local[b, n, 0] / 0.02 + 6.5, local[b, n, 1] / 0.02 + 4.5  # in cells
        for i in (int(np.floor(x)), int(np.floor(x)) + 1):
            for j in (int(np.floor(y)), int(np.floor(y)) + 1):
                if 0 <= i < 14 and 0 <= j < 10:
                    share = (1 - abs(x - i)) * (1 - abs(y - j))
                    count[b, i, j] += share
                    total[b, i, j] += share * max(local[b, n, 2], 0)
    assert (count == 0).any() and (total > 0).any()
    np.testing.assert_allclose(height_map(local, valid), (total / (count + 0.2) / 0.03).reshape(2, 140), atol=1e-12)


def test_the_wall_map_against_samples_of_each_cell():
    pokes = np.array([[0.15, -0.02, 0.3], [-0.05, 0.17, 2.0], [0.0, 0.0, 1.0]])
    found = wall_map(pokes, 0.4).reshape(3, 14, 10)
    for poke, cells in zip(pokes, found):
        turn = Rotation.from_euler("z", poke[2])
        for i, j in np.ndindex(cells.shape):
            x, y, _ = turn.apply([(i - 6.5) * 0.02, (j - 4.5) * 0.02, 0]) + [*poke[:2], 0]
            share = np.clip((max(abs(x), abs(y)) - 0.19) / 0.02, 0, 1)  # 0 a cell's half in front of the wall at 0.2 m
            assert cells[i, j] == pytest.approx(share, abs=1e-6), "x and y swapped, or the turn's sign?"
    assert found[:2].max() == 1 and 0 < found[0].mean() < 1 and not found[2].any()
    assert not wall_map(pokes, np.inf).any()


def test_first_met_against_a_disc_that_advances():
    rng, step = np.random.default_rng(13), 2e-5
    local = np.column_stack([rng.uniform(-0.19, 0.05, 60), rng.uniform(-0.02, 0.02, 60), rng.uniform(0, 0.05, 60)])
    valid = rng.random(60) < 0.9
    counts = valid & (local[:, 2] > 0.005) & (local[:, 0] > -0.16)  # what lies behind its start it does not meet
    met_at = np.full(60, np.inf)
    for x in np.arange(-0.16 - networks.FINGER, step, step):  # the disc's centre
        inside = counts & (np.hypot(local[:, 0] - x, local[:, 1]) < networks.FINGER) & (local[:, 0] > x)
        met_at[inside & np.isinf(met_at)] = x
    found = first_met(local[None], valid[None])[0]
    met = np.isfinite(met_at)
    assert 10 < met.sum() < 50
    np.testing.assert_array_equal(found[~met], 0)
    central = np.sqrt(np.maximum(0, 1 - (local[:, 1] / networks.FINGER) ** 2))
    expected = np.where(met, central * np.exp(-(met_at - met_at.min()) / 0.004), 0)
    np.testing.assert_allclose(found, expected / expected.sum(), rtol=0.02, atol=1e-4)
    np.testing.assert_array_equal(first_met(local[None] - [0.3, 0, 0], valid[None]), 0, "it meets nothing")
