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
import time
import zipfile
from pathlib import Path

from hind4sight_min.course import assignment_of, carve

PACKAGE = Path(carve.__file__).resolve().parents[1]


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
