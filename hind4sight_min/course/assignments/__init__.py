"""One file per assignment: its docstring is the theory, TASKS are what there is to do.

To add a task, copy one of them in its file and change it; to add an assignment, add its file to ASSIGNMENTS.
"""
from dataclasses import dataclass

from . import a1_camera, a2_chamfer, a3_warping, a4_smoothness, a5_inverse, a6_planning, a7_bugs, a8_improve


@dataclass(frozen=True)
class Assignment:
    """number; name: of the exercise's file; title; theory: text; tasks; tests: files of tests/ that go with it; files:
    Assignment -> name -> text of the exercise's files, where it is not carved.
    """
    number: int
    name: str
    title: str
    theory: str
    tasks: tuple
    tests: tuple = ()
    files: callable = None


def _assignment(number, module):
    title, theory = module.__doc__.split("\n", 1)
    return Assignment(number, module.__name__.rpartition("_")[2], title, theory.strip(), getattr(module, "TASKS", ()),
                      getattr(module, "TESTS", ()), getattr(module, "files", None))


ASSIGNMENTS = tuple(_assignment(number, module) for number, module in enumerate(
    (a1_camera, a2_chamfer, a3_warping, a4_smoothness, a5_inverse, a6_planning, a7_bugs, a8_improve), 1))


def assignment_of(name):
    """The assignment of a number or a name, "2" or "chamfer". Raises ValueError where there is none."""
    for assignment in ASSIGNMENTS:
        if str(name) in (str(assignment.number), assignment.name):
            return assignment
    known = ", ".join(f"{each.number} {each.name}" for each in ASSIGNMENTS)
    raise ValueError(f"assignment: expected one of {known}, got {name}")
