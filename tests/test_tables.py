"""The paper's tables: which runs they need, that these go on where they were, and what is made of their figures."""
import importlib.util
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import ttest_rel
from test_se3nets import moved_blocks
from tiny import TINY, camera, tiny_pokes

from hind4sight_min import training
from hind4sight_min.disk import checkpoints
from hind4sight_min.lab import control, evaluation, runs, se3nets, tables
from hind4sight_min.lab.tables import MODELS, Cell, Scale
from hind4sight_min.sim.objects import HELD_OUT

spec = importlib.util.spec_from_file_location("results", Path(__file__).resolve().parents[1] / "docs" / "results.py")
results = importlib.util.module_from_spec(spec)
spec.loader.exec_module(results)
TINY_SCALE = Scale(train_pokes=7, test_pokes=7, steps=3, long_steps=4, seeds=(1, 2))


@pytest.fixture
def small_world(monkeypatch):
    """Seven pokes of a block in place of simulated ones, and networks of a few units -> the folders asked for."""
    asked = []
    monkeypatch.setattr(tables, "_data", lambda folder, *_: asked.append(folder.name) or moved_blocks())
    full = tables.recipe_of
    monkeypatch.setattr(tables, "recipe_of", lambda *given: replace(full(*given), sizes=TINY.sizes, batch=4))
    return asked


# --- which runs -------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("model", MODELS)
def test_every_model_is_trained_with_its_own_terms_for_the_same_budget(model):
    recipe = tables.recipe_of(Cell(model, "noisy", 3), tables.FULL)
    assert (recipe.steps, recipe.seed) == (tables.FULL.steps, 3)
    assert tables.recipe_of(Cell(model, "noisy", 3, long=True), tables.FULL).steps == tables.FULL.long_steps
    geometry, picture = {"chamfer", "distance_smoothness"}, {"photometric", "flow_smoothness"}
    terms = {"2d": picture, "3d": geometry, "2d_3d": geometry | picture,
             "full": geometry | picture | {"inverse", "binary_masks"}}
    assert {name for name, weight in recipe.weights.items() if weight} == terms.get(model, {"association"})
    clean, noisy = (tables.objective_of(Cell(model, noise, 3)) for noise in ("clean", "noisy"))
    if model in terms:
        assert clean is training.unsupervised and noisy.keywords == {"standard_deviation": 0.01}
    else:
        window = {"se3nets_0": 1, "se3nets_9": 9, "se3nets_11": 11, "se3nets_3": 3}[model]
        assert clean.func is noisy.func is se3nets.supervised
        assert clean.keywords == {"window": window, "depth_noise": 0.0}
        assert noisy.keywords == {"window": window, "depth_noise": 0.01}


def test_no_test_shares_a_seed_with_another_and_only_unseen_has_what_was_held_out(tmp_path, monkeypatch):
    pytest.importorskip("pybullet")
    calls = {}
    monkeypatch.setattr(tables, "collect", lambda folder, *given: calls.update({folder.name: given}))
    tables.collect_data(tmp_path, tables.FULL)
    pokes = {"train": 48000, "test": 1000, "unseen": 4000, "known": 4000, "all_over": 1000, "crowded": 1000}
    assert {name: call[0] for name, call in calls.items()} == pokes
    assert len({call[1] for call in calls.values()}) == len(calls), "two of them have the same seed"
    for kind in ("kinds", "textures"):
        drawn = {name: set(getattr(call[2], kind)) for name, call in calls.items()}
        assert drawn["unseen"] == set(HELD_OUT[kind]) and not drawn["train"] & drawn["unseen"]
        assert drawn["test"] == drawn["known"] <= drawn["train"] == drawn["all_over"]


# --- runs that go on ----------------------------------------------------------------------------------------------

def test_a_cell_goes_on_where_it_was_and_is_run_once(tmp_path, small_world, monkeypatch):
    cell = Cell("full", "clean", 1, long=True)
    whole = tables.run_cell(cell, tmp_path / "whole", TINY_SCALE)
    assert whole["train_seconds"] > 0 and "unseen_flow_mse_ratio" in whole
    assert small_world == ["train", *tables.TESTS], "trained on the one, evaluated on the others"
    save, parts = runs.save_run, tmp_path / "parts" / "cells"

    def stop_at_two(path, run):
        save(path, run)
        if run.step == 2:
            raise KeyboardInterrupt
    monkeypatch.setattr(runs, "save_run", stop_at_two)
    with pytest.raises(KeyboardInterrupt):
        tables.run_cell(cell, tmp_path / "parts", TINY_SCALE, save_every=0.0)
    assert checkpoints.load_run(parts / "full_clean_long-1.npz").step == 2
    monkeypatch.setattr(runs, "save_run", save)
    again = tables.run_cell(cell, tmp_path / "parts", TINY_SCALE)
    assert {**again, "train_seconds": 0} == {**whole, "train_seconds": 0}
    monkeypatch.setattr(tables, "train_saving", None)  # what is done is not done again
    assert tables.run_cell(cell, tmp_path / "parts", TINY_SCALE) == again
    assert json.loads((parts / "full_clean_long-1.json").read_text())["commit"] == tables.commit()


def test_a_cell_of_another_recipe_is_neither_taken_nor_gone_on_with(tmp_path, small_world):
    cell = Cell("2d_3d", "clean", 1)
    tables.run_cell(cell, tmp_path, TINY_SCALE)
    for said in ("2d_3d_clean-1.json: made with another", "2d_3d_clean-1.npz: made with another"):
        with pytest.raises(ValueError, match=said):
            tables.run_cell(cell, tmp_path, replace(TINY_SCALE, steps=5))
        (tmp_path / "cells" / "2d_3d_clean-1.json").unlink(missing_ok=True)


@pytest.mark.parametrize("model", ["full", "se3nets_3"])
def test_a_cell_is_trained_and_evaluated_under_its_noise(model, tmp_path, small_world, monkeypatch):
    told, trained = [], []
    monkeypatch.setattr(evaluation, "evaluate", lambda *_, depth_noise=0.0, **data: told.append(depth_noise) or {})
    for noise in ("clean", "noisy"):
        tables.run_cell(Cell(model, noise, 1), tmp_path, TINY_SCALE)
        trained.append(checkpoints.load_run(tmp_path / "cells" / f"{model}_{noise}-1.npz"))
    assert told == [run.meta["depth_noise"] for run in trained] == [0.0, 0.01]
    assert not np.array_equal(trained[0].vector, trained[1].vector)


def test_all_together(tmp_path, small_world, monkeypatch, capsys):
    monkeypatch.setattr(tables, "collect_data", lambda *_: None)
    figures = tables.reproduce(["optical-flow"], tmp_path, TINY_SCALE)
    assert "1 of 4: full_clean_long, seed 1: ratio" in capsys.readouterr().out
    assert figures["farneback_optical_epe_px"] > 0
    assert "| full model, trained long | depth and poke |" in tables.tables_text(["optical-flow"], figures)


# --- figures and tables -------------------------------------------------------------------------------------------

METRICS = ("flow_mse_cm2", "flow_mse_ratio", "flow_epe_cm", "no_motion_epe_cm", "optical_epe_px", "optical_epe_all_px",
           "no_motion_optical_epe_px", "no_motion_optical_epe_all_px", "inverse_target_cm", "train_seconds")


@pytest.fixture
def figures():
    """The full model best, then 2D + 3D, then the others; two seeds apart by 0.1, noise by 0.5; every metric as many
    times that as its place in METRICS, so that none is taken for another.
    """
    base = {"full": 1.0, "2d_3d": 2.0, "3d": 3.0, "2d": 4.0, "se3nets_0": 0.5, "se3nets_9": 5.0, "se3nets_11": 6.0,
            "se3nets_3": 1.5}
    found = {}
    for cell in tables.cells_of_tables(list(tables.TABLES), TINY_SCALE):
        value = base[cell.model] + 0.1 * (cell.seed - 1) + (0.5 if cell.noise == "noisy" else 0) - 0.4 * cell.long
        found[cell] = {name: (i + 1) * value for i, name in enumerate(METRICS)}
        if cell.long and cell.noise == "clean":
            found[cell].update(unseen_flow_mse_ratio=4 * value, unseen_mask_iou=value, unseen_pokes=4000, pokes=1000,
                               unseen_multi_flow_mse_ratio=5 * value, unseen_wall_flow_mse_ratio=6 * value,
                               unseen_inverse_direction_deg=8 * value)
    return {**tables.summarise(found, TINY_SCALE), "dis_optical_epe_px": 3.0, "dis_optical_epe_all_px": 5.0,
            "farneback_optical_epe_px": 4.0, "farneback_optical_epe_all_px": 2.0}


def test_summary_is_mean_and_sd_over_the_seeds(figures):
    assert figures["2d_noisy_flow_mse_cm2"] == pytest.approx(4.55)
    assert figures["2d_noisy_flow_mse_cm2_sd"] == pytest.approx(0.1 / np.sqrt(2)), "SD of a sample, n - 1"
    assert figures["full_clean_long_flow_mse_ratio"] == pytest.approx(2 * 0.65)
    assert figures["full_noisy_flow_mse_ratio"] == pytest.approx(2 * 1.55)
    assert figures["seeds"] == TINY_SCALE.seeds and figures["steps"] == TINY_SCALE.steps


def test_the_order_of_the_ablation_is_told_by_differences_within_a_seed():
    ratios = {"2d": (0.30, 0.34, 0.35), "2d_3d": (0.20, 0.23, 0.22), "full": (0.19, 0.23, 0.24), "3d": (0.4, 0.5, 0.6)}
    found = tables.summarise({Cell(model, noise, seed): {"flow_mse_ratio": value} for model, values in ratios.items()
                              for noise in tables.NOISES for seed, value in enumerate(values)}, TINY_SCALE)
    assert found["2d_less_2d_3d_clean"] == pytest.approx((0.10 + 0.11 + 0.13) / 3)
    interval = ttest_rel(ratios["2d"], ratios["2d_3d"]).confidence_interval(0.95)
    assert found["2d_less_2d_3d_noisy_ci95"] == pytest.approx((interval.high - interval.low) / 2), "not paired by seed?"
    row = f"| 2D loss + 3D loss less full model | clean | 0.004 | 0.040, 0.039 | -0.003 \u00b1 {0.0379:.3f} |"
    assert row in tables.order_table(found).splitlines()


def test_the_papers_claims_by_hand(figures):
    claims = results.claims(figures)
    for name, value in {"flow_epe_ratio": 3 / 4, "unseen_over_seen": 2, "noisy_over_se3nets_da11": 1.55 / 6.55,
                        "noisy_over_se3nets_da11_scaled": 1.55 / 2.05, "ablation_order_holds": 1,
                        "inverse_target_cells": 9 * 0.65 / 2.5, "train_minutes": 10 * 0.65 / 60,
                        "optical_epe_over_best_peer_moving": 5 * 0.65 / 3,
                        "optical_epe_over_best_peer_all": 6 * 0.65 / 2}.items():
        assert claims[name] == pytest.approx(value), name


@pytest.mark.parametrize("means, deviations, holds", [
    ((1, 2, 3, 4), (0.1, 0.1, 0.1, 0.1), True), ((1, 2, 3, 4), (0.1, 1.5, 0.1, 0.1), False),
    ((1, 2, 1.5, 4), (0.1, 0.1, 0.1, 0.1), False), ((1, 2, 3, 1.5), (0.1, 0.1, 0.1, 0.1), False)])
def test_the_order_of_the_ablation(means, deviations, holds):
    found = {}
    for model, mean, deviation in zip(("full", "2d_3d", "3d", "2d"), means, deviations):
        found[f"{model}_clean_flow_mse_cm2"], found[f"{model}_clean_flow_mse_cm2_sd"] = mean, deviation
    assert results.order_holds(found, "clean") == holds


def test_tables_show_ours_beside_the_papers(figures):
    text = tables.tables_text(list(tables.TABLES), figures)
    row = next(line for line in text.splitlines() if line.startswith("| 2D loss + 3D loss"))
    assert row.split(" | ")[1:] == [f"{1.52 / 12.6:.3f}", "4.100 \u00b1 0.141", f"{1.78 / 12.6:.3f}",
                                    "5.100 \u00b1 0.141", "2.05 \u00b1 0.07", "2.55 \u00b1 0.07 |"]
    assert "| dis (FlowNet 2.0 in the paper) | both pictures | 0.11 | 3.00 | 5.0000 |" in text
    row = next(line for line in text.splitlines() if line.startswith("| the same, of kinds and textures never"))
    assert row.split(" | ")[1:] == ["4,000", "2.600 \u00b1 0.283", "3.250 \u00b1 0.354", "3.900 \u00b1 0.424",
                                    "0.65 \u00b1 0.07", "5.2 \u00b1 0.6 |"]
    assert "| 3 or 4 objects in the middle | 1,000 | " in text, "a row for pokes that were met"
    assert "6 or 7 objects" not in text, "a row for pokes that were not met"
    assert "| full model |" in tables.tables_text(list(tables.TABLES), results.recorded("reproduce"))
    assert "| learned model, up to three pokes ahead |" in tables.planning_table(results.recorded("planning"))


# --- the control experiment ---------------------------------------------------------------------------------------

def record(distance):
    """A record in which object 1 is to move, goes a long way, and another one is moved by 3 cm for a while."""
    poses = np.zeros((len(distance), 7, 7))
    poses[1:, 1, 0], poses[1:-1, 2, 1] = 0.2, 0.03
    return {"poses": poses, "distance": np.array(distance)[:, None], "movers": np.array([1]), "pokes": np.zeros((2, 3)),
            "angle": np.radians([[np.nan, 40.0]] + [[np.nan, 10.0]] * (len(distance) - 1)), "stopped": "no room"}


def test_the_outcome_of_a_run_by_hand():
    found = tables.outcome(record([0.12, 0.02, 0.05]))
    assert found["distance_m"] == pytest.approx([0.12, 0.02] + [0.05] * 9), "the present distance, not the best so far"
    assert found["others_shifted_m"] == pytest.approx(0.03), "of what was not to be moved, at its farthest"
    np.testing.assert_allclose(found["angles_deg"], [[40], [10]])
    assert found["stopped"] == "no room"


def test_scenes_are_run_once_with_random_numbers_of_their_own(tmp_path, monkeypatch):
    pytest.importorskip("pybullet")
    data = tiny_pokes(count=2, cam=camera(64, 48, 77.0))  # tasks are in pictures of the checkpoint's size
    checkpoints.save_run(tmp_path / "run.npz", training.start_run(TINY, data))
    asked = []
    monkeypatch.setattr(control, "closed_loop", lambda task, run, policy, search, budget, seed, ahead: asked.append(
        (policy, search, seed, ahead)) or record([0.1, len(asked) / 100, 0.05]))
    run_scene = partial(tables.run_scene, tmp_path / "run.npz", tmp_path)
    for given in (("pixels", 1, 0), ("greedy", 0, 0, 1), ("one_poke", 0, 1, 1)):
        first = run_scene(*given)
        assert run_scene(*given) == first
    assert [policy for policy, *_ in asked] == ["learned", "greedy", "learned"]
    assert [search.chamfer_weight for _, search, *_ in asked] == [0, 1, 1]
    assert [ahead for *_, ahead in asked] == [3, 1, 1]
    assert len({tuple(np.random.default_rng(seed).random(3)) for *_, seed, _ in asked}) == 3, "all tries are the same"
    others = {"pixels": (*tables.PLANNERS["pixels"][:3], 1)}
    for module, name, value in ((control, "GAIN", 0.5), (tables, "PLANNERS", others)):
        with monkeypatch.context() as patch, pytest.raises(ValueError, match="made with another"):
            patch.setattr(module, name, value)
            run_scene("pixels", 1, 0)
    checkpoints.save_run(tmp_path / "run.npz", training.start_run(replace(TINY, seed=4), data))
    with pytest.raises(ValueError, match="made with another"):
        run_scene("pixels", 1, 0)


def test_the_experiment_asks_for_every_scene_and_every_try(tmp_path, monkeypatch):
    def map(function, *tasks):
        tasks = list(zip(*tasks))
        assert len(set(tasks)) == len(tasks) == 7 * 3 * 6 + 2 * 3 * 5
        assert {task[2] for task in tasks if task[1]} == {0, 1, 2, 3, 4, 6}, "not the seed of the training pokes"
        return [tables.outcome(record([0.1, 0.05])) for task in tasks]
    figures, curves = tables.reproduce_planning(tmp_path, "run.npz", 6, map)
    assert curves["oracle", 3].shape == (6, 11) and figures["learned_1_left"] == pytest.approx(0.5)


def test_summary_of_the_control_experiment_by_hand():
    found = {}
    for planner in tables.PLANNERS:
        for movers in tables.OBJECTS:
            end = {"learned": 0.04, "one_poke": 0.03, "oracle": 0.02}.get(planner, 0.2)
            for seed, curve in enumerate(np.linspace([0.1, 0.3], [end, end / 2], tables.POKES + 1).T):
                found[planner, movers, seed, 0] = {"distance_m": curve, "angles_deg": [
                    [[10.0, 20.0], [60.0]][seed], [[4.0, 8.0], [30.0]][seed]]}
    for planner, shifts in (("learned", (0.0, 0.005, 0.05)), ("greedy", (0.02, 0.03, 0.0))):
        for seed, shift in enumerate(shifts):
            found[planner, 0, seed, 0] = {"others_shifted_m": shift}
    figures, curves = tables.summarise_planning(found)
    assert curves["learned", 1].shape == (2, 11)
    for name, value in {"learned_2_left": 0.06 / 0.4, "learned_2_left_sd": (0.4 - 0.02 / 0.3) / np.sqrt(2),
                        "learned_2_worst": 0.4, "plan_worst_scene": 0.4,
                        "plan_over_oracle": 1.5, "learned_1_angle_start_deg": 20, "learned_1_angle_deg": 8,
                        "learned_obstacle_avoided": 2 / 3, "greedy_obstacle_avoided": 1 / 3,
                        "greedy_obstacle_shift_cm": 5 / 3}.items():
        assert figures[name] == pytest.approx(value), name
    assert "20\u00b0 -> 8\u00b0" in tables.planning_table(figures)
    alone, _ = tables.summarise_planning({key: each for key, each in found.items() if key[0] in ("learned", "greedy")})
    parts = "learned", "greedy", "plan_worst"
    assert alone == {name: value for name, value in figures.items() if name.startswith(parts)}
    assert tables.planning_table(alone).count("\n") == 2, "a row for a planner that was not run"
