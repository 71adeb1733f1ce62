"""Optical flow from two pictures, the peers of Sec. IV-E."""
import cv2
import numpy as np
import pytest
from test_se3nets import moved_blocks

from hind4sight_min.geometry import optical_flow, unproject
from hind4sight_min.lab import image_pairs


@pytest.mark.parametrize("peer", ["dis", "farneback"])
def test_flow_of_a_shifted_picture(peer):
    rng = np.random.default_rng(0)
    picture = cv2.resize(rng.integers(0, 255, (18, 25, 3), dtype=np.uint8), (70, 50), interpolation=cv2.INTER_CUBIC)
    found = image_pairs.image_pair_flow(peer, picture[1:49, 3:67], picture[:48, 1:65])  # moves by (2, 1)
    assert found.shape == (48, 64, 2)
    np.testing.assert_allclose(np.median(found[8:-8, 8:-8], axis=(0, 1)), [2, 1], atol=0.05,
                               err_msg="x and y, or before and after, swapped; or px of the enlarged picture?")


def test_errors_against_a_made_up_flow(monkeypatch):
    data = moved_blocks()
    data.interactions.depth_before[:, 11] = 0  # missing: not counted
    asked, made_up = [], {"dis": [0.5, 0.0], "farneback": [0.0, -2.0]}

    def flow(peer, before, after):
        asked.append((before is not after, peer))
        return np.broadcast_to(np.float32(made_up[peer]), (12, 16, 2))
    monkeypatch.setattr(image_pairs, "image_pair_flow", flow)
    found = image_pairs.evaluate_image_pairs(data.interactions, data.truth)
    points = unproject(data.interactions.depth_before, data.camera)
    block = data.truth.labels == 1
    shift = block[..., None] * data.truth.poses_after[:, None, None, 0, :3]
    true, seen = optical_flow(points, points + shift, data.camera), data.interactions.depth_before > 0
    for peer, value in made_up.items():
        error = np.linalg.norm(value - true, axis=-1)
        assert found[f"{peer}_optical_epe_px"] == pytest.approx(error[block & seen].mean(), rel=1e-3)
        assert found[f"{peer}_optical_epe_all_px"] == pytest.approx(error[seen].mean(), rel=1e-3)
    assert len(asked) == 14 and all(different for different, _ in asked)
