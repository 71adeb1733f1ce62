"""The Chamfer distance

Theory.
"""
import autograd.numpy as anp
import numpy as np
from autograd.tracer import getval

from ..task import Task


def loss_cases(rng):
    maps = [{"map_predicted": rng.random((3, 5)), "map_observed": rng.random((3, 5))} for _ in range(2)]
    by_hand = {"map_predicted": np.array([[1.0, 2], [3, 4]]), "map_observed": np.array([[10.0, 20], [30, 40]])}
    return [by_hand, maps[0], {name: value.astype(np.float32) for name, value in maps[1].items()}]


def seen_cases(rng):
    names = "valid", "next_valid", "occupied", "next_occupied"
    by_hand = np.array([[[1, 1, 1, 0]], [[1, 1, 1, 1]], [[0, 1, 0, 0]], [[0, 0, 1, 0]]], bool)
    return [dict(zip(names, each)) for each in (by_hand, rng.random((4, 2, 30)) < 0.6)]


TASKS = (
    Task("2.4", "losses.chamfer_loss", "Sum both maps over the pixels, Eq. (2)", 4, 5, loss_cases,
         gradient=("map_predicted", "map_observed"),
         mistakes={
             "Twice too small, or nearly: did you sum both directions?": lambda map_predicted, map_observed:
                 anp.sum(map_predicted, axis=1),
             "The mean instead of the sum over the pixels": lambda map_predicted, map_observed:
                 anp.mean(map_predicted + map_observed, axis=1),
             "No gradient to the second map": lambda map_predicted, map_observed:
                 anp.sum(map_predicted + getval(map_observed), axis=1)}),
    Task("2.5", "losses.seen_in_both", "Which points have a counterpart in the other frame", 5, 15, seen_cases,
         mistakes={"Covered and uncovered table swapped": lambda valid, next_valid, occupied, next_occupied:
                   (valid & (next_occupied | ~occupied), next_valid & (occupied | ~next_occupied))}),
)
TESTS = ("eq2_chamfer",)
