"""What every lesson needs: its data, a place for its pictures, and closing checks that can fail."""
import argparse
import importlib
import sys
from pathlib import Path

from hind4sight_min.disk.files import whole_file  # before NumPy is loaded: the package sets the number of BLAS threads
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab.cli import data_small
from hind4sight_min.sim.truth import load_truth

import matplotlib  # noqa: E402

STEPPING = "ipykernel" in sys.modules  # in an editor, cell by cell: pictures appear there by themselves
ROOT = Path(__file__).resolve().parent.parent
passed, failed = [], []  # what the checks of this lesson have found so far


def begin(name):
    """The options of the lesson `name` -> Namespace with name, out (Path), show and quick."""
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "tutorials",
                        help="folder for the pictures (runs/tutorials in the clone)")
    parser.add_argument("--show", action="store_true", help="open a window for every picture")
    parser.add_argument("--quick", action="store_true", help="a smaller budget: the same lesson in less time")
    options = parser.parse_args([] if STEPPING else None)
    if not (options.show or STEPPING):
        matplotlib.use("Agg")
    options.name = name
    return options


def keep(options, figure, name, dpi=100):
    """Save a figure as OUT/NN_name.png and, with --show, open it."""
    import matplotlib.pyplot as plt
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{options.name[:2]}_{name}.png"
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi)
    say_where(path)
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


def say_where(path):
    """Print where a picture is, as seen from the folder one is in."""
    path = path.resolve()
    print(f"   picture: {path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}")


def pokes(part="test"):
    """The shipped pokes, data_small/train or /test -> Interactions, Truth."""
    folder = data_small() / part
    return load_interactions(folder), load_truth(folder)


def architecture():
    """The script docs/architecture.py as a module: it draws the model, box by box."""
    sys.path.append(str(ROOT / "docs"))
    return importlib.import_module("architecture")


def check(what, got, expected=None, *, within=None, above=None, below=None):
    """Print what was expected and what came out, and remember whether they agree.

    Either `expected` to a tolerance `within`, or a bound: `above` or `below` (both: between them).
    """
    if expected is not None:
        good, wanted = abs(got - expected) <= within, f"{expected:.4g} within {within:g}"
    else:
        good = (above is None or got > above) and (below is None or got < below)
        wanted = " and ".join(f"{word} {value:g}" for word, value in (("above", above), ("below", below))
                              if value is not None)
    line = f"{what}: expected {wanted}, got {got:.4g}"
    print(f"   {line}" if good else f"   FAILED: {line}")
    (passed if good else failed).append(line)


def end(options):
    """The last line: all checks passed, or which ones did not, and then exit status 1."""
    wrong, count = failed.copy(), len(failed + passed)
    failed.clear(), passed.clear()  # in an editor the cells may run again
    if wrong:
        sys.exit("\n   ".join([f"{options.name}: {len(wrong)} of {count} checks failed", *wrong]))
    print(f"{options.name}: all checks passed")
