"""Equations 2-6: one function per equation, in plain autograd.

Shapes: B interactions, H, W the picture, N = H * W points, row by row, so a map (B, N) is a picture (B, H, W).
Every term returns (B,), per interaction: the sum over pixels as printed in the paper (L_sim: a mean); `full_loss`
averages over the batch. `valid` (B, N) marks the pixels that count: the others neither attract nor cost anything. In
training these are the pixels with depth that both frames show (`seen_in_both`), but in Eq. 4 all that have depth.
"""
from functools import lru_cache

import autograd.numpy as anp
import numpy as np
from autograd.tracer import getval

from . import as_arrays
from .ops import bilinear_sample, nearest_squared_distances, take

# The paper's exp(-|grad I|) depends on the range of I. Ours is [0, 1], where exp(-40 |grad I|) makes the edge of a true
# flow 20 times cheaper than that of one that spills onto the table; see docs/research-log.md.
EDGE_SHARPNESS = 40.0


def seen_in_both(valid, next_valid, occupied, next_occupied):
    """Which points of each frame have a counterpart in the other: the `valid` of Eq. 2, 3 and 5.

    Not in the paper. Where a pixel shows the table in one frame and an object in the other, the object covers or
    uncovers that bit of table, and one of the clouds lacks it. Compared all the same, it makes most of the Chamfer
    distance of the true flow, and dragging the table along with the object is the cheapest way out.
    valid, next_valid: pixels with depth; occupied, next_occupied: pixels of objects; all (B, N) bool
    -> two (B, N) bool.
    """
    # left out: table here where the other frame shows an object
    return valid & (occupied | ~next_occupied), next_valid & (next_occupied | ~occupied)


# --- 3D -----------------------------------------------------------------------------------------------

def distance_maps(predicted, observed, valid_predicted, valid_observed):
    """The two distance transforms between clouds, each on its own cloud's grid.

    Paper: Sec. III-B.  D_{P'->P}(i) = min_j |P'_i - P_j|^2,  D_{P->P'}(j) = min_i |P'_i - P_j|^2.
    predicted, observed (B, N, 3) m; valid_* (B, N) bool -> two maps (B, N) m^2, 0 where not valid.
    The first lives on frame t's grid, the second on frame t+1's.
    """
    predicted, observed, valid_predicted, valid_observed = as_arrays(
        "BND BMD BN BM", predicted=predicted, observed=observed, valid_predicted=valid_predicted,
        valid_observed=valid_observed)
    return (nearest_squared_distances(predicted, observed, valid_observed) * valid_predicted,
            nearest_squared_distances(observed, predicted, valid_predicted) * valid_observed)


def chamfer_loss(map_predicted, map_observed):
    """Paper: Eq. (2), Sec. III-B.  L_CD = sum_xy (D_{P'->P} + D_{P->P'}).  Two maps (B, N) m^2 -> (B,) m^2."""
    return anp.sum(map_predicted + map_observed, axis=1)  # Eq. (2)


# --- 2D -----------------------------------------------------------------------------------------------

def warp_backward(next_images, flow):
    """I'_t: frame t+1 pulled back to frame t along the flow, and which pixels stay in view.

    Paper: Sec. III-C.  I'_t(x, y) = I_{t+1}(x + U, y + V), bilinear.
    next_images (B, H, W, C), flow (B, H, W, 2) px -> warped (B, H, W, C), in_view (B, H, W) bool.
    """
    height, width = next_images.shape[1:3]
    positions = flow + _pixel_grid(height, width, getval(flow).dtype.type)
    where, margin = getval(positions), 1e-3  # px: rounding must not carry the rim's still pixels out of view
    in_view = [(where[..., axis] >= -margin) & (where[..., axis] <= size - 1 + margin)
               for axis, size in enumerate((width, height))]
    return bilinear_sample(next_images, positions), in_view[0] & in_view[1]


@lru_cache(maxsize=4)
def _pixel_grid(height, width, dtype):
    """(height, width, 2): every pixel's own position (x, y)."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x, y], axis=-1).astype(dtype)


def photometric_loss(images, next_images, flow, valid):
    """Paper: Eq. (3), Sec. III-C.  L_rec = sum_xy |I_t - I'_t|_1.

    images, next_images (B, H, W, C) in [0, 1]; flow (B, H, W, 2) px; valid (B, N) bool -> (B,).
    Pixels that the flow carries out of view have nothing to be compared with and cost nothing.
    """
    images, next_images, flow, valid = as_arrays("BHWC BHWC BHW2 BP", images=images, next_images=next_images,
                                                 flow=flow, valid=valid)
    warped, in_view = warp_backward(next_images, flow)
    counted = np.reshape(valid, in_view.shape) & in_view
    return anp.sum(anp.abs(images - warped) * counted[..., None], axis=(1, 2, 3))  # Eq. (3)


def edge_weights(images):
    """exp(-EDGE_SHARPNESS |grad I|) between horizontal and between vertical neighbours.

    images (B, H, W, C) in [0, 1] -> (B, H, W-1), (B, H-1, W); |grad I| is the mean over the channels.
    """
    mean = np.full(images.shape[3], 1 / images.shape[3], images.dtype)
    across, down = (np.abs(np.diff(images, axis=axis)) @ mean for axis in (2, 1))
    return np.exp(-EDGE_SHARPNESS * across), np.exp(-EDGE_SHARPNESS * down)


def edge_aware_smoothness(field, images, valid):
    """sum_xy |d field/dx| e^{-|dI/dx|} + |d field/dy| e^{-|dI/dy|}: the common form of Eq. (4) and (5).

    field (B, H, W, C); images (B, H, W, 3) on the same grid, in [0, 1]; valid (B, N) bool -> (B,), units of the
    field. A step counts where both neighbours are valid.
    """
    field, images, valid = as_arrays("BHWD BHWC BP", field=field, images=images, valid=valid)
    across, down = edge_weights(images)
    valid = np.reshape(valid, images.shape[:3])
    across, down = across * (valid[:, :, 1:] & valid[:, :, :-1]), down * (valid[:, 1:] & valid[:, :-1])
    every, later, earlier = slice(None), slice(1, None), slice(None, -1)
    dx = take(field, (every, every, later)) - take(field, (every, every, earlier))
    dy = take(field, (every, later)) - take(field, (every, earlier))
    return (anp.sum(anp.abs(dx) * across[..., None], axis=(1, 2, 3))
            + anp.sum(anp.abs(dy) * down[..., None], axis=(1, 2, 3)))


def flow_smoothness_loss(flow, images, valid):
    """Paper: Eq. (4), Sec. III-D.  L_fs = sum |grad U| e^{-|grad I_t|} + |grad V| e^{-|grad I_t|}.

    flow (B, H, W, 2) px; images (B, H, W, 3); valid (B, N) bool -> (B,) px.
    """
    flow, = as_arrays("*2", flow=flow)
    return edge_aware_smoothness(flow, images, valid)  # Eq. (4)


def distance_smoothness_loss(map_predicted, map_observed, images, next_images, valid, next_valid):
    """Paper: Eq. (5), Sec. III-D.  L_ds = sum |grad D_{P->P'}| e^{-|grad I|} + |grad D_{P'->P}| e^{-|grad I|}.

    The paper prints I_{t+1} for both. D_{P->P'} (map_observed) lives on frame t+1's grid and is weighted by I_{t+1}
    (next_images); D_{P'->P} (map_predicted) lives on frame t's grid, so here it is weighted by I_t (images).
    Two maps (B, N) m^2, two images (B, H, W, 3), two masks (B, N) bool -> (B,) m^2.
    """
    grid = images.shape[:3] + (1,)
    return (edge_aware_smoothness(anp.reshape(map_observed, grid), next_images, next_valid)
            + edge_aware_smoothness(anp.reshape(map_predicted, grid), images, valid))  # Eq. (5)


# --- masks ------------------------------------------------------------------------------------------------

def binary_mask_loss(masks):
    """sum_xy m^0 (1 - m^0): a point is to belong to the background or to move, not to do both. Not in the paper.

    Half a mover's mask with twice its motion is the same flow, so without this term what moves little, and by the
    larger mask is background, stays it. masks (B, N, K), summing to 1 over K -> (B,).
    """
    background = take(masks, (..., 0))
    return anp.sum(background * (1 - background), axis=1)


# --- the inverse model -----------------------------------------------------------------------------------

def heatmap_cross_entropy(logits, cells):
    """Cross entropy of a heat-map over the arena's cells. Paper: L_act, Sec. III-E.

    -log softmax(logits)[cell].  logits (B, cells), cells (B,) int -> (B,) nats.
    """
    logits, cells = as_arrays("BN B", logits=logits, cells=cells)
    if not (0 <= cells.min() and cells.max() < logits.shape[1]):  # -1 would be the last
        raise ValueError(f"cells: expected 0 to {logits.shape[1] - 1}, got {cells.min()} to {cells.max()}")
    top = np.max(getval(logits), axis=1, keepdims=True)  # cancels; keeps exp in range
    shifted = logits - top
    return anp.log(anp.sum(anp.exp(shifted), axis=1)) - take(shifted, (np.arange(len(cells)), cells))


def embedding_loss(predicted, observed):
    """L1 distance of the predicted and the observed next state's embedding. Paper: L_sim, Sec. III-E.

    (B, E), (B, E) -> (B,), the mean over E, not the sum. What it trains and what not: `networks.state_embedding`.
    """
    predicted, observed = as_arrays("BE BE", predicted=predicted, observed=observed)
    # Not anp.mean: under NumPy 2 autograd's derivative of it turns float32 into float64.
    return anp.sum(anp.abs(predicted - observed), axis=1) / float(predicted.shape[1])


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

    L_3D = L_CD + L_ds and L_2D = L_rec + L_fs; with a weight per term, so that an ablation is a zero.
    terms: dict of (B,); weights: dict of floats, a missing one is 0 -> scalar.
    Raises ValueError where there is no term, and for a weight of a term that is not there.
    """
    if not terms or not set(weights) <= set(terms):
        raise ValueError(f"weights: expected some of the terms {sorted(terms)}, got {sorted(weights)}")
    total = sum(weights.get(name, 0.0) * term for name, term in terms.items())  # Eq. (6)
    return anp.sum(total) / float(len(total))
