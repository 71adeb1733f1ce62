from dataclasses import asdict

import numpy as np
import pytest

pytest.importorskip("pybullet")

from test_planning import CAMERA, SETTINGS, island

from hind4sight_min import control, planning, reproduce, training
from hind4sight_min.__main__ import data_small, main
from hind4sight_min.geometry import project
from hind4sight_min.planning import Goal, Search, View

SMALL = Search(candidates=16, elites=4, iterations=2)


@pytest.fixture(scope="module")
def run():
    return training.load_run(data_small() / "checkpoint.npz")


def test_a_task_is_the_same_every_time_and_its_goal_can_be_met():
    seen = []
    for _ in range(2):
        with control.random_task(3, 2) as task:
            seen.append((task.arena.observe()[0], task.arena.poses(), task.goal_poses, task.goal[0], task.goal_marks))
            assert len(task.movers) == 2
    for first, second in zip(*seen):
        np.testing.assert_array_equal(first, second)
    _, start, goal, _, _ = seen[0]
    away = np.linalg.norm(goal[:, :2] - start[:, :2], axis=1)
    moved = np.zeros(7, bool)
    moved[task.movers] = True
    assert ((away[moved] > 0.07) & (away[moved] < 0.15)).all() and (away[~moved] < 1e-3).all()
    assert np.abs(goal[:, :2]).max() < 0.15
    np.testing.assert_allclose(goal[moved, 2], start[moved, 2], atol=2e-3)  # upright, on the table


def test_goals_are_turned_by_up_to_an_eighth():
    angles = []
    for seed in range(4):
        with control.random_task(seed, 2) as task:
            task.arena.kinds[:] = ["carton"] * len(task.arena.kinds)  # a kind whose turn can be seen
            angles.extend(control.distances(task.arena.poses(), task)[1])
    assert max(angles) <= np.pi / 4 + 0.02 and np.median(angles) > 0.1


def test_marks_lie_on_the_movers_and_go_with_them():
    with control.random_task(5, 3) as task:
        _, depth, labels = task.arena.observe()
        settings = asdict(task.arena.settings)
        points = planning.points_at(task.marks, depth, task.arena.empty_depth, task.arena.camera, settings)
        assert [labels[y, x] for x, y in task.marks] == (task.movers + 1).tolist()
        for point, mover, goal_mark in zip(points, task.movers, task.goal_marks):
            here, there = task.arena.poses()[mover], task.goal_poses[mover]
            assert np.linalg.norm(point[:2] - here[:2]) < 0.03
            there_mark = planning.places_at([goal_mark], [point[2]], task.arena.camera, settings)[0]
            radius = np.linalg.norm(point[:2] - here[:2])
            assert np.linalg.norm(there_mark - there[:2]) == pytest.approx(radius, abs=3e-3)


def test_an_obstacle_stands_across_half_of_the_way_and_is_marked_to_stay():
    with control.random_task(0, 1, obstacle=True) as task:
        start, goal, other = (pose[:2] for pose in (task.arena.poses()[0], task.goal_poses[0], task.arena.poses()[1]))
        way = (goal - start) / np.linalg.norm(goal - start)
        assert np.linalg.norm(goal - start) == pytest.approx(0.18, abs=0.01)
        assert abs((other - start) @ way) == pytest.approx(0.09, abs=0.01)
        beside = abs((other - start) @ [-way[1], way[0]])
        assert beside == pytest.approx(sum(task.arena.radii[:2]) / 2, abs=0.005)
        assert task.movers.tolist() == [0] and task.marked.tolist() == [0, 1]
        np.testing.assert_allclose(task.goal_marks[1], task.marks[1], atol=0.2)


def test_distances_against_a_turn_by_hand():
    with control.random_task(3, 1) as task:
        mover = task.movers[0]
        task.arena.kinds[mover] = "carton"
        poses = task.goal_poses.copy()
        half = 0.3 / 2
        x, y, z, w = poses[mover, 3:]
        # by 0.3 rad about z, from the left
        turn = [np.cos(half) * x - np.sin(half) * y, np.cos(half) * y + np.sin(half) * x,
                np.cos(half) * z + np.sin(half) * w, np.cos(half) * w - np.sin(half) * z]
        poses[mover] = [*(poses[mover, :2] + [0.03, -0.04]), poses[mover, 2], *turn]
        distance, angle = control.distances(poses, task)
        np.testing.assert_allclose(distance, 0.05, atol=1e-6)
        np.testing.assert_allclose(angle, 0.3, atol=1e-5)
        task.arena.kinds[mover] = "can"
        assert np.isnan(control.distances(poses, task)[1]).all()  # a can looks the same from all sides


def test_the_oracle_foresees_what_then_happens():
    with control.random_task(1, 1) as task:
        arena, settings = task.arena, asdict(task.arena.settings)
        _, depth, labels = arena.observe()
        marks = planning.points_at(task.marks, depth, arena.empty_depth, arena.camera, settings)
        view = planning.view_of(depth, arena.empty_depth, arena.camera, settings, marks)
        before = arena.poses()
        rollout = control.oracle_rollout(arena, view, np.concatenate([labels.ravel(), task.movers + 1]), settings)
        sequences = planning.draw_pokes(np.random.default_rng(0), 6, view, settings)
        clouds, starts = rollout(sequences)
        np.testing.assert_array_equal(arena.poses(), before)  # all undone
        shift = np.linalg.norm(clouds[:, 0] - view.cloud, axis=2).max(axis=1)
        best = int(shift.argmax())
        assert shift[best] > 0.01 and np.isfinite(starts).all()
        arena.poke(sequences[best, 0], starts[best, 0])
        after = arena.poses()
        expected = view.cloud + control.true_scene_flow(view.cloud, np.concatenate([labels.ravel(), task.movers + 1]),
                                                        before, after)
        np.testing.assert_allclose(clouds[best, 0], expected, atol=2e-3)


def test_closed_loop_brings_an_object_to_its_goal_and_can_be_replayed(tmp_path, run):
    with control.random_task(0, 1) as task:
        record = control.closed_loop(task, run, "learned", Search(), budget=4, seed=0)
        count = len(record["pokes"])
        with pytest.raises(ValueError, match="policy: expected one of"):
            control.closed_loop(task, run, "magic", SMALL)
    assert 1 <= count <= 4
    assert record["rgb"].shape == (count + 1, 48, 64, 3) and record["marks"].shape == (count + 1, 1, 3)
    assert record["distance"][-1, 0] < 0.35 * record["distance"][0, 0]
    now, planned = record["costs"].T
    assert (planned < now).all() and (record["seconds"] > 0).all()
    true = control._carried(record["marks"][0], record["movers"], record["poses"][0], record["poses"][-1])
    assert np.linalg.norm(true - record["marks"][-1]) < 0.02  # the mark was followed
    control.save_record(tmp_path / "plan.npz", record, {"seed": 0, "movers": 1, "obstacle": False})
    np.testing.assert_allclose(control.replay(tmp_path / "plan.npz"), record["poses"], atol=1e-4)


@pytest.mark.parametrize("policy", ["random", "greedy", "no_motion", "oracle"])
def test_the_other_planners(policy, run):
    with control.random_task(2, 1) as task:
        record = control.closed_loop(task, run, policy, SMALL, budget=2, seed=1)
    left = record["distance"][-1, 0] / record["distance"][0, 0]
    if policy == "no_motion":  # under this model no poke helps, so none is made
        assert len(record["pokes"]) == 0 and left == 1
    else:
        assert len(record["pokes"]) == 2
    if policy in ("greedy", "oracle"):
        assert left < 0.9
    if policy == "greedy":  # straight at the goal, up to the turn that finds room for the finger
        way = task.goal_poses[task.movers[0], :2] - record["poses"][0, task.movers[0], :2]
        turn = record["pokes"][0, 2] - np.arctan2(way[1], way[0])
        assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < np.radians(60)


@pytest.mark.parametrize("farthest, shift", [(0, [-0.08, 0, 0]), (1, [0, 0.06, 0])])
def test_greedy_pokes_what_is_farthest_from_its_goal(farthest, shift):
    here = island().cloud
    there = here + np.float32([0.1, 0.1, 0])
    cloud = np.vstack([here[:-1], there[:-1], here[-1:], there[-1:]])
    view = View(cloud, np.ones(42, bool), np.ones(42, bool), np.full(42, 0.03), 2)
    goals = view.cloud[-2:] + np.float32([0.01, 0, 0])
    goals[farthest] = view.cloud[-2 + farthest] + np.float32(shift)
    poke = control.greedy_poke(view, Goal(project(goals, CAMERA), None), CAMERA, SETTINGS, np.random.default_rng(0))[0]
    assert np.linalg.norm(poke[:2] - view.cloud[-2 + farthest, :2]) < 0.03
    turn = poke[2] - np.arctan2(shift[1], shift[0])
    assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < np.radians(50)


def test_an_arena_that_becomes_empty_ends_the_loop_and_loses_nothing(run, monkeypatch):
    real, calls = planning.view_of, []

    def empty(*arguments):
        calls.append(1)
        if len(calls) > 1:
            raise planning.NoPoke("scene: no object stands in the arena")
        return real(*arguments)
    monkeypatch.setattr(planning, "view_of", empty)
    with control.random_task(0, 1) as task:
        record = control.closed_loop(task, run, "random", SMALL, budget=3)
    assert len(record["pokes"]) == 1 and len(record["rgb"]) == len(record["poses"]) == len(record["marks"]) == 2


def test_no_poke_left_ends_the_loop_and_loses_nothing(run, monkeypatch):
    next_poke, calls = control.next_poke, []

    def once(*arguments):
        calls.append(arguments)
        if len(calls) > 1:
            raise planning.NoPoke("no room")
        return next_poke(*arguments)
    monkeypatch.setattr(control, "next_poke", once)
    with control.random_task(2, 1) as task:
        record = control.closed_loop(task, run, "random", SMALL, budget=5)
    assert len(record["pokes"]) == 1 and len(record["poses"]) == 2
    with control.random_task(2, 1) as task:
        with pytest.raises(planning.NoPoke):
            control.closed_loop(task, run, "random", SMALL, budget=5)


def test_marks_and_goals_of_the_users_own():
    with control.random_task(4, 1) as task:
        mark, settings = task.marks[0], asdict(task.arena.settings)
        own = control.marked_task(task, [mark], [(32, 24)])
        assert own.movers.tolist() == task.movers.tolist() and own.goal is None
        _, depth, _ = task.arena.observe()
        point = planning.points_at([mark], depth, task.arena.empty_depth, task.arena.camera, settings)[0]
        mover = own.movers[0]
        shift = own.goal_poses[mover, :2] - task.arena.poses()[mover, :2]
        moved = project(point[None] + [[*shift, 0]], task.arena.camera)
        np.testing.assert_allclose(moved, [[32, 24]], atol=1e-3)
        for marks, goals, said in (([(0, 47)], [(32, 24)], "background"), ([mark], [(0, 47)], "outside the walls"),
                                   ([mark], [(32, 99)], "outside the 64 x 48"),
                                   ([mark, mark], [(3, 3)], "one per mark")):
            with pytest.raises(ValueError, match=said):
                control.marked_task(task, marks, goals)


# --- the commands ---------------------------------------------------------------------------------------------

def plan(*arguments):
    return main(["plan", *map(str, arguments), "--candidates", "16", "--iterations", "2", "--budget", "2"])


def test_plan_command_writes_record_animation_and_population(tmp_path, capsys):
    assert plan("--seed", 1, "--out", tmp_path) == 0
    said = capsys.readouterr().out
    assert "poke 1 to (" in said and "cm from the goals" in said
    assert (tmp_path / "plan.gif").read_bytes()[:6] == b"GIF89a"
    assert (tmp_path / "cem.png").read_bytes()[1:4] == b"PNG"
    assert len(control.replay(tmp_path / "plan.npz")) >= 2


def test_plan_command_with_a_goal_of_the_users_own(tmp_path, capsys):
    with control.random_task(4, 1) as task:
        x, y = task.marks[0]
    assert plan("--seed", 4, "--mark", x, y, "--goal", 32, 24, "--out", tmp_path) == 0
    assert "cm from the goals" in capsys.readouterr().out


@pytest.mark.parametrize("arguments, said", [
    (["--mark", 0, 47, "--goal", 32, 24], "(0, 47) lies on the background"),
    (["--mark", 99, 3, "--goal", 32, 24], "(99, 3) lies outside the 64 x 48 picture"),
    (["--mark", 3, 3], "--mark, --goal: expected both or neither"),
    (["--click"], "no display"),
    (["--pixel-weight", -1], "pixel_weight"),
    (["nowhere.npz"], "nowhere.npz")])
def test_plan_command_refuses_in_one_line(arguments, said, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    assert plan(*arguments, "--out", tmp_path / "new") == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and not (tmp_path / "new").exists()


def test_clicks_are_pairs(monkeypatch):
    import matplotlib.pyplot as plt
    from hind4sight_min import __main__
    monkeypatch.setattr(plt, "get_backend", lambda: "a window")
    monkeypatch.setattr(plt, "ginput", lambda **_: [(1, 2), (3, 4), (5, 6), (7, 8)])
    marks, goals = __main__.click(np.zeros((4, 4, 3)))
    assert marks.tolist() == [[1, 2], [5, 6]] and goals.tolist() == [[3, 4], [7, 8]]
    monkeypatch.setattr(plt, "ginput", lambda **_: [(1, 2)])
    with pytest.raises(ValueError, match="pairs of clicks"):
        __main__.click(np.zeros((4, 4, 3)))


# --- the control experiment -----------------------------------------------------------------------------------

def test_a_scene_is_run_once(tmp_path):
    arguments = data_small() / "checkpoint.npz", tmp_path, "random", 1, 0
    first = reproduce.run_scene(*arguments)
    assert len(first["distance_m"]) == reproduce.POKES + 1 and 0.08 < first["distance_m"][0] < 0.14
    path = tmp_path / "scenes" / "random-1-0-0.json"
    path.write_text(path.read_text().replace('"pokes"', '"read": 1, "pokes"'))
    assert reproduce.run_scene(*arguments)["read"] == 1


def test_summary_of_the_control_experiment_by_hand():
    curves, results = {}, {}
    for planner in reproduce.PLANNERS:
        for movers in reproduce.OBJECTS:
            end = {"learned": 0.04, "oracle": 0.02}.get(planner, 0.2)
            curves[planner, movers] = np.linspace([0.1, 0.3], [end, end / 2], reproduce.POKES + 1).T
            results[planner, movers, 0, 0] = {"angles_deg": [[10.0, 20.0, 60.0], [4.0, 8.0, 30.0]]}
    curves["oracle", 3][:, 7] += 0.1
    for planner, shifts in (("learned", (0.0, 0.005, 0.05)), ("greedy", (0.02, 0.03, 0.0))):
        for seed, shift in enumerate(shifts):
            results[planner, 0, seed, 0] = {"others_shifted_m": shift, "distance_m": [0.18, 0.09],
                                              "angles_deg": [[], []]}
    figures = reproduce.summarise_planning(results, curves)
    assert figures["plan_1_object"] == figures["plan_2_objects"] == pytest.approx(0.06 / 0.4)
    assert figures["learned_2_left_sd"] == pytest.approx((0.4 - 0.02 / 0.3) / np.sqrt(2))
    assert figures["learned_2_left_after_5"] == pytest.approx((0.07 + 0.16) / 0.4)
    assert figures["plan_over_oracle"] == pytest.approx(2)
    assert (figures["learned_3_falls"], figures["oracle_2_falls"], figures["oracle_3_falls"]) == (1, 1, 0)
    assert (figures["learned_1_angle_start_deg"], figures["learned_1_angle_deg"]) == (20, 8)
    assert figures["learned_obstacle_avoided"] == pytest.approx(2 / 3)
    assert figures["greedy_obstacle_avoided"] == pytest.approx(1 / 3)
    assert figures["learned_obstacle_left"] == 0.5
    assert figures["greedy_obstacle_shift_cm"] == pytest.approx(5 / 3)
    assert "0.15 \u00b1 0.24" in reproduce.planning_table(figures)
