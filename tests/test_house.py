"""The house itself: what may import what, what names mean, how large it is."""
import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "hind4sight_min"
CORE = sorted(path for path in PACKAGE.glob("*.py") if path.name != "__main__.py")
FILES = sorted(PACKAGE.rglob("*.py"))


def imported(path):
    """The modules that a file imports, wherever in it, as dotted names of this package or others."""
    inside, found = path.relative_to(PACKAGE.parent).with_suffix("").parts, set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = [*inside[:len(inside) - node.level]] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            found |= {module} | {f"{module}.{name.name}" for name in node.names}
    return found


def test_the_imports_of_a_file_are_found():
    assert {"hind4sight_min.geometry", "hind4sight_min.sim.truth"} <= imported(PACKAGE / "lab" / "evaluation.py")


@pytest.mark.parametrize("path", CORE, ids=lambda path: path.name)
def test_the_core_imports_no_annex_and_opens_no_file(path):
    assert not [name for name in imported(path) if
                re.match(r"hind4sight_min\.(sim|lab|disk|course)\b|pybullet|matplotlib|pathlib|json|io$", name)]


@pytest.mark.parametrize("path", sorted((PACKAGE / "sim").glob("*.py")), ids=lambda path: path.name)
def test_the_simulator_does_not_import_the_laboratory(path):
    assert not [name for name in imported(path) if name.startswith("hind4sight_min.lab")]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_np_is_numpy_and_anp_is_autograds(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            for name in node.names:
                wanted = {"numpy": "np", "autograd.numpy": "anp"}.get(name.name)
                assert wanted is None or name.asname == wanted, f"{name.name} as {name.asname}"


@pytest.mark.parametrize("folder", ["hind4sight_min", "tests", "tutorials", "benchmarks", "docs"])
def test_lines_are_not_made_denser(folder):
    assert not [f"{path.name}: {number}" for path in (PACKAGE.parent / folder).rglob("*.py")
                for number, line in enumerate(path.read_text().splitlines(), 1) if len(line) > 120]
