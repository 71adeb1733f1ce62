"""The paper's tables in miniature: which runs they need, that runs go on where they were, what is made of them."""
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_evaluation import shifted_block
from test_training import TINY, pokes_seen

from hind4sight_min import evaluation, objects, reproduce, simulator, training
from hind4sight_min.__main__ import main
from hind4sight_min.reproduce import MODELS, Cell, Scale

TIMES = {name: i + 1 for i, name in enumerate(reproduce.METRICS)}  # so that no metric is taken for another
TINY_SCALE = Scale(train_pokes=7, test_pokes=7, steps=3, long_steps=4, seeds=(1, 2))


@pytest.fixture
def small_world(monkeypatch):
    """Seven pokes of a block in place of simulated ones, and networks of a few units."""
    data = pokes_seen()
    truth = shifted_block(data, (0.02, 0.01, 0.0))
    monkeypatch.setattr(reproduce, "_data", lambda folder: (data, truth))
    full = reproduce.recipe_of
    monkeypatch.setattr(reproduce, "recipe_of",
                        lambda cell, scale: replace(full(cell, scale), sizes=TINY.sizes, batch=4))


def test_every_table_asks_for_its_runs_once():
    cells = reproduce.cells_of_tables(["flow", "ablation", "optical-flow"], reproduce.FULL)
    assert len(cells) == len(set(cells)) == 3 * 2 * (len(MODELS) + 1)
    ablation = {cell.model for cell in reproduce.cells_of_tables(["ablation"], reproduce.FULL)}
    assert ablation == {"2d", "3d", "2d_3d", "full"}
    assert all(cell.long for cell in reproduce.cells_of_tables(["optical-flow"], reproduce.FULL))
    assert len({cell.name for cell in cells}) == len(cells)


@pytest.mark.parametrize("model", MODELS)
def test_every_model_has_a_recipe_of_the_same_budget(model):
    recipe = reproduce.recipe_of(Cell(model, "noisy", 3), reproduce.FULL)
    assert (recipe.steps, recipe.seed, recipe.depth_noise) == (reproduce.FULL.steps, 3, 0.01)
    assert recipe.association == {"se3nets_0": 1, "se3nets_9": 9, "se3nets_11": 11, "se3nets_3": 3}.get(model, 0)
    terms = {name for name, weight in recipe.weights.items() if weight}
    geometry, picture = {"chamfer", "distance_smoothness"}, {"photometric", "flow_smoothness"}
    assert recipe.association or "sharing" in terms
    assert terms - {"sharing"} == {"2d": picture, "3d": geometry, "2d_3d": geometry | picture,
                                   "full": geometry | picture | {"inverse"}}.get(model, {"association"})


def test_a_cell_is_run_once_and_goes_on_where_it_was(tmp_path, small_world, monkeypatch):
    cell = Cell("full", "clean", 1, long=True)
    whole = reproduce.run_cell(cell, tmp_path / "whole", TINY_SCALE)
    assert whole["train_seconds"] > 0 and "unseen_flow_mse_ratio" in whole

    class Stop(Exception):
        pass
    step = training.training_step

    def stop_at_two(interactions, run, *rest):
        step(interactions, run, *rest)
        if run.step == 3:
            raise Stop
    monkeypatch.setattr(training, "training_step", stop_at_two)
    with pytest.raises(Stop):
        reproduce.run_cell(cell, tmp_path / "parts", TINY_SCALE, save_every=0.0)
    assert training.load_run(tmp_path / "parts" / "cells" / "full-clean-1-long.npz").step == 2
    monkeypatch.setattr(training, "training_step", step)
    again = reproduce.run_cell(cell, tmp_path / "parts", TINY_SCALE)
    del whole["train_seconds"], again["train_seconds"]
    assert again == whole
    monkeypatch.setattr(training, "train", None)  # what is done is not done again
    found = reproduce.run_cell(cell, tmp_path / "parts", TINY_SCALE)
    assert found["flow_mse_ratio"] == whole["flow_mse_ratio"]


def test_a_run_of_another_recipe_is_not_gone_on_with(tmp_path, small_world):
    cell = Cell("2d_3d", "clean", 1)
    reproduce.run_cell(cell, tmp_path, TINY_SCALE)
    (tmp_path / "cells" / "2d_3d-clean-1.json").unlink()
    with pytest.raises(ValueError, match="another recipe"):
        reproduce.run_cell(cell, tmp_path, replace(TINY_SCALE, steps=5))


def test_the_figures_of_another_recipe_are_not_taken(tmp_path, small_world, monkeypatch):
    cell = Cell("full", "clean", 1)
    found = reproduce.run_cell(cell, tmp_path, TINY_SCALE)
    assert reproduce.run_cell(cell, tmp_path, TINY_SCALE) == found
    file = json.loads((tmp_path / "cells" / "full-clean-1.json").read_text())
    assert file["metrics"] == found and file["commit"] == reproduce.commit()
    with pytest.raises(ValueError, match="full-clean-1.json: made with another recipe"):
        reproduce.run_cell(cell, tmp_path, replace(TINY_SCALE, steps=5))


def test_without_git_a_cell_has_no_commit(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert reproduce.commit.__wrapped__() is None


def test_a_cell_is_evaluated_under_the_noise_it_was_trained_with(tmp_path, small_world, monkeypatch):
    told = []
    monkeypatch.setattr(evaluation, "evaluate", lambda *_, depth_noise=0.0: told.append(depth_noise) or {})
    for noise in ("clean", "noisy"):
        reproduce.run_cell(Cell("full", noise, 1), tmp_path, TINY_SCALE)
    assert told == [0.0, 0.01]


def test_training_test_and_unseen_pokes_are_three_things(tmp_path, monkeypatch):
    calls = {}
    monkeypatch.setattr(simulator, "collect", lambda folder, pokes, seed, settings, *_: calls.update(
        {folder.name: (pokes, seed, settings)}))
    reproduce.collect_data(tmp_path, reproduce.FULL, 1)
    assert {name: call[0] for name, call in calls.items()} == {"train": 24000, "test": 1000, "unseen": 1000}
    assert len({seed for _, seed, _ in calls.values()}) == 3
    for kind in ("kinds", "textures"):
        drawn = {name: set(getattr(settings, kind)) for name, (_, _, settings) in calls.items()}
        assert drawn["unseen"] == set(objects.HELD_OUT[kind])
        assert drawn["train"] == drawn["test"] and not drawn["train"] & drawn["unseen"]


def made_up(scale, full=(1.0, 1.1)):
    """Metrics of every cell: the full model best, then 2D + 3D, then the others; two seeds apart by 0.1 or so; every
    metric as many times that as its place in METRICS, which is 1 for the squared error.
    """
    base = {"full": full[0], "2d_3d": 2.0, "3d": 3.0, "2d": 4.0, "se3nets_0": 0.5, "se3nets_9": 5.0, "se3nets_11": 6.0,
            "se3nets_3": 1.5}
    results = {}
    for cell in reproduce.cells_of_tables(["flow", "ablation"], scale):
        value = base[cell.model] + 0.1 * (cell.seed - 1) + (0.5 if cell.noise == "noisy" else 0) - 0.4 * cell.long
        metrics = {name: times * value for name, times in TIMES.items() if not name.startswith("unseen")}
        if cell.long and cell.noise == "clean":
            metrics.update(unseen_flow_mse_ratio=4 * value, unseen_mask_iou=0.5)
        results[cell] = metrics
    return results


def test_summary_against_hand_values():
    figures = reproduce.summarise(made_up(TINY_SCALE), TINY_SCALE)
    assert figures["2d_noisy_flow_mse_cm2"] == pytest.approx(4.55)
    assert figures["2d_noisy_flow_mse_cm2_sd"] == pytest.approx(0.1 / np.sqrt(2))
    assert figures["flow_mse_ratio_clean"] == pytest.approx(2 * 0.65)
    assert figures["flow_mse_ratio_noisy"] == pytest.approx(2 * 1.15)
    for headline, metric in (("mask_iou", "mask_iou"), ("inverse_direction_deg", "inverse_direction_deg")):
        assert figures[headline] == pytest.approx(TIMES[metric] * 0.65)
    assert figures["train_minutes"] == pytest.approx(TIMES["train_seconds"] * 0.65 / 60)
    assert figures["noisy_over_se3nets_da11"] == pytest.approx(1.55 / 6.55)
    assert figures["noisy_over_se3nets_da11_scaled"] == pytest.approx(1.55 / 2.05)
    assert figures["unseen_over_seen"] == pytest.approx(2)
    assert figures["inverse_target_cells"] == pytest.approx(TIMES["inverse_target_cm"] * 0.65 / 2.5)
    assert figures["ablation_order_holds"] == 1.0
    assert figures["seeds"] == TINY_SCALE.seeds and figures["steps"] == TINY_SCALE.steps
    short, long = 2 * sum([1.0, 2, 3, 4, 0.5, 5, 6, 1.5]) + 8 * 0.5, 0.6 + 1.1
    assert figures["train_core_hours"] == pytest.approx(
        TIMES["train_seconds"] * (2 * (short + long) + 18 * 0.1) / 3600)
    close = reproduce.summarise(made_up(TINY_SCALE, full=(1.95,)), TINY_SCALE)  # better, but within one SD
    assert close["ablation_order_holds"] == 0.0


@pytest.mark.parametrize("means, deviations, holds", [
    ((1, 2, 3, 4), (0.1, 0.1, 0.1, 0.1), True), ((1, 2, 3, 4), (0.1, 1.5, 0.1, 0.1), False),
    ((1, 2, 3, 4), (1.5, 0.1, 0.1, 0.1), False), ((1, 2, 1.5, 4), (0.1, 0.1, 0.1, 0.1), False),
    ((1, 2, 3, 1.5), (0.1, 0.1, 0.1, 0.1), False), ((3, 2, 4, 5), (0.1, 0.1, 0.1, 0.1), False)])
def test_the_order_of_the_ablation(means, deviations, holds):
    figures = {}
    for model, mean, deviation in zip(("full", "2d_3d", "3d", "2d"), means, deviations):
        figures[f"{model}_clean_flow_mse_cm2"], figures[f"{model}_clean_flow_mse_cm2_sd"] = mean, deviation
    assert reproduce.order_holds(figures, "clean") == holds


def test_tables_show_ours_beside_the_papers():
    figures = reproduce.summarise(made_up(TINY_SCALE), TINY_SCALE)
    figures.update(dis_optical_epe_px=3.0, dis_optical_epe_all_px=5.0, farneback_optical_epe_px=4.0,
                   farneback_optical_epe_all_px=2.0)
    figures.update(reproduce.optical_headlines(figures))
    for over, metric, best in (("moving", "optical_epe_px", 3), ("all", "optical_epe_all_px", 2)):
        assert figures[f"optical_epe_over_best_peer_{over}"] == pytest.approx(TIMES[metric] * 0.65 / best)
    text = reproduce.tables_text(list(reproduce.TABLES), figures)
    row = next(line for line in text.splitlines() if line.startswith("| 2D loss + 3D loss"))
    assert row.split(" | ")[1:5] == [f"{1.52 / 12.6:.3f}", "4.100 \u00b1 0.141", f"{1.78 / 12.6:.3f}",
                                     "5.100 \u00b1 0.141"]
    for block in text.split("\n\n"):
        assert len({line.count("|") for line in block.splitlines()}) == 1
    assert "dis (FlowNet 2.0" in text and "full model, trained long" in text


def test_another_scale_in_the_same_folder_is_refused(tmp_path, small_world):
    (tmp_path / "scale.json").write_text(json.dumps({"train_pokes": 1}))
    with pytest.raises(ValueError, match="another scale"):
        reproduce.reproduce(["flow"], tmp_path, TINY_SCALE)


# --- SE3-Nets, the supervised baseline --------------------------------------------------------------------------

def test_exact_targets_are_the_true_motion_also_in_the_mirror():
    data = pokes_seen()
    truth, rows = shifted_block(data, (0.02, 0.01, 0.0)), np.array([0, 3])
    for mirror, shift in ((False, [0.02, 0.01, 0]), (True, [-0.02, 0.01, 0])):
        batch = training.make_batch(data, rows, mirror, whole=True, truth=truth[rows], rng=np.random.default_rng(0))
        motion = (batch.targets - batch.points).reshape(2, 12, 16, 3)
        if mirror:
            motion = motion[:, :, ::-1]
        expected = np.zeros((2, 12, 16, 3))
        expected[:, 3:6, 4:8] = shift  # the block that moves
        np.testing.assert_allclose(motion, expected, atol=1e-6)


def test_association_noise_takes_points_for_others_near_them():
    data = pokes_seen()
    truth, rows = shifted_block(data, (0.02, 0.01, 0.0)), np.array([0, 3])
    exact, noisy = (training.make_batch(data, rows, whole=True, truth=truth[rows], association=window,
                                        rng=np.random.default_rng(0)).targets.reshape(2, 12, 16, 3)
                    for window in (1, 3))
    for b, v, u in np.ndindex(2, 12, 16):
        near = exact[b, max(v - 1, 0):v + 2, max(u - 1, 0):u + 2].reshape(-1, 3)
        assert (near == noisy[b, v, u]).all(axis=1).any()
    assert 0.7 < (noisy != exact).any(axis=3).mean() < 0.95


def test_se3nets_learns_from_the_truth_and_nothing_else_does():
    data = pokes_seen()
    truth = shifted_block(data, (0.02, 0.01, 0.0))
    recipe = replace(TINY, association=1, weights=dict(training.ASSOCIATION_WEIGHTS), steps=60, batch=7, mirror=False,
                     learning_rate=1e-2)
    log = training.train(data, training.start_run(recipe, data), truth=truth).log
    assert log[-1]["association"] < 0.9 * log[0]["association"]
    with pytest.raises(ValueError, match="truth"):
        training.train(data, training.start_run(recipe, data))
    with pytest.raises(ValueError, match="truth"):
        training.train(data, training.start_run(TINY, data), truth=truth)
    for association in (-1, 2):
        with pytest.raises(ValueError, match="association"):
            replace(recipe, association=association)
    with pytest.raises(ValueError, match="weights"):
        replace(TINY, association=1)


# --- optical flow from two pictures -----------------------------------------------------------------------------

@pytest.mark.parametrize("peer", evaluation.PEERS)
def test_image_pair_flow_of_a_shifted_picture(peer):
    rng = np.random.default_rng(0)
    picture = cv2.resize(rng.integers(0, 255, (18, 25, 3), dtype=np.uint8), (70, 50), interpolation=cv2.INTER_CUBIC)
    found = evaluation.image_pair_flow(peer, picture[1:49, 3:67], picture[:48, 1:65])  # moves by (2, 1)
    assert found.shape == (48, 64, 2)
    np.testing.assert_allclose(np.median(found[8:-8, 8:-8], axis=(0, 1)), [2, 1], atol=0.05)


def test_image_pair_errors_against_a_made_up_flow(monkeypatch):
    data = pokes_seen()
    truth = shifted_block(data, (0.03, 0.04, 0.0))
    monkeypatch.setattr(evaluation, "image_pair_flow", lambda peer, before, after: np.zeros((12, 16, 2)))
    found = evaluation.evaluate_image_pairs(data, truth)
    plain = evaluation.evaluate(training.start_run(TINY, data), data, truth)  # untrained: no motion
    for peer in evaluation.PEERS:
        assert found[f"{peer}_optical_epe_px"] == pytest.approx(plain["no_motion_optical_epe_px"], rel=1e-3)
        assert found[f"{peer}_optical_epe_all_px"] == pytest.approx(plain["no_motion_optical_epe_all_px"], rel=1e-3)


def test_the_whole_command_on_next_to_nothing(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pybullet", reason="the simulator needs pybullet")
    monkeypatch.setattr(reproduce, "QUICK", Scale(train_pokes=12, test_pokes=12, steps=1, long_steps=1, seeds=(1, 2)))
    arguments = ["reproduce", "optical-flow", "--quick", "--out", str(tmp_path), "--jobs", "2"]
    assert main(arguments) == 0
    first = capsys.readouterr().out
    assert "4 of 4" in first and "| full model, trained long | depth and poke |" in first
    figures = json.loads((tmp_path / "optical-flow.json").read_text())
    assert figures["full_clean_long_flow_mse_ratio"] == pytest.approx(1, abs=0.1)  # one step: hardly any motion
    assert 0 < figures["optical_epe_over_best_peer_all"] < np.inf
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    assert main(arguments) == 0  # everything is there: nothing is made again
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")} == stamps
    assert json.loads((tmp_path / "optical-flow.json").read_text()) == figures
    assert main(["reproduce", "optical-flow", "--out", str(tmp_path)]) == 2  # of another scale
    assert "another scale" in capsys.readouterr().err
