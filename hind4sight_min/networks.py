"""The siamese point encoder, the forward model and the inverse model. Parameters are a dict of arrays.

Each network is a small perceptron on each point. Forward and inverse model also hand *context*, pooled features of all
their points, back to each, the forward model a code of heights around the target too. What runs on every point is
narrow; what runs once per scene may be wide. Paper: Sec. III-A, III-E, Fig. 3, whose boxes docs/architecture.md names.
"""
from dataclasses import dataclass

import autograd.numpy as anp
import numpy as np
from autograd.tracer import getval

from . import check_whole
from .geometry import poke_axes, poke_frame, so3_exp, transform_layer
from .ops import at_rows, dense, max_over_points, put_rows, take
from .scene import look


@dataclass(frozen=True)
class Sizes:
    """masks: K, background included. width: units of the layers that run on every point. rounds: of context.
    head: units of those that run once per scene or mask; they cost next to nothing.
    embedding: length of the state embedding s_t and of the encoder's features. inverse: units of the inverse model.
    """
    masks: int = 3
    width: int = 48
    head: int = 128
    rounds: int = 2
    embedding: int = 32
    inverse: int = 64

    def __post_init__(self):
        for name in vars(self):
            check_whole(name, getattr(self, name), 2 if name == "masks" else 1, 8 if name == "rounds" else 512)


@dataclass
class Prediction:
    """What the forward model says of B interactions. N points, K masks (0 is the background)."""
    points: object        # (B, N, 3) m, arena: P'_{t+1}
    masks: object         # (B, N, K), summing to 1 over K
    rotations: object     # (B, K, 3, 3), in the poke's frame
    translations: object  # (B, K, 3) m, in the poke's frame


# --- inputs (fixed functions of the observation and the poke) --------------------------------------------

def fourier(values, wavelengths):
    """sin and cos of 2 pi v / w: positions as a perceptron can use them. (..., D) -> (..., 2 D len(wavelengths))."""
    phase = anp.reshape(values, values.shape + (1,)) * (2 * np.pi / np.asarray(wavelengths)).astype(values.dtype)
    phase = anp.reshape(phase, values.shape[:-1] + (-1,))
    return anp.concatenate([anp.sin(phase), anp.cos(phase)], axis=-1)


def position_features(points, unit, wavelengths):
    """Each point's position as a perceptron can use it, (..., 3) m -> (..., 20).

    tanh(z / 1 cm) tells the table from what stands on it, by a threshold no perceptron would learn to be as sharp.
    """
    across, up = take(points, (..., slice(0, 2))), take(points, (..., slice(2, 3)))
    return anp.concatenate([points / unit, anp.tanh(up / 0.01), fourier(across, wavelengths)], axis=-1)


def encoder_features(points):
    """Position in the arena, (..., 3) m -> (..., 20)."""
    return position_features(points, 0.25, (0.8, 0.4, 0.2, 0.1))


def poke_features(local):
    """Position relative to the poke, (..., 3) m in the poke frame -> (..., 20)."""
    return position_features(local, 0.1, (0.4, 0.2, 0.1, 0.05))


MAP_CELL = 0.02  # m
MAP_X = np.arange(-6.5, 7, dtype=np.float32)  # cell centres in the poke frame, in cells
MAP_Y = np.arange(-4.5, 5, dtype=np.float32)


def height_map(local, valid):
    """What the finger will meet: mean height over each cell around the target, (B, 140), in units of 3 cm.

    local (B, N, 3) m, poke frame; valid (B, N) bool. A point counts for the four cells around it, bilinearly, so
    that the map changes smoothly with the poke. A cell that no point is near reads 0.
    """
    across, along = (np.maximum(0, 1 - np.abs(local[..., axis, None] / MAP_CELL - centres))  # (B, N, cells)
                     for axis, centres in ((1, MAP_Y), (0, MAP_X)))
    across, along = across * valid[..., None], np.swapaxes(along, 1, 2)
    count = np.matmul(along, across)
    total = np.matmul(along, across * np.maximum(local[..., 2:], 0))
    return (total / (count + 0.2) / 0.03).reshape(len(local), -1)


def wall_map(pokes, arena):
    """The walls in the same cells, (B, 140): 1 behind them, 0 in front. pokes (B, 3); arena: its side in m."""
    axes, origins = poke_axes(pokes)
    cells = MAP_CELL * np.stack(np.meshgrid(MAP_X, MAP_Y, [0], indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.abs(np.matmul(cells, np.swapaxes(axes, 1, 2)) + origins[:, None])[..., :2].max(axis=2)
    return np.clip((away - arena / 2) / MAP_CELL + 0.5, 0, 1).astype(np.float32)


ABOVE = 0.005  # m; lower points are the table's
FINGER = 0.014  # m; half the width of what the finger of sim.arena.Settings sweeps: its radius and about half a pixel


def first_met(local, valid):
    """Where the finger first meets something on its way to the target: weights (B, N) that sum to 1, or to 0 where it
    meets nothing. Not in the paper: a perceptron learns it slowly.

    A disc of radius FINGER that ends in the origin pushes a point (x, y) of its way by d = sqrt(FINGER^2 - y^2) - x;
    the deepest one is met first. local (B, N, 3) m, poke frame; valid (B, N) bool.
    """
    x, y, z = local[..., 0], local[..., 1], local[..., 2]
    central = np.sqrt(np.maximum(0, 1 - (y / FINGER) ** 2))  # 0 beside the way
    depth = FINGER * central - x
    met = valid & (z > ABOVE) & (central > 0) & (x > -0.16) & (depth > 0)  # it comes down at most 14 cm before
    deepest = (depth * met).max(axis=1, keepdims=True)
    weights = met * central * np.exp((depth * met - deepest) / 0.004)
    return (weights / (weights.sum(axis=1, keepdims=True) + 1e-6)).astype(local.dtype)


# --- parameters --------------------------------------------------------------------------------------------

def init_parameters(sizes, rng, dtype=np.float32):
    """Random parameters: He initialisation; identity motions; mask 0 taken by the background.

    Paper: Sec. III-G, "initializing one out of K masks to predict all pixels as background and moreover
    initializing SE(3) transformations to predict identity transform".
    """
    params, width, head, embedding, inverse = {}, sizes.width, sizes.head, sizes.embedding, sizes.inverse

    def add(name, inputs, outputs, gain=2.0, bias=True):
        params[name + "_w"] = (rng.standard_normal((inputs, outputs)) * np.sqrt(gain / inputs)).astype(dtype)
        if bias:
            params[name + "_b"] = np.zeros(outputs, dtype)

    add("encoder_1", 20, embedding)
    add("encoder_2", embedding, embedding)
    add("shape_1", len(MAP_X) * len(MAP_Y), head)
    add("shape_2", head, width)
    add("trunk_0", 20 + embedding, width)
    for i in range(1, sizes.rounds + 1):
        add(f"trunk_{i}", width, width, bias=False)  # its bias is the context's
        add(f"context_{i}", 3 * width, width, gain=1.0)
    add("mask", width, sizes.masks - 1, gain=0.01)
    params["mask_b"] -= 1  # background first: 0.57 of every point (K = 3), not all of it, for movers need a gradient
    add("motion_1", 4 * width + 3, head)
    add("motion_2", head, head)
    add("motion_3", head, 6, gain=0.0)  # identity first
    add("change_1", 2 * 20 + 2 * embedding + 1, inverse)
    add("change_2", inverse, inverse)
    add("cell_context_1", 4 * inverse, inverse)
    add("cell_context_2", inverse, inverse, gain=1.0)
    add("cell_1", 18, inverse)
    add("cell_2", inverse, inverse, bias=False)  # its bias is the context's
    add("cell_3", inverse, inverse)
    add("heatmaps", inverse, 2, gain=0.1)
    return params


# --- the forward model ---------------------------------------------------------------------------------------

def layer(params, name, x, leaky=True):
    """The layer `name`: y = x W + b, with leaky=True max(y, LEAK y).  (..., I) -> (..., O)."""
    return dense(x, params[name + "_w"], params[name + "_b"], leaky=leaky)


def encode(params, points):
    """The siamese encoder: features of every point. Paper: Sec. III-E, III-G.  (B, N, 3) m arena -> (B, N, E)."""
    return layer(params, "encoder_2", layer(params, "encoder_1", encoder_features(points)))


MASK_BOUND = 6.0  # a mover's logit stays within so much of the background's, which is 0


def forward_model(params, sizes, points, valid, pokes, arena=np.inf):
    """F: masks, motions and the next point cloud under a poke. Paper: Sec. III-A, Eq. (1).

    points (B, M, 3) m arena, a set, those that `scene.look` found; valid (B, M) bool, which of them count; pokes
    (B, 3), (m, m, rad); arena: its side, m -> Prediction of these points. The poke enters only as a frame, x along it
    and its target the origin, that all but the encoder sees: where the finger came down is not told, as in u_t.
    """
    local = poke_frame(points, pokes)
    met = first_met(local, valid)[:, None]
    shape = layer(params, "shape_2", layer(params, "shape_1", height_map(local, valid) + wall_map(pokes, arena)))

    def context(h):  # (B, M, C) -> (B, 3 C)
        return anp.concatenate([max_over_points(h, valid), anp.matmul(met, h)[:, 0], shape], axis=1)

    h = layer(params, "trunk_0", anp.concatenate([poke_features(local), encode(params, points)], axis=2))
    for i in range(1, sizes.rounds + 1):
        bias = layer(params, f"context_{i}", context(h), leaky=False)
        h = dense(h, params[f"trunk_{i}_w"], bias, leaky=True, residual=True)

    # The background's logit is 0, a mover's bounded: a mask pushed to nothing would have no gradient to come back with.
    movers = MASK_BOUND * anp.tanh(layer(params, "mask", h, leaky=False) / MASK_BOUND)
    masks = softmax(anp.concatenate([np.zeros(movers.shape[:2] + (1,), points.dtype), movers], axis=2))  # (B, M, K)
    counts, background = valid[..., None].astype(points.dtype), np.eye(sizes.masks, dtype=points.dtype)[0]
    masks = counts * masks + (1 - counts) * background  # what does not count stays
    rotations, translations = _motions(params, h, masks, context(h), local)
    moved = transform_layer(local, masks, rotations, translations)  # Eq. (1), in the poke's frame
    axes, _ = poke_axes(pokes.astype(points.dtype))
    predicted = points + anp.matmul(moved - local, np.swapaxes(axes, 1, 2))
    return Prediction(predicted, masks, rotations, translations)


def softmax(logits):
    """exp(z_k) / sum_k exp(z_k) over the last axis, safe for large logits."""
    e = anp.exp(logits - np.max(getval(logits), axis=-1, keepdims=True))  # the maximum cancels
    return e / anp.sum(e, axis=-1, keepdims=True)


# Of [translation, rotation], in m and rad. The optimiser moves every weight by the learning rate, and a motion is a sum
# of many: with 5 cm and 1 rad the first steps fling the points about, and the masks withdraw within a hundred steps.
MOTION_UNIT = np.array([0.005] * 3 + [0.1] * 3, np.float32)


def _motions(params, h, masks, context, local):
    """One rigid motion per mask, from the features pooled under it; the background's is the identity.

    -> rotations (B, K, 3, 3), translations (B, K, 3) m, in the poke's frame. Translation and rotation are separate
    outputs, as in SE3-Nets: R = exp(w), about the poke's target, and T.
    """
    moving = anp.swapaxes(take(masks, (..., slice(1, None))), 1, 2)  # (B, K-1, M)
    shares = moving / (anp.sum(moving, axis=2, keepdims=True) + np.float32(1e-3))  # finite where a mask covers nothing
    pooled, centroids = anp.matmul(shares, h), anp.matmul(shares, local)  # (B, K-1, C), (B, K-1, 3)
    batch, count = pooled.shape[:2]
    everywhere = anp.reshape(context, (batch, 1, -1)) * np.ones((1, count, 1), local.dtype)
    x = layer(params, "motion_1", anp.concatenate([pooled, everywhere, centroids / 0.1], axis=2))
    twist = MOTION_UNIT * layer(params, "motion_3", layer(params, "motion_2", x), leaky=False)  # (B, K-1, 6)
    turn, shift = so3_exp(take(twist, (..., slice(3, None)))), take(twist, (..., slice(0, 3)))
    identity = np.broadcast_to(np.eye(3, dtype=local.dtype), (batch, 1, 3, 3))
    return (anp.concatenate([identity, turn], axis=1),
            anp.concatenate([np.zeros((batch, 1, 3), local.dtype), shift], axis=1))


def predict(params, sizes, scene, pokes):
    """The one way to ask the model what pokes (B, 3) do to a Scene -> Prediction of all its N points.

    The forward model on the points that `scene.look` finds; all others are background that stays.
    """
    (rows, seen), points = look(scene, pokes), scene.points
    found = forward_model(params, sizes, points[at_rows(rows)], seen, pokes, scene.arena)
    still = np.broadcast_to(np.eye(sizes.masks, dtype=points.dtype)[0], points.shape[:2] + (sizes.masks,))
    return Prediction(put_rows(points, rows, found.points), put_rows(still, rows, found.masks),
                      found.rotations, found.translations)


# --- the inverse model ---------------------------------------------------------------------------------------

STATE_GAIN = 3.0  # L_sim beside the cross entropies; of 1, 3, 10 and more: see docs/research-log.md


def state_embedding(params, points, occupied):
    """s_t, the sum of the encoder's features over the points of objects. Paper: Sec. III-E.

    Of the predicted cloud it is s'_{t+1}, of the observed one s_{t+1}. L_sim moves the predicted points, and through
    them all of the forward model. Here, where it measures, its gradient stops: the encoder's weights are held fixed,
    for free they would make L_sim small by saying nothing (docs/research-log.md).
    (B, N, 3) m arena, occupied (B, N) bool -> (B, E).
    """
    features = encode({name: getval(value) for name, value in params.items()}, points)
    weights = STATE_GAIN * occupied[:, None].astype(getval(features).dtype)
    return anp.reshape(anp.matmul(weights, features), (len(occupied), -1))


def inverse_model(params, before, after, weights, cells):
    """G: the poke that led from one cloud to the next, as two heat-maps. Paper: Sec. III-E.

    before, after (B, M, 3) m arena, weights (B, M): what `scene.most_changed` found in the whole picture (a part around
    the target would give it away); cells (cells, 2) m, the centres of the arena's grid
    -> start logits, end logits, each (B, cells); softmax makes them heat-maps.

    All but the encoder's features is said relative to the centre of change, so that a poke learnt in one corner of the
    arena helps in all of them. What changed is pooled by how much it changed, steeply, gently and not at all.
    """
    centre = np.sum(weights[..., None] * (before + after), axis=1) / 2
    centre[:, 2] = 0
    amount = np.log(weights[..., None] * weights.shape[1] + 1e-3) / 5
    x = anp.concatenate([poke_features(before - centre[:, None]), poke_features(after - centre[:, None]), amount,
                         encode(params, before), encode(params, after)], axis=2)
    x = layer(params, "change_2", layer(params, "change_1", x))
    seen = weights > 1e-6 * weights.max(axis=1, keepdims=True)
    pooling = np.stack([weights, weights ** 0.25, seen], axis=1)  # by |P_{t+1} - P_t|^4, |P_{t+1} - P_t| and 1
    pooling = (pooling / (pooling.sum(axis=2, keepdims=True) + 1e-9)).astype(before.dtype)
    pooled = anp.reshape(anp.matmul(pooling, x), (len(weights), -1))
    context = anp.concatenate([max_over_points(x, seen), pooled], axis=1)  # (B, 4 C)
    bias = layer(params, "cell_context_2", layer(params, "cell_context_1", context), leaky=False)

    local = (cells - centre[:, None, :2]).astype(before.dtype)  # (B, cells, 2)
    y = np.concatenate([local / 0.1, fourier(local, (0.4, 0.2, 0.1, 0.05))], axis=2)
    y = layer(params, "cell_1", y)
    y = layer(params, "cell_3", dense(y, params["cell_2_w"], bias, leaky=True))
    logits = layer(params, "heatmaps", y, leaky=False)
    return take(logits, (..., 0)), take(logits, (..., 1))
