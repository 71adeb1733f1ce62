"""`hind4sight course list | start NAME --out DIR | bundle NAME --out FILE.zip`."""
from . import ASSIGNMENTS, assignment_of
from .bundle import write_bundle
from .carve import start


def run_course(args):
    """`course list`: the assignments; `start`: one of them, into an empty folder; `bundle`: its autograder."""
    if args.action == "list":
        for each in ASSIGNMENTS:
            print(f"{each.number}  {each.name:<12}{each.title}")
        return
    if args.name is None:
        raise ValueError(f"course {args.action}: expected an assignment's number or name; `course list` has them")
    assignment = assignment_of(args.name)
    if args.action == "bundle":
        out = args.out or f"{assignment.name}.zip"
        write_bundle(assignment, out, args.seed, args.pokes)
        print(f"{out}: the autograder to upload; keep it to yourself, it holds the seed of the held-back inputs")
        return
    out = args.out or assignment.name
    start(assignment, out)
    print(f"{out}/README.md says what to do.")
