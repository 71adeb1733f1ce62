"""How long one planning step takes, and how many candidates per second that makes.

    python benchmarks/planning.py [--rounds 9] [--json out.json]
    python benchmarks/planning.py --before DIR     in turns with the same of DIR, a clone of another commit

One step is what the robot waits for between two pokes: the default candidates, iterations and horizon of
planning.Search, on one core, for the start of test scene 0 with two objects to move. Medians over the rounds; each
checkout plans with the model it ships, and every turn of it is three steps in a process of its own.
"""
from hind4sight_min import planning  # before NumPy: it sets the number of BLAS threads

import json
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from race import DATA, ROOT, parser_of, ratios, spread, start

from hind4sight_min.disk.checkpoints import load_run
from hind4sight_min.disk.files import write_json
from hind4sight_min.lab.control import first_look, random_task


def measure(rounds):
    """Plan so many steps -> the figures."""
    run, search, seconds = load_run(DATA / "checkpoint.npz"), planning.Search(), []
    with random_task(0, 2) as task:
        camera, settings = task.arena.camera, task.settings
        _, view, goal = first_look(task)
    rollout = partial(planning.roll, planning.learned_step(run, view), view, settings=settings)
    for seed in range(rounds):
        began = time.perf_counter()
        planning.plan(rollout, view, goal, camera, settings, search, np.random.default_rng(seed))
        seconds.append(time.perf_counter() - began)
    median = statistics.median(seconds)
    return {"plan_step_seconds": median, "plan_candidates_per_second": search.candidates * search.iterations / median}


def speedups_over(before, rounds):
    """How many times as fast this checkout plans as another one, turn by turn."""
    seconds = {ROOT: [], before: []}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figures.json"
        for _ in range(rounds):
            for checkout, each in seconds.items():
                if start(__file__, ["--rounds", 3, "--json", path], checkout, stdout=subprocess.DEVNULL).wait():
                    sys.exit(f"{checkout}: its benchmark does not run")
                each.append(json.loads(path.read_text())["plan_step_seconds"])
    return ratios(seconds, before, ROOT)


def main():
    parser = parser_of(__doc__, rounds=9)
    parser.add_argument("--before", metavar="DIR", help="a clone of another commit, to compare with")
    args = parser.parse_args()
    figures = measure(args.rounds)
    if args.before:
        figures.update(spread("plan_speedup_vs_before", speedups_over(args.before, args.rounds)))
    for name, value in figures.items():
        print(f"{name}: {value:.2f}")
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
