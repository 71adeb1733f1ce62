"""Planning with the cross entropy method

The model says what a poke does; planning looks for the poke that does what is wanted. The cross entropy method (CEM)
draws J candidates from a Gaussian, keeps the K cheapest (the *elites*), fits the Gaussian to them, and draws again:

    mean = mean of the elites,   deviation = root of their mean squared distance from it,   for each number of a poke

A poke is (a_x, a_y, a_theta). Directions are circular: -3.1 and 3.1 rad are 0.08 rad apart, their mean is pi and not 0,
arctan2(mean sin, mean cos). A deviation below LEAST would only draw the same pokes again. Candidates that cannot be have
infinite or NaN cost: these lose, and are never elites. The best candidate *ever seen* is the answer.

**Where the finger comes down.** Training pokes began in free cells 10 to 14 cm *behind* an occupied target, and the model
knows no others: a candidate is possible if its target is inside the walls and in or next to a cell with an object, and
on some such path the finger fits.

**The cost** of a scene, Sec. IV-G: how far the marked points' pixels are from where they shall be, and how far the
objects are from the goal picture's, both in cm on the table, so that neither drowns the other:

    pixel_weight 100 mean_m max(|pixel_m - goal_m| pixel_size - SLACK, 0)
    + chamfer_weight 100 sqrt(mean_i min_j |P_i - G_j|^2 + mean_j min_i |P_i - G_j|^2)

Paper: Sec. III-H and IV-G; lesson 10_planning.
"""
from dataclasses import replace

import numpy as np

from ...geometry import Camera
from ...interactions import cells_of, finger_fits, with_neighbours
from ...planning import Goal, NoPoke, Search, View, cem, first_start, planning_cost, possible_starts, refit, wrapped
from ...scene import Scene
from ..task import Task, single
from .a1_camera import DOWN


def angle_cases(rng):
    return [{"angle": np.array([0.5, 3.5, -4.0, 7.0])}, {"angle": rng.uniform(-12, 12, (3, 7))},
            single({"angle": rng.uniform(-12, 12, 9)})]


def elite_cases(rng):
    by_hand = {"elites": np.array([[[0.0, 0.1, 3.1]], [[0.2, 0.1, -3.1]]])}
    return [by_hand, {"elites": rng.normal(size=(5, 2, 3)) * [0.1, 0.001, 0.4] + [0.1, 0, np.pi - 0.3]}]


def refitted(change):
    return lambda elites: change(elites, *refit(elites))


# --- starts ---

def start_cases(rng):
    block = np.zeros((3, 6, 6), int)
    block[:, 3, 4] = 1  # pokes: along x; from the wall; on nothing
    by_hand = {"pokes": np.array([[0.07, 0.01, 0], [0.07, 0.01, np.pi], [-0.1, -0.1, 0]]), "grid": block,
               "arena": 0.3, "cell": 0.05, "lengths": 2}
    pokes = rng.uniform(-1, 1, (40, 3)) * [0.2, 0.2, np.pi]
    pokes[:5, 0], pokes[:5, 2] = 0.26, 0  # outside of the wall, pushed from inside
    beside = pokes[:, :2] + [0.025, 0] * (np.arange(40) % 2)[:, None]  # half of the targets are on, half next to it
    grid = np.zeros((40, 20, 20), int)
    grid.reshape(40, -1)[np.arange(30), cells_of(beside, {"arena": 0.5, "cell": 0.025})[:30]] = 1  # the last: no object
    for block in grid[5:]:
        block[rng.integers(20, size=9), rng.integers(20, size=9)] = 1
    return [by_hand, {"pokes": pokes, "grid": grid, "arena": 0.5, "cell": 0.025, "lengths": 5}]


def starts(function, pokes, grid, arena, cell, lengths):
    settings = {"arena": arena, "cell": cell, "poke_length": [0.10, 0.14], "finger_radius": 0.01}
    return function(pokes, grid > 0, settings, lengths)


def anywhere(pokes, grid, settings, lengths):
    back = -np.stack([np.cos(pokes[:, 2]), np.sin(pokes[:, 2])], axis=-1)
    return pokes[:, None, :2] + np.linspace(*settings["poke_length"], lengths)[:, None] * back[:, None]


def where_it_fits(pokes, grid, settings, lengths):
    places = anywhere(pokes, grid, settings, lengths)
    return np.where(finger_fits(places, grid, settings)[..., None], places, np.nan)


def on_cell_only(pokes, grid, settings, lengths):
    exact = grid.reshape(len(grid), -1)[np.arange(len(pokes)), cells_of(pokes[:, :2], settings)]
    return np.where(exact[:, None, None], possible_starts(pokes, grid, settings, lengths), np.nan)


def outside_too(pokes, grid, settings, lengths):
    near = with_neighbours(grid).reshape(len(grid), -1)[np.arange(len(pokes)), cells_of(pokes[:, :2], settings)]
    return np.where(near[:, None, None], where_it_fits(pokes, grid, settings, lengths), np.nan)


def mirrored(pokes):
    """sin for cos."""
    return np.concatenate([pokes[:, :2], np.pi / 2 - pokes[:, 2:]], axis=1)


def nearly_cases(rng):
    by_hand = {"starts": np.array([[[1.0, 2], [3, 4]], [[np.nan, np.nan], [5, 6]]])}
    drawn = rng.normal(size=(2, 6, 5, 2))
    drawn[rng.random((2, 6, 5)) < 0.5] = np.nan
    drawn[:, 0] = np.nan
    drawn[:, 1, 4] = 1.0
    return [by_hand, {"starts": drawn[0]}, single({"starts": drawn[1]})]


# --- the cost ---

CAMERA = Camera(64, 48, 60.0, 70.0, 31.0, 22.0, DOWN)


def cost_cases(rng):
    by_hand = {"clouds": np.array([[[0.2, 0.1, 0], [0.3, 0.1, 0], [0, 0, 0]], [[0.2, 0.2, 0], [0.3, 0.2, 0], [0, 0, 0]]]),
               "cloud": np.zeros((3, 3)), "occupied": np.array([True, True, False]), "marked": 1,
               "goal_pixels": np.array([[31.0, 22]]), "goal_points": np.array([[0.2, 0.1, 0], [0.2, 0.2, 0]]),
               "pixel_weight": 1.0, "chamfer_weight": 1.0}
    drawn = []
    for weights in ((1.0, 0.5), (0.0, 2.0)):
        clouds = rng.uniform(-0.2, 0.2, (4, 12, 3))
        drawn.append({"clouds": clouds, "cloud": clouds[0].copy(), "occupied": np.arange(12) > 4, "marked": 3,
                      "goal_pixels": rng.uniform(15, 35, (3, 2)), "goal_points": rng.uniform(-0.2, 0.2, (5, 3)),
                      "pixel_weight": weights[0], "chamfer_weight": weights[1]})
    return [by_hand, *drawn]


def cost_of(function, clouds, cloud, occupied, marked, goal_pixels, goal_points, pixel_weight, chamfer_weight):
    view = View(Scene(cloud[None], occupied[None] | True, occupied[None], occupied[None]), marked)
    return function(clouds, view, Goal(goal_pixels, goal_points), CAMERA,
                    Search(pixel_weight=pixel_weight, chamfer_weight=chamfer_weight))


def cost_with(pixels=None, chamfer=None):
    """The cost with another first term, distances (J, M) m -> (J,), or another second one, (there, back) m -> float."""
    def function(clouds, view, goal, camera, search):
        from scipy.spatial.distance import cdist

        from ...geometry import project
        cost = np.zeros(len(clouds))
        if search.pixel_weight and pixels:
            away = np.linalg.norm(project(clouds[:, len(view.cloud) - view.marked:], camera) - goal.pixels, axis=2)
            cost += search.pixel_weight * pixels(away, camera.pixel_size)
        elif search.pixel_weight:
            cost += planning_cost(clouds, view, goal, camera, replace(search, chamfer_weight=0.0))
        if chamfer:
            pairs = [cdist(each, goal.points) for each in clouds[:, view.occupied]]
            return cost + search.chamfer_weight * np.array([chamfer(each.min(1), each.min(0)) for each in pairs])
        return cost + planning_cost(clouds, view, goal, camera, replace(search, pixel_weight=0.0))
    return function


def table_too(clouds, view, goal, camera, search):
    everything = replace(view.scene, occupied=view.scene.occupied | True)
    return planning_cost(clouds, replace(view, scene=everything), goal, camera, search)


# --- CEM ---

def search_cases(rng):
    return [{"population": np.float32(rng.uniform(-1, 1, (count, 2, 3)) * [0.2, 0.2, 3.1]), "seed": seed, "rounds": rounds,
             "target": rng.uniform(-0.1, 0.1, (2, 3)) + [0, 0, 3.1]} for seed, count, rounds in ((0, 6, 2), (1, 12, 4), (2, 8, 3))]


def searched(function, population, seed, rounds, target):
    """-> the best sequence, its cost, and all that CEM asked the cost of. Some candidates cannot be."""
    asked, fits = [], []

    def cost(sequences):
        asked.append(sequences.copy())
        away = sequences - target
        costs = (np.abs(away[..., :2]).sum(axis=2) + 0.1 * np.abs(wrapped(away[..., 2]))).mean(axis=1)
        costs[1], costs[-2:] = np.nan, np.inf
        return costs + (0.5 if len(asked) == rounds else 0)  # the last round is a bad one

    best, lowest = function(cost, population, np.random.default_rng(seed), Search(
        candidates=len(population), elites=len(population) - 1, iterations=rounds),
        lambda iteration, population, costs, mean, deviation: fits.append(np.stack([mean, deviation])))
    return best, np.asarray(lowest), np.stack(asked), np.stack(fits)


def other_cem(keep=True, wrap=True, finite=True, sign=1, ever=True):
    """CEM with one mistake; the defaults make none."""
    def function(cost, population, rng, search, on_iteration=None):
        best, lowest = None, np.inf
        for iteration in range(search.iterations):
            costs = np.asarray(cost(population), float)
            costs = np.where(np.isnan(costs), np.inf, costs)
            order = np.argsort(sign * costs, kind="stable")
            top = np.argmin(costs)
            if costs[top] < lowest or not ever:
                best, lowest = population[top].copy(), float(costs[top])
            elites = population[[j for j in order[:search.elites] if costs[j] < np.inf or not finite]]
            mean, deviation = refit(elites if len(elites) else best[None])
            on_iteration(iteration, population, costs, mean, deviation)
            population = (mean + deviation * rng.standard_normal(population.shape)).astype(np.float32)
            if wrap:
                population[..., 2] = wrapped(population[..., 2])
            if keep:
                population[0] = best
        return best, lowest
    return function


def nan_wins(cost, population, rng, search, on_iteration=None):
    return cem(lambda sequences: np.nan_to_num(cost(sequences), nan=-1.0, posinf=np.inf), population, rng, search,
               on_iteration)


TASKS = (
    Task("6.1", "planning.wrapped", "Angles in [-pi, pi)", 5, 5, angle_cases, mistakes={
        "In [0, 2 pi)": lambda angle: angle % (2 * np.pi),
        "Cut off at pi instead of turned on": lambda angle: np.clip(angle, -np.pi, np.pi),
        "Half a turn off": lambda angle: wrapped(angle + np.pi),
        "In degrees": lambda angle: (angle + 180) % 360 - 180}),
    Task("6.2", "planning.refit", "The Gaussian of the elites; directions are circular", 20, 20, elite_cases, mistakes={
        "Directions are circular: the mean of 3.1 and -3.1 is pi, not 0": lambda elites: (
            elites.mean(axis=0), np.maximum(elites.std(axis=0), [0.002, 0.002, 0.03])),
        "The deviation of the directions is circular too": refitted(lambda elites, mean, deviation: (mean, np.maximum(
            np.sqrt(((elites - mean) ** 2).mean(axis=0)), [0.002, 0.002, 0.03]))),
        "The variance, not its root": refitted(lambda elites, mean, deviation: (mean, deviation ** 2)),
        "Divided by K - 1, not by K": refitted(lambda elites, mean, deviation: (mean, np.where(
            deviation > [0.002, 0.002, 0.03], deviation * np.sqrt(len(elites) / (len(elites) - 1)), deviation))),
        "At least LEAST: a narrower Gaussian draws the same pokes again": refitted(lambda elites, mean, deviation: (
            mean, np.sqrt(np.where(np.arange(3) < 2, ((elites - mean) ** 2).mean(axis=0), deviation ** 2))))}),
    Task("6.3", "planning.possible_starts", "Where the finger may come down for each poke", 20, 30, start_cases, starts,
         mistakes={
             "Ahead of the target: the finger comes from behind": lambda pokes, grid, settings, lengths: possible_starts(
                 pokes + [0, 0, np.pi], grid, settings, lengths),
             "sin and cos swapped": lambda pokes, grid, settings, lengths: possible_starts(
                 mirrored(pokes), grid, settings, lengths),
             "NaN where the finger does not fit": anywhere,
             "NaN where no object is near the target": where_it_fits,
             "The neighbours of an occupied cell are targets as well": on_cell_only,
             "Targets outside of the walls cannot be": outside_too,
             "The shortest path first": lambda pokes, grid, settings, lengths: possible_starts(
                 pokes, grid, {**settings, "poke_length": settings["poke_length"][::-1]}, lengths)},
         notes="settings has \"arena\" and \"poke_length\", the shortest and the longest, in m; `with_neighbours`, "
               "`cells_of` and `finger_fits` are at hand."),
    Task("6.4", "planning.first_start", "The first of several starts that is possible", 10, 10, nearly_cases, mistakes={
        "The first one, possible or not": lambda starts: starts[:, 0],
        "The last possible one": lambda starts: first_start(starts[:, ::-1]),
        "0 where none is possible; NaN says so": lambda starts: np.nan_to_num(first_start(starts)),
        "The mean of all that are possible": lambda starts: np.stack([
            each[np.isfinite(each[:, 0])].mean(axis=0) if np.isfinite(each).any() else each[0] for each in starts])}),
    Task("6.5", "planning.planning_cost", "Pixel distance and Chamfer distance to the goal", 20, 30, cost_cases, cost_of,
         mistakes={
             "SLACK is not taken off": cost_with(pixels=lambda away, size: 100 * (away * size).mean(axis=1)),
             "The marks' distance in pixels, not in cm on the table": cost_with(
                 pixels=lambda away, size: np.maximum(away - 0.015, 0).mean(axis=1)),
             "SLACK is taken off the mean, not off each mark's distance": cost_with(
                 pixels=lambda away, size: 100 * np.maximum((away * size).mean(axis=1) - 0.0751, 0)),
             "Chamfer one way only": cost_with(chamfer=lambda there, back: 100 * np.sqrt(np.mean(there ** 2))),
             "The root is missing": cost_with(chamfer=lambda there, back: 100 * (np.mean(there ** 2) + np.mean(back ** 2))),
             "Sums over the points instead of means": cost_with(
                 chamfer=lambda there, back: 100 * np.sqrt(np.sum(there ** 2) + np.sum(back ** 2))),
             "The mean distance instead of the root of the mean squared one": cost_with(
                 chamfer=lambda there, back: 100 * (np.mean(there) + np.mean(back))),
             "The table counts: only the points of objects do": table_too},
         notes="The marked points are the last `view.marked` of a cloud; they are of objects too. Without the one weight "
               "or the other its term is left out. `camera.pixel_size` is in m."),
    Task("6.6", "planning.cem", "The cross entropy method", 25, 40, search_cases, searched, mistakes={
        "The most expensive are the elites": other_cem(sign=-1),
        "The best of the last round; the best ever seen is the answer": other_cem(ever=False),
        "The best so far is lost: it goes into row 0 of the next population": other_cem(keep=False),
        "Candidates of infinite cost are among the elites": other_cem(finite=False),
        "Directions leave [-pi, pi)": other_cem(wrap=False),
        "NaN wins; it has to lose": nan_wins},
         notes="So that the numbers can be compared, draw once a round: rng.standard_normal(population.shape), in the last "
               "round too; the next population is float32, its directions in [-pi, pi), and its row 0 the best so far. "
               "`refit` makes the Gaussian. The case: the best sequence, its cost, the populations, and of every round "
               "mean and deviation."),
)
TESTS = ()
