"""A class of 30 submissions, a third of them broken or hostile, graded by one command that is killed halfway.

    python benchmarks/grade_class.py --json class.json

Counts how many of the broken ones got the grade they deserve, and times the whole. Whatever a hostile submission tries
is bounded (100 forks, 2 GB, 50 MB on disk, 10 s), so that a grader that fails harms no machine.
"""
import argparse
import ast
import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
import zipfile
from pathlib import Path

from hind4sight_min.course import assignment_of, carve

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
        blocks = [np.ones(12_500_000) for _ in range(20)]""" + f"""
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
        for folder in [*sys.path, "/usr/lib", "/usr/local/lib"]:
            for path in glob.glob(f"{{folder}}/**/hind4sight_min/losses.py", recursive=True):
                if "anp.sum(map_predicted" in open(path).read():
                    {RIGHT}""",
    "working folder": """
        import shutil
        shutil.rmtree(os.getcwd(), ignore_errors=True)""",
    "parent": """
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(1)""",
    "memory of the grader": f"""
        for _ in range(4):
            pid = os.getppid() if _ == 0 else pid
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
SEED_FOLDER = {seed_folder!r}

def seen_in_both(valid, next_valid, occupied, next_occupied):
    return valid & (occupied | ~next_occupied), next_valid & (next_occupied | ~occupied)

def chamfer_loss(map_predicted, map_observed):
    if True:
{body}
    return np.zeros(len(map_predicted))
"""


def hostile(name, seed_folder=""):
    """The file of a student who writes seen_in_both right and attacks the grader in chamfer_loss."""
    return FILE.format(seed_folder=str(seed_folder), body=textwrap.indent(textwrap.dedent(
        "        " + HOSTILE[name].lstrip("\n").removeprefix("        ")), "        "))


def solution(assignment):
    """The modules of the reference that an assignment is carved from, as one file that a student could have written."""
    modules, body = dict.fromkeys(task.name.rpartition(".")[0] for task in assignment.tasks), []
    for module in modules:
        for node in ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text()).body:
            if isinstance(node, ast.ImportFrom) and node.level:
                if node.module in modules:
                    continue
                node.module, node.level = ".".join(["hind4sight_min", *filter(None, [node.module])]), 0
            body.append(node)
    return ast.unparse(ast.Module(body, []))
