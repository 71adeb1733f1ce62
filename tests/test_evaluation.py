"""The metrics of Sec. IV-C to IV-F, against hand values."""
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import SETTINGS, TINY, random_run, still_truth, tiny_pokes

from hind4sight_min.geometry import optical_flow, unproject
from hind4sight_min.interactions import cell_centres, cells_of
from hind4sight_min.lab import evaluation
from hind4sight_min.lab.evaluation import (Answer, errors_of_poke, evaluate, matched_iou, poke_errors,
                                           poke_from_heatmaps, ratio_of, summary)
from hind4sight_min.networks import Prediction
from hind4sight_min.training import scenes_of


def shifted_block(count, shift):
    """A truth in which a 3 x 4 block of pixels of every picture moves by `shift`, and another block stays."""
    labels = np.zeros((count, 12, 16), np.uint8)
    labels[:, 3:6, 4:8], labels[:, 8:10, 10:13] = 1, 2
    truth = still_truth(labels)
    truth.poses_after[:, 0, :3] = shift
    return truth


@pytest.fixture
def oracle(monkeypatch):
    """A function that makes `ask` answer with a share of the true motion, a drift in m of all else, and good maps."""
    def answering(truth, share, drift=0.0):
        def ask(run, interactions, row, **faults):
            before, after = scenes_of(interactions[[row]])
            labels = truth.labels[row].ravel()
            moves = np.zeros_like(before.points) + np.float32([drift, 0, 0])
            moves[0, labels == 1] = share * (truth.poses_after[row, 0, :3] - truth.poses_before[row, 0, :3])
            masks = np.zeros((1, 192, 3))
            masks[..., 0] = 0.5
            masks[0, labels == 1, 2] = 0.9  # mask 2 lies on object 1
            flow = optical_flow(before.points, before.points + moves, interactions.camera).reshape(12, 16, 2)
            maps = [np.eye(400)[cells_of(place, SETTINGS)] for place in
                    (interactions.starts[row], interactions.pokes[row, :2])]
            return Answer(before, after, Prediction(before.points + moves, masks, None, None), flow, tuple(maps))
        monkeypatch.setattr(evaluation, "ask", ask)
    return answering


def metrics(oracle, share, drift=0.0, shift=(0.03, 0.04, 0.0), data=None):
    data = tiny_pokes() if data is None else data
    truth = shifted_block(len(data), shift)
    oracle(truth, share, drift)
    return evaluate(None, data, truth)


def test_the_true_flow_scores_zero(oracle):
    found = metrics(oracle, share=1.0)
    for name in ("flow_mse_ratio", "flow_epe_cm", "still_epe_cm", "all_epe_cm", "optical_epe_px", "optical_epe_all_px"):
        assert found[name] == pytest.approx(0, abs=1e-4), name
    assert found["mask_iou"] == 1.0


def test_half_the_true_flow_against_hand_values(oracle):
    found = metrics(oracle, share=0.5, drift=0.002)  # the block moves by exactly 5 cm
    for name, value in dict(flow_mse_ratio=0.25, flow_epe_cm=2.5, flow_mse_cm2=6.25, flow_rmse_cm=2.5,
                            no_motion_epe_cm=5.0, no_motion_mse_cm2=25.0, still_epe_cm=0.2,
                            all_epe_cm=(12 * 2.5 + 180 * 0.2) / 192, pokes=7, pokes_moved=7).items():
        assert found[name] == pytest.approx(value, rel=1e-3), name
    assert found["optical_epe_px"] < found["no_motion_optical_epe_px"] < 2.2 * found["optical_epe_px"]
    still = metrics(oracle, share=0.0)
    for name in ("optical_epe_px", "optical_epe_all_px"):
        assert still[name] == pytest.approx(still[f"no_motion_{name}"])


@pytest.mark.parametrize("shift, moves", [(0.00101, True), (0.00099, False)])
def test_a_point_moves_when_its_motion_is_longer_than_a_millimetre(oracle, shift, moves):
    if moves:
        assert metrics(oracle, 0.0, shift=(shift, 0, 0))["flow_epe_cm"] == pytest.approx(100 * shift, rel=1e-3)
    else:
        with pytest.raises(ValueError, match="interactions: nothing moved in any of them"):
            metrics(oracle, 0.0, shift=(shift, 0, 0))


def test_a_moving_point_without_depth_counts_and_a_still_one_does_not(oracle):
    data = tiny_pokes()
    data.depth_before[:, 3, 4:8] = 0  # a third of the block
    data.depth_before[:, 0, :5] = 0  # and some of the table
    found = metrics(oracle, 0.5, data=data)
    assert found["all_epe_cm"] == pytest.approx(12 * 2.5 / 187, rel=1e-3)
    assert found["no_motion_epe_cm"] == pytest.approx(5.0, rel=1e-3)
    for name in ("optical_epe", "no_motion_optical_epe"):
        assert found[f"{name}_all_px"] == pytest.approx(found[f"{name}_px"] * 12 / 187), name


def test_a_model_that_sees_holes_predicts_no_motion_there(monkeypatch):
    data, run = tiny_pokes(count=1), random_run(TINY)
    data.depth_before[0, 3:5, 4:8] = 0
    truth = shifted_block(1, (0.03, 0.04, 0.0))
    flow, pixels, moving = evaluation.true_motion(data, truth, 0)
    assert moving.sum() == 12 and moving.reshape(12, 16)[3:6, 4:8].all()
    np.testing.assert_allclose(np.linalg.norm(flow[moving], axis=1), 0.05, rtol=1e-4)
    assert (np.linalg.norm(pixels[moving], axis=1) > 0.5).all() and (np.linalg.norm(pixels[moving], axis=1) < 2).all()
    answer = evaluation.ask(run, data, 0)
    there = np.ix_([0], np.flatnonzero(moving)[:8])
    np.testing.assert_array_equal(answer.prediction.points[there], answer.before.points[there])
    assert errors_of_poke(run, data, truth, 0)["squared_error"] >= 8 * 0.05 ** 2 * 0.999


def test_an_object_s_holes_have_its_depth_nearest_by_not_that_of_what_it_hides():
    depth, labels = np.full((5, 6), 0.9), np.zeros((5, 6), int)
    labels[1:4, 1:4], labels[4, 5] = 1, 2
    depth[1:4, 1:4] = [[0.5, 0, 0.7], [0.5, 0.6, 0], [0, 0, 0]]
    depth[4, 5] = depth[0, 0] = 0
    found = evaluation.depth_of_objects(depth, labels)
    assert found[2, 3] in (0.6, 0.7) and found[3, 1] == 0.5 and found[3, 2] == 0.6 and found[1, 2] in (0.5, 0.6, 0.7)
    assert found[0, 0] == 0 and found[4, 5] == 0, "the table's holes stay, and an object without any depth"
    np.testing.assert_array_equal(found[depth > 0], depth[depth > 0])


def test_an_object_that_turned_is_scored_point_by_point(oracle):
    data, truth = tiny_pokes(count=1), shifted_block(1, (0, 0, 0))
    truth.poses_after[0, 0, 3:] = Rotation.from_euler("z", 0.5).as_quat()
    oracle(truth, 0.0)
    points = unproject(data.depth_before[0], data.camera)[truth.labels[0] == 1]
    lengths = np.linalg.norm(points @ Rotation.from_euler("z", 0.5).as_matrix().T - points, axis=1)
    assert np.ptp(lengths) > 0.001
    found, root = evaluate(None, data, truth), np.sqrt(np.mean(lengths ** 2))
    for name, value in (("flow_epe_cm", lengths.mean()), ("flow_rmse_cm", root), ("no_motion_rmse_cm", root)):
        assert found[name] == pytest.approx(100 * value, rel=1e-4), name


def test_errors_of_the_inverse_model_against_cell_centres(oracle):
    data = tiny_pokes()
    found = metrics(oracle, 1.0)
    centres = cell_centres(SETTINGS)
    start, end = (centres[cells_of(place, SETTINGS)] for place in (data.starts, data.pokes[:, :2]))
    away, expected = np.linalg.norm(end - data.pokes[:, :2], axis=1), np.arctan2(*(end - start).T[::-1])
    turn = np.abs((expected - data.pokes[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    assert found["inverse_target_cm"] == pytest.approx(100 * np.median(away), rel=1e-4)
    assert found["inverse_direction_deg"] == pytest.approx(np.degrees(np.median(turn)), rel=1e-4)
    assert found["inverse_target_chance_cm"] > 2 * found["inverse_target_cm"]


def poke(squared, motion, objects=1, at_wall=False):
    """What `errors_of_poke` says, as far as the groups of pokes go."""
    names = ("error", "length", "drift", "optical", "optical_zero", "optical_all", "optical_zero_all")
    return {**dict.fromkeys(names, 1.0), "moving": 5 * objects, "still": 9, "squared_error": squared,
            "squared_motion": motion, "iou": np.full(objects, 0.5), "poke": np.zeros(3), "at_wall": at_wall}


def test_the_ratio_is_pooled_and_reported_apart_for_groups_of_pokes():
    pokes = [poke(1.0, 10.0), poke(4.0, 10.0, at_wall=True), poke(6.0, 20.0, objects=2), poke(0.0, 0.0, objects=0)]
    found = summary(pokes, np.array([[0.01, 0, 0], [0.02, 0, 0], [0.03, 0, 0], [0.2, 0, 0]]), np.arange(4))
    assert found["inverse_target_cm"] == pytest.approx(2), "the last one moved nothing: who could name it?"
    expected = dict(flow_mse_ratio=11 / 40, single_flow_mse_ratio=5 / 20, multi_flow_mse_ratio=6 / 20,
                    wall_flow_mse_ratio=4 / 10, trimmed_flow_mse_ratio=5 / 20, single_pokes=2, multi_pokes=1,
                    wall_pokes=1, pokes=4, pokes_moved=3)
    for name, value in expected.items():
        assert found[name] == pytest.approx(value), name
    alone = summary(pokes[:1], np.zeros((1, 3)), np.arange(1))
    assert not {"multi_flow_mse_ratio", "multi_flow_mse_ratio_se"} & set(alone) and alone["multi_pokes"] == 0


def test_the_standard_error_of_the_ratio_against_scenes_drawn_again():
    rng, scenes = np.random.default_rng(0), np.repeat(np.arange(400), 6)
    motion = rng.gamma(2.0, 1.0, 2400)
    squared = 0.1 * motion * np.repeat(rng.gamma(1.0, 1.0, 400), 6)  # what is hard is hard six times
    ratio, error = ratio_of(squared, motion, scenes)
    by_scene = [values.reshape(400, 6) for values in (squared, motion)]
    again = [by_scene[0][rows].sum() / by_scene[1][rows].sum() for rows in rng.integers(400, size=(2000, 400))]
    assert ratio == pytest.approx(squared.sum() / motion.sum()) and error == pytest.approx(np.std(again), rel=0.06)
    assert error > 1.5 * ratio_of(squared, motion, np.arange(2400))[1]


def test_pokes_share_a_scene_as_long_as_its_objects_lie_where_the_last_one_left_them():
    truth = shifted_block(5, (0.01, 0, 0))
    for i in (1, 2, 4):
        truth.poses_before[i] = truth.poses_after[i - 1]
        truth.poses_after[i] = truth.poses_before[i] + np.float32(0.01)
    np.testing.assert_array_equal(evaluation.scenes_of_pokes(truth), [0, 0, 0, 1, 1])


@pytest.mark.parametrize("shift, at_wall", [((0.0, 0.0, 0.0), False), ((0.05, 0, 0), False), ((0.4, 0, 0), True)])
def test_a_poke_ends_at_a_wall_where_what_it_moved_ends_there(oracle, shift, at_wall):
    data, truth = tiny_pokes(count=1), shifted_block(1, shift)
    oracle(truth, 1.0)
    assert errors_of_poke(None, data, truth, 0)["at_wall"] == at_wall


def test_matched_iou_is_blind_to_the_order_of_masks_and_counts_a_shared_mask_once():
    labels = np.array([0, 0, 1, 1, 1, 2, 2, 0])
    masks = np.eye(4)[[0, 3, 3, 3, 0, 1, 1, 0]]
    np.testing.assert_allclose(matched_iou(masks, labels, [1, 2]), [2 / 4, 1.0])
    np.testing.assert_allclose(matched_iou(masks[:, [0, 3, 2, 1]], labels, [1, 2]), [2 / 4, 1.0])
    both = np.eye(3)[[0, 0, 1, 1, 1, 1, 1, 0]]
    np.testing.assert_allclose(sorted(matched_iou(both, labels, [1, 2])), [0, 3 / 5])


def test_the_poke_named_by_heatmaps_is_the_poke_that_made_them():
    centres, target, angle = cell_centres(SETTINGS), np.array([0.031, -0.052]), 2.5
    start = target - 0.12 * np.array([np.cos(angle), np.sin(angle)])
    maps = [np.exp(-np.sum((centres - place) ** 2, axis=1) / (2 * 0.02 ** 2)) for place in (start, target)]
    found = poke_from_heatmaps(*(each / each.sum() for each in maps), SETTINGS)
    np.testing.assert_allclose(found[:2], target, atol=1e-3)
    assert found[2] == pytest.approx(angle, abs=0.02)
    far = maps[1] + 0.2 * (np.linalg.norm(centres - [-0.2, 0.2], axis=1) < 0.05)  # a second, lower hill far away
    np.testing.assert_allclose(poke_from_heatmaps(maps[0], far, SETTINGS)[:2], target, atol=2e-3)


def test_poke_errors_are_circular():
    away, turn = poke_errors([[0.1, 0.0, 3.1], [0, 0, 0.3]], [[0.1, 0.03, -3.1], [0, 0, -0.2]])
    np.testing.assert_allclose(away, [0.03, 0])
    np.testing.assert_allclose(turn, [2 * np.pi - 6.2, 0.5])


def test_depth_noise_is_what_the_model_sees_its_own_for_every_poke_and_not_what_it_is_measured_by():
    data = tiny_pokes(count=20)
    data = replace(data, **{name: np.repeat(getattr(data, name)[:1], 20, axis=0) for name in
                            ("depth_before", "depth_after", "rgb_before", "rgb_after")})  # twenty times the same
    run, truth = random_run(TINY), shifted_block(20, (0.03, 0.04, 0.0))
    answers = [evaluation.ask(run, data, row, depth_noise=0.01) for row in range(20)]
    pictures = np.stack([scene.points[0] for answer in answers for scene in (answer.before, answer.after)])
    assert len(np.unique(pictures[:, :, 2], axis=0)) == 40, "the same noise for several pictures"
    again = evaluation.ask(run, data, 3, depth_noise=0.01)
    np.testing.assert_array_equal(again.before.points, answers[3].before.points)
    clean, noisy = (evaluate(run, data, truth, depth_noise=sd) for sd in (0.0, 0.01))
    assert noisy["no_motion_mse_cm2"] == clean["no_motion_mse_cm2"] and noisy["all_epe_cm"] != clean["all_epe_cm"]
