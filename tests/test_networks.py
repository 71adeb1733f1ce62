import numpy as np
import pytest
from autograd import grad
from scipy.spatial.transform import Rotation

from hind4sight_min import networks
from hind4sight_min.geometry import Camera, look_at, project
from hind4sight_min.networks import (Sizes, contact, encode, encoder_features, forward_model, fourier, height_map,
                                     init_parameters, inverse_model, most_changed, poke_axes, poke_features,
                                     poke_frame, pooling_weights, standing_out, state_embedding, windows)
from hind4sight_min.ops import weighted_means

SIZES = Sizes(masks=3, width=8, head=10, rounds=2, embedding=6, inverse=9)


def scene(rng, batch=2, count=40, dtype=np.float64):
    points = rng.uniform(-0.2, 0.2, (batch, count, 3))
    points[..., 2] = rng.uniform(0.0, 0.06, (batch, count))
    pokes = np.column_stack([rng.uniform(-0.1, 0.1, (batch, 2)), rng.uniform(-3, 3, batch)])
    return points.astype(dtype), np.ones((batch, count), bool), pokes.astype(dtype)


def random_parameters(rng, dtype=np.float64, sizes=SIZES):
    """Away from the identity initialisation, so that every output depends on every parameter."""
    return {name: (value + 0.2 * rng.standard_normal(value.shape)).astype(dtype)
            for name, value in init_parameters(sizes, rng, dtype).items()}


def test_untrained_model_predicts_background_and_no_motion():
    rng = np.random.default_rng(0)
    points, valid, pokes = scene(rng, dtype=np.float32)
    prediction = forward_model(init_parameters(SIZES, rng), SIZES, points, valid, pokes)
    assert prediction.points.dtype == np.float32
    np.testing.assert_allclose(prediction.points, points, atol=1e-6)
    assert (prediction.masks.argmax(axis=2) == 0).all()
    np.testing.assert_allclose(prediction.rotations, np.broadcast_to(np.eye(3), (2, 3, 3, 3)), atol=1e-6)


def test_masks_are_a_distribution_and_the_background_never_moves():
    rng = np.random.default_rng(1)
    points, valid, pokes = scene(rng)
    prediction = forward_model(random_parameters(rng), SIZES, points, valid, pokes)
    assert prediction.masks.shape == (2, 40, 3)
    np.testing.assert_allclose(prediction.masks.sum(axis=2), 1)
    assert (prediction.masks > 0).all()
    np.testing.assert_array_equal(prediction.rotations[:, 0], np.broadcast_to(np.eye(3), (2, 3, 3)))
    assert not prediction.translations[:, 0].any()
    assert np.abs(prediction.points - points).max() > 1e-3  # the other masks do move
    for rotation in prediction.rotations.reshape(-1, 3, 3):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_a_mask_pushed_to_nothing_keeps_a_gradient():
    rng = np.random.default_rng(2)
    points, valid, pokes = scene(rng)
    params = random_parameters(rng)
    params["mask_b"] = params["mask_b"] - 20

    def moved(bias):
        return forward_model({**params, "mask_b": bias}, SIZES, points, valid, pokes).masks[..., 1:].sum()
    assert np.abs(grad(moved)(params["mask_b"])).min() > 1e-6


def test_forward_model_turns_with_the_arena_except_for_its_arena_features():
    # Points, poke and prediction turned together about z: the poke frame must not notice.
    rng = np.random.default_rng(3)
    points, valid, pokes = scene(rng)
    params = random_parameters(rng)
    params["trunk_0_w"][23:] = 0  # what comes from the encoder is tied to the arena: switch it off
    before = forward_model(params, SIZES, points, valid, pokes)
    turn, _ = poke_axes(np.array([[0, 0, 0.7]]))
    turned_pokes = np.column_stack([pokes[:, :2] @ turn[0, :2, :2].T, pokes[:, 2] + 0.7])
    after = forward_model(params, SIZES, points @ turn[0].T, valid, turned_pokes)
    np.testing.assert_allclose(after.points, before.points @ turn[0].T, atol=1e-10)
    np.testing.assert_allclose(after.masks, before.masks, atol=1e-10)


def test_points_without_depth_do_not_change_the_others():
    rng = np.random.default_rng(4)
    points, valid, pokes = scene(rng)
    params = random_parameters(rng)
    valid[:, :10] = False
    first = forward_model(params, SIZES, points, valid, pokes)
    points[:, :10] = rng.uniform(-1, 1, (2, 10, 3))
    second = forward_model(params, SIZES, points, valid, pokes)
    np.testing.assert_allclose(second.points[:, 10:], first.points[:, 10:], atol=1e-12)
    np.testing.assert_allclose(second.masks[:, 10:], first.masks[:, 10:], atol=1e-12)


@pytest.mark.parametrize("name", sorted(init_parameters(SIZES, np.random.default_rng(0))))
def test_gradient_of_every_parameter_against_finite_differences(name):
    rng = np.random.default_rng(5)
    points, valid, pokes = scene(rng)
    next_points = points + 0.02 * rng.standard_normal(points.shape)
    params, cells = random_parameters(rng), rng.uniform(-0.2, 0.2, (7, 2))
    readout = [rng.standard_normal(shape) for shape in ((2, 40, 3), (2, 7), (2, 7))]

    def scalar(value):
        p = {**params, name: value}
        prediction = forward_model(p, SIZES, points, valid, pokes)
        start, end = inverse_model(p, *most_changed(points, next_points, valid), cells)
        return sum((a * b).sum() for a, b in zip((prediction.points, start, end), readout))

    direction = rng.standard_normal(params[name].shape)
    step = 1e-7  # small: with kinks and max-pooling a longer step may cross a kink
    expected = (scalar(params[name] + step * direction) - scalar(params[name] - step * direction)) / (2 * step)
    found = (grad(scalar)(params[name]) * direction).sum()
    assert abs(expected) > 1e-6
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_siamese_encoder_serves_both_models():
    rng = np.random.default_rng(6)
    points, valid, pokes = scene(rng)
    next_points = points + 0.02 * rng.standard_normal(points.shape)
    params, cells = random_parameters(rng), rng.uniform(-0.2, 0.2, (7, 2))

    def forward(w):
        return forward_model({**params, "encoder_1_w": w}, SIZES, points, valid, pokes).points.sum()

    def inverse(w):
        p = {**params, "encoder_1_w": w}
        return inverse_model(p, *most_changed(points, next_points, valid), cells)[0][:, 0].sum()
    for model in (forward, inverse):
        assert np.abs(grad(model)(params["encoder_1_w"])).max() > 1e-6


def test_state_embedding_is_the_sum_over_what_stands():
    rng = np.random.default_rng(7)
    points, _, _ = scene(rng)
    params, standing = random_parameters(rng), rng.random((2, 40)) < 0.3
    found = state_embedding(params, points, standing)
    assert found.shape == (2, 6) and standing.any(axis=1).all()
    for b in range(2):
        expected = sum(encode(params, points[b, n]) for n in np.flatnonzero(standing[b]))
        np.testing.assert_allclose(found[b], networks.STATE_GAIN * expected)


def test_state_embedding_pulls_at_the_points_that_stand():
    # What makes L_sim a loss of masks and motions: its gradient with respect to the predicted points.
    rng = np.random.default_rng(8)
    points, _, _ = scene(rng)
    params, standing, readout = random_parameters(rng), points[..., 2] > 0.03, rng.standard_normal((2, 6))

    def scalar(where):
        return (state_embedding(params, where, standing) * readout).sum()
    found, step = grad(scalar)(points), 1e-7
    assert not found[~standing].any() and np.abs(found[standing]).min() > 0
    for _ in range(3):
        direction = rng.standard_normal(points.shape)
        expected = (scalar(points + step * direction) - scalar(points - step * direction)) / (2 * step)
        assert abs(expected) > 1
        np.testing.assert_allclose((found * direction).sum(), expected, rtol=1e-5)
    weights = grad(lambda w: (state_embedding({**params, "encoder_2_w": w}, points, standing) * readout).sum()
                   + w.sum())(params["encoder_2_w"])
    np.testing.assert_array_equal(weights, np.ones((6, 6)))  # and not at the encoder, which would fall silent


def test_a_motion_turns_about_its_masks_centroid_and_then_shifts():
    rng = np.random.default_rng(0)
    points, valid, pokes = scene(rng)
    valid[:, :9] = False
    params = random_parameters(rng)
    params["motion_3_w"] = 0 * params["motion_3_w"]
    params["motion_3_b"] = np.array([0.4, -0.2, 0.6, 1, -2, 9])  # in units of 5 mm and 0.1 rad
    found = forward_model(params, SIZES, points, valid, pokes)
    centroids = weighted_means(poke_frame(points, pokes), found.masks[..., 1:] * valid[..., None])
    moved = np.einsum("bkij,bkj->bki", found.rotations[:, 1:], centroids) + found.translations[:, 1:]
    np.testing.assert_allclose(moved - centroids, np.tile([0.002, -0.001, 0.003], (2, 2, 1)), atol=1e-8)
    turns = Rotation.from_matrix(found.rotations[:, 1:].reshape(-1, 3, 3)).as_rotvec()
    np.testing.assert_allclose(turns, np.tile([0.1, -0.2, 0.9], (4, 1)), atol=1e-6)


def test_inverse_model_moves_with_the_change():
    # The same change 7 cm further on is the same poke 7 cm further on, seen on cells 7 cm further on.
    rng = np.random.default_rng(8)
    before, _, _ = scene(rng)
    after = before + 0.02 * rng.standard_normal(before.shape)
    weights = rng.dirichlet(np.ones(40), 2)
    params, cells = random_parameters(rng), rng.uniform(-0.2, 0.2, (7, 2))
    params["change_1_w"][41:] = 0  # what comes from the encoder is tied to the arena: switch it off
    first = inverse_model(params, before, after, weights, cells)
    shift = np.array([0.07, -0.03, 0])
    second = inverse_model(params, before + shift, after + shift, weights, cells + shift[:2])
    np.testing.assert_allclose(second, first, atol=1e-9)


def camera(width, height):
    return Camera(width, height, 1.2 * width, 1.2 * width, (width - 1) / 2, (height - 1) / 2,
                  look_at([0, -0.46, 0.62], [0, 0, 0]))


@pytest.mark.parametrize("width, height", [(64, 48), (17, 13)])
def test_windows_hold_the_target_in_their_middle_and_stay_in_the_picture(width, height):
    rng, cam = np.random.default_rng(11), camera(width, height)
    pokes = np.column_stack([rng.uniform(-0.3, 0.3, (200, 2)), rng.uniform(-3, 3, 200)])
    picture, middle = np.zeros((height, width)), 0
    for poke, (rows, columns) in zip(pokes, windows(pokes, cam)):
        assert picture[rows, columns].shape == ((height + 1) // 2, (width + 1) // 2)
        assert rows.start >= 0 and columns.start >= 0 and rows.stop <= height and columns.stop <= width
        x, y = project(np.array([poke[0] + 0.02 * np.cos(poke[2]), poke[1] + 0.02 * np.sin(poke[2]), 0.02]), cam)
        free = 0 < rows.start and rows.stop < height and 0 < columns.start and columns.stop < width
        if free:
            middle += 1
            assert abs((rows.start + rows.stop - 1) / 2 - y) <= 0.5 + 1e-9
            assert abs((columns.start + columns.stop - 1) / 2 - x) <= 0.5 + 1e-9
    assert middle > 20


def test_windows_of_a_mirrored_poke_are_mirrored():
    rng, cam = np.random.default_rng(12), camera(64, 48)
    pokes = np.column_stack([rng.uniform(-0.2, 0.2, (50, 2)), rng.uniform(-3, 3, 50)])
    for (rows, columns), (other_rows, other) in zip(windows(pokes, cam),
                                                    windows(pokes * [-1, 1, -1] + [0, 0, np.pi], cam)):
        assert rows == other_rows and (columns.start, columns.stop) == (64 - other.stop, 64 - other.start)


def test_most_changed_finds_the_moved_points_and_ignores_missing_depth(monkeypatch):
    monkeypatch.setattr(networks, "CHANGED_POINTS", 5)
    rng = np.random.default_rng(9)
    points, valid, _ = scene(rng)
    next_points = points + 1e-4
    moved = np.array([3, 8, 20, 21, 39])
    next_points[:, moved] += rng.uniform(0.02, 0.05, (2, 5, 3))
    next_points[:, 0] += 1.0
    valid[:, 0] = False
    before, after, weights = most_changed(points, next_points, valid)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    for b in range(2):
        rows = [np.flatnonzero((points[b] == point).all(axis=1))[0] for point in before[b]]
        np.testing.assert_array_equal(np.sort(rows), moved)
        np.testing.assert_array_equal(after[b], next_points[b, rows])
        lengths = np.linalg.norm(after[b] - before[b], axis=1)
        np.testing.assert_allclose(weights[b], lengths ** 4 / (lengths ** 4).sum())


def test_poke_frame_against_hand_values():
    pokes = np.array([[0.1, 0.2, np.pi / 2]])  # pushing along the arena's y
    points = np.array([[[0.1, 0.2, 0.03], [0.1, 0.1, 0.0], [0.0, 0.2, 0.0]]])
    expected = [[0, 0, 0.03], [-0.1, 0, 0], [0, 0.1, 0]]
    np.testing.assert_allclose(poke_frame(points, pokes)[0], expected, atol=1e-12)
    axes, origins = poke_axes(pokes)
    np.testing.assert_allclose(np.array(expected) @ axes[0].T + origins[0], points[0], atol=1e-12)


def test_fourier_against_numpy():
    x = np.array([[0.03, -0.11]])
    found = fourier(x, (0.4, 0.1))
    assert found.shape == (1, 8)
    expected = [f(2 * np.pi * v / w) for f in (np.sin, np.cos) for v in x[0] for w in (0.4, 0.1)]
    np.testing.assert_allclose(found[0], expected)


@pytest.mark.parametrize("features, unit", [(encoder_features, 0.25), (poke_features, 0.1)])
def test_position_features_tell_the_table_from_what_stands_on_it(features, unit):
    points = np.array([[0.05, -0.02, 0.0], [0.05, -0.02, 0.01]], np.float32)
    found = features(points)
    assert found.shape == (2, 20) and found.dtype == np.float32
    np.testing.assert_allclose(found[:, :3], points / unit, rtol=1e-6)
    np.testing.assert_allclose(found[:, 3], [0, np.tanh(1.0)], rtol=1e-6)
    np.testing.assert_array_equal(found[0, 4:], found[1, 4:])  # the waves are of x and y alone


def test_height_map_against_a_loop_over_points():
    rng = np.random.default_rng(10)
    local = rng.uniform(-0.18, 0.18, (2, 200, 3))
    valid = rng.random((2, 200)) < 0.8
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


def test_pooling_weights_look_at_the_target_along_the_path_and_at_the_first_contact():
    local = np.array([[[0, 0, 0.03], [-0.1, 0, 0.03], [0.1, 0.1, 0.03], [0, 0, 0.0]]])
    valid = np.ones((1, 4), bool)
    near, path, first = pooling_weights(local, valid, contact(local, valid)[1])[0]
    assert near[0] > 0.9 and near[3] == 0  # the last lies on the table
    np.testing.assert_allclose(path[:2], 0.5, atol=1e-3)
    assert path[2] == 0
    np.testing.assert_allclose(first, [0, 1, 0, 0], atol=1e-5)  # the finger comes from negative x


def test_contact_against_a_disc_that_pushes_points():
    rng, step = np.random.default_rng(13), 2e-5
    local = np.column_stack([rng.uniform(-0.15, 0.05, 60), rng.uniform(-0.02, 0.02, 60), rng.uniform(0, 0.05, 60)])
    valid, x = rng.random(60) < 0.9, local[:, 0].copy()
    standing = valid & (local[:, 2] > 0.005)
    for centre in np.arange(-0.2, 0, step):  # what the disc reaches goes ahead of it
        x[np.hypot(x - centre, local[:, 1]) < networks.REACH] += step
    depth = (x - local[:, 0]) * standing
    features, weights = (value[0] for value in contact(local[None], valid[None]))
    assert (depth > 1e-3).sum() > 15 and (standing & (depth == 0)).sum() > 5
    np.testing.assert_allclose(0.05 * features[:, 0], depth, atol=1e-4)
    np.testing.assert_allclose(0.05 * features[:, 2], depth.max() - depth, atol=1e-4)
    np.testing.assert_allclose(features[:, 1], np.sqrt(np.maximum(0, 1 - (local[:, 1] / networks.REACH) ** 2)))
    assert weights.argmax() == (np.exp(depth / 0.004) * features[:, 1] * (depth > 0)).argmax()
    assert (weights > 0).sum() == (depth > 1e-3).sum() and 0.2 < weights.max() <= 1


def test_contact_is_blind_to_what_is_not_met():
    local = np.array([[[-0.05, 0.03, 0.02], [0.03, 0, 0.02], [-0.05, 0, 0.001], [-0.2, 0, 0.02]]], np.float32)
    features, weights = contact(local, np.ones((1, 4), bool))  # beside the way, beyond it, on the table, behind it
    assert not features[..., 0].any() and not weights.any() and features.dtype == weights.dtype == np.float32


def test_standing_out_takes_the_most_prominent_points(monkeypatch):
    monkeypatch.setattr(networks, "LOOK", 7)
    prominence = np.random.default_rng(14).standard_normal((3, 20)).astype(np.float32)
    for rows, row in zip(standing_out(prominence), prominence):
        np.testing.assert_array_equal(rows, np.sort(np.argsort(row)[-7:]))
    np.testing.assert_array_equal(standing_out(prominence[:, :4]), np.tile(np.arange(4), (3, 1)))  # all there are
    tied = np.float32([[0, 2, 0, 0, 1, 0, 0, 3, 0, 0, 0]])
    np.testing.assert_array_equal(standing_out(tied), [[0, 1, 2, 3, 4, 5, 7]])  # of equals the first


@pytest.mark.parametrize("name, value", [("masks", 1), ("width", 0), ("head", 0), ("rounds", 0), ("embedding", 0),
                                         ("inverse", 0)])
def test_impossible_sizes(name, value):
    with pytest.raises(ValueError, match=name):
        Sizes(**{name: value})
