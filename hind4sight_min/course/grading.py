"""From a submission to its grade: results.json in Gradescope's format, a table, a class in a CSV.

A submission is the one file that the exercise asks for, NAME.py, wherever it lies in a folder, a zip file or alone. Its
tasks are graded one by one, each in a process of its own (sandbox.py), and compared here, where that code never runs.
"""
import builtins
import codecs
import csv
import hashlib
import io
import os
import random
import re
import stat
import tokenize
import zipfile
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from ..disk.files import read_json, write_json, write_text
from . import blank, bugs, improve, sandbox
from .assignments import a8_improve, assignment_of
from .task import Answer, judge

MOST_SOURCE, MOST_ZIP, MOST_MEMBERS = 1 << 20, 100 << 20, 2000  # bytes of the file, of a zip unpacked; its files


# --- a submission ------------------------------------------------------------------------------------------------

def in_order(text):
    """A key that sorts names as people count: attempt 2 before attempt 10. Not in the paper: grading."""
    pieces = [each.lstrip("0") if each.isdecimal() else each for each in re.split(r"(\d+)", str(text).lower())]
    return [(len(each) * each.isdecimal(), each) for each in pieces]  # as numbers they may be too long for int


def find_submission(path, name):
    """The file `name` in a file, a zip file or a folder of these -> its bytes, where it was, how many there were.

    Not in the paper: grading. Of several attempts the last by name counts (attempt 10 after attempt 2); times are not
    asked, for unpacking and copying change them.
    Raises ValueError, one line, where there is none, and for what is too large or not to be trusted.
    """
    path = Path(path)
    if path.is_dir():
        inside = sorted((each for each in path.rglob("*") if not each.is_symlink() and each.is_file()
                         and not ignored(each.relative_to(path))), key=in_order)
        candidates = [each for each in inside if each.name == name] or [
            each for each in inside if each.suffix.lower() == ".zip"]
        if not candidates:
            raise ValueError(f"there is no {name} in it")
        content, where, _ = find_submission(candidates[-1], name)
        return content, where, len(candidates)
    if path.suffix.lower() == ".zip":
        return (*read_zip(path, name), 1)
    if not path.is_file():
        raise ValueError(f"{path}: no such file or folder")
    if path.stat().st_size > MOST_SOURCE:
        raise ValueError(f"{path.name} has {path.stat().st_size >> 20} MB, at most {MOST_SOURCE >> 20} MB is read")
    return as_utf8(path.read_bytes()), str(path), 1


def as_utf8(content):
    """Source text in UTF-8, whatever an editor saved it in: also UTF-16 with its mark, and else Latin-1; as it is where
    it says in a comment, `# coding: gbk`, what it is in.

    Not in the paper: grading. Raises ValueError for null bytes in it.
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        content = content.decode("utf-16", errors="replace").encode()
    if b"\0" in content:
        raise ValueError("there are null bytes in it: save it as plain text")
    try:
        if tokenize.detect_encoding(io.BytesIO(content).readline)[0] in ("utf-8", "utf-8-sig"):
            content.decode()
    except (SyntaxError, UnicodeDecodeError):  # SyntaxError: already in its first lines
        content = content.decode("latin-1").encode()
    return content


def ignored(path):
    """Whether a path is of the kind that operating systems and editors leave behind. Not in the paper: grading."""
    return any(part.startswith((".", "__")) for part in Path(path).parts)


def read_zip(path, name):
    """The last file `name` in a zip file -> its bytes, where it was. Nothing is ever unpacked to disk.

    Not in the paper: grading. Raises ValueError, one line, for a zip file that is damaged, too large or leads outside.
    """
    path = Path(path)
    if path.stat().st_size > MOST_ZIP:
        raise ValueError(f"{path.name} has {path.stat().st_size >> 20} MB, at most {MOST_ZIP >> 20} MB are read")
    if path.read_bytes().count(b"PK\1\2") > 2 * MOST_MEMBERS:  # before zipfile makes an object of each
        raise ValueError(f"{path.name}: more than {MOST_MEMBERS} files in it")
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            for each in members:
                each.filename = each.filename.replace("\\", "/")  # as some Windows programs write it
            if len(members) > MOST_MEMBERS or sum(each.file_size for each in members) > MOST_ZIP:
                raise ValueError(f"{path.name}: more than {MOST_MEMBERS} files or {MOST_ZIP >> 20} MB in it")
            for each in members:
                parts = each.filename.split("/")
                if ".." in parts or parts[0] == "" or parts[0][1:2] == ":" or stat.S_ISLNK(each.external_attr >> 16):
                    raise ValueError(f"{path.name}: refused, for {each.filename!r} in it leads out of its folder")
            found = [each for each in members if Path(each.filename).name == name and not each.is_dir()
                     and not ignored(each.filename)]
            found.sort(key=lambda each: in_order(each.filename))
            if not found:
                raise ValueError(f"{path.name}: there is no {name} in it")
            with archive.open(found[-1]) as file:
                content = file.read(MOST_SOURCE + 1)  # what the directory says of its size need not be true
    except Exception as error:  # damage can surface as almost anything: zlib, zipfile, struct, a password
        if type(error) is ValueError and str(error).startswith(path.name):
            raise
        raise ValueError(f"{path.name}: a damaged or locked zip file ({sandbox.one_line(error)})") from None
    if len(content) > MOST_SOURCE:
        raise ValueError(f"{path.name}: {name} in it has more than {MOST_SOURCE >> 20} MB")
    return as_utf8(content), f"{path}: {found[-1].filename}"


# --- one task ----------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Item:
    """What earns points: its name, the points, and a function of the submission's bytes -> Mark."""
    name: str
    points: float
    mark: callable


@dataclass(frozen=True)
class Mark:
    """share: of the points, in [0, 1]. sentence: for the student. isolation: what was in force, in words. figures: for
    the leaderboard, name -> number, the smaller the better.
    """
    share: float
    sentence: str
    isolation: str
    figures: dict = field(default_factory=dict)


@dataclass(frozen=True)
class How:
    """How to grade. seed: of the inputs; None for those that the student has (public). limits: of each process; None
    for the usual ones. pokes: folder of assignment 8's, with their truth. namespaces: see sandbox.run.
    """
    seed: int = None
    limits: sandbox.Limits = None
    pokes: str = None
    namespaces: bool = True


def mark_task(assignment, task, how, content):
    """Grade one task -> Mark: half for the values, half for the gradients. Not in the paper: grading."""
    rng = np.random.default_rng(0 if how.seed is None else [how.seed, *map(int, task.number.split("."))])
    cases, file = task.cases(rng), f"{assignment.name}.py"
    outcome = sandbox.run(blank.package_for(task.name), {
        "kind": "task", "files": {file: content}, "file": file, "number": task.number, "cases": cases},
        how.limits or sandbox.Limits(), how.namespaces)
    if outcome.failure:
        missing = f"ValueError: {file}: there is no function {task.function}"
        return Mark(0.0, failure_of(outcome, how, missing), outcome.isolation)
    try:
        answers = answers_from(outcome.answer)
        if how.seed is not None:
            answers[1:] = [replace(each, error=quiet(each.error)) for each in answers[1:]]  # students have the first
        verdict = judge(task, cases, answers)
    except (MemoryError, RuntimeError):  # ours: the reference itself fails
        raise
    except Exception as error:  # answers of a form that no honest answer has
        return Mark(0.0, f"What came back is no answer ({type(error).__name__}).", outcome.isolation)
    sentence = sandbox.one_line(verdict.sentence, most=600) or "Right."
    return Mark(verdict.share, sentence + printed(outcome, how), outcome.isolation)


def answers_from(raw):
    """What `worker.answer_task` gave -> list of Answers. Raises ValueError where it is not of that form."""
    found = []
    for value, gradients, error in raw:
        arrays = [*value, *gradients.values()]
        if not all(isinstance(each, np.ndarray) for each in arrays) or not isinstance(error, (str, type(None))):
            raise ValueError("answer: expected arrays")
        found.append(Answer(tuple(value), gradients, error and sandbox.one_line(error)))
    return found


def quiet(error):
    """An exception's type and line. The rest could tell the student the inputs that are held back."""
    if not error:
        return error
    name, line = error.partition(":")[0], re.search(r"line (\d{1,4})\b", error)
    name = name if isinstance(getattr(builtins, name, None), type) else "an exception"
    return f"{name} in line {line[1]}" if line else name


def failure_of(outcome, how, harmless=""):
    """What to say where there is no answer; of an exception no text but `harmless`, where inputs are held back."""
    if outcome.raised and how.seed is not None and outcome.failure != harmless:
        return f"It raised {quiet(outcome.failure)}; on the public inputs you see the text."
    return outcome.failure + printed(outcome, how)


def printed(outcome, how):
    """The last of what the student's code printed, for whoever has the inputs anyway, or nothing."""
    text = "".join(each for each in outcome.prints[-1000:] if each.isprintable() or each == "\n").strip()
    return f"\nPrinted:\n{text}" if text and how.seed is None else ""


def mark_bug(assignment, number, how, content):
    """Grade one measurement of assignment 7 -> Mark, on the right package and on the mutant, one of them twice.

    Not in the paper: grading. The order is drawn, and so is that in which the packages are made: the clock, or the age
    of a file, would tell them apart. Tossing a coin succeeds in one case of eight.
    """
    for which in random.sample(range(len(bugs.MUTANTS) + 1), len(bugs.MUTANTS) + 1):
        blank.package_for(which)
    found, file = {0: [], number: []}, f"{assignment.name}.py"
    for which in random.sample((0, number, random.choice((0, number))), 3):
        outcome = sandbox.run(blank.package_for(which), {
            "kind": "bug", "files": {file: content}, "file": file, "number": number},
            how.limits or sandbox.Limits(), how.namespaces)
        found[which].append(outcome.failure or measured(outcome.answer))
    verdict = min((bugs.judge(number, *pair) for pair in product(found[0], found[number])), key=lambda each: each.share)
    return Mark(verdict.share, sandbox.one_line(verdict.sentence) or "Right.", outcome.isolation)


def measured(answer):
    """Three numbers, or a str that says what went wrong: all that `bugs.judge` is to be given."""
    if isinstance(answer, list) and [type(each) for each in answer] == [float] * 3:
        return tuple(answer)
    return answer if isinstance(answer, str) else "what came back is no answer"


def mark_improved(assignment, how, content):
    """Grade assignment 8 -> Mark: train in the student's process, score here. Not in the paper: grading."""
    file = f"{assignment.name}.py"
    job = improve.question(how.pokes, seed=int(np.random.default_rng([how.seed or 0, 8]).integers(2 ** 31)))
    outcome = sandbox.run(blank.package_for(), {"kind": "improve", "files": {file: content}, "file": file, **job},
                          how.limits or improve.LIMITS, how.namespaces)
    if outcome.failure:
        return Mark(0.0, failure_of(outcome, how), outcome.isolation)
    try:
        ratio, error = improve.score(outcome.answer, how.pokes)
    except ValueError as error:
        return Mark(0.0, str(error), outcome.isolation)
    return Mark(improve.share_of(ratio), f"flow_mse_ratio {ratio:.4f} \u00b1 {error:.4f}", outcome.isolation,
                {"flow_mse_ratio": round(ratio, 4)})


def items_of(assignment, how):
    """What an assignment's points are given for -> list of Items. Not in the paper: grading."""
    if assignment.name == "improve":
        return [Item("8.1 improve", a8_improve.POINTS, partial(mark_improved, assignment, how))]
    if assignment.name == "bugs":
        return [Item(f"7.{number} bug {number}", bugs.POINTS, partial(mark_bug, assignment, number, how))
                for number in range(1, len(bugs.MUTANTS) + 1)]
    return [Item(f"{task.number} {task.function}", task.points, partial(mark_task, assignment, task, how))
            for task in assignment.tasks]


# --- one submission ----------------------------------------------------------------------------------------------

def grade(items, content, out=None, only=None, note="", on_item=None):
    """Grade a submission's bytes -> the results, a dict in Gradescope's format.

    Not in the paper: grading. It is written to `out`, whole, before the first item and after every one, so that nothing
    that happens in between loses a grade. only: the number of the one task to grade. content None: `note` says why.
    on_item(test) is called after each.
    """
    items = [item for item in items if only in (None, item.name.split()[0])]
    if not items:
        raise ValueError(f"--task: there is no task {only}")
    waiting = note or "Not graded yet."
    tests = [{"name": item.name, "score": 0.0, "max_score": item.points, "output": waiting, "status": "failed"}
             for item in items]
    results = {"score": 0.0, "output": note, "tests": tests, "extra_data": {"isolation": "", "finished": False}}
    write_json(out, results)
    for item, test in zip(items, tests):
        if content is not None:
            mark = item.mark(content)
            test.update(score=round(mark.share * item.points, 2), output=mark.sentence,
                        status="passed" if mark.share == 1 else "failed")
            results["extra_data"]["isolation"] = mark.isolation
            if mark.figures:
                results["leaderboard"] = [{"name": name, "value": value, "order": "asc"}
                                          for name, value in mark.figures.items()]
        results["score"] = round(sum(each["score"] for each in tests), 2)
        results["extra_data"]["finished"] = item is items[-1]
        write_json(out, results)
        if on_item:
            on_item(test)
    return results


def total_of(results):
    """The points that could be had."""
    return sum(test["max_score"] for test in results["tests"])


def table(results):
    """The results as lines for a terminal. Not in the paper: grading."""
    lines = [f"{test['name']:<34}{test['score']:>6g} of {test['max_score']:<4g} {test['output']}"
             for test in results["tests"]]
    lines.append(f"{'together':<34}{results['score']:>6g} of {total_of(results):<4g} {results['output']}")
    return "\n".join([*lines, f"isolation: {results['extra_data']['isolation'] or 'nothing was run'}"])


# --- a class -----------------------------------------------------------------------------------------------------

ATTEMPT = re.compile(r"[ _-]*\(?\b(attempt|version|v)[ _-]*\d+\)?$", re.IGNORECASE)


def students(folder):
    """A folder's submissions by student, in order -> dict name -> list of paths, the last to count.

    Not in the paper: grading. A student is a folder or a zip or .py file; `ann attempt 1.zip` and `ann attempt 2.zip`
    are one.
    """
    if not Path(folder).is_dir():
        raise ValueError(f"--all: no such folder {folder}")
    found = {}
    for path in sorted(Path(folder).iterdir(), key=lambda path: in_order(path.name)):
        usual = path.is_dir() or path.suffix.lower() in (".zip", ".py")
        if usual and not ignored(path.name) and not path.is_symlink():
            name = path.name if path.is_dir() else path.stem
            found.setdefault(ATTEMPT.sub("", name) or name, []).append(path)
    return found


def results_folder(out):
    """The folder beside a CSV file where finished grades lie, for nobody else to read; made where there is none."""
    folder = Path(out).with_name(f"{Path(out).stem}_results")
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder


def as_cell(text):
    """Text for a CSV file and a terminal: printable, and no formula to a spreadsheet. Not in the paper: grading."""
    text = "".join(each if each.isprintable() else "?" for each in text)
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


def write_csv(path, rows):
    """Write dicts of the same keys as a CSV file, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def finished(path):
    """The results in a file; None where there are none, or not yet all."""
    try:
        results = read_json(path)
        return results if results["extra_data"]["finished"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def grade_once(name, how, path, content, note):
    """Grade a submission to the assignment `name` unless `path` has its finished results -> the results, the note."""
    results, items = None if content is None else finished(path), items_of(assignment_of(name), how)
    if results:
        return results, note
    try:
        return grade(items, content, path, note=note), note
    except Exception as error:  # ours, as where the sandbox could not begin: not the student's fault
        return read_json(path), f"NOT GRADED: {error}"


def grade_all(folder, assignment, how, out, map=map, on_student=None):
    """Grade a folder of submissions -> rows, dicts, of the CSV file `out`, which is rewritten whole after each.

    Not in the paper: grading. What is finished lies beside it in OUT_results/, by the hash of the submission and of how
    it was graded: started again, only what is missing is done. Students who hand in the same bytes share a grade. What
    goes by a figure has OUT_leaderboard.csv too, the best first.
    map: as Python's; that of an executor grades several at a time. on_student(row, results) is called after each.
    """
    out, kept, about, todo, rows, places = Path(out).absolute(), results_folder(out).absolute(), [], {}, [], []
    for name, attempts in students(folder).items():
        content, note, where, count = None, "", "", len(attempts)
        try:
            content, where, inside = find_submission(attempts[-1], f"{assignment.name}.py")
            count += inside - 1
            key = hashlib.sha256(f"{assignment.number} {how.seed} {how.pokes}\n".encode() + content).hexdigest()[:20]
        except Exception as error:  # also a folder too deep to walk through
            note, key = sandbox.one_line(error), hashlib.sha256(os.fsencode(name)).hexdigest()[:20]
        about.append((name, count, where, kept / f"{key}.json"))
        todo.setdefault(kept / f"{key}.json", (content, note))
    graded, found = map(partial(grade_once, assignment.name, how), todo, *zip(*todo.values())), {}
    for name, count, where, path in about:
        if path not in found:
            found[path] = next(graded)  # in the same order
        results, note = found[path]
        rows.append({"student": as_cell(name), "score": results["score"], "of": total_of(results), "attempts": count,
                     "file": as_cell(where), "note": as_cell(note), "results": path.name,
                     **{test["name"].split()[0]: test["score"] for test in results["tests"]}})
        write_csv(out, rows)
        places += [{"student": as_cell(name), each["name"]: each["value"]} for each in results.get("leaderboard", ())]
        if places:
            figure = [*places[0]][1]
            write_csv(out.with_name(f"{out.stem}_leaderboard.csv"), sorted(places, key=lambda place: place[figure]))
        if on_student:
            on_student(rows[-1], results)
    return rows
