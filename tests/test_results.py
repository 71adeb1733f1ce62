"""What the README and the docs say is what was recorded, and what they point to is there."""
import importlib
import importlib.util
import json
import re
from dataclasses import asdict
from pathlib import Path

import pytest

from hind4sight_min import reproduce
from hind4sight_min.interactions import write_json
from hind4sight_min.disk.checkpoints import load_run, save_run
from hind4sight_min.training import FORMAT

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
spec = importlib.util.spec_from_file_location("results", ROOT / "docs" / "results.py")
results = importlib.util.module_from_spec(spec)
spec.loader.exec_module(results)


def test_summary_is_made_of_the_recorded_results():
    summary = json.loads((ROOT / "docs" / "results" / "summary.json").read_text())
    assert summary == results.gather()
    assert {"demo_flow_mse_ratio", "demo_seconds", "shipped_flow_mse_ratio", "collect_share_in_bullet",
            "collect_jobs2_speedup"} <= set(summary)
    assert all(isinstance(value, float) for value in summary.values())


def test_the_shipped_checkpoint_says_how_it_was_trained(tmp_path):
    shipped = ROOT / "data_small" / "checkpoint.npz"
    run, recorded = load_run(shipped), json.loads((ROOT / "docs" / "results" / "training.json").read_text())
    assert (run.meta["command"], run.meta["commit"]) == (recorded["command"], recorded["commit"])
    assert run.step == run.recipe.steps == recorded["figures"]["loss_step"]
    results.ship(shipped, tmp_path / "again.npz")
    again = load_run(tmp_path / "again.npz")
    assert (again.vector == run.vector).all() and again.recipe == run.recipe and not again.first_moment.any()
    run.step -= 1
    save_run(tmp_path / "unfinished.npz", run)
    with pytest.raises(ValueError, match="stopped at step"):
        results.ship(tmp_path / "unfinished.npz", tmp_path / "never.npz")
    assert not (tmp_path / "never.npz").exists()


def test_readme_says_what_the_summary_says():
    summary = results.gather()
    assert results.readme_with(README, summary) == README
    changed = {**summary, "demo_flow_mse_ratio": 0.999}  # and would not, if a figure changed
    assert results.readme_with(README, changed) != README


def test_every_result_says_where_it_comes_from():
    for path in (ROOT / "docs" / "results").glob("*.json"):
        if path.name not in ("summary.json", "cells.json"):
            record = json.loads(path.read_text())
            for key in ("figures", "command", "commit", "seconds", "date", "machine", "python", "versions"):
                assert record[key], (path.name, key)
            assert "dirty" not in record["commit"], path.name


def test_kept_cells_are_of_todays_recipes_and_network():
    cells = {cell.name: cell for cell in reproduce.cells_of_tables(list(reproduce.TABLES), reproduce.FULL)}
    for name, kept in json.loads(results.CELLS.read_text()).items():
        assert kept["recipe"] == reproduce.plain(asdict(reproduce.recipe_of(cells[name], reproduce.FULL))), name
        assert kept["format"] == FORMAT and kept["test_pokes"] == reproduce.FULL.test_pokes, name
        assert kept["commit"] and "dirty" not in kept["commit"], name
        assert kept["metrics"]["train_seconds"] > 0 and 0 < kept["metrics"]["flow_mse_ratio"] < 2, name


def test_cells_are_kept_and_restored(tmp_path):
    cells, kept = tmp_path / "runs" / "cells", tmp_path / "kept.json"
    for name, ratio in (("a", 0.1), ("b", 0.2)):
        write_json(cells / f"{name}.json", {"metrics": {"flow_mse_ratio": ratio}})
    assert results.keep(tmp_path / "runs", kept) == 2
    (cells / "a.json").unlink()
    write_json(cells / "b.json", {"metrics": {"flow_mse_ratio": 0.3}})  # run again since: not touched
    assert results.restore(tmp_path / "runs", kept) == 1
    found = {path.stem: json.loads(path.read_text())["metrics"]["flow_mse_ratio"] for path in cells.iterdir()}
    assert found == {"a": 0.1, "b": 0.3}
    (cells / "a.json").unlink()
    assert results.keep(tmp_path / "runs", kept) == 2  # what this machine lacks stays kept
    assert json.loads(kept.read_text())["b"]["metrics"]["flow_mse_ratio"] == 0.3


def test_readme_points_to_functions_and_files_that_exist():
    names = set(re.findall(r"`([a-z_]+)\.([A-Za-z_]+)`", README)) - {("docs", "results")}
    names = {(module, name) for module, name in names if name not in ("py", "npz", "json", "png", "md", "cfg")}
    assert len(names) > 20
    for module, name in names:
        assert hasattr(importlib.import_module(f"hind4sight_min.{module}"), name), (module, name)
    paths = re.findall(r"`((?:tests|docs|data_small|benchmarks)/[\w./]*)`", README)
    paths += re.findall(r"\]\((docs/[^)]+)\)", README)
    assert len(paths) > 10
    for path in paths:
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("equation", range(1, 7))
def test_every_equation_is_marked_where_it_is_computed(equation):
    lines = [line for path in (ROOT / "hind4sight_min").glob("*.py") for line in path.read_text().splitlines()]
    assert any(re.search(rf"\S.*# Eq\. \({equation}\)$", line) for line in lines)
    assert f"| Eq. {equation}," in README


def test_data_small_is_small():
    total = sum(path.stat().st_size for path in (ROOT / "data_small").rglob("*") if path.is_file())
    assert total < 3e6
