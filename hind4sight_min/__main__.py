"""`python -m hind4sight_min` is the `hind4sight` command: see lab/cli.py."""
import sys

from .lab.cli import main

if __name__ == "__main__":
    sys.exit(main())
