"""Nothing fails silently: every kind of mistake ends in the right result or in one line that names what is wrong."""
import os
import re
import resource
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from tiny import SETTINGS, TINY, random_run, still_truth, tiny_pokes

from hind4sight_min import losses
from hind4sight_min.disk import checkpoints, files
from hind4sight_min.disk.shards import load_interactions, save_shard, stamp
from hind4sight_min.lab.cli import main
from hind4sight_min.lab.processes import parallel_map
from hind4sight_min.lab.runs import train_saving
from hind4sight_min.sim import arena
from hind4sight_min.sim.truth import load_truth, save_truth, truth_path
from hind4sight_min.training import Recipe, start_run, training_step

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))
import mutations  # noqa: E402


def run(*arguments):
    try:
        return main([str(each) for each in arguments])
    except SystemExit as refused:  # argparse's way
        return refused.code


def dead_process():
    """The number of a process that has ended."""
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


# --- files that could not be written ------------------------------------------------------------------------------

def full(*_, **__):
    raise OSError(28, "No space left on device")


def test_a_file_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(files.np, "savez_compressed", full)
    with pytest.raises(OSError, match=r"model\.npz: could not be written: No space left on device"):
        files.save_npz(tmp_path / "model.npz", {}, {})
    assert not list(tmp_path.iterdir())


def test_an_export_that_fails_leaves_no_picture_and_the_folder_free(tmp_path, capsys):
    data_set(tmp_path / "data", count=2)
    (tmp_path / "data" / "shard_0001.npz").write_text("damaged")
    assert run("export", tmp_path / "data", tmp_path / "out") == 2
    assert re.search(r"shard_0001.npz: damaged .*\(no .npz file\)", capsys.readouterr().err)
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize("arguments, said", [
    ("collect mine", "mine: expected a folder, or a place for one"), ("import r mine/out", "mine: expected a folder"),
    ("plan run.npz --out mine", "--out: mine is no folder"), ("plan run.npz --scale 2", "--scale: expected --urdf"),
    ("evaluate run.npz none", "shard_0000.npz: expected a poke at least, got none"),
    ("show run.npz none", "shard_0000.npz: expected a poke at least, got none"),
    ("collect |", "out: expected something, got an empty text"),
    ("explore --mine |", "mine: expected something, got an empty text")])
def test_a_place_that_is_no_folder_or_empty_is_named(arguments, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").write_text("mine")
    save_shard(tmp_path / "none" / "shard_0000.npz", tiny_pokes(2)[:0])
    checkpoints.save_run("run.npz", random_run())
    assert run(*arguments.replace("|", "").split(" ")) == 2
    assert re.search(said, capsys.readouterr().err)
    assert (tmp_path / "mine").read_text() == "mine"


# --- numbers that are none of their kind --------------------------------------------------------------------------

@pytest.mark.parametrize("make, said", [
    (lambda: Recipe(steps=True), "steps"), (lambda: Recipe(seed=np.bool_(1)), "seed"),
    (lambda: replace(TINY.sizes, width=1_000_000), "width: .*<= 512"),
    (lambda: replace(TINY.sizes, rounds=100), "rounds: .*<= 8")])
def test_what_is_no_whole_number_within_reason_is_refused(make, said):
    with pytest.raises(ValueError, match=f"{said}"):
        make()


def test_numpy_scalars_in_a_recipe_are_saved(tmp_path):
    given = replace(TINY, steps=np.int64(6), learning_rate=np.float32(0.25), weights={"chamfer": np.float64(2)})
    checkpoints.save_run(tmp_path / "run.npz", random_run(given))
    assert checkpoints.load_run(tmp_path / "run.npz").recipe == given


# --- checkpoints from others --------------------------------------------------------------------------------------

def with_header(path, **changes):
    """Rewrite a checkpoint's header: recipe, step and so on."""
    arrays, meta = files.load_npz(path, checkpoints.FORMAT)
    files.save_npz(path, arrays, {**meta, **changes})


def claiming(path, size):
    """Put a member into a checkpoint that claims `size` bytes and has none."""
    with zipfile.ZipFile(path, "a") as archive:
        with archive.open("more.npy", "w") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (size // 4,)})


def growing(path):
    """Put 250 MB of zeros into a checkpoint, a quarter of one when packed."""
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("more.npy", "w", force_zip64=True) as file:
            file.write(b"\x93NUMPY")
            file.write(bytes(250_000_000))


@pytest.mark.parametrize("spoil, said", [
    (lambda path: with_header(path, step="x"), "step: expected a whole number >= 0, got x"),
    (lambda path: with_header(path, recipe={**asdict(TINY), "sizes": {**asdict(TINY.sizes), "head": 10 ** 6}}),
     "head: expected .* <= 512"),
    (lambda path: with_header(path, run={"log": "x"}), "log: expected a list"),
    (lambda path: with_header(path, run=None), "NoneType"),
    (lambda path: claiming(path, 50 * 10 ** 9), "more.npy is of another size"),
    (growing, "unpacks to 25. MB")], ids=["step", "layer", "log", "run", "claim", "bomb"])
def test_a_checkpoint_from_others_is_refused_at_once_and_in_little_memory(spoil, said, tmp_path):
    path = tmp_path / "run.npz"
    checkpoints.save_run(path, random_run())
    spoil(path)
    began, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=f"run.npz: .*{said}"):
        checkpoints.load_run(path)
    assert time.process_time() - began < 2
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000, "kB: unpacked before it was judged"


# --- two at once, and what dead ones left -------------------------------------------------------------------------

def test_a_second_process_at_the_same_results_is_refused_and_the_dead_are_cleared_away(tmp_path):
    path, lock = tmp_path / "run.npz", tmp_path / ".run.npz.lock"
    with files.only_one(path):
        assert str(os.getpid()) in lock.read_text()
        with pytest.raises(ValueError, match="run.npz: process .* is at work there; .* remove .*run.npz.lock"):
            with files.only_one(path):
                pass
        assert lock.exists(), "the one refused took the lock away"
    alive = files.this_process()
    dead, elsewhere = alive.replace(str(os.getpid()), str(dead_process())), f"{dead_process()}@another.machine"
    lock.write_text(dead)
    kept = {f".{alive}.run.npz", f".{elsewhere}.run.npz", f".{dead}.other.npz"}
    for name in (f".{dead}.run.npz", f".{dead}.run.csv", *kept):
        (tmp_path / name).write_text("half")
    with files.only_one(path):
        assert {each.name for each in tmp_path.iterdir()} == {".run.npz.lock", *kept}
    assert not lock.exists()
    lock.write_text(elsewhere)
    with pytest.raises(ValueError, match=f"process {elsewhere} is at work there"):
        with files.only_one(path):
            pass


def test_two_data_sets_do_not_mix_in_one_folder_even_at_once(tmp_path):
    path = tmp_path / "collection.json"
    files.claim(path, {"seed": 1, "sizes": (2, 3)})
    files.claim(path, {"seed": 1, "sizes": (2, 3)})
    with pytest.raises(ValueError, match="collection.json: seed: expected what is there, 1, got 2"):
        files.claim(path, {"seed": 2, "sizes": (2, 3)})
    assert [each.name for each in tmp_path.iterdir()] == ["collection.json"], "a half-written file stayed"
    path.write_text("{")
    with pytest.raises(ValueError, match="collection.json: damaged"):
        files.claim(path, {"seed": 1})


# --- going on with something else ---------------------------------------------------------------------------------

def data_set(folder, seed=0, count=7):
    """A data set of one shard with its truth, as collection writes it."""
    data = tiny_pokes(count, seed)
    data.meta = {**data.meta, "seed": seed}
    truth = still_truth(np.zeros(data.depth_before.shape, int))
    save_truth(folder / "shard_0000.npz", truth, data)
    save_shard(folder / "shard_0000.npz", data)
    return data


@pytest.mark.parametrize("other, said", [
    ({"seed": 1}, "of seed 0, got 1"), ({"count": 6}, "of pokes 7, got 6"), ({"touch": True}, "of checksum")])
def test_a_run_goes_on_with_the_data_it_began_with_alone(other, said, tmp_path):
    touch = other.pop("touch", False)
    data_set(tmp_path / "a")
    run = start_run(replace(TINY, steps=1), load_interactions(tmp_path / "a"))
    train_saving(load_interactions(tmp_path / "a"), run, tmp_path / "run.npz")
    data_set(tmp_path / "b", **other)
    again = load_interactions(tmp_path / "b")
    again.pokes[3, 0] += 1e-6 * touch
    with pytest.raises(ValueError, match=f"run.npz: expected the data it was made with, {said}"):
        train_saving(again, checkpoints.load_run(tmp_path / "run.npz"), tmp_path / "run.npz")
    train_saving(tiny_pokes(), replace(run, meta={**run.meta, "data": None}), tmp_path / "old.npz")  # not known


def test_a_data_set_has_the_same_stamp_in_memory_and_on_disk(tmp_path):
    made = data_set(tmp_path)
    assert stamp(made) == stamp(load_interactions(tmp_path)) == stamp(made[:])


def test_the_truth_of_another_shard_and_poses_that_are_no_numbers_are_refused(tmp_path):
    for name, seed in (("a", 0), ("b", 1)):
        data_set(tmp_path / name, seed)
    truth = load_truth(tmp_path / "a")
    truth_path(tmp_path / "a" / "shard_0000.npz").replace(truth_path(tmp_path / "b" / "shard_0000.npz"))
    with pytest.raises(ValueError, match="shard_0000.truth.npz: expected the data it was made with, of seed 0, got 1"):
        load_truth(tmp_path / "b")
    save_truth(tmp_path / "b" / "shard_0000.npz", truth)  # an older one, which does not say whose it is
    assert load_truth(tmp_path / "b").labels.shape == truth.labels.shape
    with pytest.raises(ValueError, match="poses_after: expected finite"):
        replace(truth, poses_after=np.where(truth.poses_after == 1, np.nan, truth.poses_after))


# --- outputs that would destroy something -------------------------------------------------------------------------

@pytest.mark.parametrize("arguments, said", [
    ("train data run.npz --json run.npz", "--json: expected a name ending in .json"),
    ("evaluate run.npz data --json data/shard_0000.npz", "--json: expected a name ending in .json"),
    ("evaluate run.npz data --json link.json", "--json: link.json is a link"),
    ("evaluate run.npz data --json folder.json", "--json: folder.json is a link, a folder"),
    ("evaluate run.npz data --json /dev/null", "--json: expected"),
    ("show run.npz data --out run.npz", "--out: expected"),
    ("train data own.npz", "own.csv: exists already")])
def test_an_output_that_would_destroy_something_is_refused_before_the_work(arguments, said, tmp_path, capsys,
                                                                            monkeypatch):
    monkeypatch.chdir(tmp_path)
    data_set(tmp_path / "data")
    checkpoints.save_run("run.npz", random_run())
    (tmp_path / "link.json").symlink_to("run.npz")
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "own.csv").write_text("mine")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert run(*arguments.split()) == 2
    assert capsys.readouterr().err.splitlines()[0].startswith(f"hind4sight {arguments.split()[0]}: {said}")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


# --- types that NumPy lets pass -----------------------------------------------------------------------------------

B, H, W = 2, 3, 4
CLOUD, MASK = np.ones((B, H * W, 3)), np.ones((B, H * W), bool)
IMAGE, FLOW = np.ones((B, H, W, 3)), np.ones((B, H, W, 2))


@pytest.mark.parametrize("function, arguments, name", [
    (losses.distance_maps, (CLOUD, CLOUD, MASK * np.uint8(3), MASK), "valid_predicted"),
    (losses.distance_maps, (CLOUD, CLOUD, MASK, MASK.astype(float)), "valid_observed"),
    (losses.distance_maps, (CLOUD, CLOUD.astype(complex), MASK, MASK), "observed"),
    (losses.distance_maps, (CLOUD, CLOUD, MASK[:1], MASK), "valid_predicted"),
    (losses.photometric_loss, (IMAGE, (255 * IMAGE).astype(np.uint16), FLOW, MASK), "next_images"),
    (losses.photometric_loss, (IMAGE, IMAGE[:1], FLOW, MASK), "next_images"),
    (losses.photometric_loss, (IMAGE, IMAGE[..., :1], FLOW, MASK), "next_images"),
    (losses.photometric_loss, (IMAGE, IMAGE, FLOW, MASK[:, 1:]), "valid"),
    (losses.photometric_loss, ([[1], [1, 2]], IMAGE, FLOW, MASK), "images"),
    (losses.flow_smoothness_loss, (FLOW, IMAGE[:1], MASK), "images"),
    (losses.flow_smoothness_loss, (FLOW[..., :1], IMAGE, MASK), "flow"),
    (losses.flow_smoothness_loss, (FLOW, np.ma.masked_array(IMAGE), MASK), "images"),
    (losses.heatmap_cross_entropy, (np.ones((B, 5)), np.array([0, -1])), "cells"),
    (losses.heatmap_cross_entropy, (np.ones((B, 5)), np.array([5, 0])), "cells"),
    (losses.heatmap_cross_entropy, (np.ones((B, 5)), np.array([1.0, 0])), "cells"),
    (losses.heatmap_cross_entropy, (np.ones((B, 5)), np.array([1])), "cells"),
    (losses.embedding_loss, (np.ones((B, 5)), np.ones((1, 5))), "observed")])
def test_the_losses_refuse_what_numpy_would_let_pass(function, arguments, name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        function(*arguments)


class Series:
    """An array in another's dress, as pandas has them: with a dtype and a shape, but not NumPy's ways."""

    def __init__(self, value):
        self.value, self.dtype, self.shape, self.size = value, value.dtype, value.shape, value.size

    def __array__(self, dtype=None, copy=None):
        return self.value


RNG = np.random.default_rng(0)
BYTES, POINTS = RNG.integers(0, 256, IMAGE.shape, np.uint8), RNG.random(CLOUD.shape)
SEEN = RNG.random(MASK.shape) < 0.7


@pytest.mark.parametrize("function, given, meant", [
    (losses.distance_maps, (POINTS, CLOUD, 255 * np.uint8(SEEN), np.int64(SEEN)), (POINTS, CLOUD, SEEN, SEEN)),
    (losses.distance_maps, (POINTS.tolist(), np.uint16(CLOUD), SEEN.tolist(), SEEN), (POINTS, CLOUD, SEEN, SEEN)),
    (losses.photometric_loss, (BYTES, BYTES[::-1], FLOW, SEEN), (BYTES / 255, BYTES[::-1] / 255, FLOW, SEEN)),
    (losses.photometric_loss, ((BYTES / 255).astype(">f8"), (BYTES[::-1] / 255).astype(">f8"), FLOW, SEEN),
     (BYTES / 255, BYTES[::-1] / 255, FLOW, SEEN)),
    (losses.distance_maps, (Series(POINTS), CLOUD, Series(SEEN), SEEN), (POINTS, CLOUD, SEEN, SEEN))],
    ids=["masks", "lists", "bytes", "byte order", "series"])
def test_the_losses_convert_what_can_be_converted_exactly(function, given, meant):
    expected = function(*meant)
    assert np.max(expected) > 0.01
    np.testing.assert_allclose(function(*given), expected, rtol=1e-5)


@pytest.mark.parametrize("name, spoil, said", [
    ("meta", lambda meta: {"settings": {**SETTINGS, "cell": 1e300}}, "1 to 500 cells"),
    ("meta", lambda meta: {"settings": {**SETTINGS, "cell": 1e-9}}, "1 to 500 cells"),
    ("depth_after", lambda depth: depth * (np.arange(7) != 4)[:, None, None].astype(np.float32), "none in row 4")])
def test_a_record_of_pokes_that_stops_everything_later_is_refused_at_once(name, spoil, said):
    with pytest.raises(ValueError, match=f"{name}: expected .*{said}"):
        replace(tiny_pokes(), **{name: spoil(getattr(tiny_pokes(), name))})


# --- numbers without bound ----------------------------------------------------------------------------------------

@pytest.mark.parametrize("arguments, said", [
    ("collect c --pokes 1000000000000", "pokes: .*<= 1000000"),
    ("train data r.npz --batch 100000000", "batch: .*<= 4096"),
    ("train data r.npz --steps 1000000000000", "steps: .*<= "), ("collect c --jobs 100000", "jobs: .*<= 1024"),
    ("plan run.npz --horizon 1000000", "horizon: .*<= 10"), ("plan run.npz --candidates 10000000", "candidates: .*<="),
    ("collect c --part 9/8", "part: .*<= 8"), ("collect c --part 3", "--part: expected I/N, .*'3'"),
    ("train data r.npz --width 0", "width: .*>= 1"), ("train data r.npz --masks 0", "masks: .*>= 2"),
    ("train data r.npz --weight chamfer=x", "--weight: expected TERM=VALUE, .*chamfer, .*'chamfer=x'"),
    ("train data r.npz --depth-noise 1", "--depth-noise: expected 0 to 0.1 m, got 1"),
    ("evaluate run.npz data --depth-noise 1", "depth_noise: expected at most 0.1 m, got 1"),
    ("evaluate run.npz data --pose-error 1 nan", "pose_error: expected at most 1 m, got nan"),
    ("collect c --size 400000 300000", "width: .* to 1280"), ("train data r.npz --width 100000", "width: .*<= 512")])
def test_a_number_without_bound_is_refused_with_the_largest_that_makes_sense(arguments, said, tmp_path, capsys,
                                                                             monkeypatch):
    monkeypatch.chdir(tmp_path)
    data_set(tmp_path / "data")
    checkpoints.save_run("run.npz", random_run())
    assert run(*arguments.split()) == 2
    assert re.search(said, capsys.readouterr().err)


# --- divergence ---------------------------------------------------------------------------------------------------

def test_a_run_that_diverges_says_when_and_what_to_try(tmp_path):
    data, given = tiny_pokes(), replace(TINY, learning_rate=1e6, warmup=0, steps=50)
    with pytest.raises(FloatingPointError, match=r"diverged at step \d+: .*try a smaller learning rate than 1e\+06"):
        train_saving(data, start_run(given, data), tmp_path / "run.npz")


# --- stopping and surroundings, as a user meets them --------------------------------------------------------------

def program(*arguments, **how):
    """The command in a process of its own."""
    how["env"] = {**os.environ, "PYTHONPATH": str(ROOT), **how.get("env", {})}
    how.setdefault("preexec_fn", lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))  # in a shell's background off
    return subprocess.Popen([sys.executable, "-m", "hind4sight_min", *map(str, arguments)], text=True,
                            **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **how})


@pytest.mark.parametrize("number, status", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_training_that_is_stopped_is_saved_at_once_and_goes_on_as_the_same_run(number, status, tmp_path):
    data_set(tmp_path / "data", count=2)
    path = tmp_path / "run.npz"
    training = program("train", tmp_path / "data", path, "--width", 8, "--batch", 2, "--steps", 10 ** 6, "--jobs", 1)
    for _ in range(3):  # so many epochs are over, and one at least is kept
        training.stdout.readline()
    training.send_signal(number)
    _, err = training.communicate(timeout=20)
    assert training.returncode == status
    assert err.strip() == "hind4sight train: stopped; what is on disk is whole, --resume goes on"
    assert {each.name for each in tmp_path.iterdir()} == {"data", "run.npz", "run.csv"}
    stopped, data = checkpoints.load_run(path), load_interactions(tmp_path / "data")
    same = start_run(stopped.recipe, data)
    for _ in range(stopped.step):
        training_step(data, same)
    assert stopped.step > 0
    for name in ("vector", "first_moment", "second_moment"):
        np.testing.assert_array_equal(getattr(stopped, name), getattr(same, name), err_msg="stopped within a step?")


def test_unusual_surroundings_do_not_matter(tmp_path):
    odd = program("evaluate", "--help", env={"MPLBACKEND": "no-such-backend", "PYTHONIOENCODING": "cp1252"})
    assert odd.communicate(timeout=60)[1] == "" and odd.returncode == 0
    shown = program("show", "--out", tmp_path / "poke.png", env={"MPLBACKEND": "module://no.such.backend",
                                                                 "PYTHONIOENCODING": "ascii"})
    assert shown.communicate(timeout=60)[1] == "" and shown.returncode == 0
    quiet = program("evaluate", "no.npz", preexec_fn=lambda: os.close(2))
    quiet.communicate(timeout=60)
    assert quiet.returncode == 2
    read, write = os.pipe()
    os.close(read)
    unread = program("course", "list", stdout=write)
    os.close(write)
    assert unread.communicate(timeout=60)[1] == "" and unread.returncode == 141


def test_an_interrupt_does_not_wait_for_what_runs_elsewhere():
    began = time.perf_counter()
    with pytest.raises(KeyboardInterrupt), parallel_map(2) as map:
        for i, _ in enumerate(map(time.sleep, [0.01, 60, 0.01])):
            raise KeyboardInterrupt
    assert time.perf_counter() - began < 20


def test_an_interrupt_during_import_is_one_line_too():
    code = ("import sys, hind4sight_min.__main__ as program\n"
            "class Slow:\n"
            "    def find_spec(self, name, *_):\n"
            "        if name.endswith('lab.cli'): raise KeyboardInterrupt\n"
            "sys.meta_path.insert(0, Slow())\n"
            "sys.exit(program.main())")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 130 and done.stderr == "\nhind4sight: stopped\n"


def test_training_leaves_a_checkpoint_alone_that_another_process_works_on(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data_set(tmp_path / "data")
    with files.only_one("run.npz"):
        assert run(*"train data run.npz --steps 1 --batch 2 --width 8 --jobs 1".split()) == 2
    assert f"run.npz: process {files.this_process()} is at work" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"data"}


def test_a_texture_that_cannot_be_written_is_named(monkeypatch):
    pytest.importorskip("pybullet")
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"texture_0\.png: could not be written: No space left on device"):
        arena.Arena(arena.Settings(), np.random.default_rng(0))


# --- files and calls by the hundred -------------------------------------------------------------------------------

def test_mutated_files_and_calls_with_wrong_types_hold():
    assert not mutations.try_cases([*range(11, 5000, 31), *(f"call:{i}" for i in range(3, 1000, 11))])
