"""Data that the user brings: without truth, without a disk, and by the converter of docs/own-data.md."""
import json
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny import TINY, random_run, still_truth, tiny_pokes

from hind4sight_min import losses
from hind4sight_min.disk import checkpoints
from hind4sight_min.disk.shards import load_interactions, save_shard
from hind4sight_min.geometry import optical_flow
from hind4sight_min.interactions import PER_POKE
from hind4sight_min.lab import evaluation, figures
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


def test_the_converter_of_the_documentation_runs(tmp_path):
    made, recorded = tiny_pokes(), tmp_path / "recorded"
    recorded.mkdir()
    made.rgb_before[..., 2] //= 3  # not the same in red and blue

    def counts(depth):
        return np.round(1000 * depth).astype(np.uint16)
    cv2.imwrite(str(recorded / "empty.png"), counts(made.empty_depth))
    for i in range(len(made)):
        for when in ("before", "after"):
            cv2.imwrite(str(recorded / f"{i:04d}_{when}.png"), getattr(made, f"rgb_{when}")[i][..., ::-1])
            cv2.imwrite(str(recorded / f"{i:04d}_{when}_depth.png"), counts(getattr(made, f"depth_{when}")[i]))
    np.savetxt(recorded / "arena_from_camera.txt", made.camera.arena_from_camera)
    np.savetxt(recorded / "intrinsics.txt", [made.camera.fx, made.camera.fy, made.camera.cx, made.camera.cy])
    np.savetxt(recorded / "pokes.csv", np.hstack([made.pokes, made.starts]), delimiter=",", header="x", comments="")
    converter = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "own-data.md").read_text(), re.DOTALL)[1]
    (tmp_path / "convert.py").write_text(converter)
    done = subprocess.run([sys.executable, "convert.py", "recorded", "out"], cwd=tmp_path, capture_output=True,
                          text=True, env={"PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr
    found = load_interactions(tmp_path / "out")
    for name in PER_POKE:
        np.testing.assert_allclose(getattr(found, name), getattr(made, name), atol=6e-4, err_msg=name)
    for name, value in vars(made.camera).items():
        np.testing.assert_allclose(getattr(found.camera, name), value, err_msg=name)
