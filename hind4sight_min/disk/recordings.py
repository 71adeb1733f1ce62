"""Recordings: a folder of pictures as a camera took them. `hind4sight import` makes a data set of one, `hind4sight
export` one of a data set. What is in the folder: docs/own-data.md.
"""
import csv
import json
import struct
from dataclasses import dataclass, field, fields
from pathlib import Path

import cv2
import numpy as np

from .. import check_whole
from .files import whole_file, write_json, write_text
from .shards import DEPTH_UNIT, counts_of

CAMERA, POKES, EMPTY = "camera.json", "pokes.csv", "empty_depth"
NEEDED = "width", "height", "camera_matrix", "depth_unit"
COLUMNS = ("name", "target_x", "target_y", "direction", "start_x", "start_y")
SETTINGS = {"arena": 0.5, "cell": 0.025, "poke_length": [0.10, 0.14], "finger_radius": 0.01}  # m
SHAPES = {"camera_matrix": [(3, 3)], "distortion": [(count,) for count in (0, 4, 5, 8, 12, 14)], "depth_unit": [()],
          "arena_from_camera": [(4, 4)], "origin": [(2,)]}
MOST_SIDE = 5.0  # m, of an arena: larger ones are told in mm
MOST_TEXT = 100e6  # bytes


def _numbers(name, value, *shapes):
    """`value` as an array. Raises ValueError unless it is finite numbers of one of these shapes."""
    try:
        found = np.array(value, float)
    except (TypeError, ValueError):
        found = np.array(np.nan)
    if found.shape not in shapes or not np.isfinite(found).all():
        raise ValueError(f"{name}: expected finite numbers of shape {' or '.join(map(str, shapes))}, got {value!r}")
    return found


@dataclass(frozen=True)
class Recording:
    """M pokes as a camera recorded them. Not in the paper, whose pictures are a simulator's.

    folder: of the pictures. names (M,): of the pokes. pokes (M, 3), starts (M, 2) float32: as in Interactions.
    width, height: of every picture, px. camera_matrix (3, 3), distortion (0, 4, 5, 8, 12 or 14,): as OpenCV has them.
    depth_unit: m per count. arena_from_camera (4, 4), or None where it is to be found in the empty picture; the arena's
    origin is then where the pixel `origin` (2,) shows the table, that in the middle if not given.
    settings, seed: as in the meta of Interactions. Raises ValueError naming what cannot be.
    """
    folder: Path
    names: list
    pokes: np.ndarray
    starts: np.ndarray
    width: int
    height: int
    camera_matrix: np.ndarray
    depth_unit: float
    distortion: np.ndarray = ()
    arena_from_camera: np.ndarray = None
    origin: np.ndarray = None
    settings: dict = field(default_factory=dict)
    seed: int = None

    def __post_init__(self):
        if not isinstance(self.settings, dict):
            raise ValueError(f"settings: expected names and values, got {self.settings!r}")
        object.__setattr__(self, "settings", {**SETTINGS, **self.settings})
        for name, value in SETTINGS.items():
            if not (0 < _numbers(f"settings: {name}", self.settings[name], np.shape(value))).all() or (
                    np.max(self.settings[name]) > MOST_SIDE):
                raise ValueError(f"settings: {name}: expected above 0 and up to {MOST_SIDE:g} m, got "
                                 f"{self.settings[name]}")
        side = self.settings["arena"]
        for name in ("width", "height"):
            check_whole(name, getattr(self, name), 1, 10_000)
        for name, shapes in SHAPES.items():
            value = getattr(self, name)
            if value is not None or name not in ("arena_from_camera", "origin"):
                object.__setattr__(self, name, _numbers(name, value, *shapes))
        if not self.depth_unit > 0:
            raise ValueError(f"depth_unit: expected m per count, above 0, got {self.depth_unit}")
        (fx, skew, _), (below, fy, _), last = matrix = self.camera_matrix
        if skew or below or last.tolist() != [0, 0, 1] or not min(fx, fy) > 0:
            raise ValueError(f"camera_matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {matrix.tolist()}")
        if not 0.1 < fx / self.width < 100:
            raise ValueError(f"camera_matrix: expected fx in pixels of these pictures, {self.width} wide, got {fx:g}")
        if self.origin is not None and self.arena_from_camera is not None:
            raise ValueError("origin: expected none beside arena_from_camera, which says where it is")
        for name, poke, start in zip(self.names, self.pokes, self.starts):
            if not np.abs([*poke[:2], *start]).max() <= side:
                raise ValueError(f"poke {name}: expected start and target within {side:g} m of the middle, got "
                                 f"{start} and {poke[:2]}")
            ahead = np.arctan2(*(poke[:2] - start)[::-1])
            if not np.cos(poke[2] - ahead) > 0.98 or abs(poke[2]) > 7:  # degrees may agree by chance
                raise ValueError(f"poke {name}: expected its direction, from start to target, to be {ahead:.3f} rad, "
                                 f"got {poke[2]:g}")

    def picture(self, name):
        """One picture by its name: colour (H, W, 3) uint8, red first; one called depth (H, W) uint16, in counts.

        Raises ValueError naming the file that is no such PNG, and before it is unpacked one of another size.
        """
        path, deep = self.folder / f"{name}.png", name.endswith("depth")
        if not path.is_file():
            raise ValueError(f"{path}: no such file")
        with open(path, "rb") as file:
            head = file.read(26)
        if len(head) < 26 or head[:8] != b"\x89PNG\r\n\x1a\n":
            raise ValueError(f"{path}: expected a PNG")
        *found, kind = struct.unpack(">IIBB", head[16:])
        kind = {0: "grey", 2: "colour", 6: "colour"}.get(kind, "another kind")  # 6 has an alpha channel too
        expected = [self.width, self.height, 16, "grey"] if deep else [self.width, self.height, 8, "colour"]
        if [*found, kind] != expected:
            raise ValueError("{}: expected {} x {} pixels of {} bits, {}, got {} x {} of {} bits, {}".format(
                path, *expected, *found, kind))
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED if deep else cv2.IMREAD_COLOR_RGB)
        if picture is None:
            raise ValueError(f"{path}: damaged")
        return picture


def _text(path):
    """A text file of reasonable size."""
    if not path.is_file():
        raise ValueError("no such file")
    if path.stat().st_size > MOST_TEXT:
        raise ValueError(f"expected at most {MOST_TEXT / 1e6:.0f} MB")
    return path.read_text(encoding="utf-8-sig")  # what spreadsheets write


def _rows(text):
    """The text of POKES -> names (M,), numbers (M, 5) float32."""
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    if sorted(reader.fieldnames or ()) != sorted(COLUMNS):
        raise ValueError(f"expected columns {', '.join(COLUMNS)}, got {', '.join(reader.fieldnames or ['none'])}")
    found = {}
    for row in reader:
        name = row["name"]
        if not name or Path(name).name != name or name in found:
            raise ValueError(f"line {reader.line_num}: expected a name of its own, of files here, got {name!r}")
        try:
            found[name] = [float(row.pop(column)) for column in COLUMNS[1:]]
            if len(row) > 1:  # more columns than the heading has: decimal commas, perhaps
                raise ValueError
        except (TypeError, ValueError):
            raise ValueError(f"line {reader.line_num}: expected a name and five numbers") from None
    if not found:
        raise ValueError("expected a poke at least")
    with np.errstate(over="ignore"):  # to infinity, which is in no arena
        return list(found), np.array(list(found.values()), np.float32)


def load_recording(folder):
    """The recording in a folder -> Recording. Raises ValueError naming the file and what is wrong with it."""
    path = Path(folder) / CAMERA
    try:
        entries, known = json.loads(_text(path)), [each.name for each in fields(Recording)][4:]
        if not isinstance(entries, dict):
            raise ValueError(f"expected names and values, got {str(entries):.99}")
        if set(entries) - set(known):
            raise ValueError(f"expected no other entries than {', '.join(known)}, got {', '.join(entries)}")
        if not {*NEEDED} <= set(entries):
            raise ValueError(f"expected {', '.join(NEEDED)} at least, got {', '.join(entries) or 'none'}")
        path = Path(folder) / POKES
        names, values = _rows(_text(path))
        path = Path(folder)
        return Recording(path, names, values[:, :3], values[:, 3:], **entries)
    except (TypeError, ValueError, RecursionError, csv.Error) as error:
        raise ValueError(f"{path}: {error}") from None


def save_recording(folder, parts):
    """Write the parts of a data set, Interactions each, as one recording; the unit of depth is DEPTH_UNIT -> how many
    pokes. Raises ValueError for a folder with anything in it. However it fails, no picture is left.
    """
    folder, rows, written = Path(folder), [], []
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder}: expected a new or an empty folder")

    def write(name, picture):
        written.append(folder / f"{name}.png")
        with whole_file(written[-1]) as temporary:
            temporary.write_bytes(cv2.imencode(".png", picture)[1])
    try:
        for part in parts:
            for i in range(len(part)):
                name = f"{len(rows):04d}"
                for when in ("before", "after"):
                    write(f"{name}_{when}", getattr(part, f"rgb_{when}")[i][..., ::-1])
                    write(f"{name}_{when}_depth", counts_of(getattr(part, f"depth_{when}")[i]))
                rows.append(",".join([name, *(repr(float(value)) for value in (*part.pokes[i], *part.starts[i]))]))
        camera = part.camera
        write(EMPTY, counts_of(part.empty_depth))
        written.append(folder / POKES)
        write_text(written[-1], "\n".join([",".join(COLUMNS), *rows]) + "\n")
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        write_json(folder / CAMERA, {  # last, so that there is no half recording
            "width": camera.width, "height": camera.height, "camera_matrix": matrix, "depth_unit": DEPTH_UNIT,
            "distortion": [], "arena_from_camera": camera.plain["arena_from_camera"], "settings": part.settings,
            "seed": part.meta.get("seed")})
    except BaseException:  # an interrupt, a full disk, a damaged shard: then the folder is as it was
        for path in written:
            path.unlink(missing_ok=True)
        raise
    return len(rows)
