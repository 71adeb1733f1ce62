"""Chamfer distance and bilinear warping, value and gradient, against what one would use instead, at several sizes.

    python benchmarks/operations.py --json docs/results/operations.json     (needs the extra "bench")
    python benchmarks/operations.py --draw docs/speed.png

Chamfer: our KD-trees against brute force in PyTorch (one and two threads) and point-cloud-utils (its nearest
neighbours, the gradient in NumPy). Warping: our cv2.remap against PyTorch's grid_sample (one and two threads) and
SciPy's map_coordinates. Ours uses the threads OpenCV takes by itself, all cores for the queries of large clouds, and
one for all else. Some eight minutes on two cores. The drawing shows these and the training step, as they are recorded.
"""
import argparse
import json
import statistics
from contextlib import contextmanager

import autograd.numpy as anp
import cv2
import numpy as np
from autograd import grad, value_and_grad
from race import ROOT, fastest, parser_of, race, ratios, report, serve, shown, spread

from hind4sight_min import losses
from hind4sight_min.disk.files import write_json

CHAMFER = ("ours", "torch_1_threads", "torch_2_threads", "point_cloud_utils")
WARP = ("ours", "torch_1_threads", "torch_2_threads", "scipy")
POINTS = (500, 2000, 10000, 30000, 100000)
PICTURES = ((48, 64), (96, 128), (240, 320), (480, 640))
LARGEST_BRUTE = 30000  # points: beyond it a matrix of all pairs takes minutes


# --- Chamfer ---------------------------------------------------------------------------------------------------

def clouds(count):
    """A bumpy surface as a depth picture shows it, row by row, before and after 5 mm of noise: (count, 3) each."""
    rng = np.random.default_rng(0)
    columns = int(np.ceil(np.sqrt(count)))
    xy = np.stack(np.meshgrid(*[np.linspace(-0.25, 0.25, columns)] * 2), axis=-1).reshape(-1, 2)[:count]
    points = np.column_stack([xy, 0.03 * np.sin(20 * xy[:, 0]) * np.sin(25 * xy[:, 1])])
    return (points.astype(np.float32), (points + 0.005 * rng.standard_normal((count, 3))).astype(np.float32))


@contextmanager
def chamfer(name, count):
    """Chamfer distance of two clouds and its gradient to the first."""
    predicted, observed = clouds(count)
    if name == "ours":
        valid = np.ones((1, count), bool)

        def loss(predicted):
            return anp.sum(losses.chamfer_loss(*losses.distance_maps(predicted[None], observed[None], valid, valid)))
        yield lambda: value_and_grad(loss)(predicted)
    elif name == "point_cloud_utils":
        import point_cloud_utils as pcu

        def call():
            _, to = pcu.k_nearest_neighbors(predicted, observed, 1)
            _, back = pcu.k_nearest_neighbors(observed, predicted, 1)
            there, here = predicted - observed[to], predicted[back] - observed
            gradient = 2 * there
            for axis in range(3):
                gradient[:, axis] += np.bincount(back, 2 * here[:, axis], count)
            return (there * there).sum() + (here * here).sum(), gradient
        yield call
    else:
        import torch
        torch.set_num_threads(int(name.split("_")[1]))
        p, q = (torch.from_numpy(points) for points in (predicted, observed))

        def call():
            variable = p.clone().requires_grad_()
            with torch.no_grad():
                distances = torch.cdist(variable, q)
                to, back = distances.argmin(dim=1), distances.argmin(dim=0)
            value = ((variable - q[to]) ** 2).sum() + ((variable[back] - q) ** 2).sum()
            value.backward()
            return value.item(), variable.grad
        yield call


# --- warping ---------------------------------------------------------------------------------------------------

@contextmanager
def warp(name, height, width):
    """A picture pulled back along a flow, and the gradient of a weighted sum of it to the flow."""
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.random((height // 8, width // 8, 3)).astype(np.float32), (width, height))
    flow = (2 * rng.standard_normal((height, width, 2))).astype(np.float32)
    g = rng.standard_normal(image.shape).astype(np.float32)
    if name == "ours":
        def loss(flow):
            return anp.sum(losses.warp_backward(image[None], flow)[0] * g)
        yield lambda: grad(loss)(flow[None])
    elif name == "scipy":
        from scipy.ndimage import map_coordinates
        y, x = np.mgrid[:height, :width].astype(np.float32)

        def call():  # the picture and, for the gradient, the differences between its pixels
            pulled = np.zeros_like(flow)
            where = [np.clip(y + flow[..., 1], 0, height - 1), np.clip(x + flow[..., 0], 0, width - 1)]
            for c in range(3):
                map_coordinates(image[..., c], where, order=1, mode="nearest")
                for axis in (0, 1):
                    cell = list(where)
                    cell[axis] = np.minimum(np.floor(where[axis]), image.shape[axis] - 2)
                    slope = map_coordinates(np.diff(image[..., c], axis=axis), cell, order=1, mode="nearest")
                    pulled[..., 1 - axis] += g[..., c] * slope
            return pulled
        yield call
    else:
        import torch
        import torch.nn.functional as F
        torch.set_num_threads(int(name.split("_")[1]))
        picture, weights = (torch.from_numpy(value).permute(2, 0, 1)[None].contiguous() for value in (image, g))
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        pixels, last = torch.stack([u, v], dim=-1).float(), torch.tensor([width - 1.0, height - 1.0])

        def call():
            variable = torch.from_numpy(flow)[None].requires_grad_()
            warped = F.grid_sample(picture, 2 * (pixels + variable) / last - 1, padding_mode="border",
                                   align_corners=True)
            (warped * weights).sum().backward()
            return variable.grad
        yield call


# --- the comparison -------------------------------------------------------------------------------------------

def measure(what, names, sizes, rounds, seconds, figures):
    """Race the contenders at all sizes, and fill the flat dict of figures."""
    for size in sizes:
        label = "x".join(map(str, size))
        print(f"{what}, {label}", flush=True)
        entered = [name for name in names
                   if what == "warp" or not name.startswith("torch") or size[0] <= LARGEST_BRUTE]
        times, memory = race(__file__, entered, [what, *size], rounds, seconds)
        report(times, memory)
        for name, values in times.items():
            figures[f"{what}_{label}_{name}_ms"] = 1e3 * statistics.median(values)
            figures[f"{what}_{label}_{name}_mb"] = memory[name]
        for kind in {name.split("_")[0] for name in times} - {"ours"}:
            other = fastest(times, [name for name in times if name.startswith(kind)])
            speedups = ratios(times, other, "ours")
            figures.update(spread(f"{what}_{label}_speedup_vs_{kind}", speedups))
            print(f"  ours is {shown(speedups)} times as fast as {other}", flush=True)


def draw(path, operations, step):
    """The figure of docs/speed.md, from the recorded figures of this benchmark and of training_step.py."""
    from matplotlib.figure import Figure

    from hind4sight_min.lab.figures import BLUE, GREEN, ORANGE, RED, SKY, save_figure
    figure = Figure(figsize=(11, 3.6), dpi=110, layout="constrained")
    axes = figure.subplots(1, 3)
    styles = {"ours": (BLUE, "o"), "torch_1_threads": (ORANGE, "s"), "torch_2_threads": (RED, "s"),
              "point_cloud_utils": (GREEN, "^"), "scipy": (GREEN, "^")}
    for axis, what, names, sizes, title, unit in (
            (axes[0], "chamfer", CHAMFER, {str(n): n for n in POINTS}, "Chamfer distance: like N log N", "points"),
            (axes[1], "warp", WARP, {f"{h}x{w}": h * w for h, w in PICTURES}, "Warping: behind grid_sample", "pixels")):
        for name in names:
            colour, marker = styles[name]
            values = [operations.get(f"{what}_{label}_{name}_ms", np.nan) for label in sizes]
            axis.loglog(list(sizes.values()), values, color=colour, marker=marker, label=name.replace("_", " "))
        axis.set(title=title, xlabel=unit, ylabel="ms, value and gradient")
    n = np.array(POINTS, float)
    scale = operations["chamfer_10000_ours_ms"] / (1e4 * np.log(1e4))
    axes[0].loglog(n, scale * n * np.log(n), ":", color="grey", label="in proportion to N log N")
    contenders = {"ours_1_process": (SKY, "ours,\n1 process"), "ours_2_processes": (BLUE, "ours,\n2 processes"),
                  "torch_tree_eager_1_threads": (ORANGE, "torch,\n1 thread"),
                  "torch_tree_eager_2_threads": (RED, "torch,\n2 threads")}
    for name, (colour, label) in contenders.items():
        axes[2].bar(label, step[f"{name}_batch_16_ms"], color=colour)
    axes[2].set(title="A training step of the full model", ylabel="ms, of 16 interactions")
    axes[2].tick_params("x", labelsize=8.5)
    for axis in axes[:2]:
        axis.legend(fontsize=8)
    save_figure(figure, path)


def main():
    parser = parser_of(__doc__, rounds=7)
    parser.add_argument("--points", type=int, nargs="+", default=POINTS)
    parser.add_argument("--pictures", type=lambda text: tuple(map(int, text.split("x"))), nargs="+", metavar="HxW",
                        default=PICTURES)
    parser.add_argument("--only", nargs="+", default=CHAMFER + WARP, choices=dict.fromkeys(CHAMFER + WARP))
    parser.add_argument("--seconds", type=float, default=0.5, help="that a turn takes the fastest")
    parser.add_argument("--draw", metavar="PNG", help="measure nothing; draw what docs/results has")
    parser.add_argument("--contender", help=argparse.SUPPRESS)
    parser.add_argument("task", nargs="*", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.contender:
        what, *size = args.task
        return serve({"chamfer": chamfer, "warp": warp}[what](args.contender, *map(int, size)))
    if args.draw:
        return draw(args.draw, *(json.loads((ROOT / "docs" / "results" / f"{name}.json").read_text())["figures"]
                                 for name in ("operations", "training_step")))
    figures = {}
    for what, names, sizes in (("chamfer", CHAMFER, [(n,) for n in args.points]), ("warp", WARP, args.pictures)):
        measure(what, [name for name in names if name in args.only], sizes, args.rounds, args.seconds, figures)
    if 10000 in args.points:
        figures["chamfer_speedup_vs_torch_10k"] = figures["chamfer_10000_speedup_vs_torch"]
    warps = [figures[f"warp_{h}x{w}_speedup_vs_torch"] for h, w in args.pictures]
    figures["warp_speedup_vs_grid_sample_min"] = min(warps)
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
