"""Metrics, with the unit in the name, beside the no-motion baseline and chance. Paper: Sec. IV-C to IV-F.

This file reads the simulator's truth, where there is one; training does not.
"""
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from .. import check_whole, losses
from ..geometry import Camera, optical_flow, unproject
from ..interactions import cell_centres
from ..networks import Prediction, inverse_model, predict, softmax
from ..scene import Scene, most_changed
from ..sim.truth import true_scene_flow
from ..training import scenes_of
from .camera_faults import prepared, with_faults
from .cameras import check_camera

MOVING = 1e-3  # m; a point moves when its true motion is longer. Bullet's objects at rest stay below it.
AT_WALL = 0.012  # m; a poke ends at a wall where a point that it moved ends so near to one, about a pixel


# --- what the model says of one poke ------------------------------------------------------------------------------

@dataclass(frozen=True)
class Answer:
    """The whole model on one poke: the Scenes it saw, (1, N, ...); its Prediction; optical flow (H, W, 2) px; start and
    end heat-maps (cells,), each summing to 1.
    """
    before: Scene
    after: Scene
    prediction: Prediction
    flow: np.ndarray
    heatmaps: tuple


def ask(run, interactions, row, **faults):
    """The whole model on one row of a data set -> Answer. faults: of the camera that it sees the row with, as those of
    `camera_faults.with_faults`: the same at every call, others for every row. Pictures with faults, and all that a run
    for real cameras is asked about, are `prepared` first. Raises ValueError for a camera that cannot show the run its
    arena.
    """
    check_camera(interactions.camera, Camera(**run.meta["camera"]))
    check_whole("row", row, -len(interactions), len(interactions) - 1)
    one = interactions[[row]]
    if any(faults.values()) or run.meta.get("camera_faults"):
        one = prepared(with_faults(one, np.random.default_rng([0, row]), **faults))
    before, after = scenes_of(one)
    prediction = predict(run.params, run.recipe.sizes, before, one.pokes)
    flow = optical_flow(before.points, prediction.points, one.camera).reshape(before.images.shape[1:3] + (2,))
    logits = inverse_model(run.params, *most_changed(before, after), cell_centres(one.settings))
    return Answer(before, after, prediction, flow, tuple(softmax(each)[0] for each in logits))


PEAK = 0.08  # m; how far from its best cell the end map's mean looks: on validation pokes 1.9 cm off, the best cell 2.5


def poke_from_heatmaps(start_heatmap, end_heatmap, settings):
    """Two heat-maps (cells,) -> the poke (3,) they name. Paper: Sec. III-E.

    The target is the mean of the end map around its best cell, finer than a cell; the direction is that of the mean,
    over the start map, of the unit vectors to the target. A best start cell would give it in steps; the mean is finer
    and minds no wide map.
    """
    centres = cell_centres(settings)
    near = end_heatmap * (np.linalg.norm(centres - centres[end_heatmap.argmax()], axis=1) < PEAK)
    target = near @ centres / near.sum()
    offsets = target - centres
    mean = start_heatmap @ (offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-9))
    return np.array([*target, np.arctan2(mean[1], mean[0])])


# --- the errors of one poke ---------------------------------------------------------------------------------------

def true_motion(interactions, truth, row):
    """What really happened in one interaction, from its depth without noise.

    -> true scene flow (N, 3) m, true optical flow (N, 2) px, and which points move, (N,) bool. A point without depth
    moves too, as if it were where the nearest one of its object is: left out, it would flatter a model that sees holes.
    """
    depth = depth_of_objects(interactions.depth_before[row], truth.labels[row])
    points = unproject(depth, interactions.camera)
    flow = true_scene_flow(points, truth.labels[row], truth.poses_before[row], truth.poses_after[row])
    pixels = optical_flow(points, points + flow, interactions.camera)
    moving = (depth > 0) & (np.linalg.norm(flow, axis=2) > MOVING)
    return flow.reshape(-1, 3), pixels.reshape(-1, 2), moving.ravel()


def depth_of_objects(depth, labels):
    """Depth (H, W) m with the holes of each object filled with its depth nearest by in the picture; labels (H, W)."""
    filled = depth.copy()
    for label in np.unique(labels[labels > 0]):
        here = labels == label
        known = here & (depth > 0)
        if known.any():
            nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
            filled[here] = depth[tuple(nearest)][here]
    return filled


def matched_iou(masks, labels, moved):
    """IoU of each moved object with the predicted mask that the best one-to-one matching gives it.

    masks (N, K) soft, 0 = background; labels (N,) int; moved: the labels of the moved objects -> (len(moved),).
    A pixel belongs to its largest mask. An object without a mask scores 0.
    """
    from scipy.optimize import linear_sum_assignment  # here: it takes as long to import as all the rest
    objects = labels == np.reshape(moved, (-1, 1, 1))  # (M, 1, N)
    predicted = np.argmax(masks, axis=1) == np.arange(1, masks.shape[1])[:, None]  # (K-1, N)
    iou = np.sum(objects & predicted, axis=2) / np.maximum(np.sum(objects | predicted, axis=2), 1)
    rows, columns = linear_sum_assignment(-iou)
    result = np.zeros(len(moved))
    result[rows] = iou[rows, columns]
    return result


def poke_errors(poke, true_poke):
    """Of pokes (..., 3): distance of the targets in m, angle between the directions in rad, in [0, pi]."""
    turn = np.asarray(poke)[..., 2] - np.asarray(true_poke)[..., 2]
    return (np.linalg.norm(np.asarray(poke)[..., :2] - np.asarray(true_poke)[..., :2], axis=-1),
            np.abs((turn + np.pi) % (2 * np.pi) - np.pi))


def errors_of_poke(run, interactions, truth, row, **faults):
    """All errors of one poke -> dict: sums over its moving, its still and all its points (m, px, m^2), and counts; a
    moving point that the model sees no depth of, and does not fill in, is one that it says does not move;
    iou: of each object that moved; poke: as the inverse model names it; at_wall: whether something ended at a wall.
    """
    answer = ask(run, interactions, row, **faults)
    points = answer.before.points[0]
    true, true_pixels, moving = true_motion(interactions, truth, row)
    seen, labels = answer.before.valid[0] | moving, truth.labels[row].ravel()
    moved = [label for label in np.unique(labels[moving]) if label > 0]
    error = np.linalg.norm(answer.prediction.points[0] - points - true, axis=1)
    pixel_error = np.linalg.norm(answer.flow.reshape(-1, 2) - true_pixels, axis=1)
    length, pixel_length = np.linalg.norm(true, axis=1), np.linalg.norm(true_pixels, axis=1)
    depth = interactions.depth_before[row]
    ends = unproject(depth, interactions.camera).reshape(-1, 3) + true
    ends = np.abs(ends[moving & (depth.ravel() > 0), :2])
    return {"moving": moving.sum(), "still": (seen & ~moving).sum(), "error": error[moving].sum(),
            "length": length[moving].sum(), "drift": error[seen & ~moving].sum(),
            "squared_error": (error[moving] ** 2).sum(), "squared_motion": (length[moving] ** 2).sum(),
            "optical": pixel_error[moving].sum(), "optical_zero": pixel_length[moving].sum(),
            "optical_all": pixel_error[seen].sum(), "optical_zero_all": pixel_length[seen].sum(),
            "iou": matched_iou(answer.prediction.masks[0], labels, moved),
            "poke": poke_from_heatmaps(*answer.heatmaps, interactions.settings),
            "at_wall": bool(ends.size) and ends.max() > interactions.settings["arena"] / 2 - AT_WALL}


# --- the summary --------------------------------------------------------------------------------------------------

def evaluate(run, interactions, truth=None, progress=None, **faults):
    """All metrics on a data set -> flat dict of floats; see `summary`, and without a truth `label_free_errors`, whose
    means over the pokes these then are. faults: of the camera that the model sees the pokes with, see `ask`.
    progress(done, total) is called after every poke.
    """
    pokes = []
    if not len(interactions):
        raise ValueError("interactions: expected a poke at least, got none")
    for row in range(len(interactions)):
        pokes.append(label_free_errors(run, interactions, row, **faults) if truth is None else
                     errors_of_poke(run, interactions, truth, row, **faults))
        if progress:
            progress(row + 1, len(interactions))
    if truth is None:
        return {"pokes": float(len(pokes)),
                **{name: float(np.mean([poke[name] for poke in pokes])) for name in pokes[0]}}
    return summary(pokes, interactions.pokes, scenes_of_pokes(truth))


def label_free_errors(run, interactions, row, **faults):
    """What can be said of one poke whose truth nobody knows: how well the prediction explains the next picture.

    Paper: Eq. (2) and (3), sums over the pixels that count, in cm^2 and in intensity, and no_motion_* the same where
    nothing moves. They fall with better predictions, but noise and what the poke uncovers keep them above 0.
    """
    answer = ask(run, interactions, row, **faults)
    before, after = answer.before, answer.after
    valid, next_valid = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
    found = {}
    for prefix, points, flow in (("", answer.prediction.points, answer.flow[None]),
                                 ("no_motion_", before.points, 0 * answer.flow[None])):
        maps = losses.distance_maps(points, after.points, valid, next_valid)
        found[f"{prefix}chamfer_cm2"] = 1e4 * losses.chamfer_loss(*maps)[0]
        found[f"{prefix}photometric"] = losses.photometric_loss(before.images, after.images, flow, valid)[0]
    return found


def scenes_of_pokes(truth):
    """Which scene each poke was made in, (M,) int: a scene goes on while its objects lie where the last poke left
    them.
    """
    fresh = np.any(truth.poses_before[1:] != truth.poses_after[:-1], axis=(1, 2))
    return np.concatenate([[0], np.cumsum(fresh)])


def ratio_of(squared, motion, scenes):
    """Squared error over squared motion, both (M,), summed over pokes, and the ratio's standard error: by how much as
    many other scenes (M,) would change it (delta method; pokes of a scene are not independent). Not in the paper.
    """
    ratio = np.sum(squared) / np.sum(motion)
    return ratio, np.sqrt(np.sum(np.bincount(scenes, squared - ratio * motion) ** 2)) / np.sum(motion)


def summary(pokes, true_pokes, scenes):
    """The dicts of `errors_of_poke`, the true pokes (M, 3) and their scenes (M,) -> all metrics, a flat dict of floats.

    flow_mse_ratio: squared error over squared motion, both summed over all moving points of the set (pooled);
    an interaction in which nothing moved has no moving point and so no say in it (it still counts for
    still_epe_cm). The same for pokes that moved one object (single_), two or more (multi_), ended at a wall (wall_),
    and without the hundredth of the pokes with the largest squared errors (trimmed_); a group without a poke has no
    ratio. flow_mse_cm2, flow_rmse_cm, flow_epe_cm: over moving points; no_motion_* the same for predicting no motion.
    still_epe_cm: mean drift of points that do not move; all_epe_cm: of all points. mask_iou: mean over the objects that
    moved. optical_epe_px: over moving points; optical_epe_all_px: over all. inverse_*: medians, over pokes that moved
    something; inverse_*_chance: of a poke drawn from the set at random. Raises ValueError where nothing moved at all.
    """
    of = {name: np.array([poke[name] for poke in pokes], float) for name in pokes[0] if name not in ("iou", "poke")}
    total = {name: values.sum() for name, values in of.items()}
    if not total["moving"]:
        raise ValueError("interactions: nothing moved in any of them, so there is nothing to measure")
    moving, everything = total["moving"], total["moving"] + total["still"]
    objects, squared, motion = np.array([len(poke["iou"]) for poke in pokes]), of["squared_error"], of["squared_motion"]
    moved = objects > 0
    result = {
        "flow_mse_cm2": 1e4 * squared.sum() / moving,
        "flow_rmse_cm": 100 * np.sqrt(squared.sum() / moving),
        "flow_epe_cm": 100 * total["error"] / moving,
        "still_epe_cm": 100 * total["drift"] / max(total["still"], 1),
        "all_epe_cm": 100 * (total["error"] + total["drift"]) / everything,
        "no_motion_mse_cm2": 1e4 * motion.sum() / moving,
        "no_motion_rmse_cm": 100 * np.sqrt(motion.sum() / moving),
        "no_motion_epe_cm": 100 * total["length"] / moving,
        "mask_iou": np.mean(np.concatenate([poke["iou"] for poke in pokes])),
        "optical_epe_px": total["optical"] / moving,
        "no_motion_optical_epe_px": total["optical_zero"] / moving,
        "optical_epe_all_px": total["optical_all"] / everything,
        "no_motion_optical_epe_all_px": total["optical_zero_all"] / everything,
        "pokes": len(pokes), "pokes_moved": moved.sum(),
    }
    groups = {"single_": objects == 1, "multi_": objects > 1, "wall_": moved & (of["at_wall"] > 0),
              "trimmed_": moved & (squared <= np.quantile(squared, 0.99))}
    for group, rows in {"": moved, **groups}.items():
        if rows.any():
            ratio, error = ratio_of(squared[rows], motion[rows], scenes[rows])
            result.update({f"{group}flow_mse_ratio": ratio, f"{group}flow_mse_ratio_se": error})
    result.update({f"{group}pokes": rows.sum() for group, rows in groups.items()})
    found, true_pokes = np.stack([poke["poke"] for poke in pokes])[moved], true_pokes[moved]
    shuffled = true_pokes[np.random.default_rng(0).permutation(len(true_pokes))]
    for suffix, guess in (("", found), ("_chance", shuffled)):
        target, direction = poke_errors(guess, true_pokes)
        result[f"inverse_target{suffix}_cm"] = 100 * np.median(target)
        result[f"inverse_direction{suffix}_deg"] = np.degrees(np.median(direction))
    return {name: float(value) for name, value in result.items()}
