"""The command as a user meets it: what it prints, what it writes, how it fails."""
import importlib.util
import json
import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hind4sight_min import losses, training
from hind4sight_min.disk import checkpoints
from hind4sight_min.disk.shards import load_interactions, save_shard
from hind4sight_min.lab import cli, control, evaluation
from hind4sight_min.lab.cli import data_small, main
from hind4sight_min.lab.camera_faults import under_faults
from hind4sight_min.lab.noise import under_noise
from hind4sight_min.networks import Sizes, encode, predict, state_embedding
from hind4sight_min.scene import crop
from hind4sight_min.sim.truth import load_truth, save_truth

ROOT = Path(__file__).resolve().parent.parent
TINY = ["--steps", "3", "--batch", "2", "--width", "8", "--jobs", "1"]
needs_bullet = pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="needs pybullet")


def run(*arguments):
    return main([str(each) for each in arguments])


def one_line(capsys, status, *words):
    """The command failed as promised: status 2, one line on stderr with these words, nothing else."""
    out, err = capsys.readouterr()
    assert status == 2
    assert err.count("\n") == 1 and "Traceback" not in err
    for word in words:
        assert word in err, err


def vector(path):
    return checkpoints.load_run(path).vector


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A folder as `data_small`, with eight pokes to train on, six to test with, and a checkpoint after three steps."""
    folder = tmp_path_factory.mktemp("small")
    for name, count in (("train", 8), ("test", 6)):
        save_truth(folder / name / "shard_0000.npz", load_truth(data_small() / name)[:count])
        save_shard(folder / name / "shard_0000.npz", load_interactions(data_small() / name)[np.arange(count)])
    model = folder / "checkpoint.npz"
    assert run("train", folder / "train", model, *TINY, "--json", model.with_suffix(".json")) == 0
    return folder


# --- train ----------------------------------------------------------------------------------------

def test_train_writes_a_checkpoint_its_log_and_a_picture(small):
    assert {path.suffix for path in small.glob("checkpoint.*")} == {".csv", ".json", ".npz", ".png"}
    assert (small / "checkpoint.csv").read_text().startswith("epoch,step,learning_rate,chamfer")
    assert json.loads((small / "checkpoint.json").read_text())["loss_step"] == 3


def test_train_does_what_the_loop_does_with_the_recipe_asked_for_and_never_needs_the_truth(small, tmp_path):
    (tmp_path / "pokes").mkdir()
    (tmp_path / "pokes" / "shard_0000.npz").symlink_to(small / "train" / "shard_0000.npz")
    assert run("train", tmp_path / "pokes", tmp_path / "a.npz", *TINY, "--masks", 4, "--seed", 5, "--optimiser", "adam",
               "--weight", "chamfer=0", "--weight", "photometric=0.7", "--learning-rate", 0.01) == 0
    found, data = checkpoints.load_run(tmp_path / "a.npz"), load_interactions(small / "train")
    weights = {**training.WEIGHTS, "chamfer": 0, "photometric": 0.7}
    recipe = training.Recipe(steps=3, batch=2, seed=5, optimiser="adam", learning_rate=0.01, weights=weights,
                             sizes=Sizes(masks=4, width=8))
    assert found.recipe == recipe
    np.testing.assert_array_equal(found.vector, training.train(data, training.start_run(recipe, data)).vector)


def test_a_resumed_run_is_the_same_run_with_its_noise(small, tmp_path, capsys):
    noisy, whole, stopped = [*TINY, "--depth-noise", 0.01], tmp_path / "whole.npz", tmp_path / "stopped.npz"
    assert run("train", small / "train", whole, *noisy) == 0
    half = cli.new_run(load_interactions(small / "train"), steps=3, batch=2, width=8, depth_noise=0.01)
    for _ in range(2):
        training.training_step(load_interactions(small / "train"), half, partial(under_noise, standard_deviation=0.01))
    checkpoints.save_run(stopped, half)
    one_line(capsys, run("train", small / "train", stopped, "--resume", "--weight", "inverse=0"), "--resume", "weight")
    one_line(capsys, run("train", small / "train", stopped, *TINY), "exists already")
    assert run("train", small / "train", stopped, "--resume") == 0
    np.testing.assert_array_equal(vector(stopped), vector(whole), err_msg="resumed without its noise?")


def test_a_run_for_cameras_trains_under_faults_and_says_so(small, tmp_path, capsys):
    assert run("train", small / "train", tmp_path / "a.npz", *TINY, "--camera-faults") == 0
    found, data = checkpoints.load_run(tmp_path / "a.npz"), load_interactions(small / "train")
    assert found.meta["camera_faults"] is True
    again = training.train(data, training.start_run(found.recipe, data), under_faults)
    np.testing.assert_array_equal(found.vector, again.vector, err_msg="another objective than lab.camera_faults'?")
    one_line(capsys, run("train", small / "train", tmp_path / "b.npz", *TINY, "--camera-faults", "--depth-noise", 0.01),
             "--depth-noise", "--camera-faults")


def test_a_run_that_starts_from_another_one_has_its_parameters_and_nothing_else_of_it(small, tmp_path, capsys):
    first, data = small / "checkpoint.npz", load_interactions(small / "train")
    options = ["--steps", 3, "--batch", 2, "--jobs", 1, "--seed", 4, "--start-from", first]
    assert run("train", small / "train", tmp_path / "a.npz", *options) == 0
    again = training.start_run(training.Recipe(steps=3, batch=2, seed=4, sizes=Sizes(width=8)), data)
    again.vector = vector(first)
    np.testing.assert_array_equal(vector(tmp_path / "a.npz"), training.train(data, again).vector)
    found = checkpoints.load_run(tmp_path / "a.npz").meta
    assert found["started_from"] == checkpoints.load_run(first).meta["data"] and found["log"][-1]["step"] == 3
    one_line(capsys, run("train", small / "train", tmp_path / "b.npz", *options, "--width", 9), "--start-from", "width")
    one_line(capsys, run("train", small / "train", tmp_path / "b.npz", *TINY, "--start-from", "none.npz"), "none.npz")


# --- evaluate and show ----------------------------------------------------------------------------

def test_the_shipped_checkpoint_on_the_shipped_pokes_is_what_the_results_say(tmp_path, capsys):
    assert run("evaluate", "--json", tmp_path / "metrics.json") == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    recorded = json.loads((ROOT / "docs" / "results" / "shipped.json").read_text())["figures"]
    assert metrics == pytest.approx(recorded, rel=0.01, abs=1e-6)  # other NumPys and OpenCVs round differently
    assert "\r" not in capsys.readouterr().err, "a progress line away from a terminal"


def test_evaluate_shows_the_pokes_with_the_faults_asked_for(small, tmp_path, capsys):
    faults = {"depth_noise": 0.005, "missing": [0.2, "rims"], "pitch_error": 0.5, "pose_error": [0.3, 0.004]}
    options = ["--depth-noise", 0.005, "--missing", 0.2, "--missing", "rims", "--pitch-error", 0.5,
               "--pose-error", 0.3, 0.004]
    assert run("evaluate", small / "checkpoint.npz", small / "train", *options, "--json", tmp_path / "a.json") == 0
    model, data = checkpoints.load_run(small / "checkpoint.npz"), load_interactions(small / "train")
    expected = evaluation.evaluate(model, data, load_truth(small / "train"), **faults)
    assert json.loads((tmp_path / "a.json").read_text()) == expected
    for name in faults:
        others = {other: value for other, value in faults.items() if other != name}
        assert evaluation.evaluate(model, data, load_truth(small / "train"), **others) != expected, name
    one_line(capsys, run("evaluate", small / "checkpoint.npz", small / "train", "--missing", "rim"), "missing", "rims")


def test_camera_is_the_shipped_checkpoint_for_cameras():
    parse = cli.build_parser().parse_args
    for command in ("evaluate", "show", "plan"):
        assert parse([command, "camera"]).checkpoint == data_small() / "camera_checkpoint.npz"
        assert parse([command, "runs/camera"]).checkpoint == Path("runs/camera")
        assert parse([command]).checkpoint == data_small() / "checkpoint.npz"


def test_every_layer_of_the_shipped_checkpoint_is_alive():
    run, data = checkpoints.load_run(data_small() / "checkpoint.npz"), load_interactions(data_small() / "test")[:40]
    _, gradient = training.chunk_gradient(training.unsupervised, run.vector, run.layout, run.recipe, data, [0])
    for name, part in training.unflatten(gradient, run.layout).items():
        if name != "heatmaps_b":  # the same for all cells: softmax does not see it
            assert np.abs(part).max() > 1e-6, name
    before, after = training.scenes_of(data)
    features = encode(run.params, before.points[before.valid])
    assert (features.max(axis=0) > 1e-3).mean() > 0.9, "units die in long runs, if they may"
    predicted = predict(run.params, run.recipe.sizes, before, data.pokes).points
    now, said, then = (state_embedding(run.params, points, occupied) for points, occupied in (
        (before.points, before.occupied), (predicted, before.occupied), (after.points, after.occupied)))
    assert np.abs(said - then).sum() < 0.8 * np.abs(now - then).sum(), "no nearer to the next state than this one is"


def test_show_draws_the_row_asked_for_or_a_poke_that_moves_something(small, tmp_path, capsys, monkeypatch):
    asked, ask = [], cli.evaluation.ask
    monkeypatch.setattr(cli.evaluation, "ask", lambda run, data, row: asked.append(row) or ask(run, data, row))
    for options, row in ((["--row", 5], 5), ([], 135)):
        assert run("show", small / "checkpoint.npz", *options, "--out", tmp_path / "poke.png") == 0
        assert capsys.readouterr().out.endswith(f"interaction {row}\n") and asked.pop() == row
        assert (tmp_path / "poke.png").read_bytes().startswith(b"\x89PNG")
    for row in (-1, 10 ** 6):
        one_line(capsys, run("show", small / "checkpoint.npz", "--row", row), "row", str(row))


# --- collect, plan and the demo -------------------------------------------------------------------

@needs_bullet
def test_collect_writes_shards_of_the_size_asked_for_and_figures(tmp_path, capsys):
    assert run("collect", tmp_path / "pokes", "--pokes", 3, "--objects", 1, 2, "--kinds", "cross", "--textures",
               "rings", "--size", 96, 72, "--within", 0.5, "--jobs", 1, "--json", tmp_path / "collect.json") == 0
    assert sorted(path.name for path in (tmp_path / "pokes").iterdir()) == ["collection.json", "shard_0000.npz",
                                                                            "shard_0000.truth.npz"]
    data, found = load_interactions(tmp_path / "pokes"), json.loads((tmp_path / "collect.json").read_text())
    assert data.rgb_before.shape == (3, 72, 96, 3) and data.settings["kinds"] == ["cross"]
    assert data.settings["place_within"] == 0.5
    assert found["pokes_kept"] == 3 and found["collect_seconds"] > 0
    assert "3 pokes" in capsys.readouterr().out


@needs_bullet
@pytest.mark.parametrize("own_goal", [False, True])
def test_plan_says_and_draws_what_it_did(own_goal, small, tmp_path, capsys):
    with control.random_task(1, 1) as task:
        goal = ["--mark", *task.marks[0], "--goal", 32, 24] if own_goal else []
    assert run("plan", small / "checkpoint.npz", "--policy", "oracle", "--candidates", 8, "--iterations", 1, "--budget",
               1, "--seed", 1, *goal, "--out", tmp_path, "--json", tmp_path / "plan.json") == 0
    out, found = capsys.readouterr().out, json.loads((tmp_path / "plan.json").read_text())
    assert "poke 1 to (" in out and "cm from the goals" in out
    assert found["plan_stopped"] == "the budget of pokes, 1, is spent" and f"stopped: {found['plan_stopped']}\n" in out
    assert found["plan_pokes"] == 1 and 0 < found["plan_distance_left"] < 1
    assert (tmp_path / "plan.gif").read_bytes().startswith(b"GIF89a")


@needs_bullet
@pytest.mark.parametrize("arguments, words", [
    (["--mark", 0, 47, "--goal", 32, 24], ["(0, 47) lies on the background"]),
    (["--mark", 99, 3, "--goal", 32, 24], ["(99, 3) lies outside the 64 x 48 picture"]),
    (["--mark", 3, 3], ["--mark, --goal: expected both or neither"]),
    (["--pixel-weight", -1], ["pixel_weight"]), (["--budget", 0], ["budget", "0"]), (["--seed", -1], ["seed", "-1"]),
    (["--objects", 2, "--obstacle"], ["movers", "obstacle"])])
def test_plan_refuses_in_one_line(small, arguments, words, tmp_path, capsys):
    one_line(capsys, run("plan", small / "checkpoint.npz", *arguments, "--out", tmp_path / "new"), *words)
    assert not (tmp_path / "new").exists()


@pytest.fixture
def short_demo(small, tmp_path, monkeypatch, capsys):
    """Run the demo on next to nothing, into tmp_path -> its figures, what it printed."""
    for name, value in (("DEMO_POKES", 8), ("DEMO_TEST_POKES", 6), ("DEMO_STEPS", 2), ("data_small", lambda: small)):
        monkeypatch.setattr(cli, name, value)

    def demo():
        assert run("demo", "--out", tmp_path, "--jobs", 1) == 0
        figures = json.loads((tmp_path / "metrics.json").read_text())
        assert figures["demo_pokes"] == 6 and figures.pop("demo_seconds") > 0
        assert figures["demo_flow_mse_ratio"] == pytest.approx(1, abs=0.2)  # two steps teach nothing
        for name in ("checkpoint.npz", "checkpoint.csv", "checkpoint.png", "interaction.png"):
            assert (tmp_path / name).stat().st_size > 50, name
        return figures, capsys.readouterr().out
    return demo


@needs_bullet
def test_the_demo_simulates_trains_evaluates_shows_and_plans(short_demo, tmp_path):
    figures, out = short_demo()
    assert 0 <= figures["demo_plan_distance_left"] <= 1.5 and (tmp_path / "plan.gif").exists()
    assert cli.NO_BULLET not in out and out.count("$ hind4sight collect") == 2
    train, test = (load_interactions(tmp_path / name) for name in ("train", "test"))
    assert (len(train), len(test)) == (8, 6)
    assert not np.isin(test.pokes, train.pokes).all(axis=1).any(), "evaluated on pokes that it was trained on"


def test_the_demo_without_pybullet_takes_the_shipped_pokes_and_says_so_once(short_demo, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    figures, out = short_demo()
    assert "demo_plan_distance_left" not in figures and not (tmp_path / "plan.gif").exists()
    assert out.count(cli.NO_BULLET) == 1 and "\n" not in cli.NO_BULLET and "pip install pybullet" in cli.NO_BULLET
    assert short_demo()[0] == pytest.approx(figures), "a second time, the same"
    one_line(capsys, run("collect", tmp_path / "new", "--pokes", 1, "--jobs", 1), "pybullet", "pip install")
    assert not list(tmp_path.glob("new/*.npz"))


# --- what is wrong ends in one line ---------------------------------------------------------------

@pytest.mark.parametrize("arguments, words", [
    ("evaluate no.npz", ["no.npz", "no such file"]), ("evaluate pokes/shard_0000.npz", ["shard_0000.npz", "format"]),
    ("train nowhere out.npz", ["nowhere", "no shard_"]), ("train broken out.npz", ["shard_0000.npz", "damaged"]),
    ("train pokes out.npz --steps -1", ["steps", "-1"]), ("train pokes out.npz --batch 0", ["batch"]),
    ("train pokes out.npz --masks 1", ["masks"]), ("train pokes out.npz --jobs 0", ["jobs"]),
    ("train pokes out.npz --optimiser sgd", ["optimiser", "sgd"]),
    ("train pokes out.npz --depth-noise -1 --jobs 1", ["--depth-noise", "-1"]),
    ("train pokes out.npz --weight chamfer=-1", ["weights"]),
    ("train pokes pokes/shard_0000.npz/out.npz --steps 1 --batch 1 --width 8 --jobs 1", ["shard_0000.npz"]),
    ("train pokes out.npz --resume", ["out.npz", "no such file"]), ("train pokes", ["out", ".npz"]),
    ("train pokes model.png", ["out", ".npz", "model.png"]), ("reproduce planning --out p --jobs 0", ["jobs", "0"]),
    ("collect c --pokes -5", ["pokes", "-5"]), ("collect c --objects 0 3", ["objects"]),
    ("collect c --kinds teapot", ["kinds", "teapot"]), ("collect c --textures tartan", ["textures", "tartan"]),
    ("collect c --seed -1", ["seed"]), ("collect c --within 1.2", ["place_within", "1.2"]),
    ("collect c --jobs 0", ["jobs"]), ("collect c --size 96 48", ["width", "96"])])
def test_wrong_input_ends_in_one_line(arguments, words, small, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("pokes").symlink_to(small / "train")
    Path("broken").mkdir()
    Path("broken/shard_0000.npz").write_bytes((small / "train/shard_0000.npz").read_bytes()[:5000])
    one_line(capsys, run(*arguments.split()), *words)
    assert {path.name for path in tmp_path.iterdir()} == {"broken", "pokes"}, "something was written"


def test_an_interrupt_ends_in_one_line(monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt
    monkeypatch.setattr(cli.evaluation, "evaluate", interrupted)
    assert run("evaluate") == 130
    assert capsys.readouterr().err == "\nhind4sight evaluate: stopped; what is on disk is whole\n"


@pytest.mark.parametrize("arguments", [["fly"], ["collect"], ["evaluate", "--json"], *(
    ["train", "data", "out.npz", "--weight", wrong] for wrong in ("chamfers=1", "chamfer", "chamfer=much"))])
def test_usage_errors_are_one_line_too(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    one_line(capsys, stop.value.code, "--weight" if "train" in arguments else "")


# --- what a newcomer tries first --------------------------------------------------------------------

def test_the_command_alone_and_version(capsys):
    assert run() == 0 and "COMMAND" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        run("--version")
    assert stop.value.code == 0 and re.fullmatch(r"hind4sight \d+\.\d+\.\d+\n", capsys.readouterr().out)


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_help_says_the_defaults(command, capsys):
    with pytest.raises(SystemExit):
        run(command, "--help")
    out = " ".join(capsys.readouterr().out.split())
    for name, how in cli.COMMANDS[command][2].items():
        if how.get("default") not in (None, False):
            assert re.search(rf"{name} .*default", out), name
    assert command != "collect" or "(default 1000)" in out and "(default 64 48)" in out


def test_a_folder_alone_is_the_data(small, capsys, monkeypatch):
    monkeypatch.setitem(cli.SHIPPED, "default", small / "checkpoint.npz")
    assert run("evaluate", small / "test") == 0
    assert capsys.readouterr().out.startswith("6 pokes")


def test_progress_is_one_line_on_a_terminal_and_one_every_ten_seconds_elsewhere(monkeypatch, capsys):
    clock = [0.0]
    monkeypatch.setattr(cli.time, "perf_counter", lambda: clock[0])
    for terminal, expected in ((False, ["work: 40 of 100, 15 s left", "work: 80 of 100, 5 s left"]),
                               (True, [f"work: {done} of 100" for done in (0, 20, 40, 60, 80, 100)])):
        monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
        clock[0], show = 0.0, cli.progress_line("work")
        for done in range(0, 101, 20):
            show(done, 100)
            clock[0] += 5
        err = capsys.readouterr().err
        lines = [line for line in re.split(r"[\r\n]", err) if line]
        assert len(lines) == len(expected) and all(map(str.startswith, lines, expected)), lines


def test_train_says_the_total_beside_that_of_no_motion(small, tmp_path, capsys):
    assert run("train", small / "train", tmp_path / "a.npz", *TINY) == 0
    line = capsys.readouterr().out.splitlines()[0]
    found, data = checkpoints.load_run(tmp_path / "a.npz"), load_interactions(small / "train")
    terms = found.meta["log"][0]
    assert f"total {sum(value * terms[name] for name, value in training.WEIGHTS.items()):.4g} (" in line
    before, after = training.scenes_of(data)
    before, after = (crop(each, data.pokes, data.camera) for each in (before, after))
    valid, next_valid = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
    still = losses.chamfer_loss(*losses.distance_maps(before.points, after.points, valid, next_valid)).mean()
    assert found.meta["no_motion"]["chamfer"] == pytest.approx(still, rel=1e-3)
    assert f"chamfer {terms['chamfer']:.4g} ({still:.2g}"[:-1] in line and line.endswith("in brackets: without motion")


@needs_bullet
def test_bullet_keeps_its_banner_to_itself():
    code = "from hind4sight_min.sim.arena import *; Arena(Settings(), np.random.default_rng(0)); print('done')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout == "done\n" and done.stderr == ""


# --- the program ----------------------------------------------------------------------------------

def test_module_and_installed_command_are_the_same_from_any_folder(tmp_path):
    for how in ([sys.executable, "-m", "hind4sight_min"], [str(Path(sys.executable).parent / "hind4sight")]):
        if not Path(how[0]).exists():
            pytest.skip("the package is not installed here")
        done = subprocess.run([*how, "--help"], capture_output=True, text=True, cwd=tmp_path, timeout=60,
                              env={**os.environ, "PYTHONPATH": str(ROOT)})
        assert done.returncode == 0 and done.stderr == ""
        for name in ("collect", "train", "evaluate", "show", "plan", "reproduce", "demo"):
            assert name in done.stdout


def test_what_takes_long_to_import_waits_until_it_is_needed():
    code = ("import sys, hind4sight_min.lab.cli as _; "
            "wrong = {'matplotlib', 'scipy.optimize', 'pybullet'} & set(sys.modules);"
            "import hind4sight_min.lab.figures; wrong |= {'matplotlib.pyplot'} & set(sys.modules);"
            "sys.exit(f'imported too early: {wrong}' if wrong else 0)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
