"""What the tests compare with: central differences, and comparisons that say what probably went wrong."""
import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad


def assert_close(found, expected, hint="", rtol=1e-7, atol=1e-9):
    """The same shape and the same numbers; otherwise the message ends in the hint."""
    assert np.shape(found) == np.shape(expected), f"expected shape {np.shape(expected)}, got {np.shape(found)}. {hint}"
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=atol, err_msg=hint)


def assert_value(found, expected, mistakes):
    """As `assert_close`, for numbers worked out by hand; `mistakes` says by which mistake one gets which other ones."""
    assert np.shape(found) == np.shape(expected), f"expected shape {np.shape(expected)}, got {np.shape(found)}"
    def same(a, b):
        return np.allclose(a, b, rtol=1e-5, atol=1e-7)
    if not same(found, expected):
        likely = [name for name, wrong in mistakes.items() if same(found, wrong)]
        reason = f" Did this happen: {' or '.join(likely)}?" if likely else ""
        pytest.fail(f"expected {np.asarray(expected).tolist()}, got {np.asarray(found).tolist()}.{reason}")


def gradient_of(function, argnum, weights, *args):
    """Autograd's gradient of sum(weights * function(*args)) with respect to one argument."""
    return grad(lambda *args: anp.sum(weights * function(*args)), argnum)(*args)


def numerical_gradient(function, argnum, weights, *args, step=1e-6):
    """The same by central differences: one entry after the other a step up and a step down."""
    args, gradient = list(args), np.zeros(args[argnum].shape)
    middle = args[argnum]
    for index in np.ndindex(gradient.shape):
        totals = []
        for sign in (1, -1):
            args[argnum] = middle.copy()
            args[argnum][index] += sign * step
            totals.append(np.sum(weights * function(*args)))
        gradient[index] = (totals[0] - totals[1]) / (2 * step)
    return gradient


def assert_gradient(function, argnum, *args, step=1e-6, atol=1e-6, hint=""):
    """The gradient agrees with central differences, and is not just zero. -> the gradient and its output weights."""
    weights = np.random.default_rng(99).uniform(0.5, 2, np.shape(function(*args)))  # tells the outputs apart
    weights = weights * np.where(np.arange(weights.size).reshape(weights.shape) % 2, -1, 1)
    found = gradient_of(function, argnum, weights, *args)
    assert np.abs(found).max() > 1e-3, f"the gradient of argument {argnum} is zero. {hint}"
    assert_close(found, numerical_gradient(function, argnum, weights, *args, step=step),
                 f"gradient of argument {argnum}. {hint}", rtol=1e-5, atol=atol)
    return found, weights


def assert_float32(function, argnum, *args, atol=1e-4):
    """float32 in, float32 out, in value and gradient, and the same numbers as in float64."""
    single = [a.astype(np.float32) if getattr(a, "dtype", None) == float else a for a in args]
    exact, value = function(*args), function(*single)
    weights = np.linspace(0.5, 2, np.size(exact)).reshape(np.shape(exact))
    found = gradient_of(function, argnum, weights.astype(np.float32), *single)
    assert value.dtype == found.dtype == np.float32, f"float32 became {value.dtype}, its gradient {found.dtype}"
    assert_close(value, exact, "float32 against float64", rtol=1e-4, atol=atol)
    assert_close(found, gradient_of(function, argnum, weights, *args), "float32's gradient", rtol=1e-4, atol=atol)


def loop_smoothness(field, images, valid):
    """Eq. (4) and (5) neighbour by neighbour: field (B, H, W, D), images (B, H, W, 3), valid (B, H W) bool -> (B,)."""
    total, valid = np.zeros(len(field)), valid.reshape(field.shape[:3])
    for b, y, x in np.ndindex(field.shape[:3]):
        for y2, x2 in ((y, x + 1), (y + 1, x)):
            if y2 < field.shape[1] and x2 < field.shape[2] and valid[b, y, x] and valid[b, y2, x2]:
                edge = np.abs(images[b, y2, x2] - images[b, y, x]).mean()
                total[b] += np.abs(field[b, y2, x2] - field[b, y, x]).sum() * np.exp(-40 * edge)
    return total


def inside_outline(points, outline, margin=0.0):
    """Which points (..., 2) lie inside a convex counter-clockwise outline grown by `margin` m at every edge."""
    edges, away = np.roll(outline, -1, axis=0) - outline, points[..., None, :] - outline
    return ((edges[:, 0] * away[..., 1] - edges[:, 1] * away[..., 0]) / np.hypot(*edges.T) >= -margin).all(axis=-1)
