"""The command as a user meets it: what it prints, what it writes, how it fails."""
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hind4sight_min import __main__ as command
from hind4sight_min import networks, training
from hind4sight_min.__main__ import data_small, main
from hind4sight_min.interactions import load_interactions

ROOT = Path(__file__).resolve().parent.parent
TRAIN = ["--steps", "3", "--batch", "2", "--width", "8", "--jobs", "1"]
needs_bullet = pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="needs pybullet")


def run(*arguments):
    return main([str(a) for a in arguments])


def one_line(capsys, status, *words):
    """The command failed as promised: status 2, one line on stderr with these words, nothing else."""
    out, err = capsys.readouterr()
    assert status == 2
    assert err.count("\n") == 1 and "Traceback" not in err
    for word in words:
        assert word in err, err


def test_train_resume_evaluate_show(tmp_path, capsys):
    model = tmp_path / "model.npz"
    assert run("train", data_small() / "train", model, *TRAIN, "--json", tmp_path / "train.json") == 0
    first = training.load_run(model)
    assert first.step == 3 and (tmp_path / "model.csv").read_text().startswith("epoch,step,learning_rate,chamfer")
    assert json.loads((tmp_path / "train.json").read_text())["loss_step"] == 3
    assert run("train", data_small() / "train", model, "--resume") == 0  # nothing left to do, nothing changed
    np.testing.assert_array_equal(training.load_run(model).vector, first.vector)
    capsys.readouterr()

    assert run("show", model, data_small() / "test", "--row", 5, "--out", tmp_path / "poke.png") == 0
    assert (tmp_path / "poke.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.csv", "model.npz", "model.png", "poke.png",
                                                                  "train.json"]


def test_the_shipped_checkpoint_on_the_shipped_pokes_is_what_the_results_say(tmp_path, capsys):
    assert run("evaluate", "--json", tmp_path / "metrics.json") == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    recorded = json.loads((ROOT / "docs" / "results" / "shipped.json").read_text())["figures"]
    assert set(metrics) == set(recorded)
    for name, value in recorded.items():  # other versions of NumPy and OpenCV round differently
        assert metrics[name] == pytest.approx(value, rel=0.005, abs=0.005), name
    out, err = capsys.readouterr()
    assert err == ""  # no progress line away from a terminal
    assert f"{metrics['flow_mse_ratio']:.3f}" in out and "no motion" in out and "chance" in out
    assert f"standard error {metrics['flow_mse_ratio_se']:.2g}" in out


def test_every_layer_of_the_shipped_checkpoint_is_alive():
    run, data = training.load_run(data_small() / "checkpoint.npz"), load_interactions(data_small() / "test")
    batch, sizes = training.make_batch(data, np.arange(40)), run.recipe.sizes
    _, gradient = training.batch_gradient(run.vector, run.layout, sizes, batch, data.camera, training.WEIGHTS)
    for name, part in training.unflatten(gradient, run.layout).items():
        if name != "heatmaps_b":  # the same for all cells: softmax does not see it
            assert np.abs(part).max() > 1e-6, name
    features = networks.encode(run.params, batch.points[batch.valid])
    assert (features.max(axis=0) > 1e-3).sum() > 0.9 * sizes.embedding  # units die in long runs, if they may
    prediction, _ = training.run_forward_model(run.params, sizes, batch, data.camera)
    predicted, following = training.next_embeddings(run.params, batch, prediction.points)
    state = networks.state_embedding(run.params, batch.points, batch.occupied)
    assert np.abs(predicted - following).sum() < 0.6 * np.abs(state - following).sum()


def test_the_same_seed_writes_the_same_checkpoint(tmp_path):
    runs = []
    for name in ("a", "b"):
        assert run("train", data_small() / "train", tmp_path / f"{name}.npz", *TRAIN) == 0
        runs.append(training.load_run(tmp_path / f"{name}.npz"))
    np.testing.assert_array_equal(runs[0].vector, runs[1].vector)
    assert runs[0].log == runs[1].log
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_training_never_needs_the_truth(tmp_path):
    folder = tmp_path / "pokes"
    folder.mkdir()
    for shard in (data_small() / "train").glob("shard_????.npz"):
        (folder / shard.name).write_bytes(shard.read_bytes())
    assert run("train", folder, tmp_path / "a.npz", *TRAIN) == 0
    assert run("train", data_small() / "train", tmp_path / "b.npz", *TRAIN) == 0
    np.testing.assert_array_equal(training.load_run(tmp_path / "a.npz").vector,
                                  training.load_run(tmp_path / "b.npz").vector)


@needs_bullet
def test_collect_writes_shards_and_figures(tmp_path, capsys):
    assert run("collect", tmp_path / "pokes", "--pokes", 3, "--objects", 1, 2, "--kinds", "cross", "--textures",
               "rings", "--json", tmp_path / "collect.json") == 0
    assert sorted(path.name for path in (tmp_path / "pokes").iterdir()) == ["shard_0000.npz", "shard_0000.truth.npz"]
    figures = json.loads((tmp_path / "collect.json").read_text())
    assert figures["pokes_kept"] == 3 and 0 < figures["collect_share_in_bullet"] <= 1
    assert "3 pokes" in capsys.readouterr().out


@needs_bullet
def test_the_demo_in_small(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "DEMO_POKES", 8)
    monkeypatch.setattr(command, "DEMO_TEST_POKES", 6)
    monkeypatch.setattr(command, "DEMO_RECIPE", training.Recipe(steps=2, batch=4))
    assert run("demo", "--out", tmp_path, "--jobs", 1) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["demo_pokes"] == 6 and metrics["demo_seconds"] > 0
    assert metrics["demo_flow_mse_ratio"] == pytest.approx(1, abs=0.2)  # two steps teach nothing
    assert (tmp_path / "interaction.png").stat().st_size > 10_000
    first = capsys.readouterr().out
    assert run("demo", "--out", tmp_path, "--jobs", 1) == 0  # a second time: the same pokes, the same figures
    again = json.loads((tmp_path / "metrics.json").read_text())
    assert {**again, "demo_seconds": 0} == {**metrics, "demo_seconds": 0}
    assert "4. Look" in first


def test_the_demo_is_evaluated_on_pokes_it_was_not_trained_on(tmp_path, monkeypatch):
    class Enough(Exception):
        pass
    seeds = []

    def collect(folder, pokes, seed, **_):
        seeds.append(seed)
        if len(seeds) == 2:
            raise Enough
        return {"counts": {"kept": pokes}, "seconds": 1.0, "share_in_bullet": None}
    monkeypatch.setattr("hind4sight_min.simulator.collect", collect)
    with pytest.raises(Enough):
        run("demo", "--out", tmp_path, "--seed", 7)
    assert seeds[0] == 7 != seeds[1]


def test_without_pybullet_one_line_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    one_line(capsys, run("collect", tmp_path / "pokes", "--pokes", 1), "pybullet", "pip install")
    assert not (tmp_path / "pokes").exists() or not list((tmp_path / "pokes").iterdir())


def test_wrong_input_ends_in_one_line(tmp_path, capsys):
    shard = next((data_small() / "train").glob("shard_????.npz"))
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "shard_0000.npz").write_bytes(shard.read_bytes()[:5000])
    out = tmp_path / "model.npz"
    cases = [
        (("evaluate", tmp_path / "no.npz"), ("no.npz", "no such file")),
        (("evaluate", shard), (shard.name, "format")),
        (("train", tmp_path / "nowhere", out), ("nowhere", "no such folder")),
        (("train", broken, out), ("shard_0000.npz", "damaged")),
        (("train", data_small() / "train", out, "--steps", -1), ("steps", "-1")),
        (("train", data_small() / "train", out, "--batch", 0), ("batch",)),
        (("train", data_small() / "train", out, "--masks", 1), ("masks",)),
        (("train", data_small() / "train", out, "--jobs", 0), ("jobs",)),
        (("train", data_small() / "train", out, "--resume"), ("model.npz", "no such file")),
        (("train", data_small() / "train", tmp_path / "model.png"), ("out", ".npz", "model.png")),
        (("train", data_small() / "train"), ("out", ".npz")),
        (("train", data_small() / "train", out, "--seed", -1), ("seed", "-1")),
        (("reproduce", "planning", "--out", tmp_path / "p", "--jobs", 0), ("jobs", "0")),
        (("plan", "--seed", -1), ("seed", "-1")),
        (("plan", "--budget", 0, "--out", tmp_path / "p"), ("budget", "0")),
        (("plan", "--objects", 2, "--obstacle"), ("movers", "obstacle")),
        (("collect", tmp_path / "c", "--pokes", -5), ("pokes", "-5")),
        (("collect", tmp_path / "c", "--objects", 0, 3), ("objects",)),
        (("collect", tmp_path / "c", "--kinds", "teapot"), ("kinds", "teapot")),
        (("collect", tmp_path / "c", "--textures", "tartan"), ("textures", "tartan")),
        (("collect", tmp_path / "c", "--seed", -1), ("seed",)),
    ]
    for arguments, words in cases:
        one_line(capsys, run(*arguments), *words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken"]  # nothing half-written


def test_an_existing_checkpoint_is_not_overwritten(tmp_path, capsys):
    out = tmp_path / "model.npz"
    out.write_bytes(b"precious")
    one_line(capsys, run("train", data_small() / "train", out, *TRAIN), "exists already")
    assert out.read_bytes() == b"precious"


def test_weights_and_starting_point(tmp_path, capsys):
    first, second, third = (tmp_path / f"{name}.npz" for name in "abc")
    assert run("train", data_small() / "train", first, *TRAIN) == 0
    assert run("train", data_small() / "train", second, *TRAIN, "--start", first, "--weight", "chamfer=0",
               "--weight", "photometric=0.7", "--learning-rate", 1e-9) == 0
    went_on = training.load_run(second)
    assert went_on.recipe.weights == {**training.WEIGHTS, "chamfer": 0, "photometric": 0.7}
    np.testing.assert_allclose(went_on.vector, training.load_run(first).vector, atol=1e-7)  # hardly a step away
    capsys.readouterr()
    one_line(capsys, run("train", data_small() / "train", third, *TRAIN, "--width", 12, "--start", first), "a.npz")
    for wrong in ("chamfers=1", "chamfer", "chamfer=much"):
        with pytest.raises(SystemExit) as stop:
            run("train", data_small() / "train", third, "--weight", wrong)
        one_line(capsys, stop.value.code, "weight")
    one_line(capsys, run("train", data_small() / "train", third, "--weight", "chamfer=-1"), "weights")


def test_options_of_train_are_those_of_the_recipe(tmp_path):
    assert run("train", data_small() / "train", tmp_path / "a.npz", *TRAIN, "--masks", 3, "--depth-noise", 0.004,
               "--seed", 5) == 0
    recipe = training.load_run(tmp_path / "a.npz").recipe
    assert (recipe.steps, recipe.batch, recipe.depth_noise, recipe.seed) == (3, 2, 0.004, 5)
    assert (recipe.sizes.width, recipe.sizes.masks) == (8, 3)


def test_resuming_keeps_the_recipe_and_refuses_another(tmp_path, capsys):
    out = tmp_path / "model.npz"
    assert run("train", data_small() / "train", out, *TRAIN) == 0
    capsys.readouterr()
    one_line(capsys, run("train", data_small() / "train", out, "--weight", "inverse=0", "--resume"), "--resume",
             "weight")
    assert run("train", data_small() / "train", out, "--resume") == 0
    assert training.load_run(out).recipe.batch == 2


def test_a_camera_that_is_not_symmetric_is_trained_without_mirroring(tmp_path):
    from dataclasses import replace

    from hind4sight_min.interactions import load_interactions, load_truth, save_shard
    data, truth = load_interactions(data_small() / "train")[:4], load_truth(data_small() / "train")[:4]
    data.camera = replace(data.camera, cx=data.camera.cx + 0.3)
    save_shard(tmp_path / "shard_0000.npz", data, truth)
    assert run("train", tmp_path, tmp_path / "model.npz", *TRAIN) == 0
    assert not training.load_run(tmp_path / "model.npz").recipe.mirror
    assert training.load_run(data_small() / "checkpoint.npz").recipe.mirror


def test_a_checkpoint_of_another_camera_is_refused(tmp_path, capsys):
    model = training.load_run(data_small() / "checkpoint.npz")
    model.meta["camera"]["fx"] += 1
    training.save_run(tmp_path / "model.npz", model)
    for arguments in (["evaluate", tmp_path / "model.npz"],
                      ["show", tmp_path / "model.npz", "--out", tmp_path / "p.png"]):
        one_line(capsys, run(*arguments), "another camera")


def test_rows_outside_the_data(tmp_path, capsys):
    model = tmp_path / "model.npz"
    run("train", data_small() / "train", model, *TRAIN)
    capsys.readouterr()
    for row in (-1, 10 ** 6):
        one_line(capsys, run("show", model, data_small() / "test", "--row", row), "row", str(row))


def test_usage_errors_are_one_line_too(capsys):
    for arguments in ([], ["fly"], ["collect"], ["evaluate", "--json"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        one_line(capsys, stop.value.code)


def test_module_and_installed_command_are_the_same_from_any_folder(tmp_path):
    for how in ([sys.executable, "-m", "hind4sight_min"], [str(Path(sys.executable).parent / "hind4sight")]):
        if not Path(how[0]).exists():
            pytest.skip("the package is not installed here")
        done = subprocess.run([*how, "--help"], capture_output=True, text=True, cwd=tmp_path, timeout=60,
                              env={**os.environ, "PYTHONPATH": str(ROOT)})
        assert done.returncode == 0 and done.stderr == ""
        for name in ("collect", "train", "evaluate", "show", "demo"):
            assert name in done.stdout


def test_progress_is_for_terminals_only(monkeypatch, capsys):
    assert command.progress_line("train") is None
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    show = command.progress_line("train")
    show(1, 4)
    show(4, 4)
    err = capsys.readouterr().err
    assert "train: 1 of 4" in err and "s left" in err and err.endswith("\n")
