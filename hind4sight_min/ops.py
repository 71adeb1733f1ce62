"""The operations whose derivative we write by hand: nearest neighbours, bilinear sampling, layers, differences.

Each is an autograd primitive: a forward function in NumPy, SciPy or OpenCV and its VJP (vector-Jacobian
product: the gradient g of a scalar with respect to the output in, that with respect to each input out).
"""
import math
from functools import reduce

import autograd.numpy as anp
import cv2
import numpy as np
from autograd.extend import SparseObject, defvjp, defvjp_argnums, primitive, vspace
from autograd.tracer import getval
from scipy.spatial import cKDTree


# --- nearest neighbours (Eq. 2) -------------------------------------------------------------------------

@primitive
def squared_distances(queries, references, indices):
    """d_i = |q_i - r_{indices_i}|^2.  (N, D), (M, D), (N,) int -> (N,)."""
    difference = queries - references[indices]
    return np.einsum("ij,ij->i", difference, difference)


def _squared_distances_vjp(argnums, ans, args, kwargs):
    queries, references, indices = args

    def vjp(g):
        pull = 2 * g[:, None] * (queries - references[indices])  # d(d_i)/dq_i = 2 (q_i - r)
        result = []
        for argnum in argnums:
            if argnum == 0:
                result.append(pull)
            else:  # a reference collects from every query it is nearest to
                columns = [np.bincount(indices, column, len(references)) for column in pull.T]
                result.append(-np.stack(columns, axis=1).astype(pull.dtype))
        return result
    return vjp


defvjp_argnums(squared_distances, _squared_distances_vjp)


def nearest_squared_distances(queries, references, valid, free=None):
    """Squared distance of every query to its nearest valid reference. Paper: Eq. (2), one direction.

    d_i = min_j |q_i - r_j|^2 with a SciPy KD-tree: O(N log N), where brute force is O(N M).
    queries (B, N, D), references (B, M, D), valid (B, M) bool -> (B, N), squared units of the input.
    free (B, N), for N = M: a radius around reference i in which no other reference lies. A query i less than half of
    it away from reference i has found its nearest, exactly, and is spared the search: most points never moved.
    The gradient flows to both sides through the neighbours found (it ignores that they may change, which
    is exact except where two references are equally near).
    Raises ValueError for other shapes, no valid reference, or points that are not finite.
    """
    q, r = getval(queries), getval(references)
    if q.ndim != 3 or r.ndim != 3 or q.shape[::2] != r.shape[::2] or valid.shape != r.shape[:2]:
        raise ValueError("queries, references, valid: expected (B, N, D), (B, M, D) and (B, M), "
                         f"got {q.shape}, {r.shape}, {valid.shape}")
    if not (np.isfinite(q).all() and np.isfinite(r).all()):
        raise ValueError("queries, references: expected finite points, got NaN or infinity")
    if not valid.any(axis=1).all():
        raise ValueError("valid: expected at least one valid reference in every cloud")
    if free is None:
        search = np.ones(q.shape[:2], bool)
    else:
        difference = q - r
        search = ~(valid & (4 * np.einsum("bnd,bnd->bn", difference, difference) < free * free))
    indices = np.arange(len(q))[:, None] * r.shape[1] + np.arange(q.shape[1])
    for i in range(len(q)):
        rows = np.flatnonzero(valid[i])
        # An unbalanced tree is built twice as fast, and queried as fast on clouds like ours.
        tree = cKDTree(r[i, rows], compact_nodes=False, balanced_tree=False)
        threads = -1 if q.shape[1] > 4096 else 1  # starting them does not pay for a window
        indices[i, search[i]] = rows[tree.query(q[i, search[i]], workers=threads)[1]] + i * r.shape[1]
    flat = squared_distances(anp.reshape(queries, (-1, q.shape[2])), anp.reshape(references, (-1, r.shape[2])),
                             indices.ravel())
    return anp.reshape(flat, q.shape[:2])


# --- bilinear sampling (Eq. 3) ----------------------------------------------------------------------------

@primitive
def bilinear_sample(images, positions):
    """Image values at positions between pixels. Paper: Eq. (3), after spatial transformers.

    images (B, H, W, C) float; positions (B, h, w, 2) px, (x right, y down), pixel centres at whole numbers
    -> (B, h, w, C). Outside the picture it is the nearest border pixel (with gradient 0 to the position).
    cv2.remap does it; OpenCV 4 rounds positions to 1/32 px, OpenCV 5 only for float64 images.
    Raises ValueError for other shapes or positions that are not finite (OpenCV would silently read 0).
    """
    if images.ndim != 4 or positions.ndim != 4 or positions.shape[::3] != (len(images), 2) or not positions.size:
        raise ValueError("images, positions: expected (B, H, W, C) and (B, h, w, 2) with h, w >= 1, "
                         f"got {images.shape}, {positions.shape}")
    if not np.isfinite(positions).all():
        raise ValueError("positions: expected finite pixels, got NaN or infinity")
    x, y = _inside(images, positions)
    return np.stack([_remap(*each) for each in zip(images, x, y)])


def _inside(images, positions):
    """x and y of the positions moved into the picture, (B, h, w) float32 each."""
    return (np.clip(positions[..., axis], 0, images.shape[2 - axis] - 1).astype(np.float32) for axis in (0, 1))


def _remap(image, x, y):
    sampled = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(x.shape + image.shape[2:])  # OpenCV drops the axis of a single channel


def _bilinear_position_vjp(ans, images, positions):
    """Within a cell of four pixels the slope along x is the difference of its columns, interpolated along y alone."""
    def vjp(g):
        pull, ones = np.zeros_like(positions), np.ones(images.shape[3], g.dtype)
        for i, maps in enumerate(zip(*_inside(images, positions))):
            for axis, size in enumerate(images.shape[2:0:-1]):
                if size > 1:
                    cell = list(maps)
                    cell[axis] = np.minimum(np.floor(maps[axis]), size - 2)
                    slope = _remap(np.diff(images[i], axis=1 - axis), *cell)
                    slope *= g[i]
                    along = positions[i, ..., axis]
                    np.multiply(slope @ ones, (along >= 0) & (along <= size - 1), out=pull[i, ..., axis])
        return pull
    return vjp


def _bilinear_image_vjp(ans, images, positions):
    """Every position gives to the four pixels around it, by their shares."""
    batch, height, width, channels = images.shape
    x, y = _inside(images, positions)

    def vjp(g):
        result = np.zeros((batch * height * width, channels), images.dtype)
        for right in (0, 1):
            for below in (0, 1):
                column, row = np.minimum(np.floor(x) + right, width - 1), np.minimum(np.floor(y) + below, height - 1)
                share = (x % 1 if right else 1 - x % 1) * (y % 1 if below else 1 - y % 1)
                pixel = ((np.arange(batch)[:, None, None] * height + row) * width + column).astype(int).ravel()
                for c in range(channels):
                    result[:, c] += np.bincount(pixel, (g[..., c] * share).ravel(), len(result))
        return result.reshape(images.shape)
    return vjp


defvjp(bilinear_sample, _bilinear_image_vjp, _bilinear_position_vjp)


# --- the network's layers ---------------------------------------------------------------------------------------
#
# autograd's bookkeeping takes some 50 us per operation, there and back: as long as a layer of 48 units takes for 768
# points. So what belongs together is one operation here.

LEAK = np.float32(0.1)  # slope of the activation below 0: with 0 nine of ten units of the trunk die in a long run


@primitive
def dense(x, weights, bias, *, leaky=False, residual=False):
    """y = x W + b for every row; with leaky=True max(y, LEAK y), a leaky ReLU; with residual=True x is added to that.

    x (..., I), weights (I, O), bias (O,) or, for x (B, N, I), one per cloud, (B, O) -> (..., O).
    """
    y = np.matmul(x, weights)
    y += bias if bias.ndim == 1 else bias[:, None]
    if leaky:
        np.maximum(y, LEAK * y, out=y)
    if residual:
        y += x
    return y


def _dense_vjp(argnums, ans, args, kwargs):
    x, weights, bias = args
    leaky, residual = (kwargs.get(name, False) for name in ("leaky", "residual"))

    def vjp(g):
        through = g * np.maximum(ans > (x if residual else 0), g.dtype.type(LEAK)) if leaky else g
        rows = through.reshape(-1, through.shape[-1])

        def on_x():
            dx = np.matmul(through, weights.T)
            return np.add(dx, g, out=dx) if residual else dx

        def on_bias():  # a product with ones is faster than np.sum over the rows
            clouds = rows if bias.ndim == 1 else through
            return np.matmul(np.ones(clouds.shape[-2], g.dtype), clouds)
        gradients = (on_x, lambda: np.dot(x.reshape(-1, x.shape[-1]).T, rows), on_bias)
        return [gradients[argnum]() for argnum in argnums]
    return vjp


defvjp_argnums(dense, _dense_vjp)


@primitive
def take(x, key):
    """x[key], for slices or for indices of which none repeats.

    Its VJP adds into the gradient in place, where autograd's own uses the ten times slower np.add.at.
    """
    return x[key]


def _take_vjp(ans, x, key):
    space = vspace(x)

    def vjp(g):
        def add_to(gradient):
            gradient[key] += g
            return gradient
        return SparseObject(space, add_to)
    return vjp


defvjp(take, _take_vjp, None)


def at_rows(rows):
    """The key of the points `rows` (B, M) int of clouds (B, N, ...): clouds[at_rows(rows)] is (B, M, ...)."""
    return np.arange(len(rows))[:, None], rows


@primitive
def put_rows(clouds, rows, values):
    """The clouds (B, N, D) with their points `rows` (B, M) int, of which none repeats, replaced by values (B, M, D)."""
    result = clouds.copy()
    result[at_rows(rows)] = values
    return result


defvjp(put_rows, None, None, lambda ans, clouds, rows, values: lambda g: g[at_rows(rows)])


@primitive
def take_block(vector, start, shape):
    """vector[start:start + size] as an array of `shape`: one parameter of many."""
    return vector[start:start + math.prod(shape)].reshape(shape)


def _take_block_vjp(ans, vector, start, shape):
    space = vspace(vector)

    def vjp(g):
        def add_to(gradient):
            gradient[start:start + g.size] += g.ravel()
            return gradient
        return SparseObject(space, add_to)
    return vjp


defvjp(take_block, _take_block_vjp, None, None)


@primitive
def pool(x, valid, weights):
    """What a cloud holds: the maximum of every channel over the valid points, and weighted sums.

    x (B, N, C), valid (B, N) bool, weights (B, R, N) -> (B, (1 + R) C); the maximum is 0 where none is valid.
    Its gradient goes to every valid point that has it.
    """
    top = _top(x if valid.all() else np.where(valid[..., None], x, x.dtype.type(-np.inf)))
    top = np.where(valid.any(axis=1)[:, None], top, x.dtype.type(0))
    return np.concatenate([top, np.matmul(weights, x).reshape(len(x), -1)], axis=1)


def _top(x):
    """Maximum over the points, (B, N, C) -> (B, C), by halves (an odd middle twice): np.max is five times slower."""
    while x.shape[1] > 1:
        half = (x.shape[1] + 1) // 2
        x = np.maximum(x[:, :half], x[:, -half:])
    return x[:, 0]


def _pool_vjp(ans, x, valid, weights):
    def vjp(g):
        batch, _, channels = x.shape
        dx = np.matmul(np.swapaxes(weights, 1, 2), g[:, channels:].reshape(batch, -1, channels))
        won = x == ans[:, None, :channels]
        dx += (won if valid.all() else won & valid[..., None]) * g[:, None, :channels]
        return dx
    return vjp


defvjp(pool, _pool_vjp, None, None)


@primitive
def weighted_means(x, weights):
    """K weighted means of a cloud: sum_n w_nk x_n / (sum_n w_nk + 1e-3).  x (B, N, C), weights (B, N, K) -> (B, K, C).

    The 1e-3 keeps the mean under a mask that covers nothing finite, at 0.
    """
    return np.matmul(_shares(weights)[0], x)


def _shares(weights):
    """The weights over their sum (B, K, N), and the sum (B, 1, K): as a product, np.sum is slow along this axis."""
    total = np.matmul(np.ones((1, weights.shape[1]), weights.dtype), weights) + weights.dtype.type(1e-3)
    return np.swapaxes(weights / total, 1, 2), total


def _weighted_means_vjp(argnums, ans, args, kwargs):
    x, weights = args
    shares, total = _shares(weights)

    def vjp(g):
        gradients = (lambda: np.matmul(np.swapaxes(shares, 1, 2), g),
                     # a heavier point pulls the mean from where it was towards itself
                     lambda: (np.matmul(x, np.swapaxes(g, 1, 2)) - np.sum(ans * g, axis=2)[:, None]) / total)
        return [gradients[argnum]() for argnum in argnums]
    return vjp


defvjp_argnums(weighted_means, _weighted_means_vjp)


@primitive
def weighted_maxima(x, weights):
    """K weighted maxima of a cloud: max_n w_nk x_n, channel by channel.  x (B, N, C), weights (B, N, K) >= 0
    -> (B, K, C). The gradient goes to every point that has the maximum.
    """
    return np.stack([_top(x * weights[..., k:k + 1]) for k in range(weights.shape[2])], axis=1)


def _weighted_maxima_vjp(argnums, ans, args, kwargs):
    x, weights = args

    def vjp(g):
        dx, dw, ones = np.zeros_like(x), np.empty_like(weights), np.ones(x.shape[2], x.dtype)
        for k in range(weights.shape[2]):
            w = weights[..., k:k + 1]
            pull = (x * w == ans[:, None, k]) * g[:, None, k]
            dw[..., k] = (pull * x) @ ones
            pull *= w
            dx += pull
        return [(dx, dw)[argnum] for argnum in argnums]
    return vjp


defvjp_argnums(weighted_maxima, _weighted_maxima_vjp)


@primitive
def softmax(logits):
    """exp(z_k) / sum_k exp(z_k) over the last axis, safe for large logits."""
    top = reduce(np.maximum, np.moveaxis(logits, -1, 0))  # np.max and np.sum are slow along a short last axis
    e = np.exp(logits - top[..., None])
    return e / _sum_last(e)


def _sum_last(x):
    return np.matmul(x, np.ones((x.shape[-1], 1), x.dtype))


defvjp(softmax, lambda ans, logits: lambda g: ans * (g - _sum_last(g * ans)))


# --- steps between neighbouring pixels (Eq. 4, 5) ------------------------------------------------------------------

@primitive
def total_variation(field, across, down):
    """sum |f(x+1, y) - f(x, y)| across(x, y) + |f(x, y+1) - f(x, y)| down(x, y), over pixels and channels.

    field (B, H, W, C), weights across (B, H, W-1) and down (B, H-1, W) -> (B,).
    """
    dx = np.abs(np.diff(field, axis=2)) * across[..., None]
    dy = np.abs(np.diff(field, axis=1)) * down[..., None]
    return dx.sum(axis=(1, 2, 3)) + dy.sum(axis=(1, 2, 3))


def _total_variation_vjp(ans, field, across, down):
    def vjp(g):
        dx = np.sign(np.diff(field, axis=2)) * (g[:, None, None] * across)[..., None]
        dy = np.sign(np.diff(field, axis=1)) * (g[:, None, None] * down)[..., None]
        result = np.zeros_like(field)  # a step pulls at both its ends
        result[:, :, 1:] += dx
        result[:, :, :-1] -= dx
        result[:, 1:] += dy
        result[:, :-1] -= dy
        return result
    return vjp


defvjp(total_variation, _total_variation_vjp, None, None)
