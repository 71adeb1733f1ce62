"""What the benchmarks share: contenders that run in processes of their own and take turns.

A machine whose speed drifts slows all of them, ratios are taken within a round, and each has a peak memory of its own.
"""
import resource
import statistics
import subprocess
import sys
import time
from multiprocessing import active_children
from pathlib import Path


def serve(contender):
    """The process of a contender, a context that gives the function to call.

    Per line of input, a number of calls, one line of output, the seconds they took; the last line is the peak resident
    memory in MB, with what its worker processes had to themselves: libraries that both use are there once.
    """
    with contender as call:
        for line in sys.stdin:
            start = time.perf_counter()
            for _ in range(int(line)):
                call()
            print(time.perf_counter() - start, flush=True)
        workers = sum(_own_peak(process.pid) for process in active_children())
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss + workers) / 1024, flush=True)


def _own_peak(pid):
    """The peak resident memory of a process in KB, less the pages it shares now."""
    kilobytes = {line.split(":")[0]: int(line.split()[1]) for name in ("status", "smaps_rollup")
                 for line in Path(f"/proc/{pid}/{name}").read_text().splitlines() if line.endswith(" kB")}
    return kilobytes["VmHWM"] - kilobytes["Shared_Clean"] - kilobytes["Shared_Dirty"]


class Contender:
    def __init__(self, script, arguments):
        self.process = subprocess.Popen([sys.executable, script, *map(str, arguments)], stdin=subprocess.PIPE,
                                        stdout=subprocess.PIPE, text=True)

    def seconds(self, calls):
        """Per call."""
        self.process.stdin.write(f"{calls}\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline()) / calls

    def stop(self):
        """Ends the process -> its peak memory in MB."""
        self.process.stdin.close()
        return float(self.process.stdout.readlines()[-1])


def race(script, names, arguments, rounds, seconds=0.5, hopeless=1e9, patience=5.0):
    """Every contender in turn, round after round -> {name: seconds per call of each round}, {name: peak MB}.

    A turn has as many calls as take the fastest some `seconds`. What does not run here is left out; what starts off
    `hopeless` times slower than the fastest, or takes longer than `patience` seconds, is measured once and no more.
    """
    running, first, memory = {}, {}, {}
    for name in names:
        contender = Contender(script, ["--contender", name, *arguments])
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
    """How many times faster `fast` is than `slow`: median, least and most over the rounds."""
    each = [a / b for a, b in zip(times[slow], times[fast])]
    return statistics.median(each), min(each), max(each)


def report(times, memory):
    for name, values in times.items():
        print(f"  {name:<32} {1e3 * statistics.median(values):9.2f} ms ({1e3 * min(values):.2f} to "
              f"{1e3 * max(values):.2f}, {len(values)} rounds), {memory[name]:.0f} MB", flush=True)
