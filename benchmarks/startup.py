"""How long one waits: for the import of the package and of its command line, and for the first picture.

    python benchmarks/startup.py --json docs/results/startup.json

Each in fresh processes that take turns: Python alone, the core, the command line (which imports all but Matplotlib and
Bullet), PyTorch (if it is installed), and a whole `hind4sight show` of the shipped checkpoint, which ends with a PNG
on disk. Half a minute.
"""
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from race import parser_of, shown, spread

from hind4sight_min.disk.files import write_json


def main():
    args = parser_of(__doc__, rounds=9).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        picture = str(Path(folder) / "picture.png")
        commands = {"python": ["-c", ""],
                    "import": ["-c", "import hind4sight_min.training, hind4sight_min.planning"],
                    "import_command_line": ["-c", "import hind4sight_min.lab.cli"],
                    "import_torch": ["-c", "import torch"],
                    "first_picture": ["-m", "hind4sight_min", "show", "--out", picture]}
        seconds = {name: [] for name in commands}
        for _ in range(args.rounds):
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
            figures.update(spread(f"{name}_seconds", values))
            print(f"{name:<20} {shown(values)} s")
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
