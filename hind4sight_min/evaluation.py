"""Metrics, with the unit in the name, beside the no-motion baseline and chance. Paper: Sec. IV-C to IV-F.

This file reads the simulator's truth; training does not.
"""
from dataclasses import replace

import cv2
import numpy as np

from .geometry import optical_flow
from .interactions import cell_centres, points_and_validity, true_scene_flow
from .networks import windows
from .ops import softmax
from .training import make_batch, run_forward_model, run_inverse_model

PEAK = 0.08  # m; how far from its best cell the end map's mean looks: on validation pokes 1.9 cm off, the best cell 2.5
MOVING = 1e-3  # m; a point moves when its true motion is longer. Bullet's objects at rest stay below it.


def predict(run, interactions, rows, depth_noise=0.0):
    """The whole model on some rows, its windows pasted into the whole picture.

    -> (whole Batch, Prediction, optical flow (B, H, W, 2) px, start heat-maps, end heat-maps). Outside the windows all
    is background and stays. depth_noise: SD in m of the noise the model sees the depth with, the same at every call.
    """
    camera = interactions.camera
    batch, whole = (make_batch(interactions, rows, depth_noise=depth_noise, rng=np.random.default_rng([0, rows[0]]),
                               whole=whole) for whole in (False, True))
    prediction, flow = run_forward_model(run.params, run.recipe.sizes, batch, camera)
    heatmaps = run_inverse_model(run.params, batch)
    picture = (len(rows), camera.height, camera.width)
    background = np.eye(run.recipe.sizes.masks, dtype=np.float32)[0]
    points, masks, pixels = (np.empty(picture + (size,), np.float32) for size in (3, len(background), 2))
    points[:], masks[:], pixels[:] = whole.points.reshape(points.shape), background, 0
    for i, part in enumerate(windows(whole.pokes, camera)):
        for target, values in ((points, prediction.points), (masks, prediction.masks), (pixels, flow)):
            target[(i, *part)] = values[i].reshape(flow.shape[1:3] + (-1,))
    prediction = replace(prediction, points=points.reshape(whole.points.shape),
                         masks=masks.reshape(whole.points.shape[:2] + (-1,)))
    return (whole, prediction, pixels, *map(softmax, heatmaps))


def poke_from_heatmaps(start_heatmaps, end_heatmaps, settings):
    """Heat-maps (B, cells) -> pokes (B, 3). Paper: Sec. III-E.

    The target is the mean of the end map around its best cell, finer than a cell; the direction is that of the mean,
    over the start map, of the unit vectors to the target. A best start cell would give it in steps; the mean is finer
    and minds no wide map.
    """
    centres = cell_centres(settings)
    best = centres[np.argmax(end_heatmaps, axis=1)]
    near = end_heatmaps * (np.linalg.norm(centres - best[:, None], axis=2) < PEAK)
    target = near @ centres / near.sum(axis=1, keepdims=True)
    offsets = target[:, None] - centres  # (B, cells, 2)
    length = np.linalg.norm(offsets, axis=2, keepdims=True)
    units = offsets / np.maximum(length, 1e-9)
    mean = np.sum(start_heatmaps[..., None] * units, axis=1)
    return np.column_stack([target, np.arctan2(mean[:, 1], mean[:, 0])])


def matched_iou(masks, labels, moved):
    """IoU of each moved object with the predicted mask that the best one-to-one matching gives it.

    masks (N, K) soft, 0 = background; labels (N,) int; moved: the labels of the moved objects -> (len(moved),).
    A pixel belongs to its largest mask. An object without a mask scores 0.
    """
    from scipy.optimize import linear_sum_assignment  # here: it takes as long to import as all the rest
    hard = np.argmax(masks, axis=1)
    iou = np.zeros((len(moved), masks.shape[1] - 1))
    for i, label in enumerate(moved):
        for k in range(1, masks.shape[1]):
            union = np.count_nonzero((labels == label) | (hard == k))
            iou[i, k - 1] = np.count_nonzero((labels == label) & (hard == k)) / max(union, 1)
    rows, columns = linear_sum_assignment(-iou)
    result = np.zeros(len(moved))
    result[rows] = iou[rows, columns]
    return result


def true_motion(interactions, truth, row):
    """What really happened in one interaction, from its depth without noise.

    -> true scene flow (N, 3) m, true optical flow (N, 2) px, and which points have depth and move, (N,) bool.
    """
    points, valid = points_and_validity(interactions.depth_before[row], interactions.camera)
    flow = true_scene_flow(points, truth.labels[row], truth.poses_before[row], truth.poses_after[row])
    pixels = optical_flow(points, points + flow, interactions.camera)
    moving = valid & (np.linalg.norm(flow, axis=2) > MOVING)
    return flow.reshape(-1, 3), pixels.reshape(-1, 2), moving.ravel()


def evaluate(run, interactions, truth, progress=None, depth_noise=0.0):
    """All metrics on a data set -> flat dict of floats. depth_noise: SD in m of noise on the depth that the model sees.

    flow_mse_ratio: squared error over squared motion, both summed over all moving points of the set (pooled);
    an interaction in which nothing moved has no moving point and so no say in it (it still counts for
    still_epe_cm). flow_mse_ratio_se: its standard error, by how much other pokes, as many, would change it.
    flow_mse_cm2, flow_rmse_cm, flow_epe_cm: over moving points; no_motion_* the same for predicting no motion.
    still_epe_cm: mean drift of points that do not move; all_epe_cm: of all points. mask_iou: mean over the objects
    that moved. optical_epe_px: over moving points; optical_epe_all_px: over all. inverse_*: medians, over pokes that
    moved something; inverse_*_chance: of a poke drawn from the set at random.
    Raises ValueError where nothing moved at all.
    """
    settings = interactions.meta["settings"]
    sums = dict.fromkeys(("moving", "still", "error", "length", "drift", "optical", "optical_zero", "optical_all",
                          "optical_zero_all"), 0.0)
    ious, pokes, moved_rows, per_poke = [], [], [], []
    for first in range(0, len(interactions), 8):
        rows = np.arange(first, min(first + 8, len(interactions)))
        batch, prediction, flow, start_heatmaps, end_heatmaps = predict(run, interactions, rows, depth_noise)
        pokes.append(poke_from_heatmaps(start_heatmaps, end_heatmaps, settings))
        for i, row in enumerate(rows):
            labels = truth.labels[row].ravel()
            true, true_pixels, moving = true_motion(interactions, truth, row)
            length = np.linalg.norm(true, axis=1)
            still = batch.valid[i] & ~moving
            error = np.linalg.norm(prediction.points[i] - batch.points[i] - true, axis=1)
            pixel_error = np.linalg.norm(flow[i].reshape(-1, 2) - true_pixels, axis=1)
            pixel_length = np.linalg.norm(true_pixels, axis=1)
            for name, value in (("moving", moving.sum()), ("still", still.sum()),
                                ("error", error[moving].sum()), ("length", length[moving].sum()),
                                ("drift", error[still].sum()), ("optical", pixel_error[moving].sum()),
                                ("optical_zero", pixel_length[moving].sum()),
                                ("optical_all", pixel_error[batch.valid[i]].sum()),
                                ("optical_zero_all", pixel_length[batch.valid[i]].sum())):
                sums[name] += float(value)
            per_poke.append(((error[moving] ** 2).sum(), (length[moving] ** 2).sum()))  # squared error, squared motion
            moved = [label for label in np.unique(labels[moving]) if label > 0]
            if moved:
                moved_rows.append(row)
                ious.extend(matched_iou(prediction.masks[i], labels, moved))
        if progress:
            progress(int(rows[-1]) + 1, len(interactions))
    if not sums["moving"]:
        raise ValueError("interactions: nothing moved in any of them, so there is nothing to measure")
    moving, everything = sums["moving"], sums["moving"] + sums["still"]
    squared, motion = np.transpose(per_poke).astype(float)
    ratio = squared.sum() / motion.sum()
    found = np.concatenate(pokes)[moved_rows]
    true_pokes = interactions.pokes[moved_rows]
    shuffled = true_pokes[np.random.default_rng(0).permutation(len(true_pokes))]
    result = {
        "flow_mse_ratio": ratio,
        "flow_mse_ratio_se": np.sqrt(np.sum((squared - ratio * motion) ** 2)) / motion.sum(),  # the delta method
        "flow_mse_cm2": 1e4 * squared.sum() / moving,
        "flow_rmse_cm": 100 * np.sqrt(squared.sum() / moving),
        "flow_epe_cm": 100 * sums["error"] / moving,
        "still_epe_cm": 100 * sums["drift"] / max(sums["still"], 1),
        "all_epe_cm": 100 * (sums["error"] + sums["drift"]) / everything,
        "no_motion_mse_cm2": 1e4 * motion.sum() / moving,
        "no_motion_rmse_cm": 100 * np.sqrt(motion.sum() / moving),
        "no_motion_epe_cm": 100 * sums["length"] / moving,
        "mask_iou": np.mean(ious),
        "optical_epe_px": sums["optical"] / moving,
        "no_motion_optical_epe_px": sums["optical_zero"] / moving,
        "optical_epe_all_px": sums["optical_all"] / everything,
        "no_motion_optical_epe_all_px": sums["optical_zero_all"] / everything,
    }
    for suffix, guess in (("", found), ("_chance", shuffled)):
        target, direction = poke_errors(guess, true_pokes)
        result[f"inverse_target{suffix}_cm"] = 100 * np.median(target)
        result[f"inverse_direction{suffix}_deg"] = np.degrees(np.median(direction))
    result["pokes"], result["pokes_moved"] = len(interactions), len(moved_rows)
    return {name: float(value) for name, value in result.items()}


def poke_errors(pokes, true_pokes):
    """(distance of the targets in m, angle between the directions in rad, in [0, pi]), each (M,)."""
    turn = pokes[:, 2] - true_pokes[:, 2]
    return (np.linalg.norm(pokes[:, :2] - true_pokes[:, :2], axis=1),
            np.abs((turn + np.pi) % (2 * np.pi) - np.pi))


# --- image-pair optical flow, for comparison: sees both pictures, where our model sees one and the poke -------------

# Both methods look at patches of some 8 pixels, as wide as our objects. Enlargement and settings are those, of 18 each,
# with next to the smallest error of moving pixels on 150 validation pokes (docs/research-log.md).
ENLARGE = 4


def dis_flow(before, after):
    """Dense inverse search (Kroeger et al.): two grey pictures (H, W) uint8 -> (H, W, 2) px."""
    method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    method.setFinestScale(0)
    return method.calc(before, after, None)


def farneback_flow(before, after):
    """Farneback's polynomial expansion: two grey pictures (H, W) uint8 -> (H, W, 2) px."""
    return cv2.calcOpticalFlowFarneback(before, after, None, 0.5, 5, 31, 10, 7, 1.5, cv2.OPTFLOW_FARNEBACK_GAUSSIAN)


PEERS = {"dis": dis_flow, "farneback": farneback_flow}


def image_pair_flow(peer, rgb_before, rgb_after):
    """The optical flow of one of PEERS between two pictures (H, W, 3) uint8 -> (H, W, 2) px. Paper: Sec. IV-E."""
    height, width = rgb_before.shape[:2]
    grey = [cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (ENLARGE * width, ENLARGE * height),
                       interpolation=cv2.INTER_CUBIC) for rgb in (rgb_before, rgb_after)]
    flow = PEERS[peer](*grey)
    return cv2.resize(flow, (width, height), interpolation=cv2.INTER_AREA) / ENLARGE


def evaluate_image_pairs(interactions, truth):
    """End-point errors of the image-pair methods -> {peer_optical_epe_px (moving), peer_optical_epe_all_px}."""
    sums = {(peer, over): 0.0 for peer in PEERS for over in ("moving", "all")}
    count = {"moving": 0, "all": 0}
    for row in range(len(interactions)):
        _, pixels, moving = true_motion(interactions, truth, row)
        where = {"moving": moving, "all": (interactions.depth_before[row] > 0).ravel()}
        for over, mask in where.items():
            count[over] += int(mask.sum())
        for peer in PEERS:
            found = image_pair_flow(peer, interactions.rgb_before[row], interactions.rgb_after[row])
            error = np.linalg.norm(found.reshape(-1, 2) - pixels, axis=1)
            for over, mask in where.items():
                sums[peer, over] += float(error[mask].sum())
    return {f"{peer}_optical_epe{'' if over == 'moving' else '_all'}_px": total / max(count[over], 1)
            for (peer, over), total in sums.items()}
