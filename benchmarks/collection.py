"""How much of collection is Bullet's own work, and what a second process brings.

    python benchmarks/collection.py --json docs/results/collection.json

Runs `collect` with one and with two processes in turn, so that a machine whose speed drifts slows both; prints
the ratio pair by pair and its median, and the share of time inside Bullet's stepping and rendering. About two
minutes on two cores.
"""
import statistics
import tempfile
from pathlib import Path

from race import parser_of, spread

from hind4sight_min.disk.files import write_json
from hind4sight_min.lab.processes import parallel_map
from hind4sight_min.sim.collection import collect


def main():
    parser = parser_of(__doc__, rounds=5)
    parser.add_argument("--pokes", type=int, default=600)
    args = parser.parse_args()
    speedups, shares = [], []
    for pair in range(args.rounds):
        seconds = {}
        for jobs in (1, 2):
            with tempfile.TemporaryDirectory() as folder, parallel_map(jobs) as map:
                result = collect(Path(folder), args.pokes, seed=pair, map=map)
            seconds[jobs] = result["seconds"]
            shares.append(result["share_in_bullet"])
        speedups.append(seconds[1] / seconds[2])
        print(f"pair {pair + 1}: 1 process {seconds[1]:.1f} s, 2 processes {seconds[2]:.1f} s, "
              f"{speedups[-1]:.2f} times as fast; {args.pokes / seconds[1]:.0f} pokes per second and core", flush=True)
    figures = {**spread("collect_jobs2_speedup", speedups), "collect_share_in_bullet": statistics.median(shares)}
    for name, value in figures.items():
        print(f"{name}: {value:.3f}")
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
