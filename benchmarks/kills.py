"""Kill -9, again and again, and what is lost: in collection, in training, of the workers of a cluster.

    python benchmarks/kills.py --json docs/results/kills.json

The same small work is done undisturbed and, in processes that are killed and started again, disturbed. What was
finished before a kill must be there afterwards, byte by byte; in training all but the last SAVE_EVERY seconds; and in
the end nothing may differ. Ten of the kills in collection come while a shard is being written. The cluster is Dask's
(the extra `cluster`), a scheduler and two workers here; without it that part is left out. Five minutes.
"""
import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from hind4sight_min.disk.checkpoints import load_run
from hind4sight_min.disk.files import plain, write_json
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab.processes import parallel_map
from hind4sight_min.lab.runs import train_saving
from hind4sight_min.networks import Sizes
from hind4sight_min.sim import collection
from hind4sight_min.sim.arena import Settings
from hind4sight_min.training import Recipe, start_run

ROOT = Path(__file__).resolve().parent.parent
SHARD_POKES, SMALL = 4, Settings(width=32, height=24)
RECIPE = Recipe(steps=150, batch=8, sizes=Sizes(masks=3, width=8, head=10, embedding=6, inverse=9))
SAVE_EVERY = 0.3  # s; 60 in earnest


# --- the work, in processes that can be killed ------------------------------------------------------------------

def collect(folder, pokes, address=None):
    collection.SHARD_POKES = SHARD_POKES
    with parallel_map(1 if address else 2, address) as map:
        collection.collect(folder, int(pokes), 1, SMALL, map)


def train(path, steps):
    """Beside the checkpoint, a line for every step: its number and the time."""
    data = load_interactions(ROOT / "data_small" / "train")
    run = load_run(path) if Path(path).exists() else start_run(replace(RECIPE, steps=int(steps)), data)
    with open(f"{path}.steps", "a", buffering=1) as file:
        train_saving(data, run, path, save_every=SAVE_EVERY,
                     on_step=lambda run, terms: file.write(f"{run.step} {time.time()}\n"))


WORK = {"collect": collect, "train": train}


def begin(*work):
    """A process that does `work`: a name of WORK and its arguments."""
    return subprocess.Popen([sys.executable, __file__, "--work", *map(str, work)], env=environment())


def environment():
    return {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1",
            "PYTHONWARNINGS": "ignore"}  # of what the killed ones leave to their resource tracker


def finish(*work):
    if begin(*work).wait():
        sys.exit(f"{work}: failed")


def contents(folder):
    """{name: bytes} of what is finished in a folder."""
    return {path.name: path.read_bytes() for path in Path(folder).glob("[!.]*")}


def half_written(folder):
    return [path for path in Path(folder).glob(".*shard_*")]


# --- collection ---------------------------------------------------------------------------------------------------

def kill_collection(folder, kills, writing, pokes):
    """So many kills, `writing` of them while a shard is being written -> how many lost nothing that was finished."""
    finish("collect", folder / "whole", pokes)
    whole, survived, written, i = contents(folder / "whole"), 0, 0, 0
    for kill in range(kills):
        process = begin("collect", folder / str(i), pokes)
        before, until = contents(folder / str(i)), random.uniform(0, 0.5)
        while process.poll() is None and contents(folder / str(i)) == before:  # until it has something new
            time.sleep(0.001)
        began = time.perf_counter()
        while process.poll() is None and (not half_written(folder / str(i)) if written < writing
                                          else time.perf_counter() < began + until):
            time.sleep(0.0002)
        process.kill()
        process.wait()
        written += bool(half_written(folder / str(i)))
        found = contents(folder / str(i))
        survived += before.keys() <= found.keys() and all(whole[name] == content for name, content in found.items())
        if len(found) > 0.8 * len(whole) or kill == kills - 1:  # what is left must become the same
            finish("collect", folder / str(i), pokes)
            survived -= contents(folder / str(i)) != whole or bool(half_written(folder / str(i)))
            i += 1
    print(f"collection: {survived} of {kills} kills survived, {written} of them while a shard was being written")
    return survived, written


# --- training -----------------------------------------------------------------------------------------------------

def state(path):
    """All of a checkpoint but the seconds it took."""
    run = load_run(path)
    meta = {name: value for name, value in run.meta.items() if name != "seconds"}
    return [run.vector.tobytes(), run.first_moment.tobytes(), run.second_moment.tobytes(), run.step, json.dumps(meta)]


def kill_training(folder, kills, steps):
    """So many kills -> how many lost no more than SAVE_EVERY seconds and the step and the saving that were going on."""
    finish("train", folder / "whole.npz", steps)
    whole, survived, i = state(folder / "whole.npz"), 0, 0
    for kill in range(kills):
        path = folder / f"{i}.npz"
        steps_file, process = Path(f"{path}.steps"), None
        steps_file.unlink(missing_ok=True)
        process = begin("train", path, steps)
        while process.poll() is None and not steps_file.exists():
            time.sleep(0.001)
        time.sleep(random.uniform(0.2, 1.5))
        process.kill()
        process.wait()
        told = np.array([line.split() for line in steps_file.read_text().splitlines()], float).reshape(-1, 2)
        saved, times = load_run(path).step if path.exists() else 0, told[:, 1]
        lost = times[told[:, 0] >= saved]
        going_on = 2 * np.diff(times).max(initial=0.1)
        survived += len(lost) < 2 or lost[-1] - lost[0] <= SAVE_EVERY + going_on
        if saved > 0.8 * steps or kill == kills - 1:
            finish("train", path, steps)
            survived -= state(path) != whole
            i += 1
    print(f"training: {survived} of {kills} kills survived")
    return survived


# --- a cluster ----------------------------------------------------------------------------------------------------

@contextmanager
def dask(*arguments, folder):
    """A scheduler or worker, a process that ends with the block."""
    with open(folder / "dask.log", "a") as log:
        process = subprocess.Popen([sys.executable, "-m", "dask", *arguments, "--no-dashboard", "--scheduler-file",
                                    folder / "scheduler.json"], env=environment(), cwd=folder, stdout=log, stderr=log)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def kill_workers(folder, kills, pokes):
    """A collection by two workers, of which one after the other is killed and another one started -> how many of the
    kills were survived, and whether the data are the same to the byte.
    """
    finish("collect", folder / "whole", pokes)
    worker = "worker", "--no-nanny", "--nthreads", "1"
    with ExitStack() as stack:
        stack.enter_context(dask("scheduler", "--port", "0", "--host", "127.0.0.1", folder=folder))
        workers = [stack.enter_context(dask(*worker, folder=folder)) for _ in range(2)]
        while not (folder / "scheduler.json").exists():
            time.sleep(0.05)
        address = json.loads((folder / "scheduler.json").read_text())["address"]
        process, killed = begin("collect", folder / "cluster", pokes, address), 0
        for _ in range(kills):
            before = len(contents(folder / "cluster"))
            while process.poll() is None and len(contents(folder / "cluster")) < before + 4:
                time.sleep(0.01)
            killed += process.poll() is None
            workers.pop(0).kill()
            workers.append(stack.enter_context(dask(*worker, folder=folder)))
        identical = process.wait() == 0 and contents(folder / "cluster") == contents(folder / "whole")
    print(f"cluster: {killed} workers killed, the data are {'the same' if identical else 'OTHERS'}")
    return killed * identical, identical


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, nargs=4, default=(50, 10, 20, 5), metavar="N",
                        help="in collection, of these while a shard is being written, in training, of workers")
    parser.add_argument("--pokes", type=int, default=120)
    parser.add_argument("--work", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    if args.work:
        WORK[args.work[0]](*args.work[1:])
        return
    random.seed(0)
    with tempfile.TemporaryDirectory() as folder:
        folder, (in_collection, writing, in_training, of_workers) = Path(folder), args.kills
        for name in ("collect", "train", "cluster"):
            (folder / name).mkdir()
        survived, written = kill_collection(folder / "collect", in_collection, writing, args.pokes)
        figures = {"kills_collection": survived, "kills_writing": written,
                   "kills_training": kill_training(folder / "train", in_training, RECIPE.steps)}
        if find_spec("distributed"):
            figures["kills_workers"], identical = kill_workers(folder / "cluster", of_workers, args.pokes)
            figures["cluster_identical"] = float(identical)
        figures["kills_survived"] = sum(figures.get(f"kills_{name}", 0) for name in (
            "collection", "training", "workers"))
    write_json(args.json, plain(figures))


if __name__ == "__main__":
    main()
