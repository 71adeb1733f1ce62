"""Files that are written whole or not at all, and arrays with a JSON header that are read with care."""
import json
import math
import os
import socket
import sysconfig
from contextlib import contextmanager
from pathlib import Path

import numpy as np


def shares():
    """Where a plain install puts what is shipped beside the package: for the environment, for the user alone."""
    return [Path(sysconfig.get_path("data", scheme), "share", "hind4sight_min")
            for scheme in (sysconfig.get_default_scheme(), sysconfig.get_preferred_scheme("user"))]


def shipped(path):
    """A file or folder that is shipped with the package: beside it in a clone, under share/ after a plain install."""
    places = [folder / path for folder in (Path(__file__).resolve().parents[2], *shares())]
    return next((place for place in places if place.exists()), places[0])


@contextmanager
def whole_file(path):
    """A temporary path that takes the place of `path` when the block ends well, and vanishes when it does not.

    Raises OSError naming `path` where it cannot be written, be it only that the disk is full.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")  # the ending stays: libraries go by it
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:  # a full disk does not say of which file
        raise OSError(f"{path}: could not be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)


def check_output(name, path, ending):
    """Raise ValueError, before any work, for a path that must not be written: another ending than that of what is
    written, so perhaps an input, or what is no plain file (a folder, a link, a device). name: of the option.
    """
    path = Path(path)
    if path.suffix.lower() != ending:
        raise ValueError(f"{name}: expected a name ending in {ending}, got {path.name!r}")
    if path.is_symlink() or path.exists() and not path.is_file():
        raise ValueError(f"{name}: {path} is a link, a folder or a device; expected a plain file or a new name")


# --- one process at a time ------------------------------------------------------------------------------------

def is_alive(process):
    """Whether a process of this machine, by its number, still runs."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        pass
    return True


@contextmanager
def only_one(path):
    """Within the block no other process works on `path`, a file or a folder of results: it would overwrite ours.

    A lock file beside it holds the number and the machine of our process. That of a dead one is taken over, and what
    else dead ones left half written is removed. Raises ValueError naming the lock file where a process is at it.
    """
    path = Path(path).absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    for _ in range(2):
        try:
            with open(lock, "x") as file:
                file.write(f"{os.getpid()} {socket.gethostname()}")
            break
        except FileExistsError:
            process, _, machine = lock.read_text().partition(" ")
            if machine == socket.gethostname() and not is_alive(int(process)):
                lock.unlink(missing_ok=True)
    else:
        raise ValueError(f"{path}: process {process} on {machine} is at work there; if it is not, remove {lock}")
    try:
        for half in [*path.parent.glob(f".*.{path.stem}.*"), *path.glob(".*.*")]:  # as `whole_file` calls them
            process = half.name.split(".")[1]
            if process.isdigit() and not is_alive(int(process)):
                half.unlink(missing_ok=True)
        yield
    finally:
        lock.unlink(missing_ok=True)


# --- text and arrays --------------------------------------------------------------------------------------------

def write_text(path, text):
    """Write a text file, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path, figures):
    """Write plain JSON types, whole or not at all; nothing for no path."""
    if path:
        write_text(path, json.dumps(figures, indent=2, sort_keys=True) + "\n")


def plain(value):
    """`value` as JSON gives it back: lists for tuples, floats for NumPy's."""
    def listed(other):
        if not isinstance(other, (np.generic, np.ndarray)):
            raise TypeError(f"expected plain numbers, texts and lists, got {type(other).__name__}")
        return other.tolist()
    return json.loads(json.dumps(value, default=listed))


def save_npz(path, arrays, meta):
    """Write arrays and one JSON text to a compressed .npz, whole or not at all."""
    with whole_file(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, meta=np.array(json.dumps(plain(meta), sort_keys=True)), **arrays)


MOST_BYTES = 750e6  # that a file may unpack to: 200 pokes at 640 x 480
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def check_members(archive, most):
    """Raise ValueError unless the arrays of a zip file are as large as they say, and together at most `most` bytes.

    Before anything is unpacked: a small file can claim, or become, any size.
    """
    total = sum(member.file_size for member in archive.infolist())
    if total > most:
        raise ValueError(f"it unpacks to {total / 1e6:.0f} MB, expected at most {most / 1e6:.0f}")
    for member in archive.infolist():
        with archive.open(member) as file:
            shape, _, dtype = HEADERS[np.lib.format.read_magic(file)](file)
            if file.tell() + math.prod(shape) * dtype.itemsize != member.file_size:
                raise ValueError(f"{member.filename} is of another size than it says")


class OtherFormat(ValueError):
    """A good file, but not one of those asked for."""


def load_npz(path, format, most=MOST_BYTES):
    """Read what `save_npz` wrote: (dict of arrays, meta). Raises ValueError naming the file if it is damaged, of
    another format, or unpacks to more than `most` bytes.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            check_members(archive.zip, most)
            meta = dict(json.loads(str(archive["meta"])))
            if meta.get("format") != format:
                raise OtherFormat(f"{path}: expected format {format!r}, got {meta.get('format')!r}")
            if archive.zip.testzip():  # NumPy reads as far as a header says, and then looks at no checksum
                raise ValueError("a checksum differs")
            return {name: archive[name] for name in archive.files if name != "meta"}, meta
    except (MemoryError, OtherFormat):
        raise
    except Exception as error:  # damage can surface as almost anything: zlib, zipfile, struct, NumPy, JSON
        raise ValueError(f"{path}: damaged or not one of our files ({error or type(error).__name__})") from None
