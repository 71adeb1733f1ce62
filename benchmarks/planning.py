"""How long one planning step takes, and where: candidates per second, and the share of time in the forward model.

    python benchmarks/planning.py [--rounds 9] [--json out.json]

One step is what the robot waits for between two pokes: the default candidates, iterations and horizon of
planning.Search, on one core, for the start of test scene 0 with two objects to move. Medians over the rounds.
"""
import argparse
import time
from dataclasses import asdict

from hind4sight_min import control, planning, training  # before NumPy: it sets the number of BLAS threads
from hind4sight_min.__main__ import data_small
from hind4sight_min.interactions import write_json

import numpy as np  # noqa: E402


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json")
    args = parser.parse_args()
    run, search, inside = training.load_run(data_small() / "checkpoint.npz"), planning.Search(), []
    forward_model = planning.forward_model

    def timed(*arguments):
        start = time.perf_counter()
        result = forward_model(*arguments)
        inside.append(time.perf_counter() - start)
        return result

    planning.forward_model = timed
    with control.random_task(0, 2) as task:
        camera, settings = task.arena.camera, asdict(task.arena.settings)
        _, view, goal = control.first_look(task)
    step = planning.learned_step(run, camera, view)
    seconds, shares = [], []
    for seed in range(args.rounds):
        inside.clear()
        start = time.perf_counter()
        planning.plan(lambda sequences: planning.roll(step, view, sequences, settings), view, goal, camera, settings,
                      search, np.random.default_rng(seed))
        seconds.append(time.perf_counter() - start)
        shares.append(sum(inside) / seconds[-1])
    figures = {"plan_step_seconds": float(np.median(seconds)), "plan_share_in_model": float(np.median(shares)),
               "plan_candidates_per_second": search.candidates * search.iterations / float(np.median(seconds))}
    for name, value in figures.items():
        print(f"{name}: {value:.2f}")
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
