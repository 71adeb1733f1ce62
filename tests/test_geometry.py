"""Camera, projections and the poke's frame, exactly: off-centre principal point, fx != fy, odd poses."""
import cv2
import numpy as np
import pytest
from helpers import assert_close
from scipy.spatial.transform import Rotation

from hind4sight_min.geometry import Camera, optical_flow, poke_axes, poke_frame, project, rigid, unproject

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


@pytest.mark.parametrize("changed, named", [
    (dict(width=0), "width: .*got 0"), (dict(height=-3), "height: .*got -3"), (dict(width=7.5), "width: .*got 7.5"),
    (dict(fx=0.0), "fx: .*> 0"), (dict(fy=-60.0), "fy: .*> 0"), (dict(cx=np.nan), "cx: .*finite number, got nan"),
    (dict(arena_from_camera=np.eye(3)), r"must be \(4, 4\), got \(3, 3\)"),
    (dict(arena_from_camera=np.diag([1.0, 1, -1, 1])), "not a rigid"),  # a reflection
    (dict(arena_from_camera=np.diag([2.0, 2, 2, 1])), "not a rigid"),  # a scale
    (dict(arena_from_camera=np.eye(4) + 0.1 * np.eye(4, k=-3)), "not a rigid"),  # points as rows, not as columns
    (dict(arena_from_camera=np.eye(4) + np.nan * np.eye(4, k=3)), "not a rigid")])
def test_camera_refuses_what_no_camera_can_have(changed, named):
    with pytest.raises(ValueError, match=f"camera: .*{named}"):
        make_camera(**changed)


def test_pixel_size_at_the_arenas_origin():
    down = make_camera(arena_from_camera=pose([np.pi, 0, 0], [0, 0, 0.9]), cx=0.0, cy=0.0)  # above it, looking down
    assert down.pixel_size == pytest.approx(0.9 / FX)
    assert_close(project(np.array([[0.0, 0, 0], [down.pixel_size, 0, 0]]), down), [[0.0, 0], [1, 0]], "not a pixel")
    assert make_camera().pixel_size == pytest.approx(0.62 ** 0.5 / FX)  # |(0.1, -0.6, 0.5)|


@pytest.mark.parametrize("function, argument, named", [
    (rigid, np.array([[0, 0, 1j]]), "points: expected floating-point numbers of .*complex128"),
    (project, np.array([[0.0, 1]]), "points: expected .*..., 3.*, got .*1, 2"),
    (unproject, np.full((HEIGHT, WIDTH), 700, np.uint16), "depth: expected floating-point metres of .*uint16"),
    (unproject, np.ones((WIDTH, HEIGHT)), r"depth: expected \(..., 5, 7\) as the camera says, got \(7, 5\)"),
    (unproject, np.ones((2, HEIGHT, WIDTH + 1)), "depth: expected"), (unproject, np.ones(WIDTH), "depth: expected"),
    (unproject, np.ones((2 * HEIGHT, 2 * WIDTH)), "depth: expected")])  # intrinsics of another picture size
def test_whole_numbers_and_other_picture_sizes_are_refused(function, argument, named):
    with pytest.raises(ValueError, match=named):
        function(argument, pose() if function is rigid else make_camera())


def test_project_and_optical_flow_match_opencv():
    camera, points = make_camera(), cloud(2, 6)
    predicted = points + np.random.default_rng(2).normal(0, 0.02, points.shape)

    def with_opencv(points):
        view, matrix = np.linalg.inv(pose()), np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
        turn, _ = cv2.Rodrigues(view[:3, :3])
        pixels, _ = cv2.projectPoints(points.reshape(-1, 1, 3), turn, view[:3, 3], matrix, None)
        return pixels.reshape(points.shape[:-1] + (2,))
    assert_close(project(points, camera), with_opencv(points), "u is the column and x, v the row and y", atol=1e-7)
    flow = optical_flow(points, predicted, camera)
    assert_close(flow, with_opencv(predicted) - with_opencv(points), "minus the flow?", atol=1e-7)
    assert np.abs(flow).min() > 0.01


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
