"""The `hind4sight` command: collect, import, train, evaluate, show, explore, plan, demo and more; `COMMAND --help`."""
import argparse
import os
import sys
import time
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from .. import __version__, planning, training
from ..disk import checkpoints
from ..disk.files import check_output, data_small, only_one, read_json, write_json
from ..disk.recordings import save_recording
from ..disk.shards import load_interactions, parts_of, stream_interactions
from ..networks import Sizes
from ..sim.arena import MIDDLE, Settings
from ..sim.bodies import read_urdfs
from ..sim.collection import collect
from ..sim.objects import KINDS, TEXTURES
from ..sim.photographs import photographs
from ..sim.truth import find_truth
from . import cameras, contact, control, evaluation, tables
from .camera_faults import ONE_SIDED, under_faults
from .noise import MOST_NOISE, under_noise
from .processes import parallel_map
from .runs import total, train_saving

# `figures` is imported where a picture is made: Matplotlib takes a third of a second, in every worker process too.


# --- what is printed -------------------------------------------------------------------------------------

def progress_line(label):
    """A callable (done, total) that says how far it is and the time left: on a terminal in one line that is kept up to
    date, elsewhere in a line every 10 s.
    """
    terminal, start = sys.stderr.isatty(), time.perf_counter()
    told = start

    def show(done, total):
        nonlocal told
        now = time.perf_counter()
        left = f", {(now - start) / done * (total - done):.0f} s left" if done else ""
        if terminal:
            end = "\n" if done >= total else ""
            print(f"\r{label}: {done} of {total}{left} \033[K", end=end, file=sys.stderr, flush=True)
        elif now - told >= 10:
            print(f"{label}: {done} of {total}{left}", file=sys.stderr, flush=True)
            told = now
    return show


REPORT = (  # metric, unit, what it is, its baseline
    ("flow_epe_cm", "cm", "scene flow: error of moving points", "no_motion_epe_cm"),
    ("still_epe_cm", "cm", "scene flow: drift of still points", None),
    ("mask_iou", "", "masks: IoU of the moved objects", None),
    ("optical_epe_px", "px", "optical flow: error of moving pixels", "no_motion_optical_epe_px"),
    ("optical_epe_all_px", "px", "optical flow: error of all pixels", "no_motion_optical_epe_all_px"),
    ("inverse_target_cm", "cm", "inverse model: median target error", "inverse_target_chance_cm"),
    ("inverse_direction_deg", "deg", "inverse model: median direction error", "inverse_direction_chance_deg"),
)
GROUPS = (("", "all of them"), ("single_", "pokes that move one object"), ("multi_", "pokes that move two or more"),
          ("wall_", "pokes that end at a wall"), ("trimmed_", "without the worst 1 %"))


def print_label_free(metrics):
    print(f"{metrics['pokes']:.0f} pokes whose truth is not known: how well the predictions explain the next picture, "
          "per poke:")
    for name, unit, meaning in (("chamfer_cm2", "cm^2", "3D: Chamfer distance (Eq. 2)"),
                                ("photometric", "", "2D: photometric error (Eq. 3)")):
        print(f"  {meaning:<40}{metrics[name]:8.3f} {unit:<4}   no motion {metrics[f'no_motion_{name}']:.3f}")


def print_metrics(metrics):
    print(f"{metrics['pokes']:.0f} pokes, {metrics['pokes_moved']:.0f} of them moved something; squared error of scene "
          "flow / no motion:")
    for group, meaning in GROUPS:
        count = metrics[f"{group}pokes" if group else "pokes_moved"]
        if count:
            ratio, error = metrics[f"{group}flow_mse_ratio"], metrics[f"{group}flow_mse_ratio_se"]
            print(f"  {meaning:<40}{ratio:8.3f} \u00b1 {error:.3f}   {count:.0f} pokes")
    for name, unit, meaning, baseline in REPORT:
        beside = "   chance" if baseline and "chance" in baseline else "   no motion"
        beside = f"{beside} {metrics[baseline]:.3g}" if baseline else ""
        print(f"  {meaning:<40}{metrics[name]:8.3f} {unit:<4}{beside}".rstrip())


# --- commands ----------------------------------------------------------------------------------------------

def drawn_from(args):
    """The fields of Settings that say what lies in the arena: of --urdf and --scale, and of --kinds where there are."""
    if args.scale != 1 and not args.urdf:
        raise ValueError("--scale: expected --urdf with it, whose objects it scales")
    kinds = getattr(args, "kinds", None) or (() if args.urdf else Settings.kinds)
    return {"kinds": tuple(kinds), "own": read_urdfs(args.urdf, args.scale) if args.urdf else ()}


def run_collect(args):
    settings = Settings(objects_min=args.objects[0], objects_max=args.objects[1], textures=tuple(args.textures),
                        place_within=args.within, width=args.size[0], height=args.size[1], **drawn_from(args))
    began, show = time.perf_counter(), progress_line("collect")
    with parallel_map(args.jobs, args.cluster) as map:
        show(0, args.pokes)
        counts = collect(args.out, args.pokes, args.seed, settings, map, show, args.part)
    seconds = time.perf_counter() - began
    dropped = ", ".join(f"{count} {name}" for name, count in counts.items() if name != "kept" and count) or "none"
    print(f"{args.out}: {counts['kept']} pokes in {seconds:.1f} s; dropped: {dropped}")
    write_json(args.json, {"collect_seconds": seconds, **{f"pokes_{name}": count for name, count in counts.items()}})


def run_import(args):
    with only_one(args.out):
        found = cameras.import_recording(args.folder, args.out, tuple(args.size), progress_line("import"))
    camera = found.pop("camera")
    pose, table = camera.arena_from_camera, found["table"]
    down = np.degrees(np.arcsin(-pose[2, 2]))
    known = "told" if np.isnan(table) else f"its empty picture shows, {table:.0%} of it table"
    print(f"{args.out}: {found['pokes']} pokes, {camera.width} x {camera.height} px\n"
          f"  the camera, as {known}: {pose[2, 3]:.3f} m above the table, looking down at {down:.1f} degrees; a pixel "
          f"is {1e3 * camera.pixel_size:.1f} mm wide there\n"
          f"  {found['missing']:.0%} of the pixels have no depth; {found['met']:.0%} of the pokes end where something "
          "stands")
    write_json(args.json, {f"import_{name}": value for name, value in found.items() if np.isfinite(value)})


def run_export(args):
    with only_one(args.folder):
        count = save_recording(args.folder, parts_of(args.data))
    print(f"{args.folder}: {count} pokes; 'hind4sight import' takes them back")


def new_run(interactions, weight=(), masks=None, width=None, depth_noise=0.0, camera_faults=False, start_from=None,
            **given):
    """A fresh Run as the options of `train` say; with start_from, a path, from the parameters of that checkpoint."""
    if depth_noise and camera_faults:
        raise ValueError("--depth-noise: --camera-faults has a noise of its own")
    if not 0 <= depth_noise <= MOST_NOISE:
        raise ValueError(f"--depth-noise: expected 0 to {MOST_NOISE} m, got {depth_noise}")
    start = start_from and checkpoints.load_run(start_from)
    sizes = start.recipe.sizes if start else Sizes()
    given_sizes = {name: value for name, value in (("masks", masks), ("width", width)) if value is not None}
    asked = replace(sizes, **given_sizes)
    if start and asked != sizes:
        raise ValueError(f"--start-from: {start_from} has {sizes.masks} masks and a width of {sizes.width}, expected "
                         f"{asked.masks} and {asked.width}")
    run = training.start_run(training.Recipe(**given, sizes=asked, weights={**training.WEIGHTS, **dict(weight)}),
                             interactions)
    run.meta.update(depth_noise=depth_noise, camera_faults=camera_faults)
    if start:
        run.vector = start.vector
        run.meta["started_from"] = start.meta.get("data")  # the data set its parameters were trained on
    return run


def objective_of(run):
    """What a run minimises, as the options of `train` said."""
    if run.meta.get("camera_faults"):
        return under_faults
    noise = run.meta.get("depth_noise")
    return partial(under_noise, standard_deviation=noise) if noise else training.unsupervised


def run_train(args):
    from . import figures
    out = Path(args.out)
    check_output("out", out, ".npz")  # a folder of pokes without a checkpoint after it has another ending
    interactions = stream_interactions(args.data)
    given = {name: value for name, value in vars(args).items() if value is not None and name not in (
        "command", "function", "data", "out", "jobs", "json", "resume")}
    if args.resume and given:
        raise ValueError(f"--resume: goes on with the recipe of {out}, which --{min(given).replace('_', '-')} cannot "
                         "change")
    for path in () if args.resume else (out, out.with_suffix(".csv"), out.with_suffix(".png")):
        if path.exists():
            raise ValueError(f"{path}: exists already; " + (
                "--resume goes on with it" if path == out else f"the log of {out.name} would take its place"))
    run, show = checkpoints.load_run(out) if args.resume else new_run(interactions, **given), progress_line("train")

    def on_step(run, terms):
        show(run.step, run.recipe.steps)

    def summed(entry):
        return {"total": total(entry, run.recipe, run.step - 1), **entry}

    def on_epoch(entry):
        still = summed(run.meta["no_motion"])
        terms = ", ".join(f"{name} {value:.4g}" + (f" ({still[name]:.4g})" if name in still else "")
                          for name, value in summed(entry).items() if name == "total" or name in training.WEIGHTS)
        note = "; in brackets: without motion" if entry["epoch"] == 1 else ""
        print(f"epoch {entry['epoch']}, step {entry['step']}: {terms}{note}", flush=True)

    log = train_saving(interactions, run, out, objective_of(run), args.jobs, on_step, on_epoch)
    log = [{**entry, "total": total(entry, run.recipe, entry["step"] - 1)} for entry in log]
    still = summed(run.meta["no_motion"])
    figures.save_figure(figures.training_figure(log, still), out.with_suffix(".png"))
    print(f"{out}: {run.step} steps, {run.meta['seconds']:.0f} s in all")
    write_json(args.json, {"train_seconds": run.meta["seconds"], **{f"loss_{k}": v for k, v in log[-1].items()}})


def folder_alone(args):
    """`evaluate FOLDER` means the shipped checkpoint on that data; `show` and `explore` too."""
    if Path(args.checkpoint).is_dir() and args.data in (None, TEST["default"]):
        args.checkpoint, args.data = SHIPPED["default"], args.checkpoint


def run_evaluate(args):
    folder_alone(args)
    run, interactions = checkpoints.load_run(args.checkpoint), load_interactions(args.data)
    truth = find_truth(args.data)
    faults = {name: value for name, value in vars(args).items() if value and f"--{name.replace('_', '-')}" in FAULTS}
    metrics = evaluation.evaluate(run, interactions, truth, progress_line("evaluate"), **faults)
    print_label_free(metrics) if truth is None else print_metrics(metrics)
    write_json(args.json, metrics)


def well_moved(interactions, truth):
    """The row of a poke that moved something well, not the best one; by depth where the truth is None."""
    if truth is None:
        motion = [np.abs(after - before)[(before > 0) & (after > 0)].sum()
                  for before, after in zip(interactions.depth_before, interactions.depth_after)]
    else:
        motion = np.linalg.norm((truth.poses_after - truth.poses_before)[..., :3], axis=2).max(axis=1)
    return int(np.argsort(motion)[int(0.7 * len(motion))])


def run_show(args):
    from . import figures
    folder_alone(args)
    check_output("--out", args.out, ".png")
    run = checkpoints.load_run(args.checkpoint)
    interactions, truth = load_interactions(args.data), find_truth(args.data)
    row = well_moved(interactions, truth) if args.row is None else args.row
    if not 0 <= row < len(interactions):
        raise ValueError(f"row: expected 0 to {len(interactions) - 1}, got {row}")
    answer = evaluation.ask(run, interactions, row)
    seen = photographs(interactions, truth, [row]).get(row)
    figures.save_figure(figures.interaction_figure(interactions, row, answer, truth, seen), args.out)
    print(f"{args.out}: interaction {row}")


def run_explore(args):
    from .explore import run_explore
    folder_alone(args)
    run_explore(args)


def run_reproduce(args):
    from . import figures
    out = Path(args.out or (f"runs/{args.table}" if args.table in ("planning", "contact")
                            else "runs/reproduce-quick" if args.quick else "runs/reproduce")).absolute()
    checkpoint = Path(args.checkpoint).absolute()  # other machines have another working folder
    with parallel_map(args.jobs, args.cluster) as map:
        if args.table == "contact":
            found = contact.reproduce(checkpoints.load_run(checkpoint), 100 if args.quick else 1000, map,
                                      progress_line("poke"))
            print(contact.contact_table(found))
        elif args.table == "planning":
            found, curves = tables.reproduce_planning(out, checkpoint, 4 if args.quick else 20, map,
                                                      args.planners)
            print(tables.planning_table(found))
            figures.save_figure(figures.control_figure(curves, tables.POKES), out / "planning.png")
        else:
            names = list(tables.TABLES) if args.table == "all" else [args.table]
            scale = tables.QUICK if args.quick else tables.FULL
            found = tables.reproduce(names, out, scale, map, progress_line("collect"))
            print(tables.tables_text(names, found))
    write_json(args.json or out / f"{args.table}.json", found)


SEARCH_OPTIONS = "candidates", "iterations", "horizon", "pixel_weight", "chamfer_weight"


def run_plan(args):
    from . import figures
    run, options = checkpoints.load_run(args.checkpoint), {name: getattr(args, name) for name in SEARCH_OPTIONS}
    if (args.mark is None) != (args.goal is None):
        raise ValueError("--mark, --goal: expected both or neither; --goal says where a marked point shall go")
    if args.mark:
        options["chamfer_weight"] = 0.0  # there is no goal picture to compare with
    search, path = planning.Search(**options), Path(args.out) / "plan.gif"
    drawn, settings = drawn_from(args), control.settings_for(run)
    settings = replace(settings, **drawn) if args.urdf else settings
    check_output("--out", path, ".gif")
    with control.random_task(args.seed, args.objects, args.obstacle, settings) as task:
        if args.mark:
            task = control.marked_task(task, args.mark, args.goal)
        ahead = search.horizon if args.policy == "oracle" else control.AHEAD  # the simulator would take a minute
        record = control.closed_loop(task, run, args.policy, search, args.budget, args.seed, ahead)
        record = control.photographed(record, task)
    distance = record["distance"].mean(axis=1)  # m
    for t, (poke, start) in enumerate(zip(record["pokes"], record["starts"])):
        done = "" if np.isfinite(start).all() else "  (no room for the finger: not carried out)"
        print(f"  poke {t + 1} to ({poke[0]:6.3f}, {poke[1]:6.3f}) m, direction {np.degrees(poke[2]):4.0f} deg: "
              f"{100 * distance[t]:5.1f} -> {100 * distance[t + 1]:5.1f} cm from the goals{done}")
    figures.save_sequence(path, record, task.arena.camera)
    print(f"  stopped: {record['stopped']}")
    print(f"{path}: {len(distance) - 1} pokes, {100 * distance[0]:.1f} -> {100 * distance[-1]:.1f} cm from the goals")
    write_json(args.json, {"plan_pokes": len(distance) - 1, "plan_stopped": record["stopped"],
                           "plan_distance_left": float(distance[-1] / (distance[0] or 1))})  # of a goal that is met, 0


# --- the demo ----------------------------------------------------------------------------------------------

DEMO_POKES, DEMO_TEST_POKES, DEMO_STEPS = 2000, 200, 1000
NO_BULLET = ("Without pybullet nothing can be simulated or planned, so this demo takes the shipped pokes; to get it: "
             "pip install pybullet (ready-made for Python 3.11 and older; later versions compile it)")


def run_demo(args):
    """The whole paper on pokes just simulated; without pybullet, all but planning on the shipped ones."""
    began, out, simulating = time.perf_counter(), Path(args.out), find_spec("pybullet") is not None
    train, test = (out / "train", out / "test") if simulating else (data_small() / "train", data_small() / "test")
    model, found = out / "checkpoint.npz", out / "metrics.json"

    def run(text, *arguments):
        arguments = [str(each) for each in arguments]
        print(f"\n{text}\n$ hind4sight {' '.join(arguments)}", flush=True)
        parsed = build_parser().parse_args(arguments)
        parsed.function(parsed)

    jobs = "--jobs", args.jobs
    if simulating:
        scenes = ("--objects", Settings.objects_min, MIDDLE["objects_max"], "--within", MIDDLE["place_within"],
                  "--kinds", *MIDDLE["kinds"])
        run("Simulate pokes: before, after, and the poke alone.",
            "collect", train, "--pokes", DEMO_POKES, "--seed", args.seed, *scenes, *jobs)
        run("Some more, to test with.",
            "collect", test, "--pokes", DEMO_TEST_POKES, "--seed", args.seed + 1, *scenes, *jobs)
    else:
        print(NO_BULLET)
    for ending in (".npz", ".csv", ".png"):
        model.with_suffix(ending).unlink(missing_ok=True)
    run("Train on them without labels: Chamfer, photometric, smoothness and inverse losses (Eq. 6).",
        "train", train, model, "--steps", DEMO_STEPS, "--learning-rate", 0.002, "--seed", args.seed, *jobs)
    run("Evaluate on pokes that were never trained on.", "evaluate", model, test, "--json", found)
    metrics = read_json(found)
    run("Look at one of them.", "show", model, test, "--out", out / "interaction.png")
    if simulating:
        run("Plan pokes to a goal with the model (CEM), carry them out, look again; in a scene of neither pokes.",
            "plan", model, "--seed", args.seed + 2, "--budget", 6, "--out", out, "--json", found)
        metrics.update(read_json(found))
    metrics["seconds"] = time.perf_counter() - began
    print(f"The whole demo took {metrics['seconds']:.0f} s.")
    write_json(args.json or found, {f"demo_{name}": value for name, value in metrics.items()})


# --- the course --------------------------------------------------------------------------------------------

def run_course(args):
    from ..course.commands import run_course
    run_course(args)


def run_grade(args):
    from ..course.grade_commands import run_grade
    run_grade(args)


# --- the command line -----------------------------------------------------------------------------------------

def term_weight(text):
    """'photometric=0.5' -> ('photometric', 0.5). Raises argparse's error for anything else."""
    name, _, value = text.partition("=")
    try:
        return {name: (name, float(value)) for name in training.WEIGHTS}[name]
    except (KeyError, ValueError):
        raise argparse.ArgumentTypeError(f"expected TERM=VALUE, a term of {', '.join(training.WEIGHTS)} and a number, "
                                         f"got {text!r}") from None


def missing_kind(text):
    """'0.3' -> 0.3, a share; a name stays one."""
    try:
        return float(text)
    except ValueError:
        return text


def part_of(text):
    """'3/8' -> (3, 8). Raises argparse's error for anything else."""
    try:
        which, parts = map(int, text.split("/"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected I/N, two whole numbers, got {text!r}") from None
    return which, parts


class OneLineParser(argparse.ArgumentParser):
    """argparse without the usage text before an error."""

    def error(self, message):
        self.exit(2, f"{self.prog}: {message}\n")


def checkpoint_path(text):
    """A file's path, or 'camera' -> that of the shipped checkpoint for real cameras."""
    return data_small() / "camera_checkpoint.npz" if text == "camera" else Path(text)


SHIPPED = {"nargs": "?", "default": data_small() / "checkpoint.npz", "type": checkpoint_path,
           "help": "a file, or camera: the shipped one for real cameras"}
TEST = {"nargs": "?", "default": data_small() / "test"}
SEED, PIXEL = {"type": int, "default": 0}, {"type": float, "nargs": 2, "action": "append", "metavar": ("X", "Y")}
JOBS = {"type": int, "default": os.cpu_count(), "help": "processes; the result is the same"}
CLUSTER = {"metavar": "ADDRESS", "help": "of a Dask scheduler, whose workers do it instead"}
JSON = {"metavar": "FILE", "help": "write the figures here too"}
OWN = {"--urdf": {"nargs": "+", "metavar": "FILE", "help": "objects of your own: anything rigid that Bullet loads"},
       "--scale": {"type": float, "default": 1.0, "help": "how many times as large as the URDF files say"}}


def fields(record, *names, **how):
    """Options for some fields of a record of settings, which has their defaults."""
    return {"--" + name.replace("_", "-"): {"type": type(value), "default": value, "help": f"default {value}", **how}
            for name, value in vars(record).items() if name in names}


FAULTS = {  # of the camera that `evaluate` shows the pokes with
    "--depth-noise": {"type": float, "metavar": "SD", "help": "of the depth, in m"},
    "--missing": {"type": missing_kind, "action": "append", "metavar": f"SHARE|{'|'.join(ONE_SIDED)}",
                  "help": "depth that is missing: a share at random, rims, shadows; again for another"},
    "--pitch-error": {"type": float, "metavar": "DEG", "help": "how wrong the camera's pitch is"},
    "--pose-error": {"type": float, "nargs": 2, "metavar": ("DEG", "M"),
                     "help": "how wrong its pose is: turned about any axis, shifted in any direction"}}


COMMANDS = {  # name: what runs it, what it does, its arguments as argparse takes them
    "collect": (run_collect, "simulate pokes and write them to a folder of shards (needs pybullet)", {
        "out": {"help": "folder; one that holds a part of the same pokes is completed"},
        "--pokes": {"type": int, "default": 1000}, "--seed": SEED,
        "--objects": {"type": int, "nargs": 2, "metavar": ("MIN", "MAX"), "help": "objects in a scene, 1 to 7",
                      "default": (Settings.objects_min, Settings.objects_max)},
        "--within": {"type": float, "default": Settings.place_within,
                     "help": "part of the arena that they are put down in, at most 1"},
        "--size": {"type": int, "nargs": 2, "metavar": ("W", "H"), "default": (Settings.width, Settings.height),
                   "help": "of the pictures, px, 4:3"},
        "--kinds": {"nargs": "+", "help": f"of {', '.join(KINDS)}; with --urdf too, half of the objects (default "
                    f"{' '.join(Settings.kinds)}, with --urdf none)"},
        **OWN,
        "--textures": {"nargs": "+", "default": Settings.textures, "help": f"of {', '.join(TEXTURES)}"},
        "--part": {"type": part_of, "metavar": "I/N", "default": (1, 1),
                   "help": "the I-th of N that share the work; without it, all that is missing (default)"},
        "--jobs": JOBS, "--cluster": CLUSTER, "--json": JSON}),
    "import": (run_import, "make a folder of shards from a real camera's recording: see docs/own-data.md", {
        "folder": {"help": "of the recording: camera.json, pokes.csv and PNG pictures"},
        "out": {"help": "folder to write the shards to"},
        "--size": {"type": int, "nargs": 2, "metavar": ("W", "H"), "default": (Settings.width, Settings.height),
                   "help": "of the pictures to make, px"}, "--json": JSON}),
    "export": (run_export, "write a folder of shards as a recording, at its size", {
        "data": {"help": "folder of shards"}, "folder": {"help": "a new one, for the recording"}}),
    "train": (run_train, "train the full model (Eq. 6) on a folder of shards, without labels", {
        "data": {"nargs": "?", "default": data_small() / "train"},
        "out": {"help": "checkpoint to write (.npz); its log goes beside it (.csv and .png)"},
        **fields(training.Recipe(), "steps", "batch", "learning_rate", "optimiser", "seed", default=None),
        **fields(Sizes(), "masks", "width", default=None),
        "--weight": {"type": term_weight, "action": "append", "metavar": "TERM=VALUE",
                     "help": f"a weight of Eq. 6, 0 leaves the term out; terms: {', '.join(training.WEIGHTS)}"},
        "--depth-noise": {"type": float, "help": "SD in m of the noise to train under (0)"},
        "--camera-faults": {"action": "store_true", "default": None, "help": "train for real cameras: under noise, "
                            "missing depth and an uncertain pose"},
        "--start-from": {"type": checkpoint_path, "metavar": "FILE",
                         "help": "a checkpoint to begin with its parameters, not with random ones"},
        "--resume": {"action": "store_true", "help": "go on with the checkpoint OUT and its recipe"},
        "--jobs": JOBS, "--json": JSON}),
    "evaluate": (run_evaluate, "metrics of a checkpoint on a folder of shards; without arguments, the shipped ones", {
        "checkpoint": SHIPPED, "data": TEST, **FAULTS, "--json": JSON}),
    "show": (run_show, "one interaction as a picture; without arguments, a shipped one", {
        "checkpoint": SHIPPED, "data": TEST, "--out": {"default": "interaction.png"},
        "--row": {"type": int, "help": "which interaction (one that moves something well)"}}),
    "explore": (run_explore, "a window to poke in with the mouse: what the model predicts follows (without pybullet in "
                "the shipped pokes)", {
        "checkpoint": SHIPPED,
        "data": {"nargs": "?", "help": "a folder of pokes to explore, in place of the simulator"},
        "--seed": {**SEED, "help": "which scene"},
        "--mine": {"nargs": "+", "metavar": "FOLDER", "help": "take what a student wrote there in "
                   "place of the reference's functions; their code runs with all your rights"},
        "--script": {"metavar": "FILE", "help": "no window: do what the file says (docs/explorer.md)"},
        "--demo": {"metavar": "OUT.gif", "help": "no window: film the script, or one of our own"},
        "--out": {"default": ".", "help": "folder for saved pictures"}}),
    "plan": (run_plan, "plan pokes to a goal and carry them out, in a test scene (needs pybullet)", {
        "checkpoint": SHIPPED,
        "--seed": {**SEED, "help": f"which scene ({tables.TRAIN_SEED} has objects that were trained on)"},
        "--objects": {"type": int, "default": 1, "choices": (1, 2, 3), "help": "how many are to be moved"},
        "--obstacle": {"action": "store_true", "help": "a scene with another object in the way"},
        **OWN,
        "--mark": {**PIXEL, "help": "a pixel on an object, again for each; --goal as often, in place of the scene's"},
        "--goal": {**PIXEL, "help": "where that shall go"},
        "--policy": {"choices": control.POLICIES, "default": "learned"},
        "--budget": {"type": int, "default": 10, "help": "pokes at most"},
        **fields(planning.Search(), *SEARCH_OPTIONS),
        "--out": {"default": "runs/plan", "help": "folder for plan.gif"}, "--json": JSON}),
    "reproduce": (run_reproduce, "the paper's tables at our scale, over several seeds: hours, in which it can be "
                  "stopped and started again (needs pybullet)", {
        "table": {"choices": [*tables.TABLES, "all", "planning", "contact"],
                  "help": "all: the tables of Sec. IV-D to IV-F; planning: the control experiment of Sec. IV-G; "
                  "contact: a model's error by what met what, in minutes"},
        "--checkpoint": {"default": SHIPPED["default"], "help": "the model to plan or poke with"},
        "--planners": {"nargs": "+", "choices": list(tables.PLANNERS), "default": list(tables.PLANNERS),
                       "help": "of planning: which; all of them take most of an hour"},
        "--quick": {"action": "store_true", "help": "the same tables from little data, in under ten minutes"},
        "--out": {"help": "folder of data and runs (runs/ and reproduce, reproduce-quick, planning or contact)"},
        "--jobs": JOBS, "--cluster": CLUSTER, "--json": JSON}),
    "demo": (run_demo, "collect, train, evaluate, show and plan, in under five minutes; without pybullet, train, "
             "evaluate and show on the shipped pokes", {
        "--out": {"default": "runs/demo"}, "--seed": SEED, "--jobs": JOBS, "--json": JSON}),
    "course": (run_course, "exercises for a class: list them, or start one in a folder of its own", {
        "action": {"choices": ("list", "start", "bundle"), "help": "bundle: an exercise's autograder, for Gradescope"},
        "name": {"nargs": "?", "help": "number or name of the exercise"},
        "--out": {"help": "a new folder, or for the bundle a .zip (the exercise's name)"},
        "--seed": {"metavar": "FILE", "help": "bundle: of the held-back inputs (drawn)"},
        "--pokes": {"metavar": "FOLDER", "help": "bundle of assignment 8: the held-back pokes, with their truth"}}),
    "grade": (run_grade, "grade a submission of an assignment, each task in a process of its own; or a class of them", {
        "folder": {"nargs": "?", "help": "submission: a folder, a zip file or the file itself"},
        "--all": {"metavar": "FOLDER", "help": "a folder of submissions; with --csv and --assignment"},
        "--csv": {"metavar": "FILE", "help": "the class's grades; details in FILE_results/, from which it goes on"},
        "--assignment": {"metavar": "N", "help": "its number or name (what the submission's file is called)"},
        "--task": {"metavar": "N.M", "help": "this task alone"},
        "--public": {"action": "store_true", "help": "on the inputs that students have, with what their code prints"},
        "--seed": {"metavar": "FILE", "help": "of the held-back inputs: a number, or a file they never see (drawn)"},
        "--pokes": {"metavar": "FOLDER", "help": "assignment 8: held-back pokes, with their truth (the shipped ones)"},
        "--out": {"default": "results.json", "help": "in Gradescope's format, whole after every task"},
        "--jobs": {"type": int, "default": 2, "help": "submissions at a time"}, "--cluster": CLUSTER}),
}


def build_parser():
    """The parser of all COMMANDS; each sets `function`, which `main` calls with the arguments."""
    parser = OneLineParser(prog="hind4sight", description=__doc__)
    parser.add_argument("--version", action="version", version=f"hind4sight {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name, (function, text, arguments) in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text)
        command.set_defaults(function=function)
        for argument, how in arguments.items():
            command.add_argument(argument, **{**how, "help": with_default(how)})
    return parser


def with_default(how):
    """The help of an argument, with its default where that says something."""
    text, default = how.get("help", ""), how.get("default")
    if default in (None, False) or "default" in text:
        return text
    default = " ".join(map(str, default)) if isinstance(default, tuple) else str(default)
    return f"{text} (default {default})".strip().replace("%", "%%")


GO_ON = {"train": ", --resume goes on", "collect": ", the same command goes on",
         "reproduce": ", the same command goes on"}


def main(arguments=None):
    """Run one command; wrong input ends in one line and exit status 2."""
    parser = build_parser()
    args = parser.parse_args(arguments)
    if not args.command:
        parser.print_help()
        return 0
    try:
        for name, value in vars(args).items():
            if value == "" or isinstance(value, list) and "" in value:  # an unset variable of the shell's
                raise ValueError(f"{name}: expected something, got an empty text")
        if getattr(args, "json", None):
            check_output("--json", args.json, ".json")
        args.function(args)
    except BrokenPipeError:
        raise
    except (ValueError, RuntimeError, OSError, FloatingPointError) as error:
        print(f"hind4sight {args.command}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"\nhind4sight {args.command}: stopped; what is on disk is whole{GO_ON.get(args.command, '')}",
              file=sys.stderr)
        return getattr(interrupt, "status", 130)
    return 0
