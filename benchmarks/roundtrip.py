"""What a recording loses: simulated pokes at camera size, exported, imported, and evaluated before and after.

    python benchmarks/roundtrip.py --json docs/results/roundtrip.json

roundtrip_mm: how far a point of the imported clouds is, at most, from the one that the simulator saw, at full size.
roundtrip_pose_mm: the same where the pose was not told but found in the empty picture; the arena's origin, which nobody
can see, is put where it was. roundtrip_flow_mse_ratio_*: what the shipped model has on them as simulated, imported at
full size, and at the size that it was trained with. With --sizes, imported at more sizes, the smallest of them with
pixels twice as wide as those of the training: what coarse pixels cost.
Ten minutes for 100 pokes at 640 x 480, most of them Bullet's.
"""
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from race import DATA, parser_of

from hind4sight_min.disk.checkpoints import load_run
from hind4sight_min.disk.files import write_json
from hind4sight_min.disk.recordings import CAMERA, save_recording
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.geometry import unproject
from hind4sight_min.lab.cameras import import_recording
from hind4sight_min.lab.evaluation import evaluate
from hind4sight_min.sim.arena import Settings
from hind4sight_min.sim.collection import collect_shard


def largest_gap(made, found, shift=0.0):
    """The largest distance, mm, between points of two records where either has depth; shift (3,) m: of the second's."""
    gaps = [0.0]
    for name in ("depth_before", "depth_after"):
        for one, other in zip(getattr(made, name), getattr(found, name)):
            points, others = (unproject(depth.astype(float), record.camera)
                              for depth, record in ((one, made), (other, found)))
            gaps.append(np.linalg.norm(points - others - shift, axis=2)[(one > 0) | (other > 0)].max())
    return 1e3 * max(gaps)


def truth_at(truth, size):
    """The Truth with labels of pictures of `size` (W, H): each block's most frequent one."""
    def shares(labels):
        return [cv2.resize(np.float32(labels == label), size, interpolation=cv2.INTER_AREA) for label in range(8)]
    return replace(truth, labels=np.stack([np.argmax(shares(each), axis=0) for each in truth.labels]).astype(np.uint8))


def main():
    parser = parser_of(__doc__, rounds=1)
    parser.add_argument("--pokes", type=int, default=100)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("W", "H"))
    parser.add_argument("--sizes", type=int, nargs="*", default=(), metavar="W", help="widths to import at too")
    args = parser.parse_args()
    run, figures = load_run(DATA / "checkpoint.npz"), {}
    made, truth = collect_shard(Settings(width=args.size[0], height=args.size[1]), 2, 0, args.pokes)

    def note(name, value):
        figures[name] = value
        print(f"{name}: {value:.4f}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        save_recording(folder / "recording", [made])
        import_recording(folder / "recording", folder / "same", args.size)
        found = load_interactions(folder / "same")
        note("roundtrip_mm", largest_gap(made, found))
        note("roundtrip_flow_mse_ratio_simulated", evaluate(run, made, truth)["flow_mse_ratio"])
        note("roundtrip_flow_mse_ratio_imported", evaluate(run, found, truth)["flow_mse_ratio"])
        for width in (64, *args.sizes):
            size = width, width * 3 // 4
            import_recording(folder / "recording", folder / str(width), size)
            metrics = evaluate(run, load_interactions(folder / str(width)), truth_at(truth, size))
            note(f"roundtrip_flow_mse_ratio_{width}", metrics["flow_mse_ratio"])
            note(f"roundtrip_mask_iou_{width}", metrics["mask_iou"])
        told = json.loads((folder / "recording" / CAMERA).read_text())
        write_json(folder / "recording" / CAMERA, {**told, "arena_from_camera": None})
        import_recording(folder / "recording", folder / "pose", args.size)
        found = load_interactions(folder / "pose")
        middle = unproject(found.empty_depth.astype(float), found.camera) - unproject(
            made.empty_depth.astype(float), made.camera)
        note("roundtrip_pose_mm", largest_gap(made, found, -np.append(np.median(middle[..., :2], axis=(0, 1)), 0)))
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
