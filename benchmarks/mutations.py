"""Files from others and calls with wrong types: 5,000 mutated files, one for every reader in turn, and 1,000 calls.

    python benchmarks/mutations.py --json docs/results/mutations.json
    python benchmarks/mutations.py --only 1234 call:17        # these alone, with the traceback

A file is held when it is refused in one line that names it, or read as the right thing: bytes that were changed
somehow, as what was written; a header or an array that was changed and saved again with all checksums, as what it now
says, and fit to be used. A call is held when it raises one line, or returns what the exact conversion of its arguments
gives. None may take over 1 GB or over 5 s of processor time: it all runs in processes with such limits. Two minutes.
"""
import argparse
import io
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
import zipfile
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from hind4sight_min import geometry, interactions, losses, scene
from hind4sight_min.course import grade_commands, grading
from hind4sight_min.disk import checkpoints, files, shards
from hind4sight_min.lab import evaluation, marks, noise, tables
from hind4sight_min.networks import Sizes
from hind4sight_min.planning import Search
from hind4sight_min.sim import truth
from hind4sight_min.training import Recipe, make_batch, start_run

ROOT = Path(__file__).resolve().parent.parent
FILES, CALLS = 5000, 1000
MOST_MEMORY, MOST_SECONDS = 1 << 30, 5


# --- good files, and how each is read -----------------------------------------------------------------------------

def write_good(folder):
    """One good file of every kind, small, into a folder -> {kind: path}."""
    data = shards.load_shard(ROOT / "data_small" / "test" / "shard_0000.npz")[:3]
    known = truth.load_truth(ROOT / "data_small" / "test")[:3]
    for name in ("shard", "truth"):
        shards.save_shard(folder / name / "shard_0000.npz", data)
        truth.save_truth(folder / name / "shard_0000.npz", known, data)
    run = start_run(Recipe(sizes=Sizes(masks=3, width=8, head=10, embedding=6, inverse=9)), data)
    checkpoints.save_run(folder / "run.npz", run)
    metrics = {"made": {"recipe": asdict(run.recipe), "window": 3}, "metrics": {"ratio": 0.5}, "commit": None}
    for name in ("figures", "results", "collection"):
        files.write_json(folder / f"{name}.json", {**metrics, "seed": 1, "extra_data": {"finished": True}})
    files.write_text(folder / "seed", "0123456789abcdef")
    (folder / "seed").chmod(0o600)
    files.write_text(folder / ".locked.lock", files.this_process())
    source = "import numpy as np\n\n\ndef chamfer_loss(a, b):\n    return np.sum(a + b, axis=1)\n" * 20
    files.write_text(folder / "chamfer.py", source)
    with zipfile.ZipFile(folder / "work.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("my work/chamfer.py", source)
    return {"shard": folder / "shard" / "shard_0000.npz", "truth": folder / "truth" / "shard_0000.truth.npz",
            "run": folder / "run.npz", "figures": folder / "figures.json", "results": folder / "results.json",
            "collection": folder / "collection.json", "seed": folder / "seed", "lock": folder / ".locked.lock",
            "source": folder / "chamfer.py", "zip": folder / "work.zip"}


def arrays_of(record):
    return {name: value.tobytes() for name, value in vars(record).items() if isinstance(value, np.ndarray)}


def read_shard(path):
    found = shards.load_shard(path)
    batch = make_batch(found[:1], Recipe(), np.random.default_rng(0))
    assert np.isfinite(batch.before.points).all(), "points that are no numbers"
    return arrays_of(found), json.dumps(found.meta, sort_keys=True)


def read_truth(path):
    found = truth.load_truth(path.parent)
    evaluation.true_motion(shards.load_interactions(path.parent), found, 0)
    return arrays_of(found)


DATA = []


def read_run(path):
    run = checkpoints.load_run(path)
    if not DATA:
        DATA.append(shards.load_shard(ROOT / "data_small" / "test" / "shard_0000.npz")[:1])
    answer = evaluation.ask(run, DATA[0], 0)
    assert np.isfinite(answer.prediction.points).all(), "a prediction that is no number"
    return run.vector.tobytes(), run.first_moment.tobytes(), repr(run.recipe), run.step, json.dumps(run.meta)


def read_lock(path):
    with files.only_one(path.with_name("locked")):
        return "free"


def read_results(path):
    return grading.finished(path)


READERS = {  # kind -> how it is read; a ValueError is a refusal
    "shard": read_shard, "truth": read_truth, "run": read_run, "lock": read_lock, "results": read_results,
    "figures": lambda path: tables.once(path, {"seed": 1}, dict),
    "collection": lambda path: files.claim(path, {"seed": 1}), "seed": grade_commands.seed_from,
    "source": lambda path: grading.find_submission(path, "chamfer.py")[0],
    "zip": lambda path: grading.find_submission(path, "chamfer.py")[0]}
ANYTHING = {"source", "seed", "lock"}  # read as whatever is in them
ZIPPED, TEXTS = ("shard", "truth", "run"), ("figures", "results", "collection")


# --- mutations ----------------------------------------------------------------------------------------------------

def some_bytes(rng, content):
    """Bytes changed as damage does, or an attacker: flipped, cut, doubled, moved, overwritten, lengths made huge."""
    content = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        at, length = int(rng.integers(len(content) + 1)), int(rng.integers(1, 2 + len(content) // 4))
        kind = rng.integers(9)
        if kind == 0 and content:
            content[at % len(content)] ^= 1 << rng.integers(8)
        elif kind == 1:
            content[at:at + length] = rng.bytes(length)
        elif kind == 2:
            del content[at:]
        elif kind == 3:
            del content[at:at + length]
        elif kind == 4:
            content[at:at] = content[at:at + length]
        elif kind == 5:
            content[at:at + length] = bytes([rng.choice([0, 255, 32, 57])]) * length
        elif kind == 6:
            content[at:at + 4] = rng.choice([b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\0\0"])
        elif kind == 7:
            content[at:at] = rng.bytes(length)
        else:
            content.extend(rng.bytes(length))
    return bytes(content)


JUNK = (None, True, False, -1, 0, 1, 2.5, 1e300, -1e300, 10 ** 30, float("nan"), float("inf"), "", "x", "1", [], {},
        [1], [[1, 2], [3]], {"a": 1}, "\0", "9" * 3000, [0] * 3000)


def some_json(rng, value):
    """Plain JSON types with one entry, somewhere in them, made another, taken out, or added."""
    if isinstance(value, (dict, list)) and value and rng.random() < 0.85:
        keys = list(value) if isinstance(value, dict) else range(len(value))
        key, copy = keys[rng.integers(len(keys))], value.copy()
        if rng.random() < 0.1:
            del copy[key]
        else:
            copy[key] = some_json(rng, value[key])
        return copy
    if isinstance(value, (int, float)) and not isinstance(value, bool) and rng.random() < 0.5:
        return value * float(rng.choice([-1, 0, 0.5, 1e3, 1e-9, 1e9]))
    return JUNK[rng.integers(len(JUNK))]


def some_array(rng, value):
    """An array of another type, shape or with other values."""
    kind = rng.integers(8) if value.dtype.kind != "U" else 2
    with np.errstate(all="ignore"):
        if kind == 0:
            return value.astype(rng.choice(["f2", "f8", "c8", "?", "u1", "i4", "u8", ">f4", "S3", "M8[s]", "U2"]))
        if kind == 1 and value.ndim:
            return value[:rng.integers(len(value) + 1)]
        if kind == 2:
            return value[None] if rng.random() < 0.5 else value.reshape(-1)
        if kind == 3 and value.ndim > 1:
            return np.moveaxis(value, 0, -1)
        if kind == 4:
            return np.full_like(value, rng.choice([0, 1, 255]))
        if kind == 5 and value.dtype.kind == "f":
            copy = value.copy()
            copy.flat[rng.integers(max(1, copy.size))] = rng.choice([np.nan, np.inf, -np.inf, 1e30, -1.0])
            return copy
        if kind == 6:
            return np.zeros((0, *value.shape[1:]), value.dtype)
        return np.array("x") if value.dtype.kind == "U" else np.array(3, value.dtype)


def some_member(rng, content):
    """A member of an .npz, as NumPy writes it, with another header: other shapes, types, lengths."""
    header = bytes(content[:128])
    for old, new in ((b"(", b"(9999999,"), (b"<f4", b"|O8"), (b"<u2", b"<f8"), (b"False", b"True "), (b"{", b"["),
                     (b"1, 0", b"-1,0"), (b"shape", b"shapes"), (b"3", b"9"), (b"\x01\x00", b"\x02\x00")):
        if rng.random() < 0.25:
            header = header.replace(old, new, 1)
    return header + bytes(content[128:])


def zipped(members):
    """{name: bytes} as a zip file with right checksums."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def npy(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def mutated(rng, kind, content):
    """The content of a file of a kind, changed -> bytes, and whether only by its bytes."""
    if kind in TEXTS and rng.random() < 0.6:
        return json.dumps(some_json(rng, json.loads(content))).encode(), False
    if kind not in ZIPPED or rng.random() < 0.4:
        return some_bytes(rng, content), True
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, how = list(members)[rng.integers(len(members))], rng.integers(6)
    if how <= 1:
        meta = json.loads(str(np.load(io.BytesIO(members["meta.npy"]))))
        members["meta.npy"] = npy(np.array(json.dumps(some_json(rng, meta))))
    elif how == 2:
        members[name] = some_member(rng, members[name])
    elif how == 3:
        members[name] = npy(some_array(rng, np.load(io.BytesIO(members[name]))))
    elif how == 4:
        del members[name]
    else:
        members[str(rng.choice(["more.npy", "more", "../more.npy", "self.npy", "file.npy"]))] = members[name]
    return zipped(members), False


# --- one case ------------------------------------------------------------------------------------------------------

class TooLong(BaseException):
    """More than MOST_SECONDS."""


def on_time(*_):
    raise TooLong


def one_line(error, *named):
    """Why an error is no clear one, or ""."""
    text = str(error)
    if "\n" in text or not text or len(text) > 2000:
        return f"the error is not one line: {text[:200]!r}"
    return "" if any(name in text for name in named) else f"the error names nothing of {named}: {text[:300]}"


def try_file(i, good, originals, folder):
    """Case i of the files -> "" where it is held, else why not."""
    rng, kind = np.random.default_rng([7, i]), list(READERS)[i % len(READERS)]
    content, bytes_alone = mutated(rng, kind, originals[kind][0])
    path = good[kind]
    path.write_bytes(content)
    path.chmod(0o600)
    try:
        found = READERS[kind](path)
        right = not bytes_alone or kind in ANYTHING or kind in TEXTS or found == originals[kind][1]
        return "" if right else f"{kind}: read as something else"
    except (ValueError, FloatingPointError) as error:
        return one_line(error, path.name, path.parent.name, path.stem, "camera", "null bytes")
    finally:
        path.write_bytes(originals[kind][0])


# --- calls ---------------------------------------------------------------------------------------------------------

def good_calls():
    """(function, its good arguments by name) of what people call with arrays and numbers of their own."""
    rng, b, h, w = np.random.default_rng(0), 2, 12, 16
    data = shards.load_shard(ROOT / "data_small" / "test" / "shard_0000.npz")[:2]
    known = truth.load_truth(ROOT / "data_small" / "test")[:2]
    camera, n = data.camera, h * w
    cloud, other = rng.uniform(-0.2, 0.2, (2, b, n, 3))
    valid, image, flow = rng.random((b, n)) < 0.8, rng.random((b, h, w, 3)), rng.uniform(-2, 2, (b, h, w, 2))
    picture = scene.scene_of(data.depth_before[:1], data.rgb_before[:1], data.empty_depth, camera, 0.5)
    on_object = np.flatnonzero(picture.occupied[0])[:2]
    pixels = np.stack([on_object % camera.width, on_object // camera.width], axis=1).astype(float)
    fields = {name: getattr(data, name) for name in (*interactions.PER_POKE, "empty_depth")}
    return [
        (losses.distance_maps, dict(predicted=cloud, observed=other, valid_predicted=valid, valid_observed=valid)),
        (losses.photometric_loss, dict(images=image, next_images=image[::-1], flow=flow, valid=valid)),
        (losses.flow_smoothness_loss, dict(flow=flow, images=image, valid=valid)),
        (losses.heatmap_cross_entropy, dict(logits=rng.random((b, 9)), cells=np.array([3, 8]))),
        (losses.embedding_loss, dict(predicted=rng.random((b, 5)), observed=rng.random((b, 5)))),
        (partial(geometry.unproject, camera=camera), dict(depth=data.depth_before)),
        (partial(geometry.rigid, transform=np.eye(4)), dict(points=cloud)),
        (partial(replace, data), fields), (truth.Truth, dict(vars(known))), (geometry.Camera, camera.plain),
        (partial(marks.points_at, scene=picture, camera=camera), dict(pixels=pixels)),
        (noise.add_depth_noise, dict(depth=data.depth_before, rng=0, standard_deviation=0.01)),
        (Recipe, {name: value for name, value in vars(Recipe()).items()}), (Sizes, dict(vars(Sizes()))),
        (Search, dict(vars(Search()))), (tables.Settings, dict(vars(tables.Settings())))]


def other_types(rng, value):
    """(value of another type, its exact conversion; None where there is none)."""
    if not isinstance(value, np.ndarray):
        junk = JUNK[rng.integers(len(JUNK))]
        return junk, None
    exact = [value.tolist(), tuple(value.tolist()), np.asfortranarray(value), value.astype(value.dtype.newbyteorder()),
             np.repeat(value, 2, axis=-1)[..., ::2], np.ma.masked_array(value), value.view()]
    if value.dtype.kind == "b":
        exact += [value.astype(np.uint8), 255 * value.astype(np.uint8), value.astype(np.int64)]
    wrong = [None, "x", 3, {}, [[1], [1, 2]], value.astype(object), value.astype(complex), value.astype("U9"),
             value[:-1], value[None], value.ravel(), value[..., None], value[..., :-1],
             iter([1]), np.array(2.5), b"abc"]
    if value.dtype.kind == "f":
        wrong += [(255 * np.abs(value)).astype(np.uint8), (1000 * np.abs(value)).astype(np.uint16), value > 0]
    if rng.random() < 0.4:
        return exact[rng.integers(len(exact))], value
    return wrong[rng.integers(len(wrong))], None


def plain_result(value):
    """A result, to be compared."""
    if isinstance(value, (tuple, list)):
        return [plain_result(each) for each in value]
    if hasattr(value, "__dict__"):
        return {name: plain_result(each) for name, each in vars(value).items()}
    return value


def same(a, b):
    try:
        np.testing.assert_equal(np.asarray(a).tolist() if isinstance(a, np.ndarray) else a,
                                np.asarray(b).tolist() if isinstance(b, np.ndarray) else b)
        return True
    except AssertionError:
        try:
            return np.allclose(np.ravel(np.asarray(a, float)), np.ravel(np.asarray(b, float)), rtol=1e-5, atol=1e-5)
        except (TypeError, ValueError):
            return str(a) == str(b)


def called(function, arguments):
    if "rng" in arguments:
        arguments = {**arguments, "rng": np.random.default_rng(0)}
    return plain_result(function(**arguments))


def one_array(arguments):
    return sum(isinstance(value, np.ndarray) for value in arguments.values()) == 1


def try_call(i, calls):
    """Case i of the calls -> "" where it is held, else why not."""
    rng = np.random.default_rng([8, i])
    function, arguments = calls[i % len(calls)]
    name = list(arguments)[rng.integers(len(arguments))]
    given, exact = other_types(rng, arguments[name])
    of = getattr(function, "func", function)
    about = f"{of.__name__}({name}={type(given).__name__} {getattr(given, 'shape', '')} {str(given)[:60]!r})"
    try:
        found = called(function, {**arguments, name: given})
    except (ValueError, TypeError) as error:
        why = one_line(error, *arguments, {"pixels": "marks", "flow": "field"}.get(name, name))
        return why and f"{about}: {why}"
    if exact is None and isinstance(given, np.ndarray) and given.dtype.kind in "iu" and given.ndim:
        exact = given / np.float32(255) if "image" in name else given.astype(float)
    if isinstance(given, np.ndarray) and one_array(arguments) and given.shape[1:] == arguments[name].shape[1:]:
        exact = given  # fewer rows are as good
    if exact is None and not isinstance(arguments[name], np.ndarray):
        return ""  # a number or a text that is as good
    expected = called(function, {**arguments, name: arguments[name] if exact is None else exact})
    return "" if same(found, expected) else f"{about}: another result"


# --- all of them ----------------------------------------------------------------------------------------------------

def try_cases(cases, on_result=lambda case, why: None, debug=False):
    """Cases, numbers of files or "call:" and the number of a call -> {case: why it is not held}."""
    failures, calls = {}, None
    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
        good = write_good(Path(folder))
        originals = {}
        for kind, path in good.items():
            content = path.read_bytes()
            originals[kind] = content, None if kind == "lock" else READERS[kind](path)
        old = signal.signal(signal.SIGPROF, on_time)
        for case in cases:
            signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)
            try:
                if str(case).startswith("call:"):
                    calls = calls or good_calls()
                    why = try_call(int(case[5:]), calls)
                else:
                    why = try_file(int(case), good, originals, Path(folder))
            except (Exception, TooLong) as error:  # noqa: BLE001: that is what is looked for
                why = f"{type(error).__name__}: {str(error)[:300]}"
                if debug:
                    traceback.print_exc()
            signal.setitimer(signal.ITIMER_PROF, 0)
            if why:
                failures[str(case)] = why
            on_result(case, why)
        signal.signal(signal.SIGPROF, old)
    return failures


def limited(cases):
    """The same in a process with the limits, started anew where a case ends it -> {case: why it is not held}."""
    failures, left = {}, list(map(str, cases))
    while left:
        process = subprocess.Popen([sys.executable, __file__, "--work"], text=True, stdin=subprocess.PIPE,
                                   stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)})
        out, _ = process.communicate("\n".join(left))
        done = [line.partition("\t") for line in out.splitlines() if "\t" in line]
        failures.update((case, why) for case, _, why in done if why)
        left = left[len(done):]
        if left and process.returncode:
            failures[left.pop(0)] = f"ended the process ({process.returncode})"
    return failures


def work():
    """In the process with the limits: the cases from standard input, a line on each to standard output."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MOST_MEMORY,) * 2)
    try_cases(sys.stdin.read().split(), lambda case, why: print(case, " ".join(why.split()), sep="\t", flush=True))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=FILES)
    parser.add_argument("--calls", type=int, default=CALLS)
    parser.add_argument("--only", nargs="+", metavar="CASE")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    if args.work:
        work()
        return
    if args.only:
        sys.exit("\n".join(f"{case}: {why}" for case, why in try_cases(args.only, debug=True).items()) or None)
    in_files, in_calls = limited(range(args.files)), limited([f"call:{i}" for i in range(args.calls)])
    for case, why in {**in_files, **in_calls}.items():
        kind = "" if case.startswith("call") else list(READERS)[int(case) % len(READERS)]
        print(f"{case} {kind}: {why}")
    figures = {"mutated_files": args.files, "mutated_files_held": args.files - len(in_files), "wrong_calls": args.calls,
               "wrong_calls_held": args.calls - len(in_calls)}
    print(", ".join(f"{name}: {value}" for name, value in figures.items()))
    files.write_json(args.json, figures)


if __name__ == "__main__":
    main()
