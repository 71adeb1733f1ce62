"""Recorded results: run a command, keep its figures with where they came from, and put them into the README.

    python docs/results.py record shipped -- hind4sight evaluate
    python docs/results.py ship runs/shipped.npz          (runs/camera.npz camera)
    python docs/results.py keep runs/reproduce
    python docs/results.py restore runs/reproduce
    python docs/results.py summary

`record NAME -- COMMAND` runs COMMAND with `--json` added and writes docs/results/NAME.json: the figures, the
command, commit, versions, machine and duration. `ship CHECKPOINT` makes the checkpoint of the recorded result
`training` the shipped one, `ship CHECKPOINT camera` that of `camera_training` the one for real cameras: without the
optimiser's state, with its command and commit inside. The paper's tables take
hours: `keep FOLDER` adds the cells that `hind4sight reproduce --out FOLDER` has finished to docs/results/cells.json,
each with its recipe and commit, and `restore FOLDER` puts them back, so that another machine goes on. `summary` gathers
the headline figures of all recorded results in docs/results/summary.json and writes the tables of README.md,
docs/results.md and docs/not-in-the-paper.md; a test fails while they say anything else.
"""
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

from hind4sight_min.disk.files import write_json, write_text
from hind4sight_min.lab import image_pairs, tables
from hind4sight_min.disk.checkpoints import load_run, save_run

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results"
CELLS = RESULTS / "cells.json"

# headline figure -> (recorded result, its name there, what the README says, format, goal)
HEADLINES = {
    "demo_flow_mse_ratio": ("demo", "demo_flow_mse_ratio", "demo: squared flow error / no motion", "{:.3f}", "<= 0.16"),
    "demo_still_epe_cm": ("demo", "demo_still_epe_cm", "demo: drift of still points, cm", "{:.3f}", "< 0.15"),
    "demo_mask_iou": ("demo", "demo_mask_iou", "demo: IoU of moved objects and masks", "{:.2f}", ""),
    "demo_seconds": ("demo", "demo_seconds", "demo: seconds, all in all", "{:.0f}", "< 150"),
    "shipped_flow_mse_ratio": ("shipped", "flow_mse_ratio", "shipped model: squared flow error / no motion",
                               "{:.3f}", "<= 0.095"),
    "evaluate_multi_flow_mse_ratio": ("shipped", "multi_flow_mse_ratio", "shipped model: pokes that move two or more",
                                      "{:.2f}", ""),
    "evaluate_wall_flow_mse_ratio": ("shipped", "wall_flow_mse_ratio", "shipped model: pokes that end at a wall",
                                     "{:.2f}", ""),
    "shipped_flow_epe_cm": ("shipped", "flow_epe_cm", "shipped model: error of moving points, cm", "{:.2f}", ""),
    "shipped_still_epe_cm": ("shipped", "still_epe_cm", "shipped model: drift of still points, cm", "{:.3f}",
                             "< 0.005"),
    "shipped_mask_iou": ("shipped", "mask_iou", "shipped model: IoU of moved objects and masks", "{:.2f}", ">= 0.83"),
    "shipped_optical_epe_px": ("shipped", "optical_epe_px", "shipped model: optical flow error, moving, px",
                               "{:.2f}", ""),
    "shipped_inverse_target_cm": ("shipped", "inverse_target_cm", "shipped model: median target error, cm",
                                  "{:.2f}", "< 3"),
    "shipped_inverse_direction_deg": ("shipped", "inverse_direction_deg", "shipped model: median direction error, deg",
                                      "{:.1f}", "<= 15.5"),
    "urdf_flow_mse_ratio": ("urdfs", "flow_mse_ratio", "shipped model: objects of URDF files, flow error / no motion",
                            "{:.3f}", "<= 0.18"),
    "urdf_mask_iou": ("urdfs", "mask_iou", "shipped model: objects of URDF files, IoU", "{:.2f}", ">= 0.85"),
    "collect_share_in_bullet": ("collection", "collect_share_in_bullet", "collection: share of time inside Bullet",
                                "{:.2f}", ">= 0.80"),
    "collect_jobs2_speedup": ("collection", "collect_jobs2_speedup", "collection: two processes against one",
                              "{:.2f}", ">= 1.7"),
    "train_step_speedup_vs_torch": ("training_step", "train_step_speedup_vs_torch",
                                    "training step: speed against PyTorch's best", "{:.2f}", ">= 1.5"),
    "train_step_memory_vs_torch": ("training_step", "train_step_memory_vs_torch",
                                   "training step: peak memory against PyTorch's best", "{:.2f}", "<= 0.5"),
    "network_over_matmul_floor": ("training_step", "network_over_matmul_floor",
                                  "network, forward and back, against its bare matrix products", "{:.1f}", "<= 2.5"),
    "chamfer_over_kdtree_floor": ("training_step", "chamfer_over_kdtree_floor",
                                  "Chamfer, value and gradient, against bare KD-trees", "{:.2f}", "<= 1.5"),
    "chamfer_speedup_vs_torch_10k": ("operations", "chamfer_speedup_vs_torch_10k",
                                     "Chamfer of 10,000 points: speed against brute-force PyTorch", "{:.0f}", ">= 30"),
    "warp_speedup_vs_grid_sample_min": ("operations", "warp_speedup_vs_grid_sample_min",
                                        "warping: speed against grid_sample, at its worst size", "{:.2f}", ">= 1"),
    "flow_mse_ratio_clean": ("reproduce", "full_clean_long_flow_mse_ratio", "paper: squared flow error / no motion",
                             "{:.3f}", "<= 0.065"),
    "flow_mse_ratio_noisy": ("reproduce", "full_noisy_long_flow_mse_ratio", "paper: the same, 1 cm depth noise",
                             "{:.3f}", "<= 0.110"),
    "flow_epe_ratio": ("reproduce", "flow_epe_ratio", "paper: error / no motion as lengths, not squares", "{:.2f}", ""),
    "noisy_over_se3nets_da11": ("reproduce", "noisy_over_se3nets_da11", "paper: against SE3-Nets 11 x 11, 1 cm noise",
                                "{:.2f}", "<= 0.74"),
    "noisy_over_se3nets_da11_scaled": ("reproduce", "noisy_over_se3nets_da11_scaled",
                                       "paper: the same, window scaled to our pictures", "{:.2f}", "<= 0.74"),
    "ablation_order_holds": ("reproduce", "ablation_order_holds", "paper: order of the ablation holds (1: yes)",
                             "{:.0f}", "1"),
    "optical_epe_over_best_peer_moving": ("reproduce", "optical_epe_over_best_peer_moving",
                                          "paper: optical flow against image pairs, moving", "{:.2f}", "<= 0.60"),
    "optical_epe_over_best_peer_all": ("reproduce", "optical_epe_over_best_peer_all",
                                       "paper: optical flow against image pairs, all", "{:.2f}", "<= 0.45"),
    "mask_iou": ("reproduce", "full_clean_long_mask_iou", "paper: IoU of moved objects and masks", "{:.2f}", ">= 0.88"),
    "inverse_target_cells": ("reproduce", "inverse_target_cells", "paper: median target error, cells", "{:.2f}", "< 1"),
    "inverse_direction_deg": ("reproduce", "full_clean_long_inverse_direction_deg",
                              "paper: median direction error, deg", "{:.1f}", "<= 12"),
    "unseen_over_seen": ("reproduce", "unseen_over_seen", "paper: unseen objects against seen ones", "{:.2f}",
                         "<= 1.5"),
    "unseen_over_seen_4000": ("reproduce", "unseen_over_seen_4000", "paper: the same, 4,000 pokes of each", "{:.2f}",
                              "<= 1.15"),
    "full_over_se3nets_exact": ("reproduce", "full_over_se3nets_exact",
                                "paper: against SE3-Nets with exact association", "{:.2f}", "<= 1.2"),
    "minutes_to_0110": ("minutes_to", "minutes", "minutes on one core to a ratio of 0.110", "{:.1f}", "<= 3"),
    "multi_flow_mse_ratio": ("contact", "multi_flow_mse_ratio", "fresh pokes that move two or more objects", "{:.2f}",
                             "<= 0.13"),
    "multi_mask_iou": ("contact", "multi_mask_iou", "the same: IoU", "{:.2f}", ">= 0.65"),
    "wall_flow_mse_ratio": ("contact", "wall_flow_mse_ratio", "fresh pokes whose object hits a wall", "{:.2f}",
                            "<= 0.14"),
    "crowded_flow_mse_ratio": ("contact", "crowded_flow_mse_ratio", "6 or 7 objects all over the arena", "{:.2f}",
                               "<= 0.13"),
    "train_minutes": ("reproduce", "train_minutes", "paper: minutes of training", "{:.0f}", "< 60"),
    "plan_1_object": ("planning", "learned_1_left",
                      "planning, 1 object: distance left after 10 pokes / start",
                      "{:.2f}", "<= 0.05"),
    "plan_2_objects": ("planning", "learned_2_left", "planning, 2 objects", "{:.2f}", "<= 0.05"),
    "plan_3_objects": ("planning", "learned_3_left", "planning, 3 objects", "{:.2f}", "<= 0.07"),
    "plan_worst_scene": ("planning", "plan_worst_scene", "planning: distance left in the worst scene", "{:.2f}",
                         "<= 0.35"),
    "plan_turn_1_object_deg": ("planning", "learned_1_angle_deg",
                               "planning, 1 object: median orientation left, deg",
                               "{:.0f}", "<= 12"),
    "obstacle_left_alone": ("planning", "learned_obstacle_avoided",
                            "planning: share of runs that leave an obstacle alone", "{:.2f}", ">= 0.60"),
    "plan_over_oracle": ("planning", "plan_over_oracle",
                         "planning, one poke ahead: distance left / the simulator's", "{:.2f}", "<= 1.3"),
    "plan_step_seconds": ("planning_step", "plan_step_seconds", "planning: seconds per step", "{:.2f}", "< 2"),
    "plan_candidates_per_second": ("planning_step", "plan_candidates_per_second", "planning: candidates per second",
                                   "{:.0f}", ""),
    "camera_clean_flow_mse_ratio": ("camera", "camera_clean_flow_mse_ratio",
                                    "camera checkpoint, no fault: squared flow error / no motion", "{:.3f}",
                                    "<= 0.110"),
    "camera_noisy_flow_mse_ratio": ("camera", "camera_noisy_flow_mse_ratio", "camera checkpoint, 1 cm of depth noise",
                                    "{:.3f}", "<= 0.125"),
    "camera_noisy_direction_deg": ("camera", "camera_noisy_inverse_direction_deg",
                                   "camera checkpoint, 1 cm of depth noise: median direction error, deg", "{:.1f}",
                                   "<= 17"),
    "camera_missing30_flow_mse_ratio": ("camera", "camera_missing30_flow_mse_ratio",
                                        "camera checkpoint, 30 % of the depth missing at random", "{:.3f}",
                                        "<= 0.160"),
    "camera_shadow_mask_iou": ("camera", "camera_shadow_mask_iou",
                               "camera checkpoint, rims and shadows missing on one side: IoU", "{:.2f}", ">= 0.75"),
    "camera_pitch1_flow_mse_ratio": ("camera", "camera_pitch1_flow_mse_ratio",
                                     "camera checkpoint, pitch wrong by 1 degree", "{:.3f}", "<= 0.200"),
    "camera_shift1_flow_mse_ratio": ("camera", "camera_shift1_flow_mse_ratio",
                                     "camera checkpoint, pose wrong by 1 cm", "{:.3f}", "<= 0.140"),
    "import_seconds": ("startup", "import_seconds", "import, seconds", "{:.2f}", "< 0.7"),
    "explorer_ms": ("explorer", "explorer_ms", "explorer: from mouse to picture, ms", "{:.0f}", "< 100"),
    "planted_faults_caught": ("planted_faults", "planted_faults_caught", "planted faults that the tests catch, of 80",
                              "{:.0f}", ">= 76"),
    "course_tasks": ("grade_class", "course_tasks", "course: tasks of assignments 1 to 6", "{:.0f}", ""),
    "course_mistakes_with_feedback": ("grade_class", "course_mistakes_with_feedback",
                                      "course: mistakes that are told by a sentence", "{:.0f}", ">= 40"),
    "course_hostile_cases_held": ("grade_class", "course_hostile_cases_held", "course: attacks held, of 20", "{:.0f}",
                                  "20"),
    "grade_30_seconds": ("grade_class", "grade_30_seconds", "course: seconds to grade a class of 30", "{:.0f}",
                         "< 300"),
    "student_loop_seconds": ("grade_class", "student_loop_seconds", "course: seconds from saving to the verdict",
                             "{:.1f}", "< 3"),
    "train_memory_20k_over_2k": ("scale", "train_memory_20k_over_2k",
                                 "many pokes: memory of training on 20,000 against 2,000", "{:.2f}", "<= 1.2"),
    "kills_survived": ("kills", "kills_survived", "kills -9 survived, of 75: collection, training, a cluster's workers",
                       "{:.0f}", "75"),
    "cluster_identical": ("kills", "cluster_identical", "a cluster that loses workers collects the same bytes (1: yes)",
                          "{:.0f}", "1"),
    "mutated_files_held": ("mutations", "mutated_files_held", "mutated files refused or read right, of 5,000",
                           "{:.0f}", "5000"),
    "wrong_calls_held": ("mutations", "wrong_calls_held", "calls with wrong types refused or converted, of 1,000",
                         "{:.0f}", "1000"),
    "roundtrip_mm": ("roundtrip", "roundtrip_mm", "real cameras: error of points after export and import, mm", "{:.2f}",
                     "<= 1"),
    "core_lines": ("house", "core_lines", "lines of the core", "{:.0f}", "<= 1700"),
    "package_lines": ("house", "package_lines", "lines of the package, the course apart", "{:.0f}",
                      "<= 4000"),
    "explorer_lines": ("house", "explorer_lines", "lines of the explorer", "{:.0f}", "< 350"),
    "course_lines": ("house", "course_lines", "lines of the course", "{:.0f}", ""),
    "hero_mb": ("house", "hero_mb", "README: megabytes of its animation", "{:.2f}", "< 3"),
    "test_lines": ("house", "test_lines", "lines of the tests, the course's apart", "{:.0f}", "<= 5000"),
}
FRONT = ("demo_flow_mse_ratio", "shipped_flow_mse_ratio", "shipped_mask_iou", "shipped_inverse_direction_deg",
         "flow_mse_ratio_clean", "optical_epe_over_best_peer_moving", "plan_3_objects", "train_step_speedup_vs_torch")


def record(name, command):
    """Run a command and write its figures and their provenance to docs/results/NAME.json."""
    began_at, start = tables.commit(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figures.json"
        subprocess.run([*command, "--json", str(path)], check=True)
        figures = json.loads(path.read_text())
    libraries = {}
    for library in ("numpy", "scipy", "opencv-python-headless", "autograd", "pybullet"):
        try:
            libraries[library] = version(library)
        except ModuleNotFoundError:
            libraries[library] = None
    result = {"figures": figures, "command": " ".join(command), "commit": began_at,
              "seconds": round(time.perf_counter() - start, 1), "date": time.strftime("%Y-%m-%d"),
              "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}",
              "python": platform.python_version(), "versions": libraries}
    write_text(RESULTS / f"{name}.json", json.dumps(result, indent=2, sort_keys=True) + "\n")


def ship(checkpoint, target=ROOT / "data_small" / "checkpoint.npz", recorded="training"):
    """Write a finished checkpoint, that of a recorded training, in the form that is shipped."""
    run = load_run(checkpoint)
    if run.step < run.recipe.steps:
        raise ValueError(f"{checkpoint}: training stopped at step {run.step} of {run.recipe.steps}")
    training = json.loads((RESULTS / f"{recorded}.json").read_text())
    run.meta.update(command=training["command"], commit=training["commit"])
    save_run(target, run, resumable=False)


def keep(folder, kept=CELLS):
    """Add the finished cells of `hind4sight reproduce --out folder` to those that are kept -> how many there are."""
    cells = json.loads(kept.read_text()) if kept.exists() else {}
    cells.update((path.stem, json.loads(path.read_text())) for path in Path(folder).glob("cells/*.json"))
    write_json(kept, of_today(cells))
    return len(cells)


def restore(folder, kept=CELLS):
    """Put the kept cells where `hind4sight reproduce --out folder` looks for finished ones -> how many were missing."""
    cells = of_today(json.loads(kept.read_text()))
    cells = {Path(folder) / "cells" / f"{name}.json": cell for name, cell in cells.items()}
    missing = {path: cell for path, cell in cells.items() if not path.exists()}
    for path, cell in missing.items():
        write_json(path, cell)
    return len(missing)


def of_today(cells):
    """These cells {name: file's contents}. Raises ValueError where `hind4sight reproduce` would make one otherwise now.
    """
    now = {cell.name: tables.ingredients(cell, tables.FULL)
           for cell in tables.cells_of_tables(list(tables.TABLES), tables.FULL)}
    for name, cell in cells.items():
        if name not in now or not tables.made_of(cell, now[name]):
            raise ValueError(f"cell {name}: made with another recipe, network or data than today's; remove it")
    return cells


def recorded(name):
    """The figures of docs/results/NAME.json, or None."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text())["figures"] if path.exists() else None


RATIOS = {  # what the paper claims: a figure of `hind4sight reproduce` over another, or over a number
    "flow_epe_ratio": ("full_clean_long_flow_epe_cm", "full_clean_long_no_motion_epe_cm"),
    "unseen_over_seen": ("full_clean_long_unseen_flow_mse_ratio", "full_clean_long_flow_mse_ratio"),
    "noisy_over_se3nets_da11": ("full_noisy_flow_mse_cm2", "se3nets_11_noisy_flow_mse_cm2"),
    "noisy_over_se3nets_da11_scaled": ("full_noisy_flow_mse_cm2", "se3nets_3_noisy_flow_mse_cm2"),
    "unseen_over_seen_4000": ("full_clean_long_unseen_flow_mse_ratio", "full_clean_long_known_flow_mse_ratio"),
    "full_over_se3nets_exact": ("full_clean_flow_mse_ratio", "se3nets_0_clean_flow_mse_ratio"),
    "inverse_target_cells": ("full_clean_long_inverse_target_cm", 2.5),  # cm
    "train_minutes": ("full_clean_long_train_seconds", 60),
}


def claims(figures):
    """What the paper claims, in the figures of `hind4sight reproduce all` -> flat dict.

    optical_epe_over_best_peer_*: our optical flow, from one picture and the poke, over the better of two methods that
    see both pictures. ablation_order_holds: 1 for yes.
    """
    found = {name: figures[ours] / figures.get(other, other) for name, (ours, other) in RATIOS.items()
             if ours in figures and (other in figures or not isinstance(other, str))}
    for name, metric in (("moving", "optical_epe_px"), ("all", "optical_epe_all_px")):
        peers = [figures[f"{peer}_{metric}"] for peer in image_pairs.PEERS]
        found[f"optical_epe_over_best_peer_{name}"] = figures[f"full_clean_long_{metric}"] / min(peers)
    return {**found, "ablation_order_holds": float(all(order_holds(figures, noise) for noise in tables.NOISES))}


def order_holds(figures, noise):
    """full < 2D + 3D < 3D and 2D, each by more than one SD (the larger of the two)."""
    def better(a, b):
        first, second = (f"{model}_{noise}_flow_mse_cm2" for model in (a, b))
        return figures[second] - figures[first] > max(figures[f"{first}_sd"], figures[f"{second}_sd"])
    return better("full", "2d_3d") and better("2d_3d", "3d") and better("2d_3d", "2d")


def house():
    """How large the house is, docstrings and all, and what its front page weighs -> dict."""
    def lines(*patterns):
        return float(sum(len(path.read_text().splitlines()) for pattern in patterns for path in ROOT.glob(pattern)
                         if path.name != "__main__.py" or "**" in pattern))
    course, of_course = lines("hind4sight_min/course/**/*.py"), lines("tests/*course*.py", "tests/test_grading.py")
    return {"core_lines": lines("hind4sight_min/[!_]*.py"), "course_lines": course,
            "hero_mb": (ROOT / "docs" / "hero.gif").stat().st_size / 1e6,
            "explorer_lines": lines(*(f"hind4sight_min/lab/{name}.py" for name in ("explore", "scripts", "worlds"))),
            "package_lines": lines("hind4sight_min/**/*.py") - course, "test_lines": lines("tests/*.py") - of_course}


def gather():
    """The headline figures that have been recorded -> flat dict."""
    found = {}
    for headline, (name, figure, *_) in HEADLINES.items():
        figures = house() if name == "house" else recorded(name)
        if figures and name == "reproduce":
            figures = {**figures, **claims(figures)}
        if figures and figure in figures:
            found[headline] = float(figures[figure])
    return found


def met(value, goal):
    """Whether a figure meets a goal such as "<= 0.16"."""
    sign, _, bound = goal.rpartition(" ")
    return {"<=": value <= float(bound), ">=": value >= float(bound), "<": value < float(bound),
            "": value == float(bound)}[sign]


def table(summary, names=HEADLINES):
    """A table of headline figures, misses marked as misses."""
    lines = ["| figure | measured | goal |", "|---|---|---|"]
    for name in names:
        _, _, text, form, goal = HEADLINES[name]
        if name in summary:
            miss = ", missed" if goal and not met(float(form.format(summary[name])), goal) else ""
            goal = goal.replace("<=", "\u2264").replace(">=", "\u2265")
            lines.append(f"| {text} | {form.format(summary[name])} | {goal}{miss} |")
    return "\n".join(lines)


def paper_tables():
    """The paper's tables with ours beside them, once the full runs are recorded."""
    figures = recorded("reproduce")
    if not figures:
        return "The full runs take hours and are not recorded yet; `--quick` shows the tables in miniature."
    return tables.tables_text(list(tables.TABLES), figures)


def control_table():
    """The control experiment, once it is recorded."""
    figures = recorded("planning")
    if not figures:
        return "Not recorded yet; `hind4sight reproduce planning --quick` shows it in miniature."
    obstacle = []
    for planner in ("learned", "greedy"):
        avoided, shift = (figures[f"{planner}_obstacle_{name}"] for name in ("avoided", "shift_cm"))
        obstacle.append(f"{avoided:.0%} of the runs, and moves it by {shift:.1f} cm on average")
    return (tables.planning_table(figures) + "\n\nIn three scenes, five times each, another object stands across "
            f"half of the way. Planning avoids it (moves it by less than 1 cm) in {obstacle[0]}; "
            f"pushing straight at the goal does in {obstacle[1]}.")


def table_of(name):
    """The table of a benchmark that makes one, once it is recorded."""
    figures = recorded(name)
    return figures["table"] if figures else "Not recorded yet."


def pages(summary):
    """{page: {marker: what stands between `<!-- marker: ... -->` and `<!-- /marker -->`}}."""
    return {ROOT / "README.md": {"figures": table(summary, FRONT)},
            ROOT / "docs" / "results.md": {"figures": table(summary), "tables": paper_tables(),
                                           "control": control_table(), "cameras": table_of("camera")},
            ROOT / "docs" / "not-in-the-paper.md": {"left out": table_of("leave_one_out")}}


def page_with(text, contents):
    """The text of a page with what stands between its markers replaced."""
    for marker, content in contents.items():
        before, rest = text.split(f"<!-- {marker}: ")
        begin, rest = rest.split(" -->\n", 1)
        _, after = rest.split(f"<!-- /{marker} -->")
        text = f"{before}<!-- {marker}: {begin} -->\n{content}\n<!-- /{marker} -->{after}"
    return text


def main(arguments):
    if arguments[:1] == ["record"] and len(arguments) > 3 and arguments[2] == "--":
        record(arguments[1], arguments[3:])
    elif arguments[:1] == ["ship"] and len(arguments) == 2:
        ship(arguments[1])
    elif arguments[:1] == ["ship"] and arguments[2:] == ["camera"]:
        ship(arguments[1], ROOT / "data_small" / "camera_checkpoint.npz", "camera_training")
    elif arguments[:1] == ["keep"] and len(arguments) == 2:
        print(f"{keep(arguments[1])} cells are kept in {CELLS.relative_to(ROOT)}")
    elif arguments[:1] == ["restore"] and len(arguments) == 2:
        print(f"{restore(arguments[1])} finished cells put into {arguments[1]}")
    elif arguments == ["summary"]:
        summary = gather()
        write_text(RESULTS / "summary.json", json.dumps(summary, indent=2, sort_keys=True) + "\n")
        for page, contents in pages(summary).items():
            write_text(page, page_with(page.read_text(), contents))
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
