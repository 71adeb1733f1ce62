"""Eq. (3), Sec. III-C: the scene flow, projected, says where in I_{t+1} each pixel of I_t is to be found.

    U = x_{t+1} - x,  V = y_{t+1} - y;   I'_t(x, y) = I_{t+1}(x + U, y + V);   L_rec = sum |I_t - I'_t|_1
"""
import numpy as np
import pytest
from helpers import assert_close, assert_float32, assert_gradient, assert_value
from scipy.ndimage import map_coordinates

pytestmark = pytest.mark.eq3

B, H, W = 2, 4, 6
N = H * W


# --- the projection layer -----------------------------------------------------------------------------------------

def camera_at(position):
    """Its x is the arena's y, its y the arena's -x."""
    from hind4sight_min.geometry import Camera
    pose = np.array([[0.0, -1, 0, position[0]], [1, 0, 0, position[1]], [0, 0, 1, position[2]], [0, 0, 0, 1]])
    return Camera(width=80, height=60, fx=100.0, fy=50.0, cx=10.0, cy=20.0, arena_from_camera=pose)


def test_project_and_optical_flow_by_hand():
    from hind4sight_min.geometry import optical_flow, project
    camera = camera_at([1, 2, 3])
    point, moved = np.array([0.8, 2.1, 3.5]), np.array([0.7, 2.2, 3.5])  # in the camera: (.1, .2, .5), (.2, .3, .5)
    assert_value(project(point, camera), [30, 40], {  # 100 * 0.1 / 0.5 + 10,  50 * 0.2 / 0.5 + 20
        "x and y swapped": [40, 30], "fx and fy swapped": [20, 60], "cx, cy forgotten": [20, 20],
        "not divided by Z": [20, 30], "taken as a point of the camera": [80 / 3.5 + 10, 105 / 3.5 + 20]})
    assert_value(optical_flow(point, moved, camera), [20, 10], {
        "minus the flow": [-20, -10], "U and V swapped": [10, 20], "cx, cy added once more": [30, 30]})


def test_gradients_of_project_and_optical_flow():
    from hind4sight_min.geometry import MIN_DEPTH, optical_flow, project
    camera, rng = camera_at([0, 0, -0.5]), np.random.default_rng(0)
    points = rng.uniform(-0.2, 0.2, (2, 5, 3))
    predicted = points + rng.uniform(-0.05, 0.05, points.shape)
    for argnum in (0, 1):
        assert_gradient(optical_flow, argnum, points, predicted, camera)
        assert_float32(lambda *clouds: optical_flow(*clouds, camera), argnum, points, predicted, atol=1e-3)
    behind = np.array([[0.0, 0.1, -0.7]])
    assert_value(project(behind, camera), [[10 / MIN_DEPTH + 10, 20]], {"mirrored behind the camera": [[-40, 20]]})
    assert_gradient(project, 0, behind, camera)


# --- bilinear sampling --------------------------------------------------------------------------------------------

SQUARES = np.arange(1.0, 13).reshape(1, 3, 4, 1) ** 2  # rows 1 4 9 16, 25 36 49 64, 81 100 121 144


@pytest.mark.parametrize("x, y, expected, mistakes", [
    (1, 0, 4, {"x and y swapped": 25}),
    (0.5, 0, (1 + 4) / 2, {"x and y swapped": (1 + 25) / 2, "rounded": 1, "pixel centres at halves": 1}),
    (2, 0.5, (9 + 49) / 2, {"x and y swapped": (81 + 100) / 2, "rounded": 9, "weights the wrong way round": 49}),
    (1.25, 1.75, (3 * 36 + 49 + 3 * (3 * 100 + 121)) / 16, {"weights the wrong way round": (36 + 3 * 49 + 100) / 16}),
    (3, 2, 144, {"the last row and column": 0}), (-5, 1.5, (25 + 81) / 2, {"0 outside the picture": 0}),
    (0.5, 99, (81 + 100) / 2, {"0 outside the picture": 0}),
    (1e12, 1.5, (64 + 144) / 2, {"an overflow": (25 + 81) / 2})])
def test_bilinear_sample_by_hand(x, y, expected, mistakes):
    from hind4sight_min.ops import bilinear_sample
    found = bilinear_sample(SQUARES, np.array([[[[x, y]]]], float))
    assert_value(found, [[[[expected]]]], mistakes)


def between_pixels(rng, low, high):
    """(B, H, W, 2): multiples of 1/32 px, where every OpenCV is exact, not nearer than 2/32 to a pixel, a kink."""
    return rng.integers(low, high, (B, H, W, 2)) + rng.integers(2, 31, (B, H, W, 2)) / 32


def interpolated(image, x, y):
    """SciPy's linear interpolation of (H, W, C), the border repeated -> (C,)."""
    return [map_coordinates(channel, [[y], [x]], order=1, mode="nearest")[0] for channel in np.moveaxis(image, -1, 0)]


def test_bilinear_sample_matches_scipy_and_its_gradient_central_differences():
    from hind4sight_min.ops import bilinear_sample
    rng = np.random.default_rng(1)
    images, positions = rng.random((B, 5, 7, 3)), between_pixels(rng, -2, 7)
    found = bilinear_sample(images, positions)
    for index in np.ndindex(B, H, W):
        assert_close(found[index], interpolated(images[index[0]], *positions[index]), atol=1e-6)
    gradient, _ = assert_gradient(bilinear_sample, 1, images, positions, step=1 / 32, atol=1e-5)
    for axis, size in enumerate((7, 5)):
        outside = (positions[..., axis] < 0) | (positions[..., axis] > size - 1)
        assert outside.any() and not gradient[..., axis][outside].any(), "no slope across the border"
    assert_float32(bilinear_sample, 1, images, positions)


# --- the loss -----------------------------------------------------------------------------------------------------

def test_one_pixel_that_moves_by_hand():
    next_images = np.add.outer([0, 0.1, 0.2], [0, 0.01, 0.02, 0.03])[None, ..., None] * [1, 0, 2]  # 0.1 y + 0.01 x
    flow = np.zeros((1, 3, 4, 2))
    flow[0, 1, 1] = [1, 0.5]  # (x, y) = (1, 1) is found at (2, 1.5), where the first channel is 0.17

    def total(first_channel):  # the other eleven pixels sum to 1.27; channels 1, 0, 2
        return 3 * (1.27 + first_channel)
    from hind4sight_min.losses import photometric_loss
    found = photometric_loss(np.zeros((1, 3, 4, 3)), next_images, flow, np.ones((1, 12), bool))
    assert_value(found, [total(0.17)], {
        "x and y swapped": [total(0.215)], "minus the flow": [total(0.05)], "the flow ignored": [total(0.11)],
        "position rounded, not interpolated": [total(0.22)], "position cut off": [total(0.12)],
        "mean over the channels": [total(0.17) / 3], "mean over the pixels": [total(0.17) / 12],
        "squared": [np.sum(next_images ** 2) + 5 * (0.17 ** 2 - 0.11 ** 2)],
        "L2 norm over the channels": [total(0.17) * 5 ** 0.5 / 3], "the flow taken as a position": [total(-1.21)]})


def pictures(rng):
    """I_t brighter and darker than I_{t+1} in turn, by a margin, so that no absolute value is at its kink."""
    images, next_images = rng.uniform(0.7, 1, (B, H, W, 3)), rng.uniform(0.4, 0.6, (B, H, W, 3))
    images[:, :, ::2] -= 0.7
    return images, next_images


def test_photometric_loss_matches_scipy_and_its_gradient_central_differences():
    from hind4sight_min.losses import photometric_loss, warp_backward
    rng = np.random.default_rng(2)
    (images, next_images), flow, valid = pictures(rng), between_pixels(rng, -2, 2), rng.random((B, N)) < 0.7
    counted, costs = np.zeros((B, H, W), bool), np.zeros((B, H, W))
    warped, in_view = warp_backward(next_images, flow)
    for b, y, x in np.ndindex(B, H, W):
        to_x, to_y = x + flow[b, y, x, 0], y + flow[b, y, x, 1]
        expected = interpolated(next_images[b], to_x, to_y)
        assert_close(warped[b, y, x], expected, "x/y swapped, or minus the flow?", atol=1e-6)
        assert in_view[b, y, x] == (0 <= to_x <= W - 1 and 0 <= to_y <= H - 1), "width and height swapped?"
        counted[b, y, x] = in_view[b, y, x] and valid[b, y * W + x]
        costs[b, y, x] = np.abs(images[b, y, x] - expected).sum()
    assert 5 < counted.sum() < B * N - 5
    assert_close(photometric_loss(images, next_images, flow, valid), (costs * counted).sum(axis=(1, 2)),
                 "valid or in_view forgotten?", atol=1e-6)
    gradient, _ = assert_gradient(photometric_loss, 2, images, next_images, flow, valid, step=1 / 32, atol=1e-5)
    assert not gradient[~counted].any(), "pixels that do not count have no gradient, not even along the border"
    assert_gradient(photometric_loss, 0, images, next_images, flow, valid)
    assert_float32(photometric_loss, 2, images, next_images, flow, valid)


def test_out_of_view_and_without_depth_cost_nothing_and_rounding_is_forgiven_at_the_rim():
    from hind4sight_min.losses import photometric_loss
    images, next_images = np.ones((1, H, W, 1)), np.zeros((1, H, W, 1))
    flow, valid = np.zeros((1, H, W, 2)), np.ones((1, N), bool)
    flow[0, 0, 0], flow[0, H - 1, W - 1] = -1e-4, 1e-4  # still pixels of the rim, but for rounding
    assert_close(photometric_loss(images, next_images, flow, valid), [N], "rounding drops the rim", atol=1e-6)
    flow[0, 1, 2], flow[0, 2, 3], flow[0, 3, 0], flow[0, 1, 0] = [1e5, 0], [0, -7], [-0.5, -1], [-0.01, 0]
    assert_close(photometric_loss(images, next_images, flow, valid), [N - 4], "in_view forgotten?", atol=1e-6)
    valid[0, 5] = False
    assert_close(photometric_loss(images, next_images, flow, valid), [N - 5], "valid forgotten?", atol=1e-6)
    flow[0, 2, 2, 0] = np.nan
    with pytest.raises(ValueError, match="positions.*finite"):  # OpenCV would read 0 there and say nothing
        photometric_loss(images, next_images, flow, valid)
