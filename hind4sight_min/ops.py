"""The operations whose derivative we write by hand: nearest neighbours, bilinear sampling, fused layers.

Each is an autograd primitive: a forward function in NumPy, SciPy or OpenCV and its VJP (vector-Jacobian
product: the gradient g of a scalar with respect to the output in, that with respect to each input out).
"""
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
    return np.sum(difference * difference, axis=1)


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
    indices = np.empty(q.shape[:2], int)
    for i in range(len(q)):
        rows = np.flatnonzero(valid[i])
        # An unbalanced tree is built twice as fast, and queried as fast on clouds like ours.
        tree = cKDTree(r[i, rows], compact_nodes=False, balanced_tree=False)
        indices[i] = rows[tree.query(q[i])[1]] + i * r.shape[1]
    flat = squared_distances(anp.reshape(queries, (-1, q.shape[2])), anp.reshape(references, (-1, r.shape[2])),
                             indices.ravel())
    return anp.reshape(flat, q.shape[:2])


# --- bilinear sampling (Eq. 3) ----------------------------------------------------------------------------

@primitive
def bilinear_sample(images, positions):
    """Image values at positions between pixels. Paper: Eq. (3), after spatial transformers.

    images (B, H, W, C) float; positions (B, N, 2) px, (x right, y down), pixel centres at whole numbers
    -> (B, N, C). Outside the picture it is the nearest border pixel (with gradient 0 to the position).
    cv2.remap does it; OpenCV 4 rounds positions to 1/32 px, OpenCV 5 only for float64 images.
    Raises ValueError for other shapes or positions that are not finite (OpenCV would silently read 0).
    """
    if images.ndim != 4 or positions.ndim != 3 or positions.shape[::2] != (len(images), 2) or not positions.size:
        raise ValueError("images, positions: expected (B, H, W, C) and (B, N, 2) with N >= 1, "
                         f"got {images.shape}, {positions.shape}")
    if not np.isfinite(positions).all():
        raise ValueError("positions: expected finite pixels, got NaN or infinity")
    batch, height, width, channels = images.shape
    count = positions.shape[1]
    last = np.array([width - 1, height - 1], positions.dtype)
    maps = np.clip(positions, 0, last).astype(np.float32)
    # remap wants a picture of positions, at most 32767 a side: fold the list into rows of 1024.
    maps = np.pad(maps, ((0, 0), (0, -count % 1024), (0, 0))).reshape(batch, -1, 1024, 2)
    sampled = [cv2.remap(image, xy, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
               for image, xy in zip(images, maps)]
    return np.stack(sampled).reshape(batch, -1, channels)[:, :count]


def _corners(images, positions):
    """Flat indices of the four pixels around each position, (4, B, N), and the fractions (B, N, 1) in the cell."""
    batch, height, width, _ = images.shape
    x = np.clip(positions[..., 0], 0, width - 1)
    y = np.clip(positions[..., 1], 0, height - 1)
    x0, y0 = np.minimum(x.astype(int), max(width - 2, 0)), np.minimum(y.astype(int), max(height - 2, 0))
    first = (np.arange(batch)[:, None] * height + y0) * width + x0
    right, down = (1 if width > 1 else 0), (width if height > 1 else 0)
    a, b = ((v - v0).astype(images.dtype)[..., None] for v, v0 in ((x, x0), (y, y0)))
    return np.stack([first, first + right, first + down, first + right + down]), a, b


def _bilinear_position_vjp(ans, images, positions):
    height, width, channels = images.shape[1:]
    corners, a, b = _corners(images, positions)
    i00, i10, i01, i11 = images.reshape(-1, channels)[corners]
    along_x = (1 - b) * (i10 - i00) + b * (i11 - i01)
    along_y = (1 - a) * (i01 - i00) + a * (i11 - i10)
    inside = (positions >= 0) & (positions <= [width - 1, height - 1])

    def vjp(g):
        pull = np.stack([np.sum(g * along_x, axis=-1), np.sum(g * along_y, axis=-1)], axis=-1)
        return (pull * inside).astype(positions.dtype)
    return vjp


def _bilinear_image_vjp(ans, images, positions):
    corners, a, b = _corners(images, positions)
    weights = ((1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b)

    def vjp(g):
        result = np.zeros((images.size // images.shape[3], images.shape[3]), images.dtype)
        for corner, weight in zip(corners, weights):
            for c in range(images.shape[3]):
                result[:, c] += np.bincount(corner.ravel(), (g * weight)[..., c].ravel(), len(result))
        return result.reshape(images.shape)
    return vjp


defvjp(bilinear_sample, _bilinear_image_vjp, _bilinear_position_vjp)


# --- fused network operations (speed: a cloud's features stay in the cache between the steps) --------------------

@primitive
def dense_relu(x, weights, bias):
    """max(x W + b, 0) for every point.  x (B, N, I), weights (I, O), bias (O,) or (B, O) -> (B, N, O)."""
    y = np.empty(x.shape[:2] + weights.shape[1:], x.dtype)
    for i in range(len(x)):
        np.dot(x[i], weights, out=y[i])
        y[i] += bias if bias.ndim == 1 else bias[i]
        np.maximum(y[i], 0, out=y[i])
    return y


def _dense_relu_vjp(argnums, ans, args, kwargs):
    x, weights, bias = args

    def vjp(g):
        dx = np.empty_like(x) if 0 in argnums else None
        dw, db = np.zeros_like(weights), np.empty((len(x), weights.shape[1]), g.dtype)
        ones = np.ones(x.shape[1], g.dtype)
        for i in range(len(x)):
            through = g[i] * (ans[i] > 0)  # shared by the three inputs
            if dx is not None:
                np.dot(through, weights.T, out=dx[i])
            dw += np.dot(x[i].T, through)
            np.dot(ones, through, out=db[i])  # the sum over points; BLAS is faster at it than np.sum
        gradients = (dx, dw, db.sum(axis=0) if bias.ndim == 1 else db)
        return [gradients[argnum] for argnum in argnums]
    return vjp


defvjp_argnums(dense_relu, _dense_relu_vjp)


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


def max_pool(x, valid):
    """Maximum over the valid points.  x (B, N, C) >= 0, valid (B, N) bool -> (B, C); 0 where none is valid."""
    value = getval(x)
    winners = np.argmax(value if valid.all() else value * valid[..., None], axis=1)  # (B, C)
    cloud, channel = np.ogrid[:value.shape[0], :value.shape[2]]
    return take(x, (cloud, winners, channel)) * valid[cloud, winners]


@primitive
def softmax(logits):
    """exp(z_k) / sum_k exp(z_k) over the last axis, safe for large logits."""
    e = np.exp(logits - np.max(logits, axis=-1, keepdims=True))
    return e / np.sum(e, axis=-1, keepdims=True)


defvjp(softmax, lambda ans, logits: lambda g: ans * (g - np.sum(g * ans, axis=-1, keepdims=True)))
