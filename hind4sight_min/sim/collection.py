"""Collection: shards of pokes, each in a Bullet world with its own seed. Paper: Sec. IV-A and IV-B."""
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np

from .. import check_whole
from ..disk.files import claim, clear_away, plain
from ..disk.shards import SHARD_POKES, find_shards, load_shard, save_shard
from ..interactions import Interactions
from .arena import Arena, Settings
from .truth import Truth, save_truth, truth_path

MOST_POKES = 1_000_000  # shards are numbered with four digits


def collect_shard(settings, seed, index, pokes, world=None):
    """Collect one shard -> (Interactions, Truth). The same arguments give the same data. world: what makes the
    world, an Arena if not given.

    Interactions are dropped, and counted in meta["counts"], when an object left the arena, is out of the camera's
    sight, or never came to rest. Raises ValueError for settings under which that is nearly always so.
    """
    kept, counts = [], Counter(kept=0, left_arena=0, out_of_view=0, not_at_rest=0, no_free_start=0)
    with (world or Arena)(settings, np.random.default_rng([seed, index])) as arena:
        left = 0  # pokes that the scene is still good for
        while len(kept) < pokes:
            if not left:
                arena.new_scene()
                left, after = settings.pokes_per_scene, (*arena.observe(), arena.poses())
            before, drawn, outcome = after, arena.sample_poke(*after[:2]), "no_free_start"
            if drawn:
                at_rest = arena.poke(*drawn)
                after = *arena.observe(), arena.poses()
                outcome = _outcome(before, after, len(arena.bodies), at_rest, settings)
            left = left - 1 if outcome == "kept" else 0
            if outcome == "kept":
                kept.append((before, after, *drawn))
            counts[outcome] += 1
            if counts.total() > 20 * (len(kept) + 10):
                raise ValueError(f"settings: hardly a poke can be used ({dict(counts)})")
    befores, afters, drawn, starts = zip(*kept)
    rgb_before, depth_before, labels, poses_before = map(np.stack, zip(*befores))
    rgb_after, depth_after, _, poses_after = map(np.stack, zip(*afters))
    meta = plain({"seed": seed, "shard": index, "settings": settings.plain, "counts": dict(counts)})
    interactions = Interactions(rgb_before, rgb_after, depth_before, depth_after, np.stack(drawn), np.stack(starts),
                                arena.empty_depth, arena.camera, meta)
    return interactions, Truth(labels, poses_before, poses_after)


def _outcome(before, after, count, at_rest, settings):
    """What became of a poke among `count` objects; frames are (rgb, depth, labels, poses)."""
    poses = after[3][:count]
    if np.abs(poses[:, :2]).max() > settings.arena / 2 or poses[:, 2].min() < 0:
        return "left_arena"
    if not at_rest:
        return "not_at_rest"
    seen = [np.isin(np.arange(1, count + 1), labels).all() for labels in (before[2], after[2])]
    return "kept" if all(seen) else "out_of_view"


def _collect_file(settings, seed, path, job):
    index, pokes = job
    interactions, truth = collect_shard(settings, seed, index, pokes)
    save_truth(path, truth, interactions)  # first, so that a shard never lacks its truth
    save_shard(path, interactions)
    return interactions.meta["counts"]


def collect(folder, pokes, seed, settings=Settings(), map=map, progress=None, part=(1, 1)):
    """Collect `pokes` interactions into `folder`; shards already there from the same call are kept.

    map: as Python's; that of an executor collects several shards at a time. progress(done, total) is called after every
    shard. part: (i, n) collects every n-th shard alone, from the i-th on; others, also at the same time and on other
    machines, the rest. Returns the counts of kept and dropped pokes, a dict.
    Raises ValueError for bad counts or a folder with other data in it.
    """
    check_whole("pokes", pokes, 1, MOST_POKES)
    check_whole("seed", seed, 0)
    check_whole("part: of how many", part[1], 1)
    check_whole("part", part[0], 1, part[1])
    folder, counts, jobs = Path(folder).absolute(), Counter(kept=0), {}
    for index, first in enumerate(range(0, pokes, SHARD_POKES)):
        jobs[folder / f"shard_{index:04d}.npz"] = index, min(SHARD_POKES, pokes - first)
    there, made_of = find_shards(folder), plain({"seed": seed, "settings": settings.plain})
    jobs_of_part = dict([*jobs.items()][part[0] - 1::part[1]])
    total = sum(size for _, size in jobs_of_part.values())
    for path in there:
        if path in jobs and path not in jobs_of_part:
            continue  # another's to judge
        old, (_, size) = load_shard(path), jobs.get(path, (None, 0))
        if (old.meta["seed"], old.settings, len(old)) != (seed, made_of["settings"], size):
            raise ValueError(f"{path}: holds data of another seed, other settings or another number of pokes")
        if truth_path(path).exists():
            counts.update(old.meta["counts"])
            del jobs_of_part[path]
    claim(folder / "collection.json", made_of)
    clear_away(folder.iterdir())
    try:
        for made in map(partial(_collect_file, settings, seed), jobs_of_part, jobs_of_part.values()):
            counts.update(made)
            if progress:
                progress(counts["kept"], total)
    except ValueError:  # such scenes cannot be: others shall have the folder
        if not find_shards(folder):
            (folder / "collection.json").unlink(missing_ok=True)
        raise
    return dict(counts)
