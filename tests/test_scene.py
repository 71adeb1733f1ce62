"""What the robot sees, where the model looks, what is cropped, what changed."""
from dataclasses import replace

import numpy as np
import pytest
from tiny import camera, tiny_pokes

from hind4sight_min import scene
from hind4sight_min.geometry import project, unproject
from hind4sight_min.scene import Scene, box_of, crop, look, most_changed, scene_of


def scenes(data):
    return [scene_of(depth, rgb, data.empty_depth, data.camera, 0.5) for depth, rgb in
            ((data.depth_before, data.rgb_before), (data.depth_after, data.rgb_after))]


def test_a_scene_holds_the_points_and_what_background_subtraction_says_of_them():
    data = tiny_pokes()
    data.depth_before[1, 3, 4] = 0
    found, _ = scenes(data)
    np.testing.assert_array_equal(found.points.reshape(7, 12, 16, 3), unproject(data.depth_before, data.camera))
    assert (~found.valid).sum() == 1 and not found.valid[1, 3 * 16 + 4]
    np.testing.assert_allclose(found.images, data.rgb_before / 255, atol=1e-7)
    near = (data.depth_before > 0) & (data.empty_depth - data.depth_before > 0.008)
    inside = np.abs(found.points[..., :2]).max(axis=2) < 0.25
    np.testing.assert_array_equal(found.occupied, near.reshape(7, -1) & inside)
    assert 50 < found.occupied.sum() < 7 * 9 + 1
    for i, v, u in np.ndindex(7, 12, 16):  # a pixel is 4 cm wide here, so the rim is one pixel
        around = near[i, max(v - 1, 0):v + 2, max(u - 1, 0):u + 2].any()
        assert found.stands_out[i, v * 16 + u] == around


@pytest.mark.parametrize("nearer, is_object", [(0.0081, True), (0.0079, False)])
def test_an_object_is_nearer_than_the_empty_arena_by_more_than_8_mm(nearer, is_object):
    data = tiny_pokes(count=1)
    depth = (data.empty_depth - np.float32(nearer))[None]
    assert scene_of(depth, data.rgb_before, data.empty_depth, data.camera, 0.5).occupied.any() == is_object


def test_what_stands_outside_the_walls_is_no_object():
    data = tiny_pokes()
    narrow = scene_of(data.depth_before, data.rgb_before, data.empty_depth, data.camera, 0.1)
    assert 0 < narrow.occupied.sum() < scenes(data)[0].occupied.sum()
    assert (np.abs(narrow.points[narrow.occupied][:, :2]) < 0.05).all()


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_the_rim_is_as_wide_in_metres_at_every_picture_size(scale):
    cam = camera(64 * scale, 48 * scale, 77.0 * scale)
    empty = np.full((1, cam.height, cam.width), 0.772, np.float32)
    depth = empty.copy()
    depth[0, :, cam.width // 2:] -= 0.03
    found = scene_of(depth, np.zeros((*depth.shape, 3), np.uint8), empty[0], cam, 0.5)
    columns = found.stands_out.reshape(depth.shape)[0, 24 * scale]
    rim = columns.sum() - cam.width // 2
    assert rim * cam.pixel_size == pytest.approx(0.01, abs=0.0015), "counts pixels, not metres?"


def test_the_model_looks_at_all_that_stands_out_near_the_end_of_the_poke_and_at_nothing_else():
    data = tiny_pokes(count=20)
    before, _ = scenes(data)
    before.valid[3, ::7] = False
    rows, seen = look(before, data.pokes)
    ends = data.pokes[:, :2] + 0.02 * np.stack([np.cos(data.pokes[:, 2]), np.sin(data.pokes[:, 2])], axis=1)
    np.testing.assert_allclose(box_of(data.pokes), ends, atol=1e-6)
    counts = []
    for i in range(20):
        near = (np.abs(before.points[i, :, :2] - ends[i]) < 0.14).all(axis=1)
        expected = np.flatnonzero(near & before.stands_out[i] & before.valid[i])
        np.testing.assert_array_equal(rows[i, seen[i]], expected)
        assert len(set(rows[i])) == rows.shape[1]
        counts.append(len(expected))
    assert rows.shape[1] == max(counts) > min(counts)
    nothing = replace(before, stands_out=np.zeros_like(before.stands_out))
    assert not look(nothing, data.pokes)[1].any() and look(nothing, data.pokes)[0].shape == (20, 1)


def test_a_crop_is_the_part_of_the_picture_with_the_whole_box():
    data = tiny_pokes(cam=camera(64, 48, 77.0))
    data.depth_before[2, 20:22, 30] = 0
    before, after = scenes(data)
    pokes = data.pokes + np.linspace(-0.15, 0.15, 7, dtype=np.float32)[:, None] * [1, 1, 0]
    found = crop(before, pokes, data.camera)
    height, width = found.images.shape[1:3]
    assert height < 48 and width < 64
    for i in range(7):
        inside = (np.abs(before.points[i, :, :2] - box_of(pokes)[i]) < scene.REACH).all(axis=1) & before.valid[i]
        assert set(map(tuple, before.points[i, inside])) <= set(map(tuple, found.points[i]))
        where = found.valid[i]
        x, y = np.rint(project(found.points[i], data.camera)).astype(int)[where].T
        for name in set(vars(found)) - {"arena"}:
            part, whole = getattr(found, name)[i].reshape(len(where), -1), getattr(before, name)[i].reshape(48 * 64, -1)
            np.testing.assert_array_equal(part[where], whole[y * 64 + x], err_msg=name)
    other = crop(after, pokes, data.camera)
    assert other.images.shape == found.images.shape  # the same part of both pictures
    assert found.arena == before.arena == data.settings["arena"], "the walls are forgotten"
    found.images[:] = 0
    assert before.images.max() == 1  # a copy


def test_most_changed_finds_the_moved_points_and_ignores_missing_depth():
    rng = np.random.default_rng(9)
    points = rng.uniform(-0.2, 0.2, (2, 120, 3))  # 5 of them are a 24th
    next_points, valid = points + 1e-4, np.ones((2, 120), bool)
    moved = np.array([3, 8, 20, 21, 39])
    next_points[:, moved] += rng.uniform(0.02, 0.05, (2, 5, 3))
    next_points[:, 0] += 1.0
    valid[:, 0] = False
    here = Scene(points, np.ones_like(valid), None, None)
    there = Scene(next_points, valid, None, None)
    before, after, weights = most_changed(here, there)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    for b in range(2):
        rows = [np.flatnonzero((points[b] == point).all(axis=1))[0] for point in before[b]]
        np.testing.assert_array_equal(np.sort(rows), moved)
        np.testing.assert_array_equal(after[b], next_points[b, rows])
        lengths = np.linalg.norm(after[b] - before[b], axis=1)
        np.testing.assert_allclose(weights[b], lengths ** 4 / (lengths ** 4).sum())
    *_, weights = most_changed(here, here)
    assert not weights.any()  # nothing changed: no evidence, and no NaN
