"""A model under each fault of a real camera: what `hind4sight evaluate` says, as one table.

    python benchmarks/camera_faults.py [DATA] [--checkpoint FILE] [--jobs 2] [--json docs/results/camera.json]

Without arguments the shipped camera checkpoint on the shipped test pokes; a second or two per hundred pokes and fault.
All pictures are prepared first (`lab.camera_faults.prepared`): filled, smoothed, the pose corrected by the empty arena,
but not those without faults for a checkpoint that was not trained for cameras. Moving points without depth count.
"""
from hind4sight_min.lab.processes import parallel_map  # before NumPy: it sets the number of BLAS threads

import argparse
from functools import partial

from race import DATA

from hind4sight_min.disk.checkpoints import load_run
from hind4sight_min.disk.files import write_json
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab.camera_faults import TRAINED
from hind4sight_min.lab.evaluation import evaluate
from hind4sight_min.sim.truth import load_truth

LEVELLED = "known from the table alone"
ROWS = {  # name -> what it is, its faults
    "clean": ("no fault", {}),
    "noisy": ("1 cm of depth noise", {"depth_noise": 0.01}),
    "missing30": ("30 % of the depth missing at random", {"missing": (0.3,)}),
    "shadow": ("rims and shadows missing on one side", {"missing": ("rims", "shadow")}),
    "pitch1": ("pitch wrong by 1 degree", {"pitch_error": 1.0}),
    "shift1": ("pose wrong by 1 cm", {"pose_error": (0.0, 0.01)}),
    "shift1_table": (f"the same, {LEVELLED}", {"pose_error": (0.0, 0.01)}),
    "pose_table": (f"pose wrong by 1 cm and 1 degree, {LEVELLED}", {"pose_error": (1.0, 0.01)}),
    "all": ("noise, all that is missing, pose wrong by 1 cm and 1 degree",
            {name: value for name, (value, _) in TRAINED.items()}),
}
METRICS = {"flow_mse_ratio": ("ratio", "{:.3f}"), "mask_iou": ("IoU", "{:.2f}"),
           "inverse_direction_deg": ("direction, deg", "{:.1f}"), "inverse_target_cm": ("target, cm", "{:.2f}"),
           "still_epe_cm": ("still, cm", "{:.4f}")}


def measure(checkpoint, folder, row):
    """The METRICS of one of ROWS -> dict."""
    interactions, (text, faults) = load_interactions(folder), ROWS[row]
    if LEVELLED in text:
        interactions.settings.pop("wall_height")
    found = evaluate(load_run(checkpoint), interactions, load_truth(folder), **faults)
    return {name: found[name] for name in METRICS}


def line_of(*cells):
    return f"| {' | '.join(cells)} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", default=DATA / "test")
    parser.add_argument("--checkpoint", default=DATA / "camera_checkpoint.npz")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", metavar="FILE", help="write the figures here too")
    args, figures = parser.parse_args(), {}
    table = [line_of("fault", *(text for text, _ in METRICS.values())), "|---" * (1 + len(METRICS)) + "|"]
    print(*table, sep="\n", flush=True)
    with parallel_map(args.jobs) as map:
        for (row, (text, _)), found in zip(ROWS.items(), map(partial(measure, args.checkpoint, args.data), ROWS)):
            table.append(line_of(text, *(form.format(found[name]) for name, (_, form) in METRICS.items())))
            print(table[-1], flush=True)
            figures.update({f"camera_{row}_{name}": value for name, value in found.items()})
    write_json(args.json, {**figures, "table": "\n".join(table)})


if __name__ == "__main__":
    main()
