"""Why it works, and where it fails: the pictures and the table of docs/understanding.md.

    python docs/understanding.py

Reads the shipped checkpoint, the shipped test pokes and their truth; writes docs/landscape.png, docs/failures.png and
docs/understanding.md's table of gradient norms. About a minute.
"""
import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from hind4sight_min import evaluation, losses, training
from hind4sight_min.__main__ import data_small, write_text
from hind4sight_min.figures import _arrow, _blend, _show, flow_to_rgb, save_figure
from hind4sight_min.geometry import optical_flow, project
from hind4sight_min.interactions import load_interactions, load_truth, true_scene_flow

DOCS = Path(__file__).resolve().parent
BEGIN, END = "<!-- norms: written by docs/understanding.py -->", "<!-- /norms -->"
COLOURS = {"chamfer": "#0072B2", "distance_smoothness": "#56B4E9", "photometric": "#D55E00", "flow_smoothness": "#E69F00"}


def moved_labels(truth, row):
    """Which objects a poke moved, by more than 1 mm."""
    shift = np.linalg.norm(truth.poses_after[row, :, :3] - truth.poses_before[row, :, :3], axis=1)
    return np.flatnonzero(shift > 1e-3) + 1


def terms_at(batch, moves, camera):
    """The four terms without parameters, weighted, for a scene flow `moves` (B, n, 3) -> {name: (B,)}."""
    predicted = (batch.points + moves).astype(np.float32)
    maps = losses.distance_maps(predicted, batch.next_points, batch.shared, batch.next_shared)
    flow = optical_flow(batch.points, predicted, camera).reshape(batch.images.shape[:3] + (2,))
    values = {"chamfer": losses.chamfer_loss(*maps),
              "distance_smoothness": losses.distance_smoothness_loss(*maps, batch.images, batch.next_images, batch.shared,
                                                                     batch.next_shared),
              "photometric": losses.photometric_loss(batch.images, batch.next_images, flow, batch.shared),
              "flow_smoothness": losses.flow_smoothness_loss(flow, batch.images, batch.valid)}
    return {name: training.WEIGHTS[name] * value for name, value in values.items()}


def landscape(interactions, truth, count=60):
    """Each term along the scaled true flow, and along a rotation added to it, averaged over pokes of one object."""
    rows = np.array([row for row in range(len(interactions)) if len(moved_labels(truth, row)) == 1][:count])
    figure = Figure(figsize=(9, 7), layout="constrained")
    axes = figure.subplots(2, 2, sharey="row")
    scales, angles = np.linspace(-0.5, 2, 26), np.linspace(-60, 60, 25)
    for line, noise in enumerate((0.0, 0.01)):
        batch = training.make_batch(interactions, rows, depth_noise=noise, rng=np.random.default_rng(0), truth=truth[rows])
        true = batch.targets - batch.points
        moving = np.linalg.norm(true, axis=2) > 1e-4
        after = batch.points + true
        weight = moving[..., None] / np.maximum(moving.sum(axis=1), 1)[:, None, None]
        centre = (after * weight).sum(axis=1, keepdims=True)

        def turned(angle):
            turn = Rotation.from_rotvec([0, 0, np.radians(angle)]).as_matrix()
            return np.where(moving[..., None], (after - centre) @ turn.T + centre - batch.points, true)
        for panel, sweep, flows, label in (
                (axes[line, 0], scales, [scale * true for scale in scales], "share of the true scene flow"),
                (axes[line, 1], angles, [turned(angle) for angle in angles], "turn added to the true motion, degrees")):
            curves = [terms_at(batch, flow, interactions.camera) for flow in flows]
            for name, colour in COLOURS.items():
                values = np.array([curve[name].mean() for curve in curves])
                panel.plot(sweep, values - values.min(), color=colour, label=name.replace("_", " "))
            panel.axvline(1 if panel is axes[line, 0] else 0, color="grey", linestyle=":")
            panel.set_xlabel(label)
        axes[line, 0].set_ylabel(f"weighted term less its minimum\n{'1 cm depth noise' if noise else 'no noise'}")
    axes[0, 0].set_title("Along the motion: all but flow smoothness\nhave their minimum at the truth")
    axes[0, 1].set_title("Along a turn: pictures see it,\ngeometry less (many objects are round)")
    axes[0, 0].legend(fontsize=8)
    return figure


def gradient_norms(run, interactions, count=40):
    """{term: (norm of the mean gradient, median norm of one poke's)} over some pokes, before weighting."""
    found = {}
    for term in training.WEIGHTS:
        weights = {name: float(name == term) for name in training.WEIGHTS}
        each = np.stack([training.batch_gradient(run.vector, run.layout, run.recipe.sizes,
                                                 training.make_batch(interactions, np.array([row])), interactions.camera,
                                                 weights)[1] for row in range(count)])
        found[term] = np.linalg.norm(each.mean(axis=0)), np.median(np.linalg.norm(each, axis=1))
    return found


def norms_table(runs, interactions):
    lines = ["| term | weight | " + " | ".join(f"{name}: mean gradient, weighted | one poke's, weighted" for name in runs)
             + " |", "|---|---|" + "---|---|" * len(runs)]
    norms = {name: gradient_norms(run, interactions) for name, run in runs.items()}
    for term, weight in training.WEIGHTS.items():
        values = " | ".join(f"{weight * mean:.3g} | {weight * single:.3g}" for mean, single in
                            (norms[name][term] for name in runs))
        lines.append(f"| {term.replace('_', ' ')} | {weight:g} | {values} |")
    return "\n".join(lines)


def failures(run, interactions, truth):
    """The worst poke of each kind: a second object hit, a wall met, a soft mask, a turn missed."""
    camera, worst = interactions.camera, {}
    half = interactions.meta["settings"]["arena"] / 2
    for first in range(0, len(interactions), 40):
        rows = np.arange(first, min(first + 40, len(interactions)))
        batch, prediction, flow, *_ = evaluation.predict(run, interactions, rows)
        for i, row in enumerate(rows):
            true = true_scene_flow(batch.points[i], truth.labels[row].ravel(), truth.poses_before[row],
                                   truth.poses_after[row])
            moving = (np.linalg.norm(true, axis=1) > evaluation.MOVING) & batch.valid[i]
            labels = moved_labels(truth, row)
            if not moving.any() or not len(labels):
                continue
            error = ((prediction.points[i] - batch.points[i] - true)[moving] ** 2).sum()
            at_wall = np.abs(truth.poses_after[row, labels - 1, :2]).max() > half - 0.045
            turn = max(Rotation.from_quat(truth.poses_after[row, k - 1, 3:]).inv().__mul__(
                Rotation.from_quat(truth.poses_before[row, k - 1, 3:])).magnitude() for k in labels)
            soft = 1 - prediction.masks[i][moving, 1:].sum(axis=1).mean()
            kinds = {"a second object is hit": len(labels) > 1, "a wall stops it": at_wall and len(labels) == 1,
                     "it turns more than 40\u00b0": turn > np.radians(40) and len(labels) == 1 and not at_wall,
                     "its mask stays soft": soft > 0.4 and len(labels) == 1 and not at_wall}
            for kind, holds in kinds.items():
                if holds and error > worst.get(kind, (0,))[0]:
                    worst[kind] = (error, row, prediction.masks[i], flow[i],
                                   optical_flow(batch.points[i], batch.points[i] + true, camera))
    figure = Figure(figsize=(10, 2.2 * len(worst)), layout="constrained")
    axes = figure.subplots(len(worst), 4, squeeze=False)
    shape = (camera.height, camera.width)
    for line, (kind, (_, row, masks, flow, true)) in zip(axes, worst.items()):
        image = interactions.rgb_before[row] / 255
        true = true.reshape(*shape, 2)
        scale = np.linalg.norm(true, axis=2).max()
        _show(line[0], image, f"Before: {kind}")
        ends = np.array([[*interactions.starts[row], 0.02], [*interactions.pokes[row, :2], 0.02]])
        _arrow(line[0], *project(ends, camera))
        _show(line[1], _blend(image, masks.reshape(*shape, -1)[..., 1:]), "Predicted masks")
        _show(line[2], flow_to_rgb(flow, scale), "Predicted optical flow")
        _show(line[3], flow_to_rgb(true, scale), "True optical flow, same colours")
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of understanding.md and the pictures")
    args = parser.parse_args()
    interactions, truth = load_interactions(data_small() / "test"), load_truth(data_small() / "test")
    shipped = training.load_run(data_small() / "checkpoint.npz")
    save_figure(landscape(interactions, truth), args.out / "landscape.png")
    save_figure(failures(shipped, interactions, truth), args.out / "failures.png")
    train = load_interactions(data_small() / "train")
    early = training.start_run(training.Recipe(steps=100), train)
    training.train(train, early)
    page = args.out / "understanding.md"
    before, rest = page.read_text().split(BEGIN)
    _, after = rest.split(END)
    table = norms_table({"after 100 steps": early, "shipped": shipped}, interactions)
    write_text(page, f"{before}{BEGIN}\n{table}\n{END}{after}")


if __name__ == "__main__":
    main()
