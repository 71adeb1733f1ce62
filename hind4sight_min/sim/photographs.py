"""Photographs of recorded pokes: what the camera saw, in more pixels than the model gets. Not in the paper.

No data set holds them. The simulator puts the scenes up again and takes them; without it, a few of the shipped pokes
have theirs in data_small/photographs.npz, which `python docs/photographs.py` makes.
"""
import zlib
from functools import partial

import cv2
import numpy as np

from ..disk.files import load_npz, save_npz, shipped
from ..disk.shards import SHARD_POKES
from .arena import Arena, Settings
from .collection import collect_shard

FORMAT = "hind4sight_min photographs 1"
ALIKE = 2.0  # of 255, on average: poses on disk are rounded, so a picture taken again differs at some edges


class Replay(Arena):
    """An Arena where the recorded pokes of a shard go as they went, for photographs of the `wanted` rows.

    Objects and textures are drawn again, which takes the pokes to be drawn again too, from the same random numbers;
    where the objects then went is not simulated but read from the truth.
    """

    def __init__(self, recorded, truth, wanted, width, taken, settings, rng):
        self.recorded, self.truth, self.row = recorded, truth, 0
        self.wanted, self.width, self.taken = wanted, width, taken
        super().__init__(settings, rng)

    def new_scene(self):
        super().new_scene()
        self.move_to(self.truth.poses_before[self.row])

    def sample_poke(self, rgb, depth):
        self.as_recorded = np.abs(rgb - self.recorded.rgb_before[self.row].astype(float)).mean() < ALIKE
        if self.as_recorded:  # what was seen then decides what is drawn
            rgb, depth = self.recorded.rgb_before[self.row], self.recorded.depth_before[self.row]
        return super().sample_poke(rgb, depth)

    def poke(self, poke, start):
        row = self.row
        if not (self.as_recorded and np.array_equal(poke, self.recorded.pokes[row])):
            return False  # one that was dropped
        if row in self.wanted:
            self.taken[row] = (self.photograph(width=self.width),
                               self.photograph(self.truth.poses_after[row], self.width))
        self.move_to(self.truth.poses_after[row])
        self.row += 1
        return True


def photographs(interactions, truth, rows, width=640):
    """Photographs of recorded pokes -> {row: (before, after)}, pictures (h, w, 3) uint8, of those rows that have any.

    A few shipped pokes have some, and where pybullet is installed every simulated one whose truth is given, not None.
    width: of a picture, about, in px; the shipped ones are as they are.
    """
    found = _read(interactions, rows)
    if truth is None or not {"seed", "shard"} <= set(interactions.meta):
        return found
    for shard in sorted({row // SHARD_POKES for row in rows if row not in found}):
        first, taken = shard * SHARD_POKES, {}
        wanted = {row - first for row in rows if row // SHARD_POKES == shard}
        count = max(wanted) + 1
        part = slice(first, first + count)
        try:
            settings = Settings(**{name: tuple(value) if isinstance(value, list) else value
                                   for name, value in interactions.settings.items()})
            collect_shard(settings, interactions.meta["seed"], interactions.meta["shard"] + shard, count,
                          partial(Replay, interactions[part], truth[part], wanted, width, taken))
        except (RuntimeError, TypeError, ValueError):  # no pybullet, or another simulator than these pokes are from
            pass
        found.update({first + row: pair for row, pair in taken.items()})
    return found


# --- the file of shipped ones -------------------------------------------------------------------------------------

def key_of(picture):
    """What a photograph is filed under: a checksum of the small picture (H, W, 3) uint8 that the model gets."""
    return f"{zlib.crc32(np.ascontiguousarray(picture)):08x}"


def keep(path, interactions, found):
    """Write what `photographs` found to a file; a picture that two pokes share is kept once."""
    files = {}
    for row, pair in found.items():
        for small, picture in zip((interactions.rgb_before[row], interactions.rgb_after[row]), pair):
            files[key_of(small)] = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 85])[1]
    save_npz(path, files, {"format": FORMAT})


def _read(interactions, rows):
    """The shipped photographs of these rows, as `photographs` gives them."""
    path = shipped("data_small/photographs.npz")
    files = load_npz(path, FORMAT)[0] if path.is_file() else {}
    keys = {row: (key_of(interactions.rgb_before[row]), key_of(interactions.rgb_after[row])) for row in rows}
    return {row: tuple(cv2.imdecode(files[key], cv2.IMREAD_COLOR)[..., ::-1] for key in pair)
            for row, pair in keys.items() if set(pair) <= set(files)}
