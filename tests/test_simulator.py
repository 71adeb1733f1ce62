"""The poke arena: settings, meshes, camera against Bullet's own rays, pokes, background subtraction, collection."""
import importlib.util
import json
import sys
from dataclasses import asdict, fields
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from hind4sight_min import objects, simulator
from hind4sight_min.geometry import project, unproject
from hind4sight_min.interactions import (cell_centres, load_interactions, load_truth, points_and_validity,
                                         true_scene_flow)
from hind4sight_min.objects import HELD_OUT, KINDS, TEXTURES
from hind4sight_min.simulator import (MAX_OBJECTS, Arena, Settings, arena_camera, collect,
                                      collect_shard, draw_texture, occupied_cells)

needs_bullet = pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="pybullet is not installed")
SMALL = Settings(width=32, height=24)  # the fastest pictures in which objects can still be seen
SHARP = dict(width=128, height=96)


def make_arena(seed=0, **changed):
    return Arena(Settings(**changed), np.random.default_rng(seed))


def single(kind, **changed):
    return dict(objects_min=1, objects_max=1, kinds=(kind,), **changed)


def outlines_of(kind, seed):
    """A random object's outlines about their centroid, its height and its taper."""
    outlines, height, taper = KINDS[kind][0](np.random.default_rng(seed))
    return objects.centred(outlines)[0], height, taper


def cross_product(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def inside_outline(points, outline, margin=0.0):
    """Which points (..., 2) lie inside a convex counter-clockwise outline grown by `margin` m at every edge."""
    edges = np.roll(outline, -1, axis=0) - outline
    distance = [cross_product(edge, points - corner) / np.linalg.norm(edge) for corner, edge in zip(outline, edges)]
    return np.min(distance, axis=0) >= -margin


@pytest.fixture
def built(monkeypatch):
    """What every body was made from: body -> (kind, outlines about the centroid, height, taper)."""
    record, real = {}, Arena._add_object

    def add(self, kind, outlines, height, taper, xy):
        body = real(self, kind, outlines, height, taper, xy)
        record[body] = (kind, objects.centred(outlines)[0], height, taper)
        return body

    monkeypatch.setattr(Arena, "_add_object", add)
    return record


def put(arena, body, x, y, z, angle=0.0):
    arena.bullet.resetBasePositionAndOrientation(body, [x, y, z], [0, 0, np.sin(angle / 2), np.cos(angle / 2)],
                                                 physicsClientId=arena._client)


def finger_position(arena):
    """(x, y, z) of the finger in the arena, z = 0 when it is lowered."""
    state = arena.bullet.getLinkState(arena._finger, 2, computeForwardKinematics=1, physicsClientId=arena._client)
    return np.subtract(state[0], [0, 0, 0.105])


def record_finger(arena):
    """The finger's position after every step, appended to the list that is returned."""
    track, step = [], arena._step

    def stepping(count):
        for _ in range(count):
            step(1)
            track.append(finger_position(arena))

    arena._step = stepping
    return track


def lowered(track):
    track = np.array(track)
    return track[track[:, 2] < 0.5]


def cast_rays(arena):
    """Depth and body of what a ray through every pixel's centre meets: Bullet's collision world, no renderer."""
    camera = arena.camera
    v, u = np.mgrid[:camera.height, :camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    rays = rays.reshape(-1, 3) @ camera.arena_from_camera[:3, :3].T
    eye = camera.arena_from_camera[:3, 3]
    hits = arena.bullet.rayTestBatch([eye.tolist()] * len(rays), (eye + 2 * rays).tolist(),
                                     physicsClientId=arena._client)
    depth, body = (np.array([hit[i] for hit in hits]).reshape(u.shape) for i in (2, 0))
    return 2 * depth, body


# --- settings (no Bullet) ---------------------------------------------------------------------------------

def test_default_settings_never_use_what_is_held_out():
    settings = Settings()
    for name in ("kinds", "textures"):
        assert not set(getattr(settings, name)) & set(HELD_OUT[name])
    assert set(settings.kinds) | set(HELD_OUT["kinds"]) == set(KINDS)
    assert set(settings.textures) | set(HELD_OUT["textures"]) == set(TEXTURES)


def test_settings_survive_json():
    settings = Settings(objects_min=2, kinds=("wedge",), poke_length=(0.1, 0.2), width=32, height=24)
    assert Settings(**json.loads(json.dumps(asdict(settings)))) == settings
    assert all(not isinstance(getattr(settings, field.name), list) for field in fields(settings))


@pytest.mark.parametrize("changed, word", [
    (dict(kinds=("carton", "teapot")), "teapot"), (dict(textures=("stripes", "marble")), "marble"),
    (dict(kinds=()), "kinds"), (dict(textures=[]), "textures"), (dict(kinds="can"), "kinds"),
    (dict(objects_min=0), "objects"), (dict(objects_max=8), "objects"), (dict(objects_min=8, objects_max=8), "objects"),
    (dict(objects_min=4, objects_max=3), "objects"), (dict(width=8, height=6), "width, height"),
    (dict(width=64, height=64), "width, height"), (dict(width=0, height=0), "width, height"),
    (dict(width=-64, height=-48), "width, height")], ids=str)
def test_settings_refuse_and_name(changed, word):
    with pytest.raises(ValueError, match=word):
        Settings(**changed)


def test_settings_accept_their_limits():
    assert Settings(objects_min=1, objects_max=MAX_OBJECTS, width=16, height=12, kinds=tuple(KINDS), textures=TEXTURES)


@pytest.mark.parametrize("changed", [
    dict(arena=-0.5), dict(arena=float("nan")), dict(arena=0.6), dict(cell=0), dict(cell=0.03),
    dict(poke_length=(0.18, 0.14)), dict(poke_length=0.16), dict(objects_min=1.5), dict(pokes_per_scene=0),
    dict(pokes_per_scene=2.5),
    dict(finger_speed=0.0), dict(place_within=3.0)], ids=str)
def test_settings_that_cannot_work_are_refused(changed):
    with pytest.raises(ValueError, match=next(iter(changed)).split("_")[0]):
        Settings(**changed)


def test_without_pybullet_the_arena_says_so_in_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)  # makes `import pybullet` fail
    with pytest.raises(RuntimeError, match="needs pybullet, which is not installed: pip install pybullet") as caught:
        make_arena()
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is None and caught.value.__suppress_context__


# --- textures and meshes (no Bullet) ----------------------------------------------------------------------

@pytest.mark.parametrize("name", TEXTURES)
def test_textures(name):
    pictures = [draw_texture(name, np.random.default_rng(seed)) for seed in range(30)]
    for picture in pictures:
        assert picture.shape == (64, 64, 3) and picture.dtype == np.uint8
        colours, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
        assert len(colours) == 2 and counts.min() > 0.1 * 64 * 64  # neither colour is a mere speck
        assert np.abs(colours[0].astype(int) - colours[1]).max() > 20
        small = cv2.resize(picture, (8, 8), interpolation=cv2.INTER_AREA)  # what our small pictures can show
        assert small.reshape(-1, 3).std(axis=0).max() > 10
    np.testing.assert_array_equal(draw_texture(name, np.random.default_rng(7)), pictures[7])
    assert len({picture.tobytes() for picture in pictures}) == 30
    assert draw_texture(name, np.random.default_rng(0), size=32).shape == (32, 32, 3)


def test_unknown_texture():
    with pytest.raises(ValueError, match="marble"):
        draw_texture("marble", np.random.default_rng(0))


@pytest.mark.parametrize("kind", KINDS)
def test_outlines_are_convex_counter_clockwise_and_about_their_common_centroid(kind):
    for seed in range(3):
        outlines, height, taper = outlines_of(kind, seed)
        step = 0.0004
        grid = np.stack(np.meshgrid(*[np.arange(-0.1, 0.1, step)] * 2), axis=-1)
        covered = np.sum([inside_outline(grid, outline) for outline in outlines], axis=0)
        np.testing.assert_allclose(grid[covered > 0].mean(axis=0), 0, atol=step / 2)
        assert (covered > 1).sum() < 0.03 * (covered > 0).sum()  # parts touch at an edge; they do not overlap
        area = objects.centred(outlines)[1]
        assert area == pytest.approx((covered > 0).sum() * step ** 2, rel=0.02)
        for outline in outlines:
            sides = np.roll(outline, -1, axis=0) - outline
            assert (cross_product(sides, np.roll(sides, -1, axis=0)) > 0).all()
        assert height > 0.008 + 0.01 and 0 < taper <= 1  # above the background subtraction's threshold
        # Tall objects would topple when poked near the table.
        assert height < 1.6 * 2 * min(np.linalg.norm(outline, axis=1).max() for outline in outlines)


def test_centroid_of_a_triangle_and_of_two_squares():
    triangle = np.array([[0.0, 0], [3, 0], [1, 3]])
    area, centroid = objects.area_and_centroid(triangle)
    assert area == pytest.approx(4.5)
    np.testing.assert_allclose(centroid, triangle.mean(axis=0))
    squares = [objects.rectangle(0, 0, 2, 2), objects.rectangle(2, 0, 3, 1)]  # areas 4 and 1
    moved, total = objects.centred(squares)
    assert total == pytest.approx(5)
    np.testing.assert_allclose(moved[0][0], [-(4 * 1 + 1 * 2.5) / 5, -(4 * 1 + 1 * 0.5) / 5])
    np.testing.assert_allclose(moved[1] - moved[0][0], squares[1] - squares[0][0])


@pytest.mark.parametrize("kind", KINDS)
def test_mesh_encloses_the_prism_with_normals_outward(kind):
    outlines, height, taper = outlines_of(kind, 1)
    for outline in outlines:
        vertices, normals, uvs, indices = (np.array(v) for v in objects.prism_mesh(outline, height, taper))
        assert vertices.shape == normals.shape == (len(uvs), 3) and uvs.shape[1] == 2
        triangles = vertices[indices.reshape(-1, 3)]
        assert indices.min() >= 0 and indices.max() < len(vertices)
        double_area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        assert (np.linalg.norm(double_area, axis=1) > 1e-8).all()
        # Divergence theorem, seen from a point of the base: the missing base then contributes nothing.
        base = np.array([*outline.mean(axis=0), -height / 2])
        flux = np.einsum("ij,ij->i", triangles.mean(axis=1) - base, double_area) / 2
        assert (flux > 0).all()
        area = ConvexHull(outline).volume  # in two dimensions SciPy's volume is the area
        assert flux.sum() / 3 == pytest.approx(area * height * (1 + taper + taper ** 2) / 3, rel=1e-6)
        assert flux.sum() / 3 == pytest.approx(ConvexHull(objects.prism(outline, height, taper)).volume, rel=1e-6)
        corners = normals[indices.reshape(-1, 3)]
        faces = double_area / np.linalg.norm(double_area, axis=1, keepdims=True)
        np.testing.assert_allclose(corners, np.repeat(faces[:, None], 3, axis=1), atol=1e-6)  # flat, outward, unit
        assert uvs.min() >= 0  # the renderer repeats u, v > 1, not < 0


def test_volume_of_an_untapered_prism_is_area_times_height():
    vertices, _, _, indices = objects.prism_mesh(objects.rectangle(-0.03, -0.02, 0.03, 0.02), 0.05, 1.0)
    triangles = np.array(vertices)[np.reshape(indices, (-1, 3))] + [0, 0, 0.025]
    volume = np.einsum("ij,ij->", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
    assert volume == pytest.approx(0.06 * 0.04 * 0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_texture_keeps_its_scale_on_the_top_face(kind):
    # One texture is 8 cm wide; a coordinate that wraps at a single vertex squeezes it to a smear.
    for seed in range(20):
        outlines, height, taper = outlines_of(kind, seed)
        for outline in outlines:
            uvs = np.array(objects.prism_mesh(outline, height, taper)[2])[:len(outline)]
            np.testing.assert_allclose(uvs - uvs[0], (outline - outline[0]) * taper / 0.08, atol=1e-6)


# --- camera and background subtraction (no Bullet) --------------------------------------------------------

@pytest.mark.parametrize("width, height", [(16, 12), (64, 48), (640, 480)])
def test_camera_sees_the_whole_arena_from_the_front(width, height):
    camera = arena_camera(width, height)
    assert (camera.width, camera.height) == (width, height) and camera.is_mirror_symmetric
    forward = camera.arena_from_camera[:3, 2]
    assert np.degrees(np.arcsin(-forward[2])) == pytest.approx(54, abs=1)
    assert 2 * np.degrees(np.arctan(height / 2 / camera.fy)) == pytest.approx(34.5) and camera.fx == camera.fy
    corners = np.array([[x, y, 0] for x in (-0.25, 0.25) for y in (-0.25, 0.25)])
    pixels = project(corners, camera)
    assert (pixels >= -0.5).all() and (pixels <= np.array([width, height]) - 0.5).all()
    assert np.ptp(pixels, axis=0).min() > 0.8 * height  # and not from far away
    # The same view at any size: (pixel + 1/2) / size does not depend on it.
    reference = (project(corners, arena_camera(64, 48)) + 0.5) / [64, 48]
    np.testing.assert_allclose((pixels + 0.5) / [width, height], reference)


def plane_depth(camera, height):
    """Depth picture of the plane z = height, by ray-plane intersection."""
    v, u = np.mgrid[:camera.height, :camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return (height - camera.arena_from_camera[2, 3]) / (rays @ camera.arena_from_camera[2, :3])


def plateau(camera, x0, y0, x1, y1, height):
    """The empty table, and the table with a floating plate above x0..x1, y0..y1; (x, y) of the plate's pixels."""
    empty, high = plane_depth(camera, 0.0), plane_depth(camera, height)
    xy = unproject(high, camera)[..., :2]
    here = (xy > [x0, y0]).all(axis=-1) & (xy < [x1, y1]).all(axis=-1)
    return empty, np.where(here, high, empty), xy[here]


def test_background_subtraction_finds_the_cells_of_a_plate():
    camera, settings = arena_camera(64, 48), asdict(Settings())
    empty, depth, xy = plateau(camera, -0.06, 0.02, 0.09, 0.13, 0.04)
    expected = np.zeros((20, 20), bool)
    for x, y in xy:
        expected[int((y + 0.25) // 0.025), int((x + 0.25) // 0.025)] = True  # rows along y
    np.testing.assert_array_equal(occupied_cells(depth, empty, camera, settings), expected)
    assert expected[12:14, 8:13].all() and not expected[:10].any() and expected.sum() < 50
    assert not occupied_cells(empty, empty, camera, settings).any()


def test_background_subtraction_ignores_small_changes_missing_depth_and_the_outside():
    camera, settings = arena_camera(64, 48), asdict(Settings())
    empty, low, _ = plateau(camera, -0.1, -0.1, 0.1, 0.1, 0.005)
    assert not occupied_cells(low, empty, camera, settings).any()
    assert occupied_cells(low, empty, camera, settings, threshold=0.002).any()
    _, depth, _ = plateau(camera, -0.1, -0.1, 0.1, 0.1, 0.05)
    raised = depth != empty
    assert not occupied_cells(np.where(raised, 0, depth), empty, camera, settings).any()
    assert not occupied_cells(depth, np.where(raised, 0, empty), camera, settings).any()
    assert not occupied_cells(empty, depth, camera, settings).any()  # farther away than empty: a hole, no object
    _, outside, _ = plateau(camera, 0.251, -0.2, 0.30, 0.2, 0.05)
    assert (outside != empty).sum() > 50 and not occupied_cells(outside, empty, camera, settings).any()


# --- the camera model against Bullet ----------------------------------------------------------------------

@needs_bullet
@pytest.mark.parametrize("size", [dict(), SHARP], ids=["64 x 48", "128 x 96"])
def test_empty_arena_lies_where_the_camera_model_says(size):
    with make_arena(**size) as arena:
        rgb, depth, labels = arena.observe()
    assert rgb.shape == (*depth.shape, 3) and rgb.dtype == np.uint8 and depth.dtype == np.float32
    assert labels.dtype == np.uint8 and not labels.any()
    np.testing.assert_array_equal(depth, arena.empty_depth)
    points = unproject(depth.astype(float), arena.camera)
    inside = np.abs(points[..., :2]).max(axis=-1) < 0.25 - 1e-4
    assert inside.sum() > 0.4 * inside.size
    assert np.abs(points[inside][:, 2]).max() < 1e-4
    on_top = (np.abs(np.abs(points[..., :2]).max(axis=-1) - 0.26) < 0.0099)
    near_top = on_top & (points[..., 2] > 0.025)
    assert near_top.sum() > 50
    assert np.median(points[near_top][:, 2]) == pytest.approx(0.03, abs=1e-4)
    assert points[..., 2].max() == pytest.approx(0.03, abs=1e-4)
    np.testing.assert_allclose(depth, depth[:, ::-1], atol=1e-6)


@needs_bullet
def test_rendered_depth_and_labels_agree_with_rays_through_the_pixel_centres():
    # Half a pixel of error in the projection would move every floor pixel by millimetres.
    with make_arena(3, kinds=("bracket", "cross"), **SHARP) as arena:  # made of boxes: collision shape = mesh
        arena.new_scene()
        _, depth, labels = arena.observe()
        expected, body = cast_rays(arena)
        bodies = [0, *arena.bodies]
    error = np.abs(depth - expected)
    assert np.median(error) < 1e-6 and np.mean(error < 1e-4) > 0.95  # rays round the boxes' edges a little
    seen = np.select([body == b for b in bodies[1:]], np.arange(1, len(bodies)), 0)
    assert (labels > 0).sum() > 300 and np.mean(labels != seen) < 0.004
    edge_free = cv2.erode((labels == seen).astype(np.uint8), np.ones((3, 3))) > 0
    assert np.mean(error[edge_free] < 3e-3) > 0.995


@needs_bullet
def test_a_carton_is_seen_where_it_stands(built):
    for seed in range(4):
        with make_arena(seed, **single("carton", **SHARP)) as arena:
            arena.new_scene()
            _, depth, labels = arena.observe()
            pose, (_, (outline,), height, _) = arena.poses()[0].astype(float), built[arena.bodies[0]]
        assert (arena.bodies and labels.max() == 1) and set(np.unique(labels)) == {0, 1}
        points = unproject(depth.astype(float), arena.camera)[labels == 1]
        local = Rotation.from_quat(pose[3:]).inv().apply(points - pose[:3])
        assert np.abs(local).max(axis=0) == pytest.approx([*outline.max(axis=0), height / 2], abs=0.006)
        assert (np.abs(local) <= [*(outline.max(axis=0) + 1e-4), height / 2 + 1e-4]).all()
        on_top = (np.abs(local[:, :2]) < outline.max(axis=0) - 5e-4).all(axis=1)  # the sides' points lie at the rim
        assert on_top.mean() > 0.3
        np.testing.assert_allclose(local[on_top, 2], height / 2, atol=1e-4)
        np.testing.assert_allclose(points[on_top, 2], height, atol=1.5e-3)  # it stands on the table
        # The top is seen whole, up to one pixel (5 mm of the table across, 6 mm along).
        np.testing.assert_allclose(local[on_top, :2].max(axis=0), outline.max(axis=0), atol=0.006)
        np.testing.assert_allclose(local[on_top, :2].min(axis=0), outline.min(axis=0), atol=0.006)


@needs_bullet
def test_colours_keep_their_order_and_their_place(monkeypatch):
    red = np.zeros((64, 64, 3), np.uint8)
    red[..., 0] = 230
    monkeypatch.setattr(simulator, "draw_texture", lambda *_: red)
    with make_arena(1) as arena:
        arena.new_scene()
        rgb, _, labels = arena.observe()
    redness, blueness = (rgb[..., c].astype(int) - rgb[..., 1] for c in (0, 2))
    looks_red = redness > 40
    assert blueness.max() < 20
    both = (looks_red & (labels > 0)).sum() / (looks_red | (labels > 0)).sum()
    assert both > 0.75  # blended pixels at the rim decide either way


@needs_bullet
@pytest.mark.parametrize("kind", ["carton", "bracket", "wedge"])
@pytest.mark.parametrize("axis", [0, 1], ids=["x", "y"])
def test_textures_lie_on_the_top_at_their_scale(monkeypatch, kind, axis):
    # Half red, half blue, repeated every 8 cm: every pixel of the top then tells where it lies on the object.
    picture = np.zeros((64, 64, 3), np.uint8)
    first, second = ((slice(None), slice(0, 32)), (slice(None), slice(32, 64)))
    if axis == 1:  # pictures count rows downwards, texture coordinates count upwards
        first, second = (slice(32, 64),), (slice(0, 32),)
    picture[first + (..., 0)], picture[second + (..., 2)] = 230, 230
    monkeypatch.setattr(simulator, "draw_texture", lambda *_: picture)
    with make_arena(0, **single(kind, width=256, height=192)) as arena:
        arena.new_scene()
        rgb, depth, labels = arena.observe()
        pose = arena.poses()[0].astype(float)
    offset = unproject(depth.astype(float), arena.camera) - pose[:3]
    local = offset @ Rotation.from_quat(pose[3:]).as_matrix()
    whole = cv2.erode((labels == 1).astype(np.uint8), np.ones((5, 5))) > 0  # no pixel that blends with its surroundings
    whole &= local[..., 2] > local[whole][:, 2].max() - 2e-4
    phase = local[..., axis] / 0.08 % 1
    clear = whole & (np.abs(phase - 0.5) > 0.06) & (phase > 0.06) & (phase < 0.94)
    red = rgb[..., 0].astype(int) > rgb[..., 2]
    assert clear.sum() > 80 and 0.1 < red[clear].mean() < 0.9
    assert np.mean(red[clear] == (phase < 0.5)[clear]) > 0.97


# --- scenes -----------------------------------------------------------------------------------------------

@needs_bullet
@pytest.mark.parametrize("count", [1, MAX_OBJECTS])
def test_number_of_objects_at_the_limits(count):
    with make_arena(objects_min=count, objects_max=count) as arena:
        for _ in range(3):
            arena.new_scene()
            poses, labels = arena.poses(), arena.observe()[2]
            assert len(arena.bodies) == count and poses.shape == (7, 7) and poses.dtype == np.float32
            assert (np.abs(poses[:count]).max(axis=1) > 0).all() and (poses[count:] == 0).all()
            assert labels.max() <= count


@needs_bullet
def test_a_crowded_scene_is_drawn_again_until_everything_has_a_place():
    with make_arena(objects_min=3, objects_max=3, place_within=0.24, width=16, height=12) as arena:
        for _ in range(8):
            arena.new_scene()
            assert len(arena.bodies) == 3 and arena.bullet.getNumBodies(physicsClientId=arena._client) == 3 + 6


@needs_bullet
def test_number_of_objects_varies_between_the_limits():
    with make_arena(objects_min=2, objects_max=4, width=16, height=12) as arena:
        assert {(arena.new_scene(), len(arena.bodies))[1] for _ in range(25)} == {2, 3, 4}


@needs_bullet
def test_only_the_kinds_and_textures_asked_for(monkeypatch, built):
    names, real = [], simulator.draw_texture
    monkeypatch.setattr(simulator, "draw_texture", lambda name, *rest: names.append(name) or real(name, *rest))
    with make_arena(kinds=("can", "cross"), textures=("rings", "dots"), width=16, height=12) as arena:
        for _ in range(8):
            arena.new_scene()
    assert set(names) == {"rings", "dots"}
    assert {spec[0] for spec in built.values()} == {"can", "cross"}


@needs_bullet
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_stands_still_where_it_was_put(kind, built):
    for seed in range(3):
        with make_arena(seed, **single(kind, width=16, height=12)) as arena:
            arena.new_scene()
            height, before = built[arena.bodies[0]][2], arena.poses()[0]
            arena._step(480)
            after = arena.poses()[0]
        assert Rotation.from_quat(before[3:]).as_matrix()[2, 2] > 0.9999  # upright
        assert before[2] == pytest.approx(height / 2, abs=1.5e-3)
        assert np.abs(before[:2]).max() <= 0.5 * Settings().place_within / 2 + 1e-3
        assert np.abs(after - before).max() < 1e-3


@needs_bullet
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_weighs_what_its_volume_says(kind, monkeypatch):
    made, add = [], Arena._add_object
    monkeypatch.setattr(Arena, "_add_object", lambda self, *spec: made.append(spec) or add(self, *spec))
    with make_arena(**single(kind, width=16, height=12)) as arena:
        arena.new_scene()
        mass, friction = arena.bullet.getDynamicsInfo(arena.bodies[0], -1, physicsClientId=arena._client)[:2]
    _, outlines, height, taper, _ = made[-1]
    volume = sum(ConvexHull(objects.prism(each, height, taper)).volume for each in objects.centred(outlines)[0])
    _, density, (low, high) = KINDS[kind]
    assert mass == pytest.approx(density * volume, rel=1e-6) and low <= friction <= high
    assert 0.03 < mass < 1.5  # kg


@needs_bullet
def test_objects_of_a_new_scene_stand_apart_from_each_other_and_from_the_walls():
    with make_arena(2, objects_min=5, objects_max=7, kinds=tuple(KINDS), width=16, height=12) as arena:
        p, client = arena.bullet, arena._client
        for _ in range(5):
            arena.new_scene()
            for i, body in enumerate(arena.bodies):
                low, high = p.getAABB(body, physicsClientId=client)
                assert min(low[:2]) > -0.25 and max(high[:2]) < 0.25
                for other in arena.bodies[:i]:
                    contacts = p.getClosestPoints(body, other, 0.002, physicsClientId=client)
                    assert not contacts, [contact[8] for contact in contacts]


@needs_bullet
def test_settle_reports_what_still_falls():
    with make_arena(**single("carton", width=16, height=12)) as arena:
        arena.new_scene()
        assert arena.settle()
        put(arena, arena.bodies[0], 0, 0, 6.0)
        assert not arena.settle()


@needs_bullet
def test_an_arena_cleans_up_and_does_not_disturb_another():
    def poke_once(arena):
        arena.new_scene()
        depth = arena.observe()[1]
        arena.poke(*arena.sample_poke(depth))
        return arena.poses()

    with make_arena(4) as arena:
        alone = poke_once(arena)
    with make_arena(9) as other:  # connected first: a call that forgets its client would land here
        other.new_scene()
        there = other.poses()
        with make_arena(4) as arena:
            np.testing.assert_array_equal(poke_once(arena), alone)
            folder = arena._folder.name
        np.testing.assert_array_equal(other.poses(), there)
        assert other.bullet.isConnected(other._client) and not arena.bullet.isConnected(arena._client)
    assert not simulator.Path(folder).exists()
    assert arena.bullet_seconds > 0


# --- the finger -------------------------------------------------------------------------------------------

@needs_bullet
@pytest.mark.parametrize("start, target", [((0.04, 0.2), (0.2, 0.2)), ((-0.2, 0.2), (-0.2, 0.04)),
                                           ((0.1, 0.1), (0.2, -0.05)), ((-0.1, -0.2), (-0.2, -0.1))], ids=str)
def test_the_finger_moves_straight_and_pushes_nothing_on_an_empty_path(start, target):
    with make_arena(**single("can", width=16, height=12)) as arena:
        arena.new_scene()
        put(arena, arena.bodies[0], 0, 0, arena.poses()[0, 2])
        arena._step(240)
        before, track = arena.poses(), record_finger(arena)
        travel = np.subtract(target, start)
        assert arena.poke(np.float32([*target, np.arctan2(travel[1], travel[0])]), np.float32(start))
        path, after = lowered(track), arena.poses()
    along = travel / np.linalg.norm(travel)
    offset = path[:, :2] - start
    assert np.abs(cross_product(along, offset)).max() < 5e-4  # straight
    assert (np.diff(offset @ along) > -1e-5).all()  # never back
    assert np.abs(path[:, 2]).max() < 1e-4  # at one height
    np.testing.assert_allclose(path[-1, :2], target, atol=3e-4)
    assert np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).max() * 240 == pytest.approx(0.25, rel=0.01)
    assert np.abs(after - before)[0, :2].max() < 1e-4
    assert np.array(track)[-1, 2] == pytest.approx(simulator.PARK_HEIGHT)


@needs_bullet
@pytest.mark.parametrize("angle", np.arange(8) * np.pi / 4, ids=lambda a: f"{np.degrees(a):.0f}")
def test_a_centred_poke_pushes_a_can_ahead_of_the_finger(angle, built):
    along = np.array([np.cos(angle), np.sin(angle)])
    with make_arena(round(angle / np.pi * 4), **single("can", width=16, height=12)) as arena:
        arena.new_scene()
        body = arena.bodies[0]
        _, (outline,), height, _ = built[body]
        put(arena, body, 0, 0, height / 2 + 0.001)
        arena._step(120)
        before = arena.poses()[0]
        assert arena.poke(np.float32([0, 0, angle]), np.float32(-0.16 * along))
        motion = (arena.poses()[0] - before)[:2]
    # The finger's axis ends where the can's was: the can has gone by both radii, and may slide on a little.
    radii = np.linalg.norm(outline, axis=1).max() + 0.01
    assert radii - 0.002 < motion @ along < radii + 0.01
    assert abs(cross_product(along, motion)) < 0.004


@needs_bullet
@pytest.mark.parametrize("mass", [0, 50], ids=["fixed", "50 kg"])
def test_the_finger_stalls_at_its_force_limit(mass, built):
    # 50 kg hold with about 0.4 * 50 * 9.8 = 200 N of friction, 8 times the limit of 25 N.
    with make_arena(**single("cross", width=16, height=12)) as arena:
        arena.new_scene()
        body = arena.bodies[0]
        _, outlines, height, _ = built[body]
        put(arena, body, 0, 0, height / 2)
        arena.bullet.changeDynamics(body, -1, mass=mass, lateralFriction=0.7, physicsClientId=arena._client)
        assert arena.settle()
        before, track = arena.poses()[0], record_finger(arena)
        assert arena.poke(np.float32([0, 0, 0]), np.float32([-0.16, 0]))
        path, after = lowered(track), arena.poses()[0]
    surface = min(outline[:, 0].min() for outline in outlines) - 0.01
    assert path[:, 0].max() == pytest.approx(surface, abs=1.5e-3)  # it touches and does not pass
    assert np.abs(path[:, 1:]).max() < 1e-3  # nor does it slip aside or climb
    assert np.abs(after - before).max() < 1e-3


@needs_bullet
def test_it_is_the_force_limit_that_stalls_the_finger():
    with make_arena(**single("cross", width=16, height=12, finger_force=2000.0)) as arena:
        arena.new_scene()
        put(arena, arena.bodies[0], 0, 0, arena.poses()[0, 2])
        arena.bullet.changeDynamics(arena.bodies[0], -1, mass=50, lateralFriction=0.7, physicsClientId=arena._client)
        arena.settle()
        before = arena.poses()[0]
        arena.poke(np.float32([0, 0, 0]), np.float32([-0.16, 0]))
        assert arena.poses()[0, 0] - before[0] > 0.03


# --- sampling pokes ---------------------------------------------------------------------------------------

@needs_bullet
def test_background_subtraction_finds_the_objects_and_nothing_else(built):
    settings = Settings(kinds=tuple(KINDS), **SHARP)
    with Arena(settings, np.random.default_rng(5)) as arena:
        assert not occupied_cells(arena.observe()[1], arena.empty_depth, arena.camera, asdict(settings)).any()
        for _ in range(5):
            arena.new_scene()
            occupied = occupied_cells(arena.observe()[1], arena.empty_depth, arena.camera, asdict(settings)).ravel()
            centres, possible = cell_centres(asdict(settings)), np.zeros(400, bool)
            for body, pose in zip(arena.bodies, arena.poses()):
                turn = Rotation.from_quat(pose[3:]).as_matrix()[:2, :2]
                local = (centres - pose[:2]) @ turn
                _, outlines, _, _ = built[body]
                reach = 0.025 * np.sqrt(0.5) + 0.001  # from a cell's centre to its corner
                footprint = np.any([inside_outline(local, o, margin=reach) for o in outlines], axis=0)
                well_inside = np.any([inside_outline(local, o, margin=-0.012) for o in outlines], axis=0)
                possible |= footprint
                assert occupied[footprint].any()
                assert occupied[well_inside].all()
            assert not occupied[~possible].any()


@needs_bullet
def test_sampled_pokes_start_free_and_aim_at_something(built):
    settings, targets = Settings(**SHARP), set()
    shortest, longest = settings.poke_length
    with Arena(settings, np.random.default_rng(6)) as arena:
        for _ in range(4):
            arena.new_scene()
            depth, before = arena.observe()[1], arena.poses()
            occupied = occupied_cells(depth, arena.empty_depth, arena.camera, asdict(settings)).ravel()
            centres = cell_centres(asdict(settings))
            for _ in range(12):
                poke, start = arena.sample_poke(depth)
                assert poke.shape == (3,) and start.shape == (2,) and poke.dtype == start.dtype == np.float32
                cell = np.argmin(np.linalg.norm(centres - poke[:2], axis=1))
                np.testing.assert_allclose(centres[cell], poke[:2], atol=1e-6)
                assert occupied[cell]
                targets.add(cell)
                travel = poke[:2].astype(float) - start
                assert shortest - 1e-6 <= np.linalg.norm(travel) <= longest + 1e-6
                direction = np.array([np.cos(poke[2]), np.sin(poke[2])])
                np.testing.assert_allclose(direction, travel / np.linalg.norm(travel), atol=1e-5)
                assert np.abs(start).max() < 0.25 - 0.01
                assert not occupied[np.abs(centres - start).max(axis=1) < 1.5 * 0.025].any()  # nor any cell around it
                for body, pose in zip(arena.bodies, before):  # the finger, 1 cm in radius, fits beside every object
                    local = (start - pose[:2]) @ Rotation.from_quat(pose[3:]).as_matrix()[:2, :2]
                    assert not any(inside_outline(local, o * built[body][3], margin=0.01) for o in built[body][1])
            np.testing.assert_array_equal(arena.poses(), before)  # trying where the finger fits moves nothing
            assert finger_position(arena)[2] == pytest.approx(simulator.PARK_HEIGHT)  # lifted again
    assert len(targets) > 20


@needs_bullet
def test_no_poke_where_there_is_nothing_or_no_room():
    with make_arena(**single("carton")) as arena:
        assert arena.sample_poke(arena.observe()[1]) is None
    with make_arena(**single("carton", poke_length=(0.48, 0.49))) as arena:  # longer than the arena
        arena.new_scene()
        assert arena.sample_poke(arena.observe()[1]) is None


@needs_bullet
def test_a_start_that_only_collision_detection_sees_is_avoided():
    # The camera is told that the can is not there, as if something hid it: the descent itself must find out.
    with make_arena(**single("can", poke_length=(0.05, 0.12))) as arena:
        arena.new_scene()
        body, z = arena.bodies[0], arena.poses()[0, 2]
        put(arena, body, 0, 0, z)
        depth = arena.observe()[1]
        put(arena, body, 0.1, 0, z)
        starts = np.array([arena.sample_poke(depth)[1] for _ in range(60)])
    assert np.linalg.norm(starts - [0.1, 0], axis=1).min() > 0.024 + 0.01
    assert np.linalg.norm(starts, axis=1).max() > 0.1


# --- dropped pokes ----------------------------------------------------------------------------------------

def fabricate(changed={}, labels_before=(0, 1, 2), labels=(0, 1, 2), at_rest=True):
    arena = SimpleNamespace(bodies=[10, 11], settings=Settings())
    poses = np.zeros((7, 7), np.float32)
    poses[:2, 2], poses[:2, 6] = 0.02, 1
    for where, value in changed.items():
        poses[where] = value
    return simulator._trouble(arena, np.array([labels_before]), ((None, None, np.array([labels])), poses), at_rest)


@pytest.mark.parametrize("expected, situation", [
    (None, {}), (None, dict(changed={(0, 0): -0.24})), (None, dict(labels=(2, 0, 1))),
    ("left_arena", dict(changed={(1, 0): 0.26})), ("left_arena", dict(changed={(0, 1): -0.26})),
    ("left_arena", dict(changed={(1, 2): -0.01})), ("left_arena", dict(changed={(1, 0): 3.0}, labels=(0, 1, 1))),
    ("not_at_rest", dict(at_rest=False)),
    ("out_of_view", dict(labels=(0, 1, 1))), ("out_of_view", dict(labels_before=(0, 0, 2)))], ids=str)
def test_reasons_to_drop_a_poke(expected, situation):
    assert fabricate(**situation) == expected


@needs_bullet
def test_dropped_pokes_are_counted_and_not_kept(monkeypatch):
    script = iter(["no_free_start", "left_arena", "kept", "out_of_view", "not_at_rest", "left_arena", "kept", "kept"])
    current, real_poke, real_sample = [None], Arena.poke, Arena.sample_poke

    def sample(self, depth):
        current[0] = next(script)
        return None if current[0] == "no_free_start" else real_sample(self, depth)

    def poke(self, *drawn):
        real_poke(self, *drawn)
        moved_to = {"left_arena": (0.4, 0, 0.03), "out_of_view": (0, 0, 1.5), "not_at_rest": (0, 0, 7.0)}
        if current[0] in moved_to:
            put(self, self.bodies[0], *moved_to[current[0]])
        return self.settle() if current[0] == "not_at_rest" else True

    monkeypatch.setattr(Arena, "sample_poke", sample)
    monkeypatch.setattr(Arena, "poke", poke)
    interactions, truth, _ = collect_shard(SMALL, 0, 0, 3)
    assert interactions.meta["counts"] == {"kept": 3, "left_arena": 2, "out_of_view": 1, "not_at_rest": 1,
                                           "no_free_start": 1}
    assert len(interactions) == len(truth.labels) == 3
    for poses in (truth.poses_before, truth.poses_after):
        assert np.abs(poses[..., :2]).max() < 0.25 and poses[..., 2].max() < 0.1
    # After a dropped poke comes a new scene, so the first poke kept is followed by other objects.
    assert np.abs(truth.poses_before[1] - truth.poses_after[0]).max() > 0.01
    np.testing.assert_array_equal(truth.poses_before[2], truth.poses_after[1])


# --- a shard ----------------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def shard():
    """Twelve pokes in two scenes, in pictures sharp enough to measure in."""
    return collect_shard(Settings(**SHARP), 5, 0, 12)[:2]


def same(first, second):
    names = ("rgb_before", "rgb_after", "depth_before", "depth_after", "pokes", "starts", "empty_depth")
    return all(np.array_equal(getattr(first[0], name), getattr(second[0], name)) for name in names) and all(
        np.array_equal(getattr(first[1], name), getattr(second[1], name))
        for name in ("labels", "poses_before", "poses_after"))


@needs_bullet
def test_true_flow_carries_the_objects_onto_the_cloud_after_the_poke(shard):
    interactions, truth = shard
    with_flow, without = [], []
    for i in range(len(interactions)):
        points, _ = points_and_validity(interactions.depth_before[i], interactions.camera)
        after, _ = points_and_validity(interactions.depth_after[i], interactions.camera)
        flow = true_scene_flow(points, truth.labels[i], truth.poses_before[i], truth.poses_after[i])
        moving = np.linalg.norm(flow, axis=-1) > 0.01
        assert not moving[truth.labels[i] == 0].any()
        tree = cKDTree(after.reshape(-1, 3))
        with_flow += tree.query((points + flow)[moving])[0].tolist()
        without += tree.query(points[moving])[0].tolist()
    assert len(with_flow) > 500
    assert np.median(with_flow) < 0.004 and np.quantile(with_flow, 0.9) < 0.008  # pixels lie 5 mm apart
    assert np.median(without) > 2 * np.median(with_flow)


@needs_bullet
def test_what_stays_still_looks_the_same_after_the_poke(shard):
    interactions, truth = shard
    still = (truth.labels == 0) & (np.abs(interactions.depth_before - interactions.empty_depth) < 1e-5)
    change = np.abs(interactions.depth_after - interactions.depth_before)
    assert np.mean(change[still] < 1e-5) > 0.95  # the rest is where an object went
    background = np.abs(interactions.depth_before - interactions.empty_depth)[truth.labels == 0]
    np.testing.assert_allclose(background, 0, atol=1e-5)  # nor is the finger in the picture


@needs_bullet
def test_a_shard_keeps_its_promises(shard):
    interactions, truth = shard
    settings = interactions.meta["settings"]
    assert Settings(**settings) == Settings(**SHARP)
    assert interactions.meta["counts"]["kept"] == len(interactions) == 12 and interactions.grid_shape == (20, 20)
    for i in range(12):
        occupied = occupied_cells(interactions.depth_before[i], interactions.empty_depth, interactions.camera, settings)
        column, row = ((interactions.pokes[i, :2] + 0.25) / 0.025).astype(int)
        assert occupied[row, column]
    travel = interactions.pokes[:, :2] - interactions.starts
    shortest, longest = settings["poke_length"]
    assert np.linalg.norm(travel, axis=1).min() > shortest - 1e-6
    assert np.linalg.norm(travel, axis=1).max() < longest + 1e-6
    np.testing.assert_allclose(np.arctan2(travel[:, 1], travel[:, 0]), interactions.pokes[:, 2], atol=1e-5)
    moved = np.linalg.norm(truth.poses_after - truth.poses_before, axis=-1).max(axis=1)
    assert (moved > 0.005).mean() > 0.5  # most pokes hit


@needs_bullet
def test_pokes_of_a_scene_follow_each_other_and_scenes_last_as_long_as_the_settings_say(shard):
    interactions, truth = shard
    assert sum(interactions.meta["counts"].values()) == 12, "a dropped poke would shift the scenes: take another seed"
    for i in range(1, 12):
        follows = np.array_equal(truth.poses_before[i], truth.poses_after[i - 1])
        assert follows == (i % 6 != 0)
        assert np.array_equal(interactions.depth_before[i], interactions.depth_after[i - 1]) == follows


@needs_bullet
def test_a_shard_depends_on_its_arguments_only():
    first, again = (collect_shard(SMALL, 3, 1, 4)[:2] for _ in range(2))
    assert same(first, again) and first[0].meta == again[0].meta
    for seed, index in ((4, 1), (3, 0)):
        other = collect_shard(SMALL, seed, index, 4)[:2]
        assert not np.array_equal(first[0].pokes, other[0].pokes)
        assert not np.array_equal(first[1].poses_before, other[1].poses_before)
    shorter = collect_shard(SMALL, 3, 1, 2)[0]
    np.testing.assert_array_equal(shorter.pokes, first[0].pokes[:2])


@needs_bullet
def test_held_out_kinds_and_textures_can_be_collected(built):
    interactions, truth, seconds = collect_shard(Settings(**HELD_OUT, width=32, height=24), 0, 0, 4)
    assert {spec[0] for spec in built.values()} == set(HELD_OUT["kinds"])
    assert len(interactions) == 4 and seconds > 0
    assert (np.linalg.norm(truth.poses_after - truth.poses_before, axis=-1).max(axis=1) > 0.005).any()


# --- collection -------------------------------------------------------------------------------------------

@pytest.fixture
def short_shards(monkeypatch):
    """Shards of 5 pokes. Worker processes are told their shard's size, so this reaches them too."""
    monkeypatch.setattr(simulator, "SHARD_POKES", 5)


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """Twelve pokes in three shards: (folder, what `collect` returned, what it reported on the way)."""
    folder, reports = tmp_path_factory.mktemp("collected") / "train", []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator, "SHARD_POKES", 5)
        result = collect(folder, 12, 3, SMALL, progress=lambda done, total: reports.append((done, total)))
    return folder, result, reports


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def copy(folder, target):
    target.mkdir()
    for name, content in contents(folder).items():
        (target / name).write_bytes(content)
    return target


@needs_bullet
def test_collect_writes_shards_and_reports(collected):
    folder, result, reports = collected
    assert sorted(contents(folder)) == [f"shard_000{i}{end}" for i in range(3) for end in (".npz", ".truth.npz")]
    assert len(load_interactions(folder)) == len(load_truth(folder).labels) == 12
    assert reports == [(5, 12), (10, 12), (12, 12)]
    assert result["counts"]["kept"] == 12 and set(result["counts"]) == {"kept", "left_arena", "out_of_view",
                                                                        "not_at_rest", "no_free_start"}
    assert result["seconds"] > 0 and 0 < result["share_in_bullet"] < 1
    np.testing.assert_array_equal(load_interactions(folder).pokes[5:10], collect_shard(SMALL, 3, 1, 5)[0].pokes)


@needs_bullet
def test_the_number_of_jobs_does_not_change_a_byte(collected, short_shards, tmp_path):
    reports = []
    result = collect(tmp_path / "two", 12, 3, SMALL, jobs=2, progress=lambda *report: reports.append(report))
    assert contents(tmp_path / "two") == contents(collected[0])
    assert result["counts"] == collected[1]["counts"] and len(reports) == 3 and reports[-1] == (12, 12)


@needs_bullet
def test_another_seed_gives_other_data(collected, short_shards, tmp_path):
    collect(tmp_path / "other", 5, 4, SMALL)
    assert (tmp_path / "other" / "shard_0000.npz").read_bytes() != contents(collected[0])["shard_0000.npz"]


@needs_bullet
@pytest.mark.parametrize("lost", [["shard_0001.npz", "shard_0001.truth.npz"], ["shard_0002.npz"]], ids=str)
def test_collecting_again_makes_only_what_is_missing(collected, short_shards, tmp_path, lost):
    folder, reports = copy(collected[0], tmp_path / "again"), []
    for name in lost:
        (folder / name).unlink()
    kept = {path.name: path.stat().st_mtime_ns for path in folder.glob("shard_0000*")}
    result = collect(folder, 12, 3, SMALL, progress=lambda *report: reports.append(report))
    assert contents(folder) == contents(collected[0])
    assert {name: (folder / name).stat().st_mtime_ns for name in kept} == kept
    assert result["counts"] == collected[1]["counts"] and reports == [(12, 12)]


@needs_bullet
def test_collecting_into_a_full_folder_changes_nothing(collected, short_shards, monkeypatch):
    monkeypatch.setattr(simulator, "collect_shard", lambda *_: pytest.fail("nothing was missing"))
    before = contents(collected[0])
    assert collect(collected[0], 12, 3, SMALL)["counts"] == collected[1]["counts"]
    assert contents(collected[0]) == before


@needs_bullet
def test_a_lost_truth_file_is_made_again(collected, short_shards, tmp_path):
    folder = copy(collected[0], tmp_path / "again")
    (folder / "shard_0001.truth.npz").unlink()
    collect(folder, 12, 3, SMALL)
    assert contents(folder) == contents(collected[0])


@needs_bullet
@pytest.mark.parametrize("changed", [
    dict(seed=4), dict(settings=Settings(width=64, height=48)), dict(settings=Settings(width=32, height=24, arena=0.4)),
    dict(settings=Settings(width=32, height=24, kinds=("can",))), dict(pokes=11), dict(pokes=5)], ids=str)
def test_a_folder_with_other_data_is_refused(collected, short_shards, changed):
    before = contents(collected[0])
    with pytest.raises(ValueError, match="holds") as caught:
        collect(collected[0], **{**dict(pokes=12, seed=3, settings=SMALL), **changed})
    assert str(collected[0]) in str(caught.value)
    assert contents(collected[0]) == before


@needs_bullet
@pytest.mark.parametrize("missing, pokes", [(0, 10), (1, 5)])  # an early one; one that leaves a gap
def test_too_many_shards_are_refused_even_if_one_is_missing(collected, short_shards, tmp_path, missing, pokes):
    folder = copy(collected[0], tmp_path / "again")
    for name in (f"shard_{missing:04d}.npz", f"shard_{missing:04d}.truth.npz"):
        (folder / name).unlink()
    with pytest.raises(ValueError, match="number of pokes"):
        collect(folder, pokes, 3, SMALL)  # would leave more of them in the folder


@needs_bullet
def test_other_data_without_truth_are_not_overwritten(collected, short_shards, tmp_path):
    folder = copy(collected[0], tmp_path / "again")
    for path in folder.glob("*.truth.npz"):  # training needs none, so a folder may well come without
        path.unlink()
    before = contents(folder)
    with pytest.raises(ValueError, match="holds data of another seed"):
        collect(folder, 12, 4, SMALL)
    assert contents(folder) == before


@needs_bullet
def test_a_damaged_shard_is_not_taken_for_a_finished_one(collected, short_shards, tmp_path):
    folder = copy(collected[0], tmp_path / "again")
    (folder / "shard_0001.npz").write_bytes(contents(folder)["shard_0001.npz"][:1000])
    with pytest.raises(ValueError, match="shard_0001.npz"):
        collect(folder, 12, 3, SMALL)


@pytest.mark.parametrize("changed, name", [(dict(pokes=0), "pokes"), (dict(pokes=-5), "pokes"), (dict(jobs=0), "jobs"),
                                           (dict(seed=-1), "seed")], ids=str)
def test_collect_refuses_bad_counts(tmp_path, changed, name):
    with pytest.raises(ValueError, match=f"{name}.*{changed[name]}"):
        collect(tmp_path / "new", **{**dict(pokes=1, seed=0), **changed})
    assert not (tmp_path / "new").exists()


@needs_bullet
def test_settings_that_give_no_scene_or_no_poke_end_in_an_error(monkeypatch):
    crowd = Settings(objects_min=7, objects_max=7, place_within=0.1, width=16, height=12)
    with Arena(crowd, np.random.default_rng(0)) as arena, pytest.raises(ValueError, match="do not fit"):
        arena.new_scene()
    monkeypatch.setattr(Arena, "sample_poke", lambda *_: None)
    with pytest.raises(ValueError, match="no_free_start"):
        simulator.collect_shard(Settings(width=16, height=12), 0, 0, 1)
