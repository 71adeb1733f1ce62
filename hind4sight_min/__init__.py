"""Hind4sight-Net in a few readable NumPy files: unsupervised dynamics models from pokes.

The core, in the order to read it: geometry, ops, losses, interactions, scene, networks, training, planning. Beside it
`disk/`, files; `sim/`, the poke simulator; `lab/`, the experiments and the command line: the core imports none of them.
"""
import ctypes
import numbers
import os

# Our matrices are small, and the batch is spread over processes instead (lab/processes.py): a BLAS that starts threads
# of its own then competes with them. Set before NumPy loads, unless the user did.
for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# Every training step asks for the same megabytes again. Unless told to keep them, glibc gives them back to the system
# each time, and the page faults are a tenth of a step (docs/speed.md).
try:
    _mallopt = ctypes.CDLL(None).mallopt
    _mallopt(-1, 512 << 20)  # M_TRIM_THRESHOLD: give back only beyond so many bytes
    _mallopt(-3, 32 << 20)   # M_MMAP_THRESHOLD: no mapping of its own for arrays up to here, the most that is allowed
except (OSError, AttributeError, TypeError):  # another C library
    pass

__version__ = "0.1.0"


def check_whole(name, value, least, most=float("inf")):
    """Raise a ValueError that says what is wrong unless `value` is a whole number from `least` to `most`."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or not least <= value <= most:
        limit = f" and <= {most}" if most < float("inf") else ""
        raise ValueError(f"{name}: expected a whole number >= {least}{limit}, got {value}")


def check_arrays(**arrays):
    """Raise a ValueError naming the array that is not of as many interactions as the first, or of another type than
    bool for `valid`, whole numbers for `cells` and floating-point ones for all else: NumPy would let it pass.
    """
    count = len(next(iter(arrays.values())))
    for name, value in arrays.items():
        kinds, expected = ("f", "floating-point numbers")
        if "valid" in name:
            kinds, expected = ("b", "bool")
        elif name == "cells":
            kinds, expected = ("iu", "whole numbers")
        if value.dtype.kind not in kinds or len(value) != count:
            raise ValueError(f"{name}: expected {expected} of {count} interactions, got {value.dtype} of {len(value)}")
