"""The siamese point encoder, the forward model and the inverse model. Parameters are a dict of arrays.

Every network is the same small perceptron applied to each point, plus *context*: pooled features of the whole cloud and
a code of the heights around the target, handed back to every point. What runs on every point is narrow; what runs
once per scene may be wide. Paper: Sec. III-A, III-E and Fig. 3.

The paper's forward model is that of SE3-Nets with a projection layer; ours is smaller. Box of Fig. 3 -> function here
(its layers):
    encoder, siamese             `encode` (encoder_*), one point at a time; `state_embedding`, its sum
    poke                         `poke_frame`: not an input of its own but the frame that points are given in
    decoder of masks             `forward_model` (trunk_*, context_*, shape_*, mask)
    decoder of SE(3) motions     `_motions` (motion_*), from the features under each mask; the background's is fixed
    next state embedding         `state_embedding` of the predicted cloud, by the same encoder
    inverse model, heat-maps     `inverse_model` (change_*, cell_*, heatmaps), from what `most_changed` finds
Ours alone: `windows`, `standing_out`, `contact`, `height_map`, `pooling_weights`, `most_changed`, and all constants.
"""
from dataclasses import dataclass

import autograd.numpy as np
import numpy as onp
from autograd.tracer import getval

from . import check_whole
from .geometry import project, so3_exp, transform_layer
from .ops import at_rows, dense, pool, softmax, take, weighted_maxima, weighted_means


@dataclass(frozen=True)
class Sizes:
    """masks: K, background included. width: units of the layers that run on every point. rounds: of context.
    head: units of those that run once per scene or mask; they cost next to nothing.
    embedding: length of the state embedding s_t and of the encoder's features. inverse: units of the inverse model.
    """
    masks: int = 4
    width: int = 48
    head: int = 128
    rounds: int = 2
    embedding: int = 32
    inverse: int = 64

    def __post_init__(self):
        for name in ("masks", "width", "head", "rounds", "embedding", "inverse"):
            check_whole(name, getattr(self, name), 2 if name == "masks" else 1)


@dataclass
class Prediction:
    """What the forward model says of B interactions. N points, K masks (0 is the background)."""
    points: object        # (B, N, 3) m, arena: P'_{t+1}
    masks: object         # (B, N, K), summing to 1 over K
    rotations: object     # (B, K, 3, 3), in the poke's frame
    translations: object  # (B, K, 3) m, in the poke's frame


# --- inputs (fixed functions of the observation and the poke) --------------------------------------------

def window_shape(camera):
    """(rows, columns) of the window the model looks at: half the picture high and half as wide."""
    return (camera.height + 1) // 2, (camera.width + 1) // 2


def windows(pokes, camera):
    """Where the model looks: for each poke (B, 3) the rows and columns around its target, a list of B pairs of slices.

    Not in the paper. A poke moves what is near its target: a quarter of the picture holds all but 0.02 % of the squared
    motion (docs/research-log.md), and everything that runs on every point costs a quarter. What lies outside is
    background that stays. picture[window] cuts a window out, picture[window] = part pastes it back.
    """
    rows, columns = window_shape(camera)
    ahead = pokes[:, :2] + 0.02 * onp.stack([onp.cos(pokes[:, 2]), onp.sin(pokes[:, 2])], axis=1)  # things roll on
    x, y = project(onp.column_stack([ahead, onp.full(len(pokes), 0.02)]), camera).T
    left = onp.clip(onp.rint(x - (columns - 1) / 2), 0, camera.width - columns).astype(int)
    top = onp.clip(onp.rint(y - (rows - 1) / 2), 0, camera.height - rows).astype(int)
    return [(slice(t, t + rows), slice(c, c + columns)) for t, c in zip(top, left)]


LOOK = 256  # points of a window that the forward model looks at: a third


def standing_out(prominence):
    """Which points of a window the forward model looks at, the LOOK most prominent: (B, N) m -> rows (B, M) int.

    Not in the paper. By interactions.prominence they hold all but 0.03 % of the squared motion (0.1 % under 1 cm of
    depth noise); the others are background that stays. Of equally prominent ones, bare table mostly, the first.
    """
    order = onp.argsort(-prominence, axis=1, kind="stable")  # argpartition breaks ties by what the processor can do
    return onp.sort(order[:, :LOOK], axis=1)


def fourier(values, wavelengths):
    """sin and cos of 2 pi v / w: positions as a perceptron can use them. (..., D) -> (..., 2 D len(wavelengths))."""
    phase = np.reshape(values, values.shape + (1,)) * (2 * onp.pi / onp.asarray(wavelengths)).astype(values.dtype)
    phase = np.reshape(phase, values.shape[:-1] + (-1,))
    return np.concatenate([np.sin(phase), np.cos(phase)], axis=-1)


def position_features(points, unit, wavelengths):
    """Each point's position as a perceptron can use it, (..., 3) m -> (..., 20).

    tanh(z / 1 cm) tells the table from what stands on it, by a threshold no perceptron would learn to be as sharp.
    """
    across, up = take(points, (..., slice(0, 2))), take(points, (..., slice(2, 3)))
    return np.concatenate([points / unit, np.tanh(up / 0.01), fourier(across, wavelengths)], axis=-1)


def encoder_features(points):
    """Position in the arena, (..., 3) m -> (..., 20)."""
    return position_features(points, 0.25, (0.8, 0.4, 0.2, 0.1))


def poke_axes(pokes):
    """Pokes (B, 3) -> Q (B, 3, 3), o (B, 3): p_arena = Q p_poke + o, x along the poke, origin at its target."""
    c, s, zero, one = onp.cos(pokes[:, 2]), onp.sin(pokes[:, 2]), 0 * pokes[:, 2], 0 * pokes[:, 2] + 1
    axes = onp.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    return axes, onp.stack([pokes[:, 0], pokes[:, 1], zero], axis=-1)


def poke_frame(points, pokes):
    """Points (B, N, 3) m, arena -> the same in each poke's frame."""
    axes, origins = poke_axes(pokes.astype(points.dtype))
    return onp.matmul(points - origins[:, None], axes)


def poke_features(local):
    """Position relative to the poke, (..., 3) m in the poke frame -> (..., 20)."""
    return position_features(local, 0.1, (0.4, 0.2, 0.1, 0.05))


MAP_CELL = 0.02  # m
MAP_X = onp.arange(-6.5, 7, dtype=onp.float32)  # cell centres in the poke frame, in cells
MAP_Y = onp.arange(-4.5, 5, dtype=onp.float32)


def height_map(local, valid):
    """What the finger will meet: mean height over each cell around the target, (B, 140), in units of 3 cm.

    local (B, N, 3) m, poke frame; valid (B, N) bool. A point counts for the four cells around it, bilinearly, so
    that the map changes smoothly with the poke. A cell that no point is near reads 0.
    """
    across, along = (onp.maximum(0, 1 - onp.abs(local[..., axis, None] / MAP_CELL - centres))  # (B, N, cells)
                     for axis, centres in ((1, MAP_Y), (0, MAP_X)))
    across, along = across * valid[..., None], onp.swapaxes(along, 1, 2)
    count = onp.matmul(along, across)
    total = onp.matmul(along, across * onp.maximum(local[..., 2:], 0))
    return (total / (count + 0.2) / 0.03).reshape(len(local), -1)


REACH = 0.014  # m; half the width of what the finger sweeps: its radius and half a pixel


def contact(local, valid):
    """What the finger meets on its straight way to the target. Not in the paper: a perceptron learns it slowly.

    A disc of radius `REACH` that ends in the origin pushes a point (x, y) of its way by d = sqrt(REACH^2 - y^2) - x;
    the deepest one is met first. local (B, N, 3) m, poke frame; valid (B, N) bool
    -> features of every point (B, N, 3): d in units of 5 cm (0 for what is not met), how central it lies in the way, in
    [0, 1], and how much later than the first it is met; weights (B, N) in [0, 1], near 1 where the finger first meets
    something, 0 where it meets nothing.
    """
    x, y, z = local[..., 0], local[..., 1], local[..., 2]
    central = onp.sqrt(onp.maximum(0, 1 - (y / REACH) ** 2))  # 0 beside the way
    depth = REACH * central - x
    # The finger comes down at most 14 cm before the target.
    met = valid & (z > 0.005) & (central > 0) & (x > -0.16) & (depth > 0)
    depth = depth * met
    deepest = depth.max(axis=1, keepdims=True)
    features = onp.stack([depth / 0.05, central, (deepest - depth) / 0.05], axis=2)
    return features.astype(local.dtype), (met * central * onp.exp((depth - deepest) / 0.004)).astype(local.dtype)


def pooling_weights(local, valid, first):
    """Where the context looks: (B, 3, N), rows sum to 1. Around the target, along the finger's path, and where it first
    meets something; `first` (B, N) are the weights of `contact`.

    Points on the table's surface are left out: they say nothing about the objects there.
    """
    x, y, z = local[..., 0], local[..., 1], local[..., 2]
    near = onp.exp(-(x ** 2 + y ** 2) / (2 * 0.04 ** 2))
    path = onp.exp(-y ** 2 / (2 * 0.015 ** 2)) * ((x > -0.15) & (x < 0.02))
    weights = onp.stack([near, path, first], axis=1) * (valid & (z > 0.005))[:, None]
    return weights / (weights.sum(axis=2, keepdims=True) + 1e-6)


# --- parameters --------------------------------------------------------------------------------------------

def init_parameters(sizes, rng, dtype=onp.float32):
    """Random parameters: He initialisation; identity motions; mask 0 taken by the background.

    Paper: Sec. III-G, "initializing one out of K masks to predict all pixels as background and moreover
    initializing SE(3) transformations to predict identity transform".
    """
    params, width, head, embedding, inverse = {}, sizes.width, sizes.head, sizes.embedding, sizes.inverse

    def add(name, inputs, outputs, gain=2.0):
        params[name + "_w"] = (rng.standard_normal((inputs, outputs)) * onp.sqrt(gain / inputs)).astype(dtype)
        params[name + "_b"] = onp.zeros(outputs, dtype)

    add("encoder_1", 20, embedding)
    add("encoder_2", embedding, embedding)
    add("shape_1", len(MAP_X) * len(MAP_Y), head)
    add("shape_2", head, width)
    add("trunk_0", 23 + embedding, width)
    for i in range(1, sizes.rounds + 1):
        add(f"trunk_{i}", width, width)
        add(f"context_{i}", 5 * width, width, gain=1.0)  # its bias is the trunk layer's
        del params[f"trunk_{i}_b"]
    add("mask", width, sizes.masks - 1, gain=0.01)
    params["mask_b"] -= 1  # background first
    add("motion_1", 7 * width + 6, head)
    add("motion_2", head, head)
    add("motion_3", head, 6, gain=0.0)
    add("change_1", 2 * 20 + 2 * embedding + 1, inverse)
    add("change_2", inverse, inverse)
    add("cell_context_1", 4 * inverse, inverse)
    add("cell_context_2", inverse, inverse, gain=1.0)  # its bias is that of cell_2
    add("cell_1", 18, inverse)
    add("cell_2", inverse, inverse)
    del params["cell_2_b"]
    add("cell_3", inverse, inverse)
    add("heatmaps", inverse, 2, gain=0.1)
    return params


# --- the three networks --------------------------------------------------------------------------------------

def layer(params, name, x, leaky=True):
    """The layer `name`: y = x W + b, or max(y, 0.1 y), a leaky ReLU.  (..., I) -> (..., O)."""
    return dense(x, params[name + "_w"], params[name + "_b"], leaky=leaky)


def encode(params, points):
    """The siamese encoder: features of every point. Paper: Sec. III-E, III-G.  (B, N, 3) m arena -> (B, N, E)."""
    return layer(params, "encoder_2", layer(params, "encoder_1", encoder_features(points)))


STATE_GAIN = 3.0  # L_sim beside the cross entropies; of 1, 3, 10 and more: see docs/research-log.md


def state_embedding(params, points, standing):
    """s_t, the sum of the encoder's features over the points of objects. Paper: Sec. III-E.

    Of the predicted cloud it is the predicted s'_{t+1}, of the observed one s_{t+1}: an encoder that tells pokes apart
    also tells how a prediction differs from what happened. Its gradient goes to the points, not to the encoder, which
    would end up saying nothing: then all clouds are alike (docs/research-log.md).
    (B, N, 3) m arena, standing (B, N) bool -> (B, E).
    """
    features = encode({name: getval(value) for name, value in params.items()}, points)
    weights = STATE_GAIN * standing[:, None].astype(getval(features).dtype)
    return np.reshape(np.matmul(weights, features), (len(standing), -1))


MASK_BOUND = 6.0  # a mover's logit stays within so much of the background's, which is 0


def forward_model(params, sizes, points, valid, pokes):
    """F: masks, motions and the next point cloud under a poke. Paper: Sec. III-A, Eq. (1).

    points (B, N, 3) m arena, a set, those that `standing_out` found; valid (B, N) bool; pokes (B, 3), (m, m, rad)
    -> Prediction.
    """
    local = poke_frame(points, pokes)
    met, first = contact(local, valid)
    pooling = pooling_weights(local, valid, first)
    shape = layer(params, "shape_2", layer(params, "shape_1", height_map(local, valid)))  # (B, C)

    def context(h):  # (B, N, C) -> (B, 5 C)
        return np.concatenate([pool(h, valid, pooling), shape], axis=1)

    h = layer(params, "trunk_0", np.concatenate([poke_features(local), met, encode(params, points)], axis=2))
    for i in range(1, sizes.rounds + 1):
        bias = layer(params, f"context_{i}", context(h), leaky=False)
        h = dense(h, params[f"trunk_{i}_w"], bias, leaky=True, residual=True)
    seen = context(h)

    # The background's logit is 0, a mover's bounded: a mask that the optimiser once pushed to nothing (it
    # overshoots) would have no gradient left to come back with.
    logits = np.clip(layer(params, "mask", h, leaky=False) / MASK_BOUND, -20, 20)  # tanh is flat there: no overflow
    movers = MASK_BOUND * np.tanh(logits)
    masks = softmax(np.concatenate([onp.zeros(movers.shape[:2] + (1,), points.dtype), movers], axis=2))  # (B, N, K)
    rotations, translations = _motions(params, h, masks, seen, local, valid)
    moved = transform_layer(local, masks, rotations, translations)  # Eq. (1)
    axes, _ = poke_axes(pokes.astype(points.dtype))
    predicted = points + np.matmul(moved - local, onp.swapaxes(axes, 1, 2))
    return Prediction(predicted, masks, rotations, translations)


# Of [translation, rotation], in m and rad. The optimiser moves every weight by the learning rate, however small its
# gradient, and a motion is a sum over `head` of them: with 5 cm and 1 rad the first steps fling the points about, and
# the masks withdraw from that within a hundred steps.
MOTION_UNIT = onp.array([0.005] * 3 + [0.1] * 3, onp.float32)


def _motions(params, h, masks, seen, local, valid):
    """One rigid motion per mask, from the features pooled under it and its points' second moments; the background's is
    the identity.

    The network speaks of a turn about the mask's centroid c and a shift t: p' = R (p - c) + c + t, that is
    T = c - R c + t, all in the poke frame.
    """
    moving = take(masks, (..., slice(1, None))) * valid[..., None]
    pooled, centroids = weighted_means(h, moving), weighted_means(local, moving)  # (B, K-1, C), (B, K-1, 3)
    tops = weighted_maxima(h, moving)  # (B, K-1, C): a mean does not see the one corner that the finger meets
    moments = weighted_means(_products(local / 0.05), moving) - _products(centroids / 0.05)  # (B, K-1, 3)
    batch, count = pooled.shape[:2]
    everywhere = np.reshape(seen, (batch, 1, -1)) * onp.ones((1, count, 1), local.dtype)
    x = layer(params, "motion_1", np.concatenate([pooled, tops, everywhere, centroids / 0.1, moments], axis=2))
    twist = MOTION_UNIT * layer(params, "motion_3", layer(params, "motion_2", x), leaky=False)  # (B, K-1, 6)
    turn = so3_exp(take(twist, (..., slice(3, None))))
    turned = np.matmul(turn, centroids[..., None])[..., 0]
    shift = centroids - turned + take(twist, (..., slice(0, 3)))
    identity = onp.broadcast_to(onp.eye(3, dtype=local.dtype), (batch, 1, 3, 3))
    return (np.concatenate([identity, turn], axis=1),
            np.concatenate([onp.zeros((batch, 1, 3), local.dtype), shift], axis=1))


def _products(positions):
    """x^2, xy and y^2 of positions (..., 3) -> (..., 3)."""
    x, y = take(positions, (..., 0)), take(positions, (..., 1))
    return np.stack([x * x, x * y, y * y], axis=-1)


CHANGED_POINTS = 128  # the inverse model looks at those that changed most: a poke changes about a hundred


def most_changed(points, next_points, valid):
    """Where the two clouds differ, pixel by pixel: the evidence of a poke.

    points, next_points (B, N, 3) m; valid (B, N) bool, depth in both -> the M most changed points before and after,
    (B, M, 3) each, and their weights (B, M), summing to 1 (0 where nothing changed). The weight is
    |P_{t+1} - P_t|^4: the power keeps the many small differences of a noisy depth picture from outvoting the few large
    ones.
    """
    change = onp.sum((next_points - points) ** 2, axis=2) ** 2 * valid
    count = min(CHANGED_POINTS, change.shape[1])
    rows = onp.argpartition(-change, count - 1, axis=1)[:, :count]
    weights = onp.take_along_axis(change, rows, axis=1)
    pick = at_rows(rows)
    weights = weights / (weights.sum(axis=1, keepdims=True) + onp.finfo(points.dtype).tiny)
    return points[pick], next_points[pick], weights


def inverse_model(params, before, after, weights, cells):
    """G: the poke that led from one cloud to the next, as two heat-maps. Paper: Sec. III-E.

    before, after (B, M, 3) m arena, weights (B, M): what `most_changed` found in the whole picture (a window would
    give the target away); cells (cells, 2) m, the centres of the arena's grid
    -> start logits, end logits, each (B, cells); softmax makes them heat-maps.

    Everything is said relative to the centre of change, so that a poke learnt in one corner of the arena is
    known in all of them. What changed is pooled by how much it changed, steeply, gently and not at all.
    """
    centre = onp.sum(weights[..., None] * (before + after), axis=1) / 2
    centre[:, 2] = 0
    amount = onp.log(weights[..., None] * weights.shape[1] + 1e-3) / 5
    x = np.concatenate([poke_features(before - centre[:, None]), poke_features(after - centre[:, None]), amount,
                        encode(params, before), encode(params, after)], axis=2)
    x = layer(params, "change_2", layer(params, "change_1", x))
    seen = weights > 1e-6 * weights.max(axis=1, keepdims=True)
    pooling = onp.stack([weights, weights ** 0.25, seen], axis=1)  # by |P_{t+1} - P_t|^4, |P_{t+1} - P_t| and 1
    pooling = pooling / (pooling.sum(axis=2, keepdims=True) + 1e-9)
    context = pool(x, seen, pooling.astype(before.dtype))  # (B, 4 C): what changed, seen from its centre
    bias = layer(params, "cell_context_2", layer(params, "cell_context_1", context), leaky=False)

    local = (cells - centre[:, None, :2]).astype(before.dtype)  # (B, cells, 2)
    y = onp.concatenate([local / 0.1, fourier(local, (0.4, 0.2, 0.1, 0.05))], axis=2)
    y = layer(params, "cell_1", y)
    y = layer(params, "cell_3", dense(y, params["cell_2_w"], bias, leaky=True))
    logits = layer(params, "heatmaps", y, leaky=False)
    return take(logits, (..., 0)), take(logits, (..., 1))
