"""`hind4sight course list | start NAME --out DIR`."""
from . import ASSIGNMENTS


def run_course(args):
    """`course list`: the assignments; `course start`: one of them, into an empty folder."""
    if args.action == "list":
        for assignment in ASSIGNMENTS:
            print(f"{assignment.number}  {assignment.name:<12}{assignment.title}")
