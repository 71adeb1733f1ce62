"""What lies in the arena: shapes, their meshes and textures. Nothing here needs Bullet."""
import cv2
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from hind4sight_min.sim import objects
from hind4sight_min.sim.objects import KINDS, TEXTURES


def cross_product(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def inside_outline(points, outline):
    """Which points (..., 2) lie inside a convex counter-clockwise outline."""
    edges = np.roll(outline, -1, axis=0) - outline
    return np.min([cross_product(edge, points - corner) for corner, edge in zip(outline, edges)], axis=0) >= 0


@pytest.mark.parametrize("kind", KINDS)
def test_outlines_are_convex_counter_clockwise_and_about_their_common_centroid(kind):
    step = 0.0005
    grid = np.stack(np.meshgrid(*[np.arange(-0.085, 0.085, step)] * 2), axis=-1)
    for seed in range(2):
        outlines, area, height, taper = objects.draw_shape(kind, np.random.default_rng(seed))
        covered = np.sum([inside_outline(grid, outline) for outline in outlines], axis=0)
        np.testing.assert_allclose(grid[covered > 0].mean(axis=0), 0, atol=step / 2)
        assert (covered > 1).sum() < 0.03 * (covered > 0).sum(), "parts overlap: they weigh twice"
        assert area == pytest.approx((covered > 0).sum() * step ** 2, rel=0.02)
        for outline in outlines:
            sides = np.roll(outline, -1, axis=0) - outline
            assert (cross_product(sides, np.roll(sides, -1, axis=0)) > 0).all()
        for value, (low, high) in ((height, KINDS[kind][2]), (taper, KINDS[kind][3] or (1, 1))):
            assert low <= value <= high
        assert height > 0.008 + 0.01, "background subtraction does not see it"
        assert height < 1.6 * 2 * min(np.linalg.norm(outline, axis=1).max() for outline in outlines), "it topples"


@pytest.mark.parametrize("kind", KINDS)
def test_the_mesh_encloses_the_prisms_with_normals_outward(kind):
    outlines, area, height, taper = objects.draw_shape(kind, np.random.default_rng(1))
    vertices, normals, uvs, indices = map(np.array, objects.mesh(outlines, height, taper))
    assert vertices.shape == normals.shape == (len(uvs), 3)
    a, b, c = np.moveaxis(vertices[indices.reshape(-1, 3)], 1, 0)
    normal = np.cross(b - a, c - a)
    # Divergence theorem, seen from a point of the base's plane: the missing bases then contribute nothing.
    volume = np.einsum("ij,ij->", (a + b + c) / 3 - [0, 0, -height / 2], normal) / 6
    assert volume == pytest.approx(area * height * (1 + taper + taper ** 2) / 3, rel=1e-6), "a face is inside out"
    assert volume == pytest.approx(sum(ConvexHull(objects.prism(each, height, taper)).volume for each in outlines))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(normals[indices.reshape(-1, 3)], np.repeat(normal[:, None], 3, axis=1), atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_textures_keep_their_scale_of_8_cm(kind):
    outlines, _, height, taper = objects.draw_shape(kind, np.random.default_rng(1))
    vertices, _, uvs, indices = map(np.array, objects.mesh(outlines, height, taper))
    top = outlines[0] * taper / 0.08
    np.testing.assert_allclose(uvs[:len(top)] - uvs[0], top - top[0], atol=1e-6)
    assert uvs.min() >= 0, "the renderer repeats u, v > 1, not < 0"
    if taper == 1:  # lengths in the texture are lengths on the object, on every face
        on_object, in_texture = (each[indices.reshape(-1, 3)] for each in (vertices / 0.08, uvs))
        np.testing.assert_allclose(*(np.linalg.norm(np.roll(each, 1, axis=1) - each, axis=2)
                                     for each in (on_object, in_texture)), atol=1e-6)


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_have_two_colours_that_a_small_picture_can_show(name):
    pictures = [objects.draw_texture(name, np.random.default_rng(seed)) for seed in range(30)]
    for picture in pictures:
        assert picture.shape == (64, 64, 3) and picture.dtype == np.uint8
        colours, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
        assert len(colours) == 2 and counts.min() > 0.1 * 64 * 64, "one colour is a mere speck"
        assert np.abs(colours[0].astype(int) - colours[1]).max() > 20
        small = cv2.resize(picture, (8, 8), interpolation=cv2.INTER_AREA)
        assert small.reshape(-1, 3).std(axis=0).max() > 10
    np.testing.assert_array_equal(objects.draw_texture(name, np.random.default_rng(7)), pictures[7])
    assert len({picture.tobytes() for picture in pictures}) == 30
