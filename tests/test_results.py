"""What the README and the docs say is what was recorded, and what they point to is there."""
import importlib
import importlib.util
import json
import re
from pathlib import Path

import pytest

from hind4sight_min.disk.checkpoints import load_run, save_run
from hind4sight_min.disk.files import write_json
from hind4sight_min.lab import tables

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
ANNEXES = ("sim", "lab", "disk")
MODULES = ANNEXES + tuple(path.stem for path in (ROOT / "hind4sight_min").glob("*.py"))
spec = importlib.util.spec_from_file_location("results", ROOT / "docs" / "results.py")
results = importlib.util.module_from_spec(spec)
spec.loader.exec_module(results)


def test_summary_is_made_of_the_recorded_results():
    summary = json.loads((ROOT / "docs" / "results" / "summary.json").read_text())
    assert summary == results.gather()
    assert {"demo_flow_mse_ratio", "demo_seconds", "shipped_flow_mse_ratio", "collect_share_in_bullet",
            "collect_jobs2_speedup"} <= set(summary)
    assert all(isinstance(value, float) for value in summary.values())


@pytest.mark.parametrize("name, training", [("checkpoint", "training"), ("camera_checkpoint", "camera_training")])
def test_a_shipped_checkpoint_says_how_it_was_trained(name, training, tmp_path):
    shipped = ROOT / "data_small" / f"{name}.npz"
    if not shipped.exists():
        pytest.skip("not shipped yet")
    run, recorded = load_run(shipped), json.loads((ROOT / "docs" / "results" / f"{training}.json").read_text())
    assert bool(run.meta.get("camera_faults")) == (name == "camera_checkpoint")
    assert (run.meta["command"], run.meta["commit"]) == (recorded["command"], recorded["commit"])
    assert run.step == run.recipe.steps == recorded["figures"]["loss_step"]
    results.ship(shipped, tmp_path / "again.npz", training)
    again = load_run(tmp_path / "again.npz")
    assert (again.vector == run.vector).all() and again.recipe == run.recipe and not again.first_moment.any()
    run.step -= 1
    save_run(tmp_path / "unfinished.npz", run)
    with pytest.raises(ValueError, match="stopped at step"):
        results.ship(tmp_path / "unfinished.npz", tmp_path / "never.npz", training)
    assert not (tmp_path / "never.npz").exists()


def test_the_pages_say_what_the_summary_says():
    summary = results.gather()
    for page, contents in results.pages(summary).items():
        assert results.page_with(page.read_text(), contents) == page.read_text(), page.name
    changed = {**summary, "demo_flow_mse_ratio": 0.999}  # and would not, if a figure changed
    assert "| 0.999 | \u2264 0.16, missed |" in results.pages(changed)[ROOT / "README.md"]["figures"]
    assert len(results.FRONT) <= 8


def test_every_result_says_where_it_comes_from():
    for path in (ROOT / "docs" / "results").glob("*.json"):
        if path.name not in ("summary.json", "cells.json"):
            record = json.loads(path.read_text())
            for key in ("figures", "command", "commit", "seconds", "date", "machine", "python", "versions"):
                assert record[key], (path.name, key)
            assert "dirty" not in record["commit"], path.name


def cell_of_today(name, **changes):
    """What `reproduce` would write of a cell: all it is made of."""
    cell = next(cell for cell in tables.cells_of_tables(list(tables.TABLES), tables.FULL) if cell.name == name)
    return {**tables.ingredients(cell, tables.FULL), **changes}


def test_cells_are_kept_and_restored(tmp_path):
    cells, kept = tmp_path / "runs" / "cells", tmp_path / "kept.json"
    for name, ratio in (("full_clean-1", 0.1), ("2d_noisy-2", 0.2)):
        write_json(cells / f"{name}.json", cell_of_today(name, metrics={"flow_mse_ratio": ratio}))
    assert results.keep(tmp_path / "runs", kept) == 2
    (cells / "full_clean-1.json").unlink()
    again = cell_of_today("2d_noisy-2", metrics={"flow_mse_ratio": 0.3})
    write_json(cells / "2d_noisy-2.json", again)  # run again since: not touched
    assert results.restore(tmp_path / "runs", kept) == 1
    found = {path.stem: json.loads(path.read_text())["metrics"]["flow_mse_ratio"] for path in cells.iterdir()}
    assert found == {"full_clean-1": 0.1, "2d_noisy-2": 0.3}
    (cells / "full_clean-1.json").unlink()
    assert results.keep(tmp_path / "runs", kept) == 2  # what this machine lacks stays kept
    assert json.loads(kept.read_text())["2d_noisy-2"] == again


@pytest.mark.parametrize("name, changes", [
    ("full_clean-1", {"data": None}), ("full_clean-1", {"format": "of before"}), ("full_clean-9", {}),
    ("full_clean-1", {"data": {**cell_of_today("full_clean-1")["data"], "test": [101, {"finger_force": 25.0}]}})])
def test_cells_of_other_settings_or_another_network_are_neither_kept_nor_restored(name, changes, tmp_path):
    write_json(tmp_path / "cells" / f"{name}.json", cell_of_today("full_clean-1", **changes))
    with pytest.raises(ValueError, match=f"cell {name}: made with another"):
        results.keep(tmp_path, tmp_path / "kept.json")
    write_json(tmp_path / "before.json", {name: cell_of_today("full_clean-1", **changes)})
    with pytest.raises(ValueError, match=f"cell {name}: made with another"):
        results.restore(tmp_path / "new", tmp_path / "before.json")
    assert not (tmp_path / "kept.json").exists() and not (tmp_path / "new").exists()


@pytest.mark.parametrize("page", ["README.md", "docs/results.md", "docs/architecture.md", "docs/not-in-the-paper.md",
                                  "docs/extending.md", "docs/explorer.md", "docs/speed.md", "docs/understanding.md",
                                  "docs/own-data.md", "docs/many-machines.md", "docs/teaching.md"])
def test_a_page_points_to_functions_and_files_that_exist(page):
    text = (ROOT / page).read_text()
    for words in re.findall(r"`((?:[a-z_0-9]+\.)+[A-Za-z_]+)`", text):
        *modules, name = words.split(".")
        if modules[0] in MODULES and name not in ("py", "npz", "json", "png", "md"):
            module = importlib.import_module(f"hind4sight_min.{'.'.join(modules[:1 + (modules[0] in ANNEXES)])}")
            for part in [*modules[1 + (modules[0] in ANNEXES):], name]:
                assert hasattr(module, part) or part in getattr(module, "__dataclass_fields__", ()), words
                module = getattr(module, part, None)
    for path in re.findall(r"`((?:tests|docs|data_small|benchmarks|sim|lab|disk)/[\w./]*)`", text):
        assert any((ROOT / start / path).exists() for start in ("", "hind4sight_min")), path
    for path in re.findall(r"\]\(([\w./-]+)(?:#[\w-]*)?\)", text):
        assert ((ROOT / page).parent / path).exists(), path


def pictures_of(text):
    """[(what it says to those who cannot see it, path)] of a page's pictures, in Markdown or HTML."""
    tags = re.findall(r"<(?:img|source)\b[^>]*>", text)
    return re.findall(r"!\[([^\]]*)\]\(([^)\s]+)[^)]*\)", text) + [
        tuple((re.search(rf'\b{name}="([^"]*)"', tag) or [""] * 2)[1] for name in ("alt", "src")) for tag in tags]


PAGES = sorted(path.relative_to(ROOT) for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")))


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_picture_is_there_and_says_what_it_shows(page):
    found = pictures_of((ROOT / page).read_text())
    for text, path in found:
        assert len(text.split()) > 2, f"{path}: a text of its own, for those who cannot see it"
        assert ((ROOT / page).parent / path).is_file(), f"{path}: no such picture"
    assert len({text for text, _ in found}) == len({path for _, path in found}), "two pictures say the same"


def test_the_readme_s_python_finds_what_it_imports():
    code = re.search(r"```python\n(.*?)```", README, re.DOTALL).group(1)
    compile(code, "README.md", "exec")
    exec("\n".join(line for line in code.splitlines() if line.startswith("from ")), {})


@pytest.mark.parametrize("equation", range(1, 7))
def test_every_equation_has_its_row_in_the_paper_map_and_is_marked_where_it_is_computed(equation):
    assert f"| Eq. {equation}," in README
    lines = [line for path in (ROOT / "hind4sight_min").rglob("*.py") for line in path.read_text().splitlines()]
    assert any(re.search(rf"\S.*# Eq\. \({equation}\)$", line) for line in lines)
