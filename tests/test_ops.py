"""The operations with derivatives of our own, where the tests of the equations do not look: corners, kinks, layers."""
import re

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import elementwise_grad, grad
from helpers import assert_close, assert_float32, assert_gradient, gradient_of

from hind4sight_min.ops import (LEAK, at_rows, bilinear_sample, dense, max_over_points, nearest_squared_distances,
                                put_rows, take, unflatten)


# --- nearest neighbours -------------------------------------------------------------------------------------------

@pytest.mark.parametrize("padding", [0, 1])  # as many references as queries, where some are spared the search, or more
def test_an_invalid_reference_is_ignored_even_where_it_sits_on_the_query(padding):
    queries = np.array([[[1.0, 0, 0], [0, 2, 0], [4, 0, 3]]])
    references = np.array([[[1.0, 0, 0], [4, 0, 0], [4, 0, 2.5]] + [[9, 9, 9]] * padding])
    valid = np.array([[False, True, True] + [False] * padding])
    assert_close(nearest_squared_distances(queries, references, valid), [[9, 20, 0.25]])
    gradient = gradient_of(nearest_squared_distances, 1, 1.0, queries, references, valid)
    assert_close(gradient[0, :3], [[0, 0, 0], [2 * 3 + 2 * 4, -2 * 2, 0], [0, 0, -1]])


@pytest.mark.parametrize("queries, references, valid", [
    ((5, 3), (2, 4, 3), (2, 4)), ((2, 5, 3), (4, 3), (2, 4)), ((2, 5, 3), (3, 4, 3), (3, 4)),
    ((2, 5, 3), (2, 4, 2), (2, 4)), ((2, 5, 3), (2, 4, 3), (2, 5))])
def test_nearest_squared_distances_refuse_other_shapes(queries, references, valid):
    with pytest.raises(ValueError, match="queries, references, valid: expected .* got " + re.escape(str(queries))):
        nearest_squared_distances(np.ones(queries), np.ones(references), np.ones(valid, bool))


# --- bilinear sampling --------------------------------------------------------------------------------------------

@pytest.mark.parametrize("position, step", [((2, 1), (1, 1)), ((0, 0), (1, 1)), ((6, 4), (-1, -1)),
                                            ((6, 2), (-1, 1)), ((3, 4), (1, -1))])
def test_on_a_whole_pixel_the_gradient_is_that_of_a_cell_beside_it(position, step):
    # To the right and below; on the last column or row the last cell of the picture, never beyond it.
    images, positions = np.random.default_rng(4).random((1, 5, 7, 1)), np.array([[[position]]], float)
    found = elementwise_grad(bilinear_sample, 1)(images, positions)[0, 0, 0]
    for axis in range(2):
        moved = positions + step[axis] * np.eye(2)[axis]  # bilinear, so a whole pixel is as good as a small step
        slope = step[axis] * (bilinear_sample(images, moved) - bilinear_sample(images, positions))
        assert_close(found[axis], slope[0, 0, 0, 0], atol=1e-5)
        assert abs(found[axis]) > 0.01


@pytest.mark.parametrize("images, positions", [
    ((4, 5, 3), (2, 6, 1, 2)), ((2, 4, 5, 3), (2, 6, 2)), ((2, 4, 5, 3), (2, 6, 1, 3)), ((2, 4, 5, 3), (3, 6, 1, 2)),
    ((2, 4, 5, 3), (2, 0, 5, 2))])
def test_bilinear_sample_refuses_other_shapes(images, positions):
    with pytest.raises(ValueError, match="^images, positions: expected"):
        bilinear_sample(np.ones(images), np.ones(positions))


# --- the network's layers -----------------------------------------------------------------------------------------

@pytest.mark.parametrize("leaky, residual", [(False, False), (True, False), (False, True), (True, True)])
@pytest.mark.parametrize("shape, bias_shape", [((3, 5, 4), ()), ((3, 5, 4), (3,)), ((7, 4), ())])
def test_dense_and_its_gradients(shape, bias_shape, leaky, residual):
    rng, outputs = np.random.default_rng(6), 4 if residual else 5
    inputs = x, weights, bias = [rng.normal(size=each) for each in (shape, (4, outputs), (*bias_shape, outputs))]

    def layer(*inputs):
        return dense(*inputs, leaky=leaky, residual=residual)
    before = np.einsum("...i,io->...o", x, weights) + (bias[:, None] if bias_shape else bias)
    assert 0.2 < (before > 0).mean() < 0.8  # both sides of the kink
    copies = [value.copy() for value in inputs]
    expected = np.where(before > 0, before, LEAK * before if leaky else before)
    assert_close(layer(*inputs), expected + x if residual else expected)
    for argnum in range(3):
        assert_gradient(layer, argnum, *inputs, hint="of x, weights, bias; the leak; the residual's own share")
        assert_float32(layer, argnum, *inputs)
    for value, copy in zip(inputs, copies):
        np.testing.assert_array_equal(value, copy, err_msg="dense changes its inputs")


@pytest.mark.parametrize("count", [1, 2, 3, 6, 7])  # it halves the cloud again and again
def test_max_over_points_and_its_gradient(count):
    rng = np.random.default_rng(8)
    x, valid = rng.random((3, count, 4)) - 0.5, rng.random((3, count)) < 0.7
    x[..., 0] -= 1  # a channel without anything positive
    valid[:2, 0], valid[2] = True, False  # the last cloud has no valid point
    x[~valid] += 5  # would be the largest of all
    expected = np.array([x[b][valid[b]].max(axis=0) if valid[b].any() else np.zeros(4) for b in range(3)])
    assert_close(max_over_points(x, valid), expected)
    gradient, _ = assert_gradient(max_over_points, 0, x, valid)
    assert not gradient[~valid].any()
    assert_float32(max_over_points, 0, x, valid)


def test_equal_maxima_all_have_the_gradient_except_the_invalid_ones():
    x = np.array([[[2.0], [2.0], [1.0], [2.0], [0.0]], [[0.0], [0.0], [-1.0], [0.0], [-3.0]]])
    valid = np.array([[True, False, True, True, True], [True, False, True, True, True]])
    gradient = gradient_of(max_over_points, 0, np.array([[3.0], [5.0]]), x, valid)
    assert_close(gradient[..., 0], [[3, 0, 0, 3, 0], [5, 0, 0, 5, 0]], "an invalid point ties with the maximum")
    x[:] = 0  # without a valid point the maximum is 0, as every x here is: still no gradient
    assert_close(gradient_of(max_over_points, 0, 1.0, x, np.zeros((2, 5), bool)), 0 * x)


# --- parts of arrays ----------------------------------------------------------------------------------------------

@pytest.mark.parametrize("key", [
    slice(1, 3), slice(None, None, -2), (slice(None), slice(None, -1)), (..., slice(2, 3)), (..., 1), 2,
    (np.array([3, 0]), np.array([1, 4])), (np.array([[3], [0]]), np.array([[1, 4]]), slice(1, 3)), np.array([2, 0, 3])])
def test_take_and_its_gradient(key):
    x = np.random.default_rng(9).normal(size=(4, 5, 3))
    for shape in (None, (-1,)):
        np.testing.assert_array_equal(take(x, key, shape), x[key] if shape is None else x[key].ravel())
        assert_gradient(take, 0, x, key, shape)
    assert_float32(take, 0, x, key)


def test_gradients_of_overlapping_takes_add_up():
    x = np.random.default_rng(10).normal(size=5)
    gradient = grad(lambda x: anp.sum(take(x, slice(1, None)) ** 2) + 3 * anp.sum(take(x, slice(None, 3)))
                    + anp.sum(x * x))
    assert_close(gradient(x), 2 * x + 2 * x * [0, 1, 1, 1, 1] + [3, 3, 3, 0, 0])


def test_put_rows_replaces_points_and_hands_on_their_gradient_alone():
    rng = np.random.default_rng(11)
    clouds, values, rows = rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 2, 3)), np.array([[4, 1], [0, 3]])
    kept, found = clouds.copy(), put_rows(clouds, rows, values)
    for b, n in np.ndindex(2, 5):
        expected = values[b, list(rows[b]).index(n)] if n in rows[b] else clouds[b, n]
        np.testing.assert_array_equal(found[b, n], expected)
    np.testing.assert_array_equal(clouds, kept, err_msg="put_rows must work on a copy")
    np.testing.assert_array_equal(found[at_rows(rows)], values)
    assert_gradient(put_rows, 2, clouds, rows, values)
    assert_float32(put_rows, 2, clouds, rows, values)


def test_unflatten_cuts_a_vector_into_named_arrays_in_order():
    layout, vector = {"a": (2, 3), "b": (), "c": (4,)}, np.arange(11.0)
    found = unflatten(vector, layout)
    assert list(found) == ["a", "b", "c"] and np.shares_memory(found["a"], vector)  # views: nothing is copied
    for name, expected in (("a", [[0, 1, 2], [3, 4, 5]]), ("b", 6), ("c", [7, 8, 9, 10])):
        np.testing.assert_array_equal(found[name], expected)
