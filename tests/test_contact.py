"""The table of errors by what met what: contacts against scenes by hand, figures against hand values."""
import json

import numpy as np
import pytest

from hind4sight_min.lab import cli, contact
from hind4sight_min.lab.contact import ASIDE, WALLS, WatchedArena, contact_table, key_of, summarise, watched_pokes
from hind4sight_min.sim.arena import Arena, Settings
from hind4sight_min.training import Recipe, Run


def two_cans(made, gap):
    """Poke can 0, in its middle, along x; can 1 stands `gap` m behind -> where they end, the poke's key, the Arena."""
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    settings = Settings(objects_min=2, objects_max=2, kinds=("can",), width=16, height=12)
    with made(settings, np.random.default_rng(2)) as arena:
        arena.new_scene()
        for i, x in enumerate((0, gap + sum(arena.radii))):
            arena.put(i, (x, 0))
        assert arena.settle()
        key, poke = arena.poses(), np.float32([0.0, 0, 0])
        assert arena.poke(poke, np.float32([-0.12, 0]))
        return arena.poses(), key_of(key, poke), arena


@pytest.mark.parametrize("gap, touch", [(0.01, True), (0.10, False)])
def test_a_watched_poke_is_a_poke_and_knows_what_pressed_on_what_and_what_the_finger_aside_does(gap, touch):
    notes = {}
    plain, _, _ = two_cans(Arena, gap)
    found, key, arena = two_cans(lambda *given: WatchedArena(*given, notes=notes), gap)
    np.testing.assert_allclose(found, plain, atol=1e-4, err_msg="the poke was not brought back")
    pressed, bodies, kinds, aside = notes[key]
    assert (frozenset(bodies) in pressed) == touch and {arena._finger, bodies[0]} in pressed
    assert {0, bodies[0]} in pressed, "it stands on the table"
    assert not any(pair & WALLS for pair in pressed) and kinds == ["can", "can"] and arena.pressed is None
    # Pushed to the left of its middle, a can goes off to the right, and not as far along.
    assert aside[0, 1] < found[0, 1] - ASIDE / 2 and 0.015 < aside[0, 0] < found[0, 0] + 1e-3


def test_a_shard_says_of_every_poke_what_it_met_and_how_far_off_the_simulator_is(monkeypatch):
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    monkeypatch.setattr(contact, "errors_of_poke", lambda run, data, truth, row: {"moved": np.linalg.norm(
        truth.poses_after[row] - truth.poses_before[row], axis=1) > 0.003})
    settings = Settings(objects_min=7, objects_max=7, place_within=0.8, width=32, height=24)
    pokes = watched_pokes(None, settings, 1, (3, 20))
    assert len(pokes) == 20 and {300} < {poke["scene"] for poke in pokes} <= set(range(300, 320))
    for poke in pokes:
        assert len(poke["kinds"]) >= poke["moved"].sum() - 1 and set(poke["kinds"]) <= set(settings.kinds)
        assert not poke["free"] or len(poke["kinds"]) == 1 and not poke["contact"] and not poke["wall"]
    for name in ("wall", "contact", "free"):
        assert 0 < sum(poke[name] for poke in pokes) < 19, name
    off = np.array([poke["squared_aside"] for poke in pokes if poke["kinds"]])
    assert (off > 0).mean() > 0.9 and np.isfinite(off).all()


def poke(error, motion, aside, iou, free=False, contact=False, wall=False, kinds=("can",), scene=0):
    return {"squared_error": error, "squared_motion": motion, "squared_aside": aside, "iou": np.array(iou, float),
            "free": free, "contact": contact, "wall": wall, "kinds": list(kinds), "scene": scene}


def test_the_figures_of_the_groups_against_hand_values():
    pokes = [poke(1.0, 10.0, 0.5, [0.9], free=True, kinds=["bracket"]), poke(3.0, 30.0, 0.3, [0.7], free=True, scene=1),
             poke(4.0, 10.0, 1.0, [0.8, 0.2], contact=True, kinds=["can", "pot"], scene=2),
             poke(9.0, 0.0, 9.0, [], scene=3)]  # which moved nothing
    found = summarise(pokes, [poke(6.0, 8.0, 2.0, [0.4], wall=True)])
    for name, value in {"pokes": 3, "flow_mse_ratio": 8 / 50, "mask_iou": 2.6 / 4, "error_share": 1,
                        "simulator_ratio": 1.8 / 50, "free_pokes": 2, "free_flow_mse_ratio": 4 / 40,
                        "free_error_share": 0.5, "bracket_pokes": 1, "bracket_simulator_ratio": 0.05,
                        "contact_mask_iou": 0.5, "multi_flow_mse_ratio": 0.4, "wall_pokes": 0,
                        "crowded_flow_mse_ratio": 0.75, "crowded_simulator_ratio": 0.25}.items():
        assert found[name] == pytest.approx(value), name
    assert not {"wall_mask_iou", "crowded_error_share"} & set(found)
    text = contact_table(found)
    assert "| one object, no contact, no wall | 66.7% | 0.100 \u00b1 0.000 | 0.80 | 50% | 0.020 |" in text
    assert "| 6 or 7 objects all over the arena |  | 0.750 \u00b1 0.000 | 0.40 |  | 0.250 |" in text
    assert "wall |" not in text.split("\n", 3)[3].replace("no wall |", "")


def test_pokes_come_in_shards_of_both_arenas_in_the_models_picture_size(monkeypatch):
    asked, run = [], Run(Recipe(), {}, *[np.zeros(1)] * 3, meta={"camera": {"width": 32, "height": 24}})

    def watched(run, settings, seed, job):
        asked.append((settings.objects_max, settings.width, seed, *job))
        return [poke(1.0, 2.0 * settings.objects_max, 0.1, [0.5])] * job[1]
    monkeypatch.setattr(contact, "watched_pokes", watched)
    reports = []
    found = contact.reproduce(run, 250, progress=lambda *report: reports.append(report))
    assert asked == [(most, 32, contact.SEED, *job) for most in (4, 7) for job in ((0, 100), (1, 100), (2, 50))]
    assert found["flow_mse_ratio"] == pytest.approx(1 / 8) and found["crowded_flow_mse_ratio"] == pytest.approx(1 / 14)
    assert reports[0] == (100, 500) and reports[-1] == (500, 500)
    with pytest.raises(ValueError, match="pokes: expected"):
        contact.reproduce(run, 0)


def test_the_command_prints_the_table_and_keeps_the_figures(monkeypatch, tmp_path, capsys):
    asked, figures = [], summarise([poke(1.0, 4.0, 0.5, [0.9], free=True)], [])
    monkeypatch.setattr(contact, "reproduce", lambda run, pokes, *_: asked.append((run.step > 0, pokes)) or figures)
    assert cli.main(["reproduce", "contact", "--quick", "--out", str(tmp_path)]) == 0
    assert asked == [(True, 100)] and contact_table(figures) in capsys.readouterr().out
    assert json.loads((tmp_path / "contact.json").read_text()) == figures
