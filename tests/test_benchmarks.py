"""Every benchmark runs, for one round and with the smallest settings, and records finite figures."""
import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hind4sight_min.disk.shards import load_interactions, save_shard
from hind4sight_min.sim.truth import load_truth, save_truth

ROOT = Path(__file__).resolve().parent.parent
RUNS = {  # benchmark -> what it needs, its arguments, figures that must be among those it records
    "startup": ((), (), ("import_seconds", "import_command_line_seconds", "first_picture_seconds_max")),
    "collection": (("pybullet",), ("--pokes", "2"), ("collect_jobs2_speedup_min", "collect_share_in_bullet")),
    "roundtrip": (("pybullet",), ("--pokes", "4", "--size", "128", "96"), ("roundtrip_mm", "roundtrip_pose_mm",
                                                                       "roundtrip_flow_mse_ratio_64")),
    "explorer": ((), (), ("explorer_ms", "explorer_ms_max", "explorer_poke_ms")),
    "planning": (("pybullet",), ("--before", ROOT), ("plan_candidates_per_second", "plan_speedup_vs_before")),
    "scale": (("pybullet",), ("--pokes", "8", "--steps", "1", "--jobs", "1"),
              ("collect_pokes_per_second", "train_memory_20k_over_2k", "shard_bytes_per_poke")),
    "kills": (("pybullet",), ("--pokes", "12", "--kills", "1", "1", "1", "1"), ("kills_survived", "kills_writing")),
    "mutations": ((), ("--files", "20", "--calls", "32"), ("mutated_files_held", "wrong_calls_held")),
    "operations": (("torch", "point_cloud_utils"), ("--points", "100", "--pictures", "24x32", "--seconds", "0.1",
                                                    "--only", "ours", "torch_1_threads", "point_cloud_utils", "scipy"),
                   ("chamfer_100_speedup_vs_point", "chamfer_100_speedup_vs_torch_max",
                    "warp_24x32_speedup_vs_scipy", "warp_speedup_vs_grid_sample_min")),
    "training_step": (("torch",), ("--batch", "9", "--before", ROOT, "--seconds", "0.1", "--only", "ours_1_process",
                                   "ours_2_processes", "torch_tree_eager_1_threads"),
                      ("train_step_speedup_vs_torch", "train_step_memory_vs_torch", "train_step_speedup_vs_before_max",
                       "before_ours_2_processes_batch_9_ms", "network_over_matmul_floor", "chamfer_over_kdtree_floor")),
}


@pytest.mark.parametrize("name", RUNS)
def test_a_benchmark_runs(name, tmp_path):
    needs, arguments, expected = RUNS[name]
    for library in needs:
        pytest.importorskip(library, reason="only installed with the extra 'bench' or 'sim'")
    path = tmp_path / "figures.json"
    command = [sys.executable, ROOT / "benchmarks" / f"{name}.py", "--json", path, *arguments]
    command += ["--rounds", "1"] * (name not in ("scale", "kills", "mutations"))
    result = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert result.returncode == 0, result.stderr
    assert "does not run here" not in result.stdout, result.stdout + result.stderr
    figures = json.loads(path.read_text())
    assert not set(expected) - set(figures), "the README's table and docs/results.py ask for these"
    figures.pop("kills_writing", None)  # one kill may come a moment too late
    assert all(math.isfinite(value) and value > 0 for value in figures.values()), figures


def test_all_eighty_planted_faults_still_fit_the_source():
    spec = importlib.util.spec_from_file_location("planted_faults", ROOT / "benchmarks" / "planted_faults.py")
    planted = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(planted)
    assert len({fault.name for fault in planted.FAULTS}) == len(planted.FAULTS) == 80
    for fault in planted.FAULTS:
        planted.with_fault(fault)  # raises where its text is not there once, or no Python comes of it
        assert all((ROOT / "tests" / f"test_{name}.py").exists() for name in fault.tests.split()), fault.name


def test_minutes_to_a_ratio_ends_with_the_first_run_that_reaches_it(tmp_path):
    for name, count in (("train", 9), ("test", 4)):
        save_shard(tmp_path / name / "shard_0000.npz", load_interactions(ROOT / "data_small" / "test")[:count])
        save_truth(tmp_path / name / "shard_0000.npz", load_truth(ROOT / "data_small" / "test")[:count])
    command = [sys.executable, ROOT / "benchmarks" / "minutes_to.py", tmp_path / "train", tmp_path / "test"]
    for ratio, asked in ((99, [1]), (0, [1, 2])):
        subprocess.run([*command, "--ratio", str(ratio), "--steps", "2", "1", "--json", tmp_path / "found.json"],
                       check=True, capture_output=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
        found = json.loads((tmp_path / "found.json").read_text())
        assert [steps for steps in (1, 2) if f"steps_{steps}_ratio" in found] == asked
        assert ("minutes" in found) == (ratio > 0)


def test_the_table_of_camera_faults_runs(tmp_path):
    test = ROOT / "data_small" / "test"
    save_shard(tmp_path / "shard_0000.npz", load_interactions(test)[:6])
    save_truth(tmp_path / "shard_0000.npz", load_truth(test)[:6])
    command = [sys.executable, ROOT / "benchmarks" / "camera_faults.py", tmp_path, "--json", tmp_path / "figures.json",
               "--checkpoint", ROOT / "data_small" / "checkpoint.npz"]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures.pop("table").count("\n") == 1 + 9
    rows = "clean", "noisy", "missing30", "pitch1", "shift1"
    assert {f"camera_{row}_flow_mse_ratio" for row in rows} <= set(figures)
    ratios = [value for name, value in figures.items() if name.endswith("_flow_mse_ratio")]
    assert len(set(ratios)) == len(ratios) == 9, "rows that are the same: is a fault not passed on?"
