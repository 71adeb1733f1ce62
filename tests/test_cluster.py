"""Many machines: a Dask scheduler and two workers here, one of which is killed halfway."""
import subprocess
import sys
from pathlib import Path

import pytest

from hind4sight_min.lab.cli import main

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))
import kills  # noqa: E402


def test_a_cluster_without_dask_is_one_line(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["collect", str(tmp_path / "pokes"), "--cluster", "tcp://127.0.0.1:8786"]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        "hind4sight collect: a cluster needs Dask: pip install 'hind4sight_min[cluster]'")


def test_a_cluster_that_loses_a_worker_collects_the_same_bytes(tmp_path):
    for library in ("pybullet", "distributed"):
        pytest.importorskip(library, reason="only installed with the extra 'sim' or 'cluster'")
    assert kills.kill_workers(tmp_path, 1, 40) == (1, True), (tmp_path / "dask.log").read_text()[-2000:]


def test_a_scheduler_that_is_not_there_is_one_line(tmp_path):
    pytest.importorskip("distributed", reason="only installed with the extra 'cluster'")
    code = "import dask, sys; dask.config.set({'distributed.comm.timeouts.connect': '0.1s'}); " \
           "from hind4sight_min.lab.cli import main; sys.exit(main())"
    done = subprocess.run([sys.executable, "-c", code, "collect", tmp_path / "pokes", "--cluster", "tcp://127.0.0.1:9"],
                          env=kills.environment(), capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith("hind4sight collect: Timed out")
