"""Planning with the cross entropy method

The model says what a poke does; planning looks for the poke that does what is wanted. The cross entropy method (CEM)
draws J candidates from a Gaussian, keeps the K cheapest (the *elites*), fits the Gaussian to them, and draws again:

    mean = mean of the elites,   deviation = root of their mean squared distance from it,   for each number of a poke

A poke is (a_x, a_y, a_theta). Directions are circular: -3.1 and 3.1 rad are 0.08 rad apart, and their mean is pi, not
0: arctan2(mean sin, mean cos). A deviation below LEAST would only draw the same pokes again. Candidates that cannot be
have infinite or NaN cost: these lose, and are never elites. The best candidate *ever seen* is the answer.

**Where the finger comes down.** Training pokes began in free cells 10 to 14 cm *behind* an occupied target, and the
model knows no others: a candidate is possible if its target is inside the walls and in or next to a cell with an
object, and on some such path the finger fits.

**The cost** of a scene, Sec. IV-G: how far the marked points' pixels are from where they shall be, and how far the
objects are from the goal picture's, both in cm on the table, so that neither drowns the other:

    pixel_weight 100 mean_m max(|pixel_m - goal_m| pixel_size - SLACK, 0)
    + chamfer_weight 100 sqrt(mean_i min_j |P_i - G_j|^2 + mean_j min_i |P_i - G_j|^2)

Paper: Sec. III-H and IV-G; tutorials/12_planning.py.
"""
from dataclasses import replace

import numpy as np
from scipy.spatial.distance import cdist

from ...geometry import Camera, project
from ...interactions import cells_of, finger_fits, with_neighbours
from ...planning import (LEAST, SLACK, Goal, Search, View, cem, first_start, planning_cost, possible_starts, refit,
                         wrapped)
from ...scene import Scene
from ..task import Task, single
from .a1_camera import DOWN


def angle_cases(rng):
    return [{"angle": np.array([0.5, 3.5, -4.0, 7.0])}, {"angle": rng.uniform(-12, 12, (3, 7))},
            single({"angle": rng.uniform(-12, 12, 9)})]


def elite_cases(rng):
    by_hand = {"elites": np.array([[[0.0, 0.1, 3.1]], [[0.2, 0.1, -3.1]]])}
    return [by_hand, {"elites": rng.normal(size=(5, 2, 3)) * [0.1, 0.001, 0.4] + [0.1, 0, np.pi - 0.3]}]


def deviation_from(mean, elites):
    return np.sqrt(((elites - mean) ** 2).mean(axis=0))


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


def nearly_cases(rng):
    by_hand = {"starts": np.array([[[1.0, 2], [3, 4]], [[np.nan, np.nan], [5, 6]]])}
    drawn = rng.normal(size=(2, 6, 5, 2))
    drawn[rng.random((2, 6, 5)) < 0.5] = np.nan
    drawn[:, 0] = np.nan
    drawn[:, 1, 4] = 1.0
    return [by_hand, {"starts": drawn[0]}, {"starts": drawn[1]}]


# --- the cost ---

CAMERA = Camera(64, 48, 60.0, 70.0, 31.0, 22.0, DOWN)


def cost_cases(rng):
    clouds = np.array([[[0.0, 0, 0], [0.2, 0.1, 0], [0.3, 0.1, 0]], [[0, 0, 0], [0.2, 0.2, 0], [0.3, 0.2, 0]]])
    by_hand = {"clouds": clouds, "cloud": np.zeros((3, 3)), "occupied": np.array([False, True, True]), "marked": 1,
               "goal_pixels": np.array([[31.0, 22]]), "goal_points": np.array([[0.2, 0.1, 0], [0.2, 0.2, 0]]),
               "pixel_weight": 1.0, "chamfer_weight": 1.0}
    drawn = []
    for weights in ((1.0, 0.5), (0.0, 2.0)):
        clouds = rng.uniform(-0.2, 0.2, (4, 12, 3))
        near = project(clouds[0, -3:], CAMERA) + [[0.2, 0.1], [3, 4], [-6, 1]]  # the first mark is within SLACK
        drawn.append({"clouds": clouds, "cloud": clouds[0].copy(), "occupied": np.arange(12) > 4, "marked": 3,
                      "goal_pixels": near, "goal_points": rng.uniform(-0.2, 0.2, (5, 3)),
                      "pixel_weight": weights[0], "chamfer_weight": weights[1]})
    return [by_hand, *drawn]


def cost_of(function, clouds, cloud, occupied, marked, goal_pixels, goal_points, pixel_weight, chamfer_weight):
    view = View(Scene(cloud[None], occupied[None] | True, occupied[None], occupied[None]), marked)
    return function(clouds, view, Goal(goal_pixels, goal_points), CAMERA,
                    Search(pixel_weight=pixel_weight, chamfer_weight=chamfer_weight))


def cost_with(pixels=None, chamfer=None):
    """The cost with another first term, distances (J, M) m -> (J,), or second one, (there, back) m -> a number."""
    def function(clouds, view, goal, camera, search):
        if pixels:
            away = np.linalg.norm(project(clouds[:, len(view.cloud) - view.marked:], camera) - goal.pixels, axis=2)
            wrong = search.pixel_weight * pixels(away * camera.pixel_size)
            return wrong + planning_cost(clouds, view, goal, camera, replace(search, pixel_weight=0.0))
        pairs = [cdist(each, goal.points) for each in clouds[:, view.occupied]]
        wrong = search.chamfer_weight * np.array([chamfer(each.min(axis=1), each.min(axis=0)) for each in pairs])
        return wrong + search.pixel_weight * planning_cost(clouds, view, goal, camera, Search(chamfer_weight=0.0))
    return function


def table_too(clouds, view, goal, camera, search):
    everything = replace(view.scene, occupied=view.scene.occupied | True)
    return planning_cost(clouds, replace(view, scene=everything), goal, camera, search)


# --- CEM ---

def search_cases(rng):
    fixed = np.random.default_rng(0)

    def drawn(rng, count, elites, rounds, horizon):
        return {"population": np.float32(rng.uniform(-1, 1, (count, horizon, 3)) * [0.2, 0.2, 3.1]), "seed": count,
                "elites": elites, "rounds": rounds, "target": rng.uniform(-0.1, 0.1, (horizon, 3)) + [0, 0, 3.1]}
    return [drawn(fixed, 5, 4, 2, 1), drawn(rng, 12, 4, 4, 2), drawn(rng, 8, 7, 3, 2)]


def searched(function, population, seed, elites, rounds, target):
    """-> the best sequence, its cost, and all that CEM asked the cost of. Some candidates cannot be."""
    asked, fits = [], []

    def cost(sequences):
        asked.append(sequences.copy())
        away = sequences - target
        costs = (np.abs(away[..., :2]).sum(axis=2) + 0.1 * np.abs(wrapped(away[..., 2]))).mean(axis=1)
        costs[1], costs[-2:] = np.nan, np.inf
        return costs + (0.5 if len(asked) == rounds else 0)  # the last round is a bad one

    def on_iteration(iteration, population, costs, mean, deviation):
        fits.append(np.stack([mean, deviation]))
    search = Search(candidates=len(population), elites=elites, iterations=rounds)
    best, lowest = function(cost, population, np.random.default_rng(seed), search, on_iteration)
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
        "Half a turn off": lambda angle: wrapped(angle + np.pi)}),
    Task("6.2", "planning.refit", "The Gaussian of the elites; directions are circular", 20, 20, elite_cases, mistakes={
        "Directions are circular: the mean of 3.1 and -3.1 is pi, not 0":
            lambda elites: (elites.mean(axis=0), np.maximum(elites.std(axis=0), LEAST)),
        "The deviation of the directions is circular too":
            lambda elites: (refit(elites)[0], np.maximum(deviation_from(refit(elites)[0], elites), LEAST)),
        "The variance, not its root": lambda elites: (refit(elites)[0], np.maximum(refit(elites)[1] ** 2, LEAST)),
        "Divided by K - 1, not by K": lambda elites: (
            refit(elites)[0], refit(elites)[1] * np.sqrt(len(elites) / (len(elites) - 1))),
        "At least LEAST: a narrower Gaussian draws the same pokes again": lambda elites: (
            refit(elites)[0], np.where(np.arange(3) < 2, elites.std(axis=0), refit(elites)[1]))}),
    Task("6.3", "planning.possible_starts", "Where the finger may come down for each poke", 20, 30, start_cases, starts,
         mistakes={
             "Ahead of the target: the finger comes from behind":
                 lambda pokes, *others: possible_starts(pokes + [0, 0, np.pi], *others),
             "sin and cos swapped":
                 lambda pokes, *others: possible_starts(pokes * [1, 1, -1] + [0, 0, np.pi / 2], *others),
             "NaN where the finger does not fit": anywhere,
             "NaN where no object is near the target": where_it_fits,
             "The neighbours of an occupied cell are targets as well": on_cell_only,
             "Targets outside of the walls cannot be": outside_too,
             "The shortest path first": lambda pokes, grid, settings, lengths: possible_starts(
                 pokes, grid, {**settings, "poke_length": settings["poke_length"][::-1]}, lengths)},
         notes="settings is a dict with \"arena\", its side, and \"poke_length\", the shortest and the longest, in m. "
               "`help(with_neighbours)`, `help(cells_of)` and `help(finger_fits)` say what these do. The walls are at "
               "half the arena's side; a path's lengths are evenly spaced, both ends included."),
    Task("6.4", "planning.first_start", "The first of several starts that is possible", 10, 10, nearly_cases, mistakes={
        "The first one, possible or not": lambda starts: starts[:, 0],
        "The last possible one": lambda starts: first_start(starts[:, ::-1]),
        "0 where none is possible; NaN says so": lambda starts: np.nan_to_num(first_start(starts))},
         notes="A start that is not possible is NaN in both coordinates."),
    Task("6.5", "planning.planning_cost", "Pixel distance and Chamfer distance to the goal", 20, 30, cost_cases,
         cost_of, mistakes={
             "SLACK is not taken off": cost_with(pixels=lambda away: 100 * away.mean(axis=1)),
             "SLACK is taken off the mean, not off each mark's distance":
                 cost_with(pixels=lambda away: 100 * np.maximum(away.mean(axis=1) - SLACK, 0)),
             "In m, not in cm": lambda *args: planning_cost(*args) / 100,
             "Chamfer one way only": cost_with(chamfer=lambda there, back: 100 * np.sqrt(np.mean(there ** 2))),
             "The root is missing":
                 cost_with(chamfer=lambda there, back: 100 * (np.mean(there ** 2) + np.mean(back ** 2))),
             "Sums over the points instead of means":
                 cost_with(chamfer=lambda there, back: 100 * np.sqrt(np.sum(there ** 2) + np.sum(back ** 2))),
             "The mean distance instead of the root of the mean squared one":
                 cost_with(chamfer=lambda there, back: 100 * (np.mean(there) + np.mean(back))),
             "The table counts: only the points of objects do": table_too},
         notes="view, goal and search are a View, a Goal and a Search of `hind4sight_min.planning`: `help` says what "
               "they hold. The marked points are the last `view.marked` of a cloud; they are points of objects too. "
               "`project(points, camera)` gives their pixels and `camera.pixel_size` a pixel's size in m. A weight of "
               "0 leaves its term out; Chamfer without goal points is a ValueError. The case: camera 2 m above the "
               "table."),
    Task("6.6", "planning.cem", "The cross entropy method", 25, 40, search_cases, searched, mistakes={
        "The most expensive are the elites": other_cem(sign=-1),
        "The best of the last round; the best ever seen is the answer": other_cem(ever=False),
        "The best so far is lost: it goes into row 0 of the next population": other_cem(keep=False),
        "Candidates of infinite cost are among the elites": other_cem(finite=False),
        "Directions leave [-pi, pi)": other_cem(wrap=False),
        "NaN wins; it has to lose": nan_wins},
         notes="search is a Search of `hind4sight_min.planning`: its elites and iterations count here, iteration is 0 "
               "at first, and J is as many as `population` holds. If all candidates cannot be, raise NoPoke; if some "
               "elites cannot, the others make the Gaussian, or the best so far alone. So that the numbers can be "
               "compared, draw the next population with one rng.standard_normal(population.shape), as float32; its "
               "directions are in [-pi, pi) and its row 0 is the best so far. The case says what came of it: the best "
               "sequence and its cost, the population of each round, and each round's mean and deviation."),
)
TESTS = ()
