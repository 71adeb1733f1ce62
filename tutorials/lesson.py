"""What every tutorial needs: its data, a place for its pictures, and a closing check that can fail."""
import argparse
import sys
from pathlib import Path

from hind4sight_min.disk.files import whole_file  # before NumPy is loaded: the package sets the number of BLAS threads
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab.cli import data_small
from hind4sight_min.sim.truth import load_truth

import matplotlib  # noqa: E402

STEPPING = "ipykernel" in sys.modules  # in an editor, cell by cell: pictures appear there by themselves


def begin(name):
    """The options of the tutorial `name` -> Namespace with name, out (Path), show and quick."""
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent.parent / "runs" / "tutorials",
                        help="folder for the pictures (runs/tutorials in the clone)")
    parser.add_argument("--show", action="store_true", help="open a window for every picture")
    parser.add_argument("--quick", action="store_true", help="a smaller budget: the same lesson in less time")
    options = parser.parse_args([] if STEPPING else None)
    if not (options.show or STEPPING):
        matplotlib.use("Agg")
    options.name = name
    return options


def keep(options, figure, name):
    """Save a figure as OUT/NN_name.png and, with --show, open it."""
    import matplotlib.pyplot as plt
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{options.name[:2]}_{name}.png"
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100)
    print(f"   picture: {path.name}")
    if not plt.fignum_exists(getattr(figure, "number", None)):  # one of the package's figures: pyplot shows its picture
        if not (options.show or STEPPING):
            return
        figure = plt.figure(figsize=figure.get_size_inches(), layout="tight")
        plt.imshow(plt.imread(path))
        plt.axis("off")
    if options.show:
        plt.show()
    if not STEPPING:
        plt.close(figure)


def pokes(part="test"):
    """The shipped pokes, data_small/train or /test -> Interactions, Truth."""
    folder = data_small() / part
    return load_interactions(folder), load_truth(folder)


def check(what, got, expected=None, *, within=None, above=None, below=None):
    """Print what was expected and what came out, and stop if they differ.

    Either `expected` to a tolerance `within`, or a bound: `above` or `below` (both: between them).
    """
    if expected is not None:
        passed, wanted = abs(got - expected) <= within, f"{expected:.4g} within {within:g}"
    else:
        passed = (above is None or got > above) and (below is None or got < below)
        wanted = " and ".join(f"{word} {value:g}" for word, value in (("above", above), ("below", below))
                              if value is not None)
    print(f"   {what}: expected {wanted}, got {got:.4g}")
    assert passed, f"{what}: expected {wanted}, got {got:.4g}"
