"""The record of a poke: shards on disk and everything that can be wrong with them, true flow, cells, noises."""
import json
import os
import pickle
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chisquare

from hind4sight_min.geometry import Camera, look_at, unproject
from hind4sight_min.interactions import (DEPTH_UNIT, FORMAT, Interactions, Truth, add_depth_noise, associate_with_noise,
                                         cell_centres, cells_of, grid_shape, load_interactions, load_npz, load_shard,
                                         load_truth, occupied_pixels, points_and_validity, prominence,
                                         rotation_from_quaternion, save_npz, save_shard, shards_in, smooth_depth,
                                         true_scene_flow, truth_path, write_json)

WIDTH, HEIGHT = 8, 6
SETTINGS = {"arena": 0.5, "cell": 0.025}
PER_POKE = ("rgb_before", "rgb_after", "depth_before", "depth_after", "pokes", "starts")


def make_camera(**changed):
    values = dict(width=WIDTH, height=HEIGHT, fx=9.7, fy=9.3, cx=3.4, cy=2.6,
                  arena_from_camera=look_at((0.05, -0.46, 0.62), (0, 0, 0)))
    return Camera(**{**values, **changed})


def make_depth(rng, *shape):
    depth = rng.uniform(0.3, 1.2, shape).astype(np.float32)
    depth[rng.random(shape) < 0.1] = 0  # missing pixels
    return depth


def make_interactions(seed=0, count=3, camera=None, settings=SETTINGS):
    rng, camera = np.random.default_rng(seed), camera or make_camera()
    size = (camera.height, camera.width)
    return Interactions(
        rgb_before=rng.integers(0, 256, (count, *size, 3), np.uint8),
        rgb_after=rng.integers(0, 256, (count, *size, 3), np.uint8),
        depth_before=make_depth(rng, count, *size), depth_after=make_depth(rng, count, *size),
        pokes=rng.uniform(-0.2, 0.2, (count, 3)).astype(np.float32),
        starts=rng.uniform(-0.2, 0.2, (count, 2)).astype(np.float32),
        empty_depth=make_depth(np.random.default_rng(7), *size), camera=camera,
        meta={"seed": seed, "shard": 0, "settings": settings, "counts": {"kept": count, "left_arena": 2}})


def make_truth(seed=0, count=3):
    rng = np.random.default_rng([seed, 1])
    return Truth(rng.integers(0, 8, (count, HEIGHT, WIDTH), np.uint8),
                 rng.normal(size=(count, 7, 7)).astype(np.float32), rng.normal(size=(count, 7, 7)).astype(np.float32))


def write(folder, index=0, **changed):
    """A good shard and its truth in `folder` -> its path."""
    path = folder / f"shard_{index:04d}.npz"
    save_shard(path, make_interactions(seed=index, **changed), make_truth(index))
    return path


def rewrite(path, arrays={}, meta={}, without=()):
    """Change some arrays and some meta of a good shard, by hand."""
    old, old_meta = load_npz(path, FORMAT)
    merged = {name: value for name, value in {**old, **arrays}.items() if name not in without}
    save_npz(path, merged, {name: value for name, value in {**old_meta, **meta}.items() if name not in without})


def random_rotations(rng, count):
    return Rotation.from_quat(rng.normal(size=(count, 4)))  # SciPy normalises


def random_poses(rng):
    return np.concatenate([rng.uniform(-0.2, 0.2, (7, 3)), random_rotations(rng, 7).as_quat()], axis=1)


# --- round trip -------------------------------------------------------------------------------------------

def test_occupied_pixels_are_nearer_than_the_empty_arena_and_have_depth():
    empty = np.array([[0.7, 0.7, 0.7, 0.7, 0.7, 0.0]], np.float32)
    depth = np.array([[0.7, 0.693, 0.691, 0.75, 0.0, 0.6]], np.float32)
    assert occupied_pixels(depth, empty).tolist() == [[False, False, True, False, False, False]]
    assert occupied_pixels(depth, empty, threshold=0.005).tolist() == [[False, True, True, False, False, False]]


def test_prominence_against_a_loop_over_neighbours():
    rng = np.random.default_rng(31)
    empty = rng.uniform(0.6, 0.7, (6, 8)).astype(np.float32)
    depth = empty - rng.uniform(-0.01, 0.06, (2, 6, 8)).astype(np.float32)
    depth[0, 2, 3] = depth[1, 0, 0] = 0  # no depth: stands out for nobody
    found = prominence(depth, empty)
    assert found.shape == depth.shape and found.dtype == np.float32
    for b, v, u in np.ndindex(depth.shape):
        around = [empty[y, x] - depth[b, y, x] if depth[b, y, x] else 0.0
                  for y in range(max(v - 1, 0), min(v + 2, 6)) for x in range(max(u - 1, 0), min(u + 2, 8))]
        assert found[b, v, u] == pytest.approx(max(around), abs=1e-6)


def test_shard_round_trip(tmp_path):
    saved, truth = make_interactions(), make_truth()
    save_shard(tmp_path / "shard_0000.npz", saved, truth)
    loaded = load_shard(tmp_path / "shard_0000.npz")
    for name in ("rgb_before", "rgb_after", "pokes", "starts"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(saved, name), strict=True)
    for name in ("depth_before", "depth_after", "empty_depth"):
        before, after = getattr(saved, name), getattr(loaded, name)
        assert after.dtype == np.float32
        assert np.abs(after.astype(float) - before).max() <= DEPTH_UNIT / 2 + 2e-7  # float32 rounding on top
        np.testing.assert_array_equal(after == 0, before == 0)
        assert (before == 0).any() and (before > 0).any()
    assert {k: v for k, v in asdict(loaded.camera).items() if k != "arena_from_camera"} \
        == {k: v for k, v in asdict(saved.camera).items() if k != "arena_from_camera"}
    np.testing.assert_array_equal(loaded.camera.arena_from_camera, saved.camera.arena_from_camera, strict=True)
    assert {name: loaded.meta[name] for name in saved.meta} == saved.meta
    assert loaded.meta["format"] == FORMAT
    back = load_truth(tmp_path)
    for name in ("labels", "poses_before", "poses_after"):
        np.testing.assert_array_equal(getattr(back, name), getattr(truth, name), strict=True)


def test_a_shard_holds_what_its_documentation_says_without_our_code(tmp_path):
    saved = make_interactions()
    save_shard(tmp_path / "shard_0000.npz", saved, make_truth())
    with np.load(tmp_path / "shard_0000.npz") as archive:
        assert archive["depth_before"].dtype == np.uint16
        np.testing.assert_array_equal(archive["depth_before"], np.rint(saved.depth_before * 1e4))
        meta = json.loads(str(archive["meta"]))
    assert meta["units"]["depth"] == 1e-4
    assert meta["camera"]["arena_from_camera"] == saved.camera.arena_from_camera.tolist()


def test_depth_beyond_the_range_saturates_and_does_not_wrap_around(tmp_path):
    saved = make_interactions()
    saved.depth_before[0, 0, 0] = 7.0  # 70,000 counts; modulo 2^16 it would come back as 0.4464 m
    save_shard(tmp_path / "shard_0000.npz", saved, make_truth())
    assert load_shard(tmp_path / "shard_0000.npz").depth_before[0, 0, 0] == pytest.approx(6.5535)


def test_same_data_give_identical_bytes(tmp_path):
    paths = [write(tmp_path / name) for name in ("a", "b")]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert truth_path(paths[0]).read_bytes() == truth_path(paths[1]).read_bytes()
    assert paths[0].read_bytes() != write(tmp_path / "c", count=4).read_bytes()


def test_saving_what_was_loaded_gives_the_same_bytes(tmp_path):
    path = write(tmp_path / "a")
    save_shard(tmp_path / "b" / path.name, load_shard(path), load_truth(path.parent))
    assert (tmp_path / "b" / path.name).read_bytes() == path.read_bytes()


def test_save_makes_the_folder_and_leaves_two_files(tmp_path):
    path = write(tmp_path / "deep" / "folder")
    assert truth_path(path) == path.parent / "shard_0000.truth.npz"
    assert sorted(p.name for p in path.parent.iterdir()) == ["shard_0000.npz", "shard_0000.truth.npz"]


@pytest.mark.skipif(os.name == "nt", reason="permission bits mean something else there")
def test_files_are_as_readable_as_any_other_new_file(tmp_path):
    ordinary = tmp_path / "ordinary"
    ordinary.write_bytes(b"")
    path = write(tmp_path)
    assert path.stat().st_mode == ordinary.stat().st_mode


# --- whole or not at all ----------------------------------------------------------------------------------

def break_writing(monkeypatch, error, good_calls=0):
    """np.savez_compressed writes a few bytes and then fails, after `good_calls` that work."""
    calls, real = [], np.savez_compressed

    def broken(file, **arrays):
        calls.append(file)
        if len(calls) <= good_calls:
            return real(file, **arrays)
        file.write(b"PK half a file")
        file.flush()
        raise error

    monkeypatch.setattr(np, "savez_compressed", broken)


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()], ids=["disk full", "interrupted"])
def test_a_failed_write_leaves_no_file(tmp_path, monkeypatch, error):
    break_writing(monkeypatch, error)
    with pytest.raises(type(error)):
        write(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()], ids=["disk full", "interrupted"])
def test_a_failed_write_leaves_the_old_file_alone(tmp_path, monkeypatch, error):
    path = write(tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    break_writing(monkeypatch, error)
    with pytest.raises(type(error)):
        save_shard(path, make_interactions(seed=9), make_truth(9))
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_a_shard_never_exists_without_its_truth(tmp_path, monkeypatch):
    break_writing(monkeypatch, OSError("disk full"), good_calls=1)
    with pytest.raises(OSError, match="disk full"):
        write(tmp_path)
    with pytest.raises(ValueError, match="no shard"):
        shards_in(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["shard_0000.truth.npz"]


# --- damaged and foreign files ----------------------------------------------------------------------------

def assert_refused(path, *words):
    with pytest.raises(ValueError) as caught:
        load_shard(path)
    for word in (str(path), *words):
        assert word in str(caught.value)


@pytest.mark.parametrize("kept", [0, 1, 10, 0.3, 0.6, 0.9, -30, -1])
def test_truncated_shard(tmp_path, kept):
    path = write(tmp_path)
    raw = path.read_bytes()
    length = {float: lambda: int(kept * len(raw)), int: lambda: kept if kept >= 0 else len(raw) + kept}[type(kept)]()
    path.write_bytes(raw[:length])
    assert_refused(path)


def assert_loads_unchanged_or_refused(path, good):
    """A damaged byte that nothing depends on (a date, say) may pass; changed data may not."""
    try:
        loaded = load_shard(path)
    except ValueError as error:
        assert str(path) in str(error)
        return True
    for name in (*PER_POKE, "empty_depth"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(good, name))
    assert loaded.meta == good.meta
    return False


def test_flipped_regions_never_pass_as_data(tmp_path):
    path, rng = write(tmp_path), np.random.default_rng(0)
    raw, good, refused = path.read_bytes(), load_shard(path), 0
    for first in np.linspace(0, len(raw) - 900, 40).astype(int):  # the directory at the end has its own test
        damaged = bytearray(raw)
        damaged[first:first + 24] = rng.integers(0, 256, 24, np.uint8).tobytes()
        path.write_bytes(damaged)
        refused += assert_loads_unchanged_or_refused(path, good)
    assert refused > 30


def test_a_flipped_bit_anywhere_is_refused_or_harmless(tmp_path):
    path = write(tmp_path)
    raw, good = path.read_bytes(), load_shard(path)
    headers = {*range(60), *range(len(raw) - 700, len(raw))}  # where the archive's own fields are
    for position in sorted(headers | {*range(0, len(raw), 37)}):
        damaged = bytearray(raw)
        damaged[position] ^= 0x20 if position % 3 else 0x01
        path.write_bytes(damaged)
        assert_loads_unchanged_or_refused(path, good)


def test_flipped_truth_is_refused(tmp_path):
    path = truth_path(write(tmp_path))
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 0xff
    path.write_bytes(raw)
    with pytest.raises(ValueError, match="shard_0000.truth.npz"):
        load_truth(tmp_path)


def test_missing_file(tmp_path):
    assert_refused(tmp_path / "shard_0000.npz", "no such file")


@pytest.mark.parametrize("content", [b"", b"just some text\n" * 20, pickle.dumps({"pokes": [1, 2]})],
                         ids=["empty", "text", "pickle"])
def test_other_files_named_npz(tmp_path, content):
    path = tmp_path / "shard_0000.npz"
    path.write_bytes(content)
    assert_refused(path)


def test_a_single_array_named_npz(tmp_path):
    path = tmp_path / "shard_0000.npz"
    with open(path, "wb") as file:
        np.save(file, np.zeros(3))
    assert_refused(path)


class Trap:
    """Unpickling this would run code."""
    sprung = []

    def __reduce__(self):
        return Trap.sprung.append, (1,)


@pytest.mark.parametrize("name", ["meta", "pokes"])
def test_pickled_arrays_are_refused_and_not_run(tmp_path, name):
    path = write(tmp_path)
    arrays, meta = load_npz(path, FORMAT)
    content = {**arrays, "meta": np.array(json.dumps(meta)), name: np.array([Trap()], dtype=object)}
    np.savez_compressed(path, **content)
    assert_refused(path)
    assert Trap.sprung == []


@pytest.mark.parametrize("meta", [{"format": "hind4sight_min interactions 0"}, {"format": None}])
def test_another_format(tmp_path, meta):
    path = write(tmp_path)
    rewrite(path, meta=meta)
    assert_refused(path, FORMAT, repr(meta["format"]))


def test_a_checkpoint_is_not_a_shard(tmp_path):
    save_npz(tmp_path / "shard_0000.npz", {"weights": np.zeros(3)}, {"format": "something else"})
    assert_refused(tmp_path / "shard_0000.npz", FORMAT, "something else")


@pytest.mark.parametrize("meta", [[1, 2], 3, "text", None])
def test_meta_that_is_no_dict(tmp_path, meta):
    path = write(tmp_path)
    save_npz(path, load_npz(path, FORMAT)[0], meta)
    assert_refused(path)


@pytest.mark.parametrize("field, value", [("fx", float("nan")), ("cy", float("inf")), ("fy", 0.0), ("width", 0),
                                          ("arena_from_camera", np.zeros((4, 4)).tolist()),
                                          ("arena_from_camera", np.eye(3).tolist()), ("fx", "wide")])
def test_impossible_stored_camera(tmp_path, field, value):
    path = write(tmp_path)
    rewrite(path, meta={"camera": {**load_shard(path).meta["camera"], field: value}})
    assert_refused(path, "camera" if value != "wide" else "wide")


def test_stored_camera_of_another_size(tmp_path):
    path = write(tmp_path)
    rewrite(path, meta={"camera": {**load_shard(path).meta["camera"], "width": WIDTH + 1}})
    assert_refused(path, "rgb_before", str((3, HEIGHT, WIDTH + 1, 3)))


@pytest.mark.parametrize("name", [*PER_POKE, "empty_depth"])
def test_wrong_array_shape_names_file_and_field(tmp_path, name):
    path = write(tmp_path)
    array = load_npz(path, FORMAT)[0][name]
    rewrite(path, arrays={name: array[..., :-1]})
    assert_refused(path, name + ":", str(array.shape[:-1] + (array.shape[-1] - 1,)))


@pytest.mark.parametrize("name", ["rgb_after", "depth_before", "starts"])
def test_wrong_number_of_rows_names_file_and_field(tmp_path, name):
    path = write(tmp_path)
    rewrite(path, arrays={name: load_npz(path, FORMAT)[0][name][:2]})
    assert_refused(path, name + ":")


@pytest.mark.parametrize("name", ["pokes", "starts"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_and_infinity_name_file_and_field(tmp_path, name, bad):
    path = write(tmp_path)
    array = load_npz(path, FORMAT)[0][name]
    array[1, 1] = bad
    rewrite(path, arrays={name: array})
    assert_refused(path, name + ":")


@pytest.mark.parametrize("name", ["pokes", "empty_depth", "camera", "units"])
def test_missing_field_is_named(tmp_path, name):
    path = write(tmp_path)
    rewrite(path, without=(name,))
    assert_refused(path, name)


def test_missing_settings(tmp_path):
    path = write(tmp_path)
    rewrite(path, without=("settings",))
    with pytest.raises(ValueError, match="shard_0000.npz.*settings"):
        load_interactions(tmp_path)


@pytest.mark.parametrize("settings", [[], None, 3, {"arena": 0.5}, {"arena": "wide", "cell": 0.1},
                                      {"arena": 0.5, "cell": -0.1}, {"arena": float("nan"), "cell": 0.1}], ids=str)
def test_settings_without_a_grid(tmp_path, settings):
    path = write(tmp_path)
    rewrite(path, meta={"settings": settings})
    assert_refused(path)


def test_unknown_array_is_named(tmp_path):
    path = write(tmp_path)
    rewrite(path, arrays={"forces": np.zeros(3)})
    assert_refused(path, "forces")


# --- folders ----------------------------------------------------------------------------------------------

def test_a_text_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "figures.json"
    write_json(path, {"a": 1})
    old = path.read_bytes()

    def full_disk(self, text):
        self.write_bytes(b"{")
        raise OSError("disk full")
    monkeypatch.setattr(Path, "write_text", full_disk)
    with pytest.raises(OSError, match="disk full"):
        write_json(path, {"a": 2})
    assert path.read_bytes() == old and [each.name for each in tmp_path.iterdir()] == ["figures.json"]


def test_shards_in_sorts_and_ignores_other_files(tmp_path):
    for index in (10, 2, 0):
        write(tmp_path, index)
    (tmp_path / "notes.txt").write_text("not a shard")
    (tmp_path / "checkpoint.npz").write_bytes(b"")
    assert [p.name for p in shards_in(tmp_path)] == ["shard_0000.npz", "shard_0002.npz", "shard_0010.npz"]
    assert shards_in(str(tmp_path)) == shards_in(tmp_path)


def test_shards_in_empty_and_missing_folder(tmp_path):
    with pytest.raises(ValueError, match="no shard") as caught:
        shards_in(tmp_path)
    assert str(tmp_path) in str(caught.value)
    save_npz(tmp_path / "shard_0000.truth.npz", {}, {"format": FORMAT})  # a truth file alone is no shard
    with pytest.raises(ValueError, match="no shard"):
        load_interactions(tmp_path)
    with pytest.raises(ValueError, match="no such folder") as caught:
        load_interactions(tmp_path / "nowhere")
    assert "nowhere" in str(caught.value)


def test_load_interactions_joins_in_order(tmp_path):
    for index in (11, 1, 0):
        write(tmp_path, index, count=3)
    joined, truth = load_interactions(tmp_path), load_truth(tmp_path)
    assert len(joined) == 9
    for position, index in enumerate((0, 1, 11)):
        rows = slice(3 * position, 3 * position + 3)
        np.testing.assert_array_equal(joined.pokes[rows], make_interactions(index).pokes)
        np.testing.assert_array_equal(joined.rgb_after[rows], make_interactions(index).rgb_after)
        np.testing.assert_array_equal(truth.labels[rows], make_truth(index).labels)
        np.testing.assert_array_equal(truth.poses_after[rows], make_truth(index).poses_after)


@pytest.mark.parametrize("changed", [dict(camera=make_camera(fx=9.8)),
                                     dict(camera=make_camera(arena_from_camera=look_at((0, -0.46, 0.62), (0, 0, 0)))),
                                     dict(settings={"arena": 0.5, "cell": 0.05}),
                                     dict(settings={"arena": 0.4, "cell": 0.02})],
                         ids=["fx", "pose", "grid", "arena"])
def test_load_interactions_refuses_a_mixture(tmp_path, changed):
    write(tmp_path, 0)
    write(tmp_path, 1, **changed)
    with pytest.raises(ValueError, match="shard_0001.npz"):
        load_interactions(tmp_path)


def test_load_interactions_refuses_shards_of_two_empty_arenas(tmp_path):
    write(tmp_path, 0)
    path = write(tmp_path, 1)
    rewrite(path, {"empty_depth": load_npz(path, FORMAT)[0]["empty_depth"] + np.uint16(500)})
    with pytest.raises(ValueError, match="shard_0001.npz: another"):
        load_interactions(tmp_path)


def test_load_interactions_never_opens_the_truth(tmp_path):
    paths = [write(tmp_path, index) for index in (0, 1)]
    before = load_interactions(tmp_path)
    truth_path(paths[0]).unlink()
    truth_path(paths[1]).write_bytes(b"nonsense")
    after = load_interactions(tmp_path)
    for name in PER_POKE:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    with pytest.raises(ValueError, match="shard_0000.truth.npz: no such file"):
        load_truth(tmp_path)


@pytest.mark.parametrize("name", ["labels", "poses_before", "poses_after"])
def test_truth_without_an_array_names_the_file(tmp_path, name):
    path = truth_path(write(tmp_path))
    rewrite(path, without=(name,))
    with pytest.raises(ValueError, match="shard_0000.truth.npz"):
        load_truth(tmp_path)


def test_truth_of_another_length_names_the_file(tmp_path):
    path = truth_path(write(tmp_path))
    rewrite(path, arrays={"labels": make_truth().labels[:2]})  # would shift every later shard's labels
    with pytest.raises(ValueError, match="shard_0000.truth.npz"):
        load_truth(tmp_path)


# --- Interactions -----------------------------------------------------------------------------------------

@pytest.mark.parametrize("rows", [slice(1, 3), slice(None, None, -1), np.array([3, 0, 0]), [2],
                                  np.array([True, False, False, True]), slice(0, 0)], ids=str)
def test_indexing(rows):
    whole = make_interactions(count=4)
    part = whole[rows]
    expected = np.arange(4)[rows]
    assert isinstance(part, Interactions) and len(part) == len(expected)
    for name in PER_POKE:
        np.testing.assert_array_equal(getattr(part, name), [getattr(whole, name)[i] for i in expected]
                                      if len(expected) else getattr(whole, name)[:0])
    np.testing.assert_array_equal(part.empty_depth, whole.empty_depth)
    assert part.camera is whole.camera and part.meta == whole.meta
    truth = make_truth(count=4)
    for name in ("labels", "poses_before", "poses_after"):
        np.testing.assert_array_equal(getattr(truth[rows], name), getattr(truth, name)[expected])


def test_interactions_check_their_arrays():
    good = make_interactions()
    depth = good.depth_after.copy()
    depth[2, 1, 1] = np.nan
    with pytest.raises(ValueError, match="depth_after: .*NaN"):
        replace(good, depth_after=depth)
    with pytest.raises(ValueError, match=r"pokes: expected shape \(3, 3\), got \(3, 2\)"):
        replace(good, pokes=good.pokes[:, :2])
    with pytest.raises(ValueError, match="empty_depth"):
        replace(good, empty_depth=good.empty_depth.T)


@pytest.mark.parametrize("name, dtype", [("rgb_after", float), ("depth_before", np.uint16), ("pokes", int)])
def test_interactions_refuse_other_types(name, dtype):
    good = make_interactions()
    with pytest.raises(ValueError, match=f"{name}: expected .*, got {np.dtype(dtype)}"):
        replace(good, **{name: getattr(good, name).astype(dtype)})


def test_a_single_row_is_no_selection():
    with pytest.raises(TypeError, match="rows"):
        make_interactions()[0]


def test_grid_shape_comes_from_the_settings():
    assert make_interactions(settings={"arena": 0.6, "cell": 0.04}).grid_shape == (15, 15)
    assert grid_shape({"arena": 0.3, "cell": 0.1}) == (3, 3)  # 0.3 / 0.1 is 2.9999999999999996


def test_points_and_validity():
    camera, depth = make_camera(), make_interactions().depth_before
    points, valid = points_and_validity(depth, camera)
    np.testing.assert_array_equal(points, unproject(depth, camera))
    np.testing.assert_array_equal(valid, depth != 0)
    assert not valid.all()


# --- scene flow -------------------------------------------------------------------------------------------

def test_rotation_from_quaternion_against_scipy():
    rotations = random_rotations(np.random.default_rng(0), 60)
    quaternions = rotations.as_quat()  # (x, y, z, w)
    matrices = rotation_from_quaternion(quaternions.reshape(3, 20, 4))
    np.testing.assert_allclose(matrices.reshape(60, 3, 3), rotations.as_matrix(), atol=1e-13)
    np.testing.assert_allclose(rotation_from_quaternion(-quaternions[0]), matrices[0, 0], atol=1e-15)  # same rotation
    np.testing.assert_array_equal(rotation_from_quaternion([0, 0, 0, 1]), np.eye(3))


def test_quarter_turn_about_z():
    half = np.sqrt(0.5)
    np.testing.assert_allclose(rotation_from_quaternion([0, 0, half, half]) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_true_scene_flow_against_scipy():
    rng = np.random.default_rng(1)
    points, labels = rng.uniform(-0.2, 0.2, (9, 11, 3)), rng.integers(0, 5, (9, 11), np.uint8)
    before, after = random_poses(rng), random_poses(rng)
    expected = np.zeros_like(points)
    for v in range(9):
        for u in range(11):
            if labels[v, u]:
                i = labels[v, u] - 1
                motion = Rotation.from_quat(after[i, 3:]) * Rotation.from_quat(before[i, 3:]).inv()
                expected[v, u] = motion.apply(points[v, u] - before[i, :3]) + after[i, :3] - points[v, u]
    flow = true_scene_flow(points, labels, before, after)
    assert flow.dtype == np.float32 and flow.shape == points.shape
    np.testing.assert_allclose(flow, expected, atol=1e-7)
    assert (flow[labels == 0] == 0).all() and (np.abs(flow[labels > 0]).max(axis=-1) > 0.01).all()


def test_true_scene_flow_by_hand():
    points = np.array([[[0.1, 0.0, 0.05], [0.1, 0.1, 0.05], [0.3, 0.2, 0.0]]], np.float32)
    labels = np.array([[1, 2, 0]], np.uint8)
    before, after = np.zeros((7, 7), np.float32), np.zeros((7, 7), np.float32)
    before[:2, 6] = after[:2, 6] = 1
    before[0, :3], after[0, :3] = [0.1, 0, 0.02], [0.13, -0.01, 0.02]  # object 1 slides
    before[1, :3] = after[1, :3] = [0.1, 0, 0.02]  # object 2 turns by 90 degrees about its own position
    after[1, 3:] = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    flow = true_scene_flow(points, labels, before, after)
    np.testing.assert_allclose(flow, [[[0.03, -0.01, 0], [-0.1, -0.1, 0], [0, 0, 0]]], atol=1e-7)


def test_true_scene_flow_is_zero_where_nothing_moved():
    rng = np.random.default_rng(2)
    points, labels, poses = rng.uniform(-0.2, 0.2, (4, 5, 3)), rng.integers(0, 8, (4, 5)), random_poses(rng)
    np.testing.assert_allclose(true_scene_flow(points, labels, poses, poses), 0, atol=1e-7)
    np.testing.assert_array_equal(true_scene_flow(points, 0 * labels, poses, random_poses(rng)), 0)


# --- the grid of cells ------------------------------------------------------------------------------------

@pytest.mark.parametrize("settings", [SETTINGS, {"arena": 0.6, "cell": 0.04}, {"arena": 0.3, "cell": 0.1}])
def test_cells_and_centres_are_inverse(settings):
    centres = cell_centres(settings)
    rows, columns = grid_shape(settings)
    assert centres.shape == (rows * columns, 2)
    np.testing.assert_array_equal(cells_of(centres, settings), np.arange(rows * columns))
    np.testing.assert_allclose(centres.mean(axis=0), 0, atol=1e-12)  # the grid lies in the middle of the arena
    inside = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 50, 2)) * settings["arena"]
    cells = cells_of(inside, settings)
    assert cells.shape == (40, 50) and np.issubdtype(cells.dtype, np.integer)
    assert np.abs(centres[cells] - inside).max() <= settings["cell"] / 2 + 1e-12


def test_cells_by_hand():
    assert cells_of([-0.24, -0.24], SETTINGS) == 0
    assert cells_of([0.24, -0.24], SETTINGS) == 19  # columns run along x
    assert cells_of([-0.24, 0.24], SETTINGS) == 380  # rows run along y
    assert cells_of([0.001, 0.001], SETTINGS) == 210


def test_positions_outside_are_clipped_to_the_rim():
    outside = np.array([[-9, -9], [9, -9], [-9, 9], [9, 9], [0.25, 0.001], [0.001, -0.2501]])
    np.testing.assert_array_equal(cells_of(outside, SETTINGS), [0, 19, 380, 399, 10 * 20 + 19, 10])


# --- depth noise ------------------------------------------------------------------------------------------

def two_levels():
    """Depth with its median at 0.5 m, a quarter of the valid pixels at 1 m, and more than half of them missing."""
    depth = np.full((200, 200), 0.5, np.float32)
    depth[:50], depth[190:], depth[:, ::2] = 1.0, 0, 0
    return depth


def test_depth_noise_statistics():
    depth = two_levels()
    noise = add_depth_noise(depth, np.random.default_rng(0)).astype(float) - depth
    for level, expected in ((0.5, 0.01), (1.0, 0.02)):  # 1 cm at the median, proportional to depth
        here = noise[depth == level]
        assert here.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * here.size))  # four standard errors
        assert abs(here.mean()) < 4 * expected / np.sqrt(here.size)
        assert np.mean(np.abs(here) > 1.96 * expected) == pytest.approx(0.05, abs=0.01)  # Gaussian tails
    relative = noise[:190, 1::2] / depth[:190, 1::2]  # what is not missing
    assert abs(np.corrcoef(relative[:, 1:].ravel(), relative[:, :-1].ravel())[0, 1]) < 0.03  # neighbours independent


def test_depth_noise_scales_with_its_argument():
    depth = two_levels()
    small, large = (add_depth_noise(depth.astype(float), np.random.default_rng(1), sd) - depth for sd in (0.002, 0.008))
    np.testing.assert_allclose(large, 4 * small, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(add_depth_noise(depth, np.random.default_rng(1), 0.0), depth)


def test_depth_noise_keeps_missing_pixels_shape_dtype_and_input():
    depth = two_levels()
    before = depth.copy()
    noisy = add_depth_noise(depth, np.random.default_rng(0))
    assert noisy.dtype == np.float32 and noisy.shape == depth.shape
    np.testing.assert_array_equal(noisy == 0, depth == 0)
    np.testing.assert_array_equal(depth, before)
    wild = add_depth_noise(depth, np.random.default_rng(0), 2.0)  # never a negative depth, never a new missing pixel
    np.testing.assert_array_equal(wild > 0, depth > 0)


def test_depth_noise_of_an_empty_picture():
    nothing = np.zeros((3, 4), np.float32)
    noisy = add_depth_noise(nothing, np.random.default_rng(0))
    np.testing.assert_array_equal(noisy, nothing)
    assert not np.shares_memory(noisy, nothing)


def test_depth_noise_depends_on_the_seed_only():
    depth = two_levels()
    first, again, other = (add_depth_noise(depth, np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other)[depth > 0].mean() > 0.9


def test_depth_noise_of_many_pictures_takes_each_pictures_own_median():
    near, far = np.full((60, 60), 0.5), np.full((60, 60), 1.0)
    noise = add_depth_noise(np.stack([near, far, far]), np.random.default_rng(0)) - np.stack([near, far, far])
    assert noise[0].std() == pytest.approx(0.01, rel=0.06)
    assert noise[1].std() == pytest.approx(0.01, rel=0.06)


@pytest.mark.parametrize("bad", [-0.01, float("nan"), -np.inf])
def test_depth_noise_refuses_bad_deviations(bad):
    with pytest.raises(ValueError, match="standard_deviation"):
        add_depth_noise(two_levels(), np.random.default_rng(0), bad)


# --- association noise ------------------------------------------------------------------------------------

def shifts(indices):
    height, width = indices.shape
    v, u = np.mgrid[:height, :width]
    return indices // width - v, indices % width - u


def test_association_with_window_one_is_the_identity():
    depth = make_depth(np.random.default_rng(0), 7, 9)
    np.testing.assert_array_equal(associate_with_noise(depth, np.random.default_rng(1), 1), np.arange(63).reshape(7, 9))


@pytest.mark.parametrize("window", [3, 5, 9])
def test_association_is_uniform_over_the_window_and_stays_inside(window):
    depth = np.full((60, 70), 0.7, np.float32)
    indices = associate_with_noise(depth, np.random.default_rng(2), window)
    assert np.issubdtype(indices.dtype, np.integer) and indices.min() >= 0 and indices.max() < depth.size
    half = window // 2
    down, right = (shift[half:-half, half:-half] for shift in shifts(indices))
    assert np.abs(down).max() == np.abs(right).max() == half
    counts = np.bincount(((down + half) * window + right + half).ravel(), minlength=window ** 2)
    assert chisquare(counts).pvalue > 1e-3


def test_association_at_the_border_keeps_the_pixel_itself():
    drawn = np.stack([associate_with_noise(np.ones((4, 6)), np.random.default_rng(seed), 3) for seed in range(400)])
    # A pixel keeps itself when its draw is itself or falls outside: 6 of 9 in a corner, 4 of 9 at an edge.
    for (v, u), neighbours, kept in (((0, 0), {0, 1, 6, 7}, 6 / 9), ((3, 5), {16, 17, 22, 23}, 6 / 9),
                                     ((0, 2), {1, 2, 3, 7, 8, 9}, 4 / 9), ((2, 0), {6, 7, 12, 13, 18, 19}, 4 / 9)):
        assert set(drawn[:, v, u]) == neighbours
        assert np.mean(drawn[:, v, u] == 6 * v + u) == pytest.approx(kept, abs=0.1)  # four standard errors


def test_association_respects_the_depth_gate():
    depth = np.full((40, 40), 0.5)
    depth[:, 10:20], depth[:, 20:30], depth[:, 30:] = 0.5625, 0.6875, 0.5  # steps of 6.25, 12.5 and 18.75 cm
    for seed in range(5):
        chosen = depth.ravel()[associate_with_noise(depth, np.random.default_rng(seed), 7)]
        assert np.abs(chosen - depth).max() == 0.0625  # the small step is crossed, the big ones are not
    wide = depth.ravel()[associate_with_noise(depth, np.random.default_rng(0), 7, threshold=0.125)]
    assert np.abs(wide - depth).max() == 0.125  # "at most": exactly the threshold still counts


def test_association_respects_missing_depth():
    rng = np.random.default_rng(3)
    depth = rng.uniform(0.02, 0.06, (40, 50))  # so near that missing (0) passes the depth gate
    depth[rng.random(depth.shape) < 0.3] = 0
    indices, own = associate_with_noise(depth, rng, 5), np.arange(depth.size).reshape(depth.shape)
    missing = depth == 0
    np.testing.assert_array_equal(indices[missing], own[missing])
    assert (depth.ravel()[indices[~missing]] > 0).all()
    assert (indices != own)[~missing].mean() > 0.5


def test_association_depends_on_the_seed_only():
    depth = make_depth(np.random.default_rng(0), 30, 40)
    first, again, other = (associate_with_noise(depth, np.random.default_rng(seed), 5) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize("window", [0, 2, 8, -3])
def test_association_refuses_even_and_empty_windows(window):
    with pytest.raises(ValueError, match=f"window.*{window}"):
        associate_with_noise(np.ones((4, 5)), np.random.default_rng(0), window)


def test_smooth_depth_against_the_sum_by_hand():
    rng = np.random.default_rng(2)
    empty = np.float32(0.8) + np.linspace(0, 0.2, 12 * 16, dtype=np.float32).reshape(12, 16)
    depth = empty - 0.04 * (rng.random((2, 12, 16)) < 0.3) + rng.normal(0, 0.01, (2, 12, 16))
    depth[0, 4, 6] = 0  # missing
    images = rng.integers(0, 90, (2, 12, 16, 3)).astype(np.uint8)
    difference = np.where(depth > 0, depth - empty, 0)
    v, u = np.mgrid[:12, :16]

    def weighted(values, weights):
        return (weights * values).sum() / weights.sum()

    guess = np.empty_like(difference)  # a bilateral filter; its neighbourhood is a disc, the picture goes on mirrored
    for i in range(2):
        padded = np.pad(difference[i], 2, mode="reflect")
        for row, column in np.ndindex(12, 16):
            patch, (dv, du) = padded[row:row + 5, column:column + 5], np.mgrid[-2:3, -2:3]
            weights = np.exp(-(dv ** 2 + du ** 2) / (2 * 1.5 ** 2)
                             - (patch - difference[i, row, column]) ** 2 / (2 * 0.025 ** 2))
            guess[i, row, column] = weighted(patch, weights * (dv ** 2 + du ** 2 <= 4))
    found = smooth_depth(depth, empty, images)
    assert found.dtype == depth.dtype and found[0, 4, 6] == 0
    for i, row, column in ((0, 4, 5), (1, 7, 9), (1, 11, 0), (0, 0, 14)):
        dv, du = v - row, u - column
        colour = ((images[i] / 255.0 - images[i, row, column] / 255.0) ** 2).sum(axis=2)
        weights = np.exp(-(dv ** 2 + du ** 2) / (2 * 3.0 ** 2) - colour / (2 * 0.15 ** 2)
                         - (guess[i] - guess[i, row, column]) ** 2 / (2 * 0.02 ** 2))
        weights *= (np.maximum(abs(dv), abs(du)) <= 3) & (depth[i] > 0)
        expected = empty[row, column] + weighted(difference[i], weights)
        assert abs(found[i, row, column] - expected) < 2e-5 < 1e-3 < abs(found[i, row, column] - depth[i, row, column])


def test_smooth_depth_takes_noise_keeps_edges_missing_pixels_and_dtype():
    rng = np.random.default_rng(3)
    empty = np.full((2, 48, 64), 0.9, np.float32)
    clean, images = empty.copy(), np.full((2, 48, 64, 3), 140, np.uint8)
    clean[:, 20:30, 20:30] -= 0.06
    images[:, 20:30, 20:30] = (200, 30, 30)
    noisy = add_depth_noise(clean, rng, 0.01)
    noisy[0, 5, 5] = 0
    smooth = smooth_depth(noisy, empty, images)
    assert smooth.dtype == np.float32 and smooth[0, 5, 5] == 0 and (smooth > 0).sum() == smooth.size - 1
    rest = noisy > 0
    assert (smooth - clean)[rest].std() < 0.25 * (noisy - clean)[rest].std()
    edge = np.s_[:, 22:28, 20]  # the object's side columns do not flow out onto the table
    assert np.abs(smooth[edge] - clean[edge]).mean() < 0.006


def test_smooth_depth_without_noise_changes_little():
    empty = np.full((24, 32), 0.9, np.float32)
    images = np.full((24, 32, 3), 140, np.uint8)
    np.testing.assert_allclose(smooth_depth(empty, empty, images), empty, atol=1e-7)
    depth = empty.copy()
    depth[8:16, 8:16] -= 0.06
    images[8:16, 8:16] = (200, 30, 30)
    np.testing.assert_allclose(smooth_depth(depth, empty, images), depth, atol=1e-3)
