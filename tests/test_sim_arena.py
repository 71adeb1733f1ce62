"""The poke arena: settings, camera, renderer against geometry, scenes, the finger, how pokes are drawn."""
import sys
from dataclasses import asdict

import cv2
import numpy as np
import pytest
from helpers import inside_outline
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from hind4sight_min.geometry import project, unproject
from hind4sight_min.interactions import cell_centres, occupied_grid
from hind4sight_min.scene import scene_of
from hind4sight_min.sim import arena as arena_module
from hind4sight_min.sim import objects
from hind4sight_min.sim.arena import MAX_OBJECTS, PARK_HEIGHT, Arena, Settings, arena_camera

FAST = dict(width=16, height=12)  # where nobody looks at the pictures
SHARP = dict(width=128, height=96)


def make_arena(seed=0, **changed):
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    return Arena(Settings(**changed), np.random.default_rng(seed))


def alone(kind, seed=0, **changed):
    """An Arena with a scene of one object."""
    arena = make_arena(seed, objects_min=1, objects_max=1, kinds=(kind,), **changed)
    arena.new_scene()
    return arena


def put(arena, x, y, z=None):
    """Object 0, upright and unturned, at (x, y); z: of its middle."""
    z = arena.poses()[0, 2] if z is None else z
    arena.bullet.resetBasePositionAndOrientation(arena.bodies[0], [x, y, z], [0, 0, 0, 1])


@pytest.fixture
def built(monkeypatch):
    """What every body was made from: body -> (outlines, height, taper)."""
    record, real = {}, Arena._add_object

    def add(self, kind, outlines, area, height, taper, xy):
        body = real(self, kind, outlines, area, height, taper, xy)
        record[body] = outlines, height, taper
        return body
    monkeypatch.setattr(Arena, "_add_object", add)
    return record


def test_settings_accept_their_limits_and_leave_out_what_is_held_out():
    settings = Settings(objects_min=1, objects_max=MAX_OBJECTS, width=16, height=12, kinds=tuple(objects.KINDS),
                        textures=objects.TEXTURES, poke_length=(0.1, 0.2), place_within=1)
    for name, held_out in objects.HELD_OUT.items():
        assert not set(getattr(Settings(), name)) & set(held_out) and set(held_out) < set(getattr(settings, name))


@pytest.mark.parametrize("changed", [
    dict(kinds=("carton", "teapot")), dict(kinds=()), dict(own=[]), dict(own=("a.urdf",)),
    dict(kinds="can"), dict(textures=("marble",)), dict(textures=[]),
    dict(objects_min=0), dict(objects_min=1.5), dict(objects_max=8), dict(objects_max=2), dict(width=64.0, height=48),
    dict(width=8, height=6), dict(width=64, height=64), dict(width=0, height=0), dict(arena=-0.5), dict(arena=0.6),
    dict(arena=float("nan")), dict(cell=0), dict(cell=0.03), dict(poke_length=(0.18, 0.14)), dict(poke_length=0.16),
    dict(poke_length=(0.1, 0.5)), dict(pokes_per_scene=0), dict(finger_radius=-1.0), dict(finger_force=float("inf")),
    dict(finger_speed=0.0), dict(wall_height=0.0), dict(place_within=1.1)], ids=str)
def test_settings_that_cannot_work_are_refused(changed):
    with pytest.raises(ValueError, match=f"^{next(iter(changed))}: expected .*, got ") as caught:
        Settings(**changed)
    assert "\n" not in str(caught.value)


def test_without_pybullet_the_arena_says_so_in_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)  # makes `import pybullet` fail
    with pytest.raises(RuntimeError, match="needs pybullet, which is not installed: pip install pybullet") as caught:
        Arena(Settings(), np.random.default_rng(0))
    assert "\n" not in str(caught.value) and caught.value.__suppress_context__


@pytest.mark.parametrize("width, height", [(16, 12), (64, 48), (640, 480)])
def test_the_camera_sees_the_whole_arena_from_the_front_and_mirrors_x(width, height):
    camera = arena_camera(width, height)
    corners = np.array([[x, y, 0] for x in (-0.25, 0.25) for y in (-0.25, 0.25)])
    pixels = project(corners, camera)
    assert (pixels >= -0.5).all() and (pixels <= np.array([width, height]) - 0.5).all()
    assert np.ptp(pixels, axis=0).min() > 0.8 * height, "from far away"
    assert np.degrees(np.arcsin(-camera.arena_from_camera[2, 2])) == pytest.approx(54, abs=1)
    np.testing.assert_allclose(project(corners * [-1, 1, 1], camera), [width - 1, 0] + pixels * [-1, 1], atol=1e-6)
    reference = (project(corners, arena_camera(64, 48)) + 0.5) / [64, 48]  # the same view at any size
    np.testing.assert_allclose((pixels + 0.5) / [width, height], reference)


@pytest.mark.parametrize("size", [dict(), SHARP], ids=["64 x 48", "128 x 96"])
def test_the_empty_arena_is_the_plane_z_0_between_walls_and_symmetric(size):
    with make_arena(**size) as arena:
        rgb, depth, labels = arena.observe()
    assert rgb.shape == (*depth.shape, 3) and rgb.dtype == labels.dtype == np.uint8 and depth.dtype == np.float32
    assert not labels.any() and np.array_equal(depth, arena.empty_depth) and not arena.bullet.isConnected()
    points = unproject(depth.astype(float), arena.camera)
    out = np.abs(points[..., :2]).max(axis=-1)
    assert (out < 0.25).mean() > 0.4 and np.abs(points[out < 0.25 - 1e-4][:, 2]).max() < 1e-4
    top = (np.abs(out - 0.26) < 0.0099) & (points[..., 2] > 0.025)
    assert top.sum() > 50 and np.median(points[top][:, 2]) == pytest.approx(points[..., 2].max(), abs=1e-4)
    assert points[..., 2].max() == pytest.approx(0.03, abs=1e-4)
    np.testing.assert_allclose(depth, depth[:, ::-1], atol=1e-6)


@pytest.mark.parametrize("kind, axis", [("carton", 0), ("carton", 1), ("bracket", 1), ("wedge", 0)])
def test_objects_and_their_textures_are_seen_where_they_stand(monkeypatch, built, kind, axis):
    # Half red, half blue, repeated every 8 cm: every pixel of the top then tells where it lies on the object.
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:, :32, 0] = picture[:, 32:, 2] = 230
    if axis == 1:  # pictures count rows downwards, texture coordinates count upwards
        picture = np.rot90(picture).copy()
    monkeypatch.setattr(arena_module, "draw_texture", lambda *_: picture)
    with alone(kind, width=256, height=192) as arena:
        (rgb, depth, labels), pose = arena.observe(), arena.poses()[0].astype(float)
        outlines, height, _ = built[arena.bodies[0]]
    points = unproject(depth.astype(float), arena.camera)  # half a pixel of error would move them by millimetres
    local = (points - pose[:3]) @ Rotation.from_quat(pose[3:]).as_matrix()
    assert np.any([inside_outline(local[labels == 1][:, :2], each, 1e-4) for each in outlines], axis=0).all()
    top = (labels == 1) & np.any([inside_outline(local[..., :2], each, -5e-4) for each in outlines], axis=0)
    np.testing.assert_allclose(local[top][:, 2], height / 2, atol=1e-4)
    np.testing.assert_allclose(points[top][:, 2], height, atol=1.5e-3)  # it stands on the table
    for extreme in (np.max, np.min):  # and the top is seen whole, but for a pixel
        np.testing.assert_allclose(extreme(local[top][:, :2], axis=0), extreme(np.concatenate(outlines), axis=0),
                                   atol=0.006)
    phase = local[..., axis] / 0.08 % 1
    clear = cv2.erode(top.astype(np.uint8), np.ones((5, 5))) > 0  # no pixel that blends with its surroundings
    clear &= (np.abs(phase - 0.5) > 0.06) & (phase > 0.06) & (phase < 0.94)
    red = rgb[clear][:, 0] > rgb[clear][:, 2]
    assert 0.1 < red.mean() < 0.9 and np.mean(red == (phase[clear] < 0.5)) > 0.97, "red is blue, or u is v?"


@pytest.mark.parametrize("least, most", [(1, 1), (2, 4), (MAX_OBJECTS, MAX_OBJECTS)])
def test_scenes_have_as_many_objects_as_asked_for_apart_from_each_other(least, most):
    counts = set()
    with make_arena(objects_min=least, objects_max=most, kinds=tuple(objects.KINDS), **FAST) as arena:
        for _ in range(4 + 8 * (most - least)):
            arena.new_scene()
            poses, count = arena.poses(), len(arena.bodies)
            assert poses.shape == (7, 7) and poses.dtype == np.float32
            assert poses[:count].any(axis=1).all() and not poses[count:].any()
            assert len(arena.kinds) == len(arena.radii) == count
            assert arena.bullet.getNumBodies() == count + 6, "objects of the last scene are left"
            counts.add(count)
            for i, body in enumerate(arena.bodies):
                walls = range(1, 5)
                assert not any(arena.bullet.getClosestPoints(body, wall, 0.0) for wall in walls), "it stands in a wall"
                assert not any(arena.bullet.getClosestPoints(body, other, 0.002) for other in arena.bodies[:i])
    assert counts == set(range(least, most + 1))
    with make_arena(objects_min=7, objects_max=7, place_within=0.01, **FAST) as arena:
        with pytest.raises(ValueError, match="objects: 7 do not fit"):
            arena.new_scene()


@pytest.mark.parametrize("kind", objects.KINDS)
def test_every_kind_stands_still_where_it_was_put_and_weighs_what_its_volume_says(kind, built):
    for seed in range(2):
        with alone(kind, seed, **FAST) as arena:
            (outlines, height, taper), before = built[arena.bodies[0]], arena.poses()[0]
            mass, friction = arena.bullet.getDynamicsInfo(arena.bodies[0], -1)[:2]
            arena._step(480)
            assert np.abs(arena.poses()[0] - before).max() < 1e-3
        assert Rotation.from_quat(before[3:]).as_matrix()[2, 2] > 0.9999, "it fell over"
        assert before[2] == pytest.approx(height / 2, abs=1.5e-3)
        assert np.abs(before[:2]).max() <= 0.5 * Settings().place_within / 2 + 1e-3
        volume = sum(ConvexHull(objects.prism(outline, height, taper)).volume for outline in outlines)
        density, (low, high) = objects.KINDS[kind][-2:]
        assert mass == pytest.approx(density * volume, rel=1e-6) and low <= friction <= high


def test_settle_reports_what_still_falls_and_a_snapshot_brings_back_what_was():
    with alone("carton", **FAST) as arena:
        before, state = arena.poses(), arena.bullet.saveState()
        arena.put(0, (0.1, -0.05), turn=0.5)
        moved = arena.poses()[0]
        np.testing.assert_allclose(moved[:3], [0.1, -0.05, before[0, 2] + 0.001], atol=1e-6)
        turn = Rotation.from_quat(moved[3:]) * Rotation.from_quat(before[0, 3:]).inv()
        np.testing.assert_allclose(turn.as_rotvec(), [0, 0, 0.5], atol=1e-5)
        assert arena.settle()
        put(arena, 0, 0, 6.0)
        assert not arena.settle()
        arena.bullet.restoreState(state)
        np.testing.assert_array_equal(arena.poses(), before)
    with make_arena(objects_min=2, objects_max=2, **FAST) as arena:
        arena.new_scene()
        put(arena, 0, 0, 6.0)
        assert not arena.settle(), "the other one is at rest, which is not enough"


def track_of(arena, poke, start):
    """Carry out a poke that comes to rest -> (T, 3): where the finger was after every step while it was lowered."""
    track, step = [], arena._step

    def stepping(count):
        for _ in range(count):
            step(1)
            track.append(arena.bullet.getLinkState(arena._finger, 2, computeForwardKinematics=1)[0])
    arena._step = stepping
    assert arena.poke(np.float32(poke), np.float32(start))
    track = np.array(track) - [0, 0, 0.105]
    assert track[-1, 2] == pytest.approx(PARK_HEIGHT), "it is still down"
    return track[track[:, 2] < 0.5]


@pytest.mark.parametrize("start, target", [((0.04, 0.2), (0.2, 0.2)), ((-0.2, 0.2), (-0.2, 0.04)),
                                           ((0.1, 0.1), (0.2, -0.05)), ((-0.1, -0.2), (-0.2, -0.1))], ids=str)
def test_the_finger_moves_straight_and_pushes_nothing_on_an_empty_path(start, target):
    with alone("can", **FAST) as arena:
        put(arena, 0, 0)
        arena._step(240)
        before, travel = arena.poses(), np.subtract(target, start)
        path = track_of(arena, [*target, np.arctan2(travel[1], travel[0])], start)
        assert np.abs(arena.poses() - before)[0, :2].max() < 1e-4
    along, offset = travel / np.linalg.norm(travel), path[:, :2] - start
    assert np.abs(along[0] * offset[:, 1] - along[1] * offset[:, 0]).max() < 1e-3, "the path is bent"
    assert (np.diff(offset @ along) > -1e-5).all() and np.abs(path[:, 2]).max() < 1e-4
    np.testing.assert_allclose(path[-1, :2], target, atol=3e-4)
    assert np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).max() * 240 == pytest.approx(0.25, rel=0.01)


@pytest.mark.parametrize("mass, force", [(0, 25.0), (50, 25.0), (50, 2000.0), (0.4, 25.0)])  # kg, 0: fixed; N
def test_the_finger_pushes_ahead_what_it_can_and_stalls_at_its_force_limit(mass, force, built):
    # 50 kg hold with about 0.4 * 50 * 9.8 = 200 N of friction, 8 times the limit of 25 N.
    with alone("cross", finger_force=force, **FAST) as arena:
        put(arena, 0, 0)
        arena.bullet.changeDynamics(arena.bodies[0], -1, mass=mass, lateralFriction=0.7)
        assert arena.settle()
        before = arena.poses()[0]
        path, motion = track_of(arena, [0, 0, 0], [-0.16, 0]), arena.poses()[0] - before
    touch = np.concatenate(built[arena.bodies[0]][0])[:, 0].min() - 0.01  # where the finger's axis is then
    assert np.abs(path[:, 1:]).max() < 1e-3, "it slips aside, or climbs"
    if 200 > force and mass in (0, 50):
        assert path[:, 0].max() == pytest.approx(touch, abs=1.5e-3), "it passes through, or never touches"
        assert np.abs(motion).max() < 1e-3
    else:  # as far as the finger is in its way, and it may slide on a little
        assert -touch - 0.002 < motion[0] < -touch + 0.01 and np.abs(motion[1]) < 0.004


def test_a_book_that_is_pushed_in_its_middle_topples_and_is_seen_where_it_lies():
    with alone("book", **SHARP) as arena:
        put(arena, 0, 0)
        assert arena.settle()
        (_, depth, labels), before = arena.observe(), arena.poses()[0].astype(float)
        arena.poke(np.float32([0, 0, np.pi / 2]), np.float32([0, -0.12]))
        assert arena.settle()
        (_, depth_after, labels_after), after = arena.observe(), arena.poses()[0].astype(float)
    assert abs(Rotation.from_quat(after[3:]).as_matrix()[2, 2]) < 0.2 and np.abs(after[:2]).max() < 0.15, "it stands"
    points = unproject(depth_after.astype(float), arena.camera)[labels_after == 1]
    assert len(points) > 100 and points[:, 2].max() < 0.03 < unproject(depth, arena.camera)[labels == 1][:, 2].max()
    local = (points - after[:3]) @ Rotation.from_quat(after[3:]).as_matrix()
    assert (np.abs(local) < [0.037, 0.0105, 0.036]).all() and np.ptp(local[:, 2]) > 0.9 * 2 * before[2]


@pytest.mark.parametrize("turn, beside", [(1.1, 0.6), (1.3, 0.5), (1.5, 0.5)])  # rad; of the object's radius
def test_the_finger_does_not_squeeze_an_object_out_of_the_arenas_corner(turn, beside):
    with alone("carton", **FAST) as arena:
        corner, fastest, step = 0.249 - 0.99 * arena.radii[0], [], arena._step
        arena.put(0, (corner, corner), turn - 2 * np.arctan2(*arena.poses()[0, 5:]))
        assert arena.settle()

        def stepping(count):
            for _ in range(count):
                step(1)
                fastest.append(np.linalg.norm(arena.bullet.getBaseVelocity(arena.bodies[0])[0]))
        arena._step = stepping
        y = arena.poses()[0, 1] + beside * arena.radii[0]
        arena.poke(np.float32([0.2125, y, 0]), np.float32([0.0725, y]))
    assert 0.2 < max(fastest) < 2 * arena.settings.finger_speed, "it shoots away like a seed: too much force?"


@pytest.mark.parametrize("radius, farthest", [(0.01, 0.2375), (0.014, 0.2125)])  # clear of the walls, not farther off
def test_drawn_pokes_aim_at_something_and_start_where_the_finger_fits(built, radius, farthest):
    targets, starts = set(), []
    with make_arena(6, finger_radius=radius, **SHARP) as arena:
        for _ in range(4):
            arena.new_scene()
            (rgb, depth, _), before = arena.observe(), arena.poses()
            scene = scene_of(depth[None], rgb[None], arena.empty_depth, arena.camera, 0.5)
            grid = occupied_grid(scene.points, scene.occupied[0], asdict(arena.settings))
            taken = cell_centres(asdict(arena.settings))[grid.ravel()]
            for _ in range(10):
                poke, start = arena.sample_poke(rgb, depth)
                assert poke.shape == (3,) and start.shape == (2,) and poke.dtype == start.dtype == np.float32
                np.testing.assert_allclose((poke[:2] + 0.25) / 0.025 % 1, 0.5, atol=1e-5)  # a cell's centre
                targets.add(tuple(poke[:2]))
                starts.append(start)
                assert np.abs(taken - start).max(axis=1).min() > 1.5 * 0.025, "on or next to an occupied cell"
                turned = [((poke[:2] - pose[:2]) @ Rotation.from_quat(pose[3:]).as_matrix()[:2, :2], built[body][0])
                          for body, pose in zip(arena.bodies, before)]
                hit = [inside_outline(place, each, 0.019) for place, outlines in turned for each in outlines]
                assert any(hit), "a target where nothing stands: x and y swapped?"  # 0.019: to a cell's corner
            np.testing.assert_array_equal(arena.poses(), before)  # trying where the finger fits moves nothing
            assert arena.bullet.getJointState(arena._finger, 2)[0] == pytest.approx(PARK_HEIGHT)  # lifted again
    assert len(targets) > 20 and np.abs(starts).max() == pytest.approx(farthest)


def test_no_poke_where_there_is_nothing_or_no_room():
    with make_arena() as arena:
        assert arena.sample_poke(*arena.observe()[:2]) is None
    with alone("carton", poke_length=(0.48, 0.49), place_within=0.5) as arena:  # hardly shorter than the arena
        assert arena.sample_poke(*arena.observe()[:2]) is None


def test_a_start_that_only_collision_detection_sees_is_avoided():
    # The camera is told that the can is not there, as if something hid it: the descent itself must find out.
    with alone("can", poke_length=(0.05, 0.12)) as arena:
        put(arena, 0, 0)
        picture = arena.observe()[:2]
        put(arena, 0.1, 0)
        starts = np.array([arena.sample_poke(*picture)[1] for _ in range(60)])
    assert np.linalg.norm(starts - [0.1, 0], axis=1).min() > 0.024 + 0.01
    assert np.linalg.norm(starts, axis=1).max() > 0.1
