"""Camera, rigid motions, projections and rotations, exactly: off-centre principal point, fx != fy, odd poses."""
import cv2
import numpy as np
import pytest
from autograd import grad, jacobian
from helpers import assert_close, assert_float32, assert_gradient
from scipy.linalg import expm, expm_frechet
from scipy.spatial.transform import Rotation

from hind4sight_min.geometry import Camera, optical_flow, poke_axes, poke_frame, project, rigid, so3_exp, unproject

WIDTH, HEIGHT = 7, 5  # not square, and fx != fy, so that swapped axes show
FX, FY, CX, CY = 60.0, 70.0, 4.2, 1.3
POSITION = [0.1, -0.6, 0.5]


def pose(rotation_vector=(-2.2, 0.3, -0.2), position=POSITION):
    """A camera that looks down at the arena's middle, a little to the side and rolled."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(rotation_vector).as_matrix(), position
    return matrix


def make_camera(**changed):
    values = dict(width=WIDTH, height=HEIGHT, fx=FX, fy=FY, cx=CX, cy=CY, arena_from_camera=pose())
    return Camera(**{**values, **changed})


def cloud(*shape):
    return np.random.default_rng(0).uniform(-0.2, 0.2, shape + (3,))


# --- Camera -------------------------------------------------------------------------------------------------------

def with_entry(row, column, value):
    matrix = np.eye(4)
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize("changed, named", [
    (dict(width=0), "image size.*0 x 5"), (dict(height=-3), "image size.*7 x -3"), (dict(width=7.5), "image size"),
    (dict(fx=0.0), "intrinsics"), (dict(fy=-60.0), "intrinsics"), (dict(fx=np.nan), "intrinsics"),
    (dict(fy=np.inf), "intrinsics"), (dict(cx=np.nan), "intrinsics"), (dict(cy=-np.inf), "intrinsics"),
    (dict(arena_from_camera=np.eye(3)), r"must be \(4, 4\), got \(3, 3\)"),
    (dict(arena_from_camera=np.eye(4)[:3]), r"must be \(4, 4\)"),
    (dict(arena_from_camera=with_entry(2, 2, -1)), "not a rigid"),  # a reflection
    (dict(arena_from_camera=np.diag([2.0, 2, 2, 1])), "not a rigid"),  # a scale
    (dict(arena_from_camera=with_entry(0, 1, 0.1)), "not a rigid"),  # a shear
    (dict(arena_from_camera=with_entry(3, 0, 0.1)), "not a rigid"),  # the last row: points as rows instead of columns
    (dict(arena_from_camera=with_entry(0, 3, np.nan)), "not a rigid"),
    (dict(arena_from_camera=with_entry(2, 3, np.inf)), "not a rigid")])
def test_camera_refuses_what_no_camera_can_have(changed, named):
    with pytest.raises(ValueError, match=f"camera: .*{named}"):
        make_camera(**changed)


def test_camera_keeps_its_own_copy_of_the_pose_in_float64():
    given = pose()
    camera = make_camera(arena_from_camera=given)
    given[0, 3] = 9
    assert_close(camera.arena_from_camera, pose())
    from_lists = make_camera(arena_from_camera=pose().tolist(), width=np.int64(7))
    assert from_lists.arena_from_camera.dtype == np.float64
    assert_close(from_lists.arena_from_camera, pose())


def test_camera_from_arena_inverts_the_pose():
    rotation, expected = pose()[:3, :3], np.eye(4)
    expected[:3, :3], expected[:3, 3] = rotation.T, -rotation.T @ POSITION
    assert_close(make_camera().camera_from_arena, expected)


def test_pixel_size_at_the_arenas_origin():
    down = make_camera(arena_from_camera=pose([np.pi, 0, 0], [0, 0, 0.9]), cx=0.0, cy=0.0)  # above it, looking down
    assert down.pixel_size == pytest.approx(0.9 / FX)
    assert_close(project(np.array([[0.0, 0, 0], [down.pixel_size, 0, 0]]), down), [[0.0, 0], [1, 0]], "not a pixel")
    assert make_camera().pixel_size == pytest.approx(0.62 ** 0.5 / FX)  # |(0.1, -0.6, 0.5)|


# --- rigid, unproject, project ------------------------------------------------------------------------------------

def test_rigid_matches_homogeneous_coordinates():
    points = cloud(2, 4)
    expected = (np.concatenate([points, np.ones((2, 4, 1))], axis=2) @ pose().T)[..., :3]
    assert_close(rigid(points, pose()), expected, "R p + T")
    assert_close(rigid(points[0, 0], pose()), expected[0, 0])
    assert_float32(lambda points: rigid(points, pose()), 0, points)


@pytest.mark.parametrize("function, argument, named", [
    (rigid, np.array([[0, 0, 1]]), "points: expected floating-point metres, got int64"),
    (project, np.array([[0, 0, 1]]), "points: expected floating-point metres"),
    (unproject, np.full((HEIGHT, WIDTH), 700, np.uint16), "depth: expected floating-point metres, got uint16"),
    (unproject, np.ones((WIDTH, HEIGHT)), r"depth: expected \(..., 5, 7\) as the camera says, got \(7, 5\)"),
    (unproject, np.ones((2, HEIGHT, WIDTH + 1)), "depth: expected"), (unproject, np.ones(WIDTH), "depth: expected"),
    (unproject, np.ones((2 * HEIGHT, 2 * WIDTH)), "depth: expected")])  # intrinsics of another picture size
def test_whole_numbers_and_other_picture_sizes_are_refused(function, argument, named):
    with pytest.raises(ValueError, match=named):
        function(argument, pose() if function is rigid else make_camera())


@pytest.mark.parametrize("dtype, pixels", [(np.float64, 1e-10), (np.float32, 1e-3)])
def test_project_inverts_unproject(dtype, pixels):
    camera = make_camera()
    depth = np.random.default_rng(1).uniform(0.4, 1, (2, HEIGHT, WIDTH)).astype(dtype)
    points = unproject(depth, camera)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    assert points.dtype == dtype and points.shape == (2, HEIGHT, WIDTH, 3)
    assert_close(project(points, camera), np.broadcast_to(np.stack([u, v], axis=-1), (2, HEIGHT, WIDTH, 2)),
                 "u is the column and x, v the row and y", rtol=0, atol=pixels)
    in_camera = rigid(points.astype(float), camera.camera_from_arena)
    assert_close(in_camera[..., 2], depth, "depth is Z along the optical axis, not the length of the ray", atol=1e-6)


def test_project_and_optical_flow_match_opencv():
    camera, points = make_camera(), cloud(2, 6)
    predicted = points + np.random.default_rng(2).normal(0, 0.02, points.shape)

    def with_opencv(points):
        view, matrix = camera.camera_from_arena, np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
        turn, _ = cv2.Rodrigues(view[:3, :3])
        pixels, _ = cv2.projectPoints(points.reshape(-1, 1, 3), turn, view[:3, 3], matrix, None)
        return pixels.reshape(points.shape[:-1] + (2,))
    assert_close(project(points, camera), with_opencv(points), atol=1e-7)
    flow = optical_flow(points, predicted, camera)
    assert_close(flow, with_opencv(predicted) - with_opencv(points), "minus the flow?", atol=1e-7)
    assert np.abs(flow).min() > 0.01


def test_gradients_of_the_projections():
    x, y, z = point = np.array([0.11, -0.07, 0.6])
    closed_form = [[FX / z, 0, -FX * x / z ** 2], [0, FY / z, -FY * y / z ** 2]]
    assert_close(jacobian(project)(point, make_camera(arena_from_camera=np.eye(4))), closed_form)
    camera = make_camera()
    depth = np.random.default_rng(3).uniform(0.4, 1, (HEIGHT, WIDTH))
    for function, x in ((unproject, depth), (project, cloud(2, 5))):
        assert_gradient(lambda x: function(x, camera), 0, x)
        assert_float32(lambda x: function(x, camera), 0, x, atol=1e-3)


# --- so3_exp ------------------------------------------------------------------------------------------------------

def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


AXIS = np.array([2.0, -3.0, 6.0]) / 7
ANGLES = [0.0, 1e-8, 1e-6, 1e-4, 1e-2, 0.1, 0.7, np.pi - 1e-6, np.pi, np.pi + 1e-6, 5.0, 2 * np.pi]


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_exp_and_its_derivative_match_the_matrix_exponential(angle):
    w = angle * AXIS
    rotation, gradient = so3_exp(w), jacobian(so3_exp)(w)
    assert_close(rotation, expm(hat(w)), atol=1e-11)
    assert_close(rotation, Rotation.from_rotvec(w).as_matrix(), atol=1e-11)
    for i in range(3):  # the derivative of expm at [w]x in the direction [e_i]x
        assert_close(gradient[:, :, i], expm_frechet(hat(w), hat(np.eye(3)[i]), compute_expm=False), atol=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_exp_stays_a_rotation_in_float32(angle):
    w = (angle * AXIS).astype(np.float32)
    rotation, gradient = so3_exp(w), jacobian(so3_exp)(w)
    assert rotation.dtype == gradient.dtype == np.float32
    assert_close(rotation @ rotation.T, np.eye(3), atol=2e-6)
    assert_close(rotation, expm(hat(angle * AXIS)), atol=2e-6)
    assert_close(gradient, jacobian(so3_exp)(angle * AXIS), "1 - cos t has no digits left at small t", atol=3e-5)


def test_small_rotations_keep_their_digits_in_float32():
    for angle in (1e-4, 5e-3, 0.02, 0.1):
        w = (angle * np.array([0.6, 0.8, 0])).astype(np.float32)  # R[0, 1] is (1 - cos t) / t^2 w_x w_y alone
        assert_close(so3_exp(w)[0, 1], expm(hat(w.astype(float)))[0, 1], rtol=1e-4, atol=0)
        gradient = grad(lambda w: so3_exp(w)[0, 1])
        assert_close(gradient(w)[:2], gradient(w.astype(float))[:2], rtol=1e-4, atol=0)


@pytest.mark.parametrize("shape", [(3,), (4, 3), (2, 5, 3)])
def test_so3_exp_of_a_batch_is_that_of_each(shape):
    w = np.random.default_rng(4).normal(size=shape)
    expected = Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(shape + (3,))
    assert_close(so3_exp(w), expected)
    assert_gradient(so3_exp, 0, w)


# --- the poke's frame ---------------------------------------------------------------------------------------------

def test_poke_frame_by_hand_and_back():
    pokes = np.array([[0.1, 0.2, np.pi / 2], [0.0, -0.1, 0.3]])  # the first pushes along the arena's y
    points = np.array([[[0.1, 0.2, 0.03], [0.1, 0.1, 0], [0, 0.2, 0]]] * 2)
    local = poke_frame(points, pokes)
    assert_close(local[0], [[0, 0, 0.03], [-0.1, 0, 0], [0, 0.1, 0]], "x along the poke, its target the origin, z kept")
    axes, origins = poke_axes(pokes)
    c, s = np.cos(0.3), np.sin(0.3)
    assert_close(axes[1], [[c, -s, 0], [s, c, 0], [0, 0, 1]])
    assert_close(origins[1], [0, -0.1, 0])
    for b in range(2):
        assert_close(local[b] @ axes[b].T + origins[b], points[b], "p_arena = Q p_poke + o")
    assert poke_frame(points.astype(np.float32), pokes).dtype == np.float32
