"""What the explorer pokes: the simulator, or the pokes of a data set where there is none. Not in the paper."""
from dataclasses import asdict

import numpy as np

from ..planning import NoPoke
from ..sim.arena import Arena, Settings
from ..sim.truth import true_scene_flow
from .control import carry_out
from .evaluation import scenes_of_pokes, true_motion


class Simulated:
    """Random scenes in the simulator. Raises RuntimeError without pybullet.

    next: puts down another scene. look: what the camera sees -> rgb (H, W, 3) uint8, depth (H, W) m. poke: carries out
    a poke (3,) -> what was carried out, its start (2,) m, and the true scene flow (N, 3) m, None where nobody knows it.
    undo: takes the last poke back; history: those that can be. suggested: a poke to begin with, or None.
    """
    suggested = None

    def __init__(self, settings, seed):
        self.arena = Arena(settings, np.random.default_rng(seed))
        self.camera, self.empty_depth, self.settings = self.arena.camera, self.arena.empty_depth, asdict(settings)
        self.next()

    def next(self):
        self.arena.new_scene()
        self.seen, self.history = self.arena.observe(), []

    def look(self):
        return self.seen[:2]

    def poke(self, view, poke):
        state, before, labels = self.arena.bullet.saveState(), self.arena.poses(), self.seen[2].ravel()
        start = carry_out(self.arena, view, poke, self.settings)
        if np.isnan(start).any():
            raise NoPoke("There is no room for the finger to come down: turn the arrow.")
        self.history.append((state, self.seen))
        self.seen = self.arena.observe()
        return poke, start, true_scene_flow(view.cloud[:len(labels)], labels, before, self.arena.poses())

    def undo(self):
        state, self.seen = self.history.pop()
        self.arena.bullet.restoreState(state)


class Recorded:
    """The pokes of a data set, with the methods of Simulated: the model can be asked about any poke, but the one that
    is played is the recorded one. rows: of the scene's pokes that are still to be played.
    """

    def __init__(self, interactions, truth, seed):
        self.interactions, self.truth, self.camera = interactions, truth, interactions.camera
        self.empty_depth, self.settings = interactions.empty_depth, {**asdict(Settings()), **interactions.settings}
        self.scenes = np.arange(len(interactions)) if truth is None else scenes_of_pokes(truth)
        self.scene = seed - 1
        self.next()

    def next(self):
        self.scene = (self.scene + 1) % (self.scenes[-1] + 1)
        self.rows, self.history = list(np.flatnonzero(self.scenes == self.scene)), []

    def look(self):
        data = self.interactions
        if self.rows:
            return data.rgb_before[self.rows[0]], data.depth_before[self.rows[0]]
        return data.rgb_after[self.history[-1]], data.depth_after[self.history[-1]]

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
