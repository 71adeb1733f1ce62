"""The autograder of one assignment as Gradescope wants it: a zip with setup.sh and run_autograder, this package and the
seed of the held-back inputs. Nothing in it asks for Gradescope: any container, or a folder of your own, will do.
"""
import secrets
import shutil
import tempfile
import zipfile
from importlib.metadata import requires
from pathlib import Path

from .. import __version__
from ..disk.files import data_small, whole_file
from .bugs import PACKAGE

NOT_NEEDED = ("pybullet",)  # to simulate; students leave `import matplotlib` in

SETUP = """#!/bin/bash
# Once, when the container is built. AUTOGRADER: the folder of it all.
set -e
AUTOGRADER="${AUTOGRADER:-/autograder}"
PYTHON="${PYTHON:-python3}"
if ! "$PYTHON" -c 'import sys, ensurepip; assert sys.version_info >= (3, 10)'; then
    apt-get update && apt-get install -y python3 python3-venv
fi
"$PYTHON" -m venv "$AUTOGRADER/venv"
"$AUTOGRADER/venv/bin/pip" install --quiet --disable-pip-version-check "$AUTOGRADER/source/package"
# The students' code runs as another user: it may read neither the solutions nor the seed.
chmod 700 "$AUTOGRADER/source" "$AUTOGRADER"/venv/lib/python3*/site-packages/hind4sight_min
"""

RUN = """#!/bin/bash
# For every submission: $AUTOGRADER/submission -> $AUTOGRADER/results/results.json
AUTOGRADER="${AUTOGRADER:-/autograder}"
mkdir -p "$AUTOGRADER/results"
chmod 700 "$AUTOGRADER/source" "$AUTOGRADER/submission" "$AUTOGRADER/results"
cd "$AUTOGRADER"
"$AUTOGRADER/venv/bin/python" -I -m hind4sight_min grade submission --assignment %s --seed source/seed%s \\
    --out results/results.json
"""

PROJECT = """[build-system]
requires = ["setuptools>=64"]
build-backend = "setuptools.build_meta"

[project]
name = "hind4sight_min"
version = "%s"
requires-python = ">=3.10"
dependencies = [%s]

[tool.setuptools.packages.find]
include = ["hind4sight_min*"]

[tool.setuptools.data-files]
"share/hind4sight_min/data_small/train" = ["data_small/train/*.npz"]
"""


def write_bundle(assignment, out, seed=None, pokes=None):
    """Write the autograder of an assignment, a .zip or a new folder.

    Not in the paper: grading. seed: a file with the seed of the held-back inputs; None draws one. pokes: a folder of
    held-back pokes with their truth, for assignment 8.
    Raises ValueError where assignment 8 has no pokes, or `out` is a folder that is there already.
    """
    out = Path(out)
    if assignment.name == "improve" and not pokes:
        raise ValueError("--pokes: assignment 8 is scored on pokes that students do not have; `collect` makes some")
    if out.suffix != ".zip" and out.exists():
        raise ValueError(f"out: expected a new folder or a .zip, got {out}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, "bundle")
        shutil.copytree(PACKAGE, folder / "package" / PACKAGE.name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copytree(data_small() / "train", folder / "package" / "data_small" / "train",
                        ignore=shutil.ignore_patterns("*.truth.npz"))
        names = [each for each in requires("hind4sight_min")
                 if "extra ==" not in each and not each.startswith(NOT_NEEDED)]
        (folder / "package" / "pyproject.toml").write_text(
            PROJECT % (__version__, ", ".join(f'"{each}"' for each in names)))
        if pokes:
            shutil.copytree(pokes, folder / "pokes")
        (folder / "seed").write_text(Path(seed).read_text() if seed else secrets.token_hex(16))
        (folder / "seed").chmod(0o600)
        given = " --pokes source/pokes" if pokes else ""
        for name, text in (("setup.sh", SETUP), ("run_autograder", RUN % (assignment.number, given))):
            (folder / name).write_text(text)
            (folder / name).chmod(0o755)
        if out.suffix != ".zip":
            shutil.copytree(folder, out)
            return
        with whole_file(out) as path, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for each in sorted(folder.rglob("*")):
                archive.write(each, each.relative_to(folder))
