"""Files that are written whole or not at all, and arrays with a JSON header that are read with care."""
import json
import os
from contextlib import contextmanager
from pathlib import Path

import numpy as np


@contextmanager
def whole_file(path):
    """A temporary path that takes the place of `path` when the block ends well, and vanishes when it does not."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")  # the ending stays: libraries go by it
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path, text):
    """Write a text file, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text)


def write_json(path, figures):
    """Write plain JSON types, whole or not at all; nothing for no path."""
    if path:
        write_text(path, json.dumps(figures, indent=2, sort_keys=True) + "\n")


def plain(value):
    """`value` as JSON gives it back: lists for tuples, floats for NumPy's."""
    return json.loads(json.dumps(value, default=lambda other: other.tolist()))


def save_npz(path, arrays, meta):
    """Write arrays and one JSON text to a compressed .npz, whole or not at all."""
    with whole_file(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, meta=np.array(json.dumps(meta, sort_keys=True)), **arrays)


def load_npz(path, format):
    """Read what `save_npz` wrote: (dict of arrays, meta). Raises ValueError naming the file if it is damaged."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            if archive.zip.testzip():  # NumPy reads as far as a header says, and then looks at no checksum
                raise ValueError("a checksum differs")
            arrays = {name: archive[name] for name in archive.files}
        meta = dict(json.loads(str(arrays.pop("meta"))))
    except MemoryError:
        raise
    except Exception as error:  # damage can surface as almost anything: zlib, zipfile, struct, NumPy, JSON
        raise ValueError(f"{path}: damaged or not one of our files ({error or type(error).__name__})") from None
    if meta.get("format") != format:
        raise ValueError(f"{path}: expected format {format!r}, got {meta.get('format')!r}")
    return arrays, meta
