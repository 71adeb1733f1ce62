"""What each thing that is not in the paper brings: the model trained without it, one at a time.

    python benchmarks/leave_one_out.py TRAIN FRESH OUT [--steps 3000] [--seeds 1 2] [--only NAME ...]
    python benchmarks/leave_one_out.py --table OUT [--json FIGURES]

TRAIN, FRESH: folders of `hind4sight collect` (for the table of docs/not-in-the-paper.md 24,000 pokes of seed 5 and
1,000 of seed 900101). Every variant is a change of the source, made in a copy of the package, trained and evaluated in
a process of its own, on one core: four minutes each. Finished ones are kept in OUT and not run again, so it can be
stopped and started again.
"""
import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from hind4sight_min.disk.files import write_json

PACKAGE = Path(__file__).resolve().parent.parent / "hind4sight_min"

# name -> ([(file, text, what takes its place)], Recipe's arguments, SD of depth noise in m)
VARIANTS = {
    "full": ([], {}, 0.0),
    "Adam instead of Muon": ([], {"optimiser": "adam", "learning_rate": 2e-3}, 0.0),
    "no tanh(z / 1 cm)": ([("networks.py", "anp.tanh(up / 0.01)", "0 * up")], {}, 0.0),
    "everything compared, not what both frames show": (
        [("losses.py", "return valid & (occupied | ~next_occupied), next_valid & (next_occupied | ~occupied)",
          "return valid, next_valid")], {}, 0.0),
    "inverse model: every 24th point, not the most changed": (
        [("scene.py", "rows = np.argsort(-change, axis=1, kind=\"stable\")[:, :count]",
          "rows = np.tile(np.arange(0, change.shape[1], change.shape[1] // count)[:count], (len(change), 1))")],
        {}, 0.0),
    "ReLU, not leaky": ([("ops.py", "LEAK = np.float32(0.1)", "LEAK = np.float32(0.0)")], {}, 0.0),
    "no image noise": ([], {"image_noise": 0.0}, 0.0),
    "no height map": ([("networks.py", "return (total / (count + 0.2) / 0.03)", "return (0 * total)")], {}, 0.0),
    "no walls in the height map": ([("networks.py", " + wall_map(pokes, arena)", "")], {}, 0.0),
    "no pooling where the finger first meets something": (
        [("networks.py", "weights = met * central", "weights = 0 * central")], {}, 0.0),
    "looks at all points of the box": ([("scene.py", "scene.valid & scene.stands_out & away", "scene.valid & away")],
                                       {}, 0.0),
    "mask logits unbounded": ([("networks.py", "MASK_BOUND = 6.0", "MASK_BOUND = 1e3")], {}, 0.0),
    "no price on half masks": ([("training.py", '"binary_masks": 0.5', '"binary_masks": 0.0')], {}, 0.0),
    "motions in units of 5 cm and 1 rad": (
        [("networks.py", "np.array([0.005] * 3 + [0.1] * 3", "np.array([0.05] * 3 + [1.0] * 3")], {}, 0.0),
    "gradient of L_sim to the encoder too": (
        [("networks.py", "encode({name: getval(value) for name, value in params.items()}, points)",
          "encode(params, points)")], {}, 0.0),
    "K = 4": ([("networks.py", "masks: int = 3", "masks: int = 4")], {}, 0.0),
    "full, 1 cm noise": ([], {}, 0.01),
    "1 cm noise, depth not smoothed": (
        [("lab/noise.py", "smooth_depth(depth, interactions", "(lambda depth, *_: depth)(depth, interactions")],
        {}, 0.01),
}

WORK = """
import json, sys, time
from functools import partial
from hind4sight_min import interactions, training
from hind4sight_min.disk import shards
from hind4sight_min.lab import evaluation, noise
from hind4sight_min.sim.truth import load_truth
train, fresh, out, recipe, noise_sd = json.loads(sys.argv[1])
data = shards.load_interactions(train)
run, start = training.start_run(training.Recipe(**recipe), data), time.process_time()
objective = partial(noise.under_noise, standard_deviation=noise_sd) if noise_sd else training.unsupervised
training.train(data, run, objective)
seconds = time.process_time() - start
found = evaluation.evaluate(run, shards.load_interactions(fresh), load_truth(fresh), depth_noise=noise_sd)
open(out, "w").write(json.dumps({**found, "train_cpu_seconds": seconds}))
"""


def run_variant(name, seed, steps, train, fresh, out):
    """Train and evaluate one variant, unless OUT has it."""
    changes, recipe, noise = VARIANTS[name]
    path = out / f"{name.replace(' ', '_').replace('/', 'per')}-{seed}-{steps}.json"
    if path.exists():
        return
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(PACKAGE, Path(folder) / "hind4sight_min")
        for file, text, instead in changes:
            source = Path(folder) / "hind4sight_min" / file
            if source.read_text().count(text) != 1:
                raise ValueError(f"{name}: expected once in {file}: {text}")
            source.write_text(source.read_text().replace(text, instead))
        arguments = json.dumps([str(train), str(fresh), str(path) + ".part",
                                {"steps": steps, "seed": seed, **recipe}, noise])
        subprocess.run([sys.executable, "-c", WORK, arguments], check=True, cwd=folder,
                       env={**os.environ, "PYTHONPATH": folder})
    os.replace(str(path) + ".part", path)
    found = json.loads(path.read_text())
    print(f"{name}, seed {seed}: ratio {found['flow_mse_ratio']:.4f}, IoU {found['mask_iou']:.3f}", flush=True)


COLUMNS = (("flow_mse_ratio", "ratio", ".3f"), ("mask_iou", "IoU", ".2f"), ("still_epe_cm", "still, cm", ".4f"),
           ("multi_flow_mse_ratio", "two or more move", ".2f"), ("inverse_direction_deg", "direction", ".1f"),
           ("train_cpu_seconds", "CPU s", ".0f"))


def table(out):
    """What OUT holds, as Markdown: each seed's figures."""
    lines = ["| left out or changed | " + " | ".join(text for _, text, _ in COLUMNS) + " |",
             "|---|" + "---|" * len(COLUMNS)]
    for name in VARIANTS:
        found = [json.loads(path.read_text()) for path in
                 sorted(out.glob(f"{name.replace(' ', '_').replace('/', 'per')}-*.json"))]
        if found:
            cells = [", ".join(format(each[key], form) for each in found) if key != "train_cpu_seconds"
                     else format(statistics.mean(each[key] for each in found), form) for key, _, form in COLUMNS]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, metavar="TRAIN FRESH OUT")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--table", type=Path, metavar="OUT", help="train nothing; show what is finished")
    parser.add_argument("--json")
    args = parser.parse_args()
    if args.table:
        print(table(args.table))
        runs = {path.stem: json.loads(path.read_text()) for path in sorted(args.table.glob("*.json"))}
        return write_json(args.json, {"table": table(args.table), "runs": runs})
    if len(args.folders) != 3:
        parser.error("expected three folders: TRAIN FRESH OUT")
    train, fresh, out = (folder.resolve() for folder in args.folders)
    out.mkdir(parents=True, exist_ok=True)
    for seed in args.seeds:
        for name in args.only:
            run_variant(name, seed, args.steps, train, fresh, out)


if __name__ == "__main__":
    main()
