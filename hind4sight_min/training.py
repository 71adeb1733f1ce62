"""Unsupervised training: the recipe, a batch, the loss of Eq. (6), two optimisers, one loop."""
import math
from dataclasses import dataclass, field, replace

import numpy as np
from autograd import grad
from autograd.tracer import getval

from . import check_number, check_whole, losses
from .geometry import optical_flow
from .interactions import cell_centres, cells_of
from .networks import Sizes, init_parameters, inverse_model, predict, state_embedding
from .ops import at_rows, take, unflatten
from .scene import Scene, crop, look, most_changed, scene_of

# From an audit of gradient norms, not of the terms' values; the photometric one from what turns need (research log).
WEIGHTS = {"chamfer": 1e3, "distance_smoothness": 3e2, "photometric": 2.0, "flow_smoothness": 0.01, "inverse": 1.0,
           "binary_masks": 0.5}


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a training run besides the data.

    steps: of the optimiser, one of OPTIMISERS. batch: interactions per step. learning_rate: peak; linear warm-up over
    `warmup` steps, then a cosine to zero. weights: of the terms of Eq. (6); a missing one is 0. image_noise: SD of
    noise added to the images I_t, in [0, 1]. Without it still pixels match exactly, and there |I_t - I'_t| has a kink:
    any motion costs more at once than the object gains, so a new network learns to move nothing. Noise below a grey
    level rounds the kink off. It goes into I_t, because warping would blur it in I_{t+1}.
    """
    steps: int = 3000
    batch: int = 16
    learning_rate: float = 1.5e-3
    warmup: int = 50
    optimiser: str = "muon"
    image_noise: float = 0.003
    seed: int = 0
    weights: dict = field(default_factory=lambda: dict(WEIGHTS))
    sizes: Sizes = Sizes()

    def __post_init__(self):
        for name, least, most in (("steps", 1, 1e7), ("batch", 1, 4096), ("warmup", 0, 1e7), ("seed", 0, 2 ** 63)):
            check_whole(name, getattr(self, name), least, most)
        if self.optimiser not in [*OPTIMISERS]:  # a list, for what cannot be hashed
            raise ValueError(f"optimiser: expected one of {', '.join(OPTIMISERS)}, got {str(self.optimiser):.99}")
        check_number("learning_rate", self.learning_rate, above=0)
        check_number("image_noise", self.image_noise, least=0)
        if not isinstance(self.sizes, Sizes):
            raise ValueError(f"sizes: expected Sizes, got {str(self.sizes):.99}")
        if not isinstance(self.weights, dict) or not any(self.weights.values()):
            raise ValueError(f"weights: expected numbers by name, at least one above 0, got {str(self.weights):.99}")
        for name, value in self.weights.items():
            check_number(f"weights: {name}", value, least=0)


# --- a batch and its loss --------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Batch:
    """B interactions as the model and the losses want them.

    before, after: Scenes, cropped to where the poke can move something. evidence: (before, after, weights, cells),
    what `inverse_model` is asked about, from the whole pictures. pokes (B, 3) float32. cells (B, 2) int: where the poke
    started and ended, on the grid.
    """
    before: Scene
    after: Scene
    evidence: tuple
    pokes: np.ndarray
    cells: np.ndarray


def make_batch(interactions, recipe, rng):
    """The Batch of all interactions of a record, with the recipe's noise on the images drawn from `rng`."""
    camera, settings, pokes = interactions.camera, interactions.settings, interactions.pokes
    before, after = scenes_of(interactions)
    cells = cells_of(np.stack([interactions.starts, pokes[:, :2]], axis=1), settings)
    evidence = (*most_changed(before, after), cell_centres(settings))
    before, after = crop(before, pokes, camera), crop(after, pokes, camera)
    noise = np.float32(recipe.image_noise) * rng.standard_normal(before.images.shape, np.float32)
    before.images[:] += noise  # `crop` made a copy
    return Batch(before, after, evidence, pokes, cells)


def scenes_of(interactions):
    """The whole pictures before and after the pokes, as Scenes."""
    return [scene_of(depth, rgb, interactions.empty_depth, interactions.camera, interactions.settings["arena"])
            for depth, rgb in ((interactions.depth_before, interactions.rgb_before),
                               (interactions.depth_after, interactions.rgb_after))]


def loss_terms(params, sizes, batch, camera, wanted=WEIGHTS):
    """The terms of Eq. (6), and `binary_masks`, that are wanted -> dict of (B,); what is left out takes no time."""
    before, after, terms = batch.before, batch.after, {}
    valid, next_valid = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
    prediction = predict(params, sizes, before, batch.pokes)
    if not np.isfinite(getval(prediction.points)).all():
        raise FloatingPointError("the predicted points are not finite")
    flow = optical_flow(before.points, prediction.points, camera)  # the projection layer, Sec. III-C
    flow = flow.reshape(before.images.shape[:3] + (2,))
    if {"chamfer", "distance_smoothness"} & set(wanted):
        maps = losses.distance_maps(prediction.points, after.points, valid, next_valid)
        terms["chamfer"] = losses.chamfer_loss(*maps)
        terms["distance_smoothness"] = losses.distance_smoothness_loss(*maps, before.images, after.images, valid,
                                                                       next_valid)
    if "photometric" in wanted:
        terms["photometric"] = losses.photometric_loss(before.images, after.images, flow, valid)
    if "flow_smoothness" in wanted:
        terms["flow_smoothness"] = losses.flow_smoothness_loss(flow, before.images, before.valid)
    if "binary_masks" in wanted:
        terms["binary_masks"] = losses.binary_mask_loss(prediction.masks)
    if "inverse" in wanted:
        heatmaps = inverse_model(params, *batch.evidence)
        # Only where the poke can have changed something: elsewhere both embeddings have the same share.
        (rows, seen), (next_rows, next_seen) = (look(scene, batch.pokes) for scene in (before, after))
        rows, next_rows = at_rows(rows), at_rows(next_rows)
        embeddings = (state_embedding(params, take(prediction.points, rows), before.occupied[rows] & seen),
                      state_embedding(params, after.points[next_rows], after.occupied[next_rows] & next_seen))
        terms["inverse"] = losses.inverse_loss(*heatmaps, *batch.cells.T, *embeddings)
    return {name: term for name, term in terms.items() if name in wanted}


# --- optimisers: the step to take away from the parameters ------------------------------------------------------

@dataclass
class Run:
    """The state of a training run: all that is needed to go on, or to use the model."""
    recipe: Recipe
    layout: dict              # name -> shape of each parameter
    vector: np.ndarray        # (P,) float32, all parameters
    first_moment: np.ndarray  # of the optimiser, (P,) each
    second_moment: np.ndarray
    step: int = 0
    meta: dict = field(default_factory=dict)  # camera, settings and provenance, plain JSON types

    @property
    def params(self):
        """The parameters by name."""
        return unflatten(self.vector, self.layout)


def adam(run, gradient, rate, beta1=0.9, beta2=0.999, epsilon=1e-8):
    """Adam (Kingma and Ba). Paper: Sec. III-G.  gradient (P,) -> (P,), and updates the run's moments.

    m <- b1 m + (1 - b1) g,  v <- b2 v + (1 - b2) g^2,  step = rate m' / (sqrt(v') + eps), where m' and v' are divided
    by 1 - b^t, for they start at 0.
    """
    run.first_moment += (1 - beta1) * (gradient - run.first_moment)
    run.second_moment += (1 - beta2) * (gradient ** 2 - run.second_moment)
    first = run.first_moment / (1 - beta1 ** run.step)
    second = run.second_moment / (1 - beta2 ** run.step)
    return np.float32(rate) * first / (np.sqrt(second) + np.float32(epsilon))


def muon(run, gradient, rate, beta=0.9):
    """Adam for vectors, orthogonalised momentum (Muon; K. Jordan et al., 2024) for matrices. Not in the paper.

    A few directions dominate the gradient of a layer's matrix; the others, in which it would have to move as well,
    hardly get to. Orthogonalised, all have the same say, and a third of the steps suffice (docs/research-log.md). Times
    sqrt(max(shape)), an entry moves by the rate, in the root mean square, as in Adam's first step.
    """
    step = adam(run, gradient, rate, beta1=beta)  # for vectors; it also updates the momentum that matrices need
    ahead = unflatten(beta * run.first_moment + (1 - beta) * gradient, run.layout)  # Nesterov's momentum
    for name, block in unflatten(step, run.layout).items():  # views of `step`
        if block.ndim == 2:
            block[:] = rate * math.sqrt(max(block.shape)) * orthogonalised(ahead[name])
    return step


def orthogonalised(matrix):
    """The matrix with its singular vectors kept and its singular values brought near 1.  (I, O) -> (I, O).

    Five Newton-Schulz iterations with Muon's coefficients: every singular value s, at most 1 after the division,
    becomes 3.4445 s - 4.7750 s^3 + 2.0315 s^5, which lifts the small ones quickest: of Gaussian matrices of 48 x 48 all
    but one in a hundred end between 0.68 and 1.2. An SVD, U V^T, takes four times as long.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return orthogonalised(matrix.T).T
    x = matrix / (np.linalg.norm(matrix) + np.float32(1e-12))  # a dead layer stays at 0
    for _ in range(5):
        square = x @ x.T
        x = 3.4445 * x + (-4.7750 * square + 2.0315 * square @ square) @ x
    return x


OPTIMISERS = {"adam": adam, "muon": muon}


# --- the loop ----------------------------------------------------------------------------------------------

def learning_rate(recipe, step):
    """Linear warm-up, then a cosine to zero."""
    warm = min(1.0, (step + 1) / max(recipe.warmup, 1))
    return recipe.learning_rate * warm * 0.5 * (1 + math.cos(math.pi * step / recipe.steps))


def start_run(recipe, interactions):
    """A fresh Run for a data set."""
    params = init_parameters(recipe.sizes, np.random.default_rng(recipe.seed))
    vector = np.concatenate([value.ravel() for value in params.values()])
    meta = {"camera": interactions.camera.plain, "settings": interactions.settings}
    return Run(recipe, {name: value.shape for name, value in params.items()}, vector,
               np.zeros_like(vector), np.zeros_like(vector), meta=meta)


def rows_of_step(recipe, count, step):
    """The rows of a step, from seed and step alone, so that a resumed run is the same run.

    Every epoch is a permutation of the rows; a batch may straddle two epochs.
    """
    check_whole("data: pokes", count, 1)
    first = step * recipe.batch
    rows = []
    for epoch in range(first // count, (first + recipe.batch - 1) // count + 1):
        order = np.random.default_rng([recipe.seed, 1, epoch]).permutation(count)
        rows.append(order[max(first - epoch * count, 0):first + recipe.batch - epoch * count])
    return np.concatenate(rows)


CHUNK = 8  # interactions per gradient: enough of them to hide autograd's overhead per operation


def unsupervised(params, recipe, interactions, rng):
    """What a step minimises, before the weights: the terms of Eq. (6), dict of (B,). SE3-Nets has another objective."""
    batch = make_batch(interactions, recipe, rng)
    wanted = [name for name, weight in recipe.weights.items() if weight]
    return loss_terms(params, recipe.sizes, batch, interactions.camera, wanted)


def chunk_gradient(objective, vector, layout, recipe, interactions, seed):
    """The terms, means as floats, and the gradient (P,) of Eq. (6) of some interactions at parameters `vector` (P,).

    The noise is drawn from `seed`. Times the chunk's share of the batch, so that chunks only need adding up.
    """
    kept, share = {}, len(interactions) / recipe.batch
    weights = {name: weight for name, weight in recipe.weights.items() if weight}

    def loss(vector):
        terms = objective(unflatten(vector, layout), recipe, interactions, np.random.default_rng(seed))
        kept.update((name, share * float(getval(value).mean())) for name, value in terms.items())
        return losses.full_loss(terms, weights)

    return kept, np.float32(share) * grad(loss)(vector)


def recipe_at(recipe, step):
    """The recipe with the weights of a step: that of `binary_masks` grows from 0 in proportion to the steps, for masks
    that must be decided before anything has moved decide for the background.
    """
    share = (step + 1) / recipe.steps
    return replace(recipe, weights={name: weight * share if name == "binary_masks" else weight
                                    for name, weight in recipe.weights.items()})


def training_step(data, run, objective=unsupervised, map=map):
    """One step: draw a batch, differentiate its loss chunk by chunk, take the optimiser's step. Updates the run.

    -> the terms, dict of floats, means over the batch. Raises FloatingPointError if the gradient is not finite; the run
    is then as it was.
    """
    recipe, rows = recipe_at(run.recipe, run.step), rows_of_step(run.recipe, len(data), run.step)
    chunks = [(objective, run.vector, run.layout, recipe, data[rows[i:i + CHUNK]], [recipe.seed, 2, run.step, i])
              for i in range(0, recipe.batch, CHUNK)]
    terms, gradients = zip(*map(chunk_gradient, *zip(*chunks)))
    gradient = sum(gradients)
    if not np.isfinite(gradient).all():
        raise FloatingPointError(f"the gradient is not finite at step {run.step}")
    rate = learning_rate(recipe, run.step)
    run.step += 1  # before the optimiser, whose correction of the moments counts from 1
    run.vector = run.vector - OPTIMISERS[recipe.optimiser](run, gradient, rate)
    return {name: sum(each[name] for each in terms) for name in terms[0]}


def train(data, run, objective=unsupervised, map=map, on_step=None):
    """Go on with a run to its recipe's last step; updates and returns it. on_step(run, terms) is called after each.

    data: Interactions; for another objective, whatever it takes, with len() and rows by index array. map: as
    Python's; lab/processes.py has one for several processes. The chunks' gradients are added in order, so the result
    does not depend on it (if BLAS has one thread: import the package before NumPy).
    Raises FloatingPointError if a gradient is not finite.
    """
    while run.step < run.recipe.steps:
        terms = training_step(data, run, objective, map)
        if on_step:
            on_step(run, terms)
    return run
