"""The `hind4sight` command: collect, train, evaluate, show, plan, demo, reproduce; `hind4sight COMMAND --help`."""
import argparse
import os
import sys
import sysconfig
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from . import control, evaluation, planning, reproduce, simulator, training
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
        elif f"{name}_se" in metrics:
            beside = f"   standard error {metrics[name + '_se']:.2g}"
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


RECIPE_OPTIONS = ("steps", "batch", "learning_rate", "weight", "start", "depth_noise", "masks", "width", "seed")


def run_train(args):
    if Path(args.out).suffix != ".npz":  # a folder of pokes without a checkpoint after it, or a name its log would take
        raise ValueError(f"out: expected a name ending in .npz for the checkpoint, got {str(args.out)!r}")
    interactions = load_interactions(args.data)
    given = {name: getattr(args, name) for name in RECIPE_OPTIONS if getattr(args, name) is not None}
    if args.resume:
        run = training.load_run(args.out)
        if given:
            option = min(given).replace("_", "-")
            raise ValueError(f"--resume: goes on with the recipe of {args.out}, which "
                             f"--{option} cannot change")
    else:
        if Path(args.out).exists():
            raise ValueError(f"{args.out}: exists already; --resume goes on with it")
        start, weights = given.pop("start", None), {**training.WEIGHTS, **dict(given.pop("weight", ()))}
        sizes = Sizes(**{name: given.pop(name) for name in ("masks", "width") if name in given})
        recipe = training.Recipe(**given, sizes=sizes, weights=weights, mirror=interactions.camera.is_mirror_symmetric)
        run = training.start_run(recipe, interactions)
        if start:
            first = training.load_run(start)
            if first.layout != run.layout:
                raise ValueError(f"{start}: has networks of other sizes than this run")
            run.vector = first.vector
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
              + ", ".join(f"{name} {entry[name]:.4g}" for name in run.recipe.weights if name in entry), flush=True)
        write_log(path.with_suffix(".csv"), run.log)

    seconds = training.train_saving(interactions, run, path, jobs=jobs, on_epoch=on_epoch, on_step=on_step)
    figures.save_figure(figures.training_figure(run.log), path.with_suffix(".png"))
    return seconds


def run_evaluate(args):
    run = training.load_run(args.checkpoint)
    interactions = load_interactions(args.data)
    training.check_camera(run, interactions.camera)
    metrics = evaluation.evaluate(run, interactions, load_truth(args.data), progress_line("evaluate"))
    print_metrics(metrics)
    write_json(args.json, metrics)


def run_show(args):
    run = training.load_run(args.checkpoint)
    interactions, truth = load_interactions(args.data), load_truth(args.data)
    training.check_camera(run, interactions.camera)
    if not 0 <= args.row < len(interactions):
        raise ValueError(f"row: expected 0 to {len(interactions) - 1}, got {args.row}")
    show_row(run, interactions, args.row, truth, args.out)
    print(args.out)


def run_reproduce_planning(args):
    from . import figures
    out = Path(args.out or "runs/planning")
    found, curves = reproduce.reproduce_planning(out, args.checkpoint, scenes=4 if args.quick else 20, jobs=args.jobs)
    print(reproduce.planning_table(found))
    print(f"Obstacles avoided: planned {found['learned_obstacle_avoided']:.0%}, straight at the goal "
          f"{found['greedy_obstacle_avoided']:.0%}")
    figures.save_figure(figures.control_figure(curves, reproduce.POKES), out / "planning.png")
    write_json(args.json or out / "figures.json", found)


def run_reproduce(args):
    if args.table == "planning":
        return run_reproduce_planning(args)
    scale = reproduce.QUICK if args.quick else reproduce.FULL
    tables = list(reproduce.TABLES) if args.table == "all" else [args.table]
    out = Path(args.out or ("runs/reproduce-quick" if args.quick else "runs/reproduce"))
    figures = reproduce.reproduce(tables, out, scale, args.jobs, progress=progress_line("collect"))
    print(reproduce.tables_text(tables, figures))
    write_json(args.json or out / f"{args.table}.json", figures)


def run_plan(args):
    run = training.load_run(args.checkpoint)
    weights = {} if args.chamfer_weight is None else {"chamfer_weight": args.chamfer_weight}
    if (args.mark is None) != (args.goal is None):
        raise ValueError("--mark, --goal: expected both or neither; --goal says where a marked point shall go")
    own = args.click or args.mark is not None
    if own:
        weights = {"chamfer_weight": 0.0}  # there is no goal picture to compare with
    search = planning.Search(candidates=args.candidates, horizon=args.horizon, iterations=args.iterations,
                             pixel_weight=args.pixel_weight, **weights)
    with control.random_task(args.seed, args.objects, args.obstacle) as task:
        training.check_camera(run, task.arena.camera)
        if own:
            marks, goals = click(task.arena.observe()[0]) if args.click else (args.mark, args.goal)
            task = control.marked_task(task, marks, goals)
        plan_and_show(run, task, args.policy, search, args.budget, Path(args.out),
                      {"seed": args.seed, "movers": args.objects, "obstacle": args.obstacle})


def plan_and_show(run, task, policy, search, budget, out, meta):
    """The closed loop on a task: a line per poke, and into the folder `out` a record, the first plan's population and
    an animation.
    """
    from . import figures
    camera, rounds, settings = task.arena.camera, [], asdict(task.arena.settings)
    image = task.arena.observe()[0] / 255

    def on_iteration(iteration, population, costs, mean, deviation):
        if len(rounds) == iteration:  # of the first plan
            rounds.append((*planning.arrows_of(population[:, 0], settings, camera), costs))

    record = control.closed_loop(task, run, policy, search, budget, meta["seed"], on_iteration)
    distance, pokes = record["distance"].mean(axis=1), len(record["pokes"])
    for t, poke in enumerate(record["pokes"]):
        done = "" if np.isfinite(record["starts"][t]).all() else "  (no room for the finger: not carried out)"
        print(f"  poke {t + 1} to ({poke[0]:6.3f}, {poke[1]:6.3f}) m, direction {np.degrees(poke[2]):4.0f} deg: "
              f"{100 * distance[t]:5.1f} -> {100 * distance[t + 1]:5.1f} cm from the goals{done}")
    ends = [planning.places_on_table(each, camera) for each in (record["starts"], record["pokes"][:, :2])]
    marks = project(record["marks"], camera)
    control.save_record(out / "plan.npz", record, {**meta, "policy": policy, "search": asdict(search)})
    goal_rgb = record.get("goal_rgb")
    figures.save_sequence(out / "plan.gif", record["rgb"] / 255, None if goal_rgb is None else goal_rgb / 255,
                          np.stack(ends, axis=1), marks, record["goal_marks"], distance)
    if rounds:
        figures.save_figure(figures.population_figure(image, rounds, marks[0], record["goal_marks"]), out / "cem.png")
    print(f"{out / 'plan.gif'}: {pokes} pokes, {100 * distance[0]:.1f} -> {100 * distance[-1]:.1f} cm from the goals")
    return record


def click(image):
    """Let the user click in a window: a point on an object, then where it shall go, and so on; Enter ends.

    -> marks, goals (M, 2) px. Raises ValueError for an odd number of clicks or none, RuntimeError without a display.
    """
    import matplotlib.pyplot as plt
    if plt.get_backend().lower() == "agg":
        raise RuntimeError("--click: there is no display to open a window on; give --mark and --goal in pixels instead")
    plt.imshow(image)
    plt.title("click a point on an object, then its goal; and so on; Enter ends")
    points = np.array(plt.ginput(n=-1, timeout=0))
    plt.close()
    if len(points) == 0 or len(points) % 2:
        raise ValueError(f"--click: expected pairs of clicks, a mark and its goal, got {len(points)}")
    return points[::2], points[1::2]


DEMO_POKES, DEMO_TEST_POKES = 2000, 200
DEMO_RECIPE = training.Recipe(steps=1000, learning_rate=2e-3)


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
    motion = np.linalg.norm((truth.poses_after - truth.poses_before)[..., :3], axis=2).max(axis=1)
    row = int(np.argsort(motion)[int(0.7 * len(motion))])  # a poke that moved something well, not the best one
    show_row(run, test, row, truth, out / "interaction.png")
    print(f"{out / 'interaction.png'}\n5. Plan pokes to a goal with the model (CEM), carry them out, look again.")
    seed = args.seed + 2  # a scene of neither pokes
    with control.random_task(seed, 1) as task:
        record = plan_and_show(run, task, "learned", planning.Search(), 6, out,
                               {"seed": seed, "movers": 1, "obstacle": False})
    metrics["plan_distance_left"] = float(record["distance"][-1].mean() / record["distance"][0].mean())
    seconds = time.perf_counter() - start
    print(f"The whole demo took {seconds:.0f} s.")
    figures_found = {f"demo_{name}": value for name, value in metrics.items()}
    write_json(args.json or out / "metrics.json", {**figures_found, "demo_seconds": seconds})


def term_weight(text):
    """'photometric=0.5' -> ('photometric', 0.5)."""
    name, _, value = text.partition("=")
    if name not in training.WEIGHTS:
        raise argparse.ArgumentTypeError(f"expected TERM=VALUE with one of {', '.join(training.WEIGHTS)}, got {text!r}")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected TERM=VALUE with a number, got {text!r}") from None


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
    sub.add_argument("--steps", type=int, help=f"of the optimiser ({recipe.steps})")
    sub.add_argument("--batch", type=int, help=f"interactions per step ({recipe.batch})")
    sub.add_argument("--learning-rate", type=float, help=f"at its peak ({recipe.learning_rate})")
    sub.add_argument("--weight", type=term_weight, action="append", metavar="TERM=VALUE",
                     help=f"a weight of Eq. 6, 0 leaves the term out; terms: {', '.join(recipe.weights)}")
    sub.add_argument("--start", metavar="CHECKPOINT", help="begin with its parameters instead of random ones")
    sub.add_argument("--depth-noise", type=float, help=f"SD in m of the noise to train under ({recipe.depth_noise:g})")
    sub.add_argument("--masks", type=int, help=f"K, background included ({Sizes.masks})")
    sub.add_argument("--width", type=int, help=f"units per layer of the forward model ({Sizes.width})")
    sub.add_argument("--seed", type=int, help=f"({recipe.seed})")
    sub.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes (the result does not depend on it)")
    sub.add_argument("--resume", action="store_true", help="go on with the checkpoint OUT and its recipe")
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

    search = planning.Search()
    sub = command("plan", run_plan, "plan pokes to a goal and carry them out, in a test scene (needs pybullet)")
    sub.add_argument("checkpoint", nargs="?", default=small / "checkpoint.npz")
    sub.add_argument("--seed", type=int, default=0, help=f"which scene ({reproduce.TRAIN_SEED} has objects that the "
                     "shipped model was trained on)")
    sub.add_argument("--objects", type=int, default=1, choices=(1, 2, 3), help="how many are to be moved")
    sub.add_argument("--obstacle", action="store_true", help="a scene with another object in the way")
    sub.add_argument("--mark", type=float, nargs=2, action="append", metavar=("X", "Y"),
                     help="a pixel on an object, again for each; with as many --goal, in place of the scene's")
    sub.add_argument("--goal", type=float, nargs=2, action="append", metavar=("X", "Y"), help="where that shall go")
    sub.add_argument("--click", action="store_true", help="choose marks and goals in a window")
    sub.add_argument("--policy", choices=control.POLICIES, default="learned")
    sub.add_argument("--budget", type=int, default=10, help="pokes at most")
    sub.add_argument("--candidates", type=int, default=search.candidates, help="CEM's population J")
    sub.add_argument("--iterations", type=int, default=search.iterations)
    sub.add_argument("--horizon", type=int, default=search.horizon, help="pokes planned ahead, H")
    sub.add_argument("--pixel-weight", type=float, default=search.pixel_weight)
    sub.add_argument("--chamfer-weight", type=float, help=f"{search.chamfer_weight}; 0 with goals of your own")
    sub.add_argument("--out", default="runs/plan", help="folder for plan.gif, cem.png and the record plan.npz")

    sub = command("reproduce", run_reproduce, "the paper's tables at our scale, over several seeds: hours, in which it "
                  "can be stopped and started again (needs pybullet)")
    sub.add_argument("table", choices=[*reproduce.TABLES, "all", "planning"],
                     help="all: the tables of Sec. IV-D to IV-F; planning: the control experiment of Sec. IV-G")
    sub.add_argument("--checkpoint", default=small / "checkpoint.npz", help="the model to plan with")
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
