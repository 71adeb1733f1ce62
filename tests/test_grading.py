"""Grading holds: right submissions get their points, whatever a submission does to the grader gets it none."""
import ast
import csv
import io
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hind4sight_min.course import (ASSIGNMENTS, assignment_of, blank, bugs, bundle, carve, channel, grade_commands,
                                   grading, improve, sandbox)
from hind4sight_min.course.assignments import a8_improve
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab.cli import data_small, main
from hind4sight_min.lab.evaluation import true_motion
from hind4sight_min.sim.truth import load_truth

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))
import grade_class  # noqa: E402

CHAMFER = assignment_of("chamfer")
SHORT = sandbox.Limits(cpu=3, wall=60.0, memory=3 << 29)
HOW = grading.How(seed=7, limits=SHORT)


def items(*functions, how=HOW):
    return [item for item in grading.items_of(CHAMFER, how) if item.name.split()[1] in functions]


def scores(content, *functions, how=HOW):
    """The shares of the points, and the sentences."""
    results = grading.grade(items(*functions, how=how), content)
    return ([test["score"] / test["max_score"] for test in results["tests"]],
            [test["output"] for test in results["tests"]])


NOTHING = {"kind": "task", "files": {}, "file": "none.py", "number": "2.1", "cases": []}


def left_behind(folder=None):
    """Processes of students' code whose orders name a folder: this grader's copy of the package."""
    found, folder = [], str(folder or blank.package_for("losses.chamfer_loss")).encode()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            found += [path.parent.name] if b"worker.py" in (line := path.read_bytes()) and folder in line else []
        except OSError:  # it has ended meanwhile
            pass
    return found


# --- right and wrong ---------------------------------------------------------------------------------------------

def test_the_reference_gets_all_points_and_the_skeleton_none(tmp_path):
    functions = "chamfer_loss", "nearest_squared_distances"
    shares, sentences = scores(grade_class.solution(CHAMFER).encode(), *functions)
    assert shares == [1, 1], sentences
    assert scores(carve.exercise_text(CHAMFER).encode(), *functions)[0] == [0, 0]


def test_half_for_the_value_half_for_the_gradient():
    one_sided = "from autograd.tracer import getval\ndef chamfer_loss(map_predicted, map_observed):\n" \
                "    return (map_predicted + getval(map_observed)).sum(axis=1)\n"
    assert scores(one_sided.encode(), "chamfer_loss")[0] == [0.5]


def test_the_function_asked_for_is_not_in_the_package_the_student_sees():
    copied = "from hind4sight_min.losses import chamfer_loss, seen_in_both\n"
    assert scores(copied.encode(), "chamfer_loss", "seen_in_both")[0] == [0, 0]


def test_held_back_inputs_do_not_come_out_by_an_exception():
    source = b"def chamfer_loss(map_predicted, map_observed):\n" \
             b"    if map_predicted.shape[1] > 4: raise ValueError(repr(map_predicted))\n" \
             b"    return (map_predicted + map_observed).sum(axis=1)\n"
    for exception in ("ValueError", "sys.exit", "type('array', (Exception,), {})"):
        hostile = b"import sys\n" + source.replace(b"ValueError", exception.encode())
        _, (sentence,) = scores(hostile, "chamfer_loss")
        assert ("rror" in sentence or "xception" in sentence or "SystemExit" in sentence) and "array" not in sentence
    _, (sentence,) = scores(source, "chamfer_loss", how=replace(HOW, seed=None))
    assert "array" in sentence, "with public inputs it helps"


@pytest.mark.parametrize("task", [task for assignment in ASSIGNMENTS for task in assignment.tasks],
                         ids=lambda task: task.number)
def test_what_the_student_gets_has_no_answer_in_it(task):
    module, _, function = task.name.rpartition(".")
    found = blank.blanked((blank.PACKAGE / f"{module.replace('.', '/')}.py").read_text(), function)
    node, = [each for each in ast.parse(found).body if getattr(each, "name", None) == function]
    assert ast.unparse(node.body) == blank.ASKED


@pytest.mark.parametrize("path", sorted((blank.PACKAGE / "course" / "assignments").glob("a*.py")),
                         ids=lambda path: path.stem)
def test_neither_cases_nor_mistakes_nor_mutants_reach_the_student(path):
    source = blank.without_answers(path.read_text())
    names = {"__package__": "hind4sight_min.course.assignments", "__name__": path.stem}
    exec(compile(source, path.name, "exec"), names)
    assert all(task.cases is None and not task.mistakes for task in names.get("TASKS", ()))
    assert "(rng):" not in source, "what draws the cases is still there"
    assert bugs.MUTANTS[0].instead not in blank.without_mutants((blank.PACKAGE / "course" / "bugs.py").read_text())


def test_a_measurement_that_tells_right_from_wrong_gets_its_points_and_one_that_asks_the_reference_none():
    items = grading.items_of(assignment_of("bugs"), HOW)[:1]
    right = (ROOT / "tests" / "course_measures.py").read_bytes()
    compares = b"EXPECTED_01 = 0, 0\ndef measure_01(package):\n" \
               b"    import hind4sight_min.geometry\n    return 0\n"
    assert [grading.grade(items, content)["score"] for content in (right, compares)] == [bugs.POINTS, 0]


def test_a_measurement_too_large_to_be_a_float_is_no_answer():
    assert grading.measured([0.0, 1.0, 10 ** 400]) == "what came back is no answer"
    assert grading.measured([0.0, 1.0, 2.0]) == (0, 1, 2)


# --- assignment 8 ---------------------------------------------------------------------------------------------

def test_the_pokes_to_predict_come_without_what_came_of_them():
    pokes = improve.question(None, 0)["pokes"]
    np.testing.assert_array_equal(pokes["rgb_after"], pokes["rgb_before"])
    np.testing.assert_array_equal(pokes["depth_after"], pokes["depth_before"])
    assert [*pokes["meta"]] == ["settings"], "with the seed, the pokes can be simulated again"


def test_no_picture_to_predict_from_shows_what_came_of_another_poke():
    pokes, _ = improve.asked(data_small() / "test")
    everything = load_interactions(data_small() / "test")
    after = {each.tobytes() for each in everything.depth_after}
    assert 50 < len(pokes) < len(everything) and not after & {each.tobytes() for each in pokes.depth_before}
    assert after & {each.tobytes() for each in everything.depth_before}, "in a whole scene there are such"


def test_the_score_is_that_of_the_metrics():
    pokes, truth = load_interactions(data_small() / "test"), load_truth(data_small() / "test")
    true = np.stack([true_motion(pokes, truth, row)[0] for row in range(len(pokes))])
    assert [improve.score(share * true, None)[0] for share in (1, 0, 0.5)] == pytest.approx([0, 1, 0.25])
    assert [improve.share_of(ratio) for ratio in (1, a8_improve.BASELINE, a8_improve.TARGET, 0)] == [0, 0, 1, 1]


@pytest.mark.parametrize("flow, words", [(None, "NoneType"), (np.zeros((3, 3)), "(3, 3)"),
                                         (np.full((400, 3072, 3), np.nan), "NaN"),
                                         (np.full((400, 3072, 3), 1e200), "10 m"),
                                         (np.zeros((400, 3072, 3), int), "int")])
def test_what_is_no_scene_flow_is_refused(flow, words):
    with pytest.raises(ValueError, match="predict") as caught:
        improve.score(flow, None)
    assert words in str(caught.value)


def test_a_student_trains_and_predicts_in_the_sandbox():
    source = b"import os\nimport numpy as np\ndef train(interactions, seed):\n" \
             b"    try:\n        raise SystemExit(os.fork())\n" \
             b"    except BlockingIOError:  # a second process would have ten minutes of its own\n        pass\n" \
             b"    return lambda pokes: np.zeros((len(pokes), pokes.camera.height * pokes.camera.width, 3))\n"
    results = grading.grade(grading.items_of(assignment_of("improve"), replace(HOW, limits=None)), source)
    assert results.get("leaderboard") == [{"name": "flow_mse_ratio", "value": 1.0, "order": "asc"}], results
    assert results["score"] == 0, "no motion earns nothing"


# --- hostile -----------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("name", grade_class.HOSTILE)
def test_an_attack_gets_no_points_and_costs_none(name, tmp_path):
    (tmp_path / "seed").write_text("secret")
    (tmp_path / "seed").chmod(0o600)
    began = time.monotonic()
    shares, sentences = scores(grade_class.hostile(name, tmp_path).encode(), "chamfer_loss", "seen_in_both")
    assert shares == [0, 1], sentences
    assert all(sentences) and time.monotonic() - began < 130
    assert not left_behind()
    assert {*os.listdir(tmp_path)} == {"seed"}


BROKEN = {"null bytes": b"x = 1\0\n", "no function": b"x = 1\n",
          "not Python": b"def chamfer_loss(:\n", "empty": b"", "raises": b"raise KeyError('x')\n",
          "exits": b"import os\nos._exit(3)\n", "another type": b"chamfer_loss = 3\n",
          "no numbers": b"def chamfer_loss(map_predicted, map_observed):\n    return 'all right'\n"}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_gets_one_clear_sentence(name):
    (share,), (sentence,) = scores(BROKEN[name], "chamfer_loss")
    assert share == 0 and "\n" not in sentence and 10 < len(sentence) < 400, sentence


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1", "utf-16"])
def test_whatever_an_editor_saves_text_in_is_read(encoding, tmp_path):
    text = "NAME = 'caf\xe9'\n" + grade_class.hostile("os._exit")
    (tmp_path / "chamfer.py").write_bytes(text.replace("\n", "\r\n").encode(encoding))
    assert scores(grading.find_submission(tmp_path, "chamfer.py")[0], "seen_in_both")[0] == [1]


def test_a_file_that_says_its_encoding_is_left_alone():
    said = "# coding: gbk\nNAME = '\u6df1\u5ea6'\n".encode("gbk")
    assert grading.as_utf8(said) == said
    assert grading.as_utf8("# coding: utf-8\nx = 1  # caf\xe9\n".encode("latin-1")).decode().endswith("caf\xe9\n")


def test_the_truth_of_the_shipped_pokes_is_not_to_be_seen(monkeypatch):
    assert sandbox.HIDDEN[1].name == "hind4sight_min"
    monkeypatch.setattr(sandbox, "HIDDEN", (sandbox.PACKAGE, Path(json.__file__).parent))
    assert str(Path(json.__file__).parent) in sandbox.surroundings(tempfile.gettempdir())["hidden"]


def test_no_network(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        source = f"import socket\nsocket.create_connection(('127.0.0.1', {server.getsockname()[1]}), 5)\n" + \
                 grade_class.FILE.format(seed_folder="", package="", body="        pass")
        (test,) = grading.grade(items("seen_in_both"), source.encode())["tests"]
    if "network" not in sandbox.run(blank.package_for(), NOTHING, SHORT).isolation:
        pytest.skip("this kernel gives this user no network of its own")
    assert test["score"] == 0 and "rror" in test["output"]


# --- what comes through the pipe ---------------------------------------------------------------------------------

def test_a_message_comes_back_as_it_was():
    value = {"a": [1, 2.5, None, "x", True], "b": {"c": np.arange(6.0).reshape(2, 3), "d": np.float32(2)},
             "e": np.asfortranarray(np.ones((2, 3), bool)), "f": np.zeros((0, 3), np.float32)}
    found = channel.decode(channel.frames(channel.encode(value))[0])
    np.testing.assert_equal(found, value)
    assert [found["b"]["d"].dtype, found["e"].dtype, found["f"].shape] == [np.float32, bool, (0, 3)]


def npy(text):
    """A .npy file of a header alone."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize("content", [
    npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}"),
    npy("{'descr': '<U1', 'fortran_order': False, 'shape': (1,)}") + b"abcd",
    npy("{'descr': '|O', 'fortran_order': False, 'shape': (0,)}"),
    npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}"),
    npy("{'descr': '<f8', 'fortran_order': False, 'shape': ()}") + b"1234",
    npy("__import__('os')._exit(1)"), npy("-" * 9000 + "1"), b"", b"\0"])
def test_arrays_that_are_not_what_they_say_are_refused(content):
    with pytest.raises(ValueError):
        channel.decode([b'{"npy": 0}', memoryview(content)])


@pytest.mark.parametrize("text", [b"", b"[" * 100000, b"[" + b"{}," * 500000 + b"{}]", b'{"npy": 5}',
                                  b"\xff", b'{"npy": null}'])
def test_json_that_is_not_ours_is_refused(text):
    with pytest.raises(ValueError):
        channel.decode([text])


def test_a_stream_of_empty_frames_does_not_fill_the_memory():
    found, whole = channel.frames(bytes(8 * 100_000))
    assert len(found) <= channel.MOST_FRAMES and not whole


# --- submissions -------------------------------------------------------------------------------------------------

def zipped(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_the_last_attempt_by_name_is_found_wherever_it_lies(tmp_path):
    folder = tmp_path / "Ann Lee" / "my work"
    for attempt in ("attempt 2", "attempt 10"):
        (folder / attempt).mkdir(parents=True)
        (folder / attempt / "chamfer.py").write_text(attempt)
    assert grading.find_submission(tmp_path / "Ann Lee", "chamfer.py")[::2] == (b"attempt 10", 2)
    path = zipped(tmp_path / "bo.zip", **{"__MACOSX/a/z/chamfer.py": b"no", "a/b/chamfer.py": b"yes"})
    assert grading.find_submission(path, "chamfer.py")[0] == b"yes"


def test_names_are_sorted_as_people_count_whatever_is_in_them():
    names = ["a", "a 002", "a 10", "a 10\u00b2", "a " + "9" * 5000, "\u00b2"]
    assert sorted(names[::-1], key=grading.in_order) == names


def test_zips_as_windows_and_macs_write_them_are_read(tmp_path):
    path = zipped(tmp_path / "a.zip", **{"work\\chamfer.py": b"windows"})
    assert grading.find_submission(path, "chamfer.py")[0] == b"windows"
    path = zipped(tmp_path / "a.zip", **{"Homework 2: Ann/chamfer.py": b"mac", "z/chamfer.py/": b"a folder"})
    assert grading.find_submission(path, "chamfer.py")[0] == b"mac"


def refused_zips(folder):
    link = zipfile.ZipInfo("chamfer.py")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(folder / "link.zip", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    zipped(folder / "dots.zip", **{"chamfer.py": b"", "../../evil.py": b""})
    zipped(folder / "absolute.zip", **{"/tmp/chamfer.py": b""})
    zipped(folder / "drive.zip", **{"c:\\chamfer.py": b""})
    zipped(folder / "bomb.zip", **{"chamfer.py": b"", "big": bytes(101 << 20)})
    zipped(folder / "long.zip", **{"chamfer.py": bytes(2 << 20)})
    (folder / "null.py").write_bytes(b"x = 1\0")
    zipped(folder / "many.zip", **{f"{i}.py": b"" for i in range(2500)})
    (folder / "millions.zip").write_bytes(b"PK\1\2" * 2_000_000)
    (folder / "damaged.zip").write_bytes(b"PK\3\4 no zip")
    with open(folder / "chamfer.py", "wb") as file:
        file.truncate(100 << 20)
    with open(folder / "large.zip", "wb") as file:
        file.truncate(200 << 20)
    return sorted(folder.iterdir())


def test_what_is_too_large_or_leads_outside_is_refused_in_one_line(tmp_path):
    began = time.monotonic()
    for path in refused_zips(tmp_path):
        with pytest.raises(ValueError) as caught:
            grading.find_submission(path, "chamfer.py")
        assert "\n" not in str(caught.value) and (path.name in str(caught.value) or path.stem == "null"), path
    assert time.monotonic() - began < 10 and len(list(tmp_path.iterdir())) == 12


# --- results -----------------------------------------------------------------------------------------------------

def test_results_are_on_disk_before_the_first_task_and_after_each(tmp_path):
    seen, path = [], tmp_path / "results.json"

    def mark(content):
        seen.append(json.loads(path.read_text()))
        return grading.Mark(1.0, "Right.", "limits")
    grading.grade([grading.Item(f"2.{i} f", 5, mark) for i in range(2)], b"", path)
    seen.append(json.loads(path.read_text()))
    assert [each["score"] for each in seen] == [0, 5, 10]
    assert seen[0]["tests"][1]["output"] == "Not graded yet." and [*seen[2]["tests"][0]] == [
        "max_score", "name", "output", "score", "status"]


def test_a_class_is_graded_past_the_broken_ones_and_goes_on_where_it_was(tmp_path, monkeypatch):
    folder, out = tmp_path / "class", tmp_path / "grades.csv"
    right = grade_class.hostile("os._exit").encode()
    for name, content in (("Ann Lee", right), ("Bo", right), ("Cy", b"x = 1\0\n")):
        (folder / name / "deep er").mkdir(parents=True)
        (folder / name / "deep er" / "chamfer.py").write_bytes(content)
    zipped(folder / "Di attempt 2.zip", **{"chamfer.py": b""})
    zipped(folder / "Di attempt 10.zip", **{"x/chamfer.py": right})
    zipped(folder / "Ed.zip", **{"../chamfer.py": right})
    (folder / "Flo").mkdir()
    for name in (b"=cmd()", b"a\nb", b"\xff\xfe"):
        (folder / os.fsdecode(name) / "chamfer.py").mkdir(parents=True)  # a folder of that name
        os.mkfifo(folder / os.fsdecode(name) / "chamfer.py" / "chamfer.py")
    few = items("seen_in_both")
    monkeypatch.setattr(grading, "items_of", lambda *_: few)
    with ThreadPoolExecutor(2) as pool:
        rows = grading.grade_all(folder, CHAMFER, HOW, out, pool.map)
    found = {row["student"]: float(row["score"]) for row in csv.DictReader(io.StringIO(out.read_text()))}
    assert found == {"Ann Lee": 10, "Bo": 10, "Cy": 0, "Di": 10, "Ed": 0, "Flo": 0, "'=cmd()": 0, "a?b": 0,
                     "??": 0}
    notes = {row["student"]: row["note"] for row in rows}
    assert "'../chamfer.py'" in notes["Ed"] and "no chamfer.py" in notes["Flo"] and notes["??"] == notes["Flo"]
    monkeypatch.setattr(sandbox, "run", None)  # what is finished is not run again
    assert grading.grade_all(folder, CHAMFER, HOW, out) == rows


def test_what_no_one_foresaw_costs_a_class_one_student(tmp_path, monkeypatch):
    for name in ("Ann", "Bo", "Cy"):
        (tmp_path / "class" / name).mkdir(parents=True)

    def found(path, name):
        if path.name == "Cy":
            raise RecursionError("too deep")
        return path.name.encode(), "", 1

    def mark(content):
        if content == b"Bo":
            raise KeyError("ours")
        return grading.Mark(1.0, "Right.", "limits")
    monkeypatch.setattr(grading, "find_submission", found)
    monkeypatch.setattr(grading, "items_of", lambda *_: [grading.Item("2.5 f", 5, mark)])
    rows = grading.grade_all(tmp_path / "class", CHAMFER, HOW, tmp_path / "grades.csv")
    assert [(row["score"], row["note"]) for row in rows] == [(5, ""), (0, "NOT GRADED: 'ours'"), (0, "too deep")]


def test_a_seed_is_a_number_or_a_file_that_not_everybody_reads(tmp_path):
    path = tmp_path / "seed"
    path.write_text("abc")
    path.chmod(0o600)
    tmp_path.chmod(0o755)
    seeds = [grade_commands.seed_from(each) for each in ("17", path, None, None)]
    assert seeds[0] == 17 and len({*seeds}) == 4 and grade_commands.seed_from(path) == seeds[1]
    path.chmod(0o644)
    with pytest.raises(ValueError, match="chmod 600") if os.getuid() == 0 else nullcontext():
        grade_commands.seed_from(path)


REFUSED = [([], "either a submission"), (["a", "--all", "b"], "either a submission"), (["--all", "b"], "--csv"),
           (["--all", "b", "--csv", "c"], "--assignment"), (["nothing.py"], "--assignment"),
           (["nothing", "--assignment", "9"], "assignment: expected"),
           (["setup.cfg", "--assignment", "2", "--task", "x"], "no task x"),
           (["--all", "b", "--csv", "{}/c.csv", "--assignment", "2"], "no such folder b"),
           (["--all", "b", "--csv", "b/c.csv", "--assignment", "2"], "outside of b"),
           (["a", "--assignment", "8"], "--pokes"), (["a", "--assignment", "2", "--out", "a/chamfer.py"], "--out")]


@pytest.mark.parametrize("arguments, words", REFUSED)
def test_the_command_says_in_one_line_what_it_cannot_do(arguments, words, tmp_path, capsys):
    arguments = [each.format(tmp_path) for each in arguments]
    assert main(["grade", "--out", str(tmp_path / "results.json"), *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_the_command_grades_a_submission_without_a_file_with_nothing(tmp_path, capsys):
    assert main(["grade", str(tmp_path), "--assignment", "2", "--out", str(tmp_path / "results.json")]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["score"] == 0 and "no chamfer.py" in results["output"] and "no chamfer.py" in capsys.readouterr().out


def test_the_bundle_has_all_that_an_autograder_needs(tmp_path):
    bundle.write_bundle(CHAMFER, tmp_path / "autograder.zip")
    with zipfile.ZipFile(tmp_path / "autograder.zip") as archive:
        archive.extractall(tmp_path / "source")
        modes = {each.filename: each.external_attr >> 16 & 0o777 for each in archive.infolist()}
    assert modes["setup.sh"] == modes["run_autograder"] == 0o755
    assert len((tmp_path / "source" / "seed").read_text()) > 20
    for name in ("setup.sh", "run_autograder"):
        subprocess.run(["bash", "-n", tmp_path / "source" / name], check=True)
    package = tmp_path / "source" / "package"
    assert (package / "hind4sight_min" / "course" / "worker.py").is_file() and "numpy" in (
        package / "pyproject.toml").read_text()
    assert [*(package / "data_small" / "train").iterdir()] and not [*package.rglob("*.truth.npz")]
    with pytest.raises(ValueError, match="--pokes"):
        bundle.write_bundle(assignment_of("improve"), tmp_path / "autograder.zip")


def test_a_killed_grader_leaves_whole_results_and_no_process(tmp_path):
    (tmp_path / "chamfer.py").write_text(grade_class.hostile("endless loop"))
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        process = subprocess.Popen(
            [sys.executable, "-m", "hind4sight_min", "grade", tmp_path / "chamfer.py", "--assignment", "2", "--task",
             "2.5", "--out", tmp_path / "results.json"],
            env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": folder})
        while len(left_behind(folder)) < 2 and process.poll() is None:  # the guard, and what it watches
            time.sleep(0.05)
        time.sleep(2)  # past its imports: an end of the pipe alone would not stop it any more
        assert process.poll() is None
        first_to_go = [Path(f"/proc/{each}/oom_score_adj").read_text() for each in left_behind(folder)]
        assert {*first_to_go} == {"1000\n"}, "where memory runs out, the students' processes end first"
        process.send_signal(signal.SIGKILL)
        process.wait()
        end = time.monotonic() + 5
        while left_behind(folder) and time.monotonic() < end:
            time.sleep(0.05)
        assert not left_behind(folder), "the guard ends with the grader"
    assert json.loads((tmp_path / "results.json").read_text())["tests"][0]["output"] == "Not graded yet."
