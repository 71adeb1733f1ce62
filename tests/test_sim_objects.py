"""What lies in the arena: shapes, their meshes and textures. Nothing here needs Bullet."""
import cv2
import numpy as np
import pytest
from helpers import inside_outline
from scipy.spatial import ConvexHull

from hind4sight_min.sim import objects
from hind4sight_min.sim.objects import KINDS, TEXTURES


@pytest.mark.parametrize("kind", KINDS)
def test_outlines_are_convex_counter_clockwise_and_about_their_common_centroid(kind):
    step = 0.0005
    grid = np.stack(np.meshgrid(*[np.arange(-0.085, 0.085, step)] * 2), axis=-1)
    for seed in range(2):
        outlines, area, height, taper = objects.draw_shape(kind, np.random.default_rng(seed))
        covered = np.sum([inside_outline(grid, outline) for outline in outlines], axis=0)
        np.testing.assert_allclose(grid[covered > 0].mean(axis=0), 0, atol=step / 2)
        assert (covered > 1).sum() < 0.03 * (covered > 0).sum(), "parts overlap: they weigh twice"
        assert area == pytest.approx((covered > 0).sum() * step ** 2, rel=0.04)
        for outline in outlines:
            sides = np.roll(outline, -1, axis=0) - outline
            assert (np.linalg.det(np.stack([sides, np.roll(sides, -1, axis=0)], axis=1)) > 0).all()
        for value, (low, high) in ((height, KINDS[kind][2]), (taper, KINDS[kind][3] or (1, 1))):
            assert low <= value <= high
        assert height > 0.008 + 0.01, "background subtraction does not see it"
        assert height < 1.6 * 2 * min(np.linalg.norm(outline, axis=1).max() for outline in outlines), "it topples"


@pytest.mark.parametrize("kind", KINDS)
def test_the_mesh_encloses_the_prisms(kind):
    outlines, _, height, taper = objects.draw_shape(kind, np.random.default_rng(1))
    vertices, normals, uvs, indices = map(np.array, objects.mesh(outlines, height, taper))
    assert vertices.shape == normals.shape == (len(uvs), 3)
    a, b, c = np.moveaxis(vertices[indices.reshape(-1, 3)], 1, 0)
    # Divergence theorem, seen from a point of no face's plane, so that every face counts.
    volume = np.einsum("ij,ij->", (a + b + c) / 3 - [0.01, 0.02, -height], np.cross(b - a, c - a)) / 6
    expected = sum(ConvexHull(objects.prism(each, height, taper)).volume for each in outlines)
    assert volume == pytest.approx(expected), "a face is missing, or inside out"


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
