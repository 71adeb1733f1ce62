"""Assignment 7, find the silent bug: twelve mutants of the reference, each given by its symptom alone.

A mutant is a change of the source. The student gets it compiled, without the source, and names one number that shows
it: measure_NN(package) lies inside EXPECTED_NN = (low, high) for right code and outside for the mutant.
"""
import importlib
import importlib.util
import marshal
import math
import sys
import tempfile
import warnings
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

from .task import Verdict, described, namespace_of

PACKAGE = Path(__file__).resolve().parent.parent
PARTS = ("geometry", "ops", "losses", "interactions", "scene", "networks", "training", "planning", "disk.shards",
         "disk.checkpoints", "lab.evaluation", "lab.noise")
POINTS = 10  # each


class Mutant(NamedTuple):
    """In a file of the package, `text`, which occurs there once, becomes `instead`."""
    symptom: str
    file: str
    text: str
    instead: str


MUTANTS = (
    Mutant("Whatever is seen stands some millimetres beside where it is, always to the same side, and the more the "
           "further away it is. With the simulator's camera nothing is wrong: its optical axis goes through the middle "
           "of the picture.",
           "geometry.py", "np.arange(camera.width) - camera.cx", "np.arange(camera.width) - (camera.width - 1) / 2"),
    Mutant("Small pushes are predicted well. Objects that turn by a quarter or more come out a little too large or too "
           "small, as if they were of rubber.",
           "geometry.py", "half * half / 2 * anp", "half / 2 * anp"),
    Mutant("On the simulator's complete depth pictures all is well. With a real camera, whose depth has holes, the "
           "Chamfer distance of a scene with itself, moved by a millimetre, is that of another scene.",
           "ops.py", "rows[tree.query(q[i, asked], workers=threads)[1]]",
           "tree.query(q[i, asked], workers=threads)[1]"),
    Mutant("The Chamfer distance has the right value and training makes it smaller, but slower than the other terms; "
           "with twice the paper's weight everything is as published.",
           "ops.py", "pull = 2 * g[:, None]", "pull = g[:, None]"),
    Mutant("Everything trains, and a layer's gradient agrees with central differences wherever one looks first. Yet "
           "the trunk's rounds, whose layers add their input to their output, learn worse than they should.",
           "ops.py", "ans > (x if residual else 0)", "ans > 0"),
    Mutant("Objects that are pushed out of the picture are predicted to stop at its border.",
           "losses.py", "np.reshape(valid, in_view.shape) & in_view", "np.reshape(valid, in_view.shape)"),
    Mutant("The distance map of the second frame is smoothed across the outline of the object where it stands now, and "
           "sharp where it stood before.",
           "losses.py", "anp.reshape(map_observed, grid), next_images", "anp.reshape(map_observed, grid), images"),
    Mutant("The inverse model trains as ever, cross entropies and all. Yet the pokes it names end one or two "
           "centimetres from the true ones, always on the same side, wherever they are in the arena.",
           "interactions.py", "+ 0.5) * settings[\"cell\"]", "+ 0.0) * settings[\"cell\"]"),
    Mutant("L_sim falls to nearly zero in the first hundreds of steps, and the predicted flow is none the better.",
           "networks.py", "encode({name: getval(value) for name, value in params.items()}, points)",
           "encode(params, points)"),
    Mutant("Pokes along the arena's x axis are predicted well; the more a poke goes along y, the more the objects are "
           "predicted to go the other way.",
           "networks.py", "np.swapaxes(axes, 1, 2))\n    return", "axes)\n    return"),
    Mutant("Planning converges in four rounds, but for goals to the left (-x): there the candidates still point in all "
           "directions in the last round.",
           "planning.py", "away[..., 2] = wrapped(away[..., 2])", "away[..., 2] = away[..., 2]"),
    Mutant("With optimiser=\"adam\" the loss leaps up in the first ten steps, whatever the seed, before it falls as it "
           "should. A lower learning rate helps, and then the rest of the run is slow.",
           "training.py", "1 - beta2 ** run.step", "1 - beta1 ** run.step"),
)


# --- packages -----------------------------------------------------------------------------------------------------

def mutated(number):
    """(file, text) of the changed file of a mutant, from 1. Raises ValueError where the change does not fit."""
    mutant = MUTANTS[number - 1]
    source = (PACKAGE / mutant.file).read_text(encoding="utf-8")
    if source.count(mutant.text) != 1:
        raise ValueError(f"mutant {number}: expected once in {mutant.file}: {mutant.text}")
    return mutant.file, source.replace(mutant.text, mutant.instead)


def write_compiled(number, folder, name="package"):
    """The package with a mutant, or 0 for none, compiled, as `folder`/`name`; the course is left out."""
    changed = dict([mutated(number)] if number else [])
    for path in PACKAGE.rglob("*.py"):
        inside = path.relative_to(PACKAGE)
        if inside.parts[0] != "course":
            text = changed.get(str(inside)) or path.read_text(encoding="utf-8")
            target = Path(folder, name, inside).with_suffix(".pyc")
            target.parent.mkdir(parents=True, exist_ok=True)
            code = compile(text, f"{name}/{inside}", "exec", dont_inherit=True)
            target.write_bytes(importlib.util.MAGIC_NUMBER + bytes(12) + marshal.dumps(code))


def import_package(folder, name="package"):
    """Import what `write_compiled` wrote, with its modules: package.losses, package.lab.evaluation and so on."""
    sys.path.insert(0, str(folder))
    try:
        for part in PARTS:
            importlib.import_module(f"{name}.{part}")
        return sys.modules[name]
    finally:
        sys.path.remove(str(folder))


def broken(number):
    """The package with bug `number`, 1 to 12, or the right one for 0, to try things: broken(1).losses and so on."""
    if not 0 <= number <= len(MUTANTS):
        raise ValueError(f"number: expected 0 to {len(MUTANTS)}, got {number}")
    name = f"bug_{number:02}"
    if name not in sys.modules:
        with tempfile.TemporaryDirectory() as folder:
            write_compiled(number, folder, name)
            import_package(folder, name)
    return sys.modules[name]


# --- measuring and judging ----------------------------------------------------------------------------------------

def measure(path, number, package):
    """What a student's file says of a package -> (low, high, value), floats, or a str: what went wrong.

    The reference itself cannot be imported meanwhile: a measurement that compares with it would be none.
    """
    hidden = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == PACKAGE.name}
    sys.modules.update(dict.fromkeys(hidden))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            namespace = namespace_of(path)
            expected = namespace.get(f"EXPECTED_{number:02}")
            if not isinstance(expected, (tuple, list)) or len(expected) != 2:
                raise ValueError(f"EXPECTED_{number:02}: expected (low, high), got {expected}")
            return float(expected[0]), float(expected[1]), float(namespace[f"measure_{number:02}"](package))
    except ImportError as error:
        if (error.name or "").partition(".")[0] == PACKAGE.name:
            return "hind4sight_min cannot be imported here: measure on the package that you are given"
        return described(error)
    except Exception as error:
        return described(error)
    finally:
        sys.modules.update(hidden)


def judge(number, on_reference, on_mutant):
    """Two answers of `measure`, on the right package and on mutant `number` -> Verdict, all of the points or none."""
    def verdict(sentence):
        return Verdict(not sentence, not sentence, sentence)
    if isinstance(on_reference, str):
        return verdict(f"on right code: {on_reference}")
    if isinstance(on_mutant, str):
        return verdict(f"with bug {number} it fails, where it should measure: {on_mutant}")
    low, high, right = on_reference
    if not (math.isfinite(low) and math.isfinite(high)):
        return verdict(f"EXPECTED_{number:02}: expected two finite numbers, got {low:g}, {high:g}")
    if not low <= right <= high or on_mutant[:2] != (low, high):
        return verdict(f"right code gives {right:g}, outside of your range from {low:g} to {high:g}")
    if low <= on_mutant[2] <= high:
        return verdict(f"bug {number} gives {on_mutant[2]:g}, inside of your range from {low:g} to {high:g}: it does "
                       "not show in this number")
    return verdict("")


# --- the exercise -------------------------------------------------------------------------------------------------

def files(assignment):
    """Name -> text of the exercise."""
    functions = [SKELETON.format(number=number, symptom=fill(mutant.symptom, 112, subsequent_indent=" " * 4))
                 for number, mutant in enumerate(MUTANTS, 1)]
    symptoms = "\n".join(fill(f"{number}. {mutant.symptom}", 118, subsequent_indent=" " * 4)
                         for number, mutant in enumerate(MUTANTS, 1))
    readme = README.format(number=assignment.number, title=assignment.title, theory=assignment.theory,
                           symptoms=symptoms, points=POINTS)
    return {"bugs.py": HEAD + "".join(functions), "test_tasks.py": TEST, "README.md": readme}


HEAD = '''"""Assignment 7: find the silent bug. README.md says what to do.

measure_NN(package) returns one number, measured on a package that may have bug NN: package.losses.chamfer_loss and so
on, nothing from hind4sight_min. EXPECTED_NN is the range it lies in if the code is right.
"""
import numpy as np
'''

SKELETON = '''

EXPECTED_{number:02} = None  # (low, high)


def measure_{number:02}(package):
    """{symptom}"""
    raise NotImplementedError("Task 7.{number}")
'''

TEST = '''"""Each measurement on right code and on its bug: pytest -k 7_01 runs that of bug 1."""
from pathlib import Path

import pytest
from hind4sight_min.course import bugs


@pytest.mark.parametrize("number", range(1, len(bugs.MUTANTS) + 1), ids=lambda number: f"7_{number:02}")
def test_bug(number):
    path = Path(__file__).with_name("bugs.py")
    verdict = bugs.judge(number, *(bugs.measure(path, number, bugs.broken(each)) for each in (0, number)))
    if verdict.sentence:
        pytest.fail(verdict.sentence, pytrace=False)
'''

README = """# Assignment {number}: {title}

{theory}

## What to do

Write `measure_01` to `measure_12` and their ranges in `bugs.py`, in any order; twenty minutes each, some take longer.

    python -i bugs.py
    >>> from hind4sight_min.course.bugs import broken
    >>> measure_01(broken(0)), measure_01(broken(1))     # the right package, and the one with bug 1

    pytest -q -k 7_01                                     # does it show?

A package has the modules geometry, ops, losses, interactions, scene, networks, training, planning and lab.evaluation,
which read as those of `hind4sight_min` do.

What the users say:

{symptoms}

## How it is graded

Twelve times {points} points. Your file is given the right package and the one with the bug, both compiled and without
sources, in fresh processes and in random order, and does not know which is which. The points are won if the number is
inside of your range for the right one and outside for the other; an exception shows nothing. `hind4sight_min` cannot be
imported meanwhile.

The reference is public, and so are the twelve changes: whoever compares the two finds the place in a minute. The marks
are for the measurement: which quantity, on which input, must lie where, and why. Your teacher reads them.
"""
