"""Eq. (1), Sec. III-A: a depth picture becomes points, and each point moves by the mask-weighted mean of K motions.

    P' = sum_k m_k (R_k P + T_k)
"""
import numpy as np
import pytest
from helpers import assert_close, assert_float32, assert_gradient, assert_value, gradient_of
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.eq1

QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # a quarter turn about z: x becomes y, y becomes -x


# --- unproject, rigid: from a depth picture to points in the arena ------------------------------------------------

def camera_at(rotation, position):
    from hind4sight_min.geometry import Camera
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return Camera(width=3, height=2, fx=2.0, fy=4.0, cx=1.0, cy=0.0, arena_from_camera=pose)


def test_unproject_one_pixel_by_hand():
    from hind4sight_min.geometry import unproject
    depth = np.full((2, 3), 2.0)
    point = unproject(depth, camera_at(np.eye(3), [0, 0, 0]))[1, 2]  # row v = 1, column u = 2
    assert_value(point, [1, 0.5, 2], {  # X = (2 - 1) 2 / 2,  Y = (1 - 0) 2 / 4,  Z = 2
        "cx, cy forgotten": [2, 0.5, 2], "fx and fy swapped": [0.5, 1, 2], "u and v swapped": [0, 1, 2],
        "not times the depth": [0.5, 0.25, 2]})
    point = unproject(depth, camera_at(QUARTER, [10, 20, 30]))[1, 2]
    assert_value(point, [9.5, 21, 32], {
        "left in the camera's frame": [1, 0.5, 2], "the pose inverted": [-19.5, 9, -28],
        "rotation transposed": [10.5, 19, 32], "position forgotten": [-0.5, 1, 2]})


def test_unproject_matches_the_pinhole_formula_and_its_gradient_is_the_pixels_ray():
    from hind4sight_min.geometry import unproject
    rng = np.random.default_rng(0)
    camera, depth = camera_at(Rotation.from_rotvec([2, 0.3, -0.2]).as_matrix(), [0.1, -0.6, 0.5]), rng.random((2, 2, 3))
    points = unproject(depth, camera)
    assert points.shape == (2, 2, 3, 3)
    for b, v, u in np.ndindex(depth.shape):
        z = depth[b, v, u]
        expected = camera.arena_from_camera @ [(u - 1.0) * z / 2, v * z / 4, z, 1]
        assert_close(points[b, v, u], expected[:3])
    assert_gradient(lambda depth: unproject(depth, camera), 0, depth)
    hole = depth * [[1, 1, 0], [1, 1, 1]]
    assert_close(unproject(hole, camera)[0, 0, 2], np.array([0.1, -0.6, 0.5]), "no depth: a point at the camera")


def test_rigid_rotates_first_and_then_translates():
    from hind4sight_min.geometry import rigid
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = QUARTER, [3, 0, 0]
    assert_value(rigid(np.array([[1.0, 0, 0], [0, 0, 5]]), pose), [[3, 1, 0], [3, 0, 5]], {
        "R transposed": [[3, -1, 0], [3, 0, 5]], "translated first": [[0, 4, 0], [0, 3, 5]]})
    assert_gradient(lambda points: rigid(points, pose), 0, np.random.default_rng(1).normal(size=(2, 4, 3)))


# --- so3_exp: [R, T] of the network's rotation vectors ------------------------------------------------------------

def test_a_quarter_turn_about_z_takes_x_to_y():
    from hind4sight_min.geometry import so3_exp
    assert_value(so3_exp(np.array([0, 0, np.pi / 2])), QUARTER, {
        "turned the other way (sign of [w]x)": QUARTER.T})
    assert_close(so3_exp(np.zeros((2, 1, 3))), [[np.eye(3)]] * 2, "NaN: 0 / 0 where nothing turns")


@pytest.mark.parametrize("angle", [1e-8, 1e-3, 0.7, np.pi - 1e-3, np.pi, 5.0])
def test_so3_exp_is_the_matrix_exponential(angle):
    from hind4sight_min.geometry import so3_exp
    x, y, z = w = angle * np.array([2.0, -3, 6]) / 7
    assert_close(so3_exp(w), expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])), "a and b of Rodrigues' formula?")
    assert_gradient(so3_exp, 0, np.stack([w, w[::-1]]))


def test_so3_exp_at_zero_has_a_gradient():
    from hind4sight_min.geometry import so3_exp
    weights = np.arange(9.0).reshape(3, 3)
    found = gradient_of(so3_exp, 0, weights, np.zeros(3))  # dR = [dw]x
    expected = [weights[2, 1] - weights[1, 2], weights[0, 2] - weights[2, 0], weights[1, 0] - weights[0, 1]]
    assert_close(found, expected, "NaN: sin(t) / t is 0 / 0 at t = 0, and so is the derivative of a norm")


def test_so3_exp_keeps_its_digits_at_small_angles_in_float32():
    from hind4sight_min.geometry import so3_exp
    w = np.array([6e-5, 8e-5, 0], np.float32)  # with w_z = 0 it is R[0, 1] = w_x w_y (1 - cos t) / t^2
    assert_close(so3_exp(w)[0, 1], np.float32(6e-5 * 8e-5 / 2), "(1 - cos t) / t^2 is 0 in float32; use the half angle",
                 rtol=1e-4, atol=0)
    assert_float32(so3_exp, 0, np.random.default_rng(2).normal(size=(4, 3)))


# --- the transform layer ------------------------------------------------------------------------------------------

def test_two_points_and_two_motions_by_hand():
    from hind4sight_min.geometry import transform_layer
    points = np.array([[[1.0, 0, 0], [0, 2, 0]]])
    masks = np.array([[[0, 1], [0.5, 0.5]]])  # the first point moves by motion 1, the second by half of each
    rotations, translations = np.array([[np.eye(3), QUARTER]]), np.array([[[0.0, 0, 0], [3, 0, 0]]])
    moved = transform_layer(points, masks, rotations, translations)
    assert_value(moved, [[[3, 1, 0], [0.5, 1, 0]]], {
        "R transposed (rows times R instead of R times columns)": [[[3, -1, 0], [2.5, 1, 0]]],
        "T forgotten": [[[0, 1, 0], [-1, 1, 0]]],
        "translated first, then rotated": [[[0, 4, 0], [-1, 2.5, 0]]],
        "T not weighted by the masks": [[[3, 1, 0], [2, 1, 0]]],
        "the motion added to the point it already holds": [[[4, 1, 0], [0.5, 3, 0]]],
        "masks in reverse order": [[[1, 0, 0], [0.5, 1, 0]]]})


def random_inputs(batch=2, count=5, masks=3):
    rng = np.random.default_rng(3)
    weights = rng.random((batch, count, masks))
    return [rng.normal(size=(batch, count, 3)), weights / weights.sum(axis=2, keepdims=True),
            Rotation.from_rotvec(rng.normal(size=(batch * masks, 3))).as_matrix().reshape(batch, masks, 3, 3),
            rng.normal(size=(batch, masks, 3))]


@pytest.mark.parametrize("masks", [1, 3, 5])  # 3 and 5: as many masks as coordinates or points hide a wrong axis
def test_transform_layer_matches_a_loop_over_points_and_masks(masks):
    from hind4sight_min.geometry import transform_layer
    points, weights, rotations, translations = inputs = random_inputs(masks=masks)
    moved = transform_layer(*inputs)
    assert moved.shape == points.shape
    for b, n in np.ndindex(2, 5):
        expected = sum(weights[b, n, k] * (rotations[b, k] @ points[b, n] + translations[b, k]) for k in range(masks))
        assert_close(moved[b, n], expected, "axes of B, N and K mixed up?")


@pytest.mark.parametrize("argnum, name", [(0, "points"), (1, "masks"), (2, "rotations"), (3, "translations")])
def test_gradient_of_the_transform_layer(argnum, name):
    from hind4sight_min.geometry import transform_layer
    assert_gradient(transform_layer, argnum, *random_inputs(), hint=f"with respect to the {name}")
    assert_float32(transform_layer, argnum, *random_inputs())


@pytest.mark.parametrize("argnum, shape, named", [
    (0, (5, 3), "points"), (0, (2, 4, 3), "masks"), (1, (2, 4, 3), "masks"), (1, (2, 5, 4), "rotations"),
    (2, (2, 3, 9), "rotations"), (2, (1, 3, 3, 3), "rotations"), (3, (2, 3, 4), "translations"),
    (3, (2, 4, 3), "translations")])
def test_transform_layer_refuses_other_shapes(argnum, shape, named):
    from hind4sight_min.geometry import transform_layer
    inputs = random_inputs()
    inputs[argnum] = np.ones(shape)  # NumPy would broadcast some of these and say nothing
    with pytest.raises(ValueError, match=f"{named}: expected floating-point numbers of shape"):
        transform_layer(*inputs)
