"""A model's error by what met what: `hind4sight reproduce contact`. Not in the paper, which says that its model "models
collisions better" and has one figure for all pokes.

Beside it stands the simulator's own error, its finger ASIDE: what nobody can know who is told a poke no more exactly.
"""
from dataclasses import replace
from functools import partial

import numpy as np

from .. import check_whole
from ..disk.shards import SHARD_POKES
from ..sim.arena import MIDDLE, Arena, Settings
from ..sim.collection import collect_shard
from .control import settings_for
from .evaluation import errors_of_poke, ratio_of, scenes_of_pokes, true_motion
from .tables import CROWDED, table

ASIDE = 0.002  # m, to the left of the poke; `Arena.descent_is_free` leaves so much room
WALLS = {1, 2, 3, 4}  # Bullet's numbers of them, as `Arena._build` makes them
SEED = 900001

# name -> (what the table says, which of the pokes that moved something belong to it; None: those of CROWDED)
GROUPS = {
    "": ("all", lambda poke: True),
    "free_": ("one object, no contact, no wall", lambda poke: poke["free"]),
    "contact_": ("a moved object touches another", lambda poke: poke["contact"]),
    "multi_": ("two or more objects move", lambda poke: len(poke["iou"]) > 1),
    "wall_": ("a moved object hits a wall", lambda poke: poke["wall"]),
    "bracket_": ("brackets, no contact, no wall", lambda poke: poke["free"] and poke["kinds"] == ["bracket"]),
    "crowded_": ("6 or 7 objects all over the arena", None),
}


class WatchedArena(Arena):
    """An Arena that notes of every poke which pairs of bodies pressed on each other and, having undone it, where the
    objects end with the finger ASIDE. notes: {(poses before, poke) as bytes: (pairs, bodies, kinds, poses)}, filled.
    """
    pressed = None

    def __init__(self, settings, rng, notes):
        super().__init__(settings, rng)
        self.notes = notes

    def _step(self, count):
        for _ in range(count):
            super()._step(1)
            if self.pressed is not None:
                self.pressed |= {frozenset(each[1:3]) for each in self.bullet.getContactPoints() if each[9] > 0}  # N

    def poke(self, poke, start):
        bullet, key, before, self.pressed = self.bullet, key_of(self.poses(), poke), self.bullet.saveState(), set()
        at_rest, pressed, self.pressed = super().poke(poke, start), self.pressed, None
        after, aside = bullet.saveState(), ASIDE * np.array([-np.sin(poke[2]), np.cos(poke[2])])
        bullet.restoreState(before)
        super().poke(poke + np.append(aside, 0), start + aside)
        self.notes[key] = pressed, self.bodies, self.kinds, self.poses()
        bullet.restoreState(after)  # to some micrometres: these are pokes like those of `collect`, not the same ones
        for state in (before, after):
            bullet.removeState(state)
        return at_rest


def key_of(poses, poke):
    """What tells a poke from the others of its world: where the objects lay, (7, 7) float32, and the poke (3,)."""
    return poses.tobytes(), poke.tobytes()


def watched_pokes(run, settings, seed, job):
    """The pokes of one shard, job = (index, how many) -> the dicts of `errors_of_poke`, each with contact, wall and
    free (bool), the kinds of what moved, squared_aside (m^2) and its scene.
    """
    notes, found = {}, []
    interactions, truth = collect_shard(settings, seed, *job, partial(WatchedArena, notes=notes))
    for row, scene in enumerate(scenes_of_pokes(truth)):
        pressed, bodies, kinds, poses = notes[key_of(truth.poses_before[row], interactions.pokes[row])]
        flow, _, moving = true_motion(interactions, truth, row)
        ends = truth.poses_after.copy()
        ends[row] = poses
        aside, _, _ = true_motion(interactions, replace(truth, poses_after=ends), row)
        moved = [label - 1 for label in np.unique(truth.labels[row].ravel()[moving]) if label > 0]
        pairs = [pair for pair in pressed if pair & {bodies[i] for i in moved}]
        contact, wall = any(pair <= set(bodies) for pair in pairs), any(pair & WALLS for pair in pairs)
        found.append({**errors_of_poke(run, interactions, truth, row), "contact": contact, "wall": wall,
                      "free": len(moved) == 1 and not contact and not wall, "kinds": [kinds[i] for i in moved],
                      "squared_aside": np.sum((aside - flow)[moving] ** 2), "scene": job[0] * SHARD_POKES + scene})
    return found


def reproduce(run, pokes, map=map, progress=None):
    """The table from so many fresh pokes, and as many of CROWDED -> `summarise`'s figures. map: as of `collect`.
    progress(done, total) is called after every shard. Raises ValueError for numbers that cannot be.
    """
    check_whole("pokes", pokes, 1)
    todo = [(first // SHARD_POKES, min(SHARD_POKES, pokes - first)) for first in range(0, pokes, SHARD_POKES)]
    found = [], []
    for each, settings in zip(found, (Settings(**MIDDLE), CROWDED)):
        for shard in map(partial(watched_pokes, run, settings_for(run, settings), SEED), todo):
            each += shard
            if progress:
                progress(sum(len(each) for each in found), 2 * pokes)
    return summarise(*found)


def summarise(pokes, crowded):
    """Dicts of `watched_pokes` -> flat dict. Of every group, over the pokes that moved something: pokes, how many;
    flow_mse_ratio and simulator_ratio, pooled; mask_iou; error_share of the squared error of `pokes`. An empty group
    has pokes alone.
    """
    pokes, crowded = ([poke for poke in each if len(poke["iou"])] for each in (pokes, crowded))
    result, total = {}, sum(poke["squared_error"] for poke in pokes)
    for name, (_, belongs) in GROUPS.items():
        group = [poke for poke in pokes if belongs(poke)] if belongs else crowded
        result[f"{name}pokes"] = len(group)
        if group:
            error, motion, aside, scenes = (np.array([poke[each] for poke in group]) for each in (
                "squared_error", "squared_motion", "squared_aside", "scene"))
            ratio, spread = ratio_of(error, motion, scenes)
            result.update({f"{name}flow_mse_ratio": ratio, f"{name}flow_mse_ratio_se": spread,
                           f"{name}simulator_ratio": aside.sum() / motion.sum(),
                           f"{name}mask_iou": np.mean(np.concatenate([poke["iou"] for poke in group]))})
            if belongs:
                result[f"{name}error_share"] = error.sum() / total
    return {name: float(value) for name, value in result.items()}


def contact_table(figures):
    """The figures as Markdown."""
    rows = [("pokes that move something", "share", "ratio", "IoU", "share of the squared error",
             f"the simulator, finger {1000 * ASIDE:.0f} mm to the side")]
    for name, (text, belongs) in GROUPS.items():
        of = {key.removeprefix(name): value for key, value in figures.items() if key.startswith(name)}
        if of["pokes"]:
            rows.append((text, f"{of['pokes'] / figures['pokes']:.1%}" if belongs else "",
                         f"{of['flow_mse_ratio']:.3f} \u00b1 {of['flow_mse_ratio_se']:.3f}", f"{of['mask_iou']:.2f}",
                         f"{of['error_share']:.0%}" if belongs else "", f"{of['simulator_ratio']:.3f}"))
    return table(*rows)
