"""A course in a box: exercises carved out of the reference, checks that teach, grading.

An *assignment* is a file of `assignments/`: its docstring is the theory, its TASKS name functions of the reference.
`carve` writes the exercise, `task` says what a function answers and judges it, `bugs` is assignment 7.
"""
from .assignments import ASSIGNMENTS, assignment_of  # noqa: F401
