"""Sec. III-H and IV-G: the one model that plans, legal pokes, rollouts, the cost, CEM."""
from dataclasses import replace

import numpy as np
import pytest
from tiny import SETTINGS, TINY, camera, random_run, tiny_pokes

from hind4sight_min import planning
from hind4sight_min.geometry import project
from hind4sight_min.interactions import cell_centres, cells_of, finger_fits, occupied_grid, with_neighbours
from hind4sight_min.lab import evaluation
from hind4sight_min.planning import Goal, Search, View, cem, draw_pokes, plan, planning_cost, possible_starts, roll
from hind4sight_min.scene import Scene
from hind4sight_min.training import scenes_of

CAMERA = camera(64, 48, 77.0)


def island(count=20, seed=0, marks=((0, 0, 0.03),), table=()):
    """A View of one small object at (0, 0) with marks on it, and perhaps points of the table."""
    points = np.random.default_rng(seed).uniform([-0.01, -0.01, 0.02], [0.01, 0.01, 0.03], (count, 3))
    cloud = np.vstack([np.reshape(table, (-1, 3)), points, marks]).astype(np.float32)[None]
    on = np.arange(cloud.shape[1])[None] >= len(table)
    return View(Scene(cloud, np.ones_like(on), on, on), len(marks))


# --- the model ----------------------------------------------------------------------------------------------------

def test_planning_predicts_exactly_what_was_evaluated_and_each_of_many_candidates_as_alone(monkeypatch):
    data = tiny_pokes(cam=CAMERA)
    run = random_run(TINY, data=data)
    monkeypatch.setattr(planning, "CHUNK", 2)
    for row in range(3):
        answer = evaluation.ask(run, data, row)
        marks = answer.before.points[0][answer.before.occupied[0]][:1]
        view = planning.view_of(answer.before, marks[:0])
        step = planning.learned_step(run, view)
        alone = np.stack([step(view.cloud[None], poke[None])[0] for poke in data.pokes[:5]])
        np.testing.assert_array_equal(alone[row], answer.prediction.points[0])
        assert np.abs(alone[row] - view.cloud).max() > 1e-3
        together = step(np.repeat(view.cloud[None], 5, axis=0), data.pokes[:5])
        np.testing.assert_allclose(together, alone, atol=1e-6)
        marked = planning.view_of(answer.before, marks)
        again = planning.learned_step(run, marked)(marked.cloud[None], data.pokes[[row]])
        assert np.abs(again[0, -1] - marks).max() > 1e-4  # a mark moves with its object


def test_a_cloud_that_moved_is_looked_at_where_it_is_now():
    data = tiny_pokes(cam=CAMERA)
    run, (scene, _) = random_run(TINY, data=data), scenes_of(data[[2]])
    view = planning.view_of(scene, scene.points[0][:0])
    away = view.cloud[None] + np.float32([[[0.5, 0, 0]]]) * view.occupied[None, :, None]
    moved = planning.learned_step(run, view)(away, data.pokes[[2]])
    np.testing.assert_array_equal(moved[0][view.occupied], away[0][view.occupied])


def test_a_goal_is_where_objects_stand_and_empty_scenes_are_refused():
    scene, _ = scenes_of(tiny_pokes()[[0]])
    empty = replace(scene, occupied=np.zeros_like(scene.occupied))
    with pytest.raises(planning.NoPoke, match="scene: no object"):
        planning.view_of(empty, np.zeros((0, 3), np.float32))
    goal = planning.goal_of([(3, 3)], scene)
    np.testing.assert_array_equal(goal.points, scene.points[scene.occupied], err_msg="the table is no part of a goal")
    with pytest.raises(ValueError, match="goal scene: no object"):
        planning.goal_of([(3, 3)], empty)


# --- legal pokes --------------------------------------------------------------------------------------------------

def test_possible_starts_against_a_loop():
    rng = np.random.default_rng(5)
    grid = rng.random((60, 20, 20)) < 0.04
    pokes = np.column_stack([rng.uniform(-0.26, 0.26, (60, 2)), rng.uniform(-np.pi, np.pi, 60)])
    pokes[:6, 0], pokes[:6, 2], grid[:6, :, 19] = 0.251, 0.1, True  # next to an object, but on a wall
    found, near, possible_ones = possible_starts(pokes, grid, SETTINGS, lengths=3), with_neighbours(grid), 0
    for j, (x, y, angle) in enumerate(pokes):
        for length, start in zip((0.10, 0.12, 0.14), found[j]):
            expected = np.array([x - length * np.cos(angle), y - length * np.sin(angle)])
            possible = (max(abs(x), abs(y)) < 0.25 and near[j].ravel()[cells_of([x, y], SETTINGS)]
                        and finger_fits(expected[None, None], grid[[j]], SETTINGS)[0, 0])
            np.testing.assert_allclose(start, expected if possible else [np.nan, np.nan])
            possible_ones += possible
    assert 15 < possible_ones < 150
    for row, options in zip(planning.first_start(found), found):
        options = options[np.isfinite(options[:, 0])]
        assert np.isnan(row).all() if not len(options) else (row == options[0]).all()


def test_drawn_pokes_lie_on_what_stands_there_and_come_from_anywhere():
    scene, _ = scenes_of(tiny_pokes(cam=CAMERA)[[3]])
    view = planning.view_of(scene, scene.points[0][:0])
    drawn = draw_pokes(np.random.default_rng(6), 300, view, SETTINGS, horizon=2)
    assert drawn.shape == (300, 2, 3)
    grid = occupied_grid(view.cloud[None], view.occupied, SETTINGS)
    occupied = cell_centres(SETTINGS)[np.flatnonzero(grid[0])]
    away = drawn[..., None, :2] - occupied
    away = np.take_along_axis(away, np.abs(away).max(axis=-1).argmin(axis=-1)[..., None, None], axis=2)
    assert np.abs(away).max() < 0.0126 and away.std() == pytest.approx(0.025 / 12 ** 0.5, rel=0.1), "anywhere in a cell"
    starts = possible_starts(drawn[:, 0], np.repeat(grid, 300, axis=0), SETTINGS)
    assert np.isfinite(starts[..., 0]).any(axis=1).all()
    assert np.histogram(drawn[..., 1, 2], bins=6, range=(-np.pi, np.pi))[0].min() > 25
    x, y = np.meshgrid(np.arange(-0.24, 0.25, 0.02), np.arange(-0.24, 0.25, 0.02))
    full = island(marks=np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.03)]))
    with pytest.raises(planning.NoPoke, match="no room for the finger"):
        draw_pokes(np.random.default_rng(7), 10, full, SETTINGS)


# --- rollouts -----------------------------------------------------------------------------------------------------

def test_rolling_carries_the_cloud_from_poke_to_poke():
    view = island()

    def step(clouds, pokes):  # everything moves half-way to the target
        return (clouds + np.column_stack([pokes[:, :2], np.full(len(pokes), 0.025)])[:, None]) / 2
    sequences = np.float32([[[0.01, 0, 0.3], [0.01, 0.005, 2.0]], [[0.01, 0, 0.3], [0.2, 0.2, 0.0]]])
    clouds, starts = roll(step, view, sequences, SETTINGS)
    first = (view.cloud + [0.01, 0, 0.025]) / 2
    np.testing.assert_allclose(clouds[:, 0], [first, first], atol=1e-6)
    np.testing.assert_allclose(clouds[0, 1], (first + [0.01, 0.005, 0.025]) / 2, atol=1e-6)
    np.testing.assert_allclose(starts[0, 0], [0.01 - 0.1 * np.cos(0.3), -0.1 * np.sin(0.3)], atol=1e-6)
    assert np.isfinite(starts[0]).all() and np.isnan(starts[1, 1]).all()  # there is nothing at (0.2, 0.2)


def test_room_for_the_finger_is_sought_where_things_are_by_then():
    view = island()
    sequences = np.float32([[[0, 0, 0], [0.12, 0, 2.0]], [[0, 0, 0], [0, 0, 2.0]]])
    _, starts = roll(lambda clouds, pokes: clouds + np.float32([0.12, 0, 0]), view, sequences, SETTINGS)
    np.testing.assert_array_equal(np.isfinite(starts[..., 0]), [[True, True], [True, False]], err_msg="first scene?")


# --- the cost -----------------------------------------------------------------------------------------------------

def test_the_cost_against_brute_force():
    rng, view = np.random.default_rng(8), island()
    clouds = view.cloud + rng.normal(0, 0.02, (3, 1, 3)).astype(np.float32)
    goal = Goal(project(np.array([[0.05, 0.02, 0.03]]), CAMERA), rng.uniform(0, 0.05, (15, 3)))
    away = np.linalg.norm(project(clouds[:, -1], CAMERA) - goal.pixels, axis=1) * CAMERA.pixel_size  # m on the table
    assert (away > planning.SLACK).all()
    squared = np.sum((clouds[:, :, None] - goal.points) ** 2, axis=3)
    chamfer = squared.min(axis=2).mean(axis=1) + squared.min(axis=1).mean(axis=1)
    for pixel, shape in ((1.0, 0.0), (0.0, 1.0), (2.0, 3.0)):
        found = planning_cost(clouds, view, goal, CAMERA, Search(pixel_weight=pixel, chamfer_weight=shape))
        np.testing.assert_allclose(found, 100 * (pixel * (away - planning.SLACK) + shape * np.sqrt(chamfer)), rtol=1e-5)
    with pytest.raises(ValueError, match="without a goal picture"):
        planning_cost(clouds, view, Goal(goal.pixels, None), CAMERA, Search())


def test_the_cost_is_the_mean_over_the_marks_and_the_shape_that_of_the_objects():
    view = island(marks=[[0, 0, 0.03], [0.01, 0, 0.03]], table=[[0.2, 0.2, 0], [-0.2, 0.1, 0]])
    goal = Goal(project(view.cloud[-2:], CAMERA) + [[10, 0], [0, 4]], None)
    found = planning_cost(view.cloud[None], view, goal, CAMERA, Search(chamfer_weight=0.0))
    assert found[0] == pytest.approx(100 * ((10 + 4) / 2 * CAMERA.pixel_size - planning.SLACK), rel=1e-4)
    there = Goal(project(view.cloud[-2:], CAMERA), view.cloud[2:])
    assert planning_cost(view.cloud[None], view, there, CAMERA, Search())[0] == 0


# --- the cross entropy method -------------------------------------------------------------------------------------

def bowl(sequences):
    """Lowest at (0.03, -0.05, pi): on the seam of the circle."""
    x, y, angle = np.moveaxis(sequences[:, 0].astype(float), -1, 0)
    return (x - 0.03) ** 2 + (y + 0.05) ** 2 + 0.01 * (1 + np.cos(angle))


def first_population(seed, count=100):
    return np.random.default_rng(seed).uniform([-0.2, -0.2, -np.pi], [0.2, 0.2, np.pi],
                                               (count, 1, 3)).astype(np.float32)


def test_refit_against_numpy_and_on_the_circle():
    elites = np.random.default_rng(0).normal([0.1, -0.1, 0.5], [0.02, 0.03, 0.2], (50, 2, 3))
    mean, deviation = planning.refit(elites)
    np.testing.assert_allclose(mean[:, :2], elites[..., :2].mean(axis=0))
    np.testing.assert_allclose(deviation[:, :2], elites[..., :2].std(axis=0))
    np.testing.assert_allclose(mean[:, 2], elites[..., 2].mean(axis=0), atol=0.01)
    elites[..., 2] = np.where(np.arange(50) % 2, np.pi - 0.1, -np.pi + 0.1)[:, None]  # both sides of the seam
    mean, deviation = planning.refit(elites)
    np.testing.assert_allclose(np.abs(mean[:, 2]), np.pi, atol=1e-9, err_msg="directions are not circular")
    np.testing.assert_allclose(deviation[:, 2], 0.1)
    assert (planning.refit(elites[:1])[1] >= [0.002, 0.002, 0.03]).all(), "the spread collapses"


def test_cem_finds_the_minimum_of_a_bowl_where_a_part_is_forbidden():
    seen = []

    def cost(sequences):
        return np.where(sequences[:, 0, 0] > 0.1, np.nan, bowl(sequences))
    best, lowest = cem(cost, first_population(1), np.random.default_rng(1),
                       Search(candidates=100, elites=10, iterations=12), lambda *state: seen.append(state))
    np.testing.assert_allclose(best[0, :2], [0.03, -0.05], atol=0.006)
    assert abs(abs(best[0, 2]) - np.pi) < 0.1 and lowest == bowl(best[None])[0]
    assert [state[0] for state in seen] == list(range(12)) and np.isinf(seen[0][2]).any()
    assert (np.diff([state[4][0, 0] for state in seen[:4]]) < 0).all()  # the Gaussian narrows
    for _, population, costs, mean, deviation in seen:
        assert np.abs(population[..., 2]).max() <= np.pi + 1e-6, "directions are not wrapped"
        elites = population[np.argsort(costs, kind="stable")[:10]]
        elites = elites[np.isfinite(np.sort(costs)[:10])]
        for found, expected in zip((mean, deviation), planning.refit(elites)):
            np.testing.assert_array_equal(found, expected)
    assert all(len(np.unique(population[1:, 0, 0])) > 90 for _, population, *_ in seen), "the spread collapses"


def test_cem_keeps_the_best_ever_and_begins_every_round_with_it():
    costs, rounds = [], []

    def cost(sequences):  # from the second round on everything new is worse
        rounds.append(sequences.copy())
        costs.append(bowl(sequences) + (len(costs) > 0))
        return costs[-1]
    best, lowest = cem(cost, first_population(2), np.random.default_rng(2), Search(iterations=4))
    assert lowest == costs[0].min()
    for population in rounds[1:]:
        np.testing.assert_array_equal(population[0], best)


@pytest.mark.parametrize("bad", [np.inf, np.nan])
def test_what_is_impossible_is_no_elite_and_where_nothing_is_possible_that_is_said(bad):
    population, means, rng = first_population(4), [], np.random.default_rng(3)
    population[:3] = np.float32([[[0.1, 0.1, 0.5]], [[0.11, 0.1, 0.5]], [[0.12, 0.1, 0.5]]])

    def cost(sequences):  # these three are possible
        return np.where(np.arange(len(sequences)) < 3, 1.0 + np.arange(len(sequences)), bad)
    best, lowest = cem(cost, population, rng, Search(iterations=1), lambda *state: means.append(state[3]))
    np.testing.assert_allclose(means[0], [[0.11, 0.1, 0.5]], rtol=1e-5)
    np.testing.assert_array_equal(best, population[0])
    assert lowest == 1
    with pytest.raises(planning.NoPoke, match="no candidate poke is possible"):
        cem(lambda s: np.full(len(s), bad), population, rng, Search())


@pytest.mark.parametrize("changes, named", [
    (dict(candidates=0), "candidates"), (dict(elites=65), "elites"), (dict(iterations=0), "iterations"),
    (dict(horizon=0), "horizon"), (dict(pixel_weight=-1.0), "pixel_weight"), (dict(chamfer_weight=np.nan), "chamfer"),
    (dict(pixel_weight=0.0, chamfer_weight=0.0), "chamfer_weight")])
def test_a_search_that_cannot_be(changes, named):
    with pytest.raises(ValueError, match=named):
        Search(**changes)


# --- plans --------------------------------------------------------------------------------------------------------

def shift_along(view, length):
    """Rollouts of a model under which every poke shifts everything by `length` m along itself."""
    def step(clouds, pokes):
        return clouds + length * np.column_stack([np.cos(pokes[:, 2]), np.sin(pokes[:, 2]), 0 * pokes[:, 2]])[:, None]
    return lambda sequences: roll(step, view, sequences, SETTINGS)


def goal_at(view, there):
    return Goal(project(view.cloud[-1:] + there, CAMERA), view.cloud + there)


def test_plan_pushes_towards_the_goal_under_a_model_known_in_closed_form():
    view, rounds = island(), []
    goal, rollout = goal_at(view, [-0.04, 0.0, 0.0]), shift_along(view, 0.04)
    found = plan(rollout, view, goal, CAMERA, SETTINGS, Search(iterations=6), np.random.default_rng(9),
                 lambda i, population, costs, mean, deviation: rounds.append(costs.min()))
    assert abs(abs(found.pokes[0, 2]) - np.pi) < 0.15
    assert found.cost < 0.1 * found.now and found.cost == min(rounds)
    again = plan(rollout, view, goal, CAMERA, SETTINGS, Search(iterations=6), np.random.default_rng(9))
    np.testing.assert_array_equal(again.pokes, found.pokes)


def test_a_plan_of_two_pokes_costs_what_is_left_after_both():
    view, search = island(), Search(horizon=2, candidates=128, iterations=3)
    goal = goal_at(view, [-0.06, 0, 0])
    found = plan(shift_along(view, 0.02), view, goal, CAMERA, SETTINGS, search, np.random.default_rng(0))
    clouds, starts = shift_along(view, 0.02)(found.pokes[None])
    costs = [planning_cost(clouds[:, h], view, goal, CAMERA, search)[0] for h in (0, 1)]
    assert found.cost == pytest.approx(costs[1]) and costs[1] < costs[0] and np.isfinite(starts).all()


def test_a_sequence_that_no_finger_can_start_is_ruled_out_however_cheap():
    view = island()
    goal = goal_at(view, [0, 0, 0])

    def rollout(sequences):  # all is free of cost, but only pokes along +x have a start
        clouds, starts = shift_along(view, 0.0)(sequences)
        dear = np.cos(sequences[..., 2]) > 0
        clouds = clouds + 0.05 * dear[..., None, None]
        return clouds, np.where(dear[..., None], 0.0, np.nan)
    found = plan(rollout, view, goal, CAMERA, SETTINGS, Search(horizon=2), np.random.default_rng(0))
    assert (np.cos(found.pokes[:, 2]) > 0).all(), "nor one whose second poke cannot"
