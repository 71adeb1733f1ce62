"""`hind4sight grade DIR` and `hind4sight grade --all DIR --csv FILE --assignment N`."""
import hashlib
import os
import secrets
import stat
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from ..disk.files import write_text
from ..lab.processes import cluster_map
from . import ASSIGNMENTS, assignment_of, grading, sandbox


def run_grade(args):
    """Grade one submission, or with --all a folder of them."""
    if (args.folder is None) == (args.all is None) or (args.all is None) != (args.csv is None):
        raise ValueError("grade: expected either a submission, or --all FOLDER and --csv FILE")
    if Path(args.out).suffix != ".json":
        raise ValueError(f"--out: expected a file .json, got {args.out}")
    if args.all is None:
        assignment = assignment_of(args.assignment) if args.assignment else assignment_in(args.folder)
        expect_pokes(assignment, args)
        how = grading.How(None if args.public else seed_from(args.seed), pokes=args.pokes)
        content, note = None, ""
        try:
            content, _, _ = grading.find_submission(args.folder, f"{assignment.name}.py")
        except Exception as error:  # whatever it is, results.json says so
            note = sandbox.one_line(error)
        results = grading.grade(grading.items_of(assignment, how), content, args.out, args.task, note)
        print(grading.table(results))
        return
    if not args.assignment or args.task or args.public:
        raise ValueError("grade --all: expected --assignment N, and neither --task nor --public")
    if Path(args.csv).resolve().is_relative_to(Path(args.all).resolve()):
        raise ValueError(f"--csv: expected a file outside of {args.all}, where what lies beside it is a student's")
    expect_pokes(assignment_of(args.assignment), args)
    seed = args.seed or kept_seed(grading.results_folder(args.csv) / "seed")
    how = grading.How(seed_from(seed), pokes=args.pokes and os.path.abspath(args.pokes))
    with (cluster_map(args.cluster) if args.cluster else threads_map(args.jobs)) as map:
        rows = grading.grade_all(args.all, assignment_of(args.assignment), how, args.csv, map, print_row)
    print(f"{args.csv}: {len(rows)} students")


@contextmanager
def threads_map(jobs):
    """A `map` over threads: what students wrote runs in processes of its own anyway."""
    with ThreadPoolExecutor(jobs) as pool:
        yield pool.map


def expect_pokes(assignment, args):
    """Raises ValueError where assignment 8 would be scored on pokes that students have."""
    if assignment.name == "improve" and not (args.pokes or args.public):
        raise ValueError("--pokes: expected pokes that students do not have, `collect` makes some; or --public")


def print_row(row, results):
    """One line on a student."""
    print(f"{row['student']:<34}{row['score']:>6g} of {row['of']:<4g} {row['note']}", flush=True)


def assignment_in(path):
    """The one assignment whose file a submission holds. Raises ValueError where that is not clear."""
    def holds(name):
        if Path(path).suffix == ".py":
            return Path(path).name == name
        try:
            return bool(grading.find_submission(path, name))
        except ValueError:
            return False
    found = [assignment for assignment in ASSIGNMENTS if holds(f"{assignment.name}.py")]
    if len(found) != 1:
        raise ValueError(f"--assignment: expected its number, for there are the files of {len(found)} in {path}")
    return found[0]


def seed_from(text):
    """A number, or the contents of a file, as the seed of held-back inputs; nothing: drawn now, told to nobody."""
    if not text:
        return secrets.randbits(64)
    if str(text).isdigit():
        return int(text)
    path = Path(text)
    if not path.is_file():
        raise ValueError(f"--seed: expected a whole number or a file, got {text}")
    if os.getuid() == 0 and path.stat().st_mode & stat.S_IROTH and path.parent.stat().st_mode & stat.S_IXOTH:
        raise ValueError(f"--seed: every user can read {path}, the students' code too; chmod 600 it")
    return int.from_bytes(hashlib.sha256(path.read_bytes()).digest()[:8], "little")


def kept_seed(path):
    """A file with a seed, drawn when there is none yet, so that a class goes on with the inputs it began with."""
    if not path.is_file():
        write_text(path, secrets.token_hex(16))  # never an empty one
        path.chmod(0o600)
    return path
