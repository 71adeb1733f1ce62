"""The baseline SE3-Nets: our network, supervised by the true motion of every point. Paper: Sec. IV-D.

Each point may be taken for another one near it, the association noise of Sec. IV-B. This file reads the truth.
"""
from dataclasses import dataclass

import autograd.numpy as anp
import numpy as np

from ..geometry import unproject
from ..interactions import Interactions
from ..networks import predict
from ..sim.truth import Truth, true_scene_flow
from ..training import scenes_of
from .noise import associate_with_noise, with_depth_noise

WEIGHTS = {"association": 2e3}  # as much as Chamfer, which counts a point in both directions


@dataclass(frozen=True)
class Supervised:
    """Pokes with their truth: data for `training.train` with the objective `supervised`."""
    interactions: Interactions
    truth: Truth

    def __len__(self):
        return len(self.interactions)

    def __getitem__(self, rows):
        return Supervised(self.interactions[rows], self.truth[rows])

    @property
    def camera(self):
        return self.interactions.camera


def association_loss(predicted, targets, valid):
    """What SE3-Nets minimises instead of Chamfer: sum_i |P'_i - T_i|^2, each point's own target known.

    Paper: Sec. IV-D.
    predicted, targets (B, N, 3) m, valid (B, N) bool -> (B,) m^2.
    """
    difference = predicted - targets
    return anp.sum(difference * difference * valid[..., None], axis=(1, 2))


def true_targets(data, points, depth, window, rng):
    """Where the truth says every point goes, (B, N, 3) m, under the association noise of Sec. IV-B.

    points (B, N, 3) m and depth (B, H, W) m as the model sees them, perhaps noisy; the motion is that of the true
    points. window: a point may be taken for any in a square of so many pixels around it (1: exact; odd).
    """
    clean = unproject(data.interactions.depth_before, data.camera)
    truth = zip(clean, data.truth.labels, data.truth.poses_before, data.truth.poses_after)
    targets = points + np.stack([true_scene_flow(*each) for each in truth]).reshape(points.shape)
    if window > 1:
        taken_for = np.stack([associate_with_noise(picture, rng, window).ravel() for picture in depth])
        targets = np.take_along_axis(targets, taken_for[..., None], axis=1)
    return targets


def supervised(params, recipe, data, rng, window=1, depth_noise=0.0):
    """The objective of SE3-Nets, for `training.train`: {"association": (B,)}. data: Supervised; depth_noise: SD, m."""
    seen, pokes = data.interactions, data.interactions.pokes
    if depth_noise:
        seen = with_depth_noise(seen, depth_noise, rng)
    scene, _ = scenes_of(seen)
    targets = true_targets(data, scene.points, seen.depth_before, window, rng)
    prediction = predict(params, recipe.sizes, scene, pokes)
    return {"association": association_loss(prediction.points, targets, scene.valid)}
