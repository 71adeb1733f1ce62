"""What the benchmarks share: contenders that run in processes of their own and take turns.

A machine whose speed drifts slows all of them, ratios are taken within a round, and each has a peak memory of its own.
"""
import argparse
import os
import resource
import statistics
import subprocess
import sys
import time
from itertools import cycle
from multiprocessing import active_children
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "data_small"


def parser_of(description, rounds):
    """The command line that all benchmarks have in common."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=rounds)
    parser.add_argument("--json", metavar="FILE", help="write the figures here too")
    return parser


def start(script, arguments, checkout=ROOT, **options):
    """Start a benchmark of a checkout, with that checkout's package -> its process."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, Path(checkout) / "benchmarks" / Path(script).name, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, text=True, **options)


def serve(contender):
    """The process of a contender, a context that gives the function to call.

    Per line of input, a number of calls, one line of output, the seconds they took; the last line is the peak resident
    memory in MB, with what its worker processes had to themselves: libraries that both use are there once.
    """
    with contender as call:
        for line in sys.stdin:
            began = time.perf_counter()
            for _ in range(int(line)):
                call()
            print(time.perf_counter() - began, flush=True)
        workers = sum(_own_peak(process.pid) for process in active_children())
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss + workers) / 1024, flush=True)


def _own_peak(pid):
    """The peak resident memory of a process in KB, less the pages it shares now."""
    kilobytes = {line.split(":")[0]: int(line.split()[1]) for name in ("status", "smaps_rollup")
                 for line in Path(f"/proc/{pid}/{name}").read_text().splitlines() if line.endswith(" kB")}
    return kilobytes["VmHWM"] - kilobytes["Shared_Clean"] - kilobytes["Shared_Dirty"]


class Contender:
    def __init__(self, script, arguments, checkout):
        self.process = start(script, arguments, checkout, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def seconds(self, calls):
        """Per call."""
        self.process.stdin.write(f"{calls}\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline()) / calls

    def stop(self):
        """Ends the process -> its peak memory in MB."""
        self.process.stdin.close()
        return float(self.process.stdout.readlines()[-1])


def race(script, names, arguments, rounds, seconds, hopeless=1e9, patience=5.0, before=None):
    """Every contender in turn, round after round -> {name: seconds per call of each round}, {name: peak MB}.

    A turn has as many calls as take the fastest some `seconds`. What does not run here is left out; what starts off
    `hopeless` times slower than the fastest, or takes longer than `patience` seconds, is measured once and no more.
    "before_" and a name: the contender of that name of the same script in another checkout, `before`.
    """
    running, first, memory = {}, {}, {}
    for name in names:
        checkout = before if name.startswith("before_") else ROOT
        contender = Contender(script, ["--contender", name.removeprefix("before_"), *arguments], checkout)
        try:
            contender.seconds(2)  # warm up; compile
            first[name] = contender.seconds(1)
        except ValueError:
            print(f"{name}: does not run here", flush=True)
            continue
        running[name] = contender
    times = {name: [first[name]] for name in running}  # of the last warm-up call
    for name in [name for name in running if first[name] > min(hopeless * min(first.values()), patience)]:
        memory[name] = running.pop(name).stop()
    calls = max(1, round(seconds / min(first.values())))
    for name in running:
        times[name] = []
    for _ in range(rounds):
        for name, contender in running.items():
            times[name].append(contender.seconds(1 if first[name] > seconds else calls))
    memory.update({name: contender.stop() for name, contender in running.items()})
    return times, memory


def fastest(times, names):
    """The contender with the smallest median among `names`."""
    return min((name for name in names if name in times), key=lambda name: statistics.median(times[name]))


def ratios(times, slow, fast):
    """How many times as fast `fast` is as `slow`, round by round; a slow one may have been measured only once."""
    return [a / b for a, b in zip(cycle(times[slow]), times[fast])]


def spread(name, values):
    """A figure and its range, for the record."""
    return {name: statistics.median(values), f"{name}_min": min(values), f"{name}_max": max(values)}


def shown(values):
    """The same, to be read."""
    return f"{statistics.median(values):.2f} ({min(values):.2f} to {max(values):.2f})"


def report(times, memory):
    for name, values in times.items():
        print(f"  {name:<32} {shown([1e3 * each for each in values])} ms, {len(values)} rounds, {memory[name]:.0f} MB",
              flush=True)
