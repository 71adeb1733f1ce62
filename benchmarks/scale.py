"""What many pokes cost: the rate of collection, bytes on disk, and the memory of training on ten times as many.

    python benchmarks/scale.py --json docs/results/scale.json
    python benchmarks/scale.py --data runs/train     # pokes that are there, 100 in a shard

Collects the pokes, then trains for some steps on a tenth of them and on all, each in a process of its own, whose peak
resident memory is taken. Ten minutes on two idle cores.
"""
import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hind4sight_min.disk.files import write_json
from hind4sight_min.disk.shards import SHARD_POKES, shards_in
from hind4sight_min.sim.truth import truth_path

ROOT = Path(__file__).resolve().parent.parent


def run(*arguments):
    """A `hind4sight` command in a process of its own -> seconds, peak resident memory in MB."""
    began = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "hind4sight_min", *map(str, arguments)],
                               stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(ROOT)})
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{arguments[0]}: failed")
    return time.perf_counter() - began, usage.ru_maxrss / 1024


def collected(folder, pokes, jobs):
    """Collect -> figures."""
    seconds, memory = run("collect", folder, "--pokes", pokes, "--seed", 1, "--jobs", jobs)
    workers = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return {"collect_pokes_per_second": pokes / seconds, "collect_peak_mb": max(memory, workers)}


def trained(folder, shards, steps):
    """Train on some shards, in a new folder -> peak memory in MB."""
    (folder / "pokes").mkdir(parents=True)
    for shard in shards:
        (folder / "pokes" / shard.name).symlink_to(shard.absolute())
    _, memory = run("train", folder / "pokes", folder / "run.npz", "--steps", steps, "--jobs", 1)
    return memory


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pokes", type=int, default=20000)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="take these instead of collecting any")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        folder, figures = Path(folder), {}
        if not args.data:
            figures = collected(folder / "pokes", args.pokes, args.jobs)
        shards = shards_in(args.data or folder / "pokes")[:-(-args.pokes // SHARD_POKES)]
        pokes = min(args.pokes, len(shards) * SHARD_POKES)
        for name, paths in (("shard", shards), ("truth", [truth_path(shard) for shard in shards])):
            figures[f"{name}_bytes_per_poke"] = sum(path.stat().st_size for path in paths) / pokes
        less = trained(folder / "less", shards[:max(1, len(shards) // 10)], args.steps)
        more = trained(folder / "more", shards, args.steps)
    figures.update(scale_pokes=pokes, train_peak_mb_tenth=less, train_peak_mb=more,
                   train_memory_20k_over_2k=more / less)
    for name, value in figures.items():
        print(f"{name}: {value:.4g}")
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
