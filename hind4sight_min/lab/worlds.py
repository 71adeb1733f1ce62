"""What the explorer pokes: the simulator, or the pokes of a data set where there is none. Not in the paper."""
from importlib.util import find_spec

import numpy as np

from .. import check_whole
from ..disk.files import data_small
from ..disk.shards import load_interactions
from ..planning import NoPoke
from ..sim.arena import Arena, Settings
from ..sim.photographs import photographs
from ..sim.truth import find_truth, true_scene_flow
from .control import carry_out, settings_for
from .evaluation import scenes_of_pokes, true_motion


class Simulated:
    """Random scenes in the simulator. Raises RuntimeError without pybullet.

    next: puts down another scene. look: what the camera sees -> rgb (H, W, 3) uint8, depth (H, W) m, and rgb again for
    people, (s H, s W, 3). poke: carries out a poke (3,) -> what was carried out, its start (2,) m, and the true scene
    flow (N, 3) m, None where nobody knows it. undo: takes the last poke back; history: those that can be. suggested: a
    poke to begin with, or None. demo: a script of the explorer's, for the scene of seed 0.
    """
    suggested = None
    demo = """
        drag 43 21 50 24 50 18 43 14 37 15 34 19
        wait 1
        key space
        wait 3
        goal 20 15 30 22
        wait 1
        key p
        wait 1
        key space
        wait 2
        key p
        wait 1
        key space
        wait 3
    """

    def __init__(self, settings, seed):
        self.arena = Arena(settings, np.random.default_rng(seed))
        self.camera, self.empty_depth, self.settings = self.arena.camera, self.arena.empty_depth, vars(settings)
        self.next()

    def next(self):
        self.arena.new_scene()
        self.history = []
        self._see()

    def _see(self):
        self.seen = *self.arena.observe(), self.arena.photograph()

    def look(self):
        rgb, depth, _, photograph = self.seen
        return rgb, depth, photograph

    def poke(self, view, poke):
        state, before, labels = self.arena.bullet.saveState(), self.arena.poses(), self.seen[2].ravel()
        start = carry_out(self.arena, view, poke, self.settings)
        if np.isnan(start).any():
            raise NoPoke("There is no room for the finger to come down: turn the arrow.")
        self.history.append((state, self.seen))
        self._see()
        return poke, start, true_scene_flow(view.cloud[:len(labels)], labels, before, self.arena.poses())

    def undo(self):
        state, self.seen = self.history.pop()
        self.arena.bullet.restoreState(state)


class Recorded:
    """The pokes of a data set, with the methods of Simulated: the model can be asked about any poke, but the one that
    is played is the recorded one. rows: of the scene's pokes that are still to be played.
    """
    demo = """
        drag 17 36 26 38 26 33 20 29 26 33
        wait 1
        key space
        wait 3
        goal 17 36 28 30
        wait 1
        key p
        wait 3
    """

    def __init__(self, interactions, truth, seed):
        self.interactions, self.truth, self.camera = interactions, truth, interactions.camera
        self.empty_depth, self.settings = interactions.empty_depth, {**vars(Settings()), **interactions.settings}
        self.scenes = np.arange(len(interactions)) if truth is None else scenes_of_pokes(truth)
        self.photographs = photographs(interactions, None, range(len(interactions)))  # shipped ones: few
        self.scene = seed - 1
        self.next()

    def next(self):
        self.scene = (self.scene + 1) % (self.scenes[-1] + 1)
        self.rows, self.history = list(np.flatnonzero(self.scenes == self.scene)), []

    def look(self):
        data = self.interactions
        row, when = (self.rows[0], "before") if self.rows else (self.history[-1], "after")
        rgb, depth = (getattr(data, f"{name}_{when}")[row] for name in ("rgb", "depth"))
        return rgb, depth, dict(zip(("before", "after"), self.photographs.get(row, ()))).get(when, rgb)

    @property
    def suggested(self):
        return self.interactions.pokes[self.rows[0]] if self.rows else None

    def poke(self, view, poke):
        if not self.rows:
            raise NoPoke("This scene's last recorded poke was played: n goes to the next scene.")
        self.history.append(self.rows.pop(0))
        row, data = self.history[-1], self.interactions
        return data.pokes[row], data.starts[row], self.truth and true_motion(data, self.truth, row)[0]

    def undo(self):
        self.rows.insert(0, self.history.pop())


def world_of(run, data, seed):
    """The pokes of the folder `data`; of None the simulator, or the shipped pokes where pybullet is not installed."""
    check_whole("seed", seed, 0)
    if data is None and find_spec("pybullet"):
        return Simulated(settings_for(run), seed)
    data = data or data_small() / "test"
    return Recorded(load_interactions(data), find_truth(data), seed)
