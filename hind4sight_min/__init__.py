"""Hind4sight-Net in a few readable NumPy files: unsupervised dynamics models from pokes.

The core, in the order to read it: geometry, ops, losses, interactions, scene, networks, training, planning. Beside it
`disk/`, files; `sim/`, the poke simulator; `lab/`, the experiments and the command line: the core imports none of them.
"""
import ctypes
import math
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

import numpy as np  # noqa: E402: only now

__version__ = "0.1.0"


def check_whole(name, value, least, most=float("inf")):
    """Raise a ValueError that says what is wrong unless `value` is a whole number from `least` to `most`."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or not least <= value <= most:
        limit = f" and <= {most}" if most < float("inf") else ""
        raise ValueError(f"{name}: expected a whole number >= {least}{limit}, got {str(value):.99}")


def check_number(name, value, least=-float("inf"), most=float("inf"), above=-float("inf")):
    """Raise a ValueError that says what is wrong unless `value` is a finite number, from `least` to `most` and above
    `above`.
    """
    number = isinstance(value, numbers.Real) and not isinstance(value, bool) and abs(value) < float("inf")
    if not (number and least <= value <= most and above < value):
        limit = f" > {above}" if above > least else f" >= {least}" if least > -float("inf") else ""
        limit += f" and <= {most}" if most < float("inf") else ""
        raise ValueError(f"{name}: expected a finite number{limit}, got {str(value):.99}")


# part of an array's name, kinds of dtype as NumPy abbreviates them, in words; the first part that the name has decides
TYPES = (("valid", "b", "bool"), ("cells", "iu", "whole numbers"), ("labels", "iu", "whole numbers"),
         ("rgb", "u", "uint8"), ("depth", "f", "floating-point metres"), ("", "f", "floating-point numbers"))


def as_arrays(patterns, **arrays):
    """Check a call's arrays by their names and shapes, and convert them where that is exact -> list, in their order.

    flow, valid = as_arrays("BHW2 BP", flow=flow, valid=valid): patterns has a shape for each array, as `fits` reads it.
    `valid` is bool (0 and 1, or 0 and 255, become it), `cells` and `labels` whole numbers, `rgb` uint8, `depth`
    floating-point metres, all else floating-point numbers (whole ones become it, bytes of `images` in [0, 1]).
    Raises a ValueError naming the array that is none of these or has another shape: NumPy would let it pass.
    """
    found, sizes = [], {}
    for (name, value), pattern in zip(arrays.items(), patterns.split(), strict=True):
        _, kinds, expected = next(each for each in TYPES if each[0] in name)
        try:
            array = value if hasattr(value, "_value") else np.asanyarray(value)  # a box of autograd's stays one
        except ValueError:  # rows of several lengths
            array = np.array(None)
        if isinstance(array, np.ndarray):  # OpenCV takes another byte order for this machine's
            array = array.astype(array.dtype.newbyteorder("="), copy=False)
        if array.dtype.kind in "iu" and array.size:
            if kinds == "b" and (np.isin(array, (0, 1)).all() or np.isin(array, (0, 255)).all()):
                array = array > 0
            elif expected == "uint8" and array.dtype != np.uint8 and 0 <= array.min() and array.max() <= 255:
                array = array.astype(np.uint8)
            elif "image" in name and array.dtype == np.uint8:
                array = array / np.float32(255)
            elif expected == "floating-point numbers" and "image" not in name:
                array = array.astype(float)
        found.append(array)
        right = array.dtype == np.uint8 if expected == "uint8" else array.dtype.kind in kinds
        if not right or hasattr(array, "mask") or not fits(array.shape, pattern, sizes):
            shape = ", ".join(str(sizes.get(letter, letter)) for letter in pattern).replace("*", "...")
            raise ValueError(f"{name}: expected {expected} of shape ({shape}), got {type(value).__name__} of "
                             f"{array.dtype}, shape {array.shape}")
    return found


def fits(shape, pattern, sizes):
    """Whether a shape is as a pattern says: one character for every axis. A letter is a size, the same wherever it
    occurs (`sizes` notes it), a digit itself, `*` in front any axes, `P` at the end H x W pixels in one axis or two.
    """
    if pattern[0] == "*":
        pattern = pattern[1:]
        shape = shape[max(0, len(shape) - len(pattern)):]
    if pattern.endswith("P"):
        pattern = pattern[:-1]
        if math.prod(shape[len(pattern):]) != sizes["H"] * sizes["W"]:
            return False
        shape = shape[:len(pattern)]
    return len(shape) == len(pattern) and all(size == (int(letter) if letter.isdigit() else
                                                       sizes.setdefault(letter, size))
                                              for size, letter in zip(shape, pattern))
