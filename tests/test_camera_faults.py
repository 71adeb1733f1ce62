"""What real cameras do wrong, and what a robot does about it, against constructions whose answer is known."""
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import TINY, camera, random_run, tiny_pokes

from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.geometry import unproject
from hind4sight_min.lab import camera_faults, evaluation
from hind4sight_min.lab.camera_faults import level, lose_depth, prepared, under_faults, with_faults, wrong_pose
from hind4sight_min.lab.cli import data_small
from hind4sight_min.lab.noise import add_depth_noise, smooth_depth
from hind4sight_min.training import chunk_gradient

TRUE = camera()


def rng_of_side(side):
    """A Generator whose first draw of [-1, 1] is this one."""
    return next(np.random.default_rng(seed) for seed in range(99)
                if np.random.default_rng(seed).choice([-1, 1]) == side)


# --- missing depth ----------------------------------------------------------------------------------------------

def test_a_share_of_the_pixels_is_lost_each_by_itself_and_the_others_stay():
    depth = np.random.default_rng(1).uniform(0.5, 1, (4, 60, 60)).astype(np.float32)
    found = lose_depth(depth, np.random.default_rng(0), TRUE, (0.3,))
    lost = found == 0
    assert found.dtype == depth.dtype and (found[~lost] == depth[~lost]).all()
    assert lost.mean(axis=(1, 2)) == pytest.approx(0.3, abs=4 * np.sqrt(0.21 / 3600))
    together = np.abs(np.corrcoef(lost.reshape(4, -1)) - np.eye(4)).max()
    assert together < 0.08, "all pictures lose the same pixels"
    beside = np.corrcoef(lost[:, :, 1:].ravel(), lost[:, :, :-1].ravel())[0, 1]
    assert abs(beside) < 0.05, "neighbours are lost together"


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("focal, rim, shadow", [(77.0, 1, 2), (154.0, 2, 4)])  # px: the same in metres
def test_rims_and_shadows_lie_on_one_side_of_what_stands_nearer(side, focal, rim, shadow):
    depth = np.full((1, 12, 16), 0.80)
    depth[0, 4:8, 6:10], depth[0, 4:8, 10:] = 0.75, 0.785  # a block, and 1.5 cm beside it that is no edge
    left, right = 6, 10
    edge = left if side < 0 else right
    if side > 0:
        depth[0, 4:8, 10:] = 0.80
    found = [lose_depth(depth, rng_of_side(side), camera(16, 12, focal), (kind,)) == 0 for kind in ("rims", "shadow")]
    for lost, width, sign in zip(found, (rim, shadow), (-side, side)):  # the rim reaches inwards, the shadow outwards
        expected = np.zeros((1, 12, 16), bool)
        expected[0, 4:8, edge - width if sign < 0 else edge:edge if sign < 0 else edge + width] = True
        np.testing.assert_array_equal(lost, expected)


def test_both_pictures_of_a_poke_lose_the_same_side():
    data = tiny_pokes()
    for seed in range(6):
        seen = with_faults(data, np.random.default_rng(seed), missing=("shadow",))
        sides = []
        for name in ("depth_before", "depth_after"):
            lost, columns = getattr(seen, name) == 0, np.arange(16)
            block = getattr(data, name) < data.empty_depth - 0.02
            sides.append(np.sign((lost * columns).sum() / lost.sum() - (block * columns).sum() / block.sum()))
        assert sides[0] == sides[1]


# --- a wrong pose ------------------------------------------------------------------------------------------------

def angle_of(rotation):
    return np.linalg.norm(Rotation.from_matrix(rotation).as_rotvec())


def test_pitch_lifts_the_optical_axis_and_leaves_eye_and_right_alone():
    found = with_faults(tiny_pokes(), np.random.default_rng(0), pitch_error=1.0).camera.arena_from_camera
    true = TRUE.arena_from_camera
    np.testing.assert_allclose(found[:, [0, 3]], true[:, [0, 3]], atol=1e-12)
    rise = [np.degrees(np.arcsin(pose[2, 2])) for pose in (true, found)]
    assert rise[1] - rise[0] == pytest.approx(1.0), "too far up, in degrees"


def test_a_wrong_pose_is_wrong_by_so_much_in_any_direction_and_leaves_the_pictures():
    data, true = tiny_pokes(), TRUE.arena_from_camera
    axes, shifts = [], []
    for seed in range(40):
        seen = with_faults(data, np.random.default_rng(seed), pose_error=(2.0, 0.01))
        pose = seen.camera.arena_from_camera
        np.testing.assert_array_equal(seen.depth_before, data.depth_before)
        assert np.degrees(angle_of(true[:3, :3].T @ pose[:3, :3])) == pytest.approx(2.0)
        assert np.linalg.norm(pose[:3, 3] - true[:3, 3]) == pytest.approx(0.01)
        axes.append(Rotation.from_matrix(true[:3, :3].T @ pose[:3, :3]).as_rotvec())
        shifts.append(pose[:3, 3] - true[:3, 3])
    for drawn in (axes, shifts):
        spread = np.linalg.eigvalsh(np.cov(np.transpose(drawn)))
        assert spread[0] > 0.4 * spread[2], "not in any direction"


def test_noise_is_that_of_sec_iv_b_and_without_faults_nothing_changes():
    data = tiny_pokes()
    noisy, rng = with_faults(data, np.random.default_rng(3), depth_noise=0.01), np.random.default_rng(3)
    np.testing.assert_array_equal(noisy.depth_before, add_depth_noise(data.depth_before, rng))
    np.testing.assert_array_equal(noisy.depth_after, add_depth_noise(data.depth_after, rng))
    both = with_faults(data, np.random.default_rng(3), depth_noise=0.01, missing=(0.3,))
    kept = both.depth_after > 0
    assert 0.5 < kept.mean() < 0.9
    np.testing.assert_array_equal(both.depth_after[kept], noisy.depth_after[kept], err_msg="what is left is noisy too")
    same = with_faults(data, rng)
    for name in ("depth_before", "depth_after"):
        np.testing.assert_array_equal(getattr(same, name), getattr(data, name))
    np.testing.assert_array_equal(same.camera.arena_from_camera, TRUE.arena_from_camera)


@pytest.mark.parametrize("faults, named", [
    *[({"missing": (kind,)}, f"missing.*rims, shadow.*{kind}") for kind in (0.0, 1.0, -0.1, float("nan"), "rim")],
    *[({"pitch_error": bad}, "pitch_error.*degrees") for bad in (46, float("nan"), -float("inf"))],
    ({"pose_error": (46, 0)}, "pose_error.*degrees"), ({"pose_error": (0, 1.1)}, "pose_error: .*1 m"),
    ({"depth_noise": -0.01}, "standard_deviation"), ({"depth_noise": 1.0}, "depth_noise: expected at most 0.1 m"),
    ({"pose_error": 1.0}, "pose_error: expected .*degrees, m"), ({"pitch_error": "1"}, "pitch_error: expected")])
def test_refusals(faults, named):
    with pytest.raises(ValueError, match=named):
        with_faults(tiny_pokes(), np.random.default_rng(0), **faults)


# --- levelling ---------------------------------------------------------------------------------------------------

def table(cam, walls=0.0):
    """Depth of a table at z = 0 (H, W), and of walls 3 cm high behind and beside it, in this share of the picture."""
    v, u = np.mgrid[:cam.height, :cam.width]
    rays = np.stack([(u - cam.cx) / cam.fx, (v - cam.cy) / cam.fy, np.ones(u.shape)], axis=-1)
    down, eye = (rays @ cam.arena_from_camera[:3, :3].T)[..., 2], cam.arena_from_camera[2, 3]
    high = np.where((v < walls * cam.height / 2) | (u < walls * cam.width / 2), 0.03, 0)
    return (high - eye) / down


@pytest.mark.parametrize("walls", [0.0, 0.3])
def test_levelling_undoes_pitch_and_height_to_the_last_bit_whatever_the_walls(walls):
    cam = camera(64, 48, 80.0)
    wrong = wrong_pose(cam, [np.radians(1.5), 0, 0], [0, 0, 0.012])
    empty = table(cam, walls)
    assert np.abs(unproject(empty, wrong)[..., 2]).max() > 0.02
    np.testing.assert_allclose(level(wrong, empty).arena_from_camera, cam.arena_from_camera, atol=1e-12)
    np.testing.assert_allclose(level(cam, empty).arena_from_camera, cam.arena_from_camera, atol=1e-12)
    empty[::3, ::2] = 0  # holes
    np.testing.assert_allclose(level(wrong, empty).arena_from_camera, cam.arena_from_camera, atol=1e-12)


def test_what_levelling_leaves_is_a_turn_about_the_vertical_and_a_shift_along_the_table():
    cam, rng = camera(64, 48, 80.0), np.random.default_rng(0)
    for _ in range(5):
        turn = np.radians(1) * rng.standard_normal(3)
        wrong = wrong_pose(cam, turn, 0.01 * rng.standard_normal(3))
        found = level(wrong, table(cam))
        left = found.arena_from_camera[:3, :3] @ cam.arena_from_camera[:3, :3].T
        about_vertical = turn @ cam.arena_from_camera[2, :3]
        assert angle_of(left) == pytest.approx(abs(about_vertical), abs=1e-5)
        np.testing.assert_allclose(left @ [0, 0, 1], [0, 0, 1], atol=1e-9)
        np.testing.assert_allclose(found.arena_from_camera[:2, 3], wrong.arena_from_camera[:2, 3])
        assert np.abs(unproject(table(cam), found)[..., 2]).max() < 1e-9


def test_an_empty_picture_without_a_table_is_refused():
    with pytest.raises(ValueError, match="empty_depth: expected the table within 0.05 m of z = 0 in 25%.*got 0%"):
        level(TRUE, table(wrong_pose(TRUE, [0, 0, 0], [0, 0, 0.2])))


SIMULATED = load_interactions(data_small() / "test")[:1]


def error_of(camera, true):
    """By how many degrees a pose is off, and by how many mm it misplaces the points of the empty table on average."""
    apart = camera.arena_from_camera @ true.camera_from_arena
    clouds = [unproject(SIMULATED.empty_depth.astype(float), each) for each in (camera, true)]
    return np.degrees(angle_of(apart[:3, :3])), 1000 * np.linalg.norm(clouds[0] - clouds[1], axis=-1).mean()


def test_the_walls_tell_what_the_table_does_not():
    true, rng = SIMULATED.camera, np.random.default_rng(0)
    for _ in range(4):
        seen = with_faults(SIMULATED, rng, pose_error=(1.0, 0.01))
        assert error_of(level(seen.camera, seen.empty_depth), true)[1] > 3
        angle, distance = error_of(prepared(seen).camera, true)
        assert angle < 0.01 and distance < 1, (angle, distance)  # tops tell it to no better than a part of a pixel
        noisy = np.float32(seen.empty_depth + 0.002 * rng.standard_normal(seen.empty_depth.shape))
        angle, distance = error_of(prepared(replace(seen, empty_depth=noisy)).camera, true)
        assert angle < 0.3 and distance < 4, (angle, distance)


def test_without_walls_in_the_settings_the_camera_is_levelled_alone():
    settings = {name: value for name, value in SIMULATED.settings.items() if name != "wall_height"}
    seen = with_faults(replace(SIMULATED, meta={"settings": settings}), np.random.default_rng(0), pose_error=(1, 0.01))
    expected = level(seen.camera, seen.empty_depth)
    np.testing.assert_array_equal(prepared(seen).camera.arena_from_camera, expected.arena_from_camera)


# --- before the model looks ---------------------------------------------------------------------------------------

def test_a_hole_is_filled_by_what_is_near_and_alike():
    cam = camera(16, 12, 80.0)
    empty = table(cam).astype(np.float32)
    depth, images = empty[None].copy(), np.full((1, 12, 16, 3), 150, np.uint8)
    depth[0, 3:9, 4:9] -= 0.05
    images[0, 3:9, 4:9] = [220, 30, 30]
    true, holes = depth.copy(), [(0, 5, 8), (0, 6, 8), (0, 6, 4), (0, 6, 9), (0, 7, 9), (0, 4, 6)]
    for hole in holes:  # at the block's rims, beside it, within
        depth[hole] = 0
    found = smooth_depth(depth, empty, images, cam)
    for hole in holes:
        assert found[hole] == pytest.approx(true[hole], abs=0.002), (hole, "filled by what is unlike it?")
    depth[0, :, 9:] = 0  # nobody near at all
    images[0, :, 9:] = 0
    found = smooth_depth(depth, empty, images, cam)
    assert (found[0, :, 12:] == 0).all() and (found[0, :, :9] > 0).all()
    empty[2, 3], depth[0, 2, 3] = 0, 0.7  # without an empty arena there, nothing is known of the difference
    found = smooth_depth(depth, empty, images, cam)
    assert found[0, 2, 3] == np.float32(0.7) and np.abs(found[0, 2, 4] - empty[2, 4]) < 1e-3


def test_prepared_pokes_are_level_smooth_and_whole():
    data = tiny_pokes(cam=camera(64, 48, 80.0))
    seen = with_faults(data, np.random.default_rng(0), 0.005, (0.3,), pitch_error=1.0)
    found = prepared(seen)
    np.testing.assert_allclose(found.camera.arena_from_camera, data.camera.arena_from_camera, atol=1e-5)
    for name in ("before", "after"):
        depth, colours = (getattr(seen, f"{what}_{name}") for what in ("depth", "rgb"))
        expected = smooth_depth(depth, data.empty_depth, colours, data.camera)
        np.testing.assert_array_equal(getattr(found, f"depth_{name}"), expected)
        assert (expected > 0).mean() > 0.999


# --- training and asking ------------------------------------------------------------------------------------------

def test_training_draws_every_fault_for_some_chunks_and_prepares_all_of_them(monkeypatch):
    drawn, given, data = [], [], tiny_pokes()
    monkeypatch.setattr(camera_faults, "with_faults", lambda data, rng, **faults: drawn.append(faults) or data)
    monkeypatch.setattr(camera_faults, "prepared", lambda data: ("prepared", len(data)))
    rng = np.random.default_rng(0)
    for _ in range(400):
        under_faults("params", "recipe", data, rng, lambda *arguments: given.append(arguments))
    assert given[7] == ("params", "recipe", ("prepared", 7), rng) and len(given) == 400
    for name, (value, share) in camera_faults.TRAINED.items():
        there = [faults[name] for faults in drawn if name in faults]
        assert len(there) == pytest.approx(400 * share, abs=40) and set(there) == {value}, name
    assert len({tuple(faults) for faults in drawn}) == 8, "faults come alone and together"


def test_the_loss_copes_with_holes_that_nothing_fills_in_both_pictures(monkeypatch):
    faults = {"depth_noise": (0.005, 0.5), "missing": ((0.6, "rims"), 0.5), "pose_error": ((1, 0.01), 0.5)}
    monkeypatch.setattr(camera_faults, "TRAINED", faults)
    data, holes = tiny_pokes(), np.arange(16) >= 12
    data.depth_before[:, :, holes], data.depth_after[:, :3] = 0, 0
    data.rgb_before[:, :, holes] = 0
    run = random_run(TINY, data=data)
    for seed in range(4):
        with np.errstate(over="ignore"):  # as in training: tanh's slope at a hole, whose point is at the camera
            terms, gradient = chunk_gradient(under_faults, run.vector, run.layout, run.recipe, data, seed)
        assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0
        assert all(np.isfinite(value) for value in terms.values()) and 0 < terms["chamfer"] < 1


def test_a_run_for_cameras_is_asked_about_prepared_pictures_others_only_under_faults(monkeypatch):
    data, run = tiny_pokes(), random_run(TINY)
    data.depth_before[2, 4, 5] = 0
    assert not evaluation.ask(run, data, 2).before.valid.all()
    assert evaluation.ask(run, data, 2, depth_noise=0.0, missing=()).before.valid.sum() == 191
    run.meta["camera_faults"] = True
    answer = evaluation.ask(run, data, 2)
    assert answer.before.valid.all(), "its holes were filled"
    seen = prepared(data[[2]])
    np.testing.assert_array_equal(answer.before.points[0], unproject(seen.depth_before[0], seen.camera).reshape(-1, 3))
    with_pitch = evaluation.ask(run, data, 2, pitch_error=1.0)
    np.testing.assert_allclose(with_pitch.before.points, answer.before.points, atol=1e-4, err_msg="levelled")
    shifted = evaluation.ask(run, data, 2, pose_error=(0, 0.01))
    assert np.abs(shifted.before.points - answer.before.points).max() > 3e-3
