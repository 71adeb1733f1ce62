"""Data that the user brings: without truth, without a disk, and as docs/own-data.md says; test_cameras.py has more."""
import json
import re
from pathlib import Path

import numpy as np
import pytest
from tiny import TINY, random_run, still_truth, tiny_pokes

from hind4sight_min import losses
from hind4sight_min.disk import checkpoints
from hind4sight_min.disk.recordings import load_recording
from hind4sight_min.disk.shards import load_interactions, save_shard
from hind4sight_min.geometry import optical_flow
from hind4sight_min.interactions import PER_POKE
from hind4sight_min.lab import evaluation, figures
from hind4sight_min.lab.cameras import camera_of, sampling_of
from hind4sight_min.lab.cli import main
from hind4sight_min.sim.truth import find_truth, save_truth
from hind4sight_min.training import scenes_of, start_run, train

ROOT = Path(__file__).resolve().parent.parent


def test_pokes_in_memory_train_evaluate_and_show_without_truth_or_disk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = tiny_pokes()
    run = train(data, start_run(TINY, data))
    found = evaluation.evaluate(run, data)
    assert found["pokes"] == 7 and all(np.isfinite(value) and value > 0 for value in found.values())
    shown = figures.interaction_figure(data, 2, evaluation.ask(run, data, 2))
    names = {axes.get_label() for part in shown.subfigs for axes in part.axes}
    assert {"before", "flow", "masks", "error"} <= names and not {"labels", "true_flow"} & names
    assert not list(tmp_path.iterdir())


def test_label_free_errors_are_the_losses_beside_those_of_no_motion():
    data, run = tiny_pokes(), random_run()
    before, after = scenes_of(data[[3]])
    valid, next_valid = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
    predicted = evaluation.ask(run, data, 3).prediction.points
    found = evaluation.label_free_errors(run, data, 3)
    for prefix, points in (("", predicted), ("no_motion_", before.points)):
        flow = optical_flow(before.points, points, data.camera).reshape(1, 12, 16, 2)
        apart = np.sum((points[0][:, None] - after.points[0]) ** 2, axis=2)  # every point from every other
        chamfer = (apart[:, next_valid[0]].min(axis=1)[valid[0]].sum()
                   + apart[valid[0]].min(axis=0)[next_valid[0]].sum())
        assert found[f"{prefix}chamfer_cm2"] == pytest.approx(1e4 * chamfer, rel=1e-3), "cm^2? whose points count?"
        assert found[f"{prefix}photometric"] == pytest.approx(
            losses.photometric_loss(before.images, after.images, flow, valid)[0], rel=1e-4)
    assert abs(found["chamfer_cm2"] - found["no_motion_chamfer_cm2"]) > 0.1, "the same with and without motion"


@pytest.mark.parametrize("known", [False, True])
def test_the_commands_do_with_and_without_truth(known, tmp_path, capsys):
    data, folder = tiny_pokes(), tmp_path / "data"
    save_shard(folder / "shard_0000.npz", data)
    if known:
        truth = still_truth(np.ones(data.depth_before.shape, int))
        truth.poses_after[:, 0, 0] = 0.02
        save_truth(folder / "shard_0000.npz", truth, data)
    assert (find_truth(folder) is not None) == known
    checkpoints.save_run(tmp_path / "run.npz", random_run())
    assert main(["evaluate", str(tmp_path / "run.npz"), str(folder), "--json", str(tmp_path / "found.json")]) == 0
    out, found = capsys.readouterr().out, json.loads((tmp_path / "found.json").read_text())
    assert ("truth is not known" in out, "chamfer_cm2" in found, "flow_mse_ratio" in found) == (
        not known, not known, known)
    assert main(["show", str(tmp_path / "run.npz"), str(folder), "--out", str(tmp_path / "poke.png")]) == 0
    assert (tmp_path / "poke.png").exists()


def page(language):
    """The blocks of a language in docs/own-data.md."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / "docs" / "own-data.md").read_text(), re.DOTALL)


def test_the_recording_of_the_documentation_is_one(tmp_path):
    (tmp_path / "camera.json").write_text(page("json")[0])
    (tmp_path / "pokes.csv").write_text(page("csv")[0])
    found = load_recording(tmp_path)
    assert found.names == ["0000", "0001"] and found.settings["arena"] == 0.5 and found.depth_unit == 0.001
    np.testing.assert_allclose(found.pokes[1], [-0.110, 0.074, -1.571])
    np.testing.assert_allclose(found.starts[1], [-0.110, 0.194])
    camera, _ = camera_of(found, sampling_of(found, (64, 48)), np.ones((48, 64), np.float32))
    assert camera.fx == pytest.approx(61.52) and camera.cx == pytest.approx(322.9 / 10 - 0.45)


def test_the_code_of_the_documentation_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = tiny_pokes()
    names = {**vars(made), **vars(made.camera)}
    write, use = page("python")
    exec(write, names)
    found = load_interactions("out")
    for name in PER_POKE:
        np.testing.assert_allclose(getattr(found, name), getattr(made, name), atol=6e-5, err_msg=name)
    exec(use.replace("Recipe(steps=1000)", "TINY"), {**names, "TINY": TINY})
    assert (tmp_path / "poke.png").exists()
