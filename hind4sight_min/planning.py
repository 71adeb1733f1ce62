"""Plan pokes to a goal: rollouts, the cost of the paper, the cross entropy method. Paper: Sec. III-H and IV-G.

A *cloud* here is a picture's N points, row by row, and behind them the M points that the user marked, one per object.
A *sequence* is H pokes, (H, 3). A *rollout* is any function that says where a cloud goes under J sequences:
(J, H, 3) -> clouds after each poke (J, H, N + M, 3) m, and starts (J, H, 2) m, NaN where no finger fits. The learned
model is one, the simulator another (control.py), so that errors of the model and of the planner can be told apart.
"""
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from . import check_whole
from .geometry import project
from .interactions import cell_centres, cells_of, grid_shape, prominence, standing
from .networks import forward_model, standing_out, window_shape, windows
from .ops import at_rows

CHUNK = 16  # candidates per call of the network: more of them leave the processor's cache


@dataclass(frozen=True)
class View:
    """What the robot sees, ready for planning. cloud (N + M, 3) float32 m, arena; valid (N + M,) bool: has depth;
    occupied (N + M,) bool: stands in the arena; prominence (N + M,) m: of interactions.prominence, infinite for marks;
    marked: M, how many points at the end are the user's.
    """
    cloud: np.ndarray
    valid: np.ndarray
    occupied: np.ndarray
    prominence: np.ndarray
    marked: int


@dataclass(frozen=True)
class Goal:
    """pixels (M, 2): where the marked points shall be. points (G, 3) m: what stands in the arena in the goal picture,
    or None where there is no such picture.
    """
    pixels: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class Search:
    """The planner's budget and cost. candidates, elites, iterations, horizon: J, K, CEM's rounds, H.

    pixel_weight: per px of the marked points' mean distance, as far as it exceeds SLACK. chamfer_weight: per cm of
    the root of the scene's Chamfer distance (mean squared distance, both ways). A pixel is about a centimetre, so
    neither term drowns the other, far away or near; without the root one would. 0 leaves a term out.
    """
    candidates: int = 64
    elites: int = 8
    iterations: int = 4
    horizon: int = 1
    pixel_weight: float = 1.0
    chamfer_weight: float = 1.0

    def __post_init__(self):
        for name in ("candidates", "elites", "iterations", "horizon"):
            check_whole(name, getattr(self, name), 1)
        if self.elites > self.candidates:
            raise ValueError(f"elites: expected at most {self.candidates}, the candidates, got {self.elites}")
        weights = self.pixel_weight, self.chamfer_weight
        if not all(0 <= weight < float("inf") for weight in weights) or not any(weights):
            raise ValueError(f"pixel_weight, chamfer_weight: expected numbers >= 0, not both 0, got {weights}")


class NoPoke(ValueError):
    """There is nothing to poke, or no room to."""


# --- what the robot sees -------------------------------------------------------------------------------------

def points_at(pixels, depth, empty_depth, camera, settings):
    """The points (M, 3) m, arena, that the user marked at pixels (M, 2), (x right, y down).

    Raises ValueError for a mark outside the picture or on the background.
    """
    pixels = np.asarray(pixels, float)
    if pixels.ndim != 2 or pixels.shape[1] != 2 or not len(pixels):
        raise ValueError(f"marks: expected (M, 2) pixels, at least one, got shape {pixels.shape}")
    points, objects = standing(depth, empty_depth, camera, settings)
    found = []
    for x, y in pixels:
        column, row = (int(np.rint(value)) if np.isfinite(value) else -1 for value in (x, y))
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            raise ValueError(f"marks: ({x:g}, {y:g}) lies outside the {camera.width} x {camera.height} picture")
        if not objects[row, column]:
            raise ValueError(f"marks: ({x:g}, {y:g}) lies on the background, not on an object")
        found.append(points[row, column])
    return np.array(found, np.float32)


def view_of(depth, empty_depth, camera, settings, marks):
    """A View of a depth picture (H, W) m and the marked points (M, 3) m. Raises NoPoke where no object stands."""
    points, objects = standing(depth, empty_depth, camera, settings)
    if not objects.any():
        raise NoPoke("scene: no object stands in the arena")
    on = np.ones(len(marks), bool)
    return View(np.concatenate([points.reshape(-1, 3), marks]).astype(np.float32),
                np.concatenate([depth.ravel() > 0, on]), np.concatenate([objects.ravel(), on]),
                np.concatenate([prominence(depth, empty_depth).ravel(), np.full(len(marks), np.inf, np.float32)]),
                len(marks))


def places_at(pixels, heights, camera, settings):
    """Where on the arena, (M, 2) m, something of these heights (M,) m is that the camera sees at pixels (M, 2).

    Raises ValueError where that is outside the picture or the walls: a goal there cannot be met.
    """
    pixels, pose = np.asarray(pixels, float), camera.arena_from_camera
    if pixels.shape != (len(heights), 2) or not np.isfinite(pixels).all():
        raise ValueError(f"goals: expected ({len(heights)}, 2) finite pixels, one per mark, got shape {pixels.shape}")
    rays = np.column_stack([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))])
    rays = rays @ pose[:3, :3].T
    places = pose[:2, 3] + rays[:, :2] * ((heights - pose[2, 3]) / rays[:, 2])[:, None]
    for (x, y), place in zip(pixels, places):
        if not (0 <= x <= camera.width - 1 and 0 <= y <= camera.height - 1):
            raise ValueError(f"goals: ({x:g}, {y:g}) lies outside the {camera.width} x {camera.height} picture")
        if np.abs(place).max() > settings["arena"] / 2:
            raise ValueError(f"goals: ({x:g}, {y:g}) lies outside the walls, where no object can get")
    return places


def places_on_table(places, camera):
    """Places (..., 2) m on the arena's plane -> pixels (..., 2)."""
    places = np.asarray(places, float)
    return project(np.concatenate([places, np.zeros(places.shape[:-1] + (1,))], axis=-1), camera)


def arrows_of(pokes, settings, camera):
    """Pokes (J, 3) as arrows of the shortest length: starts and targets, pixels (J, 2) each."""
    back = settings["poke_length"][0] * np.stack([np.cos(pokes[:, 2]), np.sin(pokes[:, 2])], axis=1)
    return places_on_table(pokes[:, :2] - back, camera), places_on_table(pokes[:, :2], camera)


def goal_of(pixels, camera, settings, depth=None, empty_depth=None):
    """A Goal from the pixels (M, 2) where the marked points shall be and, for the Chamfer term, its depth picture.

    Raises ValueError for an empty goal scene.
    """
    if depth is None:
        return Goal(np.asarray(pixels, np.float32), None)
    points, objects = standing(depth, empty_depth, camera, settings)
    if not objects.any():
        raise ValueError("goal scene: no object stands in the arena")
    return Goal(np.asarray(pixels, np.float32), points[objects].astype(np.float32))


# --- actions inside the training distribution --------------------------------------------------------------------

def occupied_grid(clouds, occupied, settings):
    """Which cells objects stand in: clouds (J, N, 3) m, occupied (N,) bool -> (J, rows, columns) bool."""
    grid = np.zeros((len(clouds), *grid_shape(settings)), bool)
    cells = cells_of(clouds[:, occupied, :2], settings)
    grid.reshape(len(clouds), -1)[np.arange(len(clouds))[:, None], cells] = True
    return grid


def grown(grid):
    """The cells of a grid (J, rows, columns) and their eight neighbours each."""
    return np.stack([cv2.dilate(each.astype(np.uint8), np.ones((3, 3), np.uint8)) for each in grid]) > 0


def possible_starts(pokes, grid, settings, lengths=5):
    """Where the finger may come down for each poke: pokes (J, 3), occupied cells (J, rows, columns) -> (J, L, 2) m.

    Training pokes came from free cells 10 to 14 cm behind an occupied target (simulator.Arena.sample_poke); so many
    `lengths` of such paths are tried, the shortest first. NaN where the start is taken or outside the walls, and for
    pokes whose target is not in the neighbourhood of an occupied cell.
    """
    rows = np.arange(len(pokes))[:, None]
    taken = grown(grid).reshape(len(grid), -1)
    on_object = taken[rows[:, 0], cells_of(pokes[:, :2], settings)]
    back = -np.stack([np.cos(pokes[:, 2]), np.sin(pokes[:, 2])], axis=-1)
    starts = pokes[:, None, :2] + np.linspace(*settings["poke_length"], lengths)[:, None] * back[:, None]
    half = settings["arena"] / 2
    inside = (np.abs(starts).max(axis=2) < half - settings["finger_radius"])
    inside &= (np.abs(pokes[:, None, :2]).max(axis=2) < half) & on_object[:, None]
    free = inside & ~taken[rows, cells_of(starts, settings)]
    return np.where(free[..., None], starts, np.nan)


def first_start(starts):
    """The first possible of starts (J, L, 2), NaN where there is none -> (J, 2)."""
    return starts[np.arange(len(starts)), np.argmax(np.isfinite(starts[..., 0]), axis=1)]


def draw_pokes(rng, count, view, settings, horizon=1):
    """Sequences (count, H, 3) as the training pokes were drawn: somewhere on what stands in the arena, from anywhere.

    Those whose first poke has no free start are drawn again. Raises NoPoke where there is hardly one that has.
    """
    grid = occupied_grid(view.cloud[None], view.occupied, settings)
    targets, result = cell_centres(settings)[np.flatnonzero(grid[0])], []
    for _ in range(50):
        cells = targets[rng.integers(len(targets), size=(count, horizon))]
        cells = cells + rng.uniform(-0.5, 0.5, cells.shape) * settings["cell"]
        drawn = np.concatenate([cells, rng.uniform(-np.pi, np.pi, (count, horizon, 1))], axis=2).astype(np.float32)
        starts = possible_starts(drawn[:, 0], np.broadcast_to(grid, (count, *grid.shape[1:])), settings)
        result.extend(drawn[np.isfinite(starts[..., 0]).any(axis=1)])
        if len(result) >= count:
            return np.stack(result[:count])
    raise NoPoke("scene: there is no room for the finger to come down behind any object")


# --- rollouts -----------------------------------------------------------------------------------------------------

def roll(step, view, sequences, settings):
    """What sequences of pokes (J, H, 3) lead to -> clouds (J, H, N + M, 3) m after each, starts (J, H, 2) m, NaN where
    the finger finds no room. step: clouds (J, N + M, 3), pokes (J, 3) -> clouds after one poke.
    """
    clouds = np.repeat(view.cloud[None], len(sequences), axis=0)
    after, starts = [], []
    for pokes in np.moveaxis(sequences, 1, 0):
        starts.append(first_start(possible_starts(pokes, occupied_grid(clouds, view.occupied, settings), settings)))
        clouds = step(clouds, pokes)
        after.append(clouds)
    return np.stack(after, axis=1), np.stack(starts, axis=1)


def predict(run, camera, view, clouds, pokes):
    """The learned model on clouds (J, N + M, 3) m, where the points of a view went; pokes (J, 3)
    -> clouds after the pokes, and the number of every point's largest mask, (J, N + M) int, 0 = background.

    The model was trained on windows of the picture, on the points that stand out there. Of a cloud that has moved these
    are the most prominent of as many points whose pixels lie in the window or nearest to it; all others stay.
    """
    rows, columns = window_shape(camera)
    count, half = rows * columns, np.array([columns, rows], np.float32) / 2
    moved, masks = clouds.copy(), np.zeros(clouds.shape[:2], int)
    for first in range(0, len(clouds), CHUNK):
        part = slice(first, first + CHUNK)
        middle = np.array([[(c.start + c.stop - 1) / 2, (r.start + r.stop - 1) / 2]
                           for r, c in windows(pokes[part], camera)], np.float32)
        away = np.abs((project(clouds[part], camera) - middle[:, None]) / half).max(axis=2)  # 1: the window's rim
        near = np.sort(np.argpartition(away, count - 1, axis=1)[:, :count], axis=1)
        look = np.take_along_axis(near, standing_out(view.prominence[near]), axis=1)
        pick = at_rows(look)
        found = forward_model(run.params, run.recipe.sizes, clouds[part][pick], view.valid[look],
                              pokes[part].astype(np.float32))
        moved[part][pick] = found.points
        masks[part][pick] = found.masks.argmax(axis=2)
    return moved, masks


def learned_step(run, camera, view):
    """The learned model as a `step` of `roll`."""
    return lambda clouds, pokes: predict(run, camera, view, clouds, pokes)[0]


def no_motion_step(clouds, pokes):
    """The baseline for which no poke does anything."""
    return clouds


# --- the cost ----------------------------------------------------------------------------------------------------

SLACK = 1.5  # px; marks are followed no better than that, so nearer than this the Chamfer distance decides alone


def planning_cost(clouds, view, goal, camera, search):
    """Paper: Sec. IV-G, "pixel distance, between user marked object points, and the Chamfer distance of the whole scene
    to the goal scene".  clouds (J, N + M, 3) m -> (J,). Table and walls do not move and are left out.
    """
    cost = np.zeros(len(clouds))
    if search.pixel_weight:
        pixels = project(clouds[:, len(view.cloud) - view.marked:], camera)  # by the implicit optical flow
        away = np.linalg.norm(pixels - goal.pixels, axis=2)
        cost += search.pixel_weight * np.maximum(away - SLACK, 0).mean(axis=1)
    if search.chamfer_weight:
        if goal.points is None:
            raise ValueError("chamfer_weight: without a goal picture only the pixels count; set it to 0")
        tree = cKDTree(goal.points)
        for j, scene in enumerate(clouds[:, view.occupied]):
            there, back = tree.query(scene)[0], cKDTree(scene, balanced_tree=False).query(goal.points)[0]
            cost[j] += search.chamfer_weight * 100 * np.sqrt(np.mean(there ** 2) + np.mean(back ** 2))
    return cost


# --- the cross entropy method ----------------------------------------------------------------------------------------

LEAST = np.array([0.002, 0.002, 0.03])  # m, m, rad: a narrower Gaussian only draws the same pokes again


def refit(elites):
    """A Gaussian over sequences: elites (K, H, 3) -> mean, standard deviation, (H, 3) each; directions are circular."""
    mean = elites.mean(axis=0)
    mean[:, 2] = np.arctan2(np.sin(elites[..., 2]).mean(axis=0), np.cos(elites[..., 2]).mean(axis=0))
    away = elites - mean
    away[..., 2] = (away[..., 2] + np.pi) % (2 * np.pi) - np.pi
    return mean, np.maximum(np.sqrt((away ** 2).mean(axis=0)), LEAST)


def cem(cost, population, rng, search, on_iteration=None):
    """The cross entropy method. Paper: Sec. III-H.

    cost: sequences (J, H, 3) -> (J,), NaN or infinity for those that cannot be. population (J, H, 3): the first one.
    on_iteration(iteration, population, costs, mean, deviation) is called after every round with the refitted Gaussian.
    -> the best sequence ever seen (H, 3) and its cost; NoPoke if none had a finite one.
    """
    best, lowest = None, np.inf
    for iteration in range(search.iterations):
        costs = np.asarray(cost(population), float)
        costs = np.where(np.isnan(costs), np.inf, costs)
        order = np.argsort(costs, kind="stable")
        if costs[order[0]] < lowest:
            best, lowest = population[order[0]].copy(), float(costs[order[0]])
        elites = population[[j for j in order[:search.elites] if costs[j] < np.inf]]
        if best is None:
            raise NoPoke("plan: no candidate poke is possible")
        mean, deviation = refit(elites if len(elites) else best[None])
        if on_iteration:
            on_iteration(iteration, population, costs, mean, deviation)
        population = (mean + deviation * rng.standard_normal(population.shape)).astype(np.float32)
        population[..., 2] = (population[..., 2] + np.pi) % (2 * np.pi) - np.pi
        population[0] = best
    return best, lowest


@dataclass(frozen=True)
class Plan:
    """pokes (H, 3), starts (H, 2) m, cost of the best sequence; now: the cost of leaving all as it is."""
    pokes: np.ndarray
    starts: np.ndarray
    cost: float
    now: float


def plan(rollout, view, goal, camera, settings, search, rng, on_iteration=None):
    """The best sequence of pokes to a goal that CEM finds -> Plan.

    The cost of a sequence is the mean over the scenes after each of its pokes, so that an early gain counts.
    """
    def cost(sequences):
        clouds, starts = rollout(sequences)
        steps = [planning_cost(after, view, goal, camera, search) for after in np.moveaxis(clouds, 1, 0)]
        return np.where(np.isnan(starts).any(axis=(1, 2)), np.inf, np.mean(steps, axis=0))

    first = draw_pokes(rng, search.candidates, view, settings, search.horizon)
    pokes, lowest = cem(cost, first, rng, search, on_iteration)
    starts = rollout(pokes[None])[1][0]
    return Plan(pokes, starts, lowest, float(planning_cost(view.cloud[None], view, goal, camera, search)[0]))


# --- where the marks went ---------------------------------------------------------------------------------------------

COLOUR = 0.10  # m: how far apart black and white count when points are matched by place and colour
REACH = 0.055  # m: most of what is seen of an object is nearer to a mark in its middle


def follow(view, rgb, poke, moved, masks, next_view, next_rgb):
    """Where the marked points are after a poke that the robot has carried out, (M, 3) m. Not in the paper.

    The model says which points belong to a mark's object (its mask) and where they went; iterated closest points, by
    place and colour, in the plane of the table, correct that by what is seen. They start from the predicted motion and
    from shifts by 0 to 6 cm along the poke, for it may go otherwise than predicted; the best fit counts.
    view, next_view: Views before and after (the marks of next_view are not used); rgb, next_rgb (H, W, 3) uint8;
    poke (3,); moved (N + M, 3) m, masks (N + M,): `predict` for it.
    """
    pixels = len(view.cloud) - view.marked
    seen = next_view.occupied[:pixels]
    colour = COLOUR / 255 * next_rgb.reshape(-1, 3)[seen]
    tree = cKDTree(np.column_stack([next_view.cloud[:pixels][seen], colour]))
    result = []
    for mark in range(pixels, len(view.cloud)):
        near = np.linalg.norm(view.cloud[:pixels] - view.cloud[mark], axis=1)
        own = view.occupied[:pixels] & (near < REACH) & (masks[:pixels] == masks[mark])
        if masks[mark] == 0 or own.sum() < 8:
            own = view.occupied[:pixels] & (near < REACH / 2)
        if own.sum() < 3 or not seen.any():  # nothing to match: believe the model
            result.append(moved[mark])
            continue
        points, colours = view.cloud[:pixels][own], COLOUR / 255 * rgb.reshape(-1, 3)[own]
        along = np.array([np.cos(poke[2]), np.sin(poke[2]), 0])
        guesses = [moved[:pixels][own], *(points + shift * along for shift in (0, 0.02, 0.04, 0.06))]
        fits = [_register(points, guess, colours, tree) for guess in guesses]
        _, turn, shift = min(fits, key=lambda fit: fit[0])
        point = view.cloud[mark].astype(float)
        result.append([*(turn @ point[:2] + shift), point[2]])
    return np.array(result, np.float32).reshape(-1, 3)


def _register(points, where, colours, tree, rounds=15, kept=0.85):
    """The planar motion of points (n, 3), at first guessed to go to `where`, that best fits those in `tree`; the worst
    sixth is left out as hidden -> (mean squared distance, rotation (2, 2), shift (2,)).
    """
    for _ in range(rounds):
        distance, nearest = tree.query(np.column_stack([where, colours]))
        best = np.argsort(distance)[:max(3, int(kept * len(distance)))]
        source, target = points[best, :2], tree.data[nearest[best], :2]
        a, b = source - source.mean(axis=0), target - target.mean(axis=0)
        angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shift = target.mean(axis=0) - turn @ source.mean(axis=0)
        where = np.column_stack([points[:, :2] @ turn.T + shift, points[:, 2]])
    return np.mean(distance[best] ** 2), turn, shift
