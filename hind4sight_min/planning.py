"""Plan pokes to a goal: rollouts, the cost of the paper, the cross entropy method. Paper: Sec. III-H and IV-G.

A *cloud* here is a picture's N points, row by row, and behind them the M points that the user marked, one per object.
A *sequence* is H pokes, (H, 3). A *rollout* is any function that says where a cloud goes under J sequences:
(J, H, 3) -> clouds after each poke (J, H, N + M, 3) m, and starts (J, H, 2) m, NaN where no finger fits. The learned
model is one, the simulator another (lab/control.py), so that errors of the model and of the planner can be told apart.
"""
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from . import check_number, check_whole
from .geometry import project
from .interactions import cell_centres, cells_of, finger_fits, occupied_grid, with_neighbours
from .networks import predict
from .scene import Scene

CHUNK = 16  # candidates per call of the network: more of them leave the processor's cache


@dataclass(frozen=True)
class View:
    """What the robot sees: the Scene of one picture with the user's M marked points appended, (1, N + M, ...)."""
    scene: Scene
    marked: int

    @property
    def cloud(self):
        """(N + M, 3) float32 m, arena."""
        return self.scene.points[0]

    @property
    def occupied(self):
        """(N + M,) bool: points of objects; marks are."""
        return self.scene.occupied[0]

    @property
    def marks(self):
        """(M, 3) float32 m: the points that the user marked."""
        return self.cloud[len(self.cloud) - self.marked:]


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

    pixel_weight: per cm on the table of the marked points' mean pixel distance, as far as it exceeds SLACK.
    chamfer_weight: per cm of the root of the scene's Chamfer distance (mean squared distance, both ways): neither term
    drowns the other, far away or near; without the root one would. 0 leaves a term out.
    """
    candidates: int = 64
    elites: int = 8
    iterations: int = 4
    horizon: int = 1
    pixel_weight: float = 1.0
    chamfer_weight: float = 1.0

    def __post_init__(self):
        for name, most in (("candidates", 10_000), ("elites", 10_000), ("iterations", 100), ("horizon", 10)):
            check_whole(name, getattr(self, name), 1, most)
        if self.elites > self.candidates:
            raise ValueError(f"elites: expected at most {self.candidates}, the candidates, got {self.elites}")
        for name in ("pixel_weight", "chamfer_weight"):
            check_number(name, getattr(self, name), least=0)
        if not self.pixel_weight and not self.chamfer_weight:
            raise ValueError("pixel_weight, chamfer_weight: expected numbers >= 0, not both 0")


class NoPoke(ValueError):
    """There is nothing to poke, or no room to."""


# --- what the robot sees -------------------------------------------------------------------------------------

def view_of(scene, marks):
    """A View of a Scene of one picture and the marked points (M, 3) m. Raises NoPoke where no object stands."""
    if not scene.occupied.any():
        raise NoPoke("scene: no object stands in the arena")
    on = np.ones((1, len(marks)), bool)
    appended = {name: np.concatenate([getattr(scene, name), on], axis=1)
                for name in ("valid", "occupied", "stands_out")}
    points = np.concatenate([scene.points, np.float32(marks)[None]], axis=1)
    return View(replace(scene, points=points, **appended), len(marks))


def goal_of(pixels, scene=None):
    """A Goal from the pixels (M, 2) where the marked points shall be and, for the Chamfer term, the goal's Scene.

    Raises ValueError for an empty goal scene.
    """
    if scene is not None and not scene.occupied.any():
        raise ValueError("goal scene: no object stands in the arena")
    return Goal(np.asarray(pixels, np.float32), None if scene is None else scene.points[scene.occupied])


# --- actions inside the training distribution --------------------------------------------------------------------

def possible_starts(pokes, grid, settings, lengths=5):
    """Where the finger may come down for each poke: pokes (J, 3), occupied cells (J, rows, columns) -> (J, L, 2) m.

    Training pokes came from free cells 10 to 14 cm behind an occupied target (sim/arena.py, sample_poke); so many
    `lengths` of such paths are tried, the shortest first. NaN where the finger does not fit, and for pokes whose target
    is outside the walls or not in the neighbourhood of an occupied cell.
    """
    near = with_neighbours(grid).reshape(len(grid), -1)
    on_object = near[np.arange(len(pokes)), cells_of(pokes[:, :2], settings)]
    on_object &= np.abs(pokes[:, :2]).max(axis=1) < settings["arena"] / 2
    back = -np.stack([np.cos(pokes[:, 2]), np.sin(pokes[:, 2])], axis=-1)
    starts = pokes[:, None, :2] + np.linspace(*settings["poke_length"], lengths)[:, None] * back[:, None]
    possible = on_object[:, None] & finger_fits(starts, grid, settings)
    return np.where(possible[..., None], starts, np.nan)


def first_start(starts):
    """The first possible of starts (J, L, 2), NaN where there is none -> (J, 2)."""
    return starts[np.arange(len(starts)), np.argmax(np.isfinite(starts[..., 0]), axis=1)]


def draw_pokes(rng, count, view, settings, horizon=1):
    """Sequences (count, H, 3) much as the training pokes were drawn: on what stands in the arena, from anywhere.

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


def learned_step(run, view):
    """The learned model as a `step` of `roll`: what is seen stays as prepared once, only the points move."""
    def step(clouds, pokes):
        return np.concatenate([predict(run.params, run.recipe.sizes, moved_scene(view, clouds[i:i + CHUNK]),
                                       pokes[i:i + CHUNK]).points for i in range(0, len(clouds), CHUNK)])
    return step


def moved_scene(view, clouds):
    """The Scene of a view whose points went to clouds (J, N + M, 3) m."""
    shape = clouds.shape[:2]
    flags = {name: np.broadcast_to(getattr(view.scene, name), shape) for name in ("valid", "occupied", "stands_out")}
    return Scene(clouds, **flags, arena=view.scene.arena)


# --- the cost ----------------------------------------------------------------------------------------------------

SLACK = 0.015  # m; marks are followed no better than that, so nearer than this the Chamfer distance decides alone


def planning_cost(clouds, view, goal, camera, search):
    """Paper: Sec. IV-G, "pixel distance, between user marked object points, and the Chamfer distance of the whole scene
    to the goal scene".  clouds (J, N + M, 3) m -> (J,). Table and walls do not move and are left out.
    """
    cost = np.zeros(len(clouds))
    if search.pixel_weight:
        pixels = project(clouds[:, len(view.cloud) - view.marked:], camera)  # where optical flow takes them
        away = np.linalg.norm(pixels - goal.pixels, axis=2) * camera.pixel_size  # m on the table, at any picture size
        cost += search.pixel_weight * 100 * np.maximum(away - SLACK, 0).mean(axis=1)
    if search.chamfer_weight:
        if goal.points is None:
            raise ValueError("chamfer_weight: without a goal picture only the pixels count; set it to 0")
        tree = cKDTree(goal.points)
        for j, cloud in enumerate(clouds[:, view.occupied]):
            there, back = tree.query(cloud)[0], cKDTree(cloud, balanced_tree=False).query(goal.points)[0]
            cost[j] += search.chamfer_weight * 100 * np.sqrt(np.mean(there ** 2) + np.mean(back ** 2))
    return cost


# --- the cross entropy method -------------------------------------------------------------------------------------

LEAST = np.array([0.002, 0.002, 0.03])  # m, m, rad: a narrower Gaussian only draws the same pokes again


def wrapped(angle):
    """Angles (...) rad in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def refit(elites):
    """A Gaussian over sequences: elites (K, H, 3) -> mean, standard deviation, (H, 3) each; directions are circular."""
    mean = elites.mean(axis=0)
    mean[:, 2] = np.arctan2(np.sin(elites[..., 2]).mean(axis=0), np.cos(elites[..., 2]).mean(axis=0))
    away = elites - mean
    away[..., 2] = wrapped(away[..., 2])
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
        costs = np.where(np.isnan(costs), np.inf, costs)  # NaN loses
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
        population[..., 2] = wrapped(population[..., 2])
        population[0] = best  # so that refitting never loses it
    return best, lowest


@dataclass(frozen=True)
class Plan:
    """pokes (H, 3) and cost of the best sequence; now: the cost of leaving all as it is."""
    pokes: np.ndarray
    cost: float
    now: float


def plan(rollout, view, goal, camera, settings, search, rng, on_iteration=None, draw=None):
    """The best sequence of pokes to a goal that CEM finds -> Plan. draw: what makes the first population (J, H, 3) of
    the cost of sequences, instead of `draw_pokes`.

    The cost of a sequence is that of the scene after its last poke: to make room for another is no gain yet.
    """
    def cost(sequences):
        clouds, starts = rollout(sequences)
        found = planning_cost(clouds[:, -1], view, goal, camera, search)
        return np.where(np.isnan(starts).any(axis=(1, 2)), np.inf, found)

    first = draw(cost) if draw else draw_pokes(rng, search.candidates, view, settings, search.horizon)
    pokes, lowest = cem(cost, first, rng, search, on_iteration)
    return Plan(pokes, lowest, float(planning_cost(view.cloud[None], view, goal, camera, search)[0]))
