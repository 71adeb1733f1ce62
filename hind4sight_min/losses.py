"""Equations 2-6: one function per equation.

Shapes: B interactions, H, W the picture, N = H * W points, row by row, so a map (B, N) is a picture (B, H, W).
Every loss returns (B,): the sum over pixels as printed in the paper, per interaction; training averages
over the batch. `valid` (B, N) marks the pixels that count: the others neither attract nor cost anything. In
training these are the pixels with depth that both frames show (`seen_in_both`); flow is smooth wherever there is depth.
"""
from functools import lru_cache

import autograd.numpy as np
import numpy as onp
from autograd.tracer import getval

from .ops import bilinear_sample, nearest_squared_distances, take, total_variation

# The paper's exp(-|grad I|) depends on the range of I. Ours is [0, 1], where exp(-40 |grad I|) makes the edge of a true
# flow 20 times cheaper than that of one that spills onto the table; see docs/research-log.md.
EDGE_SHARPNESS = 40.0


def seen_in_both(valid, next_valid, occupied, next_occupied):
    """Which points of each frame have a counterpart in the other: the `valid` of Eq. 2, 3 and 5.

    Not in the paper. Where a pixel shows the table in one frame and an object in the other, the object covers or
    uncovers that bit of table, and one of the clouds lacks it. Compared all the same, it makes most of the Chamfer
    distance of the true flow, and dragging the table along with the object is the cheapest way out.
    valid, next_valid: pixels with depth; occupied, next_occupied: pixels nearer than the empty arena; all (B, N) bool
    -> two (B, N) bool.
    """
    return valid & (occupied | ~next_occupied), next_valid & (next_occupied | ~occupied)


# --- 3D -----------------------------------------------------------------------------------------------

def distance_maps(predicted, observed, valid_predicted, valid_observed, free_predicted=None, free_observed=None):
    """The two distance transforms between clouds, each on its own cloud's grid.

    Paper: Sec. III-B.  D_{P'->P}(i) = min_j |P'_i - P_j|^2,  D_{P->P'}(j) = min_i |P'_i - P_j|^2.
    predicted, observed (B, N, 3) m; valid_* (B, N) bool -> two maps (B, N) m^2, 0 where not valid.
    The first lives on frame t's grid, the second on frame t+1's.
    free_* (B, N) m, from geometry.free_radius and ray_spacing: they change nothing but the time it takes.
    """
    return (nearest_squared_distances(predicted, observed, valid_observed, free_observed) * valid_predicted,
            nearest_squared_distances(observed, predicted, valid_predicted, free_predicted) * valid_observed)


def chamfer_loss(map_predicted, map_observed):
    """Paper: Eq. (2), Sec. III-B.  L_CD = sum_xy (D_{P'->P} + D_{P->P'}).  Two maps (B, N) m^2 -> (B,) m^2."""
    return np.sum(map_predicted + map_observed, axis=1)  # Eq. (2)


def association_loss(predicted, targets, valid):
    """What SE3-Nets minimises instead of Chamfer: sum_i |P'_i - T_i|^2, each point's own target known.

    Paper: Sec. IV-D.
    predicted, targets (B, N, 3) m, valid (B, N) bool -> (B,) m^2.
    """
    difference = predicted - targets
    return np.sum(difference * difference * valid[..., None], axis=(1, 2))


# --- 2D -----------------------------------------------------------------------------------------------

def warp_backward(next_images, flow):
    """I'_t: frame t+1 pulled back to frame t along the flow, and which pixels stay in view.

    Paper: Sec. III-C.  I'_t(x, y) = I_{t+1}(x + U, y + V), bilinear.
    next_images (B, H, W, C), flow (B, H, W, 2) px -> warped (B, H, W, C), in_view (B, H, W) bool.
    """
    height, width = next_images.shape[1:3]
    positions = flow + _pixel_grid(height, width, getval(flow).dtype.type)
    where, margin = getval(positions), 1e-3  # px: rounding must not carry the rim's still pixels out of view
    # One axis after the other: NumPy is slow at small ones.
    in_view = [(where[..., axis] >= -margin) & (where[..., axis] <= size - 1 + margin)
               for axis, size in enumerate((width, height))]
    return bilinear_sample(next_images, positions), in_view[0] & in_view[1]


@lru_cache(maxsize=4)
def _pixel_grid(height, width, dtype):
    """(height, width, 2): every pixel's own position (x, y)."""
    y, x = onp.mgrid[:height, :width]
    return onp.stack([x, y], axis=-1).astype(dtype)


def photometric_loss(images, next_images, flow, valid):
    """Paper: Eq. (3), Sec. III-C.  L_rec = sum_xy |I_t - I'_t|_1.

    images, next_images (B, H, W, C) in [0, 1]; flow (B, H, W, 2) px; valid (B, N) bool -> (B,).
    Pixels that the flow carries out of view have nothing to be compared with and cost nothing.
    """
    warped, in_view = warp_backward(next_images, flow)
    counted = onp.reshape(valid, in_view.shape) & in_view
    return np.sum(np.abs(images - warped) * counted[..., None], axis=(1, 2, 3))  # Eq. (3)


def edge_weights(images):
    """exp(-EDGE_SHARPNESS |grad I|) between horizontal and between vertical neighbours.

    images (B, H, W, C) in [0, 1] -> (B, H, W-1), (B, H-1, W); |grad I| is the mean over the channels.
    """
    mean = onp.full(images.shape[3], 1 / images.shape[3], images.dtype)
    across, down = (onp.abs(onp.diff(images, axis=axis)) @ mean for axis in (2, 1))
    return onp.exp(-EDGE_SHARPNESS * across), onp.exp(-EDGE_SHARPNESS * down)


def edge_aware_smoothness(field, images, valid):
    """sum_xy |d field/dx| e^{-|dI/dx|} + |d field/dy| e^{-|dI/dy|}: the common form of Eq. (4) and (5).

    field (B, H, W, C); images (B, H, W, 3) on the same grid, in [0, 1]; valid (B, N) bool -> (B,), units of the
    field. A step counts where both neighbours have depth.
    """
    across, down = edge_weights(images)
    valid = onp.reshape(valid, images.shape[:3])
    across, down = across * (valid[:, :, 1:] & valid[:, :, :-1]), down * (valid[:, 1:] & valid[:, :-1])
    return total_variation(field, across, down)


def flow_smoothness_loss(flow, images, valid):
    """Paper: Eq. (4), Sec. III-D.  L_fs = sum |grad U| e^{-|grad I_t|} + |grad V| e^{-|grad I_t|}.

    flow (B, H, W, 2) px; images (B, H, W, 3); valid (B, N) bool -> (B,) px.
    """
    return edge_aware_smoothness(flow, images, valid)  # Eq. (4)


def distance_smoothness_loss(map_predicted, map_observed, images, next_images, valid, next_valid):
    """Paper: Eq. (5), Sec. III-D.  L_ds = sum |grad D_{P->P'}| e^{-|grad I|} + |grad D_{P'->P}| e^{-|grad I|}.

    The paper prints I_{t+1} for both; D_{P'->P} lives on frame t's grid, so it is weighted by I_t here.
    Two maps (B, N) m^2, two images (B, H, W, 3), two masks (B, N) bool -> (B,) m^2.
    """
    grid = images.shape[:3] + (1,)
    return (edge_aware_smoothness(np.reshape(map_observed, grid), next_images, next_valid)
            + edge_aware_smoothness(np.reshape(map_predicted, grid), images, valid))  # Eq. (5)


# --- masks ------------------------------------------------------------------------------------------------

SHARING_REACH = 3  # px; about the radius of an object


def sharing_loss(masks, valid):
    """How often near points move by different masks. Not in the paper.

    L_sh = sum_ij sum_{k != l} m_ik m_jl, over the pairs of pixels (i, j) that lie `SHARING_REACH` apart in a row or a
    column, and the masks k, l that move. Where two masks move alike, Eq. (2) to (5) do not mind how many of them an
    object is shared between; this does. Two objects that lie apart may have a mask each.
    masks (B, H, W, K), 0 the background; valid (B, N) bool -> (B,).
    """
    movers = take(masks, (..., slice(1, None))) * onp.reshape(valid, masks.shape[:3] + (1,))
    ahead, behind = slice(SHARING_REACH, None), slice(None, -SHARING_REACH)
    total = 0
    for axis in (1, 2):
        before = (slice(None),) * axis
        a, b = take(movers, (*before, ahead)), take(movers, (*before, behind))
        total = total + np.sum(np.sum(a, axis=3) * np.sum(b, axis=3) - np.sum(a * b, axis=3), axis=(1, 2))
    return total


# --- the inverse model -----------------------------------------------------------------------------------

def heatmap_cross_entropy(logits, cells):
    """Cross entropy of a heat-map over the arena's cells. Paper: L_act, Sec. III-E.

    -log softmax(logits)[cell].  logits (B, cells), cells (B,) int -> (B,) nats.
    """
    top = onp.max(getval(logits), axis=1, keepdims=True)  # cancels; keeps exp in range
    shifted = logits - top
    return np.log(np.sum(np.exp(shifted), axis=1)) - take(shifted, (onp.arange(len(cells)), cells))


def embedding_loss(predicted, observed):
    """L1 distance of the predicted and the observed next state's embedding. Paper: L_sim, Sec. III-E.

    (B, E), (B, E) -> (B,), the mean over E, so that its weight does not depend on the embedding's width.
    """
    # Not np.mean: under NumPy 2 autograd's derivative of it turns float32 into float64.
    return np.sum(np.abs(predicted - observed), axis=1) / float(predicted.shape[1])


def inverse_loss(start_logits, end_logits, start_cells, end_cells, predicted_embedding, next_embedding):
    """Paper: Sec. III-E.  L_inv = L_act + L_sim, with L_act over both heat-maps -> (B,)."""
    return (heatmap_cross_entropy(start_logits, start_cells) + heatmap_cross_entropy(end_logits, end_cells)
            + embedding_loss(predicted_embedding, next_embedding))


# --- the full model ----------------------------------------------------------------------------------------

# Weights of L_CD, L_ds, L_rec, L_fs, L_inv. The paper's own belong to its sums over its picture size.
PAPER_WEIGHTS = {"chamfer": 1e5, "distance_smoothness": 1e5, "photometric": 1e3, "flow_smoothness": 1e3,
                 "inverse": 1.0}


def full_loss(terms, weights):
    """Paper: Eq. (6), Sec. III-F.  L = lambda_1 L_3D + lambda_2 L_2D + lambda_3 L_inv, averaged over the batch.

    L_3D = L_CD + L_ds and L_2D = L_rec + L_fs; with a weight per term, so that an ablation is a zero. Training adds
    `sharing_loss`.
    terms: dict of (B,); weights: dict of floats; both with the same keys -> scalar.
    """
    if set(terms) != set(weights) or not terms:
        raise ValueError(f"weights: expected the keys {sorted(terms)}, got {sorted(weights)}")
    total = sum(weights[name] * terms[name] for name in terms)  # Eq. (6)
    return np.sum(total) / float(len(total))
