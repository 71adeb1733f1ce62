"""Hind4sight-Net in a few readable NumPy files: unsupervised dynamics models from pokes.

Read in this order: geometry, ops, losses, interactions, networks, training, objects, simulator, evaluation, planning,
control.
"""
import numbers
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from threading import Thread

# Our matrices are small and the batch is spread over processes instead (training.py): a BLAS that
# starts threads of its own then competes with them. Set before NumPy loads, unless the user did.
for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def check_whole(name, value, least):
    """Raise a ValueError that says what is wrong unless `value` is a whole number of at least `least`."""
    if not isinstance(value, numbers.Integral) or value < least:
        raise ValueError(f"{name}: expected a whole number >= {least}, got {value}")


def _begin_worker():
    """Leave an interrupt to the parent to handle, and end with it, however it ends: a worker that went on alone would
    write into the files of the next attempt.
    """
    def wait():
        parent_process().join()
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=wait, daemon=True).start()


def worker_pool(jobs):
    """A pool of `jobs` processes, for collection and for training.

    Fresh processes, not forks, which neither Bullet nor thread pools survive; so a script that asks for jobs > 1
    needs the usual `if __name__ == "__main__":`.
    """
    return ProcessPoolExecutor(jobs, get_context("spawn"), _begin_worker)


__version__ = "0.1.0"
