"""A training step of the full model: ours against PyTorch's.

    python benchmarks/training_step.py --json docs/results/training_step.json     (needs the extra "bench")

Every contender makes the same steps on the same pokes: batch, forward, losses, backward, optimiser. BLAS has one thread in
our processes; PyTorch is tried with one and two, with brute-force and KD-tree Chamfer, eager and compiled, and the
fastest median counts. Memory is the peak, a worker's own pages added to its parent's (Linux only).

Also the floor: how long the bare matrix products of the network and the bare KD-trees of the Chamfer distance take,
which no implementation can do without (ours avoids searches whose result is known). Some ten minutes on two cores.
"""
import argparse
import statistics
import time
from contextlib import contextmanager

import numpy as np
from autograd import grad
from autograd.tracer import getval, isbox
from race import fastest, race, ratios, report, serve
from scipy.spatial import cKDTree

from hind4sight_min import geometry, losses, networks, training
from hind4sight_min.__main__ import data_small
from hind4sight_min.interactions import load_interactions, write_json

DATA = data_small() / "train"
OURS = ("ours_1_process", "ours_2_processes")
TWINS = tuple(f"torch_{chamfer}_{mode}_{threads}_threads" for chamfer in ("tree", "brute")
              for mode in ("eager", "compiled") for threads in (1, 2))


# --- the contenders: a context with a function that makes one step ---------------------------------------------

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
    # Muon for matrices, Adam for the rest, as ours
    optimisers = [torch.optim.Muon([each for each in params.values() if each.ndim == 2], lr=recipe.learning_rate,
                                   momentum=0.9, weight_decay=0, adjust_lr_fn="match_rms_adamw"),
                  torch.optim.Adam([each for each in params.values() if each.ndim == 1], lr=recipe.learning_rate)]
    nearest = {"tree": torch_twin.nearest_by_tree, "brute": torch_twin.nearest_by_brute_force}[chamfer]
    if mode == "compiled":
        nearest = torch.compiler.disable(nearest)
    loss = torch.compile(torch_twin.full_loss) if mode == "compiled" else torch_twin.full_loss

    def step():
        rows, mirror, _ = training.rows_of_step(recipe, len(data), run.step)
        tensors = torch_twin.tensors(training.make_batch(data, rows, mirror))
        for optimiser in optimisers:
            optimiser.zero_grad()
        loss(params, recipe.sizes, tensors, data.camera, training.WEIGHTS, nearest).backward()
        for optimiser in optimisers:
            optimiser.step()
        run.step += 1
    yield step


def work(name, batch):
    if name in OURS:
        return serve(ours(batch, jobs=1 + OURS.index(name)))
    _, chamfer, mode, threads, _ = name.split("_")
    return serve(twin(batch, chamfer, mode, int(threads)))


# --- the floor ---------------------------------------------------------------------------------------------------

def products_of(network, vector):
    """All matrix products of a network's layers, forward and back, as a list of pairs of matrices."""
    shapes = []

    def recorded(x, weights, bias, **options):
        shapes.append((x.shape, weights.shape, isbox(x)))
        return dense(x, weights, bias, **options)
    dense, networks.dense = networks.dense, recorded
    try:
        grad(network)(vector)
    finally:
        networks.dense = dense
    rng, pairs = np.random.default_rng(0), []
    for shape, (inputs, outputs), traced in shapes:
        x, w, g = (rng.standard_normal(size).astype(np.float32)
                   for size in (shape, (inputs, outputs), shape[:-1] + (outputs,)))
        pairs.append((x, w))
        pairs.append((x.reshape(-1, inputs).T, g.reshape(-1, outputs)))
        if traced:  # something below it learns
            pairs.append((g, w.T))
    return pairs


def seconds_of(call):
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def floors(rounds, batch_size=8):
    """The network and the Chamfer distance of one gradient, against the bare products and trees, on one thread."""
    data = load_interactions(DATA)
    run = training.start_run(training.Recipe(), data)
    rng = np.random.default_rng(0)
    run.vector = run.vector + 0.02 * rng.standard_normal(run.vector.shape).astype(np.float32)
    batch, sizes = training.make_batch(data, np.arange(batch_size)), run.recipe.sizes

    def network(vector):
        params = training.unflatten(vector, run.layout)
        prediction, _ = training.run_forward_model(params, sizes, batch, data.camera)
        heatmaps = training.run_inverse_model(params, batch)
        embeddings = training.next_embeddings(params, batch, prediction.points)
        return sum((value * value).sum() for value in (prediction.points, *embeddings, *heatmaps))

    pairs = products_of(network, run.vector)
    trained = training.load_run(data_small() / "checkpoint.npz")
    predicted = training.run_forward_model(trained.params, trained.recipe.sizes, batch, data.camera)[0].points

    def bare_products():
        for a, b in pairs:
            np.matmul(a, b)

    def chamfer(predicted, spare):
        free = (geometry.free_radius(batch.points, getval(predicted),
                                     geometry.ray_spacing(batch.points, data.camera)),
                geometry.ray_spacing(batch.next_points, data.camera)) if spare else ()
        maps = losses.distance_maps(predicted, batch.next_points, batch.shared, batch.next_shared, *free)
        return losses.chamfer_loss(*maps).sum()

    def bare_trees():
        for p, q, valid, next_valid in zip(predicted, batch.next_points, batch.shared, batch.next_shared):
            cKDTree(q[next_valid], compact_nodes=False, balanced_tree=False).query(p)
            cKDTree(p[valid], compact_nodes=False, balanced_tree=False).query(q)

    figures = {}
    for name, call, bare in (("network_over_matmul_floor", lambda: grad(network)(run.vector), bare_products),
                             ("chamfer_over_kdtree_floor", lambda: grad(chamfer)(predicted, False), bare_trees),
                             ("chamfer_in_step_over_kdtree_floor", lambda: grad(chamfer)(predicted, True), bare_trees)):
        call(), bare()
        each = [(min(seconds_of(call) for _ in range(5)), min(seconds_of(bare) for _ in range(5)))
                for _ in range(rounds)]
        values = [a / b for a, b in each]
        figures.update({name: statistics.median(values), f"{name}_min": min(values), f"{name}_max": max(values),
                        f"{name}_bare_ms": 1e3 * statistics.median(b for _, b in each) / batch_size})
        print(f"{name}: {statistics.median(values):.2f} ({min(values):.2f} to {max(values):.2f}); the floor is "
              f"{figures[f'{name}_bare_ms']:.2f} ms per interaction", flush=True)
    return figures


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--batch", type=int, nargs="+", default=[16, 4, 64], help="the first counts, the default one")
    parser.add_argument("--only", nargs="+", choices=OURS + TWINS, default=OURS + TWINS)
    parser.add_argument("--contender", choices=OURS + TWINS, help=argparse.SUPPRESS)
    parser.add_argument("--json")
    args = parser.parse_args()
    if args.contender:
        return work(args.contender, args.batch[0])
    figures = floors(args.rounds)
    for batch in args.batch:
        print(f"a step of {batch} interactions")
        times, memory = race(__file__, args.only, ["--batch", batch], args.rounds, seconds=1.0,
                             hopeless=3.0)
        report(times, memory)
        figures.update({f"{name}_batch_{batch}_ms": 1e3 * statistics.median(values) for name, values in times.items()})
        figures.update({f"{name}_batch_{batch}_mb": value for name, value in memory.items()})
        own, other = (fastest(times, names) for names in (OURS, TWINS))
        speedup, least, most = ratios(times, other, own)
        share = memory[own] / memory[other]
        print(f"{own} is {speedup:.2f} ({least:.2f} to {most:.2f}) times as fast as {other}, with {share:.2f} of its "
              "memory", flush=True)
        suffix = "" if batch == args.batch[0] else f"_batch_{batch}"
        figures.update({f"train_step_speedup_vs_torch{suffix}": speedup,
                        f"train_step_speedup_vs_torch{suffix}_min": least,
                        f"train_step_speedup_vs_torch{suffix}_max": most,
                        f"train_step_memory_vs_torch{suffix}": share})
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
