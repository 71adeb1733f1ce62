"""The package as a student's process gets it: without the body of the function that the task asks for, and without what
only the grader needs, which says too much: cases, known mistakes, mutants.
"""
import ast
import compileall
import tempfile
import threading
from pathlib import Path

from . import bugs
from .bugs import PACKAGE

ASKED = "raise NotImplementedError('this is what the task asks for')"


def blanked(source, function):
    """Source text with the body of a function of its own replaced by NotImplementedError, without comments.

    Not in the paper: grading. Raises ValueError where there is no such function.
    """
    tree = ast.parse(source)
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == function]
    if not found:
        raise ValueError(f"function: there is no {function} to blank")
    found[0].body = ast.parse(ASKED).body
    return ast.unparse(tree)


def without_answers(source):
    """Source text of an assignment without its tasks' cases and mistakes, and what then nothing uses.

    Not in the paper: a known wrong answer, twice it or minus it, may be the right one.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Task":
            node.args[5:6] = [ast.Constant(None)] * len(node.args[5:6])
            node.keywords = [each for each in node.keywords if each.arg not in ("cases", "mistakes")]
            if len(node.args) < 6:
                node.keywords.append(ast.keyword("cases", ast.Constant(None)))
    while True:
        used = {each.id for node in tree.body for each in ast.walk(node) if isinstance(each, ast.Name)
                and each.id != getattr(node, "name", None)}
        kept = [node for node in tree.body if not isinstance(node, ast.FunctionDef) or node.name in used]
        if len(kept) == len(tree.body):
            return ast.unparse(tree)
        tree.body = kept


def without_mutants(source):
    """Source text of bugs.py without its mutants. Not in the paper: they are the answers of assignment 7."""
    tree = ast.parse(source)
    for node in tree.body:
        if isinstance(node, ast.Assign) and node.targets[0].id == "MUTANTS":
            node.value = ast.Tuple([], ast.Load())
    return ast.unparse(tree)


def write_package(folder, name=None):
    """Copy the package into a folder, without its answers; `name`: of the function to blank, module.function.

    Not in the paper: grading.
    """
    blank, _, function = (name or "").rpartition(".")
    for path in PACKAGE.rglob("*.py"):
        inside = path.relative_to(PACKAGE)
        source = path.read_text(encoding="utf-8")
        if ".".join(inside.with_suffix("").parts) == blank:
            source = blanked(source, function)
        elif inside.parent.name == "assignments" and inside.name != "__init__.py":
            source = without_answers(source)
        elif inside.as_posix() == "course/bugs.py":
            source = without_mutants(source)
        write_source(folder, inside, source)


NEEDED_TO_MEASURE = "__init__.py", "course/task.py", "course/channel.py", "course/bugs.py"


def write_mutant(folder, number):
    """A mutant of assignment 7, 0 for the right package, into a folder, and of this package what measuring it takes.

    Not in the paper: grading. The rest is left out: a measurement that compares with the reference would be none.
    """
    for name in NEEDED_TO_MEASURE:
        source = (PACKAGE / name).read_text(encoding="utf-8")
        write_source(folder, name, without_mutants(source) if name == "course/bugs.py" else source)
    write_source(folder, "course/__init__.py", "")
    bugs.write_compiled(number, folder)


def write_source(folder, inside, source):
    """A file of the copied package."""
    target = Path(folder, PACKAGE.name, inside)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(source, encoding="utf-8")


KEPT, LOCK = {}, threading.Lock()


def package_for(what=None):
    """A folder with the package: without a function (its name), with a mutant (its number), or as it is (None) -> str.

    Not in the paper: grading. Made once, compiled, for every user to read, and gone when this process ends.
    """
    with LOCK:
        if what not in KEPT:
            KEPT[what] = tempfile.TemporaryDirectory(prefix="hind4sight-package-")
            folder = Path(KEPT[what].name)
            (write_mutant if isinstance(what, int) else write_package)(folder, what)
            compileall.compile_dir(folder, quiet=2)
            for path in [folder, *folder.rglob("*")]:
                path.chmod(0o755 if path.is_dir() else 0o644)
        return KEPT[what].name
