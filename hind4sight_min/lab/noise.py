"""The paper's two noises, Sec. IV-B, and what a robot whose depth is noisy does about it. Not part of the method: noise
belongs to a camera, and goes into the pictures before anything looks at them.
"""
from dataclasses import replace

import cv2
import numpy as np

from .. import as_arrays, check_number
from ..disk.shards import DEPTH_UNIT
from ..training import unsupervised


MOST_NOISE = 0.1  # m, that anybody's pokes are seen with: more leaves no table


def add_depth_noise(depth, rng, standard_deviation=0.01):
    """Gaussian depth noise that grows with depth. Paper: Sec. IV-B, "SD of 1 cm, scaled by the depth".

    The SD is `standard_deviation` metres at each picture's median depth, and proportional to depth.
    depth (..., H, W) m -> the same shape and dtype; missing pixels (0) stay missing. Every pixel of every picture has
    noise of its own. Raises ValueError for an SD below 0 or above 10 m.
    """
    depth, = as_arrays("*HW", depth=depth)
    check_number("standard_deviation", standard_deviation, least=0, most=10)
    valid = depth > 0
    pictures = depth.reshape(-1, *depth.shape[-2:])
    median = np.array([np.median(each[each > 0]) if (each > 0).any() else 1.0 for each in pictures], depth.dtype)
    scale = standard_deviation / median.reshape(depth.shape[:-2] + (1, 1))
    noisy = depth * (1 + scale * rng.standard_normal(depth.shape))
    return np.where(valid, np.maximum(noisy, DEPTH_UNIT), 0).astype(depth.dtype)


def associate_with_noise(depth, rng, window, threshold=0.10):
    """Spurious data association: each pixel is taken for another one near it. Paper: Sec. IV-B.

    Every pixel draws one pixel of the window x window square around it; the draw counts if it lies in the
    picture, has depth, and differs in depth by at most `threshold` metres; otherwise the pixel keeps itself.
    depth (H, W) m -> (H, W) int: the flat index each pixel is associated with.
    """
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window: expected an odd number of pixels >= 1, got {window}")
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    shift = rng.integers(-(window // 2), window // 2 + 1, size=(2, height, width))
    v_new, u_new = v + shift[0], u + shift[1]
    inside = (v_new >= 0) & (v_new < height) & (u_new >= 0) & (u_new < width)
    v_new, u_new = np.where(inside, v_new, v), np.where(inside, u_new, u)
    other = depth[v_new, u_new]
    good = (other > 0) & (depth > 0) & (np.abs(other - depth) <= threshold)
    return np.where(good, v_new * width + u_new, v * width + u)


def with_depth_noise(interactions, standard_deviation, rng):
    """The same pokes as a robot sees them whose depth is noisy, Sec. IV-B, and who therefore smooths it first.

    A record in, a record out; the empty arena is known without noise. standard_deviation: in m.
    """
    noisy = [add_depth_noise(depth, rng, standard_deviation)
             for depth in (interactions.depth_before, interactions.depth_after)]
    return replace(interactions, **smoothed(interactions, *noisy))


def smoothed(interactions, depth_before, depth_after):
    """Depth pictures (M, H, W) m of these pokes with the noise taken out and holes filled, by name: a dict."""
    return {f"depth_{name}": smooth_depth(depth, interactions.empty_depth, getattr(interactions, f"rgb_{name}"),
                                          interactions.camera)
            for name, depth in (("before", depth_before), ("after", depth_after))}


SMOOTHING = 0.027, 0.15, 0.02  # what counts as near: radius and SD in m on the table, SDs of colours in [0, 1], in m


def smooth_depth(depth, empty_depth, images, camera):
    """Take noise out of depth pictures and fill their holes with the help of the colours: a joint bilateral filter.

    Not in the paper. In the difference to the empty arena the table is flat at 0 and objects are islands some cm high.
    There each pixel becomes a mean of those around it, weighted by how near they are: in the picture, in colour, and in
    a first guess of the difference, a bilateral filter of it alone, holes filled by picture and colour. Of 1 cm of
    noise that leaves 2 mm on the table and 7 on objects.
    depth (B, H, W) m, 0 = missing, which counts for nobody, and stays where nothing alike is near; empty_depth (H, W)
    m, where 0 = missing depth stays as it is; images (B, H, W, 3) uint8 -> the shape and dtype of depth.
    """
    reach, colour, metres = SMOOTHING
    px = reach / camera.pixel_size
    seen = (depth > 0) & (empty_depth > 0)
    difference = np.where(seen, depth - empty_depth, 0).astype(np.float32)
    colours, filled = [*(np.moveaxis(images, -1, 0) / np.float32(255 * colour))], difference
    if not seen.all():
        filled = np.where(seen, difference, mean_of_near(difference, seen, colours, px)[0])
    guess = np.stack([cv2.bilateralFilter(each, 2 * round(px * 2 / 3) + 1, 0.025, px / 2) for each in filled])
    smooth, weight = mean_of_near(difference, seen, [guess / np.float32(metres), *colours], px)
    known = (empty_depth > 0) & (weight > LEAST_WEIGHT)
    return np.where(known, empty_depth + smooth, depth).astype(depth.dtype)


LEAST_WEIGHT = 1e-3  # a hole is filled where the weights around it sum to more


def mean_of_near(values, seen, guides, px):
    """Of values (B, H, W), the mean of those that are `seen` up to px pixels away, weighted by exp(-d^2 / 2): d is how
    far apart they are in the picture, in units of px, and in each of the guides (B, H, W). -> means, sums of weights.
    """
    radius, (height, width) = max(1, round(px)), values.shape[-2:]
    # With a rim, where nothing is seen, a shift is an offset in flat arrays: twice as fast.
    rim = (0, 0), (0, radius), (0, radius)
    seen, values, *guides = (np.pad(each, rim).ravel() for each in (seen.astype(np.float32), values * seen, *guides))
    total, weight = values.copy(), seen.copy()
    for dv in range(radius + 1):
        for du in range(-radius if dv else 1, radius + 1):  # each pair of pixels once, for both
            offset = dv * (width + radius) + du
            here, there = slice(None, -offset), slice(offset, None)
            apart = np.float32((dv ** 2 + du ** 2) / px ** 2)  # squared, in standard deviations
            for guide in guides:
                apart = apart + np.square(guide[here] - guide[there])
            near = np.exp(-apart / 2)
            total[here] += near * values[there]
            total[there] += near * values[here]
            weight[here] += near * seen[there]
            weight[there] += near * seen[here]
    mean = total / np.maximum(weight, 1e-6)
    return [each.reshape(-1, height + radius, width + radius)[:, :height, :width] for each in (mean, weight)]


def under_noise(params, recipe, interactions, rng, standard_deviation, objective=unsupervised):
    """A training objective on pictures with depth noise, drawn anew in every step: for `training.train`."""
    return objective(params, recipe, with_depth_noise(interactions, standard_deviation, rng), rng)
