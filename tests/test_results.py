"""What the README and the docs say is what was recorded, and what they point to is there."""
import importlib
import importlib.util
import json
import re
from pathlib import Path

import pytest

from hind4sight_min.training import load_run, save_run

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
        if path.name != "summary.json":
            record = json.loads(path.read_text())
            for key in ("figures", "command", "commit", "seconds", "date", "machine", "python", "versions"):
                assert record[key], (path.name, key)
            assert "dirty" not in record["commit"], path.name


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
