"""How much of collection is Bullet's own work, and what a second process brings.

    python benchmarks/collection.py --json docs/results/collection.json

Runs `collect` with one and with two processes in turn, so that a machine whose speed drifts slows both; prints
the ratio pair by pair and its median, and the share of time inside Bullet's stepping and rendering. About two
minutes on two cores.
"""
import statistics
import tempfile
import time
from pathlib import Path

from race import parser_of, spread

from hind4sight_min.disk.files import write_json
from hind4sight_min.lab.processes import parallel_map
from hind4sight_min.sim import collection
from hind4sight_min.sim.arena import Arena


class TimedArena(Arena):
    """An arena that counts the seconds spent in Bullet's stepping and rendering, of all arenas of this process."""
    seconds = 0.0

    def __init__(self, *given):
        super().__init__(*given)
        for name in ("stepSimulation", "getCameraImage"):
            setattr(self.bullet, name, self.timed(getattr(self.bullet, name)))

    @staticmethod
    def timed(function):
        def timed(*given, **named):
            began = time.perf_counter()
            result = function(*given, **named)
            TimedArena.seconds += time.perf_counter() - began
            return result
        return timed


def main():
    parser = parser_of(__doc__, rounds=5)
    parser.add_argument("--pokes", type=int, default=600)
    args = parser.parse_args()
    speedups, shares = [], []
    collection.Arena = TimedArena  # in this process; others, which start afresh, have the usual one
    for pair in range(args.rounds):
        seconds = {}
        for jobs in (1, 2):
            TimedArena.seconds = 0.0
            with tempfile.TemporaryDirectory() as folder, parallel_map(jobs) as map:
                began = time.perf_counter()
                collection.collect(Path(folder), args.pokes, seed=pair, map=map)
                seconds[jobs] = time.perf_counter() - began
            if jobs == 1:
                shares.append(TimedArena.seconds / seconds[jobs])
        speedups.append(seconds[1] / seconds[2])
        print(f"pair {pair + 1}: 1 process {seconds[1]:.1f} s, 2 processes {seconds[2]:.1f} s, "
              f"{speedups[-1]:.2f} times as fast; {args.pokes / seconds[1]:.0f} pokes per second and core", flush=True)
    figures = {**spread("collect_jobs2_speedup", speedups), "collect_share_in_bullet": statistics.median(shares)}
    for name, value in figures.items():
        print(f"{name}: {value:.3f}")
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
