import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_training import SETTINGS, TINY, pokes_seen, random_run

from hind4sight_min import evaluation
from hind4sight_min.geometry import project, unproject
from hind4sight_min.interactions import Truth, cell_centres, cells_of
from hind4sight_min.networks import Prediction, windows
from hind4sight_min.training import make_batch, run_forward_model, start_run


def shifted_block(data, shift):
    """A truth in which a 3 x 4 block of pixels of every picture moves by `shift`, and another block stays."""
    count = len(data)
    labels = np.zeros((count, 12, 16), np.uint8)
    labels[:, 3:6, 4:8], labels[:, 8:10, 10:13] = 1, 2
    before = np.zeros((count, 7, 7), np.float32)
    before[..., 6] = 1
    after = before.copy()
    after[:, 0, :3] += shift
    return Truth(labels, before, after)


def oracle(monkeypatch, data, truth, share, drift=0.0):
    """Make `predict` return `share` of the true motion, `drift` (m) on still points, and perfect heat-maps."""
    def predict(run, interactions, rows, depth_noise=0.0):
        batch = make_batch(interactions, rows, whole=True)
        moves = np.zeros_like(batch.points) + np.float32(drift) * np.array([1, 0, 0], np.float32)
        masks = np.zeros(batch.points.shape[:2] + (3,))
        masks[..., 0] = 0.5
        for i, row in enumerate(rows):
            labels = truth.labels[row].ravel()
            moves[i, labels == 1] = share * (truth.poses_after[row, 0, :3] - truth.poses_before[row, 0, :3])
            masks[i, labels == 1, 2] = 0.9  # mask 2 lies on object 1
        points = batch.points + moves
        flow = evaluation.optical_flow(batch.points, points, interactions.camera).reshape(len(rows), 12, 16, 2)
        end, start = np.zeros((2, len(rows), 400))
        end[np.arange(len(rows)), batch.end_cells] = 1
        start[np.arange(len(rows)), batch.start_cells] = 1
        return batch, Prediction(points, masks, None, None), flow, start, end
    monkeypatch.setattr(evaluation, "predict", predict)


def metrics(monkeypatch, share, drift=0.0, shift=(0.03, 0.04, 0.0)):
    data = pokes_seen()
    truth = shifted_block(data, shift)
    oracle(monkeypatch, data, truth, share, drift)
    return evaluation.evaluate(start_run(TINY, data), data, truth)


def test_the_true_flow_scores_zero(monkeypatch):
    found = metrics(monkeypatch, share=1.0)
    for name in ("flow_mse_ratio", "flow_epe_cm", "still_epe_cm", "all_epe_cm", "optical_epe_px", "optical_epe_all_px"):
        assert found[name] == pytest.approx(0, abs=1e-4), name
    assert found["mask_iou"] == 1.0


def test_half_the_true_flow_against_hand_values(monkeypatch):
    found = metrics(monkeypatch, share=0.5, drift=0.002)  # the block moves by exactly 5 cm
    expected = {"flow_mse_ratio": 0.25, "flow_mse_cm2": 6.25, "flow_rmse_cm": 2.5, "flow_epe_cm": 2.5,
                "no_motion_mse_cm2": 25.0, "no_motion_rmse_cm": 5.0, "no_motion_epe_cm": 5.0, "still_epe_cm": 0.2,
                "all_epe_cm": (12 * 2.5 + 180 * 0.2) / 192, "pokes": 7, "pokes_moved": 7}
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-4), name
    assert 0.4 * found["no_motion_optical_epe_px"] < found["optical_epe_px"] < 0.6 * found["no_motion_optical_epe_px"]


def test_no_motion_is_its_own_baseline(monkeypatch):
    found = metrics(monkeypatch, share=0.0)
    assert found["flow_mse_ratio"] == pytest.approx(1)
    assert found["flow_epe_cm"] == pytest.approx(found["no_motion_epe_cm"])
    assert found["optical_epe_px"] == pytest.approx(found["no_motion_optical_epe_px"]) and found["optical_epe_px"] > 0.5


def test_an_interaction_without_motion_has_no_say_in_the_moving_metrics(monkeypatch):
    data = pokes_seen()
    truth = shifted_block(data, (0.03, 0.04, 0.0))
    truth.poses_after[3:] = truth.poses_before[3:]
    oracle(monkeypatch, data, truth, 0.5)
    found = evaluation.evaluate(start_run(TINY, data), data, truth)
    assert found["flow_mse_ratio"] == pytest.approx(0.25) and found["pokes_moved"] == 3
    truth.poses_after[:] = truth.poses_before
    with pytest.raises(ValueError, match="nothing moved"):
        evaluation.evaluate(start_run(TINY, data), data, truth)


def test_missing_depth_is_not_scored(monkeypatch):
    data = pokes_seen()
    truth = shifted_block(data, (0.03, 0.04, 0.0))
    data.depth_before[:, 3:6, 4:6] = 0  # half of the moving block
    oracle(monkeypatch, data, truth, 0.5)
    found = evaluation.evaluate(start_run(TINY, data), data, truth)
    assert found["flow_mse_ratio"] == pytest.approx(0.25, rel=1e-4)
    assert found["all_epe_cm"] == pytest.approx(6 * 2.5 / 186, rel=1e-4)


def test_the_ratio_is_pooled_over_all_moving_points(monkeypatch):
    data = pokes_seen()
    told, truth = (shifted_block(data, (0.03, 0.04, 0.0)) for _ in range(2))
    truth.poses_after[3:, 0, :3] *= 2  # four pokes move by 10 cm, of which 5 are foreseen
    oracle(monkeypatch, data, told, 1.0)
    found = evaluation.evaluate(start_run(TINY, data), data, truth)
    assert found["flow_mse_ratio"] == pytest.approx(4 * 25 / (3 * 25 + 4 * 100), rel=1e-4)


def test_standard_error_of_the_ratio_against_pokes_drawn_again(monkeypatch):
    data, rng = pokes_seen(), np.random.default_rng(3)
    data = data[np.arange(200) % 7]
    told, truth = (shifted_block(data, (0.03, 0.04, 0.0)) for _ in range(2))
    squared, motion = rng.uniform(0, 0.4, 200) ** 2, rng.uniform(0.5, 1.5, 200) ** 2  # in units of the block's 5 cm
    truth.poses_after[:, 0, :3] *= np.sqrt(motion)[:, None]
    told.poses_after[:, 0, :3] *= (np.sqrt(motion) + np.sqrt(squared))[:, None]
    oracle(monkeypatch, data, told, 1.0)
    found = evaluation.evaluate(start_run(TINY, data), data, truth)
    assert found["flow_mse_ratio"] == pytest.approx(squared.sum() / motion.sum(), rel=1e-3)
    drawn = rng.integers(200, size=(4000, 200))
    again = (squared[drawn].sum(axis=1) / motion[drawn].sum(axis=1)).std()
    assert found["flow_mse_ratio_se"] == pytest.approx(again, rel=0.05) and again > 1e-3


def test_optical_error_of_all_pixels_is_over_those_with_depth(monkeypatch):
    data, drift = pokes_seen(), 0.002
    truth = shifted_block(data, (0.03, 0.04, 0.0))
    data.depth_before[:, 8:, 12:] = 0
    oracle(monkeypatch, data, truth, 1.0, drift)
    found = evaluation.evaluate(start_run(TINY, data), data, truth)
    total = count = 0
    for row in range(7):
        points = unproject(data.depth_before[row], data.camera)
        error = np.linalg.norm(project(points + np.float32([drift, 0, 0]), data.camera) - project(points, data.camera),
                               axis=2)
        valid = data.depth_before[row] > 0
        total, count = total + error[valid & (truth.labels[row] != 1)].sum(), count + valid.sum()
    assert found["optical_epe_all_px"] == pytest.approx(total / count, rel=1e-3) and total > 0


def test_errors_of_the_inverse_model_against_cell_centres(monkeypatch):
    data = pokes_seen()
    truth = shifted_block(data, (0.03, 0.04, 0.0))
    oracle(monkeypatch, data, truth, 1.0)
    found = evaluation.evaluate(start_run(TINY, data), data, truth)
    centres = cell_centres(SETTINGS)
    target, start = centres[cells_of(data.pokes[:, :2], SETTINGS)], centres[cells_of(data.starts, SETTINGS)]
    assert found["inverse_target_cm"] == pytest.approx(
        100 * np.median(np.linalg.norm(target - data.pokes[:, :2], axis=1)), rel=1e-4)
    way = target - start
    turn = np.arctan2(way[:, 1], way[:, 0]) - data.pokes[:, 2]
    assert found["inverse_direction_deg"] == pytest.approx(
        np.degrees(np.median(np.abs((turn + np.pi) % (2 * np.pi) - np.pi))), rel=1e-4)
    assert found["inverse_target_cm"] < found["inverse_target_chance_cm"]


def test_depth_noise_is_what_the_model_sees_and_not_what_it_is_measured_by():
    data, run = pokes_seen(), random_run()
    truth = shifted_block(data, (0.03, 0.04, 0.0))
    clean, noisy, again = (evaluation.evaluate(run, data, truth, depth_noise=noise) for noise in (0.0, 0.01, 0.01))
    assert noisy == again and noisy["flow_mse_ratio"] != clean["flow_mse_ratio"]
    assert noisy["no_motion_mse_cm2"] == clean["no_motion_mse_cm2"]


def test_predict_pastes_the_windows_into_the_picture():
    data, run = pokes_seen(), random_run()
    rows = np.array([0, 3, 5])
    whole, prediction, flow, *_ = evaluation.predict(run, data, rows)
    batch = make_batch(data, rows)
    expected, window_flow = run_forward_model(run.params, run.recipe.sizes, batch, data.camera)
    for i, (rows_in, columns_in) in enumerate(windows(data.pokes[rows], data.camera)):
        inside = np.zeros((12, 16), bool)
        inside[rows_in, columns_in] = True
        np.testing.assert_array_equal(flow[i][inside], window_flow[i].reshape(-1, 2))
        assert not flow[i][~inside].any()
        points, masks = prediction.points[i].reshape(12, 16, 3), prediction.masks[i].reshape(12, 16, 3)
        np.testing.assert_array_equal(points[inside], expected.points[i])
        np.testing.assert_array_equal(points[~inside], whole.points[i].reshape(12, 16, 3)[~inside])
        np.testing.assert_array_equal(masks[inside], expected.masks[i])
        np.testing.assert_array_equal(masks[~inside], np.tile([1, 0, 0], (12 * 16 - 6 * 8, 1)))
        assert np.abs(flow[i][inside]).max() > 1e-3


def test_metrics_of_a_real_model_are_finite():
    data = pokes_seen()
    found = evaluation.evaluate(start_run(TINY, data), data, shifted_block(data, (0.03, 0, 0)))
    assert np.isfinite(list(found.values())).all()
    assert found["flow_mse_ratio"] == pytest.approx(1, abs=1e-3)  # untrained: no motion


def test_matched_iou_is_blind_to_the_order_of_masks():
    labels = np.repeat([0, 1, 2, 3], 10)
    masks = np.eye(4)[np.repeat([0, 3, 1, 2], 10)]  # every object has a mask of its own, in another order
    np.testing.assert_array_equal(evaluation.matched_iou(masks, labels, [1, 2, 3]), [1, 1, 1])
    masks[15:20] = [1, 0, 0, 0]  # half of object 1 given to the background
    masks[0:5] = [0, 0, 1, 0]    # object 3's mask spills over
    found = evaluation.matched_iou(masks, labels, [1, 2, 3])
    np.testing.assert_allclose(found, [0.5, 1, 10 / 15])


def test_one_mask_over_two_objects_counts_once():
    labels = np.repeat([0, 1, 2], 10)
    masks = np.eye(2)[np.repeat([0, 1, 1], 10)]
    found = evaluation.matched_iou(masks, labels, [1, 2])
    np.testing.assert_allclose(np.sort(found), [0, 0.5])


def test_poke_from_heatmaps_against_the_poke_that_made_them():
    centres = cell_centres(SETTINGS)
    target, start = np.array([[0.0125, -0.0375]]), np.array([[-0.0875, 0.0625]])
    end_map, start_map = np.zeros((2, 1, 400))
    end_map[0, cells_of(target, SETTINGS)], start_map[0, cells_of(start, SETTINGS)] = 1, 1
    found = evaluation.poke_from_heatmaps(start_map, end_map, SETTINGS)
    np.testing.assert_allclose(found[0], [0.0125, -0.0375, -np.pi / 4], atol=1e-9)
    # A target between two cells, and a second, lower peak far away that does not count.
    beside = cells_of(target + [0.025, 0], SETTINGS)
    between, far = end_map.copy(), cells_of(target + [0.15, 0], SETTINGS)
    between[0, beside], between[0, far] = 0.5, 0.4
    np.testing.assert_allclose(evaluation.poke_from_heatmaps(start_map, between, SETTINGS)[0, :2],
                               target[0] + [0.025 / 3, 0], atol=1e-9)
    # A start map spread evenly to both sides of the line gives the same direction.
    offsets = centres - target
    across = np.abs(np.arctan2(*(offsets @ np.array([[1, 1], [-1, 1]])).T[::-1]))
    spread = ((np.linalg.norm(offsets, axis=1) > 0.1) & (across > 2.5)).astype(float)[None]
    direction = evaluation.poke_from_heatmaps(spread / spread.sum(), end_map, SETTINGS)[0, 2]
    assert abs(direction + np.pi / 4) < np.radians(12)


def test_poke_errors_are_circular():
    a = np.array([[0, 0, 3.1], [0.03, 0.04, 0.0]])
    b = np.array([[0, 0, -3.1], [0, 0, np.pi]])
    distance, angle = evaluation.poke_errors(a, b)
    np.testing.assert_allclose(distance, [0, 0.05])
    np.testing.assert_allclose(angle, [2 * np.pi - 6.2, np.pi])


def test_turned_object_is_scored_point_by_point(monkeypatch):
    # A pure rotation: the centre hardly moves, the rim does. No motion must cost what the rim moves.
    data = pokes_seen()
    truth = shifted_block(data, (0, 0, 0))
    points = make_batch(data, np.array([0]), whole=True).points[0][(truth.labels[0] == 1).ravel()]
    centre = points.mean(axis=0)
    truth.poses_before[:, 0, :3] = truth.poses_after[:, 0, :3] = centre
    turn = Rotation.from_rotvec([0, 0, 0.5])
    truth.poses_after[:, 0, 3:] = turn.as_quat()
    found = evaluation.evaluate(start_run(TINY, data[slice(0, 1)]), data[slice(0, 1)], truth[slice(0, 1)])
    motion = turn.apply(points - centre) + centre - points
    lengths = np.linalg.norm(motion, axis=1)
    assert found["no_motion_rmse_cm"] == pytest.approx(100 * np.sqrt((lengths[lengths > 1e-3] ** 2).mean()), rel=1e-3)
