"""Training that is stopped and goes on: its log, its checkpoints, its seconds."""
import csv
from dataclasses import replace

import numpy as np
import pytest
from tiny import TINY, tiny_pokes

from hind4sight_min import training
from hind4sight_min.disk.checkpoints import load_run
from hind4sight_min.lab import runs
from hind4sight_min.lab.runs import train_saving
from hind4sight_min.training import start_run


def test_the_log_is_the_mean_over_the_steps_of_an_epoch(tmp_path):
    data, seen, told = tiny_pokes(count=20), [], []  # four steps an epoch, six in all
    run = start_run(TINY, data)
    log = train_saving(data, run, tmp_path / "run.npz", on_step=lambda run, terms: seen.append(terms),
                       on_epoch=told.append)
    assert log == run.meta["log"] == told and run.meta["sums"] == {}
    assert [(entry["epoch"], entry["step"]) for entry in log] == [(1, 4), (2, 6)]
    assert [entry["learning_rate"] for entry in log] == [training.learning_rate(TINY, step) for step in (3, 5)]
    for entry, steps in zip(log, (seen[:4], seen[4:])):
        assert set(entry) == {"epoch", "step", "learning_rate", *TINY.weights}
        for name in TINY.weights:
            assert entry[name] == pytest.approx(np.mean([terms[name] for terms in steps])), name
    with open(tmp_path / "run.csv") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["chamfer"]) for row in rows] == pytest.approx([entry["chamfer"] for entry in log], rel=1e-5)


@pytest.mark.parametrize("stop", [2, 4, 5])  # within the first epoch, at its end, within the second
def test_a_resumed_run_is_the_same_run_with_the_same_log(stop, tmp_path):
    data = tiny_pokes(count=20)
    whole = start_run(TINY, data)
    train_saving(data, whole, tmp_path / "whole.npz")

    def interrupt(run, terms):
        if run.step == stop:
            raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt):
        train_saving(data, start_run(TINY, data), tmp_path / "run.npz", save_every=0.0, on_step=interrupt)
    resumed = load_run(tmp_path / "run.npz")
    assert resumed.step == stop and bool(resumed.meta["sums"]) == (stop != 4)
    train_saving(data, resumed, tmp_path / "run.npz")
    np.testing.assert_array_equal(resumed.vector, whole.vector)
    assert resumed.meta["log"] == whole.meta["log"]
    again = load_run(tmp_path / "run.npz")
    assert again.meta == resumed.meta and again.step == 6


def test_seconds_add_up_over_calls_and_a_checkpoint_is_written_in_time(tmp_path, monkeypatch):
    data, run, saved, clock = tiny_pokes(), start_run(replace(TINY, steps=8), tiny_pokes()), [], [0.0]
    monkeypatch.setattr(runs.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(runs, "save_run", lambda path, run: saved.append((run.step, run.meta["seconds"])))

    def tick(run, terms):
        clock[0] += 25.0
    train_saving(data, run, tmp_path / "run.npz", on_step=tick)
    assert saved == [(3, 75.0), (6, 150.0), (8, 200.0)], "every minute, and at the end"
    run.recipe = replace(run.recipe, steps=10)
    train_saving(data, run, tmp_path / "run.npz", on_step=tick)
    assert run.meta["seconds"] == 250.0


def test_an_interrupt_within_a_step_saves_the_step_before(tmp_path, monkeypatch):
    data, muon = tiny_pokes(), training.OPTIMISERS["muon"]

    def cut_off(run, gradient, rate):
        step = muon(run, gradient, rate)  # the moments have moved on, the parameters not yet
        if run.step == 3:
            raise KeyboardInterrupt
        return step
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setitem(training.OPTIMISERS, "muon", cut_off)
        train_saving(data, start_run(TINY, data), tmp_path / "run.npz")
    saved, same = load_run(tmp_path / "run.npz"), start_run(TINY, data)
    for _ in range(2):
        training.training_step(data, same)
    assert saved.step == 2
    for name in ("vector", "first_moment", "second_moment"):
        np.testing.assert_array_equal(getattr(saved, name), getattr(same, name), err_msg=name)
