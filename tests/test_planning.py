from dataclasses import asdict, replace

import numpy as np
import pytest

from hind4sight_min import evaluation, planning, training
from hind4sight_min.__main__ import data_small
from hind4sight_min.geometry import project
from hind4sight_min.interactions import cell_centres, load_interactions, load_truth, true_scene_flow
from hind4sight_min.planning import Goal, Search, View
from hind4sight_min.simulator import Settings, arena_camera, occupied_cells

SETTINGS = asdict(Settings())
CAMERA = arena_camera(64, 48)


@pytest.fixture(scope="module")
def pokes():
    return load_interactions(data_small() / "test"), load_truth(data_small() / "test")


@pytest.fixture(scope="module")
def run():
    return training.load_run(data_small() / "checkpoint.npz")


def view_of_row(interactions, row, marks=()):
    return planning.view_of(interactions.depth_before[row], interactions.empty_depth, interactions.camera,
                            interactions.meta["settings"], np.float32(marks).reshape(-1, 3))


def island(count=20, seed=0):
    """A View of one small object at (0, 0) with a mark on it, and nothing else."""
    points = np.random.default_rng(seed).uniform([-0.01, -0.01, 0.02], [0.01, 0.01, 0.03], (count, 3))
    cloud = np.float32(np.vstack([points, [[0, 0, 0.03]]]))
    return View(cloud, np.ones(count + 1, bool), np.ones(count + 1, bool), cloud[:, 2], 1)


# --- CEM ------------------------------------------------------------------------------------------------------

def test_refit_against_numpy_and_on_the_circle():
    rng = np.random.default_rng(0)
    elites = rng.normal([0.1, -0.1, 0.5], [0.02, 0.03, 0.2], (50, 2, 3))
    mean, deviation = planning.refit(elites)
    np.testing.assert_allclose(mean[:, :2], elites[..., :2].mean(axis=0))
    np.testing.assert_allclose(deviation[:, :2], elites[..., :2].std(axis=0))
    np.testing.assert_allclose(mean[:, 2], elites[..., 2].mean(axis=0), atol=0.01)
    elites[..., 2] = np.where(np.arange(50) % 2, np.pi - 0.1, -np.pi + 0.1)[:, None]  # both sides of the seam
    mean, deviation = planning.refit(elites)
    np.testing.assert_allclose(np.abs(mean[:, 2]), np.pi, atol=1e-9)
    np.testing.assert_allclose(deviation[:, 2], 0.1)
    np.testing.assert_allclose(planning.refit(elites[:1])[1], np.tile(planning.LEAST, (2, 1)))  # never quite narrow


def bowl(sequences):
    """Lowest at (0.03, -0.05, pi): on the seam of the circle."""
    x, y, angle = np.moveaxis(sequences[:, 0].astype(float), -1, 0)
    return (x - 0.03) ** 2 + (y + 0.05) ** 2 + 0.01 * (1 + np.cos(angle))


def first_population(rng, count=100):
    return rng.uniform([-0.2, -0.2, -np.pi], [0.2, 0.2, np.pi], (count, 1, 3)).astype(np.float32)


def test_cem_finds_the_minimum_of_a_bowl_where_a_part_is_forbidden():
    rng, seen = np.random.default_rng(1), []

    def cost(sequences):
        return np.where(sequences[:, 0, 0] > 0.1, np.nan, bowl(sequences))
    best, lowest = planning.cem(cost, first_population(rng), rng, Search(candidates=100, elites=10, iterations=12),
                                lambda *state: seen.append(state))
    np.testing.assert_allclose(best[0, :2], [0.03, -0.05], atol=0.006)
    assert abs(abs(best[0, 2]) - np.pi) < 0.1
    assert lowest == bowl(best[None])[0]
    assert [state[0] for state in seen] == list(range(12))
    assert all(state[2].shape == (100,) and not np.isnan(state[2]).any() for state in seen)
    assert np.isinf(seen[0][2]).any()
    assert (np.diff([state[4][0, 0] for state in seen[:4]]) < 0).all()  # the Gaussian narrows


def test_cem_keeps_the_best_ever_seen():
    rng, found = np.random.default_rng(2), []

    def cost(sequences):  # from the second round on everything new is worse
        found.append(bowl(sequences) if not found else bowl(sequences) + 1)
        return found[-1]
    best, lowest = planning.cem(cost, first_population(rng), rng, Search(iterations=4))
    assert lowest == found[0].min() and bowl(best[None])[0] == lowest


def test_every_round_starts_with_the_best_so_far():
    rng, seen = np.random.default_rng(2), []
    planning.cem(bowl, first_population(rng), rng, Search(iterations=5), lambda *state: seen.append(state))
    best, lowest = None, np.inf
    for _, population, costs, *_ in seen:
        if best is not None:
            np.testing.assert_array_equal(population[0], best)
        if costs.min() < lowest:
            best, lowest = population[costs.argmin()].copy(), costs.min()


def test_cem_with_fewer_possible_candidates_than_elites_and_with_none():
    rng, population = np.random.default_rng(3), first_population(np.random.default_rng(4))
    only = population[7].copy()

    def cost(sequences):
        return np.where((sequences == only).all(axis=(1, 2)), 1.0, np.inf)
    best, lowest = planning.cem(cost, population, rng, Search(iterations=3))
    np.testing.assert_array_equal(best, only)
    assert lowest == 1
    with pytest.raises(ValueError, match="no candidate poke is possible"):
        planning.cem(lambda s: np.full(len(s), np.nan), population, rng, Search())


@pytest.mark.parametrize("changes, named", [
    (dict(candidates=0), "candidates"), (dict(elites=65), "elites"), (dict(iterations=0), "iterations"),
    (dict(horizon=0), "horizon"), (dict(pixel_weight=-1.0), "pixel_weight"),
    (dict(pixel_weight=0.0, chamfer_weight=0.0), "chamfer_weight")])
def test_search_that_cannot_be(changes, named):
    with pytest.raises(ValueError, match=named):
        Search(**changes)


# --- what the robot sees --------------------------------------------------------------------------------------

def test_standing_and_the_grid_agree_with_the_simulators_background_subtraction(pokes):
    interactions, _ = pokes
    for row in (0, 17, 49):
        view = view_of_row(interactions, row)
        grid = planning.occupied_grid(view.cloud[None], view.occupied, SETTINGS)[0]
        depth, camera = interactions.depth_before[row], interactions.camera
        expected = occupied_cells(depth, interactions.empty_depth, camera, SETTINGS)
        np.testing.assert_array_equal(grid, expected)
        assert 10 < grid.sum() < 100


def test_marks_become_points_and_pixels_become_places(pokes):
    interactions, truth = pokes
    rows, columns = np.nonzero(truth.labels[0] == 1)
    marks = np.column_stack([columns, rows])[:3]
    arguments = interactions.depth_before[0], interactions.empty_depth, interactions.camera, SETTINGS
    points = planning.points_at(marks, *arguments)
    np.testing.assert_allclose(project(points, interactions.camera), marks, atol=1e-3)
    places = planning.places_at(marks, points[:, 2], interactions.camera, SETTINGS)
    np.testing.assert_allclose(places, points[:, :2], atol=1e-5)
    for wrong, said in (([(64, 3)], "outside the 64 x 48"), ([(np.nan, 3)], "outside"), ([(0, 47)], "background"),
                        ([], "at least one"), ([1, 2], "expected")):
        with pytest.raises(ValueError, match=said):
            planning.points_at(wrong, *arguments)
    for wrong, said in (([(70, 3)], "outside the 64 x 48"), ([(0, 47)], "outside the walls"),
                        ([(1, 2, 3)], "one per mark")):
        with pytest.raises(ValueError, match=said):
            planning.places_at(wrong, [0.03], interactions.camera, SETTINGS)


def test_empty_scenes_are_refused(pokes):
    interactions, _ = pokes
    empty = interactions.empty_depth
    with pytest.raises(ValueError, match="scene: no object"):
        planning.view_of(empty, empty, interactions.camera, SETTINGS, np.zeros((0, 3), np.float32))
    with pytest.raises(ValueError, match="goal scene: no object"):
        planning.goal_of([(3, 3)], interactions.camera, SETTINGS, empty, empty)


def test_a_checkpoint_of_another_camera_is_refused(run):
    training.check_camera(run, CAMERA)
    with pytest.raises(ValueError, match="another camera"):
        training.check_camera(run, replace(CAMERA, fx=CAMERA.fx + 1))


# --- actions --------------------------------------------------------------------------------------------------

def test_possible_starts_against_a_loop():
    rng = np.random.default_rng(5)
    grid = rng.random((40, 20, 20)) < 0.04
    pokes = np.column_stack([rng.uniform(-0.26, 0.26, (40, 2)), rng.uniform(-np.pi, np.pi, 40)])
    found = planning.possible_starts(pokes, grid, SETTINGS, lengths=3)
    counted = 0
    for j, (x, y, angle) in enumerate(pokes):
        def near(px, py):
            column, row = (min(max(int(np.floor((v + 0.25) / 0.025)), 0), 19) for v in (px, py))
            return grid[j, max(row - 1, 0):row + 2, max(column - 1, 0):column + 2].any()
        for length, start in zip((0.10, 0.12, 0.14), found[j]):
            px, py = x - length * np.cos(angle), y - length * np.sin(angle)
            possible = (max(abs(px), abs(py)) < 0.24 and max(abs(x), abs(y)) < 0.25 and near(x, y) and not near(px, py))
            assert np.isfinite(start).all() == possible
            if possible:
                np.testing.assert_allclose(start, [px, py])
                counted += 1
    assert counted > 10
    first = planning.first_start(found)
    for row, options in zip(first, found):
        options = options[np.isfinite(options[:, 0])]
        assert np.isnan(row).all() if not len(options) else (row == options[0]).all()


def test_drawn_pokes_lie_on_what_stands_there_and_come_from_anywhere(pokes):
    interactions, _ = pokes
    view = view_of_row(interactions, 3)
    drawn = planning.draw_pokes(np.random.default_rng(6), 300, view, SETTINGS, horizon=2)
    assert drawn.shape == (300, 2, 3)
    grid = planning.occupied_grid(view.cloud[None], view.occupied, SETTINGS)
    occupied = cell_centres(SETTINGS)[np.flatnonzero(grid[0])]
    away = np.abs(drawn[..., None, :2] - occupied).max(axis=-1).min(axis=-1)
    assert away.max() < 0.0126
    starts = planning.possible_starts(drawn[:, 0], np.repeat(grid, 300, axis=0), SETTINGS)
    assert np.isfinite(starts[..., 0]).any(axis=1).all()
    assert np.histogram(drawn[..., 2], bins=6, range=(-np.pi, np.pi))[0].min() > 30


def test_no_room_behind_any_object_is_said():
    x, y = np.meshgrid(np.arange(-0.24, 0.25, 0.02), np.arange(-0.24, 0.25, 0.02))
    cloud = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.03)]).astype(np.float32)
    full = View(cloud, np.ones(len(cloud), bool), np.ones(len(cloud), bool), cloud[:, 2], 0)
    with pytest.raises(ValueError, match="no room for the finger"):
        planning.draw_pokes(np.random.default_rng(7), 10, full, SETTINGS)


# --- rollouts -------------------------------------------------------------------------------------------------

def test_predict_is_the_model_that_was_evaluated(pokes, run):
    # On the cloud of a picture the points given to the model are the most prominent ones of its window.
    interactions, _ = pokes
    for row in (1, 5, 30):
        batch, prediction, *_ = evaluation.predict(run, interactions, np.array([row]))
        view = view_of_row(interactions, row)
        camera, poke = interactions.camera, interactions.pokes[[row]]
        moved, masks = planning.predict(run, camera, view, view.cloud[None], poke)
        np.testing.assert_allclose(moved[0], prediction.points[0], atol=2e-4)
        assert np.abs(moved[0] - view.cloud).max() > 0.01
        assert np.mean(masks[0] == prediction.masks[0].argmax(axis=1)) > 0.999


def test_rolling_carries_the_cloud_from_poke_to_poke():
    view, settings = island(), SETTINGS

    def step(clouds, pokes):  # everything moves half-way to the target
        target = np.column_stack([pokes[:, :2], np.full(len(pokes), 0.025)])
        return (clouds + target[:, None]) / 2
    sequences = np.float32([[[0.01, 0, 0.3], [0.01, 0.005, 2.0]], [[0.01, 0, 0.3], [0.2, 0.2, 0.0]]])
    clouds, starts = planning.roll(step, view, sequences, settings)
    first = (view.cloud + [0.01, 0, 0.025]) / 2
    np.testing.assert_allclose(clouds[:, 0], [first, first], atol=1e-6)
    np.testing.assert_allclose(clouds[0, 1], (first + [0.01, 0.005, 0.025]) / 2, atol=1e-6)
    np.testing.assert_allclose(starts[0, 0], [0.01 - 0.1 * np.cos(0.3), -0.1 * np.sin(0.3)], atol=1e-6)
    assert np.isfinite(starts[0]).all() and np.isnan(starts[1, 1]).all()  # there is nothing at (0.2, 0.2)


# --- the cost -------------------------------------------------------------------------------------------------

def test_cost_against_brute_force():
    rng = np.random.default_rng(8)
    view = island()
    clouds = view.cloud + rng.normal(0, 0.02, (3, 1, 3)).astype(np.float32)
    goal = Goal(project(np.array([[0.05, 0.02, 0.03]]), CAMERA), rng.uniform(0, 0.05, (15, 3)))
    away = np.linalg.norm(project(clouds[:, -1], CAMERA) - goal.pixels, axis=1)
    assert (away > planning.SLACK).all()
    squared = np.sum((clouds[:, :, None] - goal.points) ** 2, axis=3)
    chamfer = squared.min(axis=2).mean(axis=1) + squared.min(axis=1).mean(axis=1)
    for pixel, shape in ((1.0, 0.0), (0.0, 1.0), (2.0, 3.0)):
        found = planning.planning_cost(clouds, view, goal, CAMERA, Search(pixel_weight=pixel, chamfer_weight=shape))
        expected = pixel * (away - planning.SLACK) + shape * 100 * np.sqrt(chamfer)
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    reached = Goal(project(view.cloud[-1:], CAMERA), view.cloud)
    assert planning.planning_cost(view.cloud[None], view, reached, CAMERA, Search())[0] == 0
    with pytest.raises(ValueError, match="without a goal picture"):
        planning.planning_cost(clouds, view, Goal(goal.pixels, None), CAMERA, Search())


def test_cost_is_the_mean_over_the_marks_and_the_shape_that_of_the_objects():
    view = island()
    table = np.float32([[0.2, 0.2, 0], [-0.2, 0.1, 0]])
    two = View(np.vstack([table, view.cloud, [[0.01, 0, 0.03]]]).astype(np.float32), np.ones(24, bool),
               np.r_[False, False, np.ones(22, bool)], np.full(24, 0.03), 2)
    goal = Goal(project(two.cloud[-2:], CAMERA) + [[10, 0], [0, 4]], None)
    found = planning.planning_cost(two.cloud[None], two, goal, CAMERA, Search(chamfer_weight=0.0))
    assert found[0] == pytest.approx((10 + 4) / 2 - planning.SLACK, rel=1e-4)
    there = Goal(project(two.cloud[-2:], CAMERA), two.cloud[2:])
    assert planning.planning_cost(two.cloud[None], two, there, CAMERA, Search())[0] == 0


def shift_along(view, length):
    """Rollouts of a model under which every poke shifts everything by `length` m along itself."""
    def step(clouds, pokes):
        along = np.column_stack([np.cos(pokes[:, 2]), np.sin(pokes[:, 2]), 0 * pokes[:, 2]])
        return clouds + length * along[:, None]
    return lambda sequences: planning.roll(step, view, sequences, SETTINGS)


def test_a_plan_of_two_pokes_costs_the_mean_of_both():
    view, there, search = island(), np.array([-0.06, 0, 0]), Search(horizon=2, candidates=128, iterations=3)
    goal = Goal(project(view.cloud[-1:] + there, CAMERA), view.cloud + there)
    found = planning.plan(shift_along(view, 0.02), view, goal, CAMERA, SETTINGS, search, np.random.default_rng(0))
    clouds, starts = shift_along(view, 0.02)(found.pokes[None])
    costs = [planning.planning_cost(clouds[:, h], view, goal, CAMERA, search)[0] for h in (0, 1)]
    assert found.cost == pytest.approx(np.mean(costs)) and costs[1] < costs[0] and np.isfinite(starts).all()


def test_arrows_begin_ten_centimetres_before_the_target():
    starts, targets = planning.arrows_of(np.array([[0.05, 0.02, np.pi / 2]]), SETTINGS, CAMERA)
    np.testing.assert_allclose(targets, project(np.array([[0.05, 0.02, 0]]), CAMERA))
    np.testing.assert_allclose(starts, project(np.array([[0.05, -0.08, 0]]), CAMERA))


def test_plan_pushes_towards_the_goal_under_a_model_known_in_closed_form():
    # Under this model every poke that starts 10 cm or more away shifts everything by 4 cm along itself.
    view = island()
    there = np.array([-0.04, 0.0, 0.0])
    goal = Goal(project(view.cloud[-1:] + there, CAMERA), view.cloud + there)
    rollout, rounds = shift_along(view, 0.04), []
    found = planning.plan(rollout, view, goal, CAMERA, SETTINGS, Search(iterations=6), np.random.default_rng(9),
                          lambda i, population, costs, mean, deviation: rounds.append(costs.min()))
    assert abs(abs(found.pokes[0, 2]) - np.pi) < 0.15
    assert found.cost < 0.1 * found.now and found.cost == min(rounds)
    np.testing.assert_allclose(found.starts[0] + 0.1 * np.array([np.cos(found.pokes[0, 2]), np.sin(found.pokes[0, 2])]),
                               found.pokes[0, :2], atol=1e-6)
    again = planning.plan(rollout, view, goal, CAMERA, SETTINGS, Search(iterations=6), np.random.default_rng(9))
    np.testing.assert_array_equal(again.pokes, found.pokes)


# --- following marks ------------------------------------------------------------------------------------------

def test_registration_against_a_known_motion():
    from scipy.spatial import cKDTree
    rng = np.random.default_rng(10)
    points, colours = rng.uniform(-0.03, 0.03, (60, 3)), rng.uniform(0, 0.1, (60, 3))
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    after = np.column_stack([points[:, :2] @ turn.T + [0.02, -0.01], points[:, 2]])
    tree = cKDTree(np.column_stack([after, colours]))
    error, found, shift = planning._register(points, points, colours, tree)
    np.testing.assert_allclose(found, turn, atol=1e-9)
    np.testing.assert_allclose(shift, [0.02, -0.01], atol=1e-9)
    assert error < 1e-15


def test_marks_are_followed_over_real_pokes(pokes, run):
    interactions, truth = pokes
    errors, motions = [], []
    for row in range(40):
        labels, depth = truth.labels[row], interactions.depth_before[row]
        marks, movers = [], []
        for label in np.unique(labels[labels > 0]):
            rows, columns = np.nonzero(labels == label)
            if len(rows) >= 15:
                marks.append((columns[len(rows) // 2], rows[len(rows) // 2]))
                movers.append(label)
        camera, empty = interactions.camera, interactions.empty_depth
        try:
            points = planning.points_at(marks, depth, empty, camera, SETTINGS)
        except ValueError:  # an object so flat to the camera that this pixel of it counts as table
            continue
        true = points + true_scene_flow(points, np.array(movers), truth.poses_before[row], truth.poses_after[row])
        view = planning.view_of(depth, empty, camera, SETTINGS, points)
        after = planning.view_of(interactions.depth_after[row], empty, camera, SETTINGS, points)
        moved, masks = planning.predict(run, camera, view, view.cloud[None], interactions.pokes[[row]])
        found = planning.follow(view, interactions.rgb_before[row], interactions.pokes[row], moved[0], masks[0], after,
                                interactions.rgb_after[row])
        errors.extend(np.linalg.norm(found - true, axis=1))
        motions.extend(np.linalg.norm(true - points, axis=1))
    errors, motions = np.array(errors), np.array(motions)
    assert len(errors) > 80 and (motions > 0.02).sum() > 15
    assert np.median(errors[motions > 0.01]) < 0.005 < np.median(motions[motions > 0.01])
    assert np.quantile(errors[motions < 0.001], 0.95) < 0.002
