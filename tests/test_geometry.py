"""Camera, rigid motions, so3_exp, the transform layer (Eq. 1) and the projection layer."""
import autograd.numpy as anp
import cv2
import numpy as np
import pytest
from autograd import elementwise_grad, grad, jacobian
from autograd.test_util import check_grads
from scipy.linalg import expm, expm_frechet
from scipy.spatial.transform import Rotation

from hind4sight_min.geometry import (MIN_DEPTH, Camera, free_radius, look_at, optical_flow, project, ray_spacing, rigid,
                                     so3_exp, transform_layer, unproject)

WIDTH, HEIGHT = 7, 5  # not square, and fx != fy, so that swapped axes show
FX, FY, CX, CY = 60.0, 70.0, 3.2, 1.7


def make_camera(eye=(0.1, -0.6, 0.5), target=(0.02, 0.05, 0.03), **changed):
    values = dict(width=WIDTH, height=HEIGHT, fx=FX, fy=FY, cx=CX, cy=CY, arena_from_camera=look_at(eye, target))
    return Camera(**{**values, **changed})


def cv2_project(points, camera):
    pose = camera.camera_from_arena
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return cv2.projectPoints(points.reshape(-1, 1, 3), cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], matrix,
                             None)[0].reshape(points.shape[:-1] + (2,))


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def cloud(rng, *shape):
    return rng.uniform(-0.2, 0.2, shape + (3,))


# --- Camera -----------------------------------------------------------------------------------------------

def test_camera_from_arena_inverts_the_pose():
    camera = make_camera()
    rotation, position = camera.arena_from_camera[:3, :3], camera.arena_from_camera[:3, 3]
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = rotation.T, -rotation.T @ position
    assert camera.camera_from_arena.shape == (4, 4)
    np.testing.assert_allclose(camera.camera_from_arena, expected, atol=1e-12)
    assert np.abs(expected[:3, 3]).min() > 0.01


def test_camera_keeps_its_own_copy_of_the_pose():
    pose = look_at((0.1, -0.6, 0.5), (0, 0, 0))
    camera, before = make_camera(arena_from_camera=pose), pose.copy()
    pose[0, 3] = 9
    np.testing.assert_array_equal(camera.arena_from_camera, before)


def test_camera_takes_a_pose_as_nested_lists():
    camera = make_camera(arena_from_camera=look_at((0.1, -0.6, 0.5), (0, 0, 0)).tolist())
    assert camera.arena_from_camera.dtype == np.float64
    np.testing.assert_allclose(camera.arena_from_camera[:3, 3], [0.1, -0.6, 0.5])


@pytest.mark.parametrize("changed, named", [
    (dict(width=0), "camera: .*image size"),
    (dict(height=-3), "camera: .*image size"),
    (dict(fx=0.0), "camera: .*intrinsics"),
    (dict(fy=-60.0), "camera: .*intrinsics"),
    (dict(fx=np.nan), "camera: .*intrinsics"),
    (dict(fy=np.inf), "camera: .*intrinsics"),
    (dict(cx=np.nan), "camera: .*intrinsics"),
    (dict(cy=-np.inf), "camera: .*intrinsics"),
    (dict(arena_from_camera=np.eye(3)), "arena_from_camera"),
    (dict(arena_from_camera=np.eye(4)[:3]), "arena_from_camera"),
    (dict(arena_from_camera=np.diag([1.0, 1, -1, 1])), "arena_from_camera"),  # a reflection
    (dict(arena_from_camera=np.diag([2.0, 2, 2, 1])), "arena_from_camera"),  # a scale
    (dict(arena_from_camera=np.full((4, 4), np.nan)), "arena_from_camera"),
    (dict(arena_from_camera=np.eye(4) + 0.1 * np.eye(4, k=-3)), "arena_from_camera"),  # the last row
    (dict(arena_from_camera=np.eye(4) + 0.1 * np.eye(4, k=1)), "arena_from_camera"),  # a shear
])
def test_camera_refuses_what_no_camera_can_have(changed, named):
    with pytest.raises(ValueError, match=named):
        make_camera(**changed)


@pytest.mark.parametrize("part", [np.nan, np.inf])
@pytest.mark.parametrize("row", [0, 2])
def test_camera_refuses_a_position_that_is_not_finite(row, part):
    pose = np.eye(4)
    pose[row, 3] = part
    with pytest.raises(ValueError, match="arena_from_camera"):
        make_camera(arena_from_camera=pose)


@pytest.mark.parametrize("changed, symmetric", [
    (dict(), True),
    (dict(eye=(1e-3, -0.6, 0.5), target=(1e-3, 0.05, 0)), False),  # beside the plane x = 0
    (dict(eye=(0, -0.6, 0.5), target=(0.01, 0.05, 0)), False),  # looks to the side
    (dict(cx=WIDTH / 2), False),  # pixel centres are whole numbers: the middle is (width - 1) / 2
    (dict(cx=(WIDTH - 1) / 2 + 1e-3), False),
])
def test_is_mirror_symmetric_says_whether_flipping_the_image_mirrors_the_arena(changed, symmetric):
    values = dict(eye=(0, -0.6, 0.5), target=(0, 0.05, 0), cx=(WIDTH - 1) / 2)
    camera = make_camera(**{**values, **changed})
    assert camera.is_mirror_symmetric is symmetric
    points = cloud(np.random.default_rng(0), 9)  # and what the word promises
    flipped = project(points, camera) * [-1, 1] + [WIDTH - 1, 0]
    assert np.allclose(project(points * [-1, 1, 1], camera), flipped, rtol=0, atol=1e-6) is symmetric


def test_is_mirror_symmetric_sees_a_rolled_camera():
    pose = look_at((0, -0.6, 0.5), (0, 0.05, 0))
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", 0.01).as_matrix()
    assert not make_camera(arena_from_camera=pose, cx=(WIDTH - 1) / 2).is_mirror_symmetric


@pytest.mark.parametrize("eye, target", [((0, -0.6, 0.5), (0, 0, 0)), ((0.3, 0.2, 0.7), (-0.1, 0.05, 0.02)),
                                         ((-0.4, 0.1, 0.1), (0.2, 0.3, 0.4))])
def test_look_at_sees_the_target_in_the_middle_upright(eye, target):
    pose = look_at(eye, target)
    assert pose.shape == (4, 4)
    right, down, forward, position = pose[:3].T
    np.testing.assert_allclose(pose[3], [0, 0, 0, 1])
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(right, down), forward, atol=1e-12)  # right-handed: x right, y down, z forward
    np.testing.assert_allclose(position, eye)
    distance = np.linalg.norm(np.subtract(target, eye))
    np.testing.assert_allclose(position + distance * forward, target, atol=1e-12)
    assert right[2] == pytest.approx(0, abs=1e-12)  # the horizon is level
    assert down[2] < -0.1
    camera = make_camera(arena_from_camera=pose)
    np.testing.assert_allclose(project(np.array(target, float), camera), [CX, CY], atol=1e-9)


# --- rigid ------------------------------------------------------------------------------------------------

def test_look_at_refuses_to_look_straight_down():
    with pytest.raises(ValueError, match="eye, target"):
        look_at((0.1, 0.2, 1), (0.1, 0.2, 0))


def test_rigid_applies_rotation_then_translation_to_every_point():
    rng = np.random.default_rng(1)
    points, transform = rng.normal(size=(2, 4, 3)), np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    transform[:3, 3] = [0.1, -0.2, 0.3]
    moved = rigid(points, transform)
    assert moved.shape == points.shape
    for index in np.ndindex(2, 4):
        np.testing.assert_allclose(moved[index], (transform @ np.append(points[index], 1))[:3], atol=1e-12)
    gradient = elementwise_grad(rigid)(points, transform)  # of the sum of all outputs: R^T (1, 1, 1)
    assert gradient.shape == points.shape
    np.testing.assert_allclose(gradient, np.broadcast_to(transform[:3, :3].sum(axis=0), points.shape), atol=1e-12)


# --- unproject and project --------------------------------------------------------------------------------

def test_unproject_matches_the_pinhole_formula_pixel_by_pixel():
    rng = np.random.default_rng(2)
    camera, depth = make_camera(), rng.uniform(0.4, 1.0, (2, HEIGHT, WIDTH))
    points = unproject(depth, camera)
    assert points.shape == (2, HEIGHT, WIDTH, 3)
    for b, v, u in np.ndindex(2, HEIGHT, WIDTH):
        z = depth[b, v, u]
        expected = camera.arena_from_camera @ [(u - CX) * z / FX, (v - CY) * z / FY, z, 1]
        np.testing.assert_allclose(points[b, v, u], expected[:3], atol=1e-12)


def test_unproject_gradient_is_the_pixels_ray():
    camera = make_camera()
    depth = np.random.default_rng(3).uniform(0.4, 1.0, (HEIGHT, WIDTH))
    for axis in range(3):
        gradient = grad(lambda d: anp.sum(unproject(d, camera)[..., axis]))(depth)
        rays = unproject(depth, camera) - camera.arena_from_camera[:3, 3]  # linear in the depth
        assert gradient.shape == depth.shape
        np.testing.assert_allclose(gradient, rays[..., axis] / depth, atol=1e-12)
    check_grads(unproject, modes=["rev"], order=1)(depth, camera)


def test_unproject_puts_pixels_without_depth_at_the_camera():
    camera = make_camera()
    depth = np.full((HEIGHT, WIDTH), 0.7)
    depth[2, 3] = 0
    points = unproject(depth, camera)
    np.testing.assert_allclose(points[2, 3], camera.arena_from_camera[:3, 3], atol=1e-12)
    assert np.linalg.norm(points[2, 4] - points[2, 3]) > 0.5


@pytest.mark.parametrize("shape", [(WIDTH, HEIGHT), (HEIGHT, WIDTH + 1), (2, HEIGHT + 1, WIDTH), (WIDTH,)])
def test_unproject_refuses_a_picture_of_another_size(shape):
    with pytest.raises(ValueError, match="depth"):  # such as the intrinsics of the full-size picture
        unproject(np.ones(shape), make_camera())


def test_unproject_refuses_depth_in_whole_numbers():
    with pytest.raises(ValueError, match="floating-point metres"):
        unproject(np.full((HEIGHT, WIDTH), 700, np.uint16), make_camera())


def test_project_inverts_unproject():
    camera = make_camera()
    depth = np.random.default_rng(4).uniform(0.4, 1.0, (2, HEIGHT, WIDTH))
    pixels = project(unproject(depth, camera), camera)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    assert pixels.shape == (2, HEIGHT, WIDTH, 2)
    np.testing.assert_allclose(pixels, np.broadcast_to(np.stack([u, v], axis=-1), pixels.shape), atol=1e-10)


def test_project_refuses_points_in_whole_numbers():
    with pytest.raises(ValueError, match="points: expected floating-point metres, got int64"):
        project(np.array([[0, 0, 0], [0, 0, 1]]), make_camera())


def test_project_matches_opencv():
    camera, points = make_camera(), cloud(np.random.default_rng(5), 2, 6)
    pixels = project(points, camera)
    assert pixels.shape == (2, 6, 2)
    np.testing.assert_allclose(pixels, cv2_project(points, camera), atol=1e-7)
    assert np.ptp(pixels, axis=(0, 1)).min() > 5


def test_project_x_points_right_and_y_points_down():
    camera = make_camera(eye=(0, -0.6, 0.5), target=(0, 0, 0))  # looks along +y and down; arena z is up
    origin = project(np.zeros(3), camera)
    east, up, north = (project(0.05 * axis, camera) for axis in np.eye(3)[[0, 2, 1]])
    assert east[0] - origin[0] > 1 and east[1] == pytest.approx(origin[1])
    assert up[1] - origin[1] < -1 and up[0] == pytest.approx(origin[0])
    assert north[1] - origin[1] < -1  # further away on the table is higher in the picture


def test_project_gradient_matches_its_closed_form_and_finite_differences():
    camera = make_camera(arena_from_camera=np.eye(4))
    x, y, z = point = np.array([0.11, -0.07, 0.6])
    expected = [[FX / z, 0, -FX * x / z ** 2], [0, FY / z, -FY * y / z ** 2]]
    gradient = jacobian(project)(point, camera)
    assert gradient.shape == (2, 3)
    np.testing.assert_allclose(gradient, expected, rtol=1e-12)
    camera = make_camera()
    check_grads(project, modes=["rev"], order=1)(cloud(np.random.default_rng(6), 2, 5), camera)


@pytest.mark.parametrize("z", [MIN_DEPTH / 2, 0.0, -0.4])
def test_points_at_or_behind_the_camera_give_finite_pixels_and_gradients(z):
    camera = make_camera(arena_from_camera=np.eye(4))
    point = np.array([0.3, -0.2, z])
    np.testing.assert_allclose(project(point, camera), [FX * 0.3 / MIN_DEPTH + CX, -FY * 0.2 / MIN_DEPTH + CY])
    # The clamp has no slope in depth; sideways the gradient still brings the point back.
    np.testing.assert_allclose(jacobian(project)(point, camera),
                               [[FX / MIN_DEPTH, 0, 0], [0, FY / MIN_DEPTH, 0]], atol=1e-12)


def test_optical_flow_is_predicted_minus_current_pixel():
    rng = np.random.default_rng(7)
    camera, points = make_camera(), cloud(rng, 2, 5)
    predicted = points + rng.uniform(-0.05, 0.05, points.shape)
    flow = optical_flow(points, predicted, camera)
    assert flow.shape == (2, 5, 2)
    np.testing.assert_allclose(flow, cv2_project(predicted, camera) - cv2_project(points, camera), atol=1e-7)
    assert np.abs(flow).max() > 1
    check_grads(optical_flow, (0, 1), modes=["rev"], order=1)(points, predicted, camera)


# --- so3_exp ----------------------------------------------------------------------------------------------

SWITCH = 1e-2  # rad; below it so3_exp evaluates a series
ANGLES = [0.0, 1e-8, 1e-4, SWITCH * (1 - 1e-9), SWITCH, SWITCH * (1 + 1e-9), 0.1, 0.7,
          np.pi - 1e-6, np.pi, np.pi + 1e-6, 5.0]
AXIS = np.array([2.0, -3.0, 6.0]) / 7


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_exp_and_its_gradient_match_the_matrix_exponential(angle):
    w = angle * AXIS
    rotation, gradient = so3_exp(w), jacobian(so3_exp)(w)
    assert rotation.shape == (3, 3) and gradient.shape == (3, 3, 3)
    np.testing.assert_allclose(rotation, expm(hat(w)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(w).as_matrix(), rtol=0, atol=1e-13)
    for i in range(3):  # the derivative of expm at [w]x in the direction [e_i]x
        expected = expm_frechet(hat(w), hat(np.eye(3)[i]), compute_expm=False)
        np.testing.assert_allclose(gradient[:, :, i], expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_so3_exp_at_exactly_zero_is_the_identity_with_the_generators_as_gradient(dtype):
    w = np.zeros(3, dtype)
    gradient = jacobian(so3_exp)(w)
    assert so3_exp(w).dtype == gradient.dtype == dtype
    np.testing.assert_array_equal(so3_exp(w), np.eye(3))
    for i in range(3):
        np.testing.assert_array_equal(gradient[:, :, i], hat(np.eye(3)[i]))


def test_so3_exp_matches_rodrigues_of_opencv():
    w = np.array([0.4, -1.1, 0.9])
    rotation, gradient = cv2.Rodrigues(w)
    np.testing.assert_allclose(so3_exp(w), rotation, atol=1e-12)
    np.testing.assert_allclose(jacobian(so3_exp)(w), np.moveaxis(gradient.reshape(3, 3, 3), 0, 2), atol=1e-12)


def test_so3_exp_of_a_batch_mixing_both_branches():
    w = np.random.default_rng(8).normal(size=(2, 3, 3)) * np.array([0, 1e-3, 1])[:, None]
    rotations = so3_exp(w)
    assert rotations.shape == (2, 3, 3, 3)
    np.testing.assert_allclose(rotations, Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(2, 3, 3, 3),
                               atol=1e-13)
    check_grads(so3_exp, modes=["rev"], order=1)(w)


@pytest.mark.parametrize("angle", [1e-4, 5e-3, 0.0101, 0.02, 0.1])
def test_so3_exp_keeps_its_digits_in_float32(angle):
    # With w_z = 0, R[0, 1] is b w_x w_y alone. (1 - cos t) / t^2 would be off by 1e-3 at 0.02 and be 0 at 1e-4.
    w = (angle * np.array([0.6, 0.8, 0.0])).astype(np.float32)
    gradient = grad(lambda w: so3_exp(w)[0, 1])(w)
    exact, x, y = w.astype(float), *w[:2].astype(float)
    assert so3_exp(w).dtype == gradient.dtype == np.float32
    t = np.hypot(x, y)
    np.testing.assert_allclose(so3_exp(w)[0, 1], 2 * np.sin(t / 2) ** 2 / t ** 2 * x * y, rtol=1e-6)
    np.testing.assert_allclose(gradient, grad(lambda w: so3_exp(w)[0, 1])(exact), rtol=1e-5)
    assert abs(gradient[0]) > 0.3 * angle


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_exp_stays_a_rotation_in_float32(angle):
    rotation = so3_exp((angle * AXIS).astype(np.float32))
    assert rotation.dtype == np.float32
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=2e-6)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=2e-6)
    np.testing.assert_allclose(rotation, expm(hat(angle * AXIS)), atol=2e-6)


# --- the transform layer ----------------------------------------------------------------------------------

def transform_inputs(rng, batch=2, count=5, masks=3):
    weights = rng.random((batch, count, masks))
    return (rng.normal(size=(batch, count, 3)), weights / weights.sum(axis=2, keepdims=True),
            Rotation.from_rotvec(rng.normal(size=(batch * masks, 3))).as_matrix().reshape(batch, masks, 3, 3),
            rng.normal(size=(batch, masks, 3)))


@pytest.mark.parametrize("masks", [1, 3])
def test_transform_layer_matches_a_loop_over_points_and_masks(masks):
    # Eq. (1)
    points, weights, rotations, translations = inputs = transform_inputs(np.random.default_rng(9), masks=masks)
    moved = transform_layer(*inputs)
    assert moved.shape == points.shape
    for b, n in np.ndindex(points.shape[:2]):
        expected = sum(weights[b, n, k] * (rotations[b, k] @ points[b, n] + translations[b, k])
                       for k in range(masks))
        np.testing.assert_allclose(moved[b, n], expected, rtol=0, atol=1e-12)


def test_transform_layer_gradients_match_a_loop_over_points_and_masks():
    # Eq. (1)
    rng = np.random.default_rng(10)
    points, weights, rotations, translations = inputs = transform_inputs(rng)
    g = rng.normal(size=points.shape)
    gradients = grad(lambda args: anp.sum(transform_layer(*args) * g))(inputs)
    expected = [np.zeros_like(value) for value in inputs]
    for b, n in np.ndindex(points.shape[:2]):
        for k in range(weights.shape[2]):
            expected[0][b, n] += weights[b, n, k] * rotations[b, k].T @ g[b, n]
            expected[1][b, n, k] = g[b, n] @ (rotations[b, k] @ points[b, n] + translations[b, k])
            expected[2][b, k] += weights[b, n, k] * np.outer(g[b, n], points[b, n])
            expected[3][b, k] += weights[b, n, k] * g[b, n]
    for found, wanted in zip(gradients, expected):
        assert found.shape == wanted.shape
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)


def test_transform_layer_with_one_hot_masks_moves_each_point_by_its_own_motion():
    # Eq. (1)
    points, _, rotations, translations = transform_inputs(np.random.default_rng(11))
    owner = np.array([[0, 1, 2, 1, 0], [2, 2, 1, 0, 1]])
    moved = transform_layer(points, np.eye(3)[owner], rotations, translations)
    for b, n in np.ndindex(2, 5):
        expected = rotations[b, owner[b, n]] @ points[b, n] + translations[b, owner[b, n]]
        np.testing.assert_allclose(moved[b, n], expected, atol=1e-12)


@pytest.mark.parametrize("which, shape", [
    (0, (5, 3)), (0, (2, 5)), (0, (2, 4, 3)), (1, (2, 4, 3)), (1, (3, 5, 3)), (1, (2, 5, 4)), (2, (2, 3, 9)),
    (2, (1, 3, 3, 3)), (2, (2, 4, 3, 3)), (3, (2, 3, 4)), (3, (3, 3)), (3, (2, 4, 3)), (3, (2, 3, 3, 1))])
def test_transform_layer_refuses_other_shapes(which, shape):
    inputs = list(transform_inputs(np.random.default_rng(12)))
    inputs[which] = np.ones(shape)
    with pytest.raises(ValueError, match="points.*masks.*rotations.*translations"):
        transform_layer(*inputs)


# --- which points cannot be near each other -----------------------------------------------------------------

def nearest_other(points):
    """The distance of every point (N, 3) to the nearest other one, over all pairs."""
    pairs = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(pairs, np.inf)
    return pairs.min(axis=1)


def test_ray_spacing_is_below_the_distance_to_every_other_point_but_not_far_below():
    rng, camera = np.random.default_rng(15), make_camera()
    for spread in (0.0, 0.02, 0.5):  # a flat picture, a rough one, and one of single points
        depth = 0.7 + spread * rng.uniform(-1, 1, (HEIGHT, WIDTH))
        points = unproject(depth, camera).reshape(-1, 3)
        spacing = ray_spacing(points, camera)
        assert spacing.shape == (HEIGHT * WIDTH,)
        assert (spacing < nearest_other(points)).all()
        if not spread:
            assert (spacing > 0.4 * nearest_other(points)).all()


def test_free_radius_is_below_the_distance_to_every_other_predicted_point():
    rng, camera = np.random.default_rng(16), make_camera()
    points = unproject(0.7 + 0.01 * rng.random((4, HEIGHT, WIDTH)), camera).reshape(4, -1, 3)
    predicted = points + 1e-4 * rng.uniform(-1, 1, points.shape)
    for i, count in ((1, 1), (2, 4), (3, points.shape[1])):  # none, one, some and all move
        predicted[i, :count] += rng.uniform(-0.05, 0.05, (count, 3))
    radius = free_radius(points, predicted, ray_spacing(points, camera))
    for i, count in enumerate((0, 1, 4, points.shape[1])):
        assert (radius[i] <= nearest_other(predicted[i])).all()
        assert not radius[i, :count].any()
        if count < 4:
            assert (radius[i, count:] > 0).mean() > 0.5


# --- dtype ------------------------------------------------------------------------------------------------

def dtype_cases():
    rng = np.random.default_rng(13)
    camera, points = make_camera(), cloud(rng, 2, 5)
    inputs = transform_inputs(rng)

    def layer(which):
        return lambda x: transform_layer(*[x if i == which else value.astype(x.dtype)
                                           for i, value in enumerate(inputs)])

    yield "rigid", lambda p: rigid(p, camera.arena_from_camera), points
    yield "unproject", lambda d: unproject(d, camera), rng.uniform(0.4, 1, (2, HEIGHT, WIDTH))
    yield "project", lambda p: project(p, camera), points
    yield "flow from", lambda p: optical_flow(p, points.astype(p.dtype), camera), points + 0.02
    yield "flow to", lambda p: optical_flow(points.astype(p.dtype), p, camera), points + 0.02
    yield "so3_exp", so3_exp, rng.normal(size=(4, 3))
    yield "so3_exp of one", so3_exp, rng.normal(size=3)
    yield "so3_exp, series", so3_exp, 1e-3 * rng.normal(size=(4, 3))
    for which, name in enumerate(("points", "masks", "rotations", "translations")):
        yield f"transform_layer, {name}", layer(which), inputs[which]


@pytest.mark.parametrize("function, x", [pytest.param(f, x, id=name) for name, f, x in dtype_cases()])
def test_float32_in_gives_float32_out_and_the_same_numbers(function, x):
    g = np.random.default_rng(14).normal(size=function(x).shape)

    def objective(x):
        return anp.sum(function(x) * g.astype(x.dtype))

    single = x.astype(np.float32)
    value, gradient = function(single), grad(objective)(single)
    assert value.dtype == gradient.dtype == np.float32
    assert gradient.shape == x.shape
    exact, exact_gradient = function(x), grad(objective)(x)
    np.testing.assert_allclose(value, exact, rtol=0, atol=1e-5 * np.abs(exact).max())
    np.testing.assert_allclose(gradient, exact_gradient, rtol=0, atol=1e-5 * np.abs(exact_gradient).max())
