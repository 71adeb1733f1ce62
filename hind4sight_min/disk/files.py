"""Files that are written whole or not at all, and arrays with a JSON header that are read with care."""
import json
import math
import os
import re
import socket
import sysconfig
import zipfile
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import get_ident

import numpy as np


def shares():
    """Where a plain install puts what is shipped beside the package: for the environment, for the user alone."""
    return [Path(sysconfig.get_path("data", scheme), "share", "hind4sight_min")
            for scheme in (sysconfig.get_default_scheme(), sysconfig.get_preferred_scheme("user"))]


def shipped(path):
    """A file or folder that is shipped with the package: beside it in a clone, under share/ after a plain install."""
    places = [folder / path for folder in (Path(__file__).resolve().parents[2], *shares())]
    return next((place for place in places if place.exists()), places[0])


def data_small():
    """The folder of the shipped data."""
    return shipped("data_small")


def make_folder(path):
    """Make a folder with those above it, unless it is there. Raises OSError that says what could not be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"{path}: expected a folder, or a place for one: {error.strerror}") from None


@contextmanager
def whole_file(path, new=False):
    """A temporary path that takes the place of `path` when the block ends well, and vanishes when it does not. new: a
    file that is there already stays, be it that another process made it meanwhile.

    Raises OSError naming `path` where it cannot be written, be it only that the disk is full.
    """
    path = Path(path)
    make_folder(path.parent)
    temporary = path.with_name(f".{this_process()}.{get_ident()}.{path.name}")  # the ending stays: libraries go by it
    try:
        yield temporary
        if new:
            with suppress(FileExistsError):
                os.link(temporary, path)
        else:
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
    if path.parent.exists() and not path.parent.is_dir():
        raise ValueError(f"{name}: {path.parent} is no folder")


# --- several processes, perhaps of several machines ----------------------------------------------------------------

def this_process():
    """This process among those of all machines: NUMBER@MACHINE."""
    return f"{os.getpid()}@{socket.gethostname()}"


def is_dead(process):
    """Whether a process, NUMBER@MACHINE, was one of this machine and has ended; of others nobody here can know."""
    number, _, machine = process.partition("@")
    if machine != socket.gethostname() or not number.isdecimal():
        return False
    try:
        os.kill(int(number), 0)
    except (ProcessLookupError, OverflowError):
        return True
    except PermissionError:  # another user's
        pass
    return False


def clear_away(paths):
    """Of `paths`, remove the temporary files of `whole_file` that dead processes of this machine have left."""
    for path in paths:
        left = re.match(rf"\.(\d+@{re.escape(socket.gethostname())})\.", path.name)
        if left and is_dead(left[1]):
            path.unlink(missing_ok=True)


@contextmanager
def only_one(path):
    """Within the block no other process works on `path`, a file or a folder of results: it would overwrite ours.

    A lock file beside it names our process. That of a dead one is taken over, and what else dead ones left half written
    is removed. Raises ValueError naming the lock file where a process is at it.
    """
    path = Path(path).absolute()
    make_folder(path.parent)
    lock = path.with_name(f".{path.name}.lock")
    for _ in range(2):
        try:
            with open(lock, "x") as file:
                file.write(this_process())
            break
        except FileExistsError:
            process = " ".join(lock.read_text(errors="replace").split())[:99]
            if is_dead(process):
                lock.unlink(missing_ok=True)
    else:
        raise ValueError(f"{path}: process {process} is at work there; if it is not, remove {lock}")
    try:
        clear_away([*path.parent.glob(f".*.{path.stem}.*"), *path.glob(".*.*")])
        yield
    finally:
        lock.unlink(missing_ok=True)


def claim(path, made):
    """Keep in a new file what a folder's results are made of, plain JSON types; where there is one, compare.

    Of any number of processes at once one writes it. Raises ValueError that says what differs.
    """
    with whole_file(path, new=True) as temporary:
        temporary.write_text(as_json(made), encoding="utf-8")
    found = read_json(path)
    for name, value in plain(made).items():
        if found.get(name) != value:
            raise ValueError(f"{path}: {name}: expected what is there, {found.get(name)}, got {value}; choose another "
                             "folder")


# --- text and arrays --------------------------------------------------------------------------------------------

def write_text(path, text):
    """Write a text file, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def as_json(figures):
    """Plain JSON types as text for people too."""
    return json.dumps(figures, indent=2, sort_keys=True) + "\n"


def write_json(path, figures):
    """Write plain JSON types, whole or not at all; nothing for no path."""
    if path:
        write_text(path, as_json(figures))


def read_json(path, most=10 << 20):
    """Read a dict of plain JSON types. Raises ValueError naming a file that is damaged, holds another thing or has more
    than `most` bytes, OSError where there is none.
    """
    with open(path, "rb") as file:
        content = file.read(most + 1)
    try:
        found = json.loads(content) if len(content) <= most else None
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise ValueError(f"{path}: damaged or not one of our files")
    return found


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
        if not zipfile.is_zipfile(path):  # of which NumPy says how to unpickle it
            raise ValueError("no .npz file")
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            check_members(archive.zip, most)
            meta = dict(json.loads(str(archive["meta"])))
            if meta.get("format") != format:
                raise OtherFormat(f"{path}: expected format {format!r}, got {meta.get('format')!r:.99}")
            if archive.zip.testzip():  # NumPy reads as far as a header says, and then looks at no checksum
                raise ValueError("a checksum differs")
            return {name: archive[name] for name in archive.files if name != "meta"}, meta
    except (MemoryError, OtherFormat):
        raise
    except Exception as error:  # damage can surface as almost anything: zlib, zipfile, struct, NumPy, JSON
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(f"{path}: damaged or not one of our files ({reason})") from None
