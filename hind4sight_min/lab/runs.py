"""Training runs that can be stopped: a log, and a checkpoint every minute, from which a run goes on as the same run."""
import time
from pathlib import Path

from ..disk.files import write_text
from ..disk.checkpoints import save_run
from ..training import CHUNK, learning_rate, train, unsupervised
from .processes import parallel_map


def train_saving(data, run, path, objective=unsupervised, jobs=1, on_step=None, on_epoch=None, save_every=60.0):
    """`train` with a log, and a checkpoint at `path` every `save_every` seconds and at the end -> the log.

    The log has a dict for each epoch: epoch, step, learning_rate, and the mean of every term. It is kept in
    run.meta["log"], the sums of an unfinished epoch in run.meta["sums"], and the seconds spent, over all calls, in
    run.meta["seconds"]; so a run that was resumed has the log of one that was not. The log also goes beside `path`, as
    CSV. jobs: processes, on which the result does not depend. on_step(run, terms), on_epoch(entry): called after each.
    """
    recipe, meta, per_epoch = run.recipe, run.meta, max(1, len(data) // run.recipe.batch)
    log, sums, before = meta.setdefault("log", []), meta.setdefault("sums", {}), meta.get("seconds", 0.0)
    began = saved = time.perf_counter()

    def save():
        nonlocal saved
        saved = time.perf_counter()
        meta["seconds"] = before + saved - began
        save_run(path, run)

    def end_epoch():
        steps = run.step - (log[-1]["step"] if log else 0)
        log.append({"epoch": len(log) + 1, "step": run.step, "learning_rate": learning_rate(recipe, run.step - 1),
                    **{name: total / steps for name, total in sums.items()}})
        sums.clear()
        rows = [",".join(log[0]), *(",".join(f"{value:g}" for value in entry.values()) for entry in log)]
        write_text(Path(path).with_suffix(".csv"), "\n".join(rows) + "\n")
        if on_epoch:
            on_epoch(log[-1])

    def step_done(run, terms):
        sums.update((name, sums.get(name, 0.0) + value) for name, value in terms.items())
        if run.step % per_epoch == 0 or run.step == recipe.steps:
            end_epoch()
        if on_step:
            on_step(run, terms)
        if time.perf_counter() - saved > save_every:  # after the log entry: what is saved must not lack it
            save()

    with parallel_map(min(jobs, -(-recipe.batch // CHUNK))) as map:
        train(data, run, objective, map, step_done)
    save()
    return log
