"""`python -m hind4sight_min` is the `hind4sight` command: see lab/cli.py. Here is what it needs of its surroundings."""
import os
import signal
import sys


class Terminated(KeyboardInterrupt):
    """SIGTERM: everything is put away as for an interrupt."""
    status = 143


def terminate(*_):
    """What SIGTERM does."""
    raise Terminated


def main():
    """Run the command -> exit status: 130 after an interrupt, 143 after SIGTERM, even while it still imports."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or open(os.devnull, "w")  # a closed one
        stream.reconfigure(errors="replace")  # a terminal that lacks a character
        setattr(sys, name, stream)
    os.environ.pop("MPLBACKEND", None)  # a notebook's, which we have no use for and perhaps not installed
    signal.signal(signal.SIGTERM, terminate)
    try:
        from .lab.cli import main
        status = main()
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # who read our output, `head` for one, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt as interrupt:
        print("\nhind4sight: stopped", file=sys.stderr)
        return getattr(interrupt, "status", 130)


if __name__ == "__main__":
    sys.exit(main())
