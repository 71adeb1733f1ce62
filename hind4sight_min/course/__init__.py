"""A course in a box: exercises carved out of the reference, checks that teach, grading.

An *assignment* is a file of `assignments/`: its docstring is the theory, its TASKS name functions of the reference.
`carve` writes the exercise, `task` says what a function answers and judges it, `bugs` is assignment 7. None of it is in
the paper: it is for teaching. The core does not know of it.
"""
from .assignments import ASSIGNMENTS, assignment_of  # noqa: F401
