"""Optical flow from two pictures, the peers of Sec. IV-E."""
import cv2
import numpy as np
import pytest
from test_se3nets import moved_blocks

from hind4sight_min.lab import image_pairs
from hind4sight_min.lab.evaluation import true_motion


@pytest.mark.parametrize("peer", ["dis", "farneback"])
def test_flow_of_a_shifted_picture(peer):
    rng = np.random.default_rng(0)
    picture = cv2.resize(rng.integers(0, 255, (18, 25, 3), dtype=np.uint8), (70, 50), interpolation=cv2.INTER_CUBIC)
    found = image_pairs.image_pair_flow(peer, picture[1:49, 3:67], picture[:48, 1:65])  # moves by (2, 1)
    assert found.shape == (48, 64, 2)
    np.testing.assert_allclose(np.median(found[8:-8, 8:-8], axis=(0, 1)), [2, 1], atol=0.05,
                               err_msg="x and y, or before and after, swapped; or px of the enlarged picture?")


def test_errors_against_a_made_up_flow(monkeypatch):
    data, made_up = moved_blocks(), {"dis": [0.5, 0.0], "farneback": [0.0, -2.0]}
    data.interactions.depth_before[:, 11] = 0  # missing: not counted
    monkeypatch.setattr(image_pairs, "image_pair_flow", lambda peer, before, after: np.broadcast_to(
        np.float32(made_up[peer]) * (before is not after), (12, 16, 2)))
    found = image_pairs.evaluate_image_pairs(data.interactions, data.truth)
    motions = [true_motion(data.interactions, data.truth, row) for row in range(7)]
    true, moving = np.concatenate([each[1] for each in motions]), np.concatenate([each[2] for each in motions])
    for peer, value in made_up.items():
        error = np.linalg.norm(value - true, axis=-1)
        assert found[f"{peer}_optical_epe_px"] == pytest.approx(error[moving].mean(), rel=1e-3)
        seen = data.interactions.depth_before.ravel() > 0
        assert found[f"{peer}_optical_epe_all_px"] == pytest.approx(error[seen].mean(), rel=1e-3)
