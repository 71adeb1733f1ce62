"""Unsupervised training: samples, the loss of one interaction, the optimiser, one loop, checkpoints.

Only the supervised baseline, SE3-Nets (Recipe.association), is given the simulator's truth.
"""
import math
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache

import autograd.numpy as np
import numpy as onp
from autograd import grad
from autograd.tracer import getval

from . import check_whole, losses, worker_pool
from .geometry import Camera, free_radius, optical_flow, ray_spacing
from .interactions import (add_depth_noise, associate_with_noise, cell_centres, cells_of, load_npz, occupied_pixels,
                           points_and_validity, prominence, save_npz, smooth_depth, true_scene_flow)
from .networks import (Sizes, forward_model, init_parameters, inverse_model, most_changed, standing_out,
                       state_embedding, windows)
from .ops import at_rows, put_rows, take, take_block

FORMAT = "hind4sight_min checkpoint 4"


@dataclass
class Batch:
    """B interactions as the model and the losses want them: organised clouds, float images, pokes and their two cells.

    h, w, n = h * w: the window of each picture that the model looks at (networks.windows).
    """
    points: onp.ndarray       # (B, n, 3) float32 m, arena, frame t
    next_points: onp.ndarray  # (B, n, 3), frame t+1
    valid: onp.ndarray        # (B, n) bool: has depth
    next_valid: onp.ndarray
    occupied: onp.ndarray     # (B, n) bool: valid and nearer than the empty arena
    next_occupied: onp.ndarray
    look: onp.ndarray         # (B, M) int: the points that stand out, see networks.standing_out
    next_look: onp.ndarray
    shared: onp.ndarray       # (B, n) bool: valid and seen in both frames, see losses.seen_in_both
    next_shared: onp.ndarray
    images: onp.ndarray       # (B, h, w, 3) float32 in [0, 1]
    next_images: onp.ndarray
    before: onp.ndarray       # (B, M, 3) m: what changed most in the whole picture, see networks.most_changed
    after: onp.ndarray
    change: onp.ndarray       # (B, M): its weights
    pokes: onp.ndarray        # (B, 3) float32
    start_cells: onp.ndarray  # (B,) int
    end_cells: onp.ndarray
    cells: onp.ndarray        # (cells, 2) m: the centres of the arena's cells
    targets: onp.ndarray = None  # (B, n, 3) m: where each point goes; for SE3-Nets alone


def make_batch(interactions, rows, mirror=False, depth_noise=0.0, rng=None, whole=False, truth=None, association=1,
               image_noise=0.0):
    """The Batch of some rows of a data set.

    mirror, a bool or one per row, shows the arena mirrored at its plane x = 0, which costs no new poke: pictures flip
    left-right, a_x changes sign, a_theta becomes pi - a_theta. This is exact for a camera that is symmetric about
    that plane; ValueError for another. depth_noise: SD in m of Sec. IV-B's depth noise, drawn from `rng`;
    a robot whose depth is noisy smooths it first.
    whole: the whole pictures instead of windows. truth (of these rows): adds the targets of SE3-Nets, with the
    association noise of Sec. IV-B, in which a point may be taken for any in an `association` px square around it.
    image_noise: SD of Gaussian noise on the images of frame t, drawn from `rng`; see Recipe.
    """
    camera, settings = interactions.camera, interactions.meta["settings"]
    mirror = onp.broadcast_to(mirror, len(rows))
    if mirror.any() and not camera.is_mirror_symmetric:
        raise ValueError("mirror: expected False (in the Recipe): this data set's camera is not symmetric about the "
                         "arena's plane x = 0")
    if (depth_noise or image_noise) and rng is None:
        raise ValueError("rng: expected a random generator to draw the noise from")
    depth, rgb = (onp.stack([getattr(interactions, f"{kind}_{when}")[rows] for when in ("before", "after")])
                  for kind in ("depth", "rgb"))  # (2, B, ...)
    pokes, starts = interactions.pokes[rows], interactions.starts[rows]
    depth[:, mirror], rgb[:, mirror] = depth[:, mirror, :, ::-1], rgb[:, mirror, :, ::-1]
    pokes[mirror] = pokes[mirror] * [-1, 1, -1] + [0, 0, onp.pi]
    starts[mirror] *= [-1, 1]
    empty = onp.where(mirror[:, None, None], interactions.empty_depth[:, ::-1], interactions.empty_depth)
    if depth_noise:
        depth = smooth_depth(add_depth_noise(depth, rng, depth_noise), empty, rgb)
    points, valid = points_and_validity(depth, camera)
    occupied = occupied_pixels(depth, empty)
    changed = most_changed(*points.reshape(2, len(rows), -1, 3), valid.all(axis=0).reshape(len(rows), -1))
    everything = [(slice(None), slice(None))] * len(rows)
    parts = everything if whole else windows(pokes, camera)

    def cut(pictures):  # (2, B, H, W, ...) -> (2, B, h, w, ...)
        return onp.stack([pictures[(slice(None), i, *part)] for i, part in enumerate(parts)], axis=1)

    look = (standing_out(each.reshape(len(rows), -1)) for each in cut(prominence(depth, empty[None])))
    targets = None
    if truth is not None:
        targets = associated_targets(interactions, rows, mirror, points[0], depth[0], truth, association, rng)
        targets = cut(targets[None])[0].reshape(len(rows), -1, 3)
    images = cut(rgb).astype(onp.float32) / 255
    if image_noise:
        images[0] += onp.float32(image_noise) * rng.standard_normal(images[0].shape, onp.float32)
    points, valid, occupied = (value.reshape(2, len(rows), -1, *value.shape[4:])
                               for value in map(cut, (points, valid, occupied)))
    return Batch(*points, *valid, *occupied, *look, *losses.seen_in_both(*valid, *occupied), *images, *changed, pokes,
                 cells_of(starts, settings), cells_of(pokes[:, :2], settings), cell_centres(settings), targets)


def associated_targets(interactions, rows, mirror, points, depth, truth, window, rng):
    """Where the truth says every point goes, (B, H, W, 3) m, under the association noise of Sec. IV-B.

    points (B, H, W, 3) m and depth (B, H, W) m as the batch has them: mirrored and noisy.
    """
    clean, _ = points_and_validity(interactions.depth_before[rows], interactions.camera)
    flow = onp.stack([true_scene_flow(*each) for each in zip(clean, truth.labels, truth.poses_before,
                                                             truth.poses_after)])
    flow[mirror] = flow[mirror][:, :, ::-1] * onp.float32([-1, 1, 1])
    targets = points + flow
    if window > 1:
        for i, picture in enumerate(depth):
            taken_for = associate_with_noise(picture, rng, window)
            targets[i] = targets[i].reshape(-1, 3)[taken_for.ravel()].reshape(points[i].shape)
    return targets


def predict_clouds(params, sizes, batch):
    """The forward model on the points that stand out; all others are background that stays -> Prediction of all n."""
    look = at_rows(batch.look)
    found = forward_model(params, sizes, batch.points[look], batch.valid[look], batch.pokes)
    masks = onp.zeros(batch.valid.shape + (sizes.masks,), batch.points.dtype)
    masks[..., 0] = 1
    return replace(found, points=put_rows(batch.points, batch.look, found.points),
                   masks=put_rows(masks, batch.look, found.masks))


def run_forward_model(params, sizes, batch, camera):
    """What the poke does to a batch -> (Prediction, optical flow (B, h, w, 2) px). Paper: Fig. 3."""
    prediction = predict_clouds(params, sizes, batch)
    flow = optical_flow(batch.points, prediction.points, camera)  # the projection layer, Sec. III-C
    return prediction, np.reshape(flow, batch.images.shape[:3] + (2,))


def run_inverse_model(params, batch):
    """Which poke it was -> (start, end) heat-map logits, (B, cells) each. Paper: Fig. 3."""
    return inverse_model(params, batch.before, batch.after, batch.change, batch.cells)


def next_embeddings(params, batch, predicted):
    """The state embeddings of frame t+1, predicted and observed, (B, E) each. Paper: Sec. III-E.

    predicted (B, n, 3) m, arena, of `run_forward_model`. Objects stand out, so only what does is looked at.
    """
    look, next_look = at_rows(batch.look), at_rows(batch.next_look)
    return (state_embedding(params, take(predicted, look), batch.occupied[look]),
            state_embedding(params, batch.next_points[next_look], batch.next_occupied[next_look]))


def loss_terms(params, sizes, batch, camera, wanted=None):
    """The terms of Eq. (6), and the one on masks -> dict of (B,) with the keys of `WEIGHTS`, or the wanted ones of
    these: what an ablation leaves out takes no time. For a batch with targets, the one term of SE3-Nets.
    """
    if batch.targets is not None:
        prediction = predict_clouds(params, sizes, batch)
        return {"association": losses.association_loss(prediction.points, batch.targets, batch.valid)}
    prediction, flow = run_forward_model(params, sizes, batch, camera)

    @lru_cache
    def maps():  # two terms share them
        free = free_radius(batch.points, getval(prediction.points), ray_spacing(batch.points, camera))
        return losses.distance_maps(prediction.points, batch.next_points, batch.shared, batch.next_shared, free,
                                    ray_spacing(batch.next_points, camera))

    def inverse():
        return losses.inverse_loss(*run_inverse_model(params, batch), batch.start_cells, batch.end_cells,
                                   *next_embeddings(params, batch, prediction.points))

    terms = {
        "chamfer": lambda: losses.chamfer_loss(*maps()),
        "distance_smoothness": lambda: losses.distance_smoothness_loss(*maps(), batch.images, batch.next_images,
                                                                       batch.shared, batch.next_shared),
        "photometric": lambda: losses.photometric_loss(batch.images, batch.next_images, flow, batch.shared),
        "flow_smoothness": lambda: losses.flow_smoothness_loss(flow, batch.images, batch.valid),
        "inverse": inverse,
        "sharing": lambda: losses.sharing_loss(np.reshape(prediction.masks, batch.images.shape[:3] + (-1,)),
                                               batch.valid),
    }
    return {name: term() for name, term in terms.items() if wanted is None or name in wanted}


def unflatten(vector, layout):
    """Parameters as one vector (P,) -> dict of arrays, views of it; `layout` gives names and shapes.

    We differentiate by one vector: autograd's gradient of a dict copies the dict once per access, which
    costs more than all layers of a small network.
    """
    result, start = {}, 0
    for name, shape in layout.items():
        result[name] = take_block(vector, start, shape)
        start += math.prod(shape)
    return result


def batch_gradient(vector, layout, sizes, batch, camera, weights):
    """Mean terms as floats, and the gradient (P,) of the full loss, Eq. (6), at parameters `vector` (P,).

    Terms of weight 0 are not computed.
    """
    kept, weights = {}, {name: weight for name, weight in weights.items() if weight}

    def objective(vector):
        terms = loss_terms(unflatten(vector, layout), sizes, batch, camera, weights)
        kept.update((name, float(getval(value).mean())) for name, value in terms.items())
        return losses.full_loss(terms, weights)

    return kept, grad(objective)(vector)


# --- the loop ----------------------------------------------------------------------------------------------

# From an audit of gradient norms, not of the terms' values, which mislead; the photometric one from what turns need,
# that of sharing, which it reaches at the end, just heavy enough to decide between masks that move alike.
# See docs/research-log.md.
WEIGHTS = {"chamfer": 1e3, "distance_smoothness": 3e2, "photometric": 2.0, "flow_smoothness": 0.01, "inverse": 1.0,
           "sharing": 0.05}
ASSOCIATION_WEIGHTS = {"association": 2e3}  # as much as Chamfer, which counts a point in both directions


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a training run besides the data.

    steps: of the optimiser. batch: interactions per step. learning_rate: peak; linear warm-up over `warmup` steps,
    then a cosine to zero. depth_noise: SD in m of noise added to the depth, Sec. IV-B. image_noise: SD of noise added
    to the images I_t, in [0, 1]; see below. mirror: show half of the interactions mirrored. weights: one per term, of
    `WEIGHTS`.
    association: 0, or the baseline SE3-Nets: supervised by the true motion of every point, each of which may be taken
    for any other in a square of so many pixels around it (1: exact; odd). Then the one weight is that of its loss.

    A simulator's two pictures of a still thing are the same to the last bit, which no camera's are. Eq. (3) has a kink
    there: to move all still edges a little costs more than to move the object gains, and a new network, whose masks
    are everywhere, learns to move nothing. Noise of less than one grey level of 255 rounds the kink off. I_{t+1} gets
    none: warping would smooth it, and so reward motion.
    """
    steps: int = 3000
    batch: int = 16
    learning_rate: float = 1.5e-3
    warmup: int = 50
    depth_noise: float = 0.0
    image_noise: float = 0.003
    seed: int = 0
    mirror: bool = True
    weights: dict = field(default_factory=lambda: dict(WEIGHTS))
    sizes: Sizes = Sizes()
    association: int = 0

    def __post_init__(self):
        for name, least in (("steps", 1), ("batch", 1), ("warmup", 0), ("seed", 0), ("association", 0)):
            check_whole(name, getattr(self, name), least)
        if self.association and self.association % 2 == 0:
            raise ValueError(f"association: expected 0 or an odd number of pixels, got {self.association}")
        if not 0 < self.learning_rate < float("inf"):
            raise ValueError(f"learning_rate: expected a finite number > 0, got {self.learning_rate}")
        for name in ("depth_noise", "image_noise"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name}: expected a finite number >= 0, got {getattr(self, name)}")
        terms = ASSOCIATION_WEIGHTS if self.association else WEIGHTS
        if set(self.weights) != set(terms) or not all(0 <= value < float("inf") for value in self.weights.values()):
            raise ValueError(f"weights: expected a finite number >= 0 for each of {sorted(terms)}, got {self.weights}")
        if not any(self.weights.values()):
            raise ValueError("weights: expected at least one above 0")


def learning_rate(recipe, step):
    """Linear warm-up, then a cosine to zero."""
    warm = min(1.0, (step + 1) / max(recipe.warmup, 1))
    return recipe.learning_rate * warm * 0.5 * (1 + math.cos(math.pi * step / recipe.steps))


def weights_at(recipe, step):
    """The terms' weights in a step. That of sharing rises from 0: masks are found first, then tidied up."""
    if "sharing" not in recipe.weights:
        return recipe.weights
    return {**recipe.weights, "sharing": recipe.weights["sharing"] * (step + 1) / recipe.steps}


@dataclass
class Run:
    """The state of a training run: all that is needed to go on, or to use the model."""
    recipe: Recipe
    layout: dict              # name -> shape of each parameter
    vector: onp.ndarray       # (P,) float32, all parameters
    first_moment: onp.ndarray
    second_moment: onp.ndarray
    step: int = 0
    sums: dict = field(default_factory=dict)  # of the terms over the epoch so far
    log: list = field(default_factory=list)   # one dict per epoch
    meta: dict = field(default_factory=dict)  # camera, settings and provenance, plain JSON types

    @property
    def params(self):
        """The parameters by name."""
        return unflatten(self.vector, self.layout)


def start_run(recipe, interactions):
    """A fresh Run for a data set."""
    params = init_parameters(recipe.sizes, onp.random.default_rng(recipe.seed))
    vector = onp.concatenate([value.ravel() for value in params.values()])
    meta = {"camera": interactions.meta["camera"], "settings": interactions.meta["settings"]}
    return Run(recipe, {name: value.shape for name, value in params.items()}, vector,
               onp.zeros_like(vector), onp.zeros_like(vector), meta=meta)


def orthogonalised(matrix):
    """The matrix with all its singular values brought to about 1 (0.7 to 1.2), its singular vectors kept.
    (I, O) -> (I, O).

    Five Newton-Schulz iterations with the coefficients of Muon (K. Jordan et al., 2024): every singular value s becomes
    3.4445 s - 4.7750 s^3 + 2.0315 s^5, which lifts the small ones quickest. An SVD, U V^T, takes four times as long.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return orthogonalised(matrix.T).T
    x = matrix / (onp.linalg.norm(matrix) + onp.float32(1e-12))  # no singular value above 1; a dead layer stays at 0
    for _ in range(5):
        square = x @ x.T
        x = 3.4445 * x + (-4.7750 * square + 2.0315 * square @ square) @ x
    return x


def optimiser_step(run, gradient, rate, beta1=0.9, beta2=0.999, epsilon=1e-8):
    """One step on the run's vector: Adam (Kingma and Ba) for vectors, orthogonalised momentum (Muon) for matrices.

    The paper has Adam for both, Sec. III-G. A few directions dominate the gradient of a layer's matrix; the others, in
    which it would have to move as well, hardly get to. Orthogonalised, all have the same say, and a third of the steps
    do (docs/research-log.md). Times sqrt(max(shape)), an entry moves by the rate, in the root mean square, as in Adam's
    first step.
    """
    run.step += 1
    run.first_moment += (1 - beta1) * (gradient - run.first_moment)
    run.second_moment += (1 - beta2) * (gradient ** 2 - run.second_moment)
    first = run.first_moment / (1 - beta1 ** run.step)
    second = run.second_moment / (1 - beta2 ** run.step)
    step = first / (onp.sqrt(second) + onp.float32(epsilon))
    ahead = unflatten(beta1 * run.first_moment + (1 - beta1) * gradient, run.layout)  # Nesterov's momentum
    for name, block in unflatten(step, run.layout).items():  # views of `step`
        if block.ndim == 2:
            block[:] = math.sqrt(max(block.shape)) * orthogonalised(ahead[name])
    run.vector = run.vector - onp.float32(rate) * step


def rows_of_step(recipe, count, step):
    """The rows and mirror flags of a step, from seed and step alone, so that a resumed run is the same run.

    Every epoch is a permutation of the rows; a batch may straddle two epochs.
    """
    first = step * recipe.batch
    rows = []
    for epoch in range(first // count, (first + recipe.batch - 1) // count + 1):
        order = onp.random.default_rng([recipe.seed, 1, epoch]).permutation(count)
        rows.append(order[max(first - epoch * count, 0):first + recipe.batch - epoch * count])
    rng = onp.random.default_rng([recipe.seed, 2, step])
    return onp.concatenate(rows), rng.random(recipe.batch) < (0.5 if recipe.mirror else 0.0), rng


CHUNK = 8  # interactions per gradient: enough of them to hide autograd's overhead per operation


def chunk_gradient(interactions, truth, mirror, noise_seed, vector, layout, recipe, step):
    """`batch_gradient` of a few interactions, weighted by their share of the batch; runs in a worker process."""
    rows, rng = onp.arange(len(interactions)), onp.random.default_rng(noise_seed)
    batch = make_batch(interactions, rows, mirror, recipe.depth_noise, rng, truth=truth, association=recipe.association,
                       image_noise=recipe.image_noise)
    terms, gradient = batch_gradient(vector, layout, recipe.sizes, batch, interactions.camera, weights_at(recipe, step))
    share = len(rows) / recipe.batch
    return {name: share * value for name, value in terms.items()}, onp.float32(share) * gradient


@contextmanager
def workers(jobs):
    """A function that applies `chunk_gradient` to a list of arguments in order, on `jobs` processes, this one included.

    Not threads: autograd holds Python's global lock for so long that a second thread brings a fifth more at best.
    """
    if jobs == 1:
        yield lambda arguments: [chunk_gradient(*each) for each in arguments]
        return
    with worker_pool(jobs - 1) as pool:
        def apply(arguments):
            given = {i: pool.submit(chunk_gradient, *each) for i, each in enumerate(arguments) if i % jobs}
            own = {i: chunk_gradient(*each) for i, each in enumerate(arguments) if not i % jobs}
            return [given[i].result() if i in given else own[i] for i in range(len(arguments))]
        yield apply


def training_step(interactions, run, gradients, truth=None):
    """One step of the optimiser on the run's next batch; `gradients` comes from `workers`.

    Adds the batch's terms to run.sums.
    Raises FloatingPointError if the gradient is not finite; the run is then as it was.
    """
    recipe = run.recipe
    rows, mirror, rng = rows_of_step(recipe, len(interactions), run.step)
    rate = learning_rate(recipe, run.step)
    chunks = [slice(i, i + CHUNK) for i in range(0, recipe.batch, CHUNK)]
    parts = gradients([(interactions[rows[chunk]], truth and truth[rows[chunk]], mirror[chunk], rng.integers(2 ** 32),
                        run.vector, run.layout, recipe, run.step) for chunk in chunks])
    gradient = sum(part[1] for part in parts)
    if not onp.isfinite(gradient).all():
        raise FloatingPointError(f"the gradient is not finite at step {run.step}")
    optimiser_step(run, gradient, rate)
    for terms, _ in parts:
        for name, value in terms.items():
            run.sums[name] = run.sums.get(name, 0.0) + value


def check_camera(run, camera):
    """Raise ValueError when a run was trained with another camera than this one."""
    trained = Camera(**run.meta["camera"])
    if not all(onp.allclose(getattr(trained, name), getattr(camera, name), rtol=1e-6) for name in vars(camera)):
        raise ValueError("camera: another camera than the checkpoint was trained with")


def train(interactions, run, jobs=1, on_epoch=None, on_step=None, truth=None):
    """Go on with a run to its recipe's last step; updates and returns it.

    truth: for SE3-Nets, and for nothing else. on_epoch(run), on_step(run) are called after each. The gradient of a
    batch is the sum over chunks that may be computed in parallel and are added in order, so the result does not depend
    on `jobs` (if BLAS has one thread here as in the workers: import the package before NumPy).
    Raises ValueError for a data set of another camera, FloatingPointError if a gradient is not finite.
    """
    check_camera(run, interactions.camera)
    check_whole("jobs", jobs, 1)
    if bool(run.recipe.association) != (truth is not None):
        raise ValueError("truth: expected for SE3-Nets (Recipe.association), and for nothing else")
    recipe, per_epoch = run.recipe, max(1, len(interactions) // run.recipe.batch)
    with workers(min(jobs, -(-recipe.batch // CHUNK))) as gradients:
        while run.step < recipe.steps:
            training_step(interactions, run, gradients, truth)
            if run.step % per_epoch == 0 or run.step == recipe.steps:
                first = run.log[-1]["step"] if run.log else 0
                run.log.append({"epoch": len(run.log) + 1, "step": run.step,
                                "learning_rate": learning_rate(recipe, run.step - 1),
                                **{name: value / (run.step - first) for name, value in run.sums.items()}})
                run.sums = {}
                if on_epoch:
                    on_epoch(run)
            if on_step:  # after the log entry: what is saved here must not lack it
                on_step(run)
    return run


# --- checkpoints -------------------------------------------------------------------------------------------

def save_run(path, run, resumable=True):
    """Write a checkpoint, whole or not at all. Without the optimiser's state it is a third of the size."""
    arrays = {"vector": run.vector}
    if resumable:
        arrays.update(first_moment=run.first_moment, second_moment=run.second_moment)
    save_npz(path, arrays, {"format": FORMAT, "recipe": asdict(run.recipe), "step": run.step, "sums": run.sums,
                            "log": run.log, "run": run.meta})


def train_saving(interactions, run, path, save_every=60.0, on_step=None, **options):
    """`train` with a checkpoint at `path` every `save_every` seconds and at the end; options are those of `train`.

    Returns the seconds spent on the whole run, over all calls; they are kept in run.meta.
    """
    before, start = run.meta.get("seconds", 0.0), time.perf_counter()
    saved = start

    def save():
        nonlocal saved
        saved = time.perf_counter()
        run.meta["seconds"] = before + saved - start
        save_run(path, run)

    def step_done(run):
        if on_step:
            on_step(run)
        if time.perf_counter() - saved > save_every:
            save()

    train(interactions, run, on_step=step_done, **options)
    save()
    return run.meta["seconds"]


def load_run(path):
    """Read a checkpoint -> Run. Raises ValueError naming the file and what is wrong."""
    arrays, meta = load_npz(path, FORMAT)
    try:
        recipe = Recipe(**{**meta["recipe"], "sizes": Sizes(**meta["recipe"]["sizes"])})
        template = init_parameters(recipe.sizes, onp.random.default_rng(0))
        layout = {name: value.shape for name, value in template.items()}
        size = sum(value.size for value in template.values())
        for name, value in arrays.items():
            if value.shape != (size,) or not onp.isfinite(value).all():
                raise ValueError(f"{name}: expected {size} finite numbers, got shape {value.shape}")
        moments = (arrays.get(name, onp.zeros(size, onp.float32)) for name in ("first_moment", "second_moment"))
        return Run(recipe, layout, arrays["vector"], *moments, meta["step"], meta["sums"], meta["log"], meta["run"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
