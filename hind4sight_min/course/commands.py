"""`hind4sight course list | start NAME --out DIR`."""
from . import ASSIGNMENTS, assignment_of
from .carve import start


def run_course(args):
    """`course list`: the assignments; `course start`: one of them, into an empty folder."""
    if args.action == "list":
        for each in ASSIGNMENTS:
            print(f"{each.number}  {each.name:<12}{each.title}")
        return
    if args.name is None:
        raise ValueError("course start: expected the number or the name of an assignment; `course list` has them")
    assignment = assignment_of(args.name)
    out = args.out or assignment.name
    start(assignment, out)
    print(f"{out}/README.md says what to do.")
