"""Equations 2-6 and the loss of masks: values and gradients against loops, SciPy and finite differences."""
import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad
from autograd.test_util import check_grads
from scipy.ndimage import map_coordinates
from scipy.special import log_softmax, softmax

from hind4sight_min import losses
from hind4sight_min.geometry import Camera, free_radius, look_at, ray_spacing, unproject
from hind4sight_min.losses import (PAPER_WEIGHTS, association_loss, chamfer_loss, distance_maps,
                                   distance_smoothness_loss, edge_aware_smoothness, edge_weights, embedding_loss,
                                   flow_smoothness_loss, full_loss, heatmap_cross_entropy, inverse_loss,
                                   photometric_loss, seen_in_both, sharing_loss, warp_backward)

B, H, W = 2, 4, 6
N = H * W


def pulled_back(function, argnum, g, *args):
    """Gradient of sum(g * function(*args)) with respect to one argument."""
    return grad(lambda *args: anp.sum(g * function(*args)), argnum)(*args)


def clouds(rng, share=1.0):
    return (rng.normal(size=(B, N, 3)), rng.normal(size=(B, N, 3)), rng.random((B, N)) < share,
            rng.random((B, N)) < share)


# --- what is compared at all --------------------------------------------------------------------------------

def test_seen_in_both_leaves_out_the_table_that_the_other_frame_hides():
    every = np.array(np.meshgrid(*[[False, True]] * 4)).reshape(4, 1, -1)  # all 16 cases, as one row of pixels
    shared, next_shared = seen_in_both(*every)
    for i, (valid, next_valid, occupied, next_occupied) in enumerate(every[:, 0].T):
        assert shared[0, i] == (valid and not (next_occupied and not occupied))
        assert next_shared[0, i] == (next_valid and not (occupied and not next_occupied))


def test_chamfer_of_the_true_flow_is_zero_and_dragging_the_table_does_not_pay():
    # A row of pixels 1 cm apart; a block 5 cm high on pixels 5 to 8 is pushed on by 3.
    def cloud(first):
        points, occupied = np.zeros((1, 20, 3)), np.zeros((1, 20), bool)
        points[0, :, 0] = 0.01 * np.arange(20)
        occupied[0, first:first + 4] = True
        points[..., 2] = 0.05 * occupied
        return points, occupied
    (before, occupied), (after, next_occupied) = cloud(5), cloud(8)
    push = np.array([0.03, 0, 0])
    true = before + push * occupied[..., None]
    dragged = true.copy()
    dragged[0, 9:12] += push  # the table in front of the block, and that behind it into its place
    dragged[0, 2:5] += push
    valid = np.ones((1, 20), bool)
    shared = seen_in_both(valid, valid, occupied, next_occupied)
    plain, compared = ([chamfer_loss(*distance_maps(flow, after, *masks))[0] for flow in (true, dragged)]
                       for masks in ((valid, valid), shared))
    assert plain[0] > 0.001 and plain[1] < plain[0]  # without it the wrong flow wins
    assert compared[0] < 1e-12 and compared[1] >= compared[0]


# --- 3D: Eq. (2) ------------------------------------------------------------------------------------------

def loop_distance_maps(predicted, observed, valid_predicted, valid_observed, g_predicted, g_observed):
    """Brute force -> the two maps, and the gradient of sum(g_predicted * first) + sum(g_observed * second)."""
    maps, gradients = np.zeros((2, B, N)), np.zeros((2, B, N, 3))
    clouds, valid, g = (predicted, observed), (valid_predicted, valid_observed), (g_predicted, g_observed)
    for here, there in ((0, 1), (1, 0)):
        for b in range(B):
            others = np.flatnonzero(valid[there][b])
            for i in np.flatnonzero(valid[here][b]):
                differences = clouds[here][b, i] - clouds[there][b, others]
                squares = (differences ** 2).sum(axis=1)
                nearest = squares.argmin()
                maps[here, b, i] = squares[nearest]
                pull = 2 * g[here][b, i] * differences[nearest]
                gradients[here, b, i] += pull
                gradients[there, b, others[nearest]] -= pull
    return maps, gradients


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_distance_maps_and_gradients_match_brute_force(share):
    # Eq. (2)
    rng = np.random.default_rng(0)
    inputs, g = clouds(rng, share), rng.normal(size=(2, B, N))

    def weighted(predicted, observed):
        first, second = distance_maps(predicted, observed, *inputs[2:])
        return anp.sum(first * g[0]) + anp.sum(second * g[1])

    expected, gradients = loop_distance_maps(*inputs, *g)
    found = distance_maps(*inputs)
    for a_map, wanted in zip(found, expected):
        assert a_map.shape == (B, N)
        np.testing.assert_allclose(a_map, wanted, rtol=0, atol=1e-12)
    for argnum in (0, 1):
        gradient = grad(weighted, argnum)(*inputs[:2])
        assert gradient.shape == (B, N, 3)
        np.testing.assert_allclose(gradient, gradients[argnum], rtol=0, atol=1e-12)
        assert not gradient[~inputs[2 + argnum]].any() and gradient[inputs[2 + argnum]].any()
    check_grads(weighted, (0, 1), modes=["rev"], order=1)(*inputs[:2])


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_points_spared_the_search_have_the_distances_and_gradients_of_those_searched(noise):
    rng, camera = np.random.default_rng(19), Camera(16, 12, 20.0, 20.0, 7.5, 5.5, look_at([0, -0.46, 0.62], [0, 0, 0]))
    before = 0.75 + 0.02 * rng.random((3, 12, 16))
    after = before + noise * rng.standard_normal(before.shape)
    after[:, 3:6, 4:8] -= 0.04
    points, observed = (unproject(depth, camera).reshape(3, -1, 3) for depth in (before, after))
    predicted = points + 1e-4 * rng.standard_normal(points.shape)
    predicted[:, 50:70] += rng.uniform(-0.04, 0.04, (3, 20, 3))
    valid, next_valid = rng.random((2, 3, 192)) < 0.9
    free = free_radius(points, predicted, ray_spacing(points, camera)), ray_spacing(observed, camera)
    g = rng.standard_normal((2, 3, 192))

    def total(predicted, observed, *free):
        here, there = distance_maps(predicted, observed, valid, next_valid, *free)
        return anp.sum(g[0] * here) + anp.sum(g[1] * there)
    for found, expected in zip(distance_maps(predicted, observed, valid, next_valid, *free),
                               distance_maps(predicted, observed, valid, next_valid)):
        np.testing.assert_array_equal(found, expected)
    for argnum in (0, 1):
        np.testing.assert_array_equal(grad(total, argnum)(predicted, observed, *free),
                                      grad(total, argnum)(predicted, observed))
    spared = 4 * ((predicted - observed) ** 2).sum(axis=2) < free[1] ** 2
    assert spared.any() and not spared.all() and (noise or spared.mean() > 0.5)


def test_chamfer_loss_is_squared_both_ways_and_summed():
    # Eq. (2)
    # On a line: P' = {0, 1}, P = {3, 8}. P' -> P: 3^2 + 2^2; P -> P': 2^2 + 7^2. Other conventions give
    # 13 (one way), 33 (means) or 14 (not squared).
    predicted = np.array([[[0.0, 0, 0], [1, 0, 0]]])
    observed = np.array([[[3.0, 0, 0], [8, 0, 0]]])
    valid = np.ones((1, 2), bool)

    def chamfer(predicted, observed):
        return chamfer_loss(*distance_maps(predicted, observed, valid, valid))

    first, second = distance_maps(predicted, observed, valid, valid)
    np.testing.assert_allclose(first, [[9, 4]])
    np.testing.assert_allclose(second, [[4, 49]])
    np.testing.assert_allclose(chamfer(predicted, observed), [66])
    gradient = pulled_back(chamfer, 0, 1.0, predicted, observed)
    np.testing.assert_allclose(gradient[0, :, 0], [2 * -3, 2 * -2 + 2 * -2 + 2 * -7])
    gradient = pulled_back(chamfer, 1, 1.0, predicted, observed)
    np.testing.assert_allclose(gradient[0, :, 0], [2 * 3 + 2 * 2 + 2 * 2, 2 * 7])


def test_chamfer_loss_sums_two_maps_per_interaction():
    # Eq. (2)
    rng = np.random.default_rng(1)
    maps, g = rng.random((2, B, N)), np.array([1.0, -2])
    value = chamfer_loss(*maps)
    assert value.shape == (B,)
    np.testing.assert_allclose(value, [maps[0, b].sum() + maps[1, b].sum() for b in range(B)], rtol=1e-12)
    for argnum in (0, 1):
        np.testing.assert_allclose(pulled_back(chamfer_loss, argnum, g, *maps), np.repeat(g[:, None], N, axis=1))


@pytest.mark.parametrize("hole_in", [0, 1])
def test_points_without_depth_neither_attract_nor_cost(hole_in):
    # Eq. (2)
    # A point without depth lies at the camera. Here it is even the nearest neighbour of every other point.
    rng = np.random.default_rng(2)
    inputs = list(clouds(rng))
    inputs[1] = inputs[0] + 5
    inputs[hole_in][:, 3] = inputs[1 - hole_in].mean(axis=1)
    inputs[2 + hole_in][:, 3] = False
    maps = distance_maps(*inputs)
    rest = [np.delete(cloud, 3, axis=1) if i == hole_in else cloud for i, cloud in enumerate(inputs[:2])]
    pairs = ((rest[0][:, :, None] - rest[1][:, None]) ** 2).sum(axis=3)  # as if the point did not exist
    expected = [pairs.min(axis=2), pairs.min(axis=1)]
    expected[hole_in] = np.insert(expected[hole_in], 3, 0, axis=1)
    for found, wanted in zip(maps, expected):
        assert found.shape == (B, N)
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
    poisoned = distance_maps(*inputs[:2], *np.ones((2, B, N), bool))[1 - hole_in]
    assert (poisoned < 0.9 * maps[1 - hole_in]).mean() > 0.5
    gradient = grad(lambda cloud: anp.sum(chamfer_loss(*distance_maps(
        *[cloud if i == hole_in else value for i, value in enumerate(inputs)]))))(inputs[hole_in])
    assert not gradient[:, 3].any() and np.abs(gradient[:, :3]).min() > 0


def test_association_loss_and_its_gradient_match_a_loop():
    rng = np.random.default_rng(0)
    predicted, targets, valid, _ = clouds(rng, 0.6)
    g = np.array([1.0, -2.0])
    value, gradient = np.zeros(B), np.zeros_like(predicted)
    for b, n in np.argwhere(valid):
        difference = predicted[b, n] - targets[b, n]
        value[b] += difference @ difference
        gradient[b, n] = 2 * g[b] * difference
    np.testing.assert_allclose(association_loss(predicted, targets, valid), value)
    np.testing.assert_allclose(pulled_back(association_loss, 0, g, predicted, targets, valid), gradient)


def test_distance_maps_refuse_a_cloud_without_depth_and_points_that_are_not_finite():
    inputs = list(clouds(np.random.default_rng(3)))
    nothing = np.zeros((B, N), bool)
    with pytest.raises(ValueError, match="valid"):
        distance_maps(*inputs[:2], nothing, inputs[3])
    with pytest.raises(ValueError, match="valid"):
        distance_maps(*inputs[:3], nothing)
    inputs[0][1, 2, 0] = np.nan
    with pytest.raises(ValueError, match="queries, references"):
        distance_maps(*inputs)


# --- 2D: Eq. (3) ------------------------------------------------------------------------------------------

def pictures(rng):
    """I_t brighter and darker than I_{t+1} in turn, by a margin, so that no absolute value is at its kink."""
    images, next_images = rng.uniform(0.7, 1, (B, H, W, 3)), rng.uniform(0.4, 0.6, (B, H, W, 3))
    images[:, :, ::2] -= 0.7
    return images, next_images


def flow_between_pixels(rng, size=2):
    """Multiples of 1/32 px, at least two steps of 1/32 from a whole number, where the derivative jumps."""
    return rng.integers(-size, size, (B, H, W, 2)) + rng.integers(2, 31, (B, H, W, 2)) / 32


def loop_photometric(images, next_images, flow, valid):
    """Per pixel costs (B, H, W) by SciPy, and which pixels are counted."""
    costs, counted = np.zeros((B, H, W)), np.zeros((B, H, W), bool)
    for b, y, x in np.ndindex(B, H, W):
        to = (y + flow[b, y, x, 1], x + flow[b, y, x, 0])
        warped = [map_coordinates(channel, np.transpose([to]), order=1, mode="nearest")[0]
                  for channel in np.moveaxis(next_images[b], -1, 0)]
        counted[b, y, x] = valid[b, y * W + x] and 0 <= to[0] <= H - 1 and 0 <= to[1] <= W - 1
        costs[b, y, x] = np.abs(images[b, y, x] - warped).sum()
    return costs * counted, counted


def test_warp_backward_reads_the_next_image_where_the_flow_points():
    # Eq. (3)
    rng = np.random.default_rng(4)
    next_images, flow = rng.random((B, H, W, 3)), flow_between_pixels(rng)
    warped, in_view = warp_backward(next_images, flow)
    assert warped.shape == (B, H, W, 3) and in_view.shape == (B, H, W)
    for b, y, x in np.ndindex(B, H, W):
        to_x, to_y = x + flow[b, y, x, 0], y + flow[b, y, x, 1]
        assert in_view[b, y, x] == (0 <= to_x <= W - 1 and 0 <= to_y <= H - 1)
        expected = [map_coordinates(next_images[b, ..., c], [[to_y], [to_x]], order=1, mode="nearest")[0]
                    for c in range(3)]
        np.testing.assert_allclose(warped[b, y, x], expected, rtol=0, atol=1e-6)
    assert in_view.any() and not in_view.all()


def test_warp_backward_counts_the_border_itself_as_in_view():
    # Eq. (3)
    flow = np.zeros((1, H, W, 2))
    flow[0, 0, 0] = [W - 1, H - 1]  # from one corner exactly onto the other
    flow[0, 1, 1] = [-1, -1]
    flow[0, 1, 2] = [W - 3 + 1 / 32, 0]  # a little too far right
    flow[0, 2, 3] = [0, -2 - 1 / 32]  # and too far up
    _, in_view = warp_backward(np.ones((1, H, W, 1)), flow)
    expected = np.ones((1, H, W), bool)
    expected[0, 1, 2] = expected[0, 2, 3] = False
    np.testing.assert_array_equal(in_view, expected)


def test_rounding_carries_no_pixel_of_the_border_out_of_view():
    flow = np.zeros((1, 4, 6, 2))
    flow[0, 0, 0], flow[0, 3, 5], flow[0, 1, 0, 0] = -1e-4, 1e-4, -0.01
    _, in_view = warp_backward(np.ones((1, 4, 6, 1)), flow)
    assert in_view[0, 0, 0] and in_view[0, 3, 5] and not in_view[0, 1, 0] and in_view.sum() == 23


def test_photometric_loss_is_zero_for_the_true_flow_only():
    # Eq. (3)
    # The scene moves 2 px to the right and 1 px down: I_{t+1}(x + 2, y + 1) = I_t(x, y).
    rng = np.random.default_rng(5)
    images = rng.random((1, H, W, 3))
    next_images = np.roll(images, (1, 2), axis=(1, 2))
    valid, flow = np.ones((1, N), bool), np.zeros((1, H, W, 2)) + [2, 1]
    np.testing.assert_allclose(photometric_loss(images, next_images, flow, valid), [0], atol=1e-5)
    for wrong in (-flow, flow[..., ::-1], 0 * flow):  # the sign, U and V swapped, no motion
        assert photometric_loss(images, next_images, wrong, valid)[0] > 1


def test_photometric_loss_and_its_flow_gradient_match_scipy_and_central_differences():
    # Eq. (3)
    rng = np.random.default_rng(6)
    images, next_images = pictures(rng)
    flow, valid, g = flow_between_pixels(rng), rng.random((B, N)) < 0.7, np.array([1.0, -2])
    costs, counted = loop_photometric(images, next_images, flow, valid)
    value = photometric_loss(images, next_images, flow, valid)
    assert value.shape == (B,)
    np.testing.assert_allclose(value, costs.sum(axis=(1, 2)), rtol=1e-6)
    found = pulled_back(photometric_loss, 2, g, images, next_images, flow, valid)
    assert found.shape == flow.shape
    for axis in range(2):
        step = np.eye(2)[axis] / 32
        above, below = (loop_photometric(images, next_images, flow + s, valid)[0] for s in (step, -step))
        np.testing.assert_allclose(found[..., axis], g[:, None, None] * (above - below) * 16, rtol=0, atol=1e-9)
    # Pixels without depth or carried out of view: no cost above, and no gradient, not even along the border.
    assert 5 < counted.sum() < B * N - 5
    assert not found[~counted].any() and np.abs(found[counted]).min() > 1e-4


def test_photometric_gradient_with_respect_to_both_images():
    # Eq. (3)
    rng = np.random.default_rng(7)
    images, next_images = pictures(rng)
    flow, valid, g = flow_between_pixels(rng), rng.random((B, N)) < 0.7, np.array([1.0, -2])
    warped, in_view = warp_backward(next_images, flow)
    counted = in_view & valid.reshape(B, H, W)
    found = pulled_back(photometric_loss, 0, g, images, next_images, flow, valid)
    expected = np.sign(images - warped) * counted[..., None] * g[:, None, None, None]
    assert found.shape == images.shape
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert (expected > 0).any() and (expected < 0).any() and (expected == 0).any()
    check_grads(photometric_loss, (0, 1), modes=["rev"], order=1)(images, next_images, flow, valid)


def test_a_pixel_out_of_view_costs_nothing_however_far_it_went():
    # Eq. (3)
    images, next_images = np.ones((1, H, W, 1)), np.zeros((1, H, W, 1))
    flow, valid = np.zeros((1, H, W, 2)), np.ones((1, N), bool)
    flow[0, 1, 2], flow[0, 2, 3], flow[0, 3, 0] = [1e5, 0], [0, -7], [-0.5, -1]
    np.testing.assert_allclose(photometric_loss(images, next_images, flow, valid), [N - 3])
    valid[0, 5] = False
    np.testing.assert_allclose(photometric_loss(images, next_images, flow, valid), [N - 4])


def test_photometric_loss_refuses_a_flow_that_is_not_finite():
    rng = np.random.default_rng(8)
    images, next_images = pictures(rng)
    flow = np.zeros((B, H, W, 2))
    flow[1, 2, 3, 0] = np.nan
    with pytest.raises(ValueError, match="positions"):
        photometric_loss(images, next_images, flow, np.ones((B, N), bool))


# --- smoothness: Eq. (4) and (5) --------------------------------------------------------------------------

ALL = np.ones((B, N), bool)


def loop_smoothness(field, images, valid=ALL):
    """Per interaction: neighbour by neighbour."""
    valid = valid.reshape(valid.shape[0], *field.shape[1:3])
    total = np.zeros(len(field))
    for b, y, x in np.ndindex(field.shape[:3]):
        for down, right in ((0, 1), (1, 0)):
            if y + down < field.shape[1] and x + right < field.shape[2] and valid[b, y, x] \
                    and valid[b, y + down, x + right]:
                edge = np.abs(images[b, y + down, x + right] - images[b, y, x]).mean()
                jump = np.abs(field[b, y + down, x + right] - field[b, y, x]).sum()
                total[b] += jump * np.exp(-40 * edge)
    return total


def test_edge_weights_match_their_formula():
    images = np.random.default_rng(9).uniform(0, 0.08, (B, H, W, 3))
    across, down = edge_weights(images)
    assert across.shape == (B, H, W - 1) and down.shape == (B, H - 1, W)
    for b, y, x in np.ndindex(across.shape):
        edge = np.abs(images[b, y, x + 1] - images[b, y, x]).mean()
        assert across[b, y, x] == pytest.approx(np.exp(-losses.EDGE_SHARPNESS * edge))
    for b, y, x in np.ndindex(down.shape):
        edge = np.abs(images[b, y + 1, x] - images[b, y, x]).mean()
        assert down[b, y, x] == pytest.approx(np.exp(-losses.EDGE_SHARPNESS * edge))


@pytest.mark.parametrize("loss, channels", [(edge_aware_smoothness, 1), (edge_aware_smoothness, 3),
                                            (flow_smoothness_loss, 2)])
def test_smoothness_and_its_gradient_match_a_loop_over_neighbours(loss, channels):
    # Eq. (4)
    rng = np.random.default_rng(10)
    field, images = rng.normal(size=(B, H, W, channels)), rng.uniform(0, 0.08, (B, H, W, 3))
    valid = rng.random((B, N)) < 0.8  # holes neither pull nor cost
    value = loss(field, images, valid)
    assert value.shape == (B,)
    np.testing.assert_allclose(value, loop_smoothness(field, images, valid), rtol=1e-12)
    assert (value < loop_smoothness(field, images)).all()
    gradient = pulled_back(loss, 0, np.array([1.0, -2]), field, images, valid)
    assert gradient.shape == field.shape
    for index in [(0, 0, 0, 0), (0, 2, 3, channels - 1), (1, H - 1, W - 1, 0), (1, 1, 0, 0), (0, 0, W - 1, 0)]:
        step = np.zeros_like(field)  # a corner, the inside, two sides
        step[index] = 1e-5
        above, below = loop_smoothness(field + step, images, valid), loop_smoothness(field - step, images, valid)
        np.testing.assert_allclose(gradient[index], (above - below) @ [1, -2] / 2e-5, rtol=1e-6, atol=1e-9)
    check_grads(lambda field: loss(field, images, valid), modes=["rev"], order=1)(field)
    assert not gradient.reshape(B, N, -1)[~valid].any()


def test_a_step_in_the_flow_costs_less_at_an_edge_of_the_image():
    # Eq. (4)
    flow, images = np.zeros((1, H, W, 2)), np.zeros((1, H, W, 3))
    flow[:, :, 3:] = [2, -3]  # a step between columns 2 and 3
    flat = flow_smoothness_loss(flow, images, ALL[:1])
    images[:, :, 3:] = 0.2  # an edge at the same place
    at_edge = flow_smoothness_loss(flow, images, ALL[:1])
    np.testing.assert_allclose(flat, [H * 5])
    np.testing.assert_allclose(at_edge, [H * 5 * np.exp(-8)])
    images[:] = 0
    images[:, :, 4:] = 0.2  # an edge elsewhere
    np.testing.assert_allclose(flow_smoothness_loss(flow, images, ALL[:1]), flat)


def test_distance_smoothness_weights_each_map_by_the_image_of_its_own_grid():
    # Eq. (5)
    rng = np.random.default_rng(11)
    map_predicted, map_observed = maps = rng.random((2, B, N))
    images, next_images = rng.uniform(0, 0.08, (2, B, H, W, 3))
    g = np.array([1.0, -2])
    grid = (B, H, W, 1)
    valid, next_valid = rng.random((2, B, N)) < 0.8
    rest = images, next_images, valid, next_valid
    value = distance_smoothness_loss(*maps, *rest)
    expected = (loop_smoothness(map_predicted.reshape(grid), images, valid)  # D_{P'->P} on frame t's grid
                + loop_smoothness(map_observed.reshape(grid), next_images, next_valid))  # D_{P->P'} on frame t+1's
    swapped = (loop_smoothness(map_predicted.reshape(grid), next_images, valid)
               + loop_smoothness(map_observed.reshape(grid), images, next_valid))
    assert value.shape == (B,)
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    assert np.abs(expected - swapped).min() > 0.05
    for argnum, own, seen in ((0, images, valid), (1, next_images, next_valid)):
        found = pulled_back(distance_smoothness_loss, argnum, g, *maps, *rest)
        one_map = pulled_back(edge_aware_smoothness, 0, g, maps[argnum].reshape(grid), own, seen)
        assert found.shape == (B, N)
        np.testing.assert_allclose(found, one_map.reshape(B, N), rtol=0, atol=1e-12)
    check_grads(lambda *maps: distance_smoothness_loss(*maps, *rest), (0, 1), modes=["rev"], order=1)(*maps)


# --- the inverse model ------------------------------------------------------------------------------------

@pytest.mark.parametrize("shift", [0.0, 1e4, -1e4])
def test_heatmap_cross_entropy_and_its_gradient_match_scipy(shift):
    rng = np.random.default_rng(12)
    logits, cells, g = rng.normal(size=(3, 7)) + shift, np.array([4, 0, 6]), rng.normal(size=3)
    value = heatmap_cross_entropy(logits, cells)
    assert value.shape == (3,)
    np.testing.assert_allclose(value, [-log_softmax(logits, axis=1)[i, cell] for i, cell in enumerate(cells)],
                               rtol=0, atol=1e-10)
    gradient = pulled_back(heatmap_cross_entropy, 0, g, logits, cells)
    assert gradient.shape == (3, 7)
    expected = g[:, None] * (softmax(logits, axis=1) - np.eye(7)[cells])
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-11)


def test_heatmap_cross_entropy_of_a_confident_heatmap():
    logits = np.array([[0, 2e4, 0], [0, 2e4, 0]], np.float32)  # exp overflows: right costs 0, wrong 20000 nats
    cells = np.array([1, 2])
    np.testing.assert_allclose(heatmap_cross_entropy(logits, cells), [0, 2e4])
    gradient = pulled_back(heatmap_cross_entropy, 0, np.float32(1), logits, cells)
    np.testing.assert_allclose(gradient, [[0, 0, 0], [0, 1, -1]], atol=1e-7)


def test_heatmap_cross_entropy_passes_finite_differences():
    logits = np.random.default_rng(13).normal(size=(3, 7))
    check_grads(heatmap_cross_entropy, modes=["rev"], order=1)(logits, np.array([4, 0, 6]))


def test_embedding_loss_is_the_mean_absolute_difference():
    rng = np.random.default_rng(14)
    predicted, observed, g = rng.normal(size=(3, 5)), rng.normal(size=(3, 5)), rng.normal(size=3)
    value = embedding_loss(predicted, observed)
    assert value.shape == (3,)
    np.testing.assert_allclose(value, [np.abs(predicted[b] - observed[b]).sum() / 5 for b in range(3)], rtol=1e-12)
    sign = np.sign(predicted - observed) * g[:, None] / 5
    for argnum, expected in ((0, sign), (1, -sign)):  # both sides: the encoder is siamese
        gradient = pulled_back(embedding_loss, argnum, g, predicted, observed)
        assert gradient.shape == (3, 5)
        np.testing.assert_allclose(gradient, expected, rtol=1e-12)


def test_inverse_loss_is_the_sum_of_both_heatmaps_and_the_embedding():
    rng = np.random.default_rng(15)
    logits, embeddings = rng.normal(size=(2, 3, 7)), rng.normal(size=(2, 3, 5))
    cells, g = (np.array([4, 0, 6]), np.array([1, 5, 2])), rng.normal(size=3)
    args = (*logits, *cells, *embeddings)
    value = inverse_loss(*args)
    expected = np.abs(embeddings[0] - embeddings[1]).mean(axis=1)
    for which in range(2):  # start with start, end with end
        expected = expected - log_softmax(logits[which], axis=1)[np.arange(3), cells[which]]
    assert value.shape == (3,)
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    for which in range(2):
        gradient = pulled_back(inverse_loss, which, g, *args)
        wanted = g[:, None] * (softmax(logits[which], axis=1) - np.eye(7)[cells[which]])
        np.testing.assert_allclose(gradient, wanted, rtol=0, atol=1e-12)
    sign = g[:, None] * np.sign(embeddings[0] - embeddings[1]) / 5
    np.testing.assert_allclose(pulled_back(inverse_loss, 4, g, *args), sign, rtol=1e-12)
    np.testing.assert_allclose(pulled_back(inverse_loss, 5, g, *args), -sign, rtol=1e-12)


# --- masks --------------------------------------------------------------------------------------------------

def loop_sharing(masks, valid, g):
    """Over all pairs of pixels -> L_sh, and the gradient of sum(g * L_sh)."""
    value, gradient, reach = np.zeros(len(masks)), np.zeros(masks.shape), losses.SHARING_REACH
    valid = valid.reshape(masks.shape[:3])
    for b, y, x in np.ndindex(masks.shape[:3]):
        for other in ((b, y + reach, x), (b, y, x + reach)):
            inside = other[1] < masks.shape[1] and other[2] < masks.shape[2]
            if inside and valid[b, y, x] and valid[other]:
                for k in range(1, masks.shape[3]):
                    for l in set(range(1, masks.shape[3])) - {k}:
                        value[b] += masks[b, y, x, k] * masks[other][l]
                        gradient[b, y, x, k] += g[b] * masks[other][l]
                        gradient[(*other, l)] += g[b] * masks[b, y, x, k]
    return value, gradient


def test_sharing_counts_near_pixels_that_move_by_different_masks():
    rng = np.random.default_rng(21)
    masks, valid, g = softmax(rng.normal(size=(B, 5, 7, 4)), axis=3), rng.random((B, 35)) < 0.8, rng.normal(size=B)
    value, gradient = loop_sharing(masks, valid, g)
    assert (value > 1).all()
    np.testing.assert_allclose(sharing_loss(masks, valid), value, rtol=1e-12)
    np.testing.assert_allclose(pulled_back(sharing_loss, 0, g, masks, valid), gradient, rtol=0, atol=1e-12)
    check_grads(lambda masks: sharing_loss(masks, valid), modes=["rev"], order=1)(masks)


def test_sharing_costs_an_object_cut_in_two_and_not_two_objects_apart():
    valid = np.ones((1, 10 * 24), bool)

    def cost(*parts):  # (columns, mask) each, 6 pixels high
        masks = np.zeros((1, 10, 24, 4))
        for columns, mask in parts:
            masks[0, 2:8, columns, mask] = 1
        masks[..., 0] = 1 - masks.sum(axis=3)
        return sharing_loss(masks, valid)[0]
    assert cost((slice(3, 9), 1)) == 0
    assert cost((slice(3, 9), 1), (slice(14, 20), 2)) == 0  # an object each
    assert cost((slice(3, 6), 1), (slice(6, 9), 2)) == 6 * 3  # each pixel of a row against the one 3 further on
    masks = np.zeros((1, 10, 24, 4))
    masks[0, 2:8, 3:9, 1:3] = 0.5  # every pixel in two masks
    assert sharing_loss(masks, valid)[0] == pytest.approx(0.5 * 2 * 6 * 3)


# --- the full model: Eq. (6) ------------------------------------------------------------------------------

def test_paper_weights_are_the_three_lambdas():
    # Eq. (6): lambda_1 of the 3D terms, lambda_2 of the 2D terms, lambda_3 of the inverse model
    assert PAPER_WEIGHTS == {"chamfer": 1e5, "distance_smoothness": 1e5, "photometric": 1e3,
                             "flow_smoothness": 1e3, "inverse": 1.0}


def test_full_loss_is_the_weighted_sum_averaged_over_the_batch():
    # Eq. (6)
    rng = np.random.default_rng(16)
    terms = {name: rng.random(4) + 1 for name in PAPER_WEIGHTS}
    weights = dict(zip(reversed(PAPER_WEIGHTS), [2.0, 0.3, 0.0, 5.0, 0.7]))  # another order, and one ablation
    value = full_loss(terms, weights)
    assert np.shape(value) == ()
    assert value == pytest.approx(sum(weights[name] * terms[name].sum() / 4 for name in terms))
    gradients = grad(full_loss)(terms, weights)
    for name in terms:
        np.testing.assert_allclose(gradients[name], np.full(4, weights[name] / 4), rtol=1e-12)


@pytest.mark.parametrize("change", [lambda w: w.pop("chamfer"), lambda w: w.update(photo=1.0),
                                    lambda w: (w.pop("inverse"), w.update(invers=1.0))])
def test_full_loss_refuses_other_keys(change):
    # Eq. (6)
    terms, weights = {name: np.ones(2) for name in PAPER_WEIGHTS}, dict(PAPER_WEIGHTS)
    change(weights)
    with pytest.raises(ValueError, match="weights"):  # a misspelt term must not drop out silently
        full_loss(terms, weights)


# --- dtype ------------------------------------------------------------------------------------------------

def dtype_cases():
    rng = np.random.default_rng(17)
    predicted, observed, valid, next_valid = clouds(rng, 0.7)
    images, next_images = pictures(rng)
    flow, maps, logits = flow_between_pixels(rng), rng.random((2, B, N)), rng.normal(size=(2, B, 7))
    cells, embeddings = np.array([3, 6]), rng.normal(size=(2, B, 5))

    def chamfer(predicted, observed):
        return chamfer_loss(*distance_maps(predicted, observed, valid, next_valid))

    yield "chamfer", chamfer, 0, (predicted, observed)
    yield "chamfer of the observed", chamfer, 1, (predicted, observed)
    yield "warp", lambda *args: warp_backward(*args)[0], 1, (next_images, flow)
    yield "photometric", photometric_loss, 2, (images, next_images, flow, valid)
    yield "flow smoothness", flow_smoothness_loss, 0, (flow, images, valid)
    for which in (0, 1):
        args = (*maps, images, next_images, valid, next_valid)
        yield f"distance smoothness {which}", distance_smoothness_loss, which, args
    yield "cross entropy", heatmap_cross_entropy, 0, (logits[0], cells)
    yield "embedding", embedding_loss, 0, tuple(embeddings)
    yield "inverse", inverse_loss, 1, (*logits, cells, cells, *embeddings)
    yield "sharing", sharing_loss, 0, (softmax(rng.normal(size=(B, H, W, 4)), axis=3), valid)
    yield "full", lambda a, b: full_loss({"a": a, "b": b}, {"a": 2.0, "b": 3.0}), 0, tuple(logits[0])


@pytest.mark.parametrize("function, argnum, args", [
    pytest.param(*case, id=name) for name, *case in dtype_cases()])
def test_float32_in_gives_float32_out_and_the_same_numbers(function, argnum, args):
    single = [a.astype(np.float32) if a.dtype == float else a for a in args]
    value, exact = function(*single), function(*args)
    g = np.random.default_rng(18).normal(size=np.shape(value))
    gradient = pulled_back(function, argnum, np.asarray(g, np.float32), *single)
    exact_gradient = pulled_back(function, argnum, g, *args)
    np.testing.assert_allclose(value, exact, rtol=1e-5)
    np.testing.assert_allclose(gradient, exact_gradient, rtol=0, atol=1e-5 * np.abs(exact_gradient).max())
    assert gradient.shape == args[argnum].shape
    assert value.dtype == np.float32
    assert gradient.dtype == np.float32
