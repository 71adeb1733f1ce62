"""A training step of the full model: ours against PyTorch's.

    python benchmarks/training_step.py --json docs/results/training_step.json     (needs the extra "bench")

Every contender is a process of its own, which makes the same steps on the same pokes: batch, forward, losses,
backward, Adam. They take turns, so that a machine whose speed drifts slows all of them, and ratios are taken within a
round. BLAS has one thread in our processes; PyTorch is tried with one and two, with brute-force and KD-tree Chamfer,
eager and compiled, and the fastest median counts; what starts off three times slower than the fastest is left out.
Memory is the peak resident size, worker processes added up.
"""
import argparse
import resource
import statistics
import subprocess
import sys
import time
from contextlib import contextmanager

from hind4sight_min import training
from hind4sight_min.__main__ import data_small, write_json
from hind4sight_min.interactions import load_interactions

DATA = data_small() / "train"
OURS = ("ours_1_process", "ours_2_processes")
TWINS = tuple(f"torch_{chamfer}_{mode}_{threads}_threads" for chamfer in ("tree", "brute")
              for mode in ("eager", "compiled") for threads in (1, 2))


# --- the contenders: a block with a function that makes one step ------------------------------------------------

@contextmanager
def ours(batch, jobs):
    """The steps of training.train, one at a time, its worker processes kept."""
    data = load_interactions(DATA)
    run = training.start_run(training.Recipe(steps=10 ** 6, batch=batch), data)
    with training.workers(jobs) as gradients:
        yield lambda: training.training_step(data, run, gradients)


@contextmanager
def twin(batch, chamfer, mode, threads):
    import torch
    import torch_twin
    torch.set_num_threads(threads)
    data = load_interactions(DATA)
    recipe = training.Recipe(steps=10 ** 6, batch=batch)
    run = training.start_run(recipe, data)
    params = {name: torch.from_numpy(value.copy()).requires_grad_() for name, value in run.params.items()}
    optimiser = torch.optim.Adam(params.values(), lr=recipe.learning_rate)
    nearest = {"tree": torch_twin.nearest_by_tree, "brute": torch_twin.nearest_by_brute_force}[chamfer]
    if mode == "compiled":
        nearest = torch.compiler.disable(nearest)
    loss = torch.compile(torch_twin.full_loss) if mode == "compiled" else torch_twin.full_loss

    def step():
        rows, mirror, _ = training.rows_of_step(recipe, len(data), run.step)
        tensors = torch_twin.tensors(training.make_batch(data, rows, mirror))
        optimiser.zero_grad()
        loss(params, recipe.sizes, tensors, data.camera, training.WEIGHTS, nearest).backward()
        optimiser.step()
        run.step += 1
    yield step


def work(name, batch):
    """The process of one contender: a number of steps per line of input, the seconds they took per line of output."""
    if name in OURS:
        jobs = 1 + OURS.index(name)
        contender = ours(batch, jobs)
    else:
        _, chamfer, mode, threads, _ = name.split("_")
        jobs, contender = 1, twin(batch, chamfer, mode, int(threads))
    with contender as step:
        for line in sys.stdin:
            start = time.perf_counter()
            for _ in range(int(line)):
                step()
            print(time.perf_counter() - start, flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if jobs > 1:
        peak += jobs * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    print(peak / 1024, flush=True)


# --- the comparison -----------------------------------------------------------------------------------------------

class Contender:
    def __init__(self, name, batch):
        self.process = subprocess.Popen([sys.executable, __file__, "--contender", name, "--batch", str(batch)],
                                        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def seconds_per_step(self, count):
        self.process.stdin.write(f"{count}\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline()) / count

    def stop(self):
        """Ends the process -> its peak memory in MB."""
        self.process.stdin.close()
        return float(self.process.stdout.readlines()[-1])


def compare(names, batch, rounds, count):
    """Every contender in turn, round after round -> {name: seconds per step of each round}, {name: peak MB}."""
    contenders, first = {}, {}
    for name in names:
        contender = Contender(name, batch)
        try:
            contender.seconds_per_step(2)  # warm up; compile
            first[name] = contender.seconds_per_step(1)
        except ValueError:
            print(f"{name}: does not run here", flush=True)
            continue
        if first[name] > 3 * min(first.values()):
            print(f"{name}: {first[name]:.1f} s a step, out of the race", flush=True)
            contender.stop()
            continue
        contenders[name] = contender
    seconds = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, contender in contenders.items():
            seconds[name].append(contender.seconds_per_step(count))
    return seconds, {name: contender.stop() for name, contender in contenders.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=8, help="of each contender per round")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--only", nargs="+", choices=OURS + TWINS, default=OURS + TWINS)
    parser.add_argument("--contender", choices=OURS + TWINS, help=argparse.SUPPRESS)
    parser.add_argument("--json")
    args = parser.parse_args()
    if args.contender:
        return work(args.contender, args.batch)
    seconds, memory = compare(args.only, args.batch, args.rounds, args.steps)
    for name, values in seconds.items():
        print(f"{name:<32} {1e3 * statistics.median(values):7.0f} ms a step ({1e3 * min(values):.0f} to "
              f"{1e3 * max(values):.0f}), {memory[name]:.0f} MB")
    figures = {f"{name}_ms": 1e3 * statistics.median(values) for name, values in seconds.items()}
    figures.update({f"{name}_mb": value for name, value in memory.items()})
    best_of = {kind: min((name for name in names if name in seconds), key=lambda name: statistics.median(seconds[name]))
               for kind, names in (("ours", OURS), ("torch", TWINS)) if any(name in seconds for name in names)}
    if len(best_of) == 2:
        ratios = [twin / own for own, twin in zip(seconds[best_of["ours"]], seconds[best_of["torch"]])]
        share = memory[best_of["ours"]] / memory[best_of["torch"]]
        figures.update(train_step_speedup_vs_torch=statistics.median(ratios), train_step_memory_vs_torch=share,
                       train_step_speedup_vs_torch_min=min(ratios), train_step_speedup_vs_torch_max=max(ratios))
        print(f"{best_of['ours']} is {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}) times as "
              f"fast as {best_of['torch']}, with {share:.2f} of its memory")
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
