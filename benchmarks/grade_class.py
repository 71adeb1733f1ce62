"""A class of 30 submissions, a third of them broken or hostile, graded by one command that is killed halfway.

    python benchmarks/grade_class.py --json class.json
    python benchmarks/grade_class.py --attacks --without-namespaces     # what holds where the kernel gives none

Then the student's loop: one function is changed and its own test run. Then every attack by itself: a table
of which got no point for it and cost the honest task none. Whatever a hostile submission tries is bounded (100 forks,
2 GB, 50 MB on disk, 10 s), so that a grader that fails harms no machine.
"""
import argparse
import ast
import csv
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
import zipfile
from pathlib import Path

from hind4sight_min.course import ASSIGNMENTS, assignment_of, carve, grading
from hind4sight_min.disk.files import write_json

PACKAGE = Path(carve.__file__).resolve().parents[1]
RIGHT = "return map_predicted.sum(axis=1) + map_observed.sum(axis=1)"

# What the function chamfer_loss does instead of its task. It answers right only where its attack went through.
HOSTILE = {
    "endless loop": """
        end = time.time() + 10
        while time.time() < end:
            pass""",
    "fork bomb": """
        for _ in range(100):
            try:
                if os.fork() == 0:
                    time.sleep(10)
                    os._exit(0)
            except OSError:
                pass""",
    "os._exit": "os._exit(0)",
    "sys.exit": "sys.exit(0)",
    "memory": """
        if "blocks" not in globals():
            globals()["blocks"] = [np.zeros(12_500_000) for _ in range(20)]""" + f"""
        {RIGHT}""",
    "output": f"""
        for _ in range(50):
            print("x" * 2 ** 20)
        {RIGHT}""",
    "numpy.testing": """
        import numpy.testing
        for module in (np, numpy.testing):
            for name in ("allclose", "array_equal", "assert_allclose", "assert_array_equal", "isfinite"):
                setattr(module, name, lambda *arguments, **options: True)""",
    "sys.modules": """
        import hind4sight_min.course.task
        import hind4sight_min.losses
        sys.modules["hind4sight_min"] = types.SimpleNamespace(losses=hind4sight_min.losses)
        hind4sight_min.course.task.judge = lambda *_: hind4sight_min.course.task.Verdict(True, True, "")
        return hind4sight_min.losses.chamfer_loss(map_predicted, map_observed)""",
    "known mistakes": """
        from hind4sight_min.course import assignment_of
        task, = [task for task in assignment_of("chamfer").tasks if task.name == "losses.chamfer_loss"]
        for mistake in task.mistakes.values():
            return -mistake(map_predicted, map_observed)""",
    "installed package": f"""
        import glob
        for folder in [*sys.path, PACKAGE]:
            for path in glob.glob(f"{{folder}}/hind4sight_min/losses.py"):
                if "anp.sum(map_predicted" in open(path).read():
                    {RIGHT}""",
    "working folder": """
        import shutil
        shutil.rmtree(os.getcwd(), ignore_errors=True)""",
    "parent": """
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(0.2)""",
    "memory of the grader": f"""
        pid = os.getppid()
        for _ in range(2):  # the process that watches this one, and the grader
            try:
                open(f"/proc/{{pid}}/mem", "rb").close()
                {RIGHT}
            except PermissionError:
                pid = int(open(f"/proc/{{pid}}/stat").read().rpartition(")")[2].split()[1])""",
    "held-back inputs": f"""
        for folder in (os.environ.get("SEED_FOLDER", "/"), SEED_FOLDER):
            if os.path.isfile(folder + "/seed") and open(folder + "/seed").read():
                {RIGHT}""",
    "fake results": """
        fake = json.dumps({"score": 100.0, "tests": [{"name": "2.5", "score": 10, "max_score": 10}]})
        print(fake, flush=True)
        for path in ("results.json", "../results.json", "/autograder/results/results.json"):
            try:
                open(path, "w").write(fake)
            except OSError:
                pass
        for descriptor in range(64):
            try:
                os.write(descriptor, fake.encode())
            except OSError:
                pass""",
}
FILE = """
import json, os, signal, sys, time, types
import numpy as np
SEED_FOLDER, PACKAGE = {seed_folder!r}, {package!r}

def seen_in_both(valid, next_valid, occupied, next_occupied):
    return valid & (occupied | ~next_occupied), next_valid & (next_occupied | ~occupied)

def chamfer_loss(map_predicted, map_observed):
    if True:
{body}
    return np.zeros(len(map_predicted))
"""


def hostile(name, seed_folder=""):
    """The file of a student who writes seen_in_both right and attacks the grader in chamfer_loss."""
    return FILE.format(seed_folder=str(seed_folder), package=str(PACKAGE.parent), body=textwrap.indent(textwrap.dedent(
        "        " + HOSTILE[name].lstrip("\n").removeprefix("        ")), "        "))


def solution(assignment):
    """The modules of the reference that an assignment is carved from, as one file that a student could have written."""
    modules, body = dict.fromkeys(task.name.rpartition(".")[0] for task in assignment.tasks), []
    for module in modules:
        for node in ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text()).body:
            if isinstance(node, ast.ImportFrom) and node.level:
                package = ".".join(["hind4sight_min", *module.split(".")][:-node.level])
                node.module, node.level = importlib.util.resolve_name("." + (node.module or ""), package).rstrip("."), 0
                if node.module.removeprefix("hind4sight_min.") in modules:
                    continue
            body.append(node)
    return ast.unparse(ast.Module(body, []))


# --- files that are broken as a whole -------------------------------------------------------------------------

def write_broken(folder, seed_folder=""):
    """Submissions that are broken as files, into a folder -> dict of their paths and the points they deserve for
    chamfer_loss and seen_in_both, 10 each.
    """
    honest = hostile("os._exit", seed_folder)
    texts = {"null bytes": (honest.encode() + b"\0", 0), "byte order mark": (b"\xef\xbb\xbf" + honest.encode(), 10),
             "latin-1": ("NAME = 'caf\u00e9'\n".encode("latin-1") + honest.encode(), 10), "100 MB": (b"", 0)}
    found = {}
    for name, (content, points) in texts.items():
        path = Path(folder, name, "chamfer.py")
        path.parent.mkdir(parents=True)
        path.write_bytes(content)
        found[name] = path, points
    os.truncate(found["100 MB"][0], 100 << 20)
    path = Path(folder, "leads outside.zip")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("../../chamfer.py", honest)
    return {**found, "leads outside": (path, 0)}


# --- the class ------------------------------------------------------------------------------------------------

def write_class(folder):
    """Thirty submissions, in every shape in which they are handed in -> dict name -> expected points of 100."""
    assignment, expected = assignment_of("chamfer"), {}
    right, skeleton = solution(assignment), carve.exercise_text(assignment)
    half = skeleton + FILE.split("def chamfer_loss")[0].format(seed_folder="", package="")
    for i in range(20):
        name, (text, points) = f"student {i:02}", ((right, 100), (half, 10), (skeleton, 0))[i % 3]
        expected[name], text = points, f"{text}\n# {name}\n"
        if i % 4 == 3:
            with zipfile.ZipFile(folder / f"{name} attempt 2.zip", "w") as archive:
                archive.writestr("my work/chamfer.py", text)
            (folder / f"{name} attempt 1.zip").write_bytes(b"an upload that broke off")
        else:
            path = folder / name / ("handed in" if i % 2 else "") / "chamfer.py"
            path.parent.mkdir(parents=True)
            path.write_text(text)
    for name in ("endless loop", "fork bomb", "os._exit", "memory", "output", "parent", "fake results"):
        (folder / name).mkdir()
        (folder / name / "chamfer.py").write_text(hostile(name))
        expected[name] = 10
    for name, (_, points) in write_broken(folder).items():
        expected[name] = points
    for name in ("byte order mark", "latin-1"):  # thirty in all
        del expected[name]
        shutil.rmtree(folder / name)
    return expected


def grades(path):
    """Student -> points, of a CSV file; none where there is no file yet."""
    if not path.is_file():
        return {}
    with open(path, newline="") as file:
        return {row["student"]: float(row["score"]) for row in csv.DictReader(file)}


def time_class(folder, jobs):
    """Grade the class, killed halfway and started again -> seconds, students with another grade than expected."""
    (folder / "class").mkdir()
    expected, out = write_class(folder / "class"), folder / "grades.csv"
    command = [sys.executable, "-m", "hind4sight_min", "grade", "--all", folder / "class", "--csv", out, "--assignment",
               "chamfer", "--jobs", str(jobs)]
    began = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while len(grades(out)) < len(expected) // 2 and process.poll() is None:
            time.sleep(0.2)
        process.kill()
    kept = len(grades(out))
    subprocess.run(command, check=True)
    seconds, found = time.perf_counter() - began, grades(out)
    wrong = [f"{name}: {found.get(name)} instead of {points}" for name, points in expected.items()
             if found.get(name) != points]
    print(f"{len(expected)} submissions in {seconds:.0f} s, killed after {kept}; wrong: {', '.join(wrong) or 'none'}")
    return seconds, wrong


def time_student_loop(folder, rounds=3):
    """From saving the file to the verdict on one task, in the exercise as it is handed out -> median of seconds."""
    carve.start(assignment_of("chamfer"), folder / "exercise")
    path, seconds = folder / "exercise" / "chamfer.py", []
    for i in range(rounds):
        path.write_text(path.read_text() + f"# {i}\n")
        began = time.perf_counter()
        subprocess.run([sys.executable, "-m", "pytest", "-q", "-k", "2_3"], cwd=path.parent, capture_output=True)
        seconds.append(time.perf_counter() - began)
    print(f"one task's own test takes {sorted(seconds)[rounds // 2]:.1f} s")
    return sorted(seconds)[rounds // 2]


# --- the attacks ----------------------------------------------------------------------------------------------

def try_attacks(folder, how):
    """Every attack by itself -> dict of whether it was held: no point for it, all points of the honest task."""
    items = [item for item in grading.items_of(assignment_of("chamfer"), how) if item.points == 10
             and item.name.split()[1] in ("chamfer_loss", "seen_in_both")]
    (folder / "seed").write_text("the seed of the held-back inputs")
    (folder / "seed").chmod(0o600)
    cases = {**{name: (hostile(name, folder).encode(), 10) for name in HOSTILE}, **write_broken(folder)}
    held = {}
    for name, (content, points) in cases.items():
        note = ""
        if isinstance(content, Path):
            try:
                content, _, _ = grading.find_submission(content, "chamfer.py")
            except ValueError as error:
                content, note = None, str(error)
        results = grading.grade(items, content, note=note)
        held[name] = results["score"] == points
        print(f"{name:<24}{'held' if held[name] else 'WENT THROUGH':<14}{results['tests'][0]['output'][:80]}",
              flush=True)
    isolation = grading.grade(items, b"")["extra_data"]["isolation"]
    print(f"{sum(held.values())} of {len(held)} held; isolation: {isolation}")
    return held


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--attacks", action="store_true", help="these alone, without the class")
    parser.add_argument("--without-namespaces", action="store_true", help="the attacks, as if the kernel gave none")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        if not args.attacks:
            seconds, wrong = time_class(Path(folder), args.jobs)
            tasks = [task for assignment in ASSIGNMENTS for task in assignment.tasks]
            figures = {"grade_30_seconds": seconds, "course_wrong_grades_of_30": len(wrong),
                       "student_loop_seconds": time_student_loop(Path(folder)), "course_tasks": len(tasks),
                       "course_mistakes_with_feedback": sum(len(task.mistakes) for task in tasks)}
        held = try_attacks(Path(folder), grading.How(seed=7, namespaces=not args.without_namespaces))
        figures.update(course_hostile_cases=len(held), course_hostile_cases_held=sum(held.values()))
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
