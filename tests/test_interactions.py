"""The record of a poke, shards on disk, the arena's cells."""
from dataclasses import asdict, replace

import numpy as np
import pytest
from tiny import SETTINGS, camera, tiny_pokes

from hind4sight_min.disk.files import load_npz, save_npz
from hind4sight_min.disk.shards import (DEPTH_UNIT, FORMAT, load_interactions, load_shard, save_shard, shards_in,
                                        stamp, stream_interactions)
from hind4sight_min.interactions import (PER_POKE, cell_centres, cells_of, finger_fits, grid_shape, occupied_grid,
                                         with_neighbours)


def pokes_with_holes(**how):
    data = tiny_pokes(**how)
    data.depth_before[0, 2, 3] = data.depth_after[1, 4, 4] = 0
    return data


# --- the record --------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("rows", [slice(1, 3), slice(None, None, -1), np.array([3, 0, 0]), [2], np.arange(7) % 2 == 0])
def test_indexing_takes_the_same_rows_of_everything(rows):
    data = tiny_pokes()
    part = data[rows]
    for name in PER_POKE:
        np.testing.assert_array_equal(getattr(part, name), getattr(data, name)[rows])
    assert part.camera is data.camera and part.meta is data.meta and len(part) == len(data.pokes[rows])


def test_a_single_row_is_no_selection():
    with pytest.raises(TypeError, match="rows: expected a slice or an index array"):
        tiny_pokes()[3]


@pytest.mark.parametrize("name, spoil, said", [
    *[(name, lambda a: a[..., :-1], "expected shape") for name in (*PER_POKE, "empty_depth")],
    *[(name, lambda a: a[:-1], "expected shape") for name in ("rgb_after", "depth_before", "starts")],
    ("rgb_after", lambda a: a.astype(float), "expected uint8"),
    ("depth_before", lambda a: (1e4 * a).astype(np.uint16), "floating-point"),
    ("pokes", lambda a: a.astype(complex), "floating-point"), ("rgb_before", lambda a: a.astype(int) - 61, "uint8"),
    *[(name, lambda a, bad=bad: np.where(np.arange(a.shape[-1]) == 0, np.float32(bad), a), "finite")
      for name in ("pokes", "starts", "depth_after", "empty_depth") for bad in (np.nan, np.inf)],
    *[("meta", lambda meta, bad=bad: {"settings": bad}, "settings with a positive")
      for bad in (None, {"arena": 0.5}, {"arena": -1, "cell": 0.1}, {"arena": float("inf"), "cell": 0.1},
                  {"arena": "0.5", "cell": 0.1}, {"arena": 0.5, "cell": None})]])
def test_a_record_refuses_other_shapes_types_and_values(name, spoil, said):
    with pytest.raises(ValueError, match=f"{name}: expected.*{said.removeprefix('expected ')}"):
        replace(tiny_pokes(), **{name: spoil(getattr(tiny_pokes(), name))})


# --- the grid -----------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("settings", [SETTINGS, {"arena": 0.6, "cell": 0.04}, {"arena": 0.3, "cell": 0.1}])
def test_cells_and_centres_are_inverse(settings):
    centres = cell_centres(settings)
    rows, columns = grid_shape(settings)
    assert len(centres) == rows * columns
    np.testing.assert_array_equal(cells_of(centres, settings), np.arange(rows * columns))
    inside = centres + np.random.default_rng(0).uniform(-0.49, 0.49, centres.shape) * settings["cell"]
    np.testing.assert_array_equal(cells_of(inside, settings), np.arange(rows * columns))


def test_cells_by_hand_and_outside_at_the_rim():
    # rows run along y, columns along x: (x, y) = (-0.24, -0.24) is the first cell, x one further the second
    np.testing.assert_array_equal(cells_of([[-0.24, -0.24], [-0.22, -0.24], [-0.24, -0.22], [0.24, 0.24]], SETTINGS),
                                  [0, 1, 20, 399], err_msg="x and y swapped?")
    np.testing.assert_array_equal(cells_of([[-9, -9], [9, -9], [-0.24, 9]], SETTINGS), [0, 19, 380])


def test_occupied_cells_their_neighbours_and_where_the_finger_fits_against_loops():
    rng = np.random.default_rng(1)
    clouds, occupied = rng.uniform(-0.25, 0.25, (3, 30, 3)), rng.random(30) < 0.5
    places = rng.uniform(-0.26, 0.26, (3, 200, 2))
    expected, near = np.zeros((2, 3, 20, 20), bool)
    for j, n in np.argwhere(np.tile(occupied, (3, 1))):
        column, row = (int((v + 0.25) / 0.025) for v in clouds[j, n, :2])
        expected[j, row, column] = True
        near[j, max(row - 1, 0):row + 2, max(column - 1, 0):column + 2] = True
    grid = occupied_grid(clouds, occupied, SETTINGS)
    np.testing.assert_array_equal(grid, expected)
    np.testing.assert_array_equal(with_neighbours(grid), near)
    fits = finger_fits(places, grid, SETTINGS)
    for j, n in np.ndindex(3, 200):
        free = np.abs(places[j, n]).max() < 0.24 and not near[j].ravel()[cells_of(places[j, n], SETTINGS)]
        assert fits[j, n] == free, "0.24: within the finger's radius of a wall"


# --- shards -------------------------------------------------------------------------------------------------------

def test_a_shard_comes_back_as_it_was(tmp_path):
    saved, path = pokes_with_holes(), tmp_path / "deep" / "shard_0000.npz"
    save_shard(path, saved)
    loaded = load_shard(path)
    for name in ("rgb_before", "rgb_after", "pokes", "starts"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(saved, name), strict=True)
    for name in ("depth_before", "depth_after", "empty_depth"):
        before, after = getattr(saved, name), getattr(loaded, name)
        assert after.dtype == np.float32 and np.abs(after.astype(float) - before).max() <= DEPTH_UNIT / 2 + 2e-7
        np.testing.assert_array_equal(after == 0, before == 0)
    for name, value in asdict(saved.camera).items():
        np.testing.assert_array_equal(getattr(loaded.camera, name), value)
    assert {name: loaded.meta[name] for name in saved.meta} == saved.meta and loaded.meta["format"] == FORMAT


def test_a_shard_holds_counts_of_a_tenth_of_a_millimetre_without_our_code(tmp_path):
    saved = pokes_with_holes()
    saved.depth_before[0, 0, :2] = 7.0, -0.1  # 70,000 counts; modulo 2^16 it would come back as 0.4464 m
    save_shard(tmp_path / "shard_0000.npz", saved)
    with np.load(tmp_path / "shard_0000.npz") as archive:
        counts = archive["depth_before"]
    assert counts.dtype == np.uint16 and counts[0, 0, :2].tolist() == [0, 0], "not missing"
    np.testing.assert_array_equal(counts[1:], np.rint(saved.depth_before[1:] * 1e4))


def rewrite(path, arrays={}, meta={}, without=()):
    """Change some arrays and some meta of a good shard, by hand."""
    old, old_meta = load_npz(path, FORMAT)
    merged = {name: value for name, value in {**old, **arrays}.items() if name not in without}
    save_npz(path, merged, {name: value for name, value in {**old_meta, **meta}.items() if name not in without})


@pytest.mark.parametrize("changes, said", [
    ({"meta": {"format": "hind4sight_min interactions 0"}}, "expected format"),
    ({"meta": {"camera": {**camera().plain, "fx": 0.0}}}, "camera: fx: expected a finite number > 0"),
    ({"arrays": {"starts": np.full((7, 2), np.nan, np.float32)}}, "starts: expected finite"),
    ({"arrays": {"labels": np.zeros(3)}}, "labels"),
    *[({"without": [name]}, name) for name in ("pokes", "empty_depth", "units", "camera", "settings")]])
def test_a_shard_with_wrong_contents_names_file_and_field(tmp_path, changes, said):
    path = tmp_path / "shard_0000.npz"
    save_shard(path, tiny_pokes())
    rewrite(path, **changes)
    with pytest.raises(ValueError, match=f"shard_0000.npz: .*{said}"):
        load_shard(path)


def test_a_data_set_is_its_shards_in_order_and_its_truth_is_never_opened(tmp_path):
    for index in (1, 0):
        save_shard(tmp_path / f"shard_{index:04d}.npz", tiny_pokes(count=3 + index, seed=index))
        (tmp_path / f"shard_{index:04d}.truth.npz").write_text("no truth at all")
    (tmp_path / "notes.txt").write_text("not a shard")
    assert [path.name for path in shards_in(tmp_path)] == ["shard_0000.npz", "shard_0001.npz"]
    joined = load_interactions(tmp_path)
    for name in PER_POKE:
        parts = [getattr(load_shard(path), name) for path in shards_in(tmp_path)]
        np.testing.assert_array_equal(getattr(joined, name), np.concatenate(parts))
    assert len(joined) == 7


def test_pokes_that_stay_on_disk_are_the_same_row_by_row(tmp_path):
    for index in (0, 1):
        save_shard(tmp_path / f"shard_{index:04d}.npz", tiny_pokes(count=3 + index, seed=index))
    whole, streamed = load_interactions(tmp_path), stream_interactions(tmp_path)
    assert len(streamed) == 7 and stamp(streamed) == stamp(whole)
    assert not isinstance(streamed.rgb_before, np.ndarray), "in memory after all"
    for rows in (np.array([6, 0, 3, 3]), np.array([-1, 2]), slice(1, 6, 2), np.arange(7) % 3 == 1, np.array([], int)):
        for name in PER_POKE:
            found, expected = getattr(streamed[rows], name), getattr(whole[rows], name)
            np.testing.assert_array_equal(found, expected, err_msg=f"{name} at {rows}", strict=True)
    np.testing.assert_array_equal(streamed.depth_after[-2], whole.depth_after[-2], strict=True)
    for rows in (7, np.array([0, 7])):
        with pytest.raises(IndexError):
            streamed.depth_after[rows]
    streamed.depth_after.file.close()
    with open("/dev/full", "wb", buffering=0) as streamed.depth_after.file:
        with pytest.raises(OSError, match="could not be written: No space left on device; TMPDIR"):
            streamed.depth_after.append(whole.depth_after)


@pytest.mark.parametrize("name, other", [
    ("camera", lambda data: tiny_pokes(cam=camera(x=0.01))),
    ("settings", lambda data: replace(data, meta={**data.meta, "settings": {**SETTINGS, "cell": 0.05}})),
    ("seed", lambda data: replace(data, meta={**data.meta, "seed": 8})),
    ("empty arena", lambda data: replace(data, empty_depth=data.empty_depth + np.float32(0.01)))])
def test_shards_of_two_data_sets_do_not_mix(tmp_path, name, other):
    for index, data in enumerate((tiny_pokes(), other(tiny_pokes()))):
        save_shard(tmp_path / f"shard_{index:04d}.npz", data)
    with pytest.raises(ValueError, match=f"shard_0001.npz: of another data set.*: its {name} differs"):
        load_interactions(tmp_path)


@pytest.mark.parametrize("folder, said", [("missing", "no shard_"), ("", "no shard_")])
def test_a_folder_without_shards(tmp_path, folder, said):
    with pytest.raises(ValueError, match=said):
        load_interactions(tmp_path / folder)
