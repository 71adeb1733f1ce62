"""The course: what is handed out, what a check says of right, wrong and empty answers, and assignment 7."""
import ast
import inspect
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hind4sight_min.course import ASSIGNMENTS, assignment_of, bugs, carve
from hind4sight_min.course.task import Task, answers_of, judge, namespace_of
from hind4sight_min.disk import files
from hind4sight_min.lab.cli import main

ROOT = Path(__file__).resolve().parent.parent
CARVED = [assignment for assignment in ASSIGNMENTS if assignment.tasks and not assignment.files]
TASKS = [task for assignment in CARVED for task in assignment.tasks]
NUMBERS = {"ids": lambda task: task.number}
MISTAKES = [(task, sentence) for task in TASKS for sentence in task.mistakes]


def verdict_on(task, function, seed=0):
    cases = task.cases(np.random.default_rng(seed))
    return judge(task, cases, answers_of(task, function, cases))


# --- tasks --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("task", TASKS, **NUMBERS)
def test_the_reference_has_full_marks_and_nothing_vanishes(task):
    for seed in (0, 1):
        verdict = verdict_on(task, task.reference, seed)
        assert (verdict.share, verdict.sentence) == (1, ""), "renamed, or another result at the same input"
    answers = answers_of(task, task.reference, task.cases(np.random.default_rng(0)))
    for answer in answers:
        assert all(np.nanmax(np.abs(value)) > 1e-6 for value in answer.value), "an answer of zeros would be right"
        assert max([1, *(np.abs(each).max() > 1e-3 for each in answer.gradients.values())]), "no gradient"
    assert sum(value.size for value in answers[0].value) <= 120, "too large to do by hand"


def test_each_assignment_has_four_to_six_tasks_and_a_hundred_points():
    for number, assignment in enumerate(ASSIGNMENTS, 1):
        assert assignment.number == number
    for assignment in CARVED:
        assert 4 <= len(assignment.tasks) <= 6 and sum(task.points for task in assignment.tasks) == 100
        assert [task.number for task in assignment.tasks] == [f"{assignment.number}.{i}" for i in range(
            1, len(assignment.tasks) + 1)]


@pytest.mark.parametrize("assignment", CARVED, ids=lambda each: each.name)
def test_the_theory_points_to_what_there_is(assignment):
    lessons = re.findall(r"tutorials/\w+\.py", assignment.theory.rpartition("Paper: ")[2])
    assert lessons and all((ROOT / lesson).is_file() for lesson in lessons), lessons


def test_where_the_reference_fails_no_student_is_blamed():
    with pytest.raises(RuntimeError, match="task 1.1: the reference fails: "):
        judge(TASKS[0], [{"depth": None, "intrinsics": np.ones(4), "pose": np.eye(4)}], [])


def filled(result, make):
    """A function's result with every array replaced, in tuples and in what a VJP returns too."""
    if callable(result):
        return lambda *args: filled(result(*args), make)
    if isinstance(result, (tuple, list)):
        return type(result)(filled(each, make) for each in result)
    return make(np.asarray(result))


def constant(value):
    def make(result):
        kind = result.dtype if result.dtype.kind == "f" or np.isfinite(value) else float
        return np.full(result.shape, value, kind)
    return make


EMPTY = {"zeros": constant(0), "ones": constant(1), "NaN": constant(np.nan), "a constant": constant(0.37)}


@pytest.mark.parametrize("task", TASKS, **NUMBERS)
def test_empty_answers_score_nothing(task):
    for name, make in EMPTY.items():
        verdict = verdict_on(task, lambda *args, **case: filled(task.reference(*unboxed(args), **unboxed(case)), make))
        assert verdict.share == 0 and verdict.sentence, name
    for given in range(2):
        verdict = verdict_on(task, lambda *args, **case: [*args, *case.values()][given % len([*args, *case.values()])])
        assert verdict.share == 0 and verdict.sentence, f"argument {given} as it is"
    assert verdict_on(task, lambda *args, **case: None).share == 0


def unboxed(value):
    """Out of autograd's boxes: what an empty answer is made of has no gradient."""
    from autograd.tracer import getval
    if isinstance(value, tuple):
        return tuple(map(unboxed, value))
    return {name: unboxed(each) for name, each in value.items()} if isinstance(value, dict) else getval(value)


@pytest.mark.parametrize("task, sentence", MISTAKES, ids=[f"{task.number}-{i}" for i, (task, _) in enumerate(MISTAKES)])
def test_a_known_mistake_gets_its_own_sentence_and_not_full_marks(task, sentence):
    verdict = verdict_on(task, task.mistakes[sentence], seed=1)
    assert verdict.sentence == sentence and verdict.share < 1


def test_there_are_enough_known_mistakes():
    assert len(MISTAKES) >= 45 and all(len(task.mistakes) >= 3 for task in TASKS)


# --- what a verdict says ------------------------------------------------------------------------------------------

DOUBLE = Task("0.1", "planning.wrapped", "", 1, 1, gradient=("angle",),
              cases=lambda rng: [{"angle": np.array([1.0, 3])}, {"angle": rng.random(4) + 1}])


@pytest.mark.parametrize("function, share, words", [
    (lambda x: 2 * x, 1, []),
    (lambda x: 2 * x[:1], 0, ["shape (2,)", "by hand", "got (1,)"]),
    (lambda x: (2 * x).astype(np.float32), 0.5, ["dtype float64", "got float32"]),
    (lambda x: 2 * x / (x < 3), 0, ["NaN or infinity in 1 of 2"]),
    (lambda x: 3 * x, 0, ["expected [2., 6.], got [3., 9.]"]),
    (lambda x: 2 * x * (1 if len(x) == 2 else 1.5), 0, ["case 1", "1.5 times"]),
    (lambda x: 2 * x + (len(x) == 4) * np.arange(len(x)), 0.5, ["case 1", "%"]),
    (lambda x: np.array([2 * float(each) for each in x]), 0.5, ["value is right", "anp"]),
    (lambda x: None, 0, ["return"]),
    (lambda x: "2", 0, ["arrays of numbers", "str"]),
    (lambda x: (x, x), 0, ["expected 1 arrays, got 2"])])
def test_what_is_wrong_is_said_in_order(monkeypatch, function, share, words):
    monkeypatch.setattr(Task, "reference", property(lambda task: lambda x: 2 * x))
    verdict = verdict_on(DOUBLE, function)
    assert verdict.share == share and all(word in verdict.sentence for word in words), verdict.sentence


def test_an_error_is_told_with_the_students_line(tmp_path):
    (tmp_path / "double.py").write_text("\ndef double(x):\n    return x[7]\n")
    verdict = verdict_on(DOUBLE, namespace_of(tmp_path / "double.py")["double"])
    assert "IndexError" in verdict.sentence and "(line 3: return x[7])" in verdict.sentence


# --- what is handed out -------------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def handed_out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("class")
    for assignment in CARVED:
        carve.start(assignment, folder / assignment.name)
    return folder


@pytest.mark.parametrize("assignment", CARVED, ids=lambda each: each.name)
def test_an_exercise_keeps_signatures_and_docstrings_and_gives_nothing_away(assignment, handed_out):
    text = (handed_out / assignment.name / f"{assignment.name}.py").read_text()
    functions = {node.name: node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)}
    assert list(functions) == [task.function for task in assignment.tasks]
    assert max(map(len, text.splitlines())) <= 120
    for task in assignment.tasks:
        source = inspect.getsource(inspect.unwrap(getattr(task.reference, "fun", task.reference)))
        original, node = ast.parse(source).body[0], functions[task.function]
        assert ast.dump(node.args) == ast.dump(original.args) and len(node.body) == 2
        assert ast.get_docstring(node) == (ast.get_docstring(original) or ast.get_docstring(node))
        assert f"Task {task.number}: {task.title}" in ast.unparse(node.body[1])
        body = original.body[ast.get_docstring(original) is not None:]
        solution = {line.strip() for each in body for line in ast.get_source_segment(source, each).splitlines()}
        documented = str(ast.get_docstring(original))
        assert not [line for line in solution if len(line) > 20 and line in text and line not in documented]


@pytest.mark.parametrize("task", TASKS, **NUMBERS)
def test_the_untouched_skeleton_scores_nothing_and_says_which_task(task, handed_out):
    name = assignment_of(task.number.partition(".")[0]).name
    verdict = carve.check(handed_out / name / f"{name}.py", task)
    assert verdict.share == 0 and f"Task {task.number}" in verdict.sentence


def solved(assignment, path, but=""):
    """The reference's own functions at the end of an exercise, but for one."""
    modules = sorted({"hind4sight_min." + task.name.rpartition(".")[0] for task in assignment.tasks})
    functions = [task.function for task in assignment.tasks]
    helpers = [f"import {module}\nglobals().update({{name: value for name, value in vars({module}).items() "
               f"if name not in {['__name__', '__file__', *functions]}}})" for module in modules]
    sources = [inspect.getsource(getattr(task.reference, "fun", task.reference)) for task in assignment.tasks
               if task.function != but]
    text = path.read_text()
    path.write_text("\n".join([text, *helpers, *sources, *re.findall(r"^defvjp.*$", text, re.MULTILINE)]) + "\n")


def test_a_task_does_not_depend_on_the_others(tmp_path):
    chamfer = assignment_of("chamfer")
    carve.start(chamfer, tmp_path / "a")
    path = tmp_path / "a" / "chamfer.py"
    solved(chamfer, path, but="squared_distances")  # and with it all others would fail, value or gradient
    shares = [carve.check(path, task).share for task in chamfer.tasks]
    assert shares == [0, 1, 1, 1, 1, 1]


def pytest_in(folder, *arguments):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments], cwd=folder,
                          env=environment, capture_output=True, text=True, timeout=300)


def test_a_students_own_tests_run_one_task_or_one_equation_and_see_the_students_functions(tmp_path):
    chamfer = assignment_of("chamfer")
    carve.start(chamfer, tmp_path / "a")
    solved(chamfer, tmp_path / "a" / "chamfer.py", but="chamfer_loss")
    done = pytest_in(tmp_path / "a", "-k", "2_3")
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout
    done = pytest_in(tmp_path / "a", "-m", "eq2")
    assert "Task 2.5" in done.stdout, "the reference's function was tested, not the student's"
    assert "FAILED test_eq2_chamfer.py::test_nearest" not in done.stdout and "3 failed" in done.stdout, done.stdout


def test_a_missing_function_and_a_renamed_one_are_named(tmp_path, handed_out):
    (tmp_path / "camera.py").write_text("x = 1")
    with pytest.raises(ValueError, match="camera.py: there is no function unproject"):
        carve.load_student(tmp_path / "camera.py", TASKS[0])
    camera = assignment_of(1)
    renamed = replace(camera, tasks=(replace(camera.tasks[0], name="geometry.deproject"),))
    with pytest.raises(ValueError, match="task 1.1: there is no function geometry.deproject"):
        carve.exercise_text(renamed)


def test_the_course_command_lists_and_starts_and_overwrites_nothing(tmp_path, capsys):
    assert main(["course", "list"]) == 0
    out = capsys.readouterr().out
    assert all(assignment.title in out for assignment in ASSIGNMENTS)
    assert main(["course", "start", "2", "--out", str(tmp_path / "mine")]) == 0
    assert (tmp_path / "mine" / "test_eq2_chamfer.py").read_text() == (ROOT / "tests/test_eq2_chamfer.py").read_text()
    capsys.readouterr()
    for arguments, word in ((["start", "chamfer", "--out", str(tmp_path / "mine")], "new or an empty folder"),
                            (["start", "9", "--out", str(tmp_path / "b")], "2 chamfer"), (["start"], "number")):
        assert main(["course", *arguments]) == 2 and word in capsys.readouterr().err


def test_a_plain_install_finds_the_tests_that_it_hands_out(tmp_path, monkeypatch):
    import configparser
    import sysconfig
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    shipped = config["options.data_files"]["share/hind4sight_min/tests"].split()
    folder = tmp_path / "share/hind4sight_min/tests"
    folder.mkdir(parents=True)
    for path in [path for pattern in shipped for path in ROOT.glob(pattern)]:
        (folder / path.name).write_text(path.read_text())
    monkeypatch.setattr(files, "__file__", str(tmp_path / "site-packages/hind4sight_min/disk/files.py"))
    monkeypatch.setattr(sysconfig, "get_path", lambda name, scheme: str(tmp_path))
    assert carve.tests_folder() == folder
    for assignment in CARVED:
        assert set(carve.exercise_files(assignment)) >= {f"test_{name}.py" for name in assignment.tests}


# --- assignment 7 -------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("number", range(1, len(bugs.MUTANTS) + 1))
def test_a_model_measurement_shows_each_bug_and_passes_right_code(number):
    path = Path(__file__).with_name("course_measures.py")
    on_reference, on_mutant = (bugs.measure(path, number, bugs.broken(each)) for each in (0, number))
    assert bugs.judge(number, on_reference, on_mutant).sentence == ""
    assert bugs.judge(number, on_reference, on_reference).share == 0


def test_the_broken_packages_come_without_sources(tmp_path):
    bugs.write_compiled(3, tmp_path)
    assert {path.suffix for path in tmp_path.rglob("*.*")} == {".pyc"} and not (tmp_path / "package/course").exists()
    with pytest.raises((OSError, TypeError)):
        inspect.getsource(bugs.broken(3).ops.nearest_squared_distances)


@pytest.mark.parametrize("text, word", [
    ("EXPECTED_01 = 0, 1\ndef measure_01(package): return 0.5", "does not show"),
    ("EXPECTED_01 = 0, 1\ndef measure_01(package): return 2", "outside of your range"),
    ("EXPECTED_01 = 0, 1\ndef measure_01(package): import hind4sight_min.ops", "hind4sight_min"),
    ("EXPECTED_01 = 0, float('inf')\ndef measure_01(package): return 2", "finite"),
    ("EXPECTED_01 = None\ndef measure_01(package): return 2", "EXPECTED"),
    ("def measure_01(package): return 2", "EXPECTED_01")])
def test_what_shows_no_bug_wins_nothing(tmp_path, text, word):
    (tmp_path / "bugs.py").write_text(text)
    found = [bugs.measure(tmp_path / "bugs.py", 1, bugs.broken(each)) for each in (0, 1)]
    verdict = bugs.judge(1, *found)
    assert verdict.share == 0 and word in verdict.sentence, verdict.sentence


def test_an_empty_exercise_of_bugs_wins_nothing(tmp_path):
    carve.start(assignment_of("bugs"), tmp_path / "bugs")
    found = bugs.measure(tmp_path / "bugs" / "bugs.py", 12, bugs.broken(0))
    assert bugs.judge(12, found, found).share == 0
    assert (tmp_path / "bugs/README.md").read_text().count("\n12. ") == 1
