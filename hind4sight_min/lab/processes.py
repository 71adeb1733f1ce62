"""Several processes: for collection, for the chunks of a training step, and for the cells of a table."""
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from threading import Thread

from .. import check_whole


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
    """A pool of `jobs` processes.

    Fresh processes, not forks, which neither Bullet nor thread pools survive; so a script that asks for jobs > 1
    needs the usual `if __name__ == "__main__":`.
    """
    return ProcessPoolExecutor(jobs, get_context("spawn"), _begin_worker)


@contextmanager
def parallel_map(jobs):
    """A `map` that spreads its calls over `jobs` processes, this one included; results come in order, one by one.

    Not threads: autograd holds Python's global lock for so long that a second thread brings a fifth more at best.
    Raises ValueError for a number of processes that cannot be.
    """
    check_whole("jobs", jobs, 1)
    if jobs == 1:
        yield map
        return
    pool = worker_pool(jobs - 1)

    def parallel(function, *arguments):
        calls = list(zip(*arguments))
        given = {i: pool.submit(function, *call) for i, call in enumerate(calls) if i % jobs}
        for i, call in enumerate(calls):
            yield given[i].result() if i in given else function(*call)
    try:
        yield parallel
    finally:
        pool.shutdown(cancel_futures=True)  # after an interrupt, what has not begun is left for the next call
