"""Photographs of some shipped test pokes, for those who have no simulator: data_small/photographs.npz.

    python docs/photographs.py

Puts the scenes up again (needs pybullet) and takes them; a minute. The pokes: the first twenty, and the one that
`hind4sight show` shows.
"""
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab.cli import data_small, well_moved
from hind4sight_min.sim.photographs import keep, photographs
from hind4sight_min.sim.truth import load_truth

FIRST = 20


def main():
    interactions, truth = load_interactions(data_small() / "test"), load_truth(data_small() / "test")
    rows = sorted({*range(FIRST), well_moved(interactions, truth)})
    path = data_small() / "photographs.npz"
    path.unlink(missing_ok=True)  # else what it has would not be taken again
    found = photographs(interactions, truth, rows, width=320)
    keep(path, interactions, found)
    print(f"{path}: {len(found)} of {len(rows)} pokes, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
