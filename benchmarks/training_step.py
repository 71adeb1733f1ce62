"""A training step of the full model: ours against PyTorch's.

    python benchmarks/training_step.py --json docs/results/training_step.json     (needs the extra "bench")
    python benchmarks/training_step.py --before DIR     and against ours in DIR, a clone of another commit

Every contender makes the same steps on the same pokes: batch, forward, losses, backward, optimiser. BLAS has one thread
in our processes; PyTorch is tried with one and two, with brute-force and KD-tree Chamfer, eager and compiled, and the
fastest median counts. Memory is the peak, a worker's own pages added to its parent's (Linux only). PyTorch gets its
batches from `make_batch` too, and the C library keeps freed memory for it as it does for us.

Also the floor: how long the bare matrix products of the network and the bare KD-trees of the Chamfer distance take,
which no implementation can do without where all points move. Some ten minutes on two cores.
"""
import hind4sight_min  # noqa: F401  before NumPy: it sets the number of BLAS threads

import argparse
import statistics
from contextlib import contextmanager
from timeit import repeat

import numpy as np
from autograd import grad
from autograd.tracer import getval, isbox
from race import DATA, fastest, parser_of, race, ratios, report, serve, shown, spread
from scipy.spatial import cKDTree

from hind4sight_min import losses, networks, training
from hind4sight_min.disk.files import write_json
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab.processes import parallel_map
from hind4sight_min.ops import unflatten

OURS = ("ours_1_process", "ours_2_processes")
TWINS = tuple(f"torch_{chamfer}_{mode}_{threads}_threads" for chamfer in ("tree", "brute")
              for mode in ("eager", "compiled") for threads in (1, 2))


# --- the contenders: a context with a function that makes one step ---------------------------------------------

@contextmanager
def ours(batch, jobs):
    """The steps of training.train, one at a time, its worker processes kept."""
    data = load_interactions(DATA / "train")
    run = training.start_run(training.Recipe(steps=10 ** 6, batch=batch), data)
    with parallel_map(jobs) as map:
        yield lambda: training.training_step(data, run, map=map)


@contextmanager
def twin(batch, threads, chamfer, mode):
    import torch
    import torch_twin
    torch.set_num_threads(threads)
    data = load_interactions(DATA / "train")
    recipe = training.Recipe(steps=10 ** 6, batch=batch)
    run = training.start_run(recipe, data)
    params = {name: torch.from_numpy(value.copy()).requires_grad_() for name, value in run.params.items()}
    # Muon for matrices, Adam for the rest, as ours
    optimisers = [torch.optim.Muon([each for each in params.values() if each.ndim == 2], lr=recipe.learning_rate,
                                   momentum=0.9, weight_decay=0, adjust_lr_fn="match_rms_adamw"),
                  torch.optim.Adam([each for each in params.values() if each.ndim == 1], lr=recipe.learning_rate)]
    nearest = {"tree": torch_twin.nearest_by_tree, "brute": torch_twin.nearest_by_brute_force}[chamfer]
    if mode == "compiled":
        nearest = torch.compiler.disable(nearest)
    loss = torch.compile(torch_twin.full_loss) if mode == "compiled" else torch_twin.full_loss

    def step():
        rows = training.rows_of_step(recipe, len(data), run.step)
        batch = training.make_batch(data[rows], recipe, np.random.default_rng(run.step))
        tensors = torch_twin.tensors(batch)
        for optimiser in optimisers:
            optimiser.zero_grad()
        loss(params, recipe.sizes, tensors, data.camera, recipe.weights, nearest).backward()
        for optimiser in optimisers:
            optimiser.step()
        run.step += 1
    yield step


# --- the floor ---------------------------------------------------------------------------------------------------

def products_of(network, vector):
    """All matrix products of a network's layers, forward and back, as a list of pairs of matrices."""
    pairs, dense = [], networks.dense

    def recorded(x, weights, bias, **options):
        y = dense(x, weights, bias, **options)
        rows, w, g = getval(x), getval(weights), getval(y)
        pairs.extend([(rows, w), (rows.reshape(-1, len(w)).T, g.reshape(-1, g.shape[-1]))])
        if isbox(x):  # something below it learns
            pairs.append((g, w.T))
        return y

    networks.dense = recorded
    try:
        grad(network)(vector)
    finally:
        networks.dense = dense
    return pairs


def floors(rounds, count=8):
    """The network and the Chamfer distance of one gradient, against the bare products and trees, on one thread."""
    data, rng = load_interactions(DATA / "train")[:count], np.random.default_rng(0)
    run = training.start_run(training.Recipe(), data)
    vector = run.vector + 0.02 * rng.standard_normal(run.vector.shape).astype(np.float32)
    batch, sizes = training.make_batch(data, run.recipe, rng), run.recipe.sizes
    before, after = batch.before, batch.after
    valid, next_valid = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)

    def network(vector):
        params = unflatten(vector, run.layout)
        predicted = networks.predict(params, sizes, before, batch.pokes).points
        return sum((value * value).sum() for value in (predicted, *networks.inverse_model(params, *batch.evidence)))

    def chamfer(predicted):
        return losses.chamfer_loss(*losses.distance_maps(predicted, after.points, valid, next_valid)).sum()

    def bare_products():
        for a, b in pairs:
            np.matmul(a, b)

    moved = before.points + 1e-3 * rng.standard_normal(before.points.shape).astype(np.float32)

    def bare_trees():
        for p, q, here, there in zip(moved, after.points, valid, next_valid):
            cKDTree(q[there], compact_nodes=False, balanced_tree=False).query(p)
            cKDTree(p[here], compact_nodes=False, balanced_tree=False).query(q)

    figures, pairs = {}, products_of(network, vector)
    for name, call, bare in (("network_over_matmul_floor", lambda: grad(network)(vector), bare_products),
                             ("chamfer_over_kdtree_floor", lambda: grad(chamfer)(moved), bare_trees)):
        each = [[min(repeat(function, number=1)) for function in (call, bare)] for _ in range(rounds)]
        values, bare_ms = [a / b for a, b in each], 1e3 * statistics.median(b for _, b in each) / count
        figures.update({**spread(name, values), f"{name}_bare_ms": bare_ms})
        print(f"{name}: {shown(values)}; the floor is {bare_ms:.2f} ms per interaction", flush=True)
    return figures


def main():
    parser = parser_of(__doc__, rounds=9)
    parser.add_argument("--batch", type=int, nargs="+", default=[16, 4, 64], help="the first counts, the default one")
    parser.add_argument("--only", nargs="+", choices=OURS + TWINS, default=OURS + TWINS)
    parser.add_argument("--seconds", type=float, default=1.0, help="that a turn takes the fastest")
    parser.add_argument("--before", metavar="DIR", help="a clone of another commit, to race against")
    parser.add_argument("--contender", choices=OURS + TWINS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.contender:
        kind, *how, count, _ = args.contender.split("_")
        return serve({"ours": ours, "torch": twin}[kind](args.batch[0], int(count), *how))
    before = tuple(f"before_{name}" for name in OURS if args.before and name in args.only)
    figures = floors(args.rounds)
    for batch in args.batch:
        print(f"a step of {batch} interactions")
        times, memory = race(__file__, (*args.only, *before), ["--batch", batch], args.rounds, args.seconds,
                             hopeless=3.0, before=args.before)
        report(times, memory)
        figures.update({f"{name}_batch_{batch}_ms": 1e3 * statistics.median(values) for name, values in times.items()})
        figures.update({f"{name}_batch_{batch}_mb": value for name, value in memory.items()})
        suffix = "" if batch == args.batch[0] else f"_batch_{batch}"
        for peer, names in (("torch", TWINS), ("before", before)):
            if not times.keys() & set(names):
                continue
            own, other = fastest(times, OURS), fastest(times, names)
            speedups, share = ratios(times, other, own), memory[own] / memory[other]
            print(f"{own} is {shown(speedups)} times as fast as {other}, with {share:.2f} of its memory", flush=True)
            figures.update(spread(f"train_step_speedup_vs_{peer}{suffix}", speedups))
            figures[f"train_step_memory_vs_{peer}{suffix}"] = share
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
