"""Assignment 7, find the silent bug: what the grader needs of it.

write_package(number, folder, name="package"): a compiled copy of the package without its sources, mutant `number`, or
the reference for 0, as folder/name/, to be imported under that name with `folder` on sys.path.
measure(path, number, package): the student's EXPECTED_NN and measure_NN(package), in the process that runs the
student's code -> (low, high, value), floats.
judge(number, on_reference, on_mutant) -> task.Verdict; either may be a str instead, what went wrong.
MUTANTS: the mutants, in order; MUTANTS[0].number is 1. Each is worth POINTS.
"""
