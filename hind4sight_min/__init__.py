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


def check_whole(name, value, least):
    """Raise a ValueError that says what is wrong unless `value` is a whole number of at least `least`."""
    if not isinstance(value, numbers.Integral) or value < least:
        raise ValueError(f"{name}: expected a whole number >= {least}, got {value}")
