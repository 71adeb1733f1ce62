"""Sec. IV-G in the simulator: tasks, planners, the closed loop."""
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pybullet")

from scipy.spatial.transform import Rotation
from test_planning import CAMERA, goal_at, island, shift_along
from tiny import SETTINGS

from hind4sight_min import planning
from hind4sight_min.disk import checkpoints
from hind4sight_min.geometry import project, unproject
from hind4sight_min.lab import control
from hind4sight_min.lab.cli import data_small
from hind4sight_min.lab.marks import places_at
from hind4sight_min.planning import Goal, Plan, Search, planning_cost
from hind4sight_min.sim.truth import true_scene_flow

SMALL = Search(candidates=16, elites=4, iterations=2)


@pytest.fixture(scope="module")
def run():
    return checkpoints.load_run(data_small() / "checkpoint.npz")


@pytest.fixture(scope="module")
def shared_task():
    with control.random_task(2, 1) as task:
        yield task, task.arena.bullet.saveState()


@pytest.fixture
def task(shared_task):
    """A task with one object to move, at its start."""
    shared_task[0].arena.bullet.restoreState(shared_task[1])
    return shared_task[0]


def turn_between(a, b):
    return abs((a - b + np.pi) % (2 * np.pi) - np.pi)


# --- tasks ----------------------------------------------------------------------------------------------------

def test_a_task_is_the_same_every_time_and_its_goal_can_be_met():
    seen = []
    for _ in range(2):
        with control.random_task(3, 2) as task:
            seen.append((task.arena.observe()[0], task.arena.poses(), task.goal_poses, task.goal[0], task.goal_marks))
            task.arena.round[:] = [False] * len(task.arena.round)  # turns that can be seen
            angles = control.distances(task.arena.poses(), task)[1]
    for first, second in zip(*seen):
        np.testing.assert_array_equal(first, second)
    _, start, goal, _, _ = seen[0]
    away, moved = np.linalg.norm(goal[:, :2] - start[:, :2], axis=1), np.isin(np.arange(7), task.movers)
    assert moved.sum() == 2 and ((away[moved] > 0.07) & (away[moved] < 0.15)).all() and (away[~moved] < 1e-3).all()
    assert np.abs(goal[:, :2]).max() < 0.15 and 0.02 < max(angles) <= np.pi / 4 + 0.02
    np.testing.assert_allclose(goal[moved, 2], start[moved, 2], atol=2e-3)  # upright, on the table


def test_marks_lie_on_the_movers_and_go_with_them():
    with control.random_task(5, 3) as task:
        (_, depth, labels), view, goal = control.first_look(task)
        assert [labels[y, x] for x, y in task.marks] == (task.movers + 1).tolist()
        np.testing.assert_allclose(project(view.marks, task.arena.camera), task.marks, atol=1e-3)
        np.testing.assert_array_equal(goal.pixels, task.goal_marks)
        there = places_at(task.goal_marks, view.marks[:, 2], task.arena.camera, task.settings)
        for point, place, here, goal_pose in zip(view.marks, there, task.arena.poses()[task.movers],
                                                 task.goal_poses[task.movers]):
            radius = np.linalg.norm(point[:2] - here[:2])
            assert radius < 0.03 and np.linalg.norm(place - goal_pose[:2]) == pytest.approx(radius, abs=3e-3)
        goal_cloud = unproject(task.goal[1], task.arena.camera).reshape(-1, 3)
        assert {tuple(point) for point in goal.points} < {tuple(point) for point in goal_cloud}
        assert len(goal.points) > 100


def test_an_obstacle_stands_across_half_of_the_way_and_is_marked_to_stay():
    with control.random_task(0, 1, obstacle=True) as task:
        start, goal, other = (pose[:2] for pose in (task.arena.poses()[0], task.goal_poses[0], task.arena.poses()[1]))
        way = (goal - start) / np.linalg.norm(goal - start)
        assert np.linalg.norm(goal - start) == pytest.approx(0.18, abs=0.01)
        assert abs((other - start) @ way) == pytest.approx(0.09, abs=0.01)
        assert abs((other - start) @ [-way[1], way[0]]) == pytest.approx(sum(task.arena.radii[:2]) / 2, abs=0.005)
        assert task.movers.tolist() == [0] and task.marked.tolist() == [0, 1]
        np.testing.assert_allclose(task.goal_marks[1], task.marks[1], atol=0.2)


def test_distances_against_a_turn_by_hand(task):
    mover, were = task.movers[0], list(task.arena.round)
    task.arena.round[mover] = False
    poses = task.goal_poses.copy()
    poses[mover, :2] += [0.03, -0.04]
    poses[mover, 3:] = (Rotation.from_euler("z", 0.3) * Rotation.from_quat(poses[mover, 3:])).as_quat()
    distance, angle = control.distances(poses, task)
    np.testing.assert_allclose([distance[0], angle[0]], [0.05, 0.3], atol=1e-5)
    task.arena.round[mover] = True
    assert np.isnan(control.distances(poses, task)[1]).all()  # it looks the same from all sides
    task.arena.round[:] = were


def test_marks_and_goals_of_the_users_own(task):
    mark, arena = task.marks[0], task.arena
    own = control.marked_task(task, [mark], [(32, 24)])
    assert own.movers.tolist() == task.movers.tolist() and own.goal is None
    _, view, goal = control.first_look(own)
    shift = own.goal_poses[own.movers, :2] - arena.poses()[own.movers, :2]
    there = view.marks + np.pad(shift, ((0, 0), (0, 1)))
    np.testing.assert_allclose(project(there, arena.camera), [[32, 24]], atol=1e-3)
    assert goal.points is None and np.linalg.norm(shift) > 0.02


@pytest.mark.parametrize("refused, said", [
    (lambda task, run: control.marked_task(task, [(0, 47)], [(32, 24)]), "background"),
    (lambda task, run: control.marked_task(task, task.marks, [(0, 47)]), "outside the walls"),
    (lambda task, run: control.marked_task(task, task.marks, [(3, 3), (3, 3)]), "one per mark"),
    (lambda task, run: control.random_task(0, 2, True).__enter__(), "movers: expected 1"),
    (lambda task, run: control.random_task(-1, 1).__enter__(), "seed"),
    (lambda task, run: control.closed_loop(task, run, "magic", SMALL), "policy: expected one of"),
    (lambda task, run: control.closed_loop(task, run, "random", SMALL, budget=0), "budget"),
    (lambda task, run: control.closed_loop(task, replace(run, meta={"camera": {**vars(CAMERA), "fx": 1e4}}), "random",
                                           SMALL), "camera: fx: expected")])
def test_refusals(refused, said, task, run):
    with pytest.raises(ValueError, match=said):
        refused(task, run)


# --- planners -------------------------------------------------------------------------------------------------

def test_the_oracle_foresees_what_then_happens(task):
    (_, _, labels), view, _ = control.first_look(task)
    arena, labels, before = task.arena, np.append(labels.ravel(), task.marked + 1), task.arena.poses()
    sequences = planning.draw_pokes(np.random.default_rng(0), 6, view, task.settings, horizon=2)
    clouds, starts = control.oracle_rollout(arena, view, labels, task.settings)(sequences)
    np.testing.assert_array_equal(arena.poses(), before, err_msg="not undone")
    shift = np.linalg.norm(clouds[:, 0] - view.cloud, axis=2).max(axis=1)
    best = int(shift.argmax())
    assert shift[best] > 0.01 and np.isfinite(starts[:, 0]).all() and clouds.shape == (6, 2, len(view.cloud), 3)
    arena.poke(sequences[best, 0], starts[best, 0])
    expected = view.cloud + true_scene_flow(view.cloud, labels, before, arena.poses())
    np.testing.assert_allclose(clouds[best, 0], expected, atol=2e-3)


@pytest.mark.parametrize("farthest, shift", [(0, [-0.08, 0, 0]), (1, [0, 0.06, 0]), (1, [0.05, -0.05, 0])])
def test_greedy_pushes_what_is_farthest_from_its_goal_towards_it(farthest, shift):
    view = island(marks=[(0, 0, 0.03), (0.1, 0.1, 0.03)], table=())
    goals = view.marks + np.float32([0.01, 0, 0])
    goals[farthest] = view.marks[farthest] + np.float32(shift)
    poke = control.greedy_poke(view, Goal(project(goals, CAMERA), None), CAMERA, SETTINGS, np.random.default_rng(0))[0]
    assert np.linalg.norm(poke[:2] - view.marks[farthest, :2]) < 0.03
    assert turn_between(poke[2], np.arctan2(shift[1], shift[0])) < np.radians(50), "pushed away from the goal?"
    assert (poke[:2] - view.marks[farthest, :2]) @ shift[:2] > 0, "the finger stops before it has pushed"


BLOCK = np.array([(x, y) for x in (-0.02, -0.01, 0, 0.01, 0.02) for y in (-0.02, -0.01, 0, 0.01, 0.02)])


@pytest.mark.parametrize("first, second, meets", [
    ((0.1, 0), (0, 0), True), ((0.1, 0), (0.04, 0), True), ((0.05, 0), (0.04, 0), False), ((-0.1, 0), (0, 0), False),
    ((0, 0.1), (0, 0), False), ((0.005, 0), (0, 0), False)])
def test_what_passes_through_something_else(first, second, meets):
    """Two blocks with 2 cm between them, each with its shift."""
    before = np.concatenate([BLOCK, BLOCK + [0.06, 0]])
    share = control.pass_through(before, before + np.repeat([first, second], 25, axis=0), 0.015)
    assert share > 0.1 if meets else share == 0


def test_care_refuses_plans_that_meet_more_than_they_say_and_those_that_move_what_shall_stay():
    marks = np.column_stack([BLOCK + [0.06, 0], np.full(25, 0.03)])
    view = island(marks=marks)  # a block in the middle, and a second one, of marks
    first = np.arange(len(view.cloud)) < len(view.cloud) - 25
    shifts = np.float32([[(0.1, 0), (0, 0)], [(0, 0.1), (0, 0)], [(-0.1, 0), (0.01, 0)]])  # of one block, of the other
    after = view.cloud + np.pad(np.where(first[:, None], shifts[:, :1], shifts[:, 1:]), ((0, 0), (0, 0), (0, 1)))
    clouds = np.stack([after, after + [0, 0.001, 0]], axis=1)  # the second poke does nothing to speak of

    def refused(stays, target=(-0.02, 0)):
        sequences = np.float32([[[*target, 0], [-0.02, 0, 0]]] * 3)
        starts = control.careful(lambda sequences: (clouds, np.zeros((3, 2, 2))), view, stays)(sequences)[1]
        return np.isnan(starts).all(axis=2).tolist()
    assert refused(np.zeros(25, bool), target=(0.06, 0)) == [[True, False], [False, False], [False, False]]
    assert refused(np.arange(25) == 12) == [[True, False], [False, False], [True, False]]
    assert refused(np.arange(25) == 12, target=(0.06, 0.04)) == [[True, False], [True, False], [True, False]]


# --- the closed loop ------------------------------------------------------------------------------------------

def test_closed_loop_brings_an_object_to_its_goal(run):
    with control.random_task(0, 1) as task:
        record = control.closed_loop(task, run, "learned", Search(), budget=4, seed=0)
        for t, poses in enumerate(record["poses"]):
            np.testing.assert_array_equal(record["distance"][t], control.distances(poses, task)[0])
    count = len(record["pokes"])
    assert 1 <= count <= 4 and record["rgb"].shape == (count + 1, 48, 64, 3)
    assert record["marks"].shape == (count + 1, 1, 3) and np.isfinite(record["starts"]).all()
    assert record["distance"][-1, 0] < 0.35 * record["distance"][0, 0]
    flow = true_scene_flow(record["marks"][0], record["movers"] + 1, record["poses"][0], record["poses"][-1])
    assert np.linalg.norm(record["marks"][0] + flow - record["marks"][-1]) < 0.02, "the mark was lost"


@pytest.mark.parametrize("policy", ["random", "greedy", "no_motion", "oracle"])
def test_the_other_planners(policy, task, run):
    record = control.closed_loop(task, run, policy, SMALL, budget=2, seed=1, ahead=1)
    left = record["distance"][-1, 0] / record["distance"][0, 0]
    if policy == "no_motion":  # under this model no poke helps, so none is made
        assert len(record["pokes"]) == 0 and left == 1 and record["starts"].shape == (0, 2)
    else:
        assert len(record["pokes"]) == 2
    if policy in ("greedy", "oracle"):
        assert left < 0.9


def next_plans(monkeypatch, *plans):
    """Make the planner return these, one after the other, then raise NoPoke."""
    coming = iter(plans)

    def next_plan(*_):
        found = next(coming, None)
        if found is None:
            raise planning.NoPoke("no room")
        return Plan(found, np.nan, np.nan)
    monkeypatch.setattr(control, "next_plan", next_plan)


@pytest.fixture
def pokes(task):
    """Two pokes that have room, (2, 3)."""
    view = control.first_look(task)[1]
    return planning.draw_pokes(np.random.default_rng(4), 2, view, task.settings)[:, 0]


def test_of_a_plan_of_two_pokes_the_first_is_carried_out(task, run, pokes, monkeypatch):
    next_plans(monkeypatch, pokes)
    done, poke = [], task.arena.poke
    monkeypatch.setattr(task.arena, "poke", lambda *given: (done.append(given[0]), poke(*given)))
    record = control.closed_loop(task, run, "learned", SMALL, budget=5)
    np.testing.assert_array_equal(record["pokes"], pokes[:1])
    np.testing.assert_array_equal(done, pokes[:1])
    assert record["stopped"] == "no room"
    with pytest.raises(planning.NoPoke):  # what was done is kept, but at first it is an error
        control.closed_loop(task, run, "learned", SMALL, budget=5)


@pytest.mark.parametrize("now, costs, lowest, rest, left, asked, pokes, ahead", [(*case, 3) for case in [
    (1.9, {1: 1.8}, np.inf, 0, 9, [1], 1),  # near the goal one is enough
    (5.0, {1: 4.4}, np.inf, 0, 9, [1], 1),  # it brings more than a tenth
    (np.nan, {1: np.nan}, np.inf, 0, 9, [1], 1),  # a planner without costs
    (5.0, {1: 4.6, 3: 2.0}, np.inf, 0, 9, [1, 3], 3),
    (5.0, {1: 4.6, 3: 4.0}, np.inf, 0, 9, [1, 3], 1),  # three bring less each
    (5.0, {1: 4.4, 3: 2.0}, 4.5, 0, 9, [1, 3], 3),  # it only takes back what the last poke did
    (5.0, {1: 4.6, 3: None}, np.inf, 0, 9, [1, 3], 1),  # no room, so far ahead
    (5.0, {1: 4.6, 2: 2.0}, np.inf, 0, 2, [1, 2], 2), (5.0, {1: 4.6}, np.inf, 0, 1, [1], 1),  # no more than are left
    (5.0, {2: 4.0}, np.inf, 2, 9, [2], 2),  # the rest of a plan
    (5.0, {2: 4.8, 1: 4.4}, np.inf, 2, 9, [2, 1], 1),  # which brings little now
    (5.0, {2: None, 1: 4.8, 3: 2.0}, np.inf, 2, 9, [2, 1, 3], 3),
    (1.5, {2: 1.6, 1: 1.49}, np.inf, 2, 9, [2, 1], 1), (5.0, {1: None, 3: None}, np.inf, 0, 9, [1, 3], 0)]] + [
    (5.0, {1: 4.6}, np.inf, 0, 9, [1], 1, 1), (5.0, {1: 4.6, 4: 1.0}, np.inf, 0, 9, [1, 4], 4, 4)])
def test_it_looks_further_ahead_where_a_poke_hardly_helps_far_from_the_goal(now, costs, lowest, rest, left, asked,
                                                                           pokes, ahead):
    calls, rest = [], np.ones((rest, 3))

    def ask(search, given):
        calls.append(search.horizon)
        assert given is rest
        if costs[search.horizon] is None:
            raise planning.NoPoke("no room")
        return Plan(np.zeros((search.horizon, 3)), costs[search.horizon], now)
    if pokes:
        assert len(control.choose_plan(ask, SMALL, ahead, rest, lowest, left).pokes) == pokes
    else:
        with pytest.raises(planning.NoPoke, match="no room"):
            control.choose_plan(ask, SMALL, ahead, rest, lowest, left)
    assert calls == asked


def test_a_plan_is_followed_and_why_it_ends_is_said(task, run, pokes, monkeypatch):
    asked, nows = [], [5.0, 6.0, 7.0]

    def choose_plan(ask, search, ahead, rest, lowest, left):
        now = nows[len(asked)]
        asked.append((ahead, np.reshape(rest, (-1, 3)).tolist(), lowest, left))
        return Plan(pokes, (0.0, 0.0, now)[len(asked) - 1], now)
    monkeypatch.setattr(control, "choose_plan", choose_plan)
    places = [np.zeros(2), np.full(2, np.nan)]  # the second poke finds no room
    monkeypatch.setattr(control, "carry_out", lambda *given: places[len(asked) - 1])
    record = control.closed_loop(task, run, "learned", SMALL, budget=5, ahead=2)
    np.testing.assert_array_equal(record["pokes"], pokes[[0, 0]])
    assert asked == [(2, [], np.inf, 5), (2, pokes[1:].tolist(), 5.0, 4), (2, [], 5.0, 3)]
    assert record["stopped"] == "no poke would help, the model says; what is left costs 7.00"


def test_where_a_mark_shall_stay_it_looks_no_further_than_it_is_told(task, run, pokes, monkeypatch):
    asked = []
    monkeypatch.setattr(control, "choose_plan", lambda ask, search, ahead, *_: asked.append(ahead) or Plan(pokes, 0, 1))
    for slack in (0.0, 1.0):  # m: so near to its goal a mark shall stay, none and every
        monkeypatch.setattr(control, "SLACK", slack)
        control.closed_loop(task, run, "learned", SMALL, budget=1)
    assert asked == [3, 1]


def test_sequences_are_drawn_poke_by_poke_where_the_last_one_led_and_the_best_goes_on():
    view, search = island(), Search(horizon=3, candidates=20, elites=4)
    goal, rollout = goal_at(view, [-0.15, 0, 0]), shift_along(view, 0.05)

    def drawn(horizon, rest=(), rollout=rollout, view=view):
        return control.draw_sequences(
            lambda sequences: planning_cost(rollout(sequences)[0][:, -1], view, goal, CAMERA, search),
            np.random.default_rng(0), rollout, view, SETTINGS, replace(search, horizon=horizon), rest)
    found = drawn(3)
    np.testing.assert_array_equal(found[:, :1], drawn(1))
    before = np.concatenate([np.zeros((20, 1, 2)), rollout(found)[0][:, :2, -1, :2]], axis=1)
    assert np.abs(found[..., :2] - before).max() < 0.05, "targets lie on the object, where it then is"
    assert np.median(np.abs(found[:, 1:, 2] % (2 * np.pi) - np.pi)) < 0.5, "the later ones go for the goal, -x"
    rest = np.ones((2, 3), np.float32)
    np.testing.assert_array_equal(drawn(2, rest)[0], rest)
    assert len(drawn(2, rest)) == 21 and len(drawn(3, rest)) == 20

    x, y = np.meshgrid(np.arange(-0.24, 0.25, 0.02), np.arange(-0.24, 0.25, 0.02))
    everywhere = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.03)])
    heap = island(marks=np.full(everywhere.shape, [0, 0, 0.03]))

    def scattered(sequences):  # by pokes to the left: no finger finds room then
        clouds, starts = shift_along(heap, 0.0)(sequences)
        clouds[sequences[:, 0, 2] > 0, :, -len(everywhere):] = everywhere
        return clouds, starts
    assert 0 < len(drawn(2, rollout=scattered, view=heap)) < 20, "what leaves no room for the next poke is dropped"


def test_the_rest_of_a_plan_is_a_candidate_of_the_next(task, run):
    (_, _, labels), view, goal = control.first_look(task)
    best = control.next_plan("learned", task, view, labels, goal, run, np.random.default_rng(0), Search())
    search = Search(candidates=4, elites=2, iterations=1)
    alone, found = (control.next_plan("learned", task, view, labels, goal, run, np.random.default_rng(9), search, rest)
                    for rest in ((), best.pokes))
    assert found.cost <= best.cost < alone.cost


def test_where_bullet_finds_the_finger_s_way_taken_the_next_start_is_used_or_the_poke_is_spent(task, run, pokes,
                                                                                               monkeypatch):
    asked = []
    monkeypatch.setattr(task.arena, "descent_is_free", lambda *place: asked.append(place) or len(asked) == 2)
    view = control.first_look(task)[1]
    start = control.carry_out(task.arena, view, pokes[0], task.settings)
    np.testing.assert_array_equal(start, asked[1])
    assert len(asked) == 2 and np.linalg.norm(pokes[0, :2] - asked[0]) < np.linalg.norm(pokes[0, :2] - start)
    before = task.arena.poses()
    next_plans(monkeypatch, pokes[:1])
    record = control.closed_loop(task, run, "learned", SMALL, budget=1)
    assert len(record["pokes"]) == 1 and np.isnan(record["starts"]).all()
    np.testing.assert_array_equal(record["poses"], np.stack([before, before]))
    np.testing.assert_array_equal(record["marks"][1], record["marks"][0])
