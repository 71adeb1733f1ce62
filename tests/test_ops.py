"""Nearest neighbours, bilinear sampling layers and differences: values and gradients."""
import autograd.numpy as anp
import cv2
import numpy as np
import pytest
import scipy.special
from autograd import elementwise_grad, grad
from autograd.test_util import check_grads
from scipy.ndimage import map_coordinates

from hind4sight_min import ops
from hind4sight_min.ops import (dense, nearest_squared_distances, pool, put_rows, softmax, squared_distances,
                                take, take_block, total_variation, weighted_maxima, weighted_means)

CV2_MAJOR = int(cv2.__version__.split(".")[0])


def pulled_back(function, argnum, g, *args):
    """Gradient of sum(g * function(*args)) with respect to one argument."""
    return grad(lambda *args: anp.sum(g * function(*args)), argnum)(*args)


# --- nearest neighbours -----------------------------------------------------------------------------------

def test_squared_distances_and_gradients_when_references_are_shared_or_unused():
    rng = np.random.default_rng(0)
    queries, references, g = rng.normal(size=(4, 3)), rng.normal(size=(5, 3)), rng.normal(size=4)
    indices = np.array([2, 0, 2, 2])  # 2 collects from three queries; 1, 3 and 4 are nobody's neighbour
    value = squared_distances(queries, references, indices)
    expected, dq, dr = np.zeros(4), np.zeros((4, 3)), np.zeros((5, 3))
    for i, j in enumerate(indices):
        difference = queries[i] - references[j]
        expected[i] = difference @ difference
        dq[i] = 2 * g[i] * difference
        dr[j] -= 2 * g[i] * difference
    assert value.shape == (4,)
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    for argnum, wanted in ((0, dq), (1, dr)):
        found = pulled_back(squared_distances, argnum, g, queries, references, indices)
        assert found.shape == wanted.shape
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
    check_grads(squared_distances, (0, 1), modes=["rev"], order=1)(queries, references, indices)


def brute_force(queries, references, valid):
    """All pairs; -> squared distances (B, N) and the index of each query's nearest valid reference."""
    pairs = ((queries[:, :, None] - references[:, None]) ** 2).sum(axis=3)
    pairs[np.broadcast_to(~valid[:, None], pairs.shape)] = np.inf
    return pairs.min(axis=2), pairs.argmin(axis=2)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_nearest_squared_distances_match_brute_force(dimensions, share):
    # Eq. (2), one direction
    rng = np.random.default_rng(1)
    queries, references = rng.normal(size=(3, 20, dimensions)), rng.normal(size=(3, 14, dimensions))
    valid = rng.random((3, 14)) < share
    g = rng.normal(size=(3, 20))
    value = nearest_squared_distances(queries, references, valid)
    expected, nearest = brute_force(queries, references, valid)
    assert value.shape == (3, 20)
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    dq, dr = np.zeros_like(queries), np.zeros_like(references)
    for b, i in np.ndindex(3, 20):
        pull = 2 * g[b, i] * (queries[b, i] - references[b, nearest[b, i]])
        dq[b, i] = pull
        dr[b, nearest[b, i]] -= pull
    for argnum, wanted in ((0, dq), (1, dr)):
        found = pulled_back(nearest_squared_distances, argnum, g, queries, references, valid)
        assert found.shape == wanted.shape
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
    assert not dr[~valid].any() and dr[valid].any()
    # No two references are equally near, so the neighbours do not change within a finite difference.
    check_grads(nearest_squared_distances, (0, 1), modes=["rev"], order=1)(queries, references, valid)


def test_an_invalid_reference_is_ignored_even_where_it_is_the_nearest():
    queries = np.array([[[1.0, 0, 0], [0, 2, 0]]])
    references = np.array([[[1.0, 0, 0], [4, 0, 0], [0, 2, 0.1]]])  # the first and the last sit on the queries
    valid = np.array([[False, True, False]])
    value = nearest_squared_distances(queries, references, valid)
    np.testing.assert_allclose(value, [[9, 20]])
    gradient = pulled_back(nearest_squared_distances, 1, 1.0, queries, references, valid)
    np.testing.assert_allclose(gradient, [[[0, 0, 0], [2 * 3 + 2 * 4, -2 * 2, 0], [0, 0, 0]]])


def test_the_clouds_of_a_batch_do_not_see_each_other():
    queries = np.array([[[0.0, 0, 0]], [[5, 0, 0]]])
    references = queries[::-1] + [0, 1, 0]  # the other cloud's reference would be nearer
    value = nearest_squared_distances(queries, references, np.ones((2, 1), bool))
    np.testing.assert_allclose(value, [[26], [26]])
    gradient = pulled_back(nearest_squared_distances, 1, np.array([[1.0], [3.0]]), queries, references,
                           np.ones((2, 1), bool))
    np.testing.assert_allclose(gradient, [[[10, 2, 0]], [[-30, 6, 0]]])


@pytest.mark.parametrize("queries, references, valid", [
    ((5, 3), (2, 4, 3), (2, 4)), ((2, 5, 3), (4, 3), (2, 4)), ((2, 5, 3), (3, 4, 3), (3, 4)),
    ((2, 5, 3), (2, 4, 2), (2, 4)), ((2, 5, 3), (2, 4, 3), (2, 5)), ((2, 5, 3), (2, 4, 3), (2, 4, 1)),
    ((2, 5), (2, 4), (2, 4)), ((2, 5, 3, 1), (2, 4, 3), (2, 4)), ((2, 5, 3), (2, 4, 3, 1), (2, 4))])
def test_nearest_squared_distances_refuse_other_shapes(queries, references, valid):
    with pytest.raises(ValueError, match="queries, references, valid"):
        nearest_squared_distances(np.ones(queries), np.ones(references), np.ones(valid, bool))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("which", [0, 1])
def test_nearest_squared_distances_refuse_points_that_are_not_finite(which, bad):
    clouds = [np.ones((2, 5, 3)), np.ones((2, 4, 3))]
    clouds[which][1, 2, 0] = bad
    with pytest.raises(ValueError, match=("queries", "references")[which] + ".*finite"):
        nearest_squared_distances(*clouds, np.ones((2, 4), bool))


def test_nearest_squared_distances_refuse_a_cloud_without_a_valid_reference():
    valid = np.array([[True, False], [False, False]])  # the second cloud has none
    with pytest.raises(ValueError, match="valid"):
        nearest_squared_distances(np.ones((2, 5, 3)), np.ones((2, 2, 3)), valid)


# --- bilinear sampling ------------------------------------------------------------------------------------

def bilinear_sample(images, positions):
    """ops.bilinear_sample of a list of positions (B, N, 2) -> (B, N, C)."""
    return anp.reshape(ops.bilinear_sample(images, anp.reshape(positions, positions.shape[:2] + (1, 2))),
                       positions.shape[:2] + images.shape[3:])


def interpolated(images, positions):
    """The oracle: SciPy's linear interpolation with the border repeated."""
    sampled = [[map_coordinates(image[..., c], xy.T[::-1].astype(float), order=1, mode="nearest")
                for c in range(image.shape[2])] for image, xy in zip(images, positions)]
    return np.moveaxis(np.array(sampled), 1, 2)


def grid_positions(rng, batch, count, low, high):
    """Random positions that are multiples of 1/32 px, where every OpenCV samples exactly."""
    return rng.integers(np.multiply(low, 32), np.multiply(high, 32), (batch, count, 2), endpoint=True) / 32


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_bilinear_sample_on_the_grid_of_1_32_matches_scipy_exactly(dtype, channels):
    # Eq. (3)
    rng = np.random.default_rng(2)
    images = rng.random((2, 5, 7, channels)).astype(dtype)
    positions = grid_positions(rng, 2, 60, (-3, -3), (9, 7)).astype(dtype)  # inside and outside
    value = bilinear_sample(images, positions)
    assert value.shape == (2, 60, channels) and value.dtype == dtype
    np.testing.assert_allclose(value, interpolated(images, positions), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bilinear_sample_at_arbitrary_positions_matches_scipy(dtype):
    # Eq. (3)
    rng = np.random.default_rng(3)
    images = rng.random((2, 5, 7, 3)).astype(dtype)
    positions = rng.uniform((-2, -2), (8, 6), (2, 80, 2)).astype(dtype)
    value = bilinear_sample(images, positions)
    # Where positions are rounded to 1/32 px: half of that, along x and along y, on slopes of at most 1 per px.
    exact = CV2_MAJOR >= 5 and dtype == np.float32
    assert value.shape == (2, 80, 3)
    np.testing.assert_allclose(value, interpolated(images, positions), rtol=0, atol=1e-5 if exact else 1 / 32)


@pytest.mark.parametrize("shape", [(1, 1), (3, 8), (8, 3), (1, 2500)])
def test_bilinear_sample_keeps_the_order_of_the_picture_of_positions(shape):
    rng = np.random.default_rng(4)
    images = rng.random((2, 4, 6, 2))
    positions = grid_positions(rng, 2, shape[0] * shape[1], (0, 0), (5, 3))
    value = ops.bilinear_sample(images, positions.reshape(2, *shape, 2))
    assert value.shape == (2, *shape, 2)
    np.testing.assert_allclose(value.reshape(2, -1, 2), interpolated(images, positions), rtol=0, atol=1e-6)


def test_bilinear_sample_at_whole_half_and_border_positions():
    images = np.arange(1.0, 13).reshape(1, 3, 4, 1) ** 2  # rows 1 4 9 16, 25 36 49 64, 81 100 121 144
    positions = np.array([[[1, 0], [2, 1], [0.5, 0], [1, 0.5], [1.5, 1.5],
                           [0, 0], [3, 0], [0, 2], [3, 2], [2.5, 2], [3, 1.5]]])
    expected = [4, 49, (1 + 4) / 2, (4 + 36) / 2, (36 + 49 + 100 + 121) / 4,
                1, 16, 81, 144, (121 + 144) / 2, (64 + 144) / 2]
    np.testing.assert_allclose(bilinear_sample(images, positions)[0, :, 0], expected, rtol=1e-6)


def test_outside_the_picture_the_border_is_repeated():
    images = np.arange(1.0, 13).reshape(1, 3, 4, 1) ** 2
    positions = np.array([[[-5, 1.5], [1e6, 1.5], [0.5, -0.25], [0.5, 99], [-1, -1], [4, 3], [-7, 50]]])
    value = bilinear_sample(images, positions)
    np.testing.assert_allclose(value[0, :, 0], [(25 + 81) / 2, (64 + 144) / 2, 2.5, 90.5, 1, 144, 81], rtol=1e-6)
    gradient = elementwise_grad(bilinear_sample, 1)(images, positions)
    # No slope across the border; along it the picture still has one.
    np.testing.assert_allclose(gradient[0], [[0, 81 - 25], [0, 144 - 64], [3, 0], [19, 0], [0, 0], [0, 0], [0, 0]])
    on_border = elementwise_grad(bilinear_sample, 0)(images, positions)
    expected = np.zeros((3, 4))
    for (row, column), weight in {(1, 0): 0.5, (2, 0): 0.5 + 0.5 + 1, (1, 3): 0.5, (2, 3): 0.5 + 1,
                                  (0, 0): 0.5 + 1, (0, 1): 0.5, (2, 1): 0.5}.items():
        expected[row, column] = weight
    np.testing.assert_allclose(on_border[0, :, :, 0], expected)


def test_bilinear_position_gradient_matches_central_differences():
    # Eq. (3)
    rng = np.random.default_rng(5)
    images, g = rng.random((2, 5, 7, 3)), rng.normal(size=(2, 30, 3))
    cells = rng.integers((-1, -1), (8, 6), (2, 30, 2))  # some of them outside
    positions = cells + rng.integers(2, 31, (2, 30, 2)) / 32  # one step of 1/32 px stays in the cell
    found = pulled_back(bilinear_sample, 1, g, images, positions)
    assert found.shape == positions.shape
    for axis in range(2):
        step = np.eye(2)[axis] / 32
        difference = bilinear_sample(images, positions + step) - bilinear_sample(images, positions - step)
        np.testing.assert_allclose(found[..., axis], (g * difference).sum(axis=2) * 16, rtol=0, atol=1e-5)
    inside = ((positions > 0) & (positions < [6, 4])).all(axis=2)
    assert 5 < inside.sum() < 55 and np.abs(found[inside]).min() > 1e-4


@pytest.mark.parametrize("position, step", [((2, 1), (1, 1)), ((0, 0), (1, 1)), ((6, 4), (-1, -1)),
                                            ((6, 2), (-1, 1)), ((3, 4), (1, -1))])
def test_bilinear_position_gradient_on_a_whole_pixel_is_that_of_a_cell_beside_it(position, step):
    # To the right and below; on the last column or row the last cell of the picture, never beyond it.
    rng = np.random.default_rng(6)
    images, positions = rng.random((1, 5, 7, 1)), np.array([[position]], float)
    found = elementwise_grad(bilinear_sample, 1)(images, positions)[0, 0]
    for axis in range(2):
        one = step[axis] * np.eye(2)[axis]  # bilinear, so a whole pixel is as good as a small step
        difference = bilinear_sample(images, positions + one) - bilinear_sample(images, positions)
        np.testing.assert_allclose(found[axis], difference[0, 0, 0] * step[axis], rtol=0, atol=1e-5)
        assert abs(found[axis]) > 0.01


def test_bilinear_image_gradient_matches_explicit_weights_and_finite_differences():
    # Eq. (3)
    rng = np.random.default_rng(7)
    images, g = rng.random((2, 4, 5, 2)), rng.normal(size=(2, 25, 2))
    positions = grid_positions(rng, 2, 25, (-1, -1), (5, 4))  # more positions than pixels: they add up
    found = pulled_back(bilinear_sample, 0, g, images, positions)
    expected = np.zeros_like(images)
    for b, n in np.ndindex(2, 25):
        x, y = np.clip(positions[b, n], 0, [4, 3])
        for row, column in np.ndindex(4, 5):  # the hat function around each pixel
            expected[b, row, column] += max(0, 1 - abs(x - column)) * max(0, 1 - abs(y - row)) * g[b, n]
    assert found.shape == images.shape
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    check_grads(bilinear_sample, modes=["rev"], order=1)(images, positions)


@pytest.mark.parametrize("height, width", [(4, 1), (1, 5), (1, 1)])
def test_bilinear_sample_of_a_picture_one_pixel_wide_or_high(height, width):
    rng = np.random.default_rng(8)
    images, g = rng.random((2, height, width, 2)), rng.normal(size=(2, 12, 2))
    cells = rng.integers((-1, -1), (width, height), (2, 12, 2), endpoint=True)
    positions = cells + rng.integers(2, 31, (2, 12, 2)) / 32
    value = bilinear_sample(images, positions)
    assert value.shape == (2, 12, 2)
    np.testing.assert_allclose(value, interpolated(images, positions), rtol=0, atol=1e-6)
    check_grads(bilinear_sample, modes=["rev"], order=1)(images, positions)
    found = pulled_back(bilinear_sample, 1, g, images, positions)
    for axis in range(2):
        step = np.eye(2)[axis] / 32
        difference = bilinear_sample(images, positions + step) - bilinear_sample(images, positions - step)
        np.testing.assert_allclose(found[..., axis], (g * difference).sum(axis=2) * 16, rtol=0, atol=1e-5)
    assert bool(found[..., 0].any()) is (width > 1) and bool(found[..., 1].any()) is (height > 1)


@pytest.mark.parametrize("images, positions", [
    ((4, 5, 3), (2, 6, 1, 2)), ((2, 4, 5, 3), (2, 6, 2)), ((2, 4, 5, 3), (2, 6, 1, 3)), ((2, 4, 5, 3), (3, 6, 1, 2)),
    ((2, 4, 5, 3), (2, 0, 5, 2))])
def test_bilinear_sample_refuses_other_shapes(images, positions):
    with pytest.raises(ValueError, match="images, positions"):
        ops.bilinear_sample(np.ones(images), np.ones(positions))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bilinear_sample_refuses_positions_that_are_not_finite(bad):
    positions = np.ones((2, 6, 2))
    positions[1, 3, 0] = bad  # OpenCV would read 0 there and say nothing
    with pytest.raises(ValueError, match="positions.*finite"):
        bilinear_sample(np.ones((2, 4, 5, 3)), positions)


# --- the network's layers ---------------------------------------------------------------------------------

@pytest.mark.parametrize("leaky", [False, True])
@pytest.mark.parametrize("shape, per_cloud", [((3, 5, 4), False), ((3, 5, 4), True), ((7, 4), False)])
def test_dense_and_its_gradients_match_numpy(shape, per_cloud, leaky):
    rng = np.random.default_rng(9)
    x, weights, bias = rng.normal(size=shape), rng.normal(size=(4, 6)), rng.normal(size=(3, 6) if per_cloud else 6)
    g = rng.normal(size=shape[:-1] + (6,))

    def layer(x, weights, bias):
        return dense(x, weights, bias, leaky=leaky)
    before = np.einsum("...i,io->...o", x, weights) + (bias[:, None] if per_cloud else bias)
    value = layer(x, weights, bias)
    assert value.shape == g.shape
    after = np.where(before > 0, before, ops.LEAK * before) if leaky else before
    np.testing.assert_allclose(value, after, rtol=0, atol=1e-12)
    through = g * (np.where(before > 0, 1, ops.LEAK) if leaky else 1)
    assert 0.2 < (before > 0).mean() < 0.8  # both sides of the kink
    flat = through.reshape(-1, 6)
    expected = (np.einsum("...o,io->...i", through, weights), np.einsum("no,ni->io", flat, x.reshape(-1, 4)),
                through.sum(axis=1) if per_cloud else flat.sum(axis=0))
    together = grad(lambda args: anp.sum(g * layer(*args)))((x, weights, bias))
    for argnum, wanted in enumerate(expected):
        alone = pulled_back(layer, argnum, g, x, weights, bias)
        for found in (alone, together[argnum]):
            assert found.shape == wanted.shape
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
    check_grads(layer, (0, 1, 2), modes=["rev"], order=1)(x, weights, bias)


def test_a_residual_layer_adds_its_input():
    rng = np.random.default_rng(22)
    x, weights, bias = rng.normal(size=(3, 5, 4)), rng.normal(size=(4, 4)), rng.normal(size=(3, 4))
    g = rng.normal(size=(3, 5, 4))
    args = (x, weights, bias)

    def residual(*args):
        return dense(*args, leaky=True, residual=True)

    def plain(*args):
        return args[0] + dense(*args, leaky=True)
    np.testing.assert_allclose(residual(*args), plain(*args), rtol=1e-12)
    for argnum in range(3):
        np.testing.assert_allclose(pulled_back(residual, argnum, g, *args), pulled_back(plain, argnum, g, *args),
                                   rtol=0, atol=1e-12)
    check_grads(residual, (0, 1, 2), modes=["rev"], order=1)(*args)


def test_dense_changes_none_of_its_inputs():
    rng = np.random.default_rng(10)
    inputs = [rng.normal(size=shape) for shape in ((2, 3, 4), (4, 5), (2, 5))]
    copies = [value.copy() for value in inputs]
    dense(*inputs, leaky=True)
    pulled_back(lambda *args: dense(*args, leaky=True), 0, 1.0, *inputs)
    for value, copy in zip(inputs, copies):
        np.testing.assert_array_equal(value, copy)


def test_take_block_and_its_gradient():
    rng = np.random.default_rng(21)
    vector, g = rng.normal(size=11), rng.normal(size=(2, 3))
    np.testing.assert_array_equal(take_block(vector, 4, (2, 3)), vector[4:10].reshape(2, 3))
    np.testing.assert_array_equal(pulled_back(take_block, 0, g, vector, 4, (2, 3)), [0] * 4 + [*g.ravel()] + [0])
    twice = grad(lambda v: anp.sum(take_block(v, 4, (2, 3)) * g) + 2 * anp.sum(take_block(v, 8, (3,))))(vector)
    np.testing.assert_allclose(twice, np.r_[[0] * 4, g.ravel(), 0] + np.r_[[0] * 8, 2, 2, 2])


def test_put_rows_and_its_gradient():
    rng = np.random.default_rng(23)
    clouds, values, g = (rng.normal(size=(2, count, 3)) for count in (5, 2, 5))
    rows = np.array([[4, 1], [0, 3]])
    found, kept = put_rows(clouds, rows, values), clouds.copy()
    for b in range(2):
        for n in range(5):
            expected = values[b, list(rows[b]).index(n)] if n in rows[b] else clouds[b, n]
            np.testing.assert_array_equal(found[b, n], expected)
    np.testing.assert_array_equal(clouds, kept)  # a copy
    check_grads(lambda v: put_rows(clouds, rows, v) * g, modes=["rev"])(values)


@pytest.mark.parametrize("key", [
    slice(1, 3), slice(None, None, -2), (slice(None), slice(None, -1)), (..., slice(2, 3)), (..., 1), 2,
    (slice(None), slice(1, None), slice(0, 2)), (np.array([3, 0]), np.array([1, 4])),
    (np.array([[3], [0]]), np.array([[1, 4]]), slice(1, 3)), np.array([2, 0, 3])])
def test_take_and_its_gradient(key):
    rng = np.random.default_rng(11)
    x = rng.normal(size=(4, 5, 3))
    value = take(x, key)
    assert value.shape == x[key].shape
    np.testing.assert_array_equal(value, x[key])
    g = rng.normal(size=value.shape)
    expected = np.zeros_like(x)
    expected[key] = g
    found = pulled_back(take, 0, g, x, key)
    assert found.shape == x.shape
    np.testing.assert_array_equal(found, expected)
    check_grads(take, modes=["rev"], order=1)(x, key)


def test_gradients_of_overlapping_takes_add_up():
    x = np.random.default_rng(12).normal(size=5)
    gradient = grad(lambda x: anp.sum(take(x, slice(1, None)) ** 2) + 3 * anp.sum(take(x, slice(None, 3)))
                    + anp.sum(x * x))(x)
    np.testing.assert_allclose(gradient, 2 * x + 2 * x * [0, 1, 1, 1, 1] + [3, 3, 3, 0, 0], rtol=1e-12)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_pool_and_its_gradient_match_a_loop(share):
    rng = np.random.default_rng(13)
    x, valid, weights = rng.random((3, 6, 4)) - 0.5, rng.random((3, 6)) < share, rng.random((3, 2, 6))
    x[..., 0] -= 1  # a channel without anything positive
    x[~valid] += 5  # the largest of all, were they counted
    g = rng.normal(size=(3, 12))
    value, expected, gradient = pool(x, valid, weights), np.zeros((3, 12)), np.zeros_like(x)
    for b, c in np.ndindex(3, 4):
        rows = np.flatnonzero(valid[b])
        winner = rows[np.argmax(x[b, rows, c])]
        expected[b, c] = x[b, winner, c]
        gradient[b, winner, c] += g[b, c]
        for r in range(2):
            expected[b, 4 * (r + 1) + c] = weights[b, r] @ x[b, :, c]
            gradient[b, :, c] += weights[b, r] * g[b, 4 * (r + 1) + c]
    assert value.shape == (3, 12)
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    found = pulled_back(pool, 0, g, x, valid, weights)
    assert found.shape == x.shape
    np.testing.assert_allclose(found, gradient, rtol=0, atol=1e-12)
    check_grads(pool, modes=["rev"], order=1)(x, valid, weights)


def test_equal_maxima_all_have_the_gradient():
    x, valid = np.array([[[2.0], [2.0], [1.0]]]), np.ones((1, 3), bool)
    gradient = pulled_back(pool, 0, np.array([[3.0, 0.0]]), x, valid, np.ones((1, 1, 3)))
    np.testing.assert_array_equal(gradient[0, :, 0], [3, 3, 0])


def test_the_maximum_is_zero_with_zero_gradient_where_nothing_is_valid():
    x, weights = np.random.default_rng(14).random((2, 3, 4)) + 1, np.zeros((2, 1, 3))
    valid = np.array([[False, False, False], [False, True, False]])
    expected = np.zeros_like(x)
    expected[1, 1] = 1
    np.testing.assert_array_equal(pool(x, valid, weights)[:, :4], [np.zeros(4), x[1, 1]])
    np.testing.assert_array_equal(pulled_back(pool, 0, 1.0, x, valid, weights), expected)


def test_the_maximum_of_zeros_is_not_that_of_an_invalid_point():
    x, weights = np.zeros((1, 3, 2)), np.zeros((1, 1, 3))
    x[0, 0] = 7  # invalid, first, and as large as the valid ones once masked
    valid = np.array([[False, True, True]])
    np.testing.assert_array_equal(pool(x, valid, weights), [[0, 0, 0, 0]])
    assert not pulled_back(pool, 0, 1.0, x, valid, weights)[0, 0].any()


def test_weighted_means_and_their_gradients_match_autograd_of_the_plain_formula():
    rng = np.random.default_rng(23)
    x, weights, g = rng.normal(size=(2, 6, 4)), rng.random((2, 6, 3)), rng.normal(size=(2, 3, 4))

    def plain(x, weights):
        total = anp.sum(weights, axis=1) + 1e-3
        return anp.einsum("bnk,bnc->bkc", weights, x) / total[..., None]
    np.testing.assert_allclose(weighted_means(x, weights), plain(x, weights), rtol=1e-12)
    for argnum in (0, 1):
        found = pulled_back(weighted_means, argnum, g, x, weights)
        np.testing.assert_allclose(found, pulled_back(plain, argnum, g, x, weights), rtol=0, atol=1e-12)
        assert np.abs(found).min() > 1e-5
    check_grads(weighted_means, (0, 1), modes=["rev"], order=1)(x, weights)
    np.testing.assert_array_equal(weighted_means(x, 0 * weights), np.zeros((2, 3, 4)))  # under an empty mask


def test_weighted_maxima_and_their_gradients_match_autograd_of_the_plain_formula():
    rng = np.random.default_rng(24)
    x, weights, g = rng.random((2, 7, 4)) - 0.3, rng.random((2, 7, 3)), rng.normal(size=(2, 3, 4))

    def plain(x, weights):
        return anp.max(weights[..., None] * x[:, :, None], axis=1)
    np.testing.assert_array_equal(weighted_maxima(x, weights), plain(x, weights))
    for argnum in (0, 1):
        found = pulled_back(weighted_maxima, argnum, g, x, weights)
        np.testing.assert_allclose(found, pulled_back(plain, argnum, g, x, weights), rtol=0, atol=1e-12)
        assert np.count_nonzero(np.abs(found) > 1e-5) >= 12  # a point for every mask and channel, some for several
    check_grads(weighted_maxima, (0, 1), modes=["rev"], order=1)(x, weights)
    np.testing.assert_array_equal(weighted_maxima(x, 0 * weights), np.zeros((2, 3, 4)))  # under an empty mask


def test_equal_weighted_maxima_all_have_the_gradient():
    x, weights = np.array([[[2.0], [4.0], [1.0]]]), np.array([[[1.0], [0.5], [1.0]]])
    np.testing.assert_array_equal(pulled_back(weighted_maxima, 0, 3.0, x, weights)[0, :, 0], [3, 1.5, 0])
    np.testing.assert_array_equal(pulled_back(weighted_maxima, 1, 3.0, x, weights)[0, :, 0], [6, 12, 0])


def test_softmax_and_its_gradient_match_scipy_and_finite_differences():
    rng = np.random.default_rng(15)
    logits, g = rng.normal(size=(2, 5, 4)), rng.normal(size=(2, 5, 4))
    value = softmax(logits)
    assert value.shape == logits.shape
    np.testing.assert_allclose(value, scipy.special.softmax(logits, axis=-1), rtol=1e-12)
    found = pulled_back(softmax, 0, g, logits)
    assert found.shape == logits.shape
    for index in np.ndindex(2, 5):
        p = value[index]
        np.testing.assert_allclose(found[index], (np.diag(p) - np.outer(p, p)) @ g[index], rtol=0, atol=1e-14)
    check_grads(softmax, modes=["rev"], order=1)(logits)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shift", [1e4, -1e4])
def test_softmax_of_huge_logits_neither_overflows_nor_underflows(dtype, shift):
    logits = np.array([[0, 0.5, -1], [0, 3e3, 0]], dtype) + dtype(shift)
    value = softmax(logits)
    gradient = pulled_back(softmax, 0, np.array([1, -2, 3], dtype), logits)
    p = scipy.special.softmax([0, 0.5, -1])
    assert value.dtype == gradient.dtype == dtype
    np.testing.assert_allclose(value, [p, [0, 1, 0]], rtol=1e-6)
    np.testing.assert_allclose(gradient, [(np.diag(p) - np.outer(p, p)) @ [1, -2, 3], [0, 0, 0]], atol=1e-6)


# --- steps between neighbouring pixels (Eq. 4, 5) -----------------------------------------------------------

def test_total_variation_and_its_gradient_match_autograd_of_the_plain_formula():
    rng = np.random.default_rng(18)
    field, across, down = rng.normal(size=(2, 4, 5, 3)), rng.random((2, 4, 4)), rng.random((2, 3, 5))
    g = np.array([1.5, -0.5])

    def plain(field):
        dx = anp.sum(anp.abs(field[:, :, 1:] - field[:, :, :-1]), axis=3)
        dy = anp.sum(anp.abs(field[:, 1:] - field[:, :-1]), axis=3)
        return anp.sum(dx * across, axis=(1, 2)) + anp.sum(dy * down, axis=(1, 2))
    np.testing.assert_allclose(total_variation(field, across, down), plain(field), rtol=1e-12)
    found = pulled_back(total_variation, 0, g, field, across, down)
    np.testing.assert_allclose(found, grad(lambda field: anp.sum(g * plain(field)))(field), rtol=0, atol=1e-12)
    assert np.abs(found).min() > 1e-3
    check_grads(lambda field: total_variation(field, across, down), modes=["rev"], order=1)(field)


# --- dtype ------------------------------------------------------------------------------------------------

def dense_leaky(x, weights, bias):
    return dense(x, weights, bias, leaky=True)


def dtype_cases():
    rng = np.random.default_rng(16)
    queries, references, valid = rng.normal(size=(2, 6, 3)), rng.normal(size=(2, 5, 3)), rng.random((2, 5)) < 0.7
    indices = np.array([0, 2, 2, 1, 4, 0])
    images, positions = rng.random((2, 4, 5, 3)), grid_positions(rng, 2, 9, (-1, -1), (5, 4)) + 1 / 64
    x, weights, bias = rng.normal(size=(2, 5, 3)), rng.normal(size=(3, 4)), rng.normal(size=4)
    yield squared_distances, 0, (queries[0], references[0], indices)
    yield squared_distances, 1, (queries[0], references[0], indices)
    yield nearest_squared_distances, 0, (queries, references, valid)
    yield nearest_squared_distances, 1, (queries, references, valid)
    yield bilinear_sample, 0, (images, positions - 1 / 64)
    yield bilinear_sample, 1, (images, positions)  # a position on the grid may be a kink
    for argnum in range(3):
        yield dense, argnum, (x, weights, bias)
        yield dense, argnum, (x, weights, rng.normal(size=(2, 4)))
        yield dense_leaky, argnum, (x, weights, bias)
    yield take, 0, (x, (slice(None), slice(1, 3)))
    yield take, 0, (x, (np.array([1, 0]), np.array([3, 4])))
    yield take_block, 0, (bias, 1, (3, 1))
    pooling = rng.random((2, 2, 5))
    yield pool, 0, (np.abs(x), np.ones((2, 5), bool), pooling)
    yield pool, 0, (np.abs(x), np.array([[True, False, True, True, False]] * 2), pooling)
    for argnum in range(2):
        yield weighted_means, argnum, (x, rng.random((2, 5, 3)))
        yield weighted_maxima, argnum, (np.abs(x), rng.random((2, 5, 3)))
    yield softmax, 0, (x,)
    yield total_variation, 0, (images, rng.random((2, 4, 4)), rng.random((2, 3, 5)))


@pytest.mark.parametrize("function, argnum, args", [
    pytest.param(*case, id=f"{case[0].__name__}-{case[1]}-{i}") for i, case in enumerate(dtype_cases())])
def test_float32_in_gives_float32_out_and_the_same_numbers(function, argnum, args):
    single = [a.astype(np.float32) if isinstance(a, np.ndarray) and a.dtype == float else a for a in args]
    value = function(*single)
    g = np.random.default_rng(17).normal(size=value.shape)
    gradient = pulled_back(function, argnum, g.astype(np.float32), *single)
    assert value.dtype == gradient.dtype == np.float32
    assert gradient.shape == args[argnum].shape
    tolerance = 1 / 32 if function is bilinear_sample and argnum == 1 else 1e-5  # OpenCV's rounding, see above
    np.testing.assert_allclose(value, function(*args), rtol=0, atol=tolerance)
    tolerance = 1 / 16 if function is bilinear_sample and argnum == 1 else 1e-5  # in float64 the slopes are rounded too
    np.testing.assert_allclose(gradient, pulled_back(function, argnum, g, *args), rtol=0, atol=tolerance)
    assert np.abs(gradient).max() > 0.1
