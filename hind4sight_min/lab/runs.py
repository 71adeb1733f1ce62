"""Training runs that can be stopped: a log, and a checkpoint every minute, from which a run goes on as the same run."""
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..disk.checkpoints import save_run
from ..disk.files import only_one, plain, write_text
from ..disk.shards import check_same_data, stamp
from ..networks import init_parameters
from ..training import CHUNK, learning_rate, recipe_at, train, unsupervised
from .cameras import check_camera
from .processes import parallel_map

SAMPLE = 64  # pokes: enough to say what a loss is without motion


def no_motion(data, recipe, objective):
    """What the terms of a loss are, on SAMPLE pokes, for a network that moves nothing: a new one -> dict of floats.

    Not in the paper. Not of `binary_masks`, which asks nothing of such a network.
    """
    rows = np.random.default_rng(0).permutation(len(data))[:SAMPLE]
    new = init_parameters(recipe.sizes, np.random.default_rng(recipe.seed))
    terms = [objective(new, recipe, data[each], np.random.default_rng(0))
             for each in np.split(rows, range(CHUNK, len(rows), CHUNK))]
    return {name: float(np.concatenate([each[name] for each in terms]).mean())
            for name in terms[0] if name != "binary_masks"}


def total(terms, recipe, step):
    """The loss of Eq. (6) before a step: the terms, a dict of floats, with the recipe's weights of then."""
    return sum(weight * terms.get(name, 0.0) for name, weight in recipe_at(recipe, step).weights.items())


def end_epoch(run, path):
    """Close an epoch: its means go into the run's log, and the log as CSV beside `path` -> the new entry."""
    log, sums = run.meta["log"], run.meta["sums"]
    steps = run.step - (log[-1]["step"] if log else 0)
    log.append({"epoch": len(log) + 1, "step": run.step, "learning_rate": learning_rate(run.recipe, run.step - 1),
                **{name: total / steps for name, total in sums.items()}})
    sums.clear()
    rows = [",".join(log[0]), *(",".join(f"{value:g}" for value in entry.values()) for entry in log)]
    write_text(Path(path).with_suffix(".csv"), "\n".join(rows) + "\n")
    return log[-1]


def kept(run):
    """The run as it is, apart from what the next step changes in place."""
    return replace(run, first_moment=run.first_moment.copy(), second_moment=run.second_moment.copy(),
                   meta={**run.meta, "log": [*run.meta["log"]], "sums": dict(run.meta["sums"])})


def begin(run, data, path, objective):
    """Note in run.meta which data set the run is of and what its terms are without motion, unless it has them.

    path: of the checkpoint, for the message. Raises ValueError for another data set than the run began with and for a
    camera that does not show the arena.
    """
    data_stamp = plain(stamp(getattr(data, "interactions", data)))  # SE3-Nets has its own around them
    check_same_data(path, run.meta.get("data"), data_stamp)
    check_camera(data.camera)
    run.meta["data"] = data_stamp
    if "no_motion" not in run.meta:
        run.meta["no_motion"] = no_motion(data, run.recipe, objective)


def train_saving(data, run, path, objective=unsupervised, jobs=1, on_step=None, on_epoch=None, save_every=60.0):
    """`train` with a log, and a checkpoint at `path` every `save_every` seconds and at its end, however it ends, unless
    it diverged -> the log.

    The log has a dict for each epoch: epoch, step, learning_rate, and the mean of every term. It is kept in
    run.meta["log"], the sums of an unfinished epoch in run.meta["sums"], and the seconds spent, over all calls, in
    run.meta["seconds"]; so a run that was resumed has the log of one that was not. The log also goes beside `path`, as
    CSV. run.meta["data"] says of which data set the run is, run.meta["no_motion"] what the terms are without motion.
    jobs: processes, on which the result does not depend. on_step(run, terms), on_epoch(entry): called after each.
    Raises ValueError for another data set than the run began with, for a camera that does not show the arena, and where
    another process writes to `path`; FloatingPointError where the loss is no number any more.
    """
    first, recipe, meta, per_epoch = run.step, run.recipe, run.meta, max(1, len(data) // run.recipe.batch)
    log, sums, before = meta.setdefault("log", []), meta.setdefault("sums", {}), meta.get("seconds", 0.0)
    began = saved = time.perf_counter()
    begin(run, data, path, objective)

    def save():
        nonlocal saved
        saved = time.perf_counter()
        whole.meta["seconds"] = meta["seconds"] = before + saved - began
        save_run(path, whole)

    whole = kept(run)  # after the last step

    def step_done(run, terms):
        nonlocal whole
        sums.update((name, sums.get(name, 0.0) + value) for name, value in terms.items())
        if run.step % per_epoch == 0 or run.step == recipe.steps:
            entry = end_epoch(run, path)
            if on_epoch:
                on_epoch(entry)
        whole = kept(run)  # after the log entry: what is saved must not lack it
        if on_step:
            on_step(run, terms)
        if time.perf_counter() - saved > save_every:
            save()

    with only_one(path), parallel_map(min(jobs, -(-recipe.batch // CHUNK))) as map, np.errstate(all="ignore"):
        try:
            train(data, run, objective, map, step_done)
        except FloatingPointError as error:
            raise FloatingPointError(f"diverged at step {run.step}: {error}; try a smaller learning rate than "
                                     f"{recipe.learning_rate:g}") from None
        except BaseException:  # an interrupt, say, which can come in the middle of a step
            if whole.step > first:
                save()
            raise
        save()
    return log
