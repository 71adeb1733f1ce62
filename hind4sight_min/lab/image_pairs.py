"""Optical flow from two pictures, for comparison: it sees before and after, where our model sees before and the poke.

Paper: Sec. IV-E, which has FlowNet 2.0 here.
"""
import cv2
import numpy as np

from .evaluation import true_motion

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
    """The optical flow of one of PEERS between two pictures (H, W, 3) uint8 -> (H, W, 2) px."""
    height, width = rgb_before.shape[:2]
    grey = [cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (ENLARGE * width, ENLARGE * height),
                       interpolation=cv2.INTER_CUBIC) for rgb in (rgb_before, rgb_after)]
    return cv2.resize(PEERS[peer](*grey), (width, height), interpolation=cv2.INTER_AREA) / ENLARGE


def evaluate_image_pairs(interactions, truth):
    """End-point errors of PEERS -> {peer_optical_epe_px: over moving points, peer_optical_epe_all_px: over all}."""
    errors, moving = {peer: [] for peer in PEERS}, []
    seen = interactions.depth_before > 0
    for row in range(len(interactions)):
        _, pixels, moves = true_motion(interactions, truth, row)
        moving.append(moves.reshape(seen[row].shape))
        for peer in PEERS:
            flow = image_pair_flow(peer, interactions.rgb_before[row], interactions.rgb_after[row])
            errors[peer].append(np.linalg.norm(flow - pixels.reshape(flow.shape), axis=2))
    return {f"{peer}_optical_epe{over}_px": float(np.stack(errors[peer])[where].mean())
            for peer in PEERS for over, where in (("", np.stack(moving)), ("_all", seen))}
