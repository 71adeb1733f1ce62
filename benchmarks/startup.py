"""How long one waits for the package: its import, and the time to the first picture.

    python benchmarks/startup.py --json docs/results/startup.json

Each in fresh processes that take turns: Python alone, our import, that of PyTorch (if it is installed), and a whole
`hind4sight show` of the shipped checkpoint, which ends with a PNG on disk. Half a minute.
"""
import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hind4sight_min.interactions import write_json


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        picture = str(Path(folder) / "picture.png")
        commands = {"python": ["-c", ""],
                    "import": ["-c", "import hind4sight_min.evaluation"],
                    "import_torch": ["-c", "import torch"],
                    "first_picture": ["-m", "hind4sight_min", "show", "--out", picture]}
        seconds = {name: [] for name in commands}
        for _ in range(args.rounds + 1):  # the first only warms the disk's cache
            for name, command in commands.items():
                start = time.perf_counter()
                result = subprocess.run([sys.executable, *command], capture_output=True)
                if result.returncode == 0:
                    seconds[name].append(time.perf_counter() - start)
                elif name != "import_torch":
                    sys.exit(result.stderr.decode())
        assert Path(picture).stat().st_size > 0
    figures = {}
    for name, values in seconds.items():
        if values:
            values = values[1:]
            figures.update({f"{name}_seconds": statistics.median(values), f"{name}_seconds_min": min(values),
                            f"{name}_seconds_max": max(values)})
            print(f"{name:<16} {statistics.median(values):.2f} s ({min(values):.2f} to {max(values):.2f})")
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
