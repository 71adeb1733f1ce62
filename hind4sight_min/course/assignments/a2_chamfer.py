"""The Chamfer distance

Nobody says which point of the predicted cloud P' is which of the observed cloud P. The Chamfer distance asks each point
for its nearest neighbour in the other cloud:

    D_{P'->P}(i) = min_j |P'_i - P_j|^2,    D_{P->P'}(j) = min_i |P'_i - P_j|^2
    L_CD = sum_i D_{P'->P}(i) + sum_j D_{P->P'}(j)                                             Eq. (2)

Squared, both ways, summed. As pictures on the pixels the points come from, the two are *distance maps*, the first on
frame t's grid, the second on frame t+1's. Pixels without depth neither attract (they are nobody's neighbour) nor cost
anything (0 in their map).

**The neighbours** come from a KD-tree (`scipy.spatial.cKDTree`), which autograd knows nothing of. So the distance to a
*given* neighbour is a primitive, and its derivative is written by hand as a VJP (vector-Jacobian product): from g, the
gradient of some scalar L with respect to the distances d, those with respect to the inputs.

    d_i = |q_i - r_j|^2, j = indices_i:    dL/dq_i = 2 g_i (q_i - r_j),    dL/dr_j = -sum over those i of dL/dq_i

A reference may be nearest to several queries, and collects from all of them; one that is nearest to none gets 0. That
the neighbour changes when a point moves far enough is ignored: exact but where two are equally near.

**What only one frame shows** has no counterpart: an object covers table in frame t+1 that frame t shows, and uncovers
other. A pixel counts unless it is table (valid, not occupied) where the *other* frame shows an object.

Paper: Sec. III-B; tutorials/04_chamfer.py (03_derivative.py for the VJP).
"""
import autograd.numpy as anp
import numpy as np
from autograd.tracer import getval

from ...losses import chamfer_loss, distance_maps, seen_in_both
from ...ops import nearest_squared_distances, squared_distances
from ..task import Task, single


def on_a_line(*x):
    return np.array([[[value, 0, 0] for value in x]], float)


# --- the distance to a given neighbour, and its VJP ---

def distance_cases(rng):
    by_hand = {"queries": np.array([[0.0, 0], [1, 2], [4, 0]]), "references": np.array([[3.0, 0], [1, 1], [9, 9]]),
               "indices": np.array([0, 1, 0])}
    drawn = [{"queries": rng.normal(size=(6, 3)), "references": rng.normal(size=(5, 3)),
              "indices": np.array([2, 0, 2, 4, 2, 0])} for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


def pull_cases(rng):
    cases = distance_cases(rng)
    for case in cases:
        case["g"] = np.array([1.0, 10, 100]) if case is cases[0] else (
            rng.uniform(0.5, 2, 6) * [1, -1, 1, -1, 1, -1]).astype(case["queries"].dtype)
    return cases


def both_gradients(function, queries, references, indices, g):
    args = queries, references, indices
    return tuple(function((0, 1), squared_distances(*args), args, {})(g))


def pulls(scale, on_references):
    """A wrong VJP: 2 is the right scale; on_references: pull, indices, count -> the references' gradient."""
    def maker(argnums, ans, args, kwargs):
        queries, references, indices = args

        def vjp(g):
            pull = scale(g) * (queries - references[indices])
            return [pull, on_references(pull, indices, np.zeros_like(references))]
        return vjp
    return maker


def collected(pull, indices, gradient, sign=-1):
    np.add.at(gradient, indices, sign * pull)
    return gradient


def last_only(pull, indices, gradient):
    gradient[indices] = -pull
    return gradient


# --- the nearest neighbour ---

def nearest_cases(rng):
    by_hand = {"queries": on_a_line(0, 1), "references": on_a_line(3, 8, 2), "valid": np.array([[True, True, False]])}
    drawn = [{"queries": rng.normal(size=(2, 6, 3)), "references": rng.normal(size=(2, 9, 3)),
              "valid": np.arange(9) % 3 + np.zeros((2, 1)) > 0} for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


def all_in_one(queries, references, valid):
    one = [anp.reshape(each, (1, -1, each.shape[2])) for each in (queries, references)]
    return anp.reshape(nearest_squared_distances(*one, valid.reshape(1, -1)), queries.shape[:2])


# --- both maps ---

def map_cases(rng):
    flags = {"valid_predicted": np.array([[True, True, False]]), "valid_observed": np.array([[True, False, True]])}
    by_hand = {"predicted": on_a_line(0, 1, 2), "observed": on_a_line(3, 1.5, 8), **flags}
    drawn = [{"predicted": rng.normal(size=(2, 8, 3)), "observed": rng.normal(size=(2, 8, 3)),
              "valid_predicted": np.arange(8) % 4 + np.zeros((2, 1)) > 0,
              "valid_observed": np.arange(8) % 3 + np.zeros((2, 1)) > 0} for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


def loss_cases(rng):
    drawn = [{"map_predicted": rng.random((3, 5)), "map_observed": rng.random((3, 5))} for _ in range(2)]
    by_hand = {"map_predicted": np.array([[1.0, 2], [3, 4]]), "map_observed": np.array([[10.0, 20], [30, 40]])}
    return [by_hand, drawn[0], single(drawn[1])]


def seen_cases(rng):
    names = "valid", "next_valid", "occupied", "next_occupied"
    by_hand = np.array([[[1, 1, 1, 0]], [[1, 1, 1, 1]], [[0, 1, 0, 0]], [[0, 0, 1, 0]]], bool)
    return [dict(zip(names, each)) for each in (by_hand, rng.random((4, 2, 40)) < 0.6)]


TASKS = (
    Task("2.1", "ops.squared_distances", "The squared distance of each query to a given reference", 10, 10,
         distance_cases, mistakes={
             "The distance, not its square": lambda q, r, indices: np.sqrt(squared_distances(q, r, indices)),
             "The mean over the coordinates instead of the sum":
                 lambda q, r, indices: ((q - r[indices]) ** 2).mean(axis=1),
             "Each query with the reference of its own number: `indices` says which one":
                 lambda q, r, indices: squared_distances(q, r, np.arange(len(q)) % len(r)),
             "Summed over the points too": lambda q, r, indices: squared_distances(q, r, indices).sum()},
         notes="An autograd primitive: it sees plain arrays, so its body is NumPy."),
    Task("2.2", "ops._squared_distances_vjp", "The VJP of squared_distances, by hand", 25, 40, pull_cases,
         both_gradients, mistakes={
             "Half of it: the square's factor 2 is missing": pulls(lambda g: g[:, None], collected),
             "The sign of the references' gradient":
                 pulls(lambda g: 2 * g[:, None], lambda *args: collected(*args, sign=1)),
             "A reference that is nearest to several keeps only the last of them: collect from all":
                 pulls(lambda g: 2 * g[:, None], last_only),
             "g is missing: a VJP gives the gradient of a scalar further on": pulls(lambda g: 2, collected)},
         notes="args are (queries, references, indices), kwargs is empty, ans are the distances, and argnums says "
               "whose gradients are asked for: 0 the queries', 1 the references'. It returns a function vjp(g), g "
               "(N,), that returns a list: for each of argnums the gradient, in the shape and dtype of that input."),
    Task("2.3", "ops.nearest_squared_distances", "Every query's squared distance to its nearest valid reference", 25,
         30, nearest_cases, gradient=("queries", "references"), mistakes={
             "The distance, not its square": lambda q, r, valid: anp.sqrt(nearest_squared_distances(q, r, valid)),
             "References that are not valid attract": lambda q, r, valid: nearest_squared_distances(q, r, valid | True),
             "Neighbours are sought in the whole batch": all_in_one,
             "No gradient to the references": lambda q, r, valid: nearest_squared_distances(q, getval(r), valid),
             "No gradient to the queries": lambda q, r, valid: nearest_squared_distances(getval(q), r, valid)},
         notes="Find the neighbours in plain arrays (`getval` takes them out of autograd's boxes), then let "
               "`squared_distances` say how far they are. Brute force counts as well as a tree."),
    Task("2.4", "losses.distance_maps", "Both distance maps, each on its own grid", 20, 15, map_cases,
         gradient=("predicted", "observed"), mistakes={
             "The two maps are swapped": lambda *args: distance_maps(*args)[::-1],
             "Pixels without depth cost: multiply each map by its own grid's mask":
                 lambda p, o, valid_p, valid_o: (nearest_squared_distances(p, o, valid_o),
                                                 nearest_squared_distances(o, p, valid_p)),
             "Pixels without depth attract: they must be nobody's neighbour":
                 lambda p, o, valid_p, valid_o: tuple(each * valid for each, valid in zip(
                     distance_maps(p, o, valid_p | True, valid_o | True), (valid_p, valid_o))),
             "The two masks are swapped":
                 lambda p, o, valid_p, valid_o: distance_maps(p, o, valid_o, valid_p)}),
    Task("2.5", "losses.chamfer_loss", "The sum of both maps, Eq. (2)", 10, 5, loss_cases,
         gradient=("map_predicted", "map_observed"), mistakes={
             "Too small: did you sum both directions?": lambda p, o: anp.sum(p, axis=1),
             "The mean instead of the sum over the pixels": lambda p, o: anp.mean(p + o, axis=1),
             "Summed over the interactions too: one number each": lambda p, o: anp.sum(p + o),
             "No gradient to the second map": lambda p, o: chamfer_loss(p, getval(o))}),
    Task("2.6", "losses.seen_in_both", "Which points have a counterpart in the other frame", 10, 15, seen_cases,
         mistakes={
             "Covered and uncovered table swapped":
                 lambda a, b, here, there: (a & (there | ~here), b & (here | ~there)),
             "Objects that moved are left out: only table has no counterpart":
                 lambda a, b, here, there: (a & ~(here ^ there), b & ~(here ^ there)),
             "Pixels without depth count":
                 lambda a, b, here, there: seen_in_both(a | True, b | True, here, there)}),
)
TESTS = ("eq2_chamfer",)
