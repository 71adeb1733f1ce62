"""Would the tests notice? Eighty mistakes of the kind that students and careless edits make, planted one at a time.

    python benchmarks/planted_faults.py [--jobs 1] [--only WORD ...] [--json FILE]

Every fault is a change of the source, made in a copy of the tree, and the tests that matter run there in a process of
their own: caught, and by which test, or SURVIVED. WORD: of the fault's name or file. A survivor has a comment beside it
that says why.
"""
import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
TIME_OUT = 300  # s; a fault that makes the tests hang is caught


class Fault(NamedTuple):
    """In a file of the package, `text`, which occurs there once, becomes `instead`; tests: the files that matter."""
    name: str
    file: str
    text: str
    instead: str
    tests: str


# file, the tests that matter, and its faults: name, text, what takes its place
PLANTED = (
    ("__init__.py", "planning", [
        ("the least number that is allowed is refused", "least <= value <= most:", "least < value <= most:")]),

    ("geometry.py", "geometry eq1_transform", [
        ("principal point in the picture's middle", "np.arange(camera.width) - camera.cx",
         "np.arange(camera.width) - camera.width / 2"),
        ("fx for both axes", "np.array([camera.fx, camera.fy], points_camera.dtype)",
         "np.array([camera.fx, camera.fx], points_camera.dtype)"),
        ("rotations transposed", "anp.swapaxes(rotations, 2, 3)", "rotations"),
        ("turned into the poke's frame before it is shifted", "np.matmul(points - origins[:, None], axes)",
         "np.matmul(points, axes) - origins[:, None]")]),

    ("ops.py", "ops eq3_photometric", [
        ("a query sits on a reference that does not count", "found = valid & np.logical_and", "found = np.logical_and"),
        ("number among the valid references taken for that among all",
         "rows[tree.query(q[i, asked], workers=threads)[1]]", "tree.query(q[i, asked], workers=threads)[1]"),
        ("a slope across the picture's border", "(along >= 0) & (along <= size - 1)", "True"),
        ("the leak's kink at the wrong place under a residual", "ans > (x if residual else 0)", "ans > 0"),
        ("an invalid point that ties gets a maximum's gradient", "((x == ans[:, None]) & valid[..., None])",
         "(x == ans[:, None])")]),

    ("losses.py", "eq2_chamfer eq3_photometric", [
        ("covered and uncovered table swapped",
         "valid & (occupied | ~next_occupied), next_valid & (next_occupied | ~occupied)",
         "valid & (next_occupied | ~occupied), next_valid & (occupied | ~next_occupied)"),
        ("the other frame's mask on a distance map",
         "nearest_squared_distances(predicted, observed, valid_observed) * valid_predicted",
         "nearest_squared_distances(predicted, observed, valid_observed) * valid_observed"),
        ("Chamfer: mean, not sum", "anp.sum(map_predicted + map_observed", "anp.mean(map_predicted + map_observed"),
        ("warped along minus the flow", "flow + _pixel_grid(height, width, getval(flow).dtype.type)",
         "_pixel_grid(height, width, getval(flow).dtype.type) - flow"),
        ("pixels out of view cost", "np.reshape(valid, in_view.shape) & in_view", "np.reshape(valid, in_view.shape)")]),
    ("losses.py", "eq4_flow_smoothness eq5_distance_smoothness", [
        ("a step counts where one neighbour has depth", "(valid[:, 1:] & valid[:, :-1])",
         "(valid[:, 1:] | valid[:, :-1])"),
        ("I_t for both distance maps", "anp.reshape(map_observed, grid), next_images",
         "anp.reshape(map_observed, grid), images")]),
    ("losses.py", "inverse_loss eq6_full_loss", [
        ("the end's heat-map with the start's cell", "heatmap_cross_entropy(end_logits, end_cells)",
         "heatmap_cross_entropy(end_logits, start_cells)"),
        ("mean over the terms, not the batch", "float(len(total))", "float(len(terms))")]),

    ("interactions.py", "interactions", [
        ("cells column by column", "row * columns + column", "column * rows + row"),
        ("the finger comes down in a wall", '< settings["arena"] / 2 - settings["finger_radius"]',
         '< settings["arena"] / 2')]),

    ("scene.py", "scene", [
        ("pixels without depth are objects", "near = (depth > 0) & (empty_depth > 0)", "near = (empty_depth > 0)"),
        ("the rim of an object is a pixel, whatever its size", "max(1, round(RIM / camera.pixel_size))", "1"),
        ("the model looks at points without depth", "scene.valid & scene.stands_out & away", "scene.stands_out & away"),
        ("what one frame does not show has changed", "** 2 * (before.valid & after.valid)", "** 2")]),

    ("networks.py", "networks", [
        ("masks start as movers", 'params["mask_b"] -= 1', 'params["mask_b"] += 1'),
        ("the finger meets what lies behind its start", "& (x > -0.16) & (depth > 0)", "& (depth > 0)"),
        ("motions turned back the wrong way", "np.swapaxes(axes, 1, 2))\n    return", "axes)\n    return"),
        ("the finger is flat in front", "FINGER * central - x", "FINGER - x"),
        ("what only fills a row up moves", "masks = counts * masks + (1 - counts) * background", "masks = 1.0 * masks"),
        ("L_sim trains the encoder that compares",
         "encode({name: getval(value) for name, value in params.items()}, points)", "encode(params, points)"),
        ("the inverse model's two maps swapped", "take(logits, (..., 0)), take(logits, (..., 1))",
         "take(logits, (..., 1)), take(logits, (..., 0))")]),

    ("training.py", "training", [
        ("L_sim counts what only fills a row up", "before.occupied[rows] & seen", "before.occupied[rows]"),
        ("the poke's part of the picture gives its target away", "(*most_changed(before, after),",
         "(*most_changed(crop(before, pokes, camera), crop(after, pokes, camera)),"),
        ("all images of a batch share their noise", "rng.standard_normal(before.images.shape, np.float32)",
         "rng.standard_normal(before.images.shape[1:], np.float32)"),
        ("covered pixels count in Eq. 3", "photometric_loss(before.images, after.images, flow, valid)",
         "photometric_loss(before.images, after.images, flow, before.valid)"),
        ("every seed starts from the same weights", "np.random.default_rng(recipe.seed)", "np.random.default_rng(0)"),
        ("every seed has the same order of pokes", "[recipe.seed, 1, epoch]", "[1, epoch]"),
        ("the same noise at every step", "[recipe.seed, 2, run.step, i]", "[recipe.seed, 2, i]"),
        ("chunks added up, not averaged", "share = {}, len(interactions) / recipe.batch", "share = {}, 1.0"),
        ("the learning rate of the next step", "learning_rate(recipe, run.step)",
         "learning_rate(recipe, run.step + 1)")]),

    ("planning.py", "planning", [
        ("targets in one quarter of their cell", "rng.uniform(-0.5, 0.5, cells.shape)",
         "rng.uniform(0, 0.5, cells.shape)"),
        ("room for the finger is sought in the first scene", "possible_starts(pokes, occupied_grid(clouds, view",
         "possible_starts(pokes, occupied_grid(0 * clouds + view.cloud, view"),
        ("Chamfer of the scene one way", "np.mean(there ** 2) + np.mean(back ** 2)", "2 * np.mean(there ** 2)"),
        ("the spread collapses", "np.maximum(np.sqrt((away ** 2).mean(axis=0)), LEAST)",
         "np.sqrt((away ** 2).mean(axis=0))"),
        ("elites of infinite cost are kept", "order[:search.elites] if costs[j] < np.inf", "order[:search.elites]"),
        ("directions leave the circle", "population[..., 2] = wrapped(population[..., 2])", "pass"),
        ("a cheap sequence that no finger can start is planned",
         "np.where(np.isnan(starts).any(axis=(1, 2)), np.inf, found)", "found")]),

    ("disk/files.py", "files", [
        ("a half-written file stays behind", "temporary.unlink(missing_ok=True)", "pass"),
        ("files may run code", "allow_pickle=False", "allow_pickle=True")]),
    ("disk/shards.py", "interactions", [
        ("depth cut off, not rounded", "np.round(depth / DEPTH_UNIT)", "np.floor(depth / DEPTH_UNIT)")]),
    ("disk/checkpoints.py", "training", [
        ("a resumed run forgets its moments", "arrays.get(name, np.zeros(size, np.float32))",
         "np.zeros(size, np.float32)")]),

    ("sim/objects.py", "sim_objects", [
        ("the parts of an object weigh the same", "np.average(centroids, axis=0, weights=areas)",
         "np.mean(centroids, axis=0)")]),
    ("sim/arena.py", "sim_arena sim_collection", [
        ("pictures half a pixel off", "fine * c.cx + (fine - 1) / 2", "fine * c.cx"),
        ("one object at rest is enough", "if all(np.abs(self.bullet.getBaseVelocity",
         "if any(np.abs(self.bullet.getBaseVelocity"),
        ("a poke's direction by arctan2(dx, dy)", "np.arctan2(dy, dx)", "np.arctan2(dx, dy)")]),
    ("sim/collection.py", "sim_collection", [
        ("the labels of the second picture", "rgb_after, depth_after, _, poses_after",
         "rgb_after, depth_after, labels, poses_after")]),
    ("sim/truth.py", "sim_truth", [("R_b for its transpose", "(before[3:]).inv()", "(before[3:])")]),

    ("lab/noise.py", "noise", [
        ("one noise for all pictures", "rng.standard_normal(depth.shape)", "rng.standard_normal(depth.shape[-2:])"),
        ("the same noise before and after, at every step",
         'add_depth_noise(depth, rng, standard_deviation)',
         'add_depth_noise(depth, np.random.default_rng(0), standard_deviation)')]),
    ("lab/se3nets.py", "se3nets", [
        ("the truth of other rows", "self.truth[rows]", "self.truth[np.sort(rows)]"),
        ("the motion of noisy points for the true ones", "unproject(data.interactions.depth_before, data.camera)",
         "unproject(depth, data.camera)")]),
    ("lab/evaluation.py", "evaluation", [
        ("moving from 2 mm on", "MOVING = 1e-3", "MOVING = 2e-3"),
        ("the same noise for eight pokes", "np.random.default_rng([0, row])", "np.random.default_rng([0, row // 8])"),
        ("optical flow is scored where there is no depth", "pixel_error[seen].sum()", "pixel_error.sum()"),
        ("pokes of a scene taken as independent", "np.bincount(scenes, squared - ratio * motion)",
         "(squared - ratio * motion)")]),
    ("lab/image_pairs.py", "image_pairs", [
        ("flow of the enlarged picture", "interpolation=cv2.INTER_AREA) / ENLARGE", "interpolation=cv2.INTER_AREA)")]),
    ("lab/marks.py", "marks", [
        ("marks follow points of other masks", " & (masks[:pixels] == masks[mark])", ""),
        ("the worst matches kept", "np.argsort(distance)[:", "np.argsort(-distance)[:")]),
    ("lab/control.py", "control", [
        ("greedy pushes away from the goal", "places_at(goal.pixels, marks[:, 2], camera, settings) - marks[:, :2]",
         "marks[:, :2] - places_at(goal.pixels, marks[:, 2], camera, settings)"),
        ("the last poke of a plan first", "pokes.append(found.pokes[0])", "pokes.append(found.pokes[-1])"),
        ("every sequence begins where the last one ended",
         "            arena.bullet.restoreState(start)\n            found", "            found")]),
    ("lab/tables.py", "tables", [
        ("tested on the training pokes", '_data(out / "test")), depth_noise', '_data(out / "train")), depth_noise'),
        ("all tries identical", "[seed, attempt], ahead", "seed, ahead"),
        ("the best distance so far", "np.pad(distance,", "np.pad(np.minimum.accumulate(distance),"),
        ("the obstacle's shift measured on the mover", 'np.delete(record["poses"][..., :2], record["movers"], axis=1)',
         'record["poses"][:, record["movers"], :2]')]),
    ("lab/runs.py", "runs", [("an epoch's sums go on in the next", "sums.clear()", "pass")]),
    ("lab/processes.py", "se3nets", [
        ("chunks come back out of order", "for i, call in enumerate(calls):",
         "for i, call in reversed([*enumerate(calls)]):")]),
    ("lab/cli.py", "cli", [
        ("--weight has no say", "{**training.WEIGHTS, **dict(weight)}", "{**dict(weight), **training.WEIGHTS}")]),
    ("lab/figures.py", "figures", [("heat-maps upside down", 'origin="lower"', 'origin="upper"')]),
)
FAULTS = [Fault(name, file, text, instead, tests)
          for file, tests, faults in PLANTED for name, text, instead in faults]


def copy_of_tree(folder):
    """The package and its tests in an empty folder; what they only read is linked."""
    for path in ROOT.iterdir():
        if path.name in ("hind4sight_min", "tests"):
            shutil.copytree(path, folder / path.name, ignore=shutil.ignore_patterns("__pycache__"))
        elif path.name == "setup.cfg":
            shutil.copy(path, folder)
        elif path.name in ("benchmarks", "data_small", "docs", "pyproject.toml", "README.md", "tutorials"):
            (folder / path.name).symlink_to(path)


def tests_in(folder, tests):
    """Run test files, given by their names without test_, until one fails -> None, or what failed."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider",
               *(f"tests/test_{name}.py" for name in tests)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(folder)}
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=TIME_OUT)
    except subprocess.TimeoutExpired:
        return "the time-out"
    failed = re.findall(r"^(?:FAILED|ERROR) (?:tests/)?(.+?)(?: - |$)", done.stdout, re.MULTILINE)
    return None if done.returncode == 0 else failed[0] if failed else done.stdout[-500:] + done.stderr[-500:]


def with_fault(fault):
    """The text of a file with a fault in it. Raises ValueError where the fault does not fit the file any more."""
    source = (ROOT / "hind4sight_min" / fault.file).read_text()
    if source.count(fault.text) != 1:
        raise ValueError(f"{fault.name}: expected once in {fault.file}: {fault.text}")
    changed = source.replace(fault.text, fault.instead)
    compile(changed, fault.file, "exec")
    return changed


def try_fault(fault):
    """Plant a fault -> what caught it, None where nothing did."""
    with tempfile.TemporaryDirectory() as folder:
        copy_of_tree(Path(folder))
        (Path(folder) / "hind4sight_min" / fault.file).write_text(with_fault(fault))
        return tests_in(Path(folder), fault.tests.split())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", nargs="+", metavar="WORD", default=[""])
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    faults = [fault for fault in FAULTS if any(word in fault.name or word in fault.file for word in args.only)]
    with tempfile.TemporaryDirectory() as folder:
        copy_of_tree(Path(folder))
        for name in sorted({name for fault in faults for name in fault.tests.split()}):
            failed = tests_in(Path(folder), [name])
            if failed:
                sys.exit(f"without any fault: {failed}")
    survivors, began = [], time.perf_counter()
    with ThreadPoolExecutor(args.jobs) as pool:
        for fault, caught in zip(faults, pool.map(try_fault, faults)):
            print(f"{fault.file}: {fault.name}: " + (f"caught by {caught}" if caught else "SURVIVED"), flush=True)
            survivors += [fault.name] * (not caught)
    print(f"{len(faults) - len(survivors)} of {len(faults)} caught in {time.perf_counter() - began:.0f} s")
    if args.json:
        args.json.write_text(json.dumps({"planted_faults": len(faults), "survivors": survivors,
                                         "planted_faults_caught": len(faults) - len(survivors)}, indent=2) + "\n")


if __name__ == "__main__":
    main()
