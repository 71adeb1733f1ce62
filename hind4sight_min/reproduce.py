"""The paper's tables at our scale: which models, on what data, for how long; runs that go on where they were.

Paper: Sec. IV, Tables I to III. Every cell of a table is a training run with a budget of its own, on one core; a
finished cell leaves its figures in a file and is never run again. This file reads the simulator's truth.
"""
import json
import subprocess
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from multiprocessing import active_children
from pathlib import Path

import numpy as np

from . import check_whole, control, evaluation, planning, simulator, training, worker_pool
from .interactions import load_interactions, load_truth, write_json
from .objects import HELD_OUT


@dataclass(frozen=True)
class Scale:
    """train_pokes, test_pokes: how many. steps: of every cell of the tables; long_steps: of the headline models."""
    train_pokes: int = 24000
    test_pokes: int = 1000
    steps: int = 3000
    long_steps: int = 20000
    seeds: tuple = (1, 2, 3)


FULL = Scale()
QUICK = Scale(train_pokes=600, test_pokes=100, steps=200, long_steps=300, seeds=(1, 2))


def _only(*terms):
    """The weights of an ablation; what keeps masks together belongs to the model, not to a domain."""
    return {name: value * (name in (*terms, "sharing")) for name, value in training.WEIGHTS.items()}


# name -> (what the table says, what its recipe changes). SE3-Nets is our network with its loss. The paper gives windows
# of 9 and 11 pixels but not the picture's size; SE3-Nets' has 320 columns, five times ours, where they span what 3
# pixels do here. Both are shown.
MODELS = {
    "se3nets_0": ("SE3-Nets, exact association", {"association": 1}),
    "se3nets_9": ("SE3-Nets, 9 x 9 px", {"association": 9}),
    "se3nets_11": ("SE3-Nets, 11 x 11 px", {"association": 11}),
    "se3nets_3": ("SE3-Nets, 3 x 3 px (11 x 11 scaled)", {"association": 3}),
    "2d": ("2D loss", {"weights": _only("photometric", "flow_smoothness")}),
    "3d": ("3D loss", {"weights": _only("chamfer", "distance_smoothness")}),
    "2d_3d": ("2D loss + 3D loss", {"weights": {**training.WEIGHTS, "inverse": 0.0}}),
    "full": ("full model", {}),
}
NOISES = {"clean": 0.0, "noisy": 0.01}  # m, SD of the depth noise in training and test

# The paper prints "MSE (cm)". We read its numbers as squared errors in cm^2, as the name says; read as lengths, it is
# our flow_epe_ratio that they have to be held against.
NO_MOTION_PAPER = 12.6  # Table II
PAPER = {  # Table I, flow MSE
    "se3nets_0": (1.00, 1.07), "se3nets_9": (1.68, 1.94), "se3nets_11": (2.07, 2.20), "2d": (1.86, 1.93),
    "3d": (1.80, 31.39), "2d_3d": (1.52, 1.78), "full": (1.47, 1.63)}
OPTICAL_PAPER = {"full": 0.05, "peer": 0.11}  # Table III, FlowNet 2.0 as the peer

TABLES = {"flow": [name for name in MODELS if name.startswith("se3nets")] + ["full"],
          "ablation": ["2d", "3d", "2d_3d", "full"], "optical-flow": []}


@dataclass(frozen=True)
class Cell:
    """One training run: a model, a noise and a seed, for the budget of the tables or the long one of the headlines."""
    model: str
    noise: str
    seed: int
    long: bool = False

    @property
    def name(self):
        return f"{self.model}-{self.noise}-{self.seed}" + ("-long" if self.long else "")


def cells_of_tables(tables, scale):
    """The cells that some tables need, each once; the long runs of the full model are the headlines of all of them."""
    cells = []
    for seed in scale.seeds:  # so that one seed of everything is there first
        cells += [Cell("full", noise, seed, long=True) for noise in NOISES]
        cells += [Cell(model, noise, seed) for table in tables for model in TABLES[table] for noise in NOISES]
    return list(dict.fromkeys(cells))


def recipe_of(cell, scale):
    changes = MODELS[cell.model][1]
    if changes.get("association"):
        changes = {**changes, "weights": dict(training.ASSOCIATION_WEIGHTS)}
    return training.Recipe(steps=scale.long_steps if cell.long else scale.steps, seed=cell.seed,
                           depth_noise=NOISES[cell.noise], **changes)


# --- data ------------------------------------------------------------------------------------------------------

# Also of the shipped checkpoint's pokes. A task of this seed would share its random numbers with a training shard, and
# so its objects: no scene of the control experiment has it.
TRAIN_SEED = 5


def collect_data(out, scale, jobs, progress=None):
    """Training pokes, test pokes, and test pokes of objects and textures never trained on; completes what is there."""
    for name, pokes, seed, settings in (("train", scale.train_pokes, TRAIN_SEED, simulator.Settings()),
                                        ("test", scale.test_pokes, 101, simulator.Settings()),
                                        ("unseen", scale.test_pokes, 102, simulator.Settings(**HELD_OUT))):
        simulator.collect(out / name, pokes, seed, settings, jobs, progress)


@lru_cache(maxsize=4)
def _data(folder):
    return load_interactions(folder), load_truth(folder)


# --- one cell ----------------------------------------------------------------------------------------------------

@lru_cache
def commit():
    """The commit that the package is of, with "-dirty" where files differ from it; None outside a checkout, or without
    git.
    """
    try:
        found = subprocess.run(["git", "describe", "--always", "--dirty", "--abbrev=12"], cwd=Path(__file__).parent,
                               capture_output=True, text=True)
    except FileNotFoundError:
        return None
    return found.stdout.strip() if found.returncode == 0 else None


def run_cell(cell, out, scale, save_every=60.0):
    """Train and evaluate one cell, from where it was -> its metrics, with train_seconds. Runs in a worker process.

    What is finished is found in a file that says how it was made; `python docs/results.py keep` collects these files.
    """
    path, figures = out / "cells" / f"{cell.name}.npz", out / "cells" / f"{cell.name}.json"
    recipe, began_at = recipe_of(cell, scale), commit()
    made = {"recipe": plain(asdict(recipe)), "format": training.FORMAT, "test_pokes": scale.test_pokes,
            "train_pokes": scale.train_pokes}
    if figures.exists():
        found = json.loads(figures.read_text())
        if any(found.get(name) != value for name, value in made.items()):
            raise ValueError(f"{figures}: made with another recipe or network; remove it, or choose another --out")
        return found["metrics"]
    interactions, truth = _data(out / "train")
    run = training.load_run(path) if path.exists() else training.start_run(recipe, interactions)
    if run.recipe != recipe:
        raise ValueError(f"{path}: made with another recipe; remove it, or choose another --out")
    seconds = training.train_saving(interactions, run, path, save_every, truth=truth if recipe.association else None)
    metrics = evaluation.evaluate(run, *_data(out / "test"), depth_noise=recipe.depth_noise)
    metrics["train_seconds"] = seconds
    if cell.long and cell.noise == "clean":
        unseen = evaluation.evaluate(run, *_data(out / "unseen"))
        metrics.update({f"unseen_{name}": value for name, value in unseen.items()})
    write_json(figures, {**made, "commit": began_at, "metrics": metrics})
    return metrics


def plain(value):
    """`value` as JSON gives it back: lists for tuples."""
    return json.loads(json.dumps(value))


# --- all of them ------------------------------------------------------------------------------------------------

def run_all(function, tasks, jobs, report=None):
    """{task: function(*task)} of tuples, in their order, over so many processes; report(done, task, result) is called
    as each of them ends.
    """
    results = {}
    with worker_pool(jobs) as pool:
        try:
            waiting = {pool.submit(function, *task): task for task in tasks}
            for future in as_completed(waiting):
                task = waiting[future]
                results[task] = future.result()
                if report:
                    report(len(results), task, results[task])
        except BaseException:  # an interrupt must not wait for what runs: its files are on disk
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
            raise
    return {task: results[task] for task in tasks}


def reproduce(tables, out, scale, jobs=1, progress=None):
    """Everything that some tables need -> flat dict of figures. Cells run side by side, one core each."""
    check_whole("jobs", jobs, 1)
    out = Path(out)
    described = {"train_pokes": scale.train_pokes, "test_pokes": scale.test_pokes, "steps": scale.steps,
                 "long_steps": scale.long_steps}
    note = out / "scale.json"
    if note.exists() and json.loads(note.read_text()) != described:
        raise ValueError(f"{out}: holds runs of another scale; choose another --out")
    write_json(note, described)
    collect_data(out, scale, jobs, progress)
    cells = cells_of_tables(tables, scale)

    def report(done, task, metrics):
        print(f"{done} of {len(cells)}: {task[0].name}: ratio {metrics['flow_mse_ratio']:.3f}, "
              f"{metrics['train_seconds'] / 60:.1f} min", flush=True)

    results = run_all(partial(run_cell, out=out, scale=scale), [(cell,) for cell in cells], jobs, report)
    figures = summarise({cell: results[cell,] for cell in cells}, scale)
    if "optical-flow" in tables:
        figures.update(evaluation.evaluate_image_pairs(*_data(out / "test")))
        figures.update(optical_headlines(figures))
    return figures


METRICS = ("flow_mse_cm2", "flow_mse_ratio", "flow_epe_cm", "no_motion_epe_cm", "still_epe_cm", "mask_iou",
           "optical_epe_px", "optical_epe_all_px", "inverse_target_cm", "inverse_direction_deg", "no_motion_mse_cm2",
           "no_motion_optical_epe_px", "no_motion_optical_epe_all_px", "unseen_flow_mse_ratio", "unseen_mask_iou",
           "train_seconds")


def summarise(results, scale):
    """{Cell: metrics} -> mean and SD over the seeds of every metric, a flat dict; what the paper claims of them; the
    scale, its seeds, and how long all the training took, on one core each.
    """
    figures = {**asdict(scale),
               "train_core_hours": sum(metrics["train_seconds"] for metrics in results.values()) / 3600}
    for cell in results:
        if cell.seed == scale.seeds[0]:
            group = [results[other] for other in results if replace(other, seed=cell.seed) == cell]
            for metric in METRICS:
                if metric in group[0]:
                    values = [metrics[metric] for metrics in group]
                    key = f"{cell.model}_{cell.noise}{'_long' if cell.long else ''}_{metric}"
                    figures[key], figures[f"{key}_sd"] = float(np.mean(values)), float(np.std(values, ddof=1))
    figures.update(headlines(figures))
    return figures


def headlines(figures):
    """The figures that the paper's claims are held against."""
    found = {"flow_mse_ratio_clean": figures["full_clean_long_flow_mse_ratio"],
             "flow_mse_ratio_noisy": figures["full_noisy_long_flow_mse_ratio"],
             "flow_epe_ratio": figures["full_clean_long_flow_epe_cm"] / figures["full_clean_long_no_motion_epe_cm"],
             "mask_iou": figures["full_clean_long_mask_iou"],
             "inverse_target_cells": figures["full_clean_long_inverse_target_cm"] / (100 * simulator.Settings().cell),
             "inverse_direction_deg": figures["full_clean_long_inverse_direction_deg"],
             "unseen_over_seen": figures["full_clean_long_unseen_flow_mse_ratio"]
             / figures["full_clean_long_flow_mse_ratio"],
             "train_minutes": figures["full_clean_long_train_seconds"] / 60}
    if "se3nets_11_noisy_flow_mse_cm2" in figures:
        found["noisy_over_se3nets_da11"] = figures["full_noisy_flow_mse_cm2"] / figures["se3nets_11_noisy_flow_mse_cm2"]
        found["noisy_over_se3nets_da11_scaled"] = (figures["full_noisy_flow_mse_cm2"]
                                                   / figures["se3nets_3_noisy_flow_mse_cm2"])
    if "2d_clean_flow_mse_cm2" in figures:
        found["ablation_order_holds"] = float(all(order_holds(figures, noise) for noise in NOISES))
    return found


def order_holds(figures, noise):
    """full < 2D + 3D < 3D and 2D, each by more than one SD (the larger of the two)."""
    def better(a, b):
        first, second = (f"{model}_{noise}_flow_mse_cm2" for model in (a, b))
        return figures[second] - figures[first] > max(figures[f"{first}_sd"], figures[f"{second}_sd"])
    return better("full", "2d_3d") and better("2d_3d", "3d") and better("2d_3d", "2d")


def optical_headlines(figures):
    """Our optical flow, from one picture and the poke, over the better of two methods that see both pictures."""
    return {f"optical_epe_over_best_peer_{name}": figures[f"full_clean_long_{metric}"]
            / min(figures[f"{peer}_{metric}"] for peer in evaluation.PEERS)
            for name, metric in (("moving", "optical_epe_px"), ("all", "optical_epe_all_px"))}


# --- tables ------------------------------------------------------------------------------------------------------

def _pm(figures, key, form="{:.2f}"):
    if key not in figures:
        return ""
    return f"{form.format(figures[key])} \u00b1 {form.format(figures[key + '_sd'])}"


def flow_table(figures, models, title):
    """Table I of the paper, ours beside it: flow MSE, relative to no motion, of every model without and with noise."""
    lines = [f"| {title} | paper, no noise | ours, no noise | paper, 1 cm noise | ours, 1 cm noise "
             "| ours, cm^2, no noise | ours, cm^2, 1 cm noise |", "|---|---|---|---|---|---|---|"]
    for key in models + (["full_long"] if "full" in models else []):
        model, long = (key.removesuffix("_long"), key.endswith("_long"))
        text = MODELS[model][0] + (", trained long" if long else "")
        paper = [f"{value / NO_MOTION_PAPER:.3f}" for value in PAPER.get(model, ())] if not long else []
        name = [f"{model}_{noise}{'_long' if long else ''}" for noise in NOISES]
        ratio = [_pm(figures, f"{each}_flow_mse_ratio", "{:.3f}") for each in name]
        mse = [_pm(figures, f"{each}_flow_mse_cm2") for each in name]
        if any(ratio):
            paper = paper or ["", ""]
            lines.append(f"| {text} | {paper[0]} | {ratio[0]} | {paper[1]} | {ratio[1]} | {mse[0]} | {mse[1]} |")
    return "\n".join(lines)


def optical_table(figures):
    """Table III of the paper, ours beside it."""
    lines = ["| optical flow, end-point error | sees | paper | moving pixels, px | all pixels, px |",
             "|---|---|---|---|---|"]
    for peer in evaluation.PEERS:
        if f"{peer}_optical_epe_px" in figures:
            lines.append(f"| {peer} (FlowNet 2.0 in the paper) | both pictures | {OPTICAL_PAPER['peer']} | "
                         f"{figures[f'{peer}_optical_epe_px']:.2f} | {figures[f'{peer}_optical_epe_all_px']:.4f} |")
    lines.append(f"| full model, trained long | depth and poke | {OPTICAL_PAPER['full']} | "
                 f"{_pm(figures, 'full_clean_long_optical_epe_px')} | "
                 f"{_pm(figures, 'full_clean_long_optical_epe_all_px', '{:.4f}')} |")
    lines.append(f"| no motion | | | {figures['full_clean_long_no_motion_optical_epe_px']:.2f} | "
                 f"{figures['full_clean_long_no_motion_optical_epe_all_px']:.4f} |")
    return "\n".join(lines)


def tables_text(tables, figures):
    """The asked-for tables as Markdown."""
    parts = []
    for table in tables:
        if table == "optical-flow":
            parts.append(optical_table(figures))
        else:
            title = "flow MSE / no motion" + (", ablation" if table == "ablation" else "")
            parts.append(flow_table(figures, TABLES[table], title))
    return "\n\n".join(parts)


# --- planning (Sec. IV-G) ------------------------------------------------------------------------------------------

# name -> (what the table says, control.POLICIES, what its search changes)
PLANNERS = {
    "learned": ("learned model", "learned", {}),
    "pixels": ("learned model, pixel distance alone", "learned", {"chamfer_weight": 0.0}),
    "chamfer": ("learned model, Chamfer distance alone", "learned", {"pixel_weight": 0.0}),
    "oracle": ("the simulator as the model", "oracle", {}),
    "random": ("random pokes", "random", {}),
    "no_motion": ("model of no motion", "no_motion", {}),
}
OBJECTS, POKES = (1, 2, 3), 10
OBSTACLE_SCENES, OBSTACLE_TRIES = 3, 5
AVOIDED = 0.01  # m; an obstacle that was moved by less was avoided
AHEAD = {"horizon": 2, "candidates": 128}  # getting around an obstacle takes more than one poke


def run_scene(checkpoint, out, planner, movers, seed, attempt=0):
    """One sequence of pokes, or its figures if it was run before; runs in a worker process.

    planner: of PLANNERS, or "greedy"; movers 0: an obstacle scene.
    """
    path = out / "scenes" / f"{planner}-{movers}-{seed}-{attempt}.json"
    if path.exists():
        return json.loads(path.read_text())
    _, policy, changes = PLANNERS.get(planner, (None, planner, {})) if movers else (None, planner, AHEAD)
    with control.random_task(seed, max(movers, 1), obstacle=movers == 0) as task:
        record = control.closed_loop(task, training.load_run(checkpoint), policy, planning.Search(**changes), POKES,
                                     seed=[seed, attempt])
    others = np.setdiff1d(np.arange(record["poses"].shape[1]), record["movers"])  # any but the one to be moved
    shifted = np.linalg.norm(record["poses"][:, others, :2] - record["poses"][0, others, :2], axis=2).max()
    last = np.repeat(record["distance"][-1:], POKES + 1 - len(record["distance"]), axis=0)  # it stopped: all stays
    distance = np.concatenate([record["distance"], last]).mean(axis=1)
    angles = record["angle"][[0, -1]]
    figures = {"distance_m": distance.tolist(), "others_shifted_m": float(shifted), "pokes": len(record["pokes"]),
               "angles_deg": np.degrees(angles[:, np.isfinite(angles[0])]).tolist()}
    write_json(path, figures)
    return figures


def reproduce_planning(out, checkpoint, scenes=20, jobs=1):
    """The paper's control experiment -> flat dict of figures, curves {(planner, objects): (scenes, pokes + 1) m}.

    Scenes that were run before, with the same checkpoint and planners, are not run again.
    """
    check_whole("jobs", jobs, 1)
    out = Path(out)
    note = out / "planning.json"
    described = plain({"vector": float(np.abs(training.load_run(checkpoint).vector).sum()), "planners": PLANNERS,
                       "search": asdict(planning.Search()), "pokes": POKES, "ahead": AHEAD,
                       "settings": asdict(control.SETTINGS)})
    if note.exists() and json.loads(note.read_text()) != described:
        raise ValueError(f"{out}: holds runs of another checkpoint or other planners; choose another --out")
    write_json(note, described)
    seeds = [seed for seed in range(scenes + 1) if seed != TRAIN_SEED][:scenes]
    todo = [(planner, movers, seed, 0) for planner in PLANNERS for movers in OBJECTS for seed in seeds]
    todo += [(planner, 0, seed, attempt) for planner in ("learned", "greedy") for seed in range(OBSTACLE_SCENES)
             for attempt in range(OBSTACLE_TRIES)]
    results = run_all(partial(run_scene, checkpoint, out), todo, jobs)
    curves = {(planner, movers): np.array([results[planner, movers, seed, 0]["distance_m"] for seed in seeds])
              for planner in PLANNERS for movers in OBJECTS}
    return summarise_planning(results, curves), curves


def summarise_planning(results, curves):
    """Distance left after all pokes, relative to the start; orientation; obstacles -> flat dict of figures."""
    figures = {}
    for (planner, movers), curve in curves.items():
        mean = curve.mean(axis=0)
        figures[f"{planner}_{movers}_left"] = float(mean[-1] / mean[0])
        figures[f"{planner}_{movers}_left_sd"] = float((curve[:, -1] / curve[:, 0]).std(ddof=1))
        figures[f"{planner}_{movers}_left_after_5"] = float(mean[5] / mean[0])
        figures[f"{planner}_{movers}_falls"] = float((np.diff(mean) < 1e-6).all())  # to a micrometre
        turned = [each["angles_deg"] for key, each in results.items() if key[:2] == (planner, movers)]
        before, after = (np.concatenate([pair[i] for pair in turned]) for i in (0, 1))
        if len(before):
            figures[f"{planner}_{movers}_angle_start_deg"] = float(np.median(before))
            figures[f"{planner}_{movers}_angle_deg"] = float(np.median(after))
    left = {planner: sum(curves[planner, movers][:, -1].mean() for movers in OBJECTS) for planner in PLANNERS}
    figures["plan_over_oracle"] = float(left["learned"] / left["oracle"])
    for movers in OBJECTS:
        figures[f"plan_{movers}_object{'s' * (movers > 1)}"] = figures[f"learned_{movers}_left"]
    for planner in ("learned", "greedy"):
        runs = [each for key, each in results.items() if key[:2] == (planner, 0)]
        figures[f"{planner}_obstacle_avoided"] = float(np.mean([each["others_shifted_m"] < AVOIDED for each in runs]))
        figures[f"{planner}_obstacle_shift_cm"] = float(100 * np.mean([each["others_shifted_m"] for each in runs]))
        figures[f"{planner}_obstacle_left"] = float(np.sum([each["distance_m"][-1] for each in runs])
                                                    / np.sum([each["distance_m"][0] for each in runs]))
    return figures


def planning_table(figures):
    """The control experiment as Markdown: distance left relative to the start, and median orientation error."""
    lines = ["| planner | " + " | ".join(f"{m} object{'s' * (m > 1)}: distance left | turned wrong by, start -> end"
                                         for m in OBJECTS) + " |", "|---|" + "---|" * (2 * len(OBJECTS))]
    for planner, (text, *_) in PLANNERS.items():
        cells = []
        for m in OBJECTS:
            cells.append(_pm(figures, f"{planner}_{m}_left"))
            angle = figures.get(f"{planner}_{m}_angle_deg")
            start = figures.get(f"{planner}_{m}_angle_start_deg")
            cells.append("" if angle is None else f"{start:.0f}\u00b0 -> {angle:.0f}\u00b0")
        lines.append(f"| {text} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
