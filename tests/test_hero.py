"""The README's animation: filming changes nothing, what is kept is what was shown, and the file is small."""
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hind4sight_min.sim.arena import Arena, Settings

DOCS = Path(__file__).resolve().parent.parent / "docs"
spec = importlib.util.spec_from_file_location("hero", DOCS / "hero.py")
hero = importlib.util.module_from_spec(spec)
spec.loader.exec_module(hero)


def test_filming_changes_nothing(monkeypatch):
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    monkeypatch.setattr(hero, "WIDTH", 16)
    poses = []
    for filmed in (False, True):
        with Arena(Settings(width=16, height=12), np.random.default_rng(1)) as arena:
            arena.new_scene()
            films = hero.film_pokes(arena, 30) if filmed else []
            target = arena.poses()[0, :2]
            arena.poke(np.float32([*target, 0]), target - [0.12, 0])
            poses.append(arena.poses())
    assert np.array_equal(*poses), "the film changes the poke"
    assert len(films) == 1 and len(films[0]) >= 4, "too few pictures of the poke"
    assert not np.array_equal(films[0][0], films[0][-1]), "the film shows one moment"


def test_frames_are_kept_with_their_durations(tmp_path):
    stage, half = hero.Stage(64, 48), np.zeros((48, 64, 3))
    for seconds, grey in ((0.5, 0.0), (1.5, 1.0)):
        stage.show(seconds, (half + grey, "left"), (half, "right"), "below")
    stage.save(tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as film:
        durations, corners = [], []
        for i in range(film.n_frames):
            film.seek(i)
            durations.append(film.info["duration"])
            corners.append(np.asarray(film.convert("RGB"))[film.height // 2, film.width // 4])
    assert durations == [500, 1500]
    np.testing.assert_allclose(corners, [[0] * 3, [255] * 3], atol=8)


def test_a_missing_checkpoint_is_one_line(tmp_path):
    done = subprocess.run([sys.executable, DOCS / "hero.py", "--checkpoint", "no.npz", "--out", tmp_path / "film.gif"],
                          env={**os.environ, "PYTHONPATH": str(DOCS.parent)}, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (2, "hero.py: no.npz: no such file\n")


def test_the_shipped_animation_is_small_and_wide():
    with Image.open(DOCS / "hero.gif") as film:
        assert film.n_frames > 20 and film.width == 800 and film.info["loop"] == 0
    assert (DOCS / "hero.gif").stat().st_size < 3e6
