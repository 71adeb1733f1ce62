"""The few operations whose derivative we write by hand, because autograd lacks it or is slow at it.

Each is an autograd primitive: a forward function in NumPy, SciPy or OpenCV and its VJP (vector-Jacobian
product: the gradient g of a scalar with respect to the output in, that with respect to each input out).
Everything else in the package is plain autograd. What the costly ones bring is in docs/speed.md.
"""
import math

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


def nearest_squared_distances(queries, references, valid):
    """Squared distance of every query to its nearest valid reference. Paper: Eq. (2), one direction.

    d_i = min_j |q_i - r_j|^2 with a SciPy KD-tree: O(N log N), where brute force is O(N M).
    queries (B, N, D), references (B, M, D), valid (B, M) bool -> (B, N), squared units of the input.
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
    found = np.zeros(q.shape[:2], bool)
    if q.shape == r.shape:  # who coincides with the reference of its own index need not ask: most points never moved
        found = valid & np.logical_and.reduce([q[..., axis] == r[..., axis] for axis in range(q.shape[2])])
    indices = np.arange(len(q))[:, None] * r.shape[1] + np.arange(q.shape[1])
    for i in range(len(q)):
        rows, asked = np.flatnonzero(valid[i]), ~found[i]
        # An unbalanced tree is built twice as fast, and queried as fast on clouds like ours.
        tree = cKDTree(r[i, rows], compact_nodes=False, balanced_tree=False)
        threads = -1 if q.shape[1] > 4096 else 1  # starting them does not pay for a small picture
        indices[i, asked] = rows[tree.query(q[i, asked], workers=threads)[1]] + i * r.shape[1]
    flat = squared_distances(anp.reshape(queries, (-1, q.shape[2])), anp.reshape(references, (-1, r.shape[2])),
                             indices.ravel())
    return anp.reshape(flat, q.shape[:2])


# --- bilinear sampling (Eq. 3) ----------------------------------------------------------------------------

@primitive
def bilinear_sample(images, positions):
    """Image values at positions between pixels. Paper: Eq. (3), after spatial transformers.

    images (B, H, W, C) float; positions (B, h, w, 2) px, (x right, y down), pixel centres at whole numbers
    -> (B, h, w, C). Outside the picture it is the nearest border pixel (with gradient 0 to the position).
    cv2.remap does it; OpenCV 4 rounds positions to 1/32 px, OpenCV 5 only for float64 images and for two channels or
    more than four. Raises ValueError for other shapes or positions that are not finite (OpenCV would silently read 0).
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
                    cell[axis] = np.floor(maps[axis])
                    slope = _remap(np.diff(images[i], axis=1 - axis), *cell)
                    slope *= g[i]
                    along = positions[i, ..., axis]
                    np.multiply(slope @ ones, (along >= 0) & (along <= size - 1), out=pull[i, ..., axis])
        return pull
    return vjp


defvjp(bilinear_sample, _bilinear_position_vjp, argnums=(1,))  # nothing learns from the picture's own gradient


# --- the network's layers ---------------------------------------------------------------------------------------

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
def max_over_points(x, valid):
    """The maximum of every channel over the valid points of a cloud, 0 where none is valid.

    x (B, N, C), valid (B, N) bool -> (B, C). Its gradient goes to every valid point that has the maximum.
    """
    top = np.where(valid[..., None], x, x.dtype.type(-np.inf))
    while top.shape[1] > 1:  # by halves (an odd middle twice): np.max is five times slower along this axis
        half = (top.shape[1] + 1) // 2
        top = np.maximum(top[:, :half], top[:, -half:])
    return np.where(valid.any(axis=1)[:, None], top[:, 0], x.dtype.type(0))


def _max_over_points_vjp(ans, x, valid):
    return lambda g: ((x == ans[:, None]) & valid[..., None]) * g[:, None]


defvjp(max_over_points, _max_over_points_vjp, None)


# --- parts of arrays ----------------------------------------------------------------------------------------------

@primitive
def take(x, key, shape=None):
    """x[key], for slices or for indices of which none repeats; with a shape, reshaped to it.

    Its VJP adds into the gradient in place, where autograd's own uses the ten times slower np.add.at.
    """
    return x[key] if shape is None else x[key].reshape(shape)


def _take_vjp(ans, x, key, shape=None):
    space = vspace(x)

    def vjp(g):
        def add_to(gradient):
            gradient[key] += g if shape is None else g.reshape(x[key].shape)
            return gradient
        return SparseObject(space, add_to)
    return vjp


defvjp(take, _take_vjp, None, None)


def at_rows(rows):
    """The key of the points `rows` (B, M) int of clouds (B, N, ...): clouds[at_rows(rows)] is (B, M, ...)."""
    return np.arange(len(rows))[:, None], rows


@primitive
def put_rows(clouds, rows, values):
    """The clouds (B, N, D) with their points `rows` (B, M) int, of which none repeats, replaced by values (B, M, D).

    Only `values` has a derivative.
    """
    result = clouds.copy()
    result[at_rows(rows)] = values
    return result


defvjp(put_rows, None, None, lambda ans, clouds, rows, values: lambda g: g[at_rows(rows)])


def unflatten(vector, layout):
    """One vector (P,) of all parameters -> dict of arrays, views of it; `layout` gives names and shapes.

    We differentiate by one vector: autograd's gradient of a dict copies the dict once per access, which
    costs more than all layers of a small network.
    """
    result, start = {}, 0
    for name, shape in layout.items():
        size = math.prod(shape)
        result[name] = take(vector, slice(start, start + size), shape)
        start += size
    return result
