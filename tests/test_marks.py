"""Marked points: from pixels to metres and back, and where they are after a poke."""
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import SETTINGS, tiny_pokes

from hind4sight_min.geometry import project
from hind4sight_min.lab.marks import follow, places_at, points_at
from hind4sight_min.networks import Prediction
from hind4sight_min.planning import view_of
from hind4sight_min.scene import Scene
from hind4sight_min.training import scenes_of


def one_scene():
    data = tiny_pokes(1)
    return data, scenes_of(data)[0]


def test_marks_become_points_and_pixels_become_places():
    data, scene = one_scene()
    rows, columns = np.nonzero(scene.occupied.reshape(12, 16))
    pixels = np.column_stack([columns, rows])  # x right, y down
    points = points_at(pixels + 0.4, scene, data.camera)  # the nearest pixel
    np.testing.assert_allclose(project(points, data.camera), pixels, atol=1e-3, err_msg="x and y swapped?")
    places = places_at(pixels, points[:, 2], data.camera, SETTINGS)
    np.testing.assert_allclose(places, points[:, :2], atol=1e-5)
    assert len(pixels) == 9 and np.ptp(places, axis=0).min() > 0.05


@pytest.mark.parametrize("name, pixels, said", [
    ("marks", [(16, 3)], "outside the 16 x 12"), ("marks", [(np.nan, 3)], "outside"), ("marks", [], "one"),
    ("marks", [(0, 11)], "background"), ("marks", [1, 2], r"expected \(M, 2\)"),
    ("goals", [(17, 3)], "outside the 16 x 12"), ("goals", [(0, 0)], "outside the walls"),
    ("goals", [(1, 2, 3)], "one per mark"), ("goals", [(1, np.nan)], "finite")])
def test_marks_and_goals_that_cannot_be(name, pixels, said):
    data, scene = one_scene()
    with pytest.raises(ValueError, match=f"{name}: .*{said}"):
        if name == "marks":
            points_at(pixels, scene, data.camera)
        else:
            places_at(pixels, np.array([0.03]), data.camera, SETTINGS)


def turned(points, angle, shift):
    """Points (n, 3) turned about the vertical through the origin, then shifted in the plane."""
    return points @ Rotation.from_rotvec([0, 0, angle]).as_matrix().T + [*shift, 0]


def two_objects(seed, angle=0.5, shift=(0.03, -0.02), hidden=0):
    """One object moves, another one right beside it stays; what the model says of the motion is wrong, of masks right.

    -> View, Prediction, Scene after, and where the mark is then. hidden: points of the first that are not seen after.
    """
    rng = np.random.default_rng(seed)
    moving = rng.uniform([-0.03, -0.03, 0.02], [0.03, 0.03, 0.04], (80, 3))
    still = rng.uniform([0.032, -0.03, 0.02], [0.06, 0.03, 0.04], (80, 3))
    points, colours = np.vstack([moving, still]), rng.uniform(0, 1, (160, 3))
    after = points.copy()
    after[:80] = turned(moving, angle, shift)
    mark = np.array([0.004, 0.003, 0.04])
    on = np.ones((1, 160), bool)
    before = Scene(np.float32(points)[None], on, on, on, np.float32(colours).reshape(1, 8, 20, 3))
    seen = on & (np.arange(160) >= hidden)
    view = view_of(before, mark[None])
    said = view.cloud.copy()
    said[[*range(80), -1]] += np.float32([0.7 * shift[0], 0.6 * shift[1], 0])
    masks = np.eye(3)[np.r_[np.ones(80, int), np.full(80, 2), 1]]
    scene = Scene(np.float32(after)[None], on, seen, on, before.images)
    return view, Prediction(said[None], masks[None], None, None), scene, turned(mark[None], angle, shift)


@pytest.mark.parametrize("angle, hidden", [(0.5, 0), (0.2, 10)])  # what is hidden afterwards is left out
def test_a_known_motion_is_found_exactly(angle, hidden):
    errors = []
    for seed in range(20):
        view, prediction, after, expected = two_objects(seed, angle, hidden=hidden)
        errors.append(np.linalg.norm(follow(view, prediction, after) - expected))
        assert np.linalg.norm(prediction.points[0, -1] - expected) > 0.006  # the model alone
    assert max(errors) < 1e-5, f"{np.round(errors, 4)} m: the worst matches kept, or those of another mask?"


def test_what_does_not_move_stays_and_without_anything_to_match_the_model_is_believed():
    view, prediction, after, _ = two_objects(0, 0.0, (0.0, 0.0))
    np.testing.assert_allclose(follow(view, prediction, after), view.marks, atol=1e-6)
    view, prediction, after, expected = two_objects(0)
    nothing = Scene(after.points, after.valid, after.occupied & False, after.stands_out, after.images)
    np.testing.assert_array_equal(follow(view, prediction, nothing), prediction.points[0, -1:])
    background = Prediction(prediction.points, np.eye(3)[np.zeros((1, 161), int)], None, None)
    found = follow(view, background, after)  # without a mask, what lies around the mark
    assert np.linalg.norm(found - expected) < 1e-5
