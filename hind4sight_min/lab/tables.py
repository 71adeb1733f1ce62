"""The paper's tables at our scale: which models, on what data, for how long; runs that go on where they were.

Paper: Sec. IV, Tables I to III, and the control experiment of Sec. IV-G. Every cell of a table is a training run with a
budget of its own, on one core; what is finished leaves its figures in a file and is never run again.
"""
import subprocess
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from itertools import product
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

from .. import planning, training
from ..disk import checkpoints
from ..disk.files import plain, read_json, write_json
from ..disk.shards import load_interactions, stream_interactions
from ..sim.arena import MIDDLE, Settings
from ..sim.collection import collect
from ..sim.objects import HELD_OUT
from ..sim.truth import load_truth
from . import control, evaluation, image_pairs, se3nets
from .noise import under_noise
from .runs import train_saving


@dataclass(frozen=True)
class Scale:
    """train_pokes, test_pokes: how many, of each of TESTS times its factor. steps: of every cell of the tables;
    long_steps: of the headline models.
    """
    train_pokes: int = 48000
    test_pokes: int = 1000
    steps: int = 3000
    long_steps: int = 30000
    seeds: tuple = (1, 2, 3)


FULL = Scale()
QUICK = Scale(train_pokes=600, test_pokes=100, steps=200, long_steps=300, seeds=(1, 2))

_2D = {name: training.WEIGHTS[name] for name in ("photometric", "flow_smoothness")}
_3D = {name: training.WEIGHTS[name] for name in ("chamfer", "distance_smoothness")}

NOISES = {"clean": 0.0, "noisy": 0.01}  # m, SD of the depth noise in training and test

# name -> (what the table says, weights, window in pixels of SE3-Nets' association noise, the paper's flow MSE, Table I,
# without and with noise). SE3-Nets is our network with its loss. The paper gives windows of 9 and 11 pixels but not the
# picture's size; SE3-Nets' has 320 columns, five times ours, where they span what 3 pixels do here. Both are shown.
# The paper prints "MSE (cm)". We read its numbers as squared errors in cm^2, as the name says; read as lengths, it is
# our flow_epe_ratio that they have to be held against.
MODELS = {
    "se3nets_0": ("SE3-Nets, exact association", se3nets.WEIGHTS, 1, (1.00, 1.07)),
    "se3nets_9": ("SE3-Nets, 9 x 9 px", se3nets.WEIGHTS, 9, (1.68, 1.94)),
    "se3nets_11": ("SE3-Nets, 11 x 11 px", se3nets.WEIGHTS, 11, (2.07, 2.20)),
    "se3nets_3": ("SE3-Nets, 3 x 3 px (11 x 11 scaled)", se3nets.WEIGHTS, 3, ()),
    "2d": ("2D loss", _2D, None, (1.86, 1.93)),
    "3d": ("3D loss", _3D, None, (1.80, 31.39)),
    "2d_3d": ("2D loss + 3D loss", {**_2D, **_3D}, None, (1.52, 1.78)),
    "full": ("full model", training.WEIGHTS, None, (1.47, 1.63)),
}
NO_MOTION_PAPER = 12.6  # Table II, cm^2
# What the ablation orders, the larger error first, and the SD that Table I gives of each, without and with noise.
ORDER = (("2d_3d", "full"), ("2d", "2d_3d"), ("3d", "2d_3d"))
SD_PAPER = {"2d": (0.46, 0.48), "3d": (0.49, 24.08), "2d_3d": (0.50, 0.64), "full": (0.49, 0.47)}
OPTICAL_PAPER, PEER_PAPER = "0.05", "0.11"  # Table III, px; the peer is FlowNet 2.0

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
    def group(self):
        """What the runs of all seeds have in common, as the figures' names say it."""
        return f"{self.model}_{self.noise}" + ("_long" if self.long else "")

    @property
    def name(self):
        """As its file is called."""
        return f"{self.group}-{self.seed}"


def cells_of_tables(tables, scale):
    """The cells that some tables need, each once; the long runs of the full model are the headlines of all of them."""
    cells = []
    for seed in scale.seeds:  # so that one seed of everything is there first
        cells += [Cell("full", noise, seed, long=True) for noise in NOISES]
        cells += [Cell(model, noise, seed) for noise in NOISES for table in tables for model in TABLES[table]]
    return list(dict.fromkeys(cells))


def recipe_of(cell, scale):
    """The Recipe of a cell."""
    return training.Recipe(steps=scale.long_steps if cell.long else scale.steps, seed=cell.seed,
                           weights=dict(MODELS[cell.model][1]))


def objective_of(cell):
    """The objective of a cell, for `training.train`; that of SE3-Nets takes `se3nets.Supervised` data."""
    noise, window = NOISES[cell.noise], MODELS[cell.model][2]
    if window:
        return partial(se3nets.supervised, window=window, depth_noise=noise)
    return partial(under_noise, standard_deviation=noise) if noise else training.unsupervised


# --- data ------------------------------------------------------------------------------------------------------

# Also of the shipped checkpoint's pokes. A task of this seed would share its random numbers with a training shard, and
# so its objects: no scene of the control experiment has it.
TRAIN_SEED = 5
CROWDED = Settings(objects_min=6)

# name -> (seed, settings, times how many pokes, what `tests_table` says). All models meet the first one, the long runs
# without noise the others too.
TESTS = {
    "test": (101, Settings(**MIDDLE), 1, "3 or 4 objects in the middle"),
    "unseen": (102, Settings(**{**MIDDLE, **HELD_OUT}), 4, "the same, of kinds and textures never trained on"),
    "known": (103, Settings(**MIDDLE), 4, "the same, of known ones, to compare with"),
    "all_over": (104, Settings(), 1, "3 to 7 objects all over the arena, as trained on"),
    "crowded": (105, CROWDED, 1, "6 or 7 objects all over the arena"),
}


def collect_data(out, scale, map=map, progress=None):
    """Training pokes and those of TESTS; completes what is there."""
    collect(out / "train", scale.train_pokes, TRAIN_SEED, Settings(), map, progress)
    for name, (seed, settings, times, _) in TESTS.items():
        collect(out / name, times * scale.test_pokes, seed, settings, map, progress)


@lru_cache(maxsize=2)
def _data(folder, read=load_interactions):
    return se3nets.Supervised(read(folder), load_truth(folder))


# --- one cell ----------------------------------------------------------------------------------------------------

@lru_cache
def commit():
    """The commit of the package, "-dirty" where files differ from it; None outside a checkout or without git."""
    try:
        return subprocess.run(["git", "describe", "--always", "--dirty", "--abbrev=12"], cwd=Path(__file__).parent,
                              capture_output=True, text=True, check=True).stdout.strip()
    except (FileNotFoundError, subprocess.CalledProcessError):
        return None


def once(path, made, compute):
    """The figures in a file; where there is none, those that compute() returns, kept there with what they are made of.

    made: plain JSON types. Raises ValueError for figures that were made of something else.
    """
    if not path.exists():
        began_at = commit()
        write_json(path, {**made, "metrics": compute(), "commit": began_at})
    found = read_json(path)
    if "metrics" not in found or not made_of(found, made):
        raise ValueError(f"{path}: made with another recipe, network, data or search; remove it, or choose another "
                         "--out")
    return found["metrics"]


def made_of(found, made):
    """Whether the figures of a file, as `once` wrote it, were made of this."""
    return all(found.get(name) == value for name, value in made.items())


def ingredients(cell, scale):
    """All that decides the figures of a cell, in plain JSON types, as `once` keeps it."""
    data = {"train": (TRAIN_SEED, Settings().plain, scale.train_pokes),
            **{name: (seed, settings.plain, times * scale.test_pokes)
               for name, (seed, settings, times, _) in TESTS.items()}}
    return plain({"recipe": asdict(recipe_of(cell, scale)), "window": MODELS[cell.model][2],
                  "depth_noise": NOISES[cell.noise], "format": checkpoints.FORMAT, "data": data})


def run_cell(cell, out, scale, save_every=60.0):
    """Train and evaluate one cell, from where it was -> its metrics, with train_seconds. Runs in a worker process.

    `python docs/results.py keep` collects the files of what is finished.
    """
    path, recipe, noise = out / "cells" / f"{cell.name}.npz", recipe_of(cell, scale), NOISES[cell.noise]
    window = MODELS[cell.model][2]

    def compute():
        data = _data(out / "train", stream_interactions)
        run = checkpoints.load_run(path) if path.exists() else training.start_run(recipe, data.interactions)
        if run.recipe != recipe:
            raise ValueError(f"{path}: made with another recipe; remove it, or choose another --out")
        run.meta["depth_noise"] = noise
        train_saving(data if window else data.interactions, run, path, objective_of(cell), save_every=save_every)
        metrics = evaluation.evaluate(run, **vars(_data(out / "test")), depth_noise=noise)
        if cell.long and not noise:
            for test in list(TESTS)[1:]:
                found = evaluation.evaluate(run, **vars(_data(out / test)))
                metrics.update({f"{test}_{name}": value for name, value in found.items()})
        return {**metrics, "train_seconds": run.meta["seconds"]}

    return once(path.with_suffix(".json"), ingredients(cell, scale), compute)


# --- all of them ------------------------------------------------------------------------------------------------

def reproduce(tables, out, scale, map=map, progress=None):
    """Everything that some tables need -> flat dict of figures. map: as of `collect`; cells run side by side with that
    of an executor, one core each.
    """
    collect_data(out, scale, map, progress)
    cells, results = cells_of_tables(tables, scale), {}
    for cell, metrics in zip(cells, map(partial(run_cell, out=out, scale=scale), cells)):
        results[cell] = metrics
        print(f"{len(results)} of {len(cells)}: {cell.group}, seed {cell.seed}: ratio {metrics['flow_mse_ratio']:.3f}, "
              f"{metrics['train_seconds'] / 60:.1f} min", flush=True)
    figures = summarise(results, scale)
    if "optical-flow" in tables:
        figures.update(image_pairs.evaluate_image_pairs(**vars(_data(out / "test"))))
    return figures


def summarise(results, scale):
    """{Cell: metrics} -> mean and SD over the seeds of every metric, and the scale: a flat dict.

    worse_less_better_noise of ORDER: by how much the ratios of the same seed differ, the mean; _ci95: half of its 95 %
    interval, by Student's t.
    """
    figures, groups = asdict(scale), {}
    for cell, metrics in results.items():
        groups.setdefault(cell.group, []).append(metrics)
    for group, seeds in groups.items():
        for metric in seeds[0]:
            values = [metrics[metric] for metrics in seeds]
            figures[f"{group}_{metric}"] = float(np.mean(values))
            figures[f"{group}_{metric}_sd"] = float(np.std(values, ddof=1))
    for (worse, better), noise in product(ORDER, NOISES):
        ours = [[metrics["flow_mse_ratio"] for metrics in groups.get(f"{model}_{noise}", [])]
                for model in (worse, better)]
        if all(ours):
            less, name = np.subtract(*ours), f"{worse}_less_{better}_{noise}"
            figures[name] = float(less.mean())
            figures[f"{name}_ci95"] = float(stdtrit(len(less) - 1, 0.975) * less.std(ddof=1) / np.sqrt(len(less)))
    return figures


# --- tables ------------------------------------------------------------------------------------------------------

def table(*rows):
    """Rows of texts as Markdown; the first is the head."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def mean_and_sd(figures, key, form="{:.2f}"):
    """The text "mean +- SD" of a figure, the mean alone where it has no SD, "" for a figure that is not there."""
    return " \u00b1 ".join(form.format(figures[name]) for name in (key, f"{key}_sd") if name in figures)


def flow_table(figures, name):
    """Table I of the paper, ours beside it: flow MSE, relative to no motion, of every model without and with noise."""
    rows = [("flow MSE / no motion" + (", ablation" if name == "ablation" else ""), "paper, no noise", "ours, no noise",
             "paper, 1 cm noise", "ours, 1 cm noise", "ours, cm^2, no noise", "ours, cm^2, 1 cm noise")]
    for model, long in [(model, "") for model in TABLES[name]] + [("full", "_long")]:
        paper = [f"{value / NO_MOTION_PAPER:.3f}" for value in MODELS[model][3] if not long] or ["", ""]
        ratio, mse = ([mean_and_sd(figures, f"{model}_{noise}{long}_{metric}", form) for noise in NOISES]
                      for metric, form in (("flow_mse_ratio", "{:.3f}"), ("flow_mse_cm2", "{:.2f}")))
        if any(ratio):
            text = MODELS[model][0] + (", trained long" if long else "")
            rows.append((text, paper[0], ratio[0], paper[1], ratio[1], *mse))
    return table(*rows)


def tests_table(figures):
    """The full model, trained long without noise, on each of TESTS: the ratio of all pokes, of those that move two or
    more objects and of those that end at a wall; IoU; direction in degrees.
    """
    rows = [("full model, trained long, no noise", "pokes", "flow MSE / no motion", "two or more move", "at a wall",
             "IoU", "direction, deg")]
    for name, (*_, text) in TESTS.items():
        key = "full_clean_long_" + (f"{name}_" if name != "test" else "")
        if f"{key}pokes" in figures:
            rows.append((text, f"{figures[key + 'pokes']:,.0f}", *(
                mean_and_sd(figures, key + metric, form) for metric, form in (
                    ("flow_mse_ratio", "{:.3f}"), ("multi_flow_mse_ratio", "{:.3f}"),
                    ("wall_flow_mse_ratio", "{:.3f}"), ("mask_iou", "{:.2f}"), ("inverse_direction_deg", "{:.1f}")))))
    return table(*rows)


def order_table(figures):
    """How sure the order of the ablation is: differences within a seed, ours with their interval, and the paper's."""
    rows = [("difference of flow MSE / no motion", "noise", "paper", "the paper's SDs", "ours, 95 % interval")]
    for (worse, better), (i, noise) in product(ORDER, enumerate(NOISES)):
        name, paper = f"{worse}_less_{better}_{noise}", MODELS[worse][3][i] - MODELS[better][3][i]
        if name in figures:
            rows.append((f"{MODELS[worse][0]} less {MODELS[better][0]}", noise, f"{paper / NO_MOTION_PAPER:.3f}",
                         ", ".join(f"{SD_PAPER[model][i] / NO_MOTION_PAPER:.3f}" for model in (worse, better)),
                         f"{figures[name]:.3f} \u00b1 {figures[name + '_ci95']:.3f}"))
    return table(*rows)


def optical_table(figures):
    """Table III of the paper, ours beside it."""
    rows = [("optical flow, end-point error", "sees", "paper", "moving pixels, px", "all pixels, px")]
    for key, *texts in (*((peer, f"{peer} (FlowNet 2.0 in the paper)", "both pictures", PEER_PAPER)
                          for peer in image_pairs.PEERS),
                        ("full_clean_long", "full model, trained long", "depth and poke", OPTICAL_PAPER),
                        ("full_clean_long_no_motion", "no motion", "", "")):
        rows.append((*texts, mean_and_sd(figures, f"{key}_optical_epe_px"),
                     mean_and_sd(figures, f"{key}_optical_epe_all_px", "{:.4f}")))
    return table(*rows)


def tables_text(tables, figures):
    """The asked-for tables as Markdown."""
    made = {"flow": [partial(flow_table, name="flow"), tests_table],
            "ablation": [partial(flow_table, name="ablation"), order_table], "optical-flow": [optical_table]}
    texts = [make(figures) for name in tables for make in made[name]]
    return "\n\n".join(text for text in texts if text.count("\n") > 1)  # not those without a row


# --- planning (Sec. IV-G) -----------------------------------------------------------------------------------------

# name -> (what the table says, control.POLICIES, what its search changes, the most pokes that it plans in a row). The
# simulator would take a minute for three, 10,000 pokes.
PLANNERS = {
    "learned": ("learned model, up to three pokes ahead", "learned", {}, control.AHEAD),
    "one_poke": ("learned model, one poke ahead", "learned", {}, 1),
    "pixels": ("learned model, pixel distance alone", "learned", {"chamfer_weight": 0.0}, control.AHEAD),
    "chamfer": ("learned model, Chamfer distance alone", "learned", {"pixel_weight": 0.0}, control.AHEAD),
    "oracle": ("the simulator as the model, one poke ahead", "oracle", {}, 1),
    "random": ("random pokes", "random", {}, 1),
    "no_motion": ("model of no motion", "no_motion", {}, 1),
}
OBJECTS, POKES = (1, 2, 3), 10
OBSTACLE_SCENES, OBSTACLE_TRIES = 3, 5
AVOIDED = 0.01  # m; an obstacle that was moved by less was avoided


def run_scene(checkpoint, out, planner, movers, seed, attempt=0):
    """One closed loop -> its `outcome`, or that of when it was run before. Runs in a worker process.

    planner: of PLANNERS, or "greedy"; movers 0: an obstacle scene. attempt: another one has other random numbers.
    """
    _, policy, changes, ahead = PLANNERS.get(planner, ("", planner, {}, 1))
    run, search = checkpoints.load_run(checkpoint), planning.Search(**changes)

    def compute():
        with control.random_task(seed, max(movers, 1), movers == 0, control.settings_for(run)) as task:
            return outcome(control.closed_loop(task, run, policy, search, POKES, [seed, attempt], ahead))

    return once(out / "scenes" / f"{planner}-{movers}-{seed}-{attempt}.json", plain({
        "vector": float(np.abs(run.vector).sum()),  # which checkpoint
        "search": asdict(search), "pokes": POKES, "settings": control.settings_for(run).plain,
        "loop": [control.GAIN, control.NEAR, control.SLOW, ahead, control.TRIES, control.CLEAR, control.PASSES,
                 control.STAYS, control.KEEP_OFF]}), compute)


def outcome(record):
    """What the tables need of a record of `control.closed_loop` -> dict. distance_m (POKES + 1): mean over the movers
    after every poke; others_shifted_m: the farthest that any other object was moved from its place; angles_deg: of
    movers that are not round, at first and at last; stopped: why it ended.
    """
    distance, angles = record["distance"].mean(axis=1), record["angle"][[0, -1]]
    others = np.delete(record["poses"][..., :2], record["movers"], axis=1)
    return {"distance_m": np.pad(distance, (0, POKES + 1 - len(distance)), "edge").tolist(),  # it stopped: all stays
            "others_shifted_m": float(np.linalg.norm(others - others[0], axis=2).max()),
            "angles_deg": np.degrees(angles[:, np.isfinite(angles[0])]).tolist(), "stopped": record["stopped"]}


def reproduce_planning(out, checkpoint, scenes=20, map=map, planners=tuple(PLANNERS)):
    """The paper's control experiment -> flat dict of figures, curves {(planner, objects): (scenes, pokes + 1) m}.

    planners: which of PLANNERS; the obstacle is for all of them. Scenes that were run before, with the same checkpoint
    and planners, are not run again.
    """
    seeds = [seed for seed in range(scenes + 1) if seed != TRAIN_SEED][:scenes]
    todo = [*product(planners, OBJECTS, seeds, [0]),
            *product(("learned", "greedy"), [0], range(OBSTACLE_SCENES), range(OBSTACLE_TRIES))]
    return summarise_planning(dict(zip(todo, map(partial(run_scene, checkpoint, out), *zip(*todo)))))


def summarise_planning(results):
    """{(planner, movers, seed, attempt): outcome} -> flat dict of figures (distance left after all pokes, relative to
    the start; orientation; obstacles), curves as of `reproduce_planning`. plan_over_oracle: the mean distance left with
    the learned model over that with the simulator, both one poke ahead.
    """
    def of(planner, movers):
        return [each for key, each in results.items() if key[:2] == (planner, movers)]

    figures, curves = {}, {}
    for planner, movers in product([name for name in PLANNERS if of(name, OBJECTS[0])], OBJECTS):
        curve = curves[planner, movers] = np.array([each["distance_m"] for each in of(planner, movers)])
        left = curve[:, -1] / curve[:, 0]
        found = {"left": curve[:, -1].mean() / curve[:, 0].mean(), "left_sd": left.std(ddof=1), "worst": left.max()}
        start, end = (np.concatenate([each["angles_deg"][i] for each in of(planner, movers)]) for i in (0, 1))
        if len(start):
            found.update(angle_start_deg=np.median(start), angle_deg=np.median(end))
        figures.update({f"{planner}_{movers}_{name}": float(value) for name, value in found.items()})
    if {("one_poke", 1), ("oracle", 1)} <= set(curves):
        ours, oracle = (sum(curves[planner, movers][:, -1].mean() for movers in OBJECTS)
                        for planner in ("one_poke", "oracle"))
        figures["plan_over_oracle"] = float(ours / oracle)
    if ("learned", 1) in curves:
        figures["plan_worst_scene"] = max(figures[f"learned_{movers}_worst"] for movers in OBJECTS)
    for planner in ("learned", "greedy"):
        shifts = np.array([each["others_shifted_m"] for each in of(planner, 0)])
        figures[f"{planner}_obstacle_avoided"] = float(np.mean(shifts < AVOIDED))
        figures[f"{planner}_obstacle_shift_cm"] = float(100 * np.mean(shifts))
    return figures, curves


def planning_table(figures):
    """The control experiment as Markdown: distance left relative to the start, and median orientation error."""
    rows = [["planner"]]
    for movers in OBJECTS:
        rows[0] += [f"{movers} object{'s' * (movers > 1)}: distance left", "turned wrong by, start -> end"]
    for planner, (text, *_) in PLANNERS.items():
        if f"{planner}_{OBJECTS[0]}_left" not in figures:
            continue
        rows.append([text])
        for movers in OBJECTS:
            start, end = (figures.get(f"{planner}_{movers}_{name}") for name in ("angle_start_deg", "angle_deg"))
            rows[-1] += [mean_and_sd(figures, f"{planner}_{movers}_left"),
                         "" if end is None else f"{start:.0f}\u00b0 -> {end:.0f}\u00b0"]
    return table(*rows)
