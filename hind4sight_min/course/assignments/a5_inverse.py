"""The inverse model and its heat-maps

The inverse model sees two frames and says which poke led from one to the other, as two heat-maps over the cells of the
arena's grid: where the finger came down, and where it went. It is trained with the poke itself, which the robot knows:

    softmax(z)_k = exp(z_k) / sum_j exp(z_j)
    L_act = -log softmax(z_start)[cell of the start] - log softmax(z_end)[cell of the end]
    L_sim = mean |s'_{t+1} - s_{t+1}|

exp overflows for large logits; subtracting the largest of them changes nothing else. s_t is the state embedding, the
sum of the encoder's features over the points of objects (times STATE_GAIN): s'_{t+1} that of the predicted cloud,
s_{t+1} that of the observed one. L_sim moves the points. Where it measures, its gradient must stop: free to, the
encoder would make L_sim small by saying nothing at all.

**Cells** are counted row by row; rows run along y, columns along x; cell 0 is at the corner (-arena/2, -arena/2).

**From heat-maps back to a poke.** The best cell of the end map is known to a cell only; the map's mean over the cells
less than PEAK around its centre is finer. The direction is that of the mean, over the start map, of the unit vectors
from the cells' centres to the target.

Paper: Sec. III-E; docs/architecture.md.
"""
import autograd.numpy as anp
import numpy as np
from autograd.tracer import getval

from ...interactions import cell_centres, cells_of
from ...lab.evaluation import poke_from_heatmaps
from ...losses import embedding_loss, heatmap_cross_entropy
from ...networks import STATE_GAIN, encode, softmax, state_embedding
from ..task import Task, single


def logit_cases(rng):
    by_hand = {"logits": np.log([[1.0, 2, 5], [1, 1, 2]])}
    drawn = [{"logits": rng.normal(size=(2, 3, 5))} for _ in range(2)]
    return [by_hand, drawn[0], {"logits": drawn[0]["logits"] + 1000}, single(drawn[1])]


def naive(logits, axis=-1):
    return anp.exp(logits) / anp.sum(anp.exp(logits), axis=axis, keepdims=True)


# --- cells ---

def grid(function, xy, arena, cell):
    return function(xy, {"arena": arena, "cell": cell})


def place_cases(rng):
    by_hand = {"xy": np.array([[-0.14, -0.14], [0.06, -0.14], [0.0, 0.12], [0.9, 0.0]]), "arena": 0.3, "cell": 0.1}
    return [by_hand, {"xy": rng.uniform(-0.3, 0.3, (4, 9, 2)), "arena": 0.5, "cell": 0.025}]


def cells_by(rounding, xy, settings, clip=True, swap=False):
    count = round(settings["arena"] / settings["cell"])
    cell = rounding((xy + settings["arena"] / 2) / settings["cell"]).astype(int)
    cell = np.clip(cell, 0, count - 1) if clip else cell
    return cell[..., 0] * count + cell[..., 1] if swap else cell[..., 1] * count + cell[..., 0]


# --- the two losses ---

def entropy_cases(rng):
    by_hand = {"logits": np.log([[1.0, 2, 5], [1, 1, 2]]), "cells": np.array([2, 0])}
    drawn = [{"logits": rng.normal(size=(3, 7)), "cells": np.array([4, 0, 6])} for _ in range(2)]
    return [by_hand, drawn[0], {**drawn[0], "logits": drawn[0]["logits"] + 1000}, single(drawn[1])]


def picked(values, cells):
    return values[np.arange(len(cells)), cells]


def embedding_cases(rng):
    by_hand = {"predicted": np.array([[1.0, 2, 3, 0], [0, 0, 0, 8]]),
               "observed": np.array([[2.0, 0, 3, 1], [1, 2, 3, 4]])}
    drawn = [{"predicted": rng.normal(size=(3, 5)), "observed": rng.normal(size=(3, 5))} for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


# --- the state embedding ---

def state_cases(rng):
    def drawn(shape):
        return {"points": rng.uniform(-0.2, 0.2, (*shape, 3)), "weights": rng.normal(size=(4, 4)),
                "occupied": np.arange(np.prod(shape)).reshape(shape) % 3 > 0}
    fixed = {"points": np.array([[[0.1, 0.2, 0.01], [0.1, 0.0, 0.03]]]), "weights": np.eye(4)[::-1].copy(),
             "occupied": np.array([[True, False]])}
    return [fixed, drawn((2, 6)), single(drawn((2, 6)))]


LAYERS = {"encoder_1_w": np.random.default_rng(0).normal(size=(20, 4)) / 4, "encoder_1_b": np.zeros(4),
          "encoder_2_b": np.zeros(4)}


def embedded(function, points, weights, occupied):
    """With an encoder of four features, the same at every call but for the weights of its second layer."""
    dtype = getval(points).dtype
    return function({**{name: value.astype(dtype) for name, value in LAYERS.items()}, "encoder_2_w": weights}, points,
                    occupied)


def summed(params, points, weights):
    return anp.sum(STATE_GAIN * encode(params, points) * weights[..., None], axis=1)


def held(params):
    return {name: getval(value) for name, value in params.items()}


# --- from heat-maps to a poke ---

def heatmap_cases(rng):
    by_hand = {"start_heatmap": np.array([0.5, 0, 0, 0, 0, 0, 0.5, 0, 0]), "arena": 0.15, "cell": 0.05,
               "end_heatmap": np.array([0, 0.1, 0, 0, 0.5, 0.4, 0, 0, 0])}
    drawn = []
    for _ in range(2):
        maps = rng.random((2, 100)) ** 8
        maps[1, rng.integers(100)] = 2
        drawn.append({**dict(zip(("start_heatmap", "end_heatmap"), maps / maps.sum(axis=1, keepdims=True))),
                      "arena": 0.5, "cell": 0.05})
    return [by_hand, *drawn]


def named(function, start_heatmap, end_heatmap, arena, cell):
    return function(start_heatmap, end_heatmap, {"arena": arena, "cell": cell})


def poke_to(target, start_heatmap, settings):
    """The poke to another target, its direction from the start map's mean."""
    centres = cell_centres(settings)
    away = np.linalg.norm(target - centres, axis=1, keepdims=True)
    mean = start_heatmap @ ((target - centres) / np.maximum(away, 1e-9))
    return np.array([*target, np.arctan2(mean[1], mean[0])])


def turned(direction):
    """The right target with another direction: (poke, start_heatmap, centres) -> rad."""
    def function(start_heatmap, end_heatmap, settings):
        poke = poke_from_heatmaps(start_heatmap, end_heatmap, settings)
        return np.array([*poke[:2], direction(poke, start_heatmap, cell_centres(settings))])
    return function


TASKS = (
    Task("5.1", "networks.softmax", "Probabilities from logits, safe for large ones", 10, 10, logit_cases,
         gradient=("logits",), mistakes={
             "exp overflows: subtract the largest logit first": naive,
             "Over all numbers instead of the last axis": lambda z: softmax(z.reshape(1, -1)).reshape(z.shape),
             "Over the first axis instead of the last": lambda z: anp.swapaxes(softmax(anp.swapaxes(z, 0, -1)), 0, -1),
             "The logarithm of it": lambda z: anp.log(softmax(z)),
             "Not divided by the sum": lambda z: anp.exp(z - np.max(getval(z), axis=-1, keepdims=True))}),
    Task("5.2", "interactions.cells_of", "Which cell of the grid a place is in", 15, 15, place_cases, grid, mistakes={
        "Rows and columns swapped: rows run along y": lambda xy, settings: cells_by(np.floor, xy, settings, swap=True),
        "Rounded to the nearest instead of down": lambda xy, settings: cells_by(np.round, xy, settings),
        "Places outside of the arena belong to the cells of its rim":
            lambda xy, settings: cells_by(np.floor, xy, settings, clip=False),
        "The arena's origin is in its middle, not in its corner":
            lambda xy, settings: cells_of(xy - settings["arena"] / 2, settings)},
         notes="settings is a dict with \"arena\", its side, and \"cell\", a cell's, in m. Only the last axis of xy is "
               "sure: it may be (2,), (4, 2), (3, 5, 2)."),
    Task("5.3", "losses.heatmap_cross_entropy", "L_act of one heat-map", 20, 20, entropy_cases, gradient=("logits",),
         mistakes={
             "The sign: it is minus the logarithm": lambda z, cells: -heatmap_cross_entropy(z, cells),
             "exp overflows: subtract the largest logit first": lambda z, cells: -anp.log(picked(naive(z), cells)),
             "The logarithm is missing": lambda z, cells: picked(softmax(z), cells),
             "The softmax is missing": lambda z, cells: -picked(z, cells),
             "Cells are counted from 0": lambda z, cells: heatmap_cross_entropy(z, (cells - 1) % z.shape[1]),
             "The mean over the interactions: one number each":
                 lambda z, cells: anp.mean(heatmap_cross_entropy(z, cells))}),
    Task("5.4", "losses.embedding_loss", "L_sim", 10, 5, embedding_cases, gradient=("predicted", "observed"), mistakes={
        "The sum over the embedding instead of its mean": lambda p, o: anp.sum(anp.abs(p - o), axis=1),
        "Squared: L_sim has the absolute value": lambda p, o: anp.mean((p - o) ** 2, axis=1),
        "The sign is kept: where is |.|?": lambda p, o: anp.mean(p - o, axis=1),
        "The length of the difference (L2)": lambda p, o: anp.sqrt(anp.sum((p - o) ** 2, axis=1)),
        "No gradient to the observed state's embedding": lambda p, o: embedding_loss(p, getval(o))},
         notes="autograd's derivative of anp.mean turns float32 into float64; divide anp.sum by a float."),
    Task("5.5", "networks.state_embedding", "The sum of features over the points of objects", 20, 25, state_cases,
         embedded, gradient=("points", "weights"), mistakes={
             "The gradient must stop at the encoder's weights":
                 lambda params, points, occupied: summed(params, points, occupied.astype(points.dtype)),
             "The gradient must go on to the points":
                 lambda params, points, occupied: state_embedding(params, getval(points), occupied),
             "All points count: only those of objects do":
                 lambda params, points, occupied: state_embedding(params, points, occupied | True),
             "STATE_GAIN is missing":
                 lambda params, points, occupied: state_embedding(params, points, occupied) / STATE_GAIN,
             "The mean over the points instead of the sum": lambda params, points, occupied: summed(
                 held(params), points, occupied / occupied.sum(axis=1, keepdims=True).astype(points.dtype))},
         notes="`encode(params, points)` gives the features (B, N, E); `getval(parameter)` is the same array, of which "
               "autograd knows nothing. `weights` here is the parameter \"encoder_2_w\", whose gradient must be 0; the "
               "others are fixed, so this case is to be compared, not done by hand."),
    Task("5.6", "lab.evaluation.poke_from_heatmaps", "The poke that two heat-maps name", 25, 30, heatmap_cases, named,
         mistakes={
             "The best cell's centre: the mean around it is finer":
                 lambda start, end, settings: poke_to(cell_centres(settings)[end.argmax()], start, settings),
             "The mean of all of the end map: cells further than PEAK from the best one do not count":
                 lambda start, end, settings: poke_to(end @ cell_centres(settings), start, settings),
             "The direction is opposite: it is that from the start to the target":
                 turned(lambda poke, start, centres: poke[2] - np.sign(poke[2]) * np.pi),
             "arctan2 takes y first": turned(lambda poke, start, centres: np.arctan2(np.cos(poke[2]), np.sin(poke[2]))),
             "The direction from the best start cell alone, not the start map's mean":
                 turned(lambda poke, start, centres: np.arctan2(*(poke[:2] - centres[start.argmax()])[::-1])),
             "The direction from the start map's mean place: each cell's unit vector counts":
                 turned(lambda poke, start, centres: np.arctan2(*(poke[:2] - start @ centres)[::-1]))}),
)
TESTS = ("inverse_loss",)
