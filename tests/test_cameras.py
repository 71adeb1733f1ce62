"""Real cameras: recordings in and out, lens distortion, small pictures, holes, poses, and which camera will do."""
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import camera, random_run, tiny_pokes

from hind4sight_min.disk import checkpoints, recordings
from hind4sight_min.disk.shards import counts_of, load_interactions, save_shard, stamp
from hind4sight_min.geometry import unproject
from hind4sight_min.interactions import PER_POKE
from hind4sight_min.lab import cameras, control, evaluation
from hind4sight_min.lab.cli import main
from hind4sight_min.training import scenes_of

ROOT = Path(__file__).resolve().parent.parent
WIDTH, HEIGHT, DISTORTION = 320, 240, [-0.12, 0.05, 0.004, -0.003, 0.02]
MATRIX = np.array([[330.0, 0, 155], [0, 340, 128], [0, 0, 1]])
POSE = camera().arena_from_camera


def rays_of(pixels, distortion=DISTORTION):
    """What MATRIX and a distortion see at pixels (..., 2): rays (..., 3) of camera axes, as OpenCV inverts them."""
    straight = cv2.undistortPoints(np.reshape(pixels, (-1, 1, 2)).astype(float), MATRIX, np.array(distortion))
    return np.insert(straight.reshape(np.shape(pixels)), 2, 1, axis=-1)


def table_depth(pose=POSE, height=0.0):
    """The depth of a plane at z = height as the distorting camera records it, by closed form: (HEIGHT, WIDTH) m."""
    rays = rays_of(np.dstack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))))
    return (height - pose[2, 3]) / (rays @ pose[:3, :3].T)[..., 2]


def painted():
    """A picture (HEIGHT, WIDTH, 3) whose colours, red first, say where in it one is: x / 2, y, 100."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([x / 2, y, 0 * x + 100], axis=-1).round().astype(np.uint8)


def recorded(folder, count=1, unit=0.001, **entries):
    """A recording of a block, 6 cm high, that a poke ends at."""
    empty = table_depth()
    block = empty.copy()
    block[100:140, 120:170] = table_depth(height=0.06)[100:140, 120:170]
    folder.mkdir(parents=True, exist_ok=True)

    def write(name, picture):
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    write("empty_depth", np.round(empty / unit).astype(np.uint16))
    target = (POSE[:3, :3] @ rays_of([145, 120]) * block[120, 145] + POSE[:3, 3])[:2]
    for i in range(count):
        for when in ("before", "after"):
            write(f"{i}_{when}", painted()[..., ::-1])
            write(f"{i}_{when}_depth", np.round(block / unit).astype(np.uint16))
    lines = [f"{i}, {target[0]}, {target[1]}, 0, {target[0] - 0.1}, {target[1]}\n" for i in range(count)]
    (folder / "pokes.csv").write_text("name, target_x, target_y, direction, start_x, start_y\n" + "".join(lines))
    known = {"width": WIDTH, "height": HEIGHT, "camera_matrix": MATRIX.tolist(), "distortion": DISTORTION,
             "depth_unit": unit, "arena_from_camera": POSE.tolist(), **entries}
    (folder / "camera.json").write_text(json.dumps({k: v for k, v in known.items() if v is not None}))
    return folder


# --- there and back -----------------------------------------------------------------------------------------------

def test_what_is_exported_comes_back_to_the_bit(tmp_path, capsys):
    made = tiny_pokes(cam=camera(64, 48, focal=80.0))
    made.meta = {**made.meta, "seed": 5}
    made.depth_after[2, 3, 4] = made.empty_depth[5, 6] = 0
    save_shard(tmp_path / "data" / "shard_0000.npz", made[:4])
    save_shard(tmp_path / "data" / "shard_0001.npz", made[4:])
    data, folder, out = (str(tmp_path / name) for name in ("data", "recording", "out"))
    assert main(["export", data, folder]) == 0 and main(["import", folder, out]) == 0
    assert "7 pokes, 64 x 48 px" in capsys.readouterr().out
    found, made = load_interactions(out), load_interactions(data)
    for name in PER_POKE:
        np.testing.assert_array_equal(getattr(found, name), np.asarray(getattr(made, name), getattr(found, name).dtype))
    for name, value in vars(made.camera).items():
        np.testing.assert_allclose(getattr(found.camera, name), value, rtol=1e-12, err_msg=name)
    assert (found.settings, found.meta["seed"]) == (made.settings, 5) and found.empty_depth[5, 6] > 0
    assert main(["export", data, folder]) == 2 and main(["import", folder, out]) == 2, "over what was there"


# --- small pictures without distortion ----------------------------------------------------------------------------

@pytest.mark.parametrize("size", [(40, 30), (64, 40), (100, 75)])
def test_a_small_pixel_shows_what_opencv_projects_to_it(size, tmp_path):
    cameras.import_recording(recorded(tmp_path / "r"), tmp_path / "out", size)
    data = load_interactions(tmp_path / "out")
    points = unproject(data.depth_before[0].astype(float), data.camera)
    seen = data.depth_before[0] > 0
    assert seen.mean() > 0.9
    there = data.camera.camera_from_arena
    pixels = cv2.projectPoints(points[seen], cv2.Rodrigues(there[:3, :3])[0], there[:3, 3], MATRIX,
                               np.array(DISTORTION))[0][:, 0]
    inside = ((pixels > 8) & (pixels < [WIDTH - 9, HEIGHT - 9])).all(axis=1)
    colours = data.rgb_before[0][seen][inside].astype(float) * [2, 1, 1]
    away = colours[:, :2] - pixels[inside]
    assert np.abs(away).max() < 1.6, "distortion the wrong way round? half a pixel lost?"
    assert np.abs(away.mean(axis=0)).max() < 0.15
    middle = data.rgb_before[0][size[1] // 2, size[0] // 2].astype(float) * [2, 1, 1]
    assert np.abs(middle[:2] - [160, 120]).max() < 8, "not the recorded picture's middle"
    heights, off = points[seen][:, 2], 0.001 + data.camera.pixel_size / 4  # at a rim a part of the block
    assert (np.minimum(np.abs(heights), np.abs(heights - 0.06)) < off).all(), "a mean of the object and the table?"
    assert (heights > 0.05).mean() > 0.02


def test_holes_stay_holes_and_pull_nothing_nearer():
    recording = recordings.Recording(Path(), [], [], [], 48, 48, MATRIX, 0.001)
    depth = np.ones((48, 48))
    depth[:3, :12] = [[0, 0.7, 0.7, 0, 0.8, 0.7, 0, 0.8, 1.2, 0, 0.8, 0.806],
                      [0, 0.0, 0.7, 0, 0.8, 0.9, 0, 0.8, 0.7, 0, 0.8, 0.700],
                      [0, 0.0, 0.7, 0, 1.2, 0.0, 0, 1.2, 1.2, 0, 1.2, 1.200]]
    small, expected = cameras.sampling_of(recording, (16, 16)).depth(depth), np.ones((16, 16))
    expected[0, :4] = 0, 0.8, 0.8, 0.803  # 4 of 9 are too few; of 5 the third; of 6 the nearer, or a mean
    np.testing.assert_allclose(small, expected, err_msg="were the holes counted in?")


def test_depth_that_no_shard_can_hold_is_missing():
    for unit, expected in (0.001, [0.8] * 5 + [0.9, 6.4, 0, 0, 0]), (0.0025, [2] * 5 + [2.25, 0, 0, 0, 0]):
        found = cameras.metres_of("depth.png", np.array([[800] * 5 + [900, 6400, 6501, 65535, 0]], np.uint16), unit)
        np.testing.assert_allclose(found, [expected], rtol=1e-6)
    np.testing.assert_array_equal(counts_of(np.array([-0.1, 1e10, np.inf, np.nan, 6.6, 0.8])), [0, 0, 0, 0, 0, 8000])


# --- the pose -----------------------------------------------------------------------------------------------------

def turned(pose, *angles):
    """The pose with the camera itself turned by angles in degrees about its x, y and z."""
    result = pose.copy()
    result[:3, :3] = pose[:3, :3] @ Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return result


@pytest.mark.parametrize("origin", [None, [100.0, 150.0]])
def test_the_pose_is_found_in_the_empty_picture_under_noise_walls_and_holes(origin, tmp_path):
    rng, true = np.random.default_rng(1), turned(POSE, 4, -3, 7)
    depth = table_depth(true) * (1 + 0.003 * rng.standard_normal((HEIGHT, WIDTH)))
    depth[:, :70], depth[:40] = 0.5 + 0.2 * rng.random((HEIGHT, 70)), 0
    folder = recorded(tmp_path / "r", arena_from_camera=None, **({} if origin is None else {"origin": origin}))
    cv2.imwrite(str(folder / "empty_depth.png"), np.round(1000 * depth).astype(np.uint16))
    found = cameras.import_recording(folder, tmp_path / "out", (80, 60))
    pose = found["camera"].arena_from_camera
    np.testing.assert_allclose(pose[2], true[2], atol=0.003, err_msg="the table's normal and how far it is")
    assert abs(pose[1, 0]) < 1e-12 and pose[0, 0] > 0.9, "x is not the camera's right, along the table"
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    middle = np.linalg.solve(pose[:3, :3], -pose[:3, 3])  # the arena's origin, camera axes
    pixel = cv2.projectPoints(middle[None], np.zeros(3), np.zeros(3), MATRIX, np.array(DISTORTION))[0].ravel()
    np.testing.assert_allclose(pixel, [159.5, 119.5] if origin is None else origin, atol=0.05)
    assert 0.5 < found["table"] < 0.8


def test_a_rotation_as_it_is_printed_becomes_a_true_one():
    printed = np.round(POSE, 3)
    pose = cameras.rigid_pose(printed)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose, printed, atol=1e-3)
    assert np.abs(pose - printed).max() > 1e-5
    np.testing.assert_array_equal(cameras.rigid_pose(POSE), POSE, err_msg="one that is true already stays")


def test_holes_in_the_empty_picture_are_filled_where_the_table_surrounds_them():
    cam = camera(64, 48, focal=80.0)
    empty = tiny_pokes(1, cam=cam).empty_depth
    seen = empty.copy()
    seen[10:16, 20:30] = seen[30, 5] = seen[47, 60:] = 0  # on the table, the last at the picture's rim
    seen[20:30, 40:50] -= 0.05  # something stands there, with a hole in its middle
    seen[24:26, 44:46] = seen[21:24, 38:42] = 0  # and one half on the table
    expected = seen.copy()
    for hole in (slice(10, 16), slice(20, 30)), (30, 5), (47, slice(60, None)):
        expected[hole] = empty[hole]
    np.testing.assert_allclose(cameras.filled(seen, cam), expected, rtol=1e-5)
    np.testing.assert_array_equal(cameras.filled(0 * seen, cam), 0 * seen, err_msg="nothing surrounds it")


# --- which camera will do -----------------------------------------------------------------------------------------

def test_a_model_works_through_another_camera():
    wide, near = (tiny_pokes(2, cam=camera(64, 48, focal=f, x=x)) for f, x in ((80.0, 0.0), (95.0, 0.05)))
    run = random_run(data=wide)
    assert np.isfinite(evaluation.ask(run, near, 0).prediction.points).all()


def moved(pose, **entries):
    pose = pose.copy()
    for entry, value in entries.items():
        pose["xyz".index(entry), 3] = value
    return pose


@pytest.mark.parametrize("changes, said", [
    ({"arena_from_camera": moved(POSE, z=-0.62)}, "arena_from_camera: .*above the table, got one at z = -0.62"),
    ({"arena_from_camera": turned(POSE, 0, 180, 0)}, "arena_from_camera: .*the arena's middle .* ahead"),
    ({"arena_from_camera": moved(POSE, x=0.6)}, "arena_from_camera: .*the arena's middle"),
    ({"arena_from_camera": np.linalg.inv(POSE)}, "arena_from_camera: "),
    ({"arena_from_camera": moved(1000 * POSE, x=0, y=-460, z=620) / [[1000] * 3 + [1]] * 4}, "rigid"),
    ({"fx": 9.0, "fy": 9.9}, "fx: expected pixels of at most 77 mm .* got 86")])
def test_a_camera_that_cannot_work_is_refused_by_the_field(changes, said):
    with pytest.raises(ValueError, match=f"camera: .*{said}"):
        cameras.check_camera(replace(camera(), **changes), camera())


def test_the_simulator_takes_the_size_of_the_training_where_it_can():
    sizes = {(96, 72): (96, 72), (64, 36): (64, 48)}
    for size, expected in sizes.items():
        run = random_run()
        run.meta["camera"] = {"width": size[0], "height": size[1]}
        settings = control.settings_for(run)
        assert (settings.width, settings.height) == expected


# --- a real camera ------------------------------------------------------------------------------------------------

REAL = ROOT.parent / "shared" / "real"


@pytest.mark.skipif(not REAL.is_dir(), reason="the real frames are not here: ../shared/real")
def test_real_frames_load_align_and_show(tmp_path, capsys):
    folder, camera_json = tmp_path / "r", {"width": 640, "height": 480, "depth_unit": 1e-4}
    folder.mkdir()
    for source, name in (("empty.depth", "empty_depth"), ("input.color", "a_before"), ("input.color", "a_after"),
                         ("input.depth", "a_before_depth"), ("input.depth", "a_after_depth")):
        shutil.copy(REAL / f"{source}.png", folder / f"{name}.png")
    camera_json["camera_matrix"] = np.loadtxt(REAL / "intrinsics.txt").tolist()
    (folder / "camera.json").write_text(json.dumps(camera_json))
    (folder / "pokes.csv").write_text("name,target_x,target_y,direction,start_x,start_y\n"
                                      f"a,-0.014,-0.124,{-np.pi / 2},-0.014,-0.004\n")  # at the flashlight, down
    model, out = ROOT / "data_small" / "checkpoint.npz", tmp_path / "out"
    assert main(["import", str(folder), str(out)]) == 0
    assert re.search(r" 0\.[67]\d* m above the table, looking down at 5[5-7]\.\d degrees", capsys.readouterr().out)
    data = load_interactions(out)
    before, _ = scenes_of(data)
    points, occupied = before.points[0].reshape(48, 64, 3), before.occupied[0].reshape(48, 64)
    inside = np.zeros((48, 64), bool)
    inside[29:34, 27:36] = True  # of the whole picture, y 290 to 340 and x 270 to 360 px
    flashlight = inside & occupied
    assert flashlight.sum() >= 12 and 0.015 < points[flashlight][:, 2].max() < 0.04, "a flashlight is 3 cm thick"
    red, _, blue = np.moveaxis(data.rgb_before[0][flashlight].astype(int), -1, 0)
    assert (blue > red).mean() > 0.7, "depth and colour do not lie over each other, or blue is red"
    assert occupied.sum() < 300, "the bin itself stands out"
    masks = evaluation.ask(checkpoints.load_run(model), data, 0).prediction.masks[0].argmax(axis=1).reshape(48, 64) > 0
    assert 0.8 * flashlight.sum() < masks.sum() < 4 * flashlight.sum() and (masks & flashlight).sum() > 10
    assert main(["show", str(model), str(out), "--out", str(tmp_path / "poke.png")]) == 0


# --- what cannot be -----------------------------------------------------------------------------------------------

def entry(**changes):
    def spoil(folder):
        path = folder / "camera.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))
    return spoil


def text(name, old, new):
    def spoil(folder):
        path = folder / name
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))
    return spoil


def picture(name, value):
    return lambda folder: cv2.imwrite(str(folder / f"{name}.png"), value)


def cut(name):
    def spoil(folder):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[:len(content) // 2])
    return spoil


DEPTH = np.full((HEIGHT, WIDTH), 800, np.uint16)
FEW = np.uint16(np.arange(HEIGHT) < 10)[:, None]  # rows, of which any plane has most


@pytest.mark.parametrize("spoil, said", [
    (lambda folder: (folder / "camera.json").unlink(), "camera.json: no such file"),
    (text("camera.json", "{", ""), "camera.json: "),
    (entry(distorsion=[0.1] * 5), "camera.json: .*no other .*distorsion"),
    (entry(width="320"), ": width: expected a whole number"), (entry(depth_unit=None), "depth_unit: expected"),
    (entry(depth_unit=-0.001), "depth_unit: expected .*above 0, got -0.001"),
    (entry(camera_matrix=[330, 340, 155, 128]), "camera_matrix: expected .*\\(3, 3\\)"),
    (entry(camera_matrix=MATRIX.T.tolist()), "camera_matrix: expected .*fx, 0, cx"),
    (entry(camera_matrix=(MATRIX * [0, 1, 1]).tolist()), "camera_matrix: expected .*fx, 0, cx"),
    (entry(distortion=[0.1, 0.2]), "distortion: expected .*\\(4,\\)"), (entry(distortion=[1e400] * 4), "distortion: "),
    (entry(origin=[3, 4]), "origin: expected none beside"), (entry(settings=[1]), "settings: expected"),
    (entry(settings={"arena": "big"}), "settings: arena: expected"),
    (entry(settings={"cell": None}), "settings: cell: expected finite"),
    (entry(settings={"finger_radius": 0}), "settings: finger_radius: expected above 0"),
    (entry(settings={"poke_length": [100, 140]}), "settings: poke_length: expected .*up to 5 m"),
    (entry(camera_matrix=[[1.03, 0, 0.48], [0, 1.4, 0.53], [0, 0, 1]]), "camera_matrix: expected fx in pixels .*320"),
    (lambda folder: (folder / "camera.json").write_text('{"width": 320}'), "camera.json: expected width, height, "),
    (lambda folder: (folder / "camera.json").write_text("[3]"), "camera.json: expected names and values"),
    (lambda folder: (folder / "camera.json").write_text("[" * 100_000), "camera.json: maximum recursion"),
    (entry(arena_from_camera=(1.01 * POSE).tolist()), "arena_from_camera: expected a rotation"),
    (entry(arena_from_camera=np.diag([1, 1, -1, 1.0]).tolist()), "arena_from_camera: expected a rotation"),
    (entry(arena_from_camera=moved(POSE, z=620).tolist()), "camera: arena_from_camera: expected the arena's middle"),
    (entry(depth_unit=1), "empty_depth.png: .*0.1 to 6.5 m, got a median of .* with a depth_unit of 1 m"),
    (entry(depth_unit=1e-5), "empty_depth.png: .*got a median of 0.00"),
    (entry(width=640), "empty_depth.png: expected 640 x 240"),
    (picture("empty_depth", DEPTH.astype(np.uint8)), "empty_depth.png: .*16 bits, grey, got .*8 bits, grey"),
    (lambda folder: (entry(arena_from_camera=None)(folder), picture("empty_depth", DEPTH * FEW)(folder)),
     "empty_depth.png: expected depth in 25% of it to find the table, got 3%; give arena_from_camera"),
    (picture("0_before", DEPTH), "0_before.png: expected .*8 bits, colour, got .*16 bits, grey"),
    (picture("0_after_depth", 0 * DEPTH), "0_after_depth.png: expected depths"),
    (picture("0_after_depth", DEPTH * np.eye(WIDTH, dtype=np.uint16)[:HEIGHT]), "0_after_depth.png: .* depth in 50%"),
    (cut("0_after.png"), "0_after.png: damaged"), (cut("pokes.csv"), "pokes.csv: "),
    (lambda folder: (folder / "0_after.png").write_bytes(b"GIF89a"), "0_after.png: expected a PNG"),
    (lambda folder: (folder / "0_after.png").unlink(), "0_after.png: no such file"),
    (text("pokes.csv", "direction", "angle"), "pokes.csv: expected columns name, target_x"),
    (text("pokes.csv", ", 0, ", ", x, "), "pokes.csv: line 2: expected a name and five numbers"),
    (text("pokes.csv", ", 0, ", ", 0, 5, "), "pokes.csv: line 2: expected a name and five numbers"),
    (text("pokes.csv", ", 0, ", ", nan, "), "expected its direction"),
    (text("pokes.csv", ", 0, ", ", 30, "), "0.000 rad, got 30"),
    (text("pokes.csv", "\n0, ", "\n1, 300, 0, 0, 1e300, 0\n0, "), "poke 1: expected start and target within 0.5 m"),
    (text("pokes.csv", "\n0,", "\n../0,"), "line 2: expected a name of its own"),
    (text("pokes.csv", "\n", "\n0, 0, 0, 0, -0.1, 0\n0, 0, 0, 0, -0.1, 0\n"), "line 3: expected a name of its own")])
def test_a_recording_that_cannot_be_is_refused_by_its_file_and_field(spoil, said, tmp_path, capfd):
    spoil(recorded(tmp_path / "r"))
    assert main(["import", str(tmp_path / "r"), str(tmp_path / "out")]) == 2
    err = capfd.readouterr().err
    assert re.search(f"^hind4sight import: .*{said}", err, re.MULTILINE), err
    assert not list((tmp_path / "out").glob("*")), "a half data set"
