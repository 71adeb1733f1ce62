"""Several processes: for collection, for the chunks of a training step, for the cells of a table.

Whatever can be spread takes a `map`: Python's own, that of any `concurrent.futures.Executor`, or one of these.
"""
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process
from threading import Thread

import numpy as np

from .. import check_whole


def _begin_worker():
    """End with the parent, however it ends: a worker that went on alone would write into the files of the next attempt.
    What overflows is for the parent to find and say.
    """
    def wait():
        parent_process().join()
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's to handle
    np.seterr(all="ignore")
    Thread(target=wait, daemon=True).start()


@contextmanager
def cluster_map(address):
    """A `map` over the workers of the Dask scheduler at an address; what a lost worker had is given to another one.

    The workers need this package, and the files under the same paths. Raises RuntimeError where Dask is missing or a
    call has lost one worker after the other, OSError where no scheduler or no worker is there.
    """
    try:
        from distributed import Client, KilledWorker
    except ModuleNotFoundError:
        raise RuntimeError("a cluster needs Dask: pip install 'hind4sight_min[cluster]'") from None
    with Client(address) as client:
        client.wait_for_workers(1, timeout=30)
        try:
            yield client.get_executor().map
        except KilledWorker as error:
            raise RuntimeError(f"cluster: {error}") from None


@contextmanager
def parallel_map(jobs, cluster=None):
    """A `map` that spreads its calls over `jobs` processes, this one included; results come in order, one by one.
    cluster: address of a scheduler, whose workers make the calls instead.

    Fresh processes, not forks, which neither Bullet nor thread pools survive; so a script that asks for jobs > 1
    needs the usual `if __name__ == "__main__":`. Not threads: autograd holds Python's global lock for so long that a
    second one brings a fifth more at best. Raises ValueError for a number of processes that cannot be, and as
    `cluster_map`.
    """
    check_whole("jobs", jobs, 1, 1024)
    if cluster:
        with cluster_map(cluster) as map_there:
            yield map_there
        return
    if jobs == 1:
        yield map
        return
    pool = ProcessPoolExecutor(jobs - 1, get_context("spawn"), _begin_worker)

    def parallel(function, *arguments):
        calls = list(zip(*arguments))
        # Processes are started here, and an interrupt is ours to handle from their first moment on.
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        given = {i: pool.submit(function, *call) for i, call in enumerate(calls) if i % jobs}
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        for i, call in enumerate(calls):
            yield given[i].result() if i in given else function(*call)
    others = active_children()
    try:
        yield parallel
    except BaseException:  # an interrupt, say, must not wait for what runs: files are whole or not there
        for process in set(active_children()) - set(others):
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
