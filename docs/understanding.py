"""Why it works, and where it fails: the pictures and the table of docs/understanding.md.

    python docs/understanding.py

Reads the shipped checkpoint, the shipped test pokes and their truth, and simulates pokes of objects never trained on;
writes docs/landscape.png, failures.png, emergent.png and the table of gradient norms in docs/understanding.md. About a
minute.
"""
import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from hind4sight_min import losses, training  # before NumPy: it sets the number of BLAS threads
from hind4sight_min.disk import checkpoints
from hind4sight_min.disk.files import write_text
from hind4sight_min.geometry import optical_flow
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab import evaluation
from hind4sight_min.lab.cli import data_small
from hind4sight_min.lab.figures import (TERM_COLOURS, blend, draw_arrow, draw_wheel, on_table, save_figure,
                                        show_flow, show_image, zoom)
from hind4sight_min.lab.noise import with_depth_noise
from hind4sight_min.sim.arena import Settings
from hind4sight_min.sim.collection import collect
from hind4sight_min.sim.objects import HELD_OUT
from hind4sight_min.sim.photographs import photographs
from hind4sight_min.sim.truth import load_truth

import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from results import page_with  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

DOCS = Path(__file__).resolve().parent


def moved_labels(truth, row):
    """Which objects a poke moved, by more than 1 mm."""
    shift = np.linalg.norm(truth.poses_after[row, :, :3] - truth.poses_before[row, :, :3], axis=1)
    return np.flatnonzero(shift > 1e-3) + 1


def terms_at(before, after, moves, camera):
    """The four terms without parameters, weighted, for a scene flow `moves` (B, N, 3) -> {name: (B,)}."""
    predicted = (before.points + moves).astype(np.float32)
    seen = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
    maps = losses.distance_maps(predicted, after.points, *seen)
    flow = optical_flow(before.points, predicted, camera).reshape(before.images.shape[:3] + (2,))
    values = {"chamfer": losses.chamfer_loss(*maps),
              "distance_smoothness": losses.distance_smoothness_loss(*maps, before.images, after.images, *seen),
              "photometric": losses.photometric_loss(before.images, after.images, flow, seen[0]),
              "flow_smoothness": losses.flow_smoothness_loss(flow, before.images, before.valid)}
    return {name: training.WEIGHTS[name] * value for name, value in values.items()}


def landscape(interactions, truth, count=60):
    """Each term along the scaled true flow, and along a rotation added to it, averaged over pokes of one object."""
    rows = np.array([row for row in range(len(interactions)) if len(moved_labels(truth, row)) == 1][:count])
    true = np.stack([evaluation.true_motion(interactions, truth, row)[0] for row in rows])
    figure = Figure(figsize=(9, 7), layout="constrained")
    axes = figure.subplots(2, 2, sharey="row")
    scales, angles = np.linspace(-0.5, 2, 26), np.linspace(-60, 60, 25)
    for line, noise in enumerate((0.0, 0.01)):
        seen = interactions[rows]
        if noise:
            seen = with_depth_noise(seen, noise, np.random.default_rng(0))
        scene, next_scene = training.scenes_of(seen)
        moving = np.linalg.norm(true, axis=2) > 1e-4
        after = scene.points + true
        weight = moving[..., None] / np.maximum(moving.sum(axis=1), 1)[:, None, None]
        centre = (after * weight).sum(axis=1, keepdims=True)

        def turned(angle):
            turn = Rotation.from_rotvec([0, 0, np.radians(angle)]).as_matrix()
            return np.where(moving[..., None], (after - centre) @ turn.T + centre - scene.points, true)
        for panel, sweep, flows, label in (
                (axes[line, 0], scales, [scale * true for scale in scales], "share of the true scene flow"),
                (axes[line, 1], angles, [turned(angle) for angle in angles], "turn added to the true motion, degrees")):
            curves = [terms_at(scene, next_scene, flow, interactions.camera) for flow in flows]
            for name in curves[0]:
                values = np.array([curve[name].mean() for curve in curves])
                panel.plot(sweep, values - values.min(), color=TERM_COLOURS[name], label=name.replace("_", " "))
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
        recipe = replace(run.recipe, batch=1, image_noise=0.0, weights={term: 1.0})
        each = np.stack([training.chunk_gradient(training.unsupervised, run.vector, run.layout, recipe,
                                                 interactions[[row]], 0)[1] for row in range(count)])
        found[term] = np.linalg.norm(each.mean(axis=0)), np.median(np.linalg.norm(each, axis=1))
    return found


def norms_table(runs, interactions):
    columns = " | ".join(f"{name}: mean gradient, weighted | one poke's, weighted" for name in runs)
    lines = [f"| term | weight | {columns} |", "|---|---|" + "---|---|" * len(runs)]
    norms = {name: gradient_norms(run, interactions) for name, run in runs.items()}
    for term, weight in training.WEIGHTS.items():
        values = " | ".join(f"{weight * mean:.3g} | {weight * single:.3g}" for mean, single in
                            (norms[name][term] for name in runs))
        lines.append(f"| {term.replace('_', ' ')} | {weight:g} | {values} |")
    return "\n".join(lines)


def predictions(run, interactions, truth):
    """For every poke that moved something: a dict of what is predicted, what is true, and how large the error is."""
    for row in range(len(interactions)):
        true, pixels, moving = evaluation.true_motion(interactions, truth, row)
        if moving.any():
            answer = evaluation.ask(run, interactions, row)
            error, masks = answer.prediction.points[0] - answer.before.points[0] - true, answer.prediction.masks[0]
            yield {"row": row, "labels": moved_labels(truth, row), "masks": masks, "flow": answer.flow,
                   "softness": 1 - masks[moving, 1:].sum(axis=1).mean(), "error": (error[moving] ** 2).sum(),
                   "motion": (true[moving] ** 2).sum(), "true": pixels}


def draw(examples):
    """[(what it shows, data set, its truth, one of `predictions`)] -> a figure with a row for each."""
    figure = Figure(figsize=(12, 2.25 * len(examples)), layout="constrained")
    for line, (title, data, truth, found) in zip(figure.subplots(len(examples), 5, squeeze=False), examples):
        width, height, row = data.camera.width, data.camera.height, found["row"]
        true, predicted = (found[name].reshape(height, width, 2) for name in ("true", "flow"))
        scale, image = np.linalg.norm(true, axis=2).max(), data.rgb_before[row] / 255
        photograph, _ = photographs(data, truth, [row], 320).get(row, (image, None))
        show_image(line[0], photograph, title.capitalize(), extent=(-0.5, width - 0.5, height - 0.5, -0.5))
        show_image(line[1], image, f"What the model gets\n({width} x {height}; framed part)")
        show_image(line[2], blend(image, found["masks"].reshape(height, width, -1)[..., 1:]), "Predicted masks")
        show_flow(line[3], predicted, scale, "Predicted optical flow")
        show_flow(line[4], true, scale, "True optical flow,\nthe same colours")
        arrow = on_table([data.starts[row], data.pokes[row, :2]], data.camera)
        for axes in line[:2]:
            draw_arrow(axes, *arrow)
        (right, low), _ = arrow >= arrow[::-1]  # what moves leaves room behind
        draw_wheel(line[4], scale, low, right)
        zoom(line[1:], line[:1], arrow[1], (width, height))
    return figure


def turn_of(truth, row, label):
    """By how much a poke turned an object, rad."""
    before, after = (Rotation.from_quat(poses[row, label - 1, 3:]) for poses in (truth.poses_before, truth.poses_after))
    return (after * before.inv()).magnitude()


def failures(run, interactions, truth):
    """The worst poke of each kind: a second object hit, a wall met, a soft mask, a turn missed."""
    half, worst = interactions.settings["arena"] / 2, {}
    for found in predictions(run, interactions, truth):
        row, labels = found["row"], found["labels"]
        at_wall = np.abs(truth.poses_after[row, labels - 1, :2]).max(initial=0) > half - 0.045
        free = len(labels) == 1 and not at_wall
        kinds = {"a second object is hit": len(labels) > 1, "a wall stops it": at_wall and len(labels) == 1,
                 "it turns more than 40\u00b0": free and turn_of(truth, row, labels[0]) > np.radians(40),
                 "its mask stays soft": free and found["softness"] > 0.4}
        for kind, holds in kinds.items():
            if holds and (kind not in worst or found["error"] > worst[kind]["error"]):
                worst[kind] = found
    return draw([(kind, interactions, truth, found) for kind, found in sorted(worst.items())])


def emergent(run, interactions, truth, pokes=120):
    """Pokes never seen, of objects seen and of kinds and textures never seen: the median one and the quartiles."""
    examples = []
    with tempfile.TemporaryDirectory() as folder:
        collect(Path(folder), pokes, 102, Settings(**HELD_OUT))
        unseen = load_interactions(folder), load_truth(folder)
    for name, (data, labels) in (("known kinds", (interactions, truth)), ("new kinds", unseen)):
        found = [each for each in predictions(run, data, labels) if each["motion"] > 0.03]  # m^2: well moved
        found.sort(key=lambda each: each["error"] / each["motion"])
        for share, where in ((0.25, "best quarter"), (0.5, "median"), (0.75, "worst quarter")):
            examples.append((f"{name},\n{where}", data, labels, found[int(share * len(found))]))
    return draw(examples)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of understanding.md and the pictures")
    args = parser.parse_args()
    interactions, truth = load_interactions(data_small() / "test"), load_truth(data_small() / "test")
    shipped = checkpoints.load_run(data_small() / "checkpoint.npz")
    save_figure(landscape(interactions, truth), args.out / "landscape.png")
    save_figure(failures(shipped, interactions, truth), args.out / "failures.png")
    save_figure(emergent(shipped, interactions, truth), args.out / "emergent.png")
    train = load_interactions(data_small() / "train")
    early = training.start_run(training.Recipe(steps=100), train)
    training.train(train, early)
    page = args.out / "understanding.md"
    table = norms_table({"after 100 steps": early, "shipped": shipped}, interactions)
    write_text(page, page_with(page.read_text(), {"norms": table}))


if __name__ == "__main__":
    main()
