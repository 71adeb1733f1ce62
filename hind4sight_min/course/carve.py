"""Carve an exercise out of the reference: its functions without their bodies, theory, tasks and tests.

The reference carries no marks for it: a task names a function, and `ast` finds its body. One source, nothing twice.
"""
import ast
import importlib.util
import re
import sys
import textwrap
from pathlib import Path

import numpy as np

from ..disk.files import shipped
from .assignments import ASSIGNMENTS, assignment_of
from .task import answer, answers_of, judge, namespace_of

SHARED_TESTS = ("helpers.py", "tiny.py")  # what the files of tests/ import
MARKERS = "eq1", "eq2", "eq3", "eq4", "eq5", "eq6", "inverse"


# --- the functions -----------------------------------------------------------------------------------------------

def exercise_text(assignment):
    """The file that the student writes in: every task's function with decorator, signature and docstring, its body
    replaced by NotImplementedError. Raises ValueError for a task without a function in the reference.
    """
    functions = [task.function for task in assignment.tasks]
    blocks, imports = [], {"import autograd.numpy as anp": set(), "import numpy as np": set()}
    for done, task in enumerate(assignment.tasks, 1):
        block, needed = _carved(task, functions, functions[:done])
        blocks.append(block)
        for line, names in needed.items():
            imports.setdefault(line, set()).update(names)
    lines = []
    for line, names in sorted(imports.items(), key=lambda item: (item[0].startswith("from"), item[0])):
        text = line + ", ".join(sorted(names))
        lines.append(text if len(text) <= 120 else line + "(" + textwrap.fill(
            ", ".join(sorted(names)), 119 - len(line), subsequent_indent=" " * (len(line) + 1)) + ")")
    head = (f'"""Assignment {assignment.number}: {assignment.title}. README.md says what to do.\n\n'
            'Write the functions; arguments and results stay as they are. What can be differentiated uses anp.\n"""\n')
    return head + "\n".join(lines) + "\n\n\n" + "\n\n\n".join(blocks) + "\n"


def _carved(task, functions, so_far):
    """One function without its body and the statements of its module that belong to it -> text, imports needed."""
    module = "hind4sight_min." + task.name.rpartition(".")[0]
    source = Path(importlib.util.find_spec(module).origin).read_text(encoding="utf-8")
    tree, lines = ast.parse(source), source.splitlines()
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == task.function]
    if not found:
        raise ValueError(f"task {task.number}: there is no function {task.name} in the reference any more")
    node, kept = found[0], [found[0]]
    first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
    documented = ast.get_docstring(node) is not None
    text = lines[first - 1:node.body[0].end_lineno if documented else node.body[0].lineno - 1]
    if not documented:
        text += textwrap.indent(textwrap.fill(f'"""{task.title}. {task.notes}"""', 112), "    ").splitlines()
    text.append(f'    raise NotImplementedError("Task {task.number}: {task.title}")')
    for other in tree.body:  # defvjp(primitive, its VJP): behind the later one of the two
        named = _names(other) & set(functions) if isinstance(other, ast.Expr) else set()
        if task.function in named and named <= set(so_far):
            text += ["", "", ast.get_source_segment(source, other)]
            kept.append(other)
    return "\n".join(text), _imports(tree, module, set().union(*map(_names, kept)), functions)


def _names(node):
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}


def _imports(tree, module, used, functions):
    """Where the names that a function uses come from, lines to import them with; private helpers are solution."""
    needed = {}
    for node in tree.body:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            for alias in node.names:
                bound = alias.asname or alias.name
                if bound not in used or bound in functions:
                    continue
                written = alias.name + (f" as {alias.asname}" if alias.asname else "")
                if isinstance(node, ast.Import):
                    needed[f"import {written}"] = set()
                else:
                    origin = importlib.util.resolve_name("." * node.level + (node.module or ""),
                                                         module.rpartition(".")[0]) if node.level else node.module
                    needed.setdefault(f"from {origin} import ", set()).add(written)
        else:
            targets = node.targets if isinstance(node, ast.Assign) else []
            bound = {each.id for each in targets if isinstance(each, ast.Name)} | {getattr(node, "name", None)}
            public = {name for name in bound & used - set(functions) if not name.startswith("_")}
            if public:
                needed.setdefault(f"from {module} import ", set()).update(public)
    return needed


# --- the folder ----------------------------------------------------------------------------------------------------

def start(assignment, out):
    """Write an assignment into a folder. Raises ValueError where there is something already."""
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"out: expected a new or an empty folder, got {out}")
    files = (assignment.files or exercise_files)(assignment)
    out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (out / name).write_text(text, encoding="utf-8")


def exercise_files(assignment):
    """Name -> text of all files of a carved exercise."""
    folder = tests_folder()
    tests = [f"test_{name}.py" for name in assignment.tests]
    shared = [name for name in SHARED_TESTS if any(f"from {name[:-3]} import" in (folder / test).read_text("utf-8")
                                                   for test in tests)]
    return {f"{assignment.name}.py": exercise_text(assignment), "README.md": readme(assignment),
            "conftest.py": CONFTEST.format(name=assignment.name),
            "test_tasks.py": TEST_TASKS.format(name=assignment.name),
            "pytest.ini": "[pytest]\nmarkers =\n" + "".join(f"    {name}\n" for name in MARKERS),
            **{name: (folder / name).read_text("utf-8") for name in tests + shared}}


def tests_folder():
    """The folder of the reference's tests."""
    return shipped("tests/helpers.py").parent


CONFTEST = '''"""Puts your functions in place of the reference's while one of its own tests runs."""
from pathlib import Path

import pytest
from hind4sight_min.course import carve


@pytest.fixture(autouse=True)
def yours(request, monkeypatch):
    if request.module.__name__ != "test_tasks":
        carve.put_in_place(Path(__file__).with_name("{name}.py"), request.module, monkeypatch)
'''

TEST_TASKS = '''"""One check per task: pytest -k 2_1 runs that of 2.1, and the reference's functions for others."""
from pathlib import Path

import pytest
from hind4sight_min.course import assignment_of, carve

TASKS = assignment_of("{name}").tasks


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.number.replace(".", "_"))
def test_task(task):
    verdict = carve.check(Path(__file__).with_name("{name}.py"), task)
    if verdict.sentence:
        pytest.fail(f"Task {{task.number}}, {{task.function}}: {{verdict.sentence}}", pytrace=False)
'''


def readme(assignment):
    """Theory, tasks with points, minutes and the case by hand, how to check and how it is graded."""
    tasks, name, rows, hands = assignment.tasks, assignment.name, [], []
    for task in tasks:
        rows.append(f"| {task.number} | `{task.function}` | {task.title} | {task.points} | {task.minutes} |")
        case = task.cases(np.random.default_rng(0))[0]
        results = [("->", value) for value in answer(task, task.reference, case, 0).value]
        hands.append("\n".join([*textwrap.wrap(f"**{task.number} `{task.function}`** {task.notes}", 120), "", "```",
                                *(_shown(*each) for each in [*case.items(), *results]), "```"]))
    first = tasks[0].number.replace(".", "_")
    return README.format(
        number=assignment.number, title=assignment.title, theory=assignment.theory, name=name, rows="\n".join(rows),
        points=sum(task.points for task in tasks), minutes=sum(task.minutes for task in tasks),
        hands="\n\n".join(hands), first=first, task=tasks[0].number, tests=OWN_TESTS.format(
            tests=" ".join(f"test_{each}.py" for each in assignment.tests)) if assignment.tests else "")


def _shown(name, value):
    """An array on lines of its own under its name and shape, axes of length 1 left out."""
    value = np.asarray(value)
    text = np.array2string(np.squeeze(value) if value.ndim > 1 else value, precision=4, suppress_small=True,
                           separator=", ", threshold=200)
    if value.ndim < 2:
        return f"{name} {text}"
    return f"{name} {value.shape}\n" + textwrap.indent(re.sub(r"\n\n+", "\n", text), "    ")


OWN_TESTS = """
    pytest -q                 # with the reference's own tests, {tests}

There your functions stand in for the reference's all together, so some fail until all are written. These tests also
ask for what the docstrings say of bad input ("Raises ValueError ..."), which carries no points.
"""

README = """# Assignment {number}: {title}

{theory}

## What to do

Write the functions of `{name}.py`, in any order. Their docstrings say what goes in and what comes out; B pokes, N
points, H x W pixels. {points} points, about {minutes} minutes.

| task | function | | points | minutes |
|---|---|---|---|---|
{rows}

## How to check

    pytest -q -k {first}          # task {task} alone, a second or two
    pytest -q test_tasks.py   # all tasks

`test_tasks.py` compares shape, dtype, finite numbers, values and gradients, in this order, first on the case by hand
below. Where it recognises a mistake it says which. A task does not depend on the others: the check takes the
reference's functions for them.
{tests}
## Cases by hand

What goes in, and after the arrow what comes out, with shapes; axes of length 1 are not drawn.

{hands}

## How it is graded

As `test_tasks.py` does, with other numbers. Where a gradient is asked for, it counts half and the value half. float32
in must give float32 out.

All of the reference is public, in the installed package too. Copying it gives full marks and teaches nothing: this
exercise is for learning, and your teacher knows it.
"""


# --- the student's functions -----------------------------------------------------------------------------------------

def load_student(path, task):
    """The student's function for a task, with the reference's in place of the other tasks'. Raises ValueError where the
    file has none, and what the file itself raises.

    A primitive and its VJP are told apart too: the file registers its own VJP with its own primitive.
    """
    namespace = namespace_of(path)
    for other in assignment_of(task.number.partition(".")[0]).tasks:
        if other.number != task.number:
            namespace[other.function] = other.reference
    return _function(namespace, task, path)


def put_in_place(path, test_module, monkeypatch):
    """Replace the reference's functions by the student's in every module of the package that holds them, and in the
    module of a test, until `monkeypatch` takes it back.
    """
    namespace, assignment = namespace_of(path), assignment_of(Path(path).stem)
    for task in assignment.tasks:
        reference, written = task.reference, _function(namespace, task, path)
        _replace(reference, written, monkeypatch.setattr, test_module)


def take_written(folder, replace=setattr):
    """Replace the reference's functions by those that a student has written in a folder of exercises -> their names.

    For good, if `replace` is setattr. What still raises its NotImplementedError stays the reference's. This is a plain
    import: the code runs with all your rights, not apart as in `grade`. Raises ValueError for a folder without an
    exercise, and what its files raise.
    """
    carved = {f"{each.name}.py": each for each in ASSIGNMENTS if each.tasks}
    paths, taken = [path for path in sorted(Path(folder).glob("*.py")) if path.name in carved], []
    if not paths:
        raise ValueError(f"folder: expected one with {' or '.join(carved)}, got {folder}")
    for path in paths:
        namespace = namespace_of(path)
        for task in carved[path.name].tasks:
            reference, written = task.reference, _function(namespace, task, path)
            tried = answer(task, written, task.cases(np.random.default_rng(0))[0], 0).error or ""
            if f"Task {task.number}:" in tried:
                namespace[task.function] = reference
                continue
            taken.append(task.function)
            _replace(reference, written, replace)
    return taken


def _replace(reference, written, replace, *others):
    """Replace a function wherever a module of the package, or one of the others, holds it."""
    modules = [module for name, module in list(sys.modules.items())
               if name.startswith("hind4sight_min") and not name.startswith("hind4sight_min.course")]
    for module in [*modules, *others]:
        for name in [name for name, value in vars(module).items() if value is reference]:
            replace(module, name, written)


def _function(namespace, task, path):
    if not callable(namespace.get(task.function)):
        raise ValueError(f"{Path(path).name}: there is no function {task.function}")
    return namespace[task.function]


def check(path, task, seed=0):
    """The verdict on a student's function, here in this process: for the student's own checks, not for grading."""
    cases = task.cases(np.random.default_rng(seed))
    return judge(task, cases, answers_of(task, load_student(path, task), cases))
