"""The `hind4sight` command: collect, train, evaluate, show, demo, reproduce. `hind4sight COMMAND --help` says more."""
import argparse
import os
import sys
import sysconfig
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from . import evaluation, reproduce, simulator, training
from .geometry import project
from .interactions import load_interactions, load_truth, write_json, write_text
from .losses import distance_maps, warp_backward
from .networks import Sizes


def data_small():
    """The folder of the shipped data: beside the package in a clone, under share/ after a plain install."""
    clone = Path(__file__).resolve().parent.parent / "data_small"
    return clone if clone.is_dir() else Path(sysconfig.get_path("data")) / "share" / "hind4sight_min" / "data_small"


# --- small helpers ---------------------------------------------------------------------------------------

def progress_line(label):
    """A callable (done, total) that keeps one line with the time left up to date; None away from a terminal."""
    if not sys.stderr.isatty():
        return None
    start = time.perf_counter()

    def show(done, total):
        left = (time.perf_counter() - start) / max(done, 1) * (total - done)
        end = "\n" if done >= total else ""
        print(f"\r{label}: {done} of {total}, {left:.0f} s left \033[K", end=end, file=sys.stderr, flush=True)
    return show


def write_log(path, log):
    """The log of a run, one dict per epoch, as CSV."""
    if log:
        names = list(log[0])
        lines = [",".join(names)] + [",".join(f"{row[name]:g}" for name in names) for row in log]
        write_text(path, "\n".join(lines) + "\n")


REPORT = (  # metric, unit, what it is, its baseline
    ("flow_mse_ratio", "", "scene flow: squared error / no motion", None),
    ("flow_epe_cm", "cm", "scene flow: error of moving points", "no_motion_epe_cm"),
    ("flow_rmse_cm", "cm", "scene flow: root mean square", "no_motion_rmse_cm"),
    ("still_epe_cm", "cm", "scene flow: drift of still points", None),
    ("all_epe_cm", "cm", "scene flow: error of all points", None),
    ("mask_iou", "", "masks: IoU of the moved objects", None),
    ("optical_epe_px", "px", "optical flow: error of moving pixels", "no_motion_optical_epe_px"),
    ("optical_epe_all_px", "px", "optical flow: error of all pixels", "no_motion_optical_epe_all_px"),
    ("inverse_target_cm", "cm", "inverse model: median target error", "inverse_target_chance_cm"),
    ("inverse_direction_deg", "deg", "inverse model: median direction error", "inverse_direction_chance_deg"),
)


def print_metrics(metrics):
    print(f"{metrics['pokes']:.0f} pokes, {metrics['pokes_moved']:.0f} of them moved something")
    for name, unit, meaning, baseline in REPORT:
        beside = ""
        if baseline:
            beside = f"   {'chance' if 'chance' in baseline else 'no motion'} {metrics[baseline]:.3g}"
        print(f"  {meaning:<40}{metrics[name]:8.3f} {unit:<4}{beside}".rstrip())


def show_row(run, interactions, row, truth, path):
    """Save the figure of one interaction: what the robot saw, and what the model makes of it."""
    from . import figures  # here: Matplotlib takes a third of a second to import, in every worker process too
    camera, settings = interactions.camera, interactions.meta["settings"]
    shape = (camera.height, camera.width)
    batch, prediction, flow, start_heatmap, end_heatmap = evaluation.predict(run, interactions, np.array([row]))
    warped, _ = warp_backward(batch.next_images, flow)
    maps = distance_maps(prediction.points, batch.next_points, batch.shared, batch.next_shared)
    points = batch.points[0].reshape(*shape, 3)
    poke, start = interactions.pokes[row], interactions.starts[row]
    ends = np.array([[*start, 0], [*poke[:2], 0]], np.float32)
    true = evaluation.true_scene_flow(points, truth.labels[row], truth.poses_before[row], truth.poses_after[row])
    labels = truth.labels[row]
    moved = np.unique(labels[np.linalg.norm(true, axis=2) > evaluation.MOVING])
    figure = figures.interaction_figure(
        image=batch.images[0], next_image=batch.next_images[0], points=points,
        scene_flow=prediction.points[0].reshape(*shape, 3) - points, masks=prediction.masks[0].reshape(*shape, -1),
        optical_flow=flow[0], warped=warped[0], distance_predicted=maps[0][0].reshape(shape),
        distance_observed=maps[1][0].reshape(shape), start_heatmap=start_heatmap.reshape(interactions.grid_shape),
        end_heatmap=end_heatmap.reshape(interactions.grid_shape), arena=settings["arena"], poke=poke, start=start,
        poke_pixels=project(ends, camera), valid=batch.valid[0].reshape(shape),
        shared=batch.shared[0].reshape(shape), true_scene_flow=true,
        true_optical_flow=evaluation.optical_flow(points, points + true, camera),
        true_labels=np.where(np.isin(labels, moved), labels, 0))
    figures.save_figure(figure, path)


# --- commands ----------------------------------------------------------------------------------------------

def run_collect(args):
    settings = simulator.Settings(objects_min=args.objects[0], objects_max=args.objects[1],
                                  kinds=tuple(args.kinds), textures=tuple(args.textures))
    result = simulator.collect(args.out, args.pokes, args.seed, settings, args.jobs, progress_line("collect"))
    print_collection(args.out, result)
    write_json(args.json, {"collect_seconds": result["seconds"], "collect_share_in_bullet": result["share_in_bullet"],
                           **{f"pokes_{name}": count for name, count in result["counts"].items()}})


def print_collection(folder, result):
    counts = result["counts"]
    dropped = ", ".join(f"{count} {name}" for name, count in counts.items() if name != "kept" and count) or "none"
    share = result["share_in_bullet"]
    spent = "all there already" if share is None else f"{share:.0%} of the time in Bullet's stepping and rendering"
    print(f"{folder}: {counts['kept']} pokes in {result['seconds']:.1f} s; dropped: {dropped}; {spent}")


def run_train(args):
    interactions = load_interactions(args.data)
    if args.resume:
        run = training.load_run(args.out)
    else:
        if Path(args.out).exists():
            raise ValueError(f"{args.out}: exists already; --resume goes on with it")
        recipe = training.Recipe(steps=args.steps, batch=args.batch, learning_rate=args.learning_rate, seed=args.seed,
                                 depth_noise=args.depth_noise, sizes=Sizes(masks=args.masks, width=args.width),
                                 ramp=args.ramp, weights={**training.WEIGHTS, **dict(args.weight)})
        run = training.start_run(recipe, interactions)
        if args.start:
            start = training.load_run(args.start)
            if start.layout != run.layout:
                raise ValueError(f"{args.start}: has networks of other sizes than this run")
            run.vector = start.vector
    seconds = train_and_save(run, interactions, args.out, args.jobs)
    print(f"{args.out}: {run.step} steps, {seconds:.0f} s in all")
    write_json(args.json, {"train_seconds": seconds, **{f"loss_{k}": v for k, v in run.log[-1].items()}})


def train_and_save(run, interactions, path, jobs):
    """Train to the recipe's end: a checkpoint every minute, a log line and a CSV row every epoch, then a picture
    of the loss terms. Returns the seconds spent on the whole run, over all calls.
    """
    from . import figures
    path, show = Path(path), progress_line("train")

    def on_step(run):
        if show:
            show(run.step, run.recipe.steps)

    def on_epoch(run):
        entry = run.log[-1]
        print(f"epoch {entry['epoch']:.0f}, step {entry['step']:.0f}: "
              + ", ".join(f"{name} {entry[name]:.4g}" for name in run.recipe.weights), flush=True)
        write_log(path.with_suffix(".csv"), run.log)

    seconds = training.train_saving(interactions, run, path, jobs=jobs, on_epoch=on_epoch, on_step=on_step)
    figures.save_figure(figures.training_figure(run.log), path.with_suffix(".png"))
    return seconds


def run_evaluate(args):
    run = training.load_run(args.checkpoint)
    interactions = load_interactions(args.data)
    check_camera(run, interactions, args.data)
    metrics = evaluation.evaluate(run, interactions, load_truth(args.data), progress_line("evaluate"))
    print_metrics(metrics)
    write_json(args.json, metrics)


def check_camera(run, interactions, data):
    if run.meta["camera"] != interactions.meta["camera"]:
        raise ValueError(f"{data}: taken with another camera than the checkpoint was trained with")


def run_show(args):
    run = training.load_run(args.checkpoint)
    interactions, truth = load_interactions(args.data), load_truth(args.data)
    check_camera(run, interactions, args.data)
    if not 0 <= args.row < len(interactions):
        raise ValueError(f"row: expected 0 to {len(interactions) - 1}, got {args.row}")
    show_row(run, interactions, args.row, truth, args.out)
    print(args.out)


def run_reproduce(args):
    scale = reproduce.QUICK if args.quick else reproduce.FULL
    tables = list(reproduce.TABLES) if args.table == "all" else [args.table]
    out = Path(args.out or ("runs/reproduce-quick" if args.quick else "runs/reproduce"))
    figures = reproduce.reproduce(tables, out, scale, args.jobs, progress=progress_line("collect"))
    print(reproduce.tables_text(tables, figures))
    write_json(args.json or out / f"{args.table}.json", figures)


DEMO_POKES, DEMO_TEST_POKES = 2000, 200
DEMO_RECIPE = training.Recipe(steps=1000)


def run_demo(args):
    """Collect, train, evaluate, show: the whole paper on pokes that Bullet has just simulated."""
    start, out = time.perf_counter(), Path(args.out)
    print("1. Simulate pokes: before, after, and the poke alone.")
    for name, pokes, seed in (("train", DEMO_POKES, args.seed), ("test", DEMO_TEST_POKES, args.seed + 1)):
        result = simulator.collect(out / name, pokes, seed, jobs=args.jobs, progress=progress_line("collect"))
        print_collection(out / name, result)
    print("2. Train on them without labels: Chamfer, photometric, smoothness and inverse losses (Eq. 6).")
    interactions = load_interactions(out / "train")
    run = training.start_run(replace(DEMO_RECIPE, seed=args.seed), interactions)
    train_and_save(run, interactions, out / "checkpoint.npz", args.jobs)
    print("3. Evaluate on pokes that were never trained on.")
    test, truth = load_interactions(out / "test"), load_truth(out / "test")
    metrics = evaluation.evaluate(run, test, truth, progress_line("evaluate"))
    print_metrics(metrics)
    print("4. Look at one of them.")
    motion = [np.abs(truth.poses_after[i] - truth.poses_before[i]).max() for i in range(len(test))]
    row = int(np.argsort(motion)[int(0.7 * len(motion))])  # a poke that moved something well, not the best one
    show_row(run, test, row, truth, out / "interaction.png")
    seconds = time.perf_counter() - start
    print(f"{out / 'interaction.png'}\nThe whole demo took {seconds:.0f} s.")
    figures_found = {f"demo_{name}": value for name, value in metrics.items()}
    write_json(args.json or out / "metrics.json", {**figures_found, "demo_seconds": seconds})


def term_weight(text):
    """'photometric=0.5' -> ('photometric', 0.5)."""
    name, _, value = text.partition("=")
    if name not in training.WEIGHTS:
        raise argparse.ArgumentTypeError(f"expected TERM=VALUE with one of {', '.join(training.WEIGHTS)}, got {text!r}")
    return name, float(value)


class OneLineParser(argparse.ArgumentParser):
    """argparse without the usage text before an error."""

    def error(self, message):
        self.exit(2, f"{self.prog}: {message}\n")


def build_parser():
    parser = OneLineParser(prog="hind4sight", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    small = data_small()

    def command(name, function, text):
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(function=function)
        return sub

    defaults = simulator.Settings()
    sub = command("collect", run_collect, "simulate pokes and write them to a folder of shards (needs pybullet)")
    sub.add_argument("out", help="folder; one that holds a part of the same pokes is completed")
    sub.add_argument("--pokes", type=int, default=1000)
    sub.add_argument("--seed", type=int, default=0)
    sub.add_argument("--jobs", type=int, default=1, help="processes (the data do not depend on it)")
    sub.add_argument("--objects", type=int, nargs=2, metavar=("MIN", "MAX"),
                     default=(defaults.objects_min, defaults.objects_max), help="objects in a scene, 1 to 7")
    sub.add_argument("--kinds", nargs="+", default=defaults.kinds, help=f"of {', '.join(simulator.KINDS)}")
    sub.add_argument("--textures", nargs="+", default=defaults.textures, help=f"of {', '.join(simulator.TEXTURES)}")
    sub.add_argument("--json", help="write the figures here too")

    recipe = training.Recipe()
    sub = command("train", run_train, "train the full model (Eq. 6) on a folder of shards, without labels")
    sub.add_argument("data", nargs="?", default=small / "train")
    sub.add_argument("out", help="checkpoint to write (.npz); its log goes beside it (.csv and .png)")
    sub.add_argument("--steps", type=int, default=recipe.steps)
    sub.add_argument("--batch", type=int, default=recipe.batch)
    sub.add_argument("--learning-rate", type=float, default=recipe.learning_rate)
    sub.add_argument("--weight", type=term_weight, action="append", default=[], metavar="TERM=VALUE",
                     help=f"a weight of Eq. 6, 0 leaves the term out; terms: {', '.join(recipe.weights)}")
    sub.add_argument("--ramp", type=float, nargs=2, default=recipe.ramp, metavar=("FROM", "TO"),
                     help="shares of the steps between which the 2D terms' weights grow from 0")
    sub.add_argument("--start", metavar="CHECKPOINT", help="begin with its parameters instead of random ones")
    sub.add_argument("--depth-noise", type=float, default=0.0, help="SD in m of the depth noise to train under")
    sub.add_argument("--masks", type=int, default=Sizes.masks, help="K, background included")
    sub.add_argument("--width", type=int, default=Sizes.width, help="units per layer of the forward model")
    sub.add_argument("--seed", type=int, default=0)
    sub.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes (the result does not depend on it)")
    sub.add_argument("--resume", action="store_true", help="go on with the checkpoint OUT")
    sub.add_argument("--json", help="write the figures here too")

    for name, function, text in (("evaluate", run_evaluate, "metrics of a checkpoint on a folder of shards"),
                                 ("show", run_show, "one interaction as a picture")):
        sub = command(name, function, text + "; without arguments, the shipped ones")
        sub.add_argument("checkpoint", nargs="?", default=small / "checkpoint.npz")
        sub.add_argument("data", nargs="?", default=small / "test")
        if name == "show":
            sub.add_argument("--row", type=int, default=0, help="which interaction")
            sub.add_argument("--out", default="interaction.png")
        else:
            sub.add_argument("--json", help="write the figures here too")

    sub = command("reproduce", run_reproduce, "the paper's tables at our scale, over several seeds: hours, in which it "
                  "can be stopped and started again (needs pybullet)")
    sub.add_argument("table", choices=[*reproduce.TABLES, "all"])
    sub.add_argument("--quick", action="store_true", help="the same tables from little data, in under ten minutes")
    sub.add_argument("--out", help="folder of data and runs (runs/reproduce, runs/reproduce-quick)")
    sub.add_argument("--jobs", type=int, default=os.cpu_count())
    sub.add_argument("--json", help="write the figures here (otherwise to OUT/TABLE.json)")

    sub = command("demo", run_demo, "collect, train, evaluate and show, in under five minutes (needs pybullet)")
    sub.add_argument("--out", default="runs/demo")
    sub.add_argument("--seed", type=int, default=0)
    sub.add_argument("--jobs", type=int, default=os.cpu_count())
    sub.add_argument("--json", help="write the figures here (otherwise to OUT/metrics.json)")
    return parser


def main(arguments=None):
    """Run one command; wrong input ends in one line and exit status 2."""
    args = build_parser().parse_args(arguments)
    try:
        args.function(args)
    except (ValueError, RuntimeError, OSError, FloatingPointError) as error:
        print(f"hind4sight {args.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\nhind4sight {args.command}: stopped; what is on disk is whole", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
