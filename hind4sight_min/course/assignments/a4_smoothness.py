"""Smoothness and the whole objective

Colours say little where a surface has none, and nearest neighbours are often the wrong ones. What helps is that flow is
*piecewise smooth*: neighbours mostly move alike, but for the edges of objects, and there the picture has edges too.

    L_fs = sum_xy |grad U| e^{-|grad I_t|} + |grad V| e^{-|grad I_t|}                                     Eq. (4)
    L_ds = sum_xy |grad D_{P->P'}| e^{-|grad I|} + |grad D_{P'->P}| e^{-|grad I|}                         Eq. (5)

|grad f| is |df/dx| + |df/dy|, and df/dx the step from a pixel to the one on its right, df/dy to the one below: a
picture of W columns has W - 1 steps along a row. |dI/dx|, the mean over the channels, weights the steps along x,
|dI/dy| those along y. Images lie in [0, 1], where a factor (EDGE_SHARPNESS) makes their edges count: e^{-40 |grad I|}.
A step counts where both of its pixels are valid.

The paper prints I_{t+1} for both maps of Eq. (5). But D_{P'->P} lives on frame t's grid: here each map is weighted by
the image of its own grid.

**The whole objective** is a weighted sum, averaged over the batch, with a weight per term, so that an ablation is a 0:

    L = lambda_1 (L_CD + L_ds) + lambda_2 (L_rec + L_fs) + lambda_3 L_inv                                 Eq. (6)

Paper: Sec. III-D and III-F; tutorials/06_smoothness.py.
"""
from functools import partial

import autograd.numpy as anp
import numpy as np

from ...losses import (EDGE_SHARPNESS, distance_smoothness_loss, edge_aware_smoothness, edge_weights,
                       flow_smoothness_loss, full_loss)
from ..task import Task, single


def pictures(rng, shape=(2, 4, 5)):
    """Of low contrast, so that no weight is nearly 0."""
    return rng.uniform(0, 0.08, shape + (3,))


def flags(rng, batch=2, count=20):
    return (rng.random((batch, count)) < 0.85) & (np.arange(count) > 1)  # two neighbours without depth, at least


def weight_cases(rng):
    by_hand = {"images": np.array([[0, 0.05, 0.05], [0.1, 0.05, 0.05]]).reshape(1, 2, 3, 1)}
    return [by_hand, {"images": pictures(rng)}, single({"images": pictures(rng)})]


def other_weights(of_step, sharpness=EDGE_SHARPNESS):
    """edge_weights with something else than the mean over the channels of |step|."""
    return lambda images: tuple(np.exp(-images.dtype.type(sharpness) * of_step(np.diff(images, axis=axis)))
                                for axis in (2, 1))


def field_cases(rng, name="field", channels=2):
    """Steps along x of 1 and 2, along y of 4; an edge of the picture between the rows; one pixel without depth."""
    by_hand = {name: np.array([[0.0, 1, 3], [4, 5, 7]]).reshape(1, 2, 3, 1),
               "images": np.array([[[0.0] * 3, [0.05] * 3]])[..., None] + np.zeros(3),
               "valid": np.arange(6).reshape(1, 6) < 5}
    if channels == 2:
        by_hand[name] = by_hand[name] * [1, 10]
    drawn = [{name: rng.normal(size=(2, 4, 5, channels)), "images": pictures(rng), "valid": flags(rng)}
             for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


def smoothness(of_step, counts=np.logical_and, weights=edge_weights):
    """Eq. (4) with something else than |.| of a step, other steps that count, or other weights."""
    def loss(field, images, valid):
        (across, down), seen = weights(images), np.reshape(valid, images.shape[:3])
        across, down = across * counts(seen[:, :, 1:], seen[:, :, :-1]), down * counts(seen[:, 1:], seen[:, :-1])
        return (anp.sum(of_step(field[:, :, 1:] - field[:, :, :-1]) * across[..., None], axis=(1, 2, 3))
                + anp.sum(of_step(field[:, 1:] - field[:, :-1]) * down[..., None], axis=(1, 2, 3)))
    return loss


def length(step):
    """Of the vector (U, V), as one channel."""
    return anp.sqrt(anp.sum(step ** 2, axis=-1, keepdims=True) + step.dtype.type(1e-30))


def map_cases(rng):
    def images(edge_along):
        dark = np.zeros((1, 2, 2, 3))
        dark[(0, slice(None), 1) if edge_along == "x" else (0, 1)] = 0.05
        return dark
    by_hand = {"map_predicted": np.array([[0.0, 1, 0, 3]]), "map_observed": np.array([[0.0, 10, 20, 20]]),
               "images": images("x"), "next_images": images("y"), "valid": np.ones((1, 4), bool),
               "next_valid": np.array([[True, True, True, False]])}
    drawn = [{"map_predicted": rng.random((2, 20)), "map_observed": rng.random((2, 20)), "images": pictures(rng),
              "next_images": pictures(rng), "valid": flags(rng), "next_valid": flags(rng)} for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


def with_maps(change):
    """Eq. (5) with other images and masks: (images, next_images, valid, next_valid) -> these four."""
    return lambda map_predicted, map_observed, *others: distance_smoothness_loss(
        map_predicted, map_observed, *change(*others))


NAMES = "chamfer", "distance_smoothness", "photometric", "flow_smoothness", "inverse"


def term_cases(rng):
    by_hand = {"terms": np.array([[1.0, 3], [10, 50], [7, 9]]), "weights": np.array([2.0, 0.5])}
    drawn = [{"terms": rng.random((5, 4)) + 1, "weights": np.array([2.0, 0.3, 0.7, 5.0])} for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


def of_terms(function, terms, weights):
    """Rows of `terms` by name; the last one has no weight, which is a weight of 0."""
    return function({name: terms[i] for i, name in zip(range(len(terms)), NAMES)}, dict(zip(NAMES, weights.tolist())))


def total(terms, weights, missing=0.0):
    return sum(weights.get(name, missing) * term for name, term in terms.items())


def mean(terms):
    """Of one number per interaction, in its own dtype."""
    return anp.sum(terms) / float(len(terms))


TASKS = (
    Task("4.1", "losses.edge_weights", "How much each step counts: less across an edge", 15, 20, weight_cases,
         mistakes={
             "The exponent's sign: an edge makes a step cheaper":
                 lambda images: tuple(1 / each for each in edge_weights(images)),
             "EDGE_SHARPNESS is missing": other_weights(lambda step: np.abs(step).mean(axis=3), sharpness=1),
             "The sign of the step is kept: where is |.|?": other_weights(lambda step: step.mean(axis=3)),
             "|.| after the mean over the channels, not before: an edge between two hues vanishes":
                 other_weights(lambda step: np.abs(step.mean(axis=3))),
             "The sum over the channels instead of their mean": other_weights(lambda step: np.abs(step).sum(axis=3)),
             "Across and down swapped": lambda images: edge_weights(images)[::-1]}),
    Task("4.2", "losses.edge_aware_smoothness", "The common form of Eq. (4) and (5)", 30, 35, field_cases,
         gradient=("field",), mistakes={
             "Squared: the equation has the absolute value": smoothness(lambda step: step ** 2),
             "A step counts where both of its pixels are valid, not one of them":
                 smoothness(anp.abs, counts=np.logical_or),
             "A step counts where both of its pixels are valid, not the first alone":
                 smoothness(anp.abs, counts=lambda later, earlier: earlier),
             "Pixels that are not valid count":
                 lambda field, images, valid: edge_aware_smoothness(field, images, valid | True),
             "The weights of the picture's edges are missing":
                 smoothness(anp.abs, weights=lambda images: [1.0, 1.0]),
             "The mean instead of the sum": lambda field, images, valid: edge_aware_smoothness(
                 field, images, valid) / float(np.prod(field.shape[1:])),
             "Only steps along x": smoothness(anp.abs, weights=lambda images: [edge_weights(images)[0], 0.0])}),
    Task("4.3", "losses.flow_smoothness_loss", "Eq. (4)", 15, 10, partial(field_cases, name="flow"),
         gradient=("flow",), mistakes={
             "Only U: V counts too": lambda flow, images, valid: edge_aware_smoothness(flow[..., :1], images, valid),
             "The length of the step's vector: U and V count each by itself": smoothness(length),
             "The edges of the picture have no say": smoothness(anp.abs, weights=lambda images: [1.0, 1.0]),
             "The mean of U's and V's terms: Eq. (4) has their sum":
                 lambda flow, images, valid: flow_smoothness_loss(flow, images, valid) / 2.0}),
    Task("4.4", "losses.distance_smoothness_loss", "Eq. (5), each map with the image of its own grid", 20, 15,
         map_cases, gradient=("map_predicted", "map_observed"), mistakes={
             "I_{t+1} for both maps, as printed in the paper: D_{P'->P} lives on frame t's grid":
                 with_maps(lambda now, later, valid, next_valid: (later, later, valid, next_valid)),
             "Image and mask of frame t+1 for both maps: D_{P'->P} lives on frame t's grid":
                 with_maps(lambda now, later, valid, next_valid: (later, later, next_valid, next_valid)),
             "I_t for both maps": with_maps(lambda now, later, valid, next_valid: (now, now, valid, next_valid)),
             "The two images are swapped": with_maps(lambda now, later, valid, next_valid: (
                 later, now, valid, next_valid)),
             "The two masks are swapped": with_maps(lambda now, later, valid, next_valid: (
                 now, later, next_valid, valid)),
             "Images and masks are swapped: map_predicted lives on frame t's grid":
                 with_maps(lambda now, later, valid, next_valid: (later, now, next_valid, valid)),
             "D_{P'->P} is missing": lambda p, o, *others: distance_smoothness_loss(0 * p, o, *others)}),
    Task("4.5", "losses.full_loss", "The weighted sum of all terms, averaged over the batch, Eq. (6)", 20, 15,
         term_cases, of_terms, gradient=("terms",), mistakes={
             "The sum over the batch instead of its mean": lambda terms, weights: anp.sum(total(terms, weights)),
             "One number per interaction: average over the batch": total,
             "A missing weight was taken for 1; it is 0":
                 lambda terms, weights: mean(total(terms, weights, missing=1.0)),
             "The weights are ignored": lambda terms, weights: mean(sum(terms.values())),
             "Divided by the number of terms, not of interactions":
                 lambda terms, weights: anp.sum(total(terms, weights)) / float(len(terms)),
             "The weights go with each other's terms: by name, not by position":
                 lambda terms, weights: full_loss(terms, dict(zip(weights, reversed(weights.values()))))},
         notes="Here each row of terms is one of the dict's, its names being in this order chamfer, "
               "distance_smoothness, photometric, flow_smoothness, inverse; those of the weights too. The last row has "
               "no weight."),
)
TESTS = "eq4_flow_smoothness", "eq5_distance_smoothness", "eq6_full_loss"
