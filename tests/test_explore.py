"""The explorer, driven by the events that mouse and keys make: what it says and draws is what the package computes."""
import importlib.util
from functools import partial

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from hind4sight_min import planning
from hind4sight_min.course import carve
from hind4sight_min.course.assignments import assignment_of
from hind4sight_min.disk.checkpoints import load_run
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.geometry import project
from hind4sight_min.lab import explore, figures
from hind4sight_min.lab.cli import data_small, main
from hind4sight_min.lab.evaluation import ask, errors_of_poke, scenes_of_pokes
from hind4sight_min.networks import predict
from hind4sight_min.sim.truth import load_truth
from hind4sight_min.training import scenes_of

FOLDER = data_small() / "test"
needs_bullet = pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="needs pybullet")


def opened(data=FOLDER, **how):
    return explore.explore(data=data, figure=FigureCanvasAgg(Figure(explore.SIZE, dpi=50)).figure, **how)


def do(explorer, *lines):
    explore.play(explorer, lines)
    return explorer.art.text.get_text()


def screen(explorer):
    return np.array(explorer.canvas.buffer_rgba())


def shown(explorer, name):
    return np.array(explorer.art.images[name].get_array())


def on_object(explorer, nth=0.5):
    """A pixel (x, y) in the midst of what stands in the arena."""
    rows = np.flatnonzero(explorer.scene.occupied[0])
    y, x = divmod(int(rows[int(nth * len(rows))]), explorer.camera.width)
    return x, y


@pytest.fixture(scope="module")
def recorded():
    """Run, pokes, truth and scenes of the shipped test pokes."""
    data, truth = load_interactions(FOLDER), load_truth(FOLDER)
    return load_run(data_small() / "checkpoint.npz"), data, truth, scenes_of_pokes(truth)


def test_a_drag_is_a_poke_and_what_is_drawn_is_what_the_model_says_of_it(recorded, tmp_path):
    run, data, _, _ = recorded
    explorer = opened(out=tmp_path)
    before = screen(explorer)
    np.testing.assert_array_equal(explorer.poke, data.pokes[0], err_msg="it begins with the recorded poke")
    np.testing.assert_allclose(explorer.flow, ask(run, data, 0).flow, atol=1e-4)
    x, y = on_object(explorer)
    for to_x, to_y, angle in ((x + 6, y, 0), (x, y - 6, np.pi / 2), (x - 6, y, np.pi)):
        do(explorer, f"drag {x} {y} {to_x} {to_y}")
        target, tip = (project(np.append(place, explorer.scene.points[0, 64 * y + x, 2]), data.camera) for place in (
            explorer.poke[:2], explorer.poke[:2] + 0.05 * explore.direction(explorer.poke)))
        np.testing.assert_allclose(target, (x, y), atol=1e-2, err_msg="the target is what was clicked")
        start, end = explorer.art.arrows[2]._posA_posB  # from above, m
        np.testing.assert_allclose(end, explorer.poke[:2], err_msg="the arrow does not follow")
        assert (end - start) @ explore.direction(explorer.poke) > 0.099, "it comes from 10 to 14 cm behind"
        assert (tip - target) @ [to_x - x, to_y - y] > 0.99 * 6 * np.linalg.norm(tip - target), "dragged another way?"
        assert np.abs(np.angle(np.exp(1j * (explorer.poke[2] - angle)))) < 0.5
    said = predict(run.params, run.recipe.sizes, scenes_of(data[[0]])[0], explorer.poke[None])
    np.testing.assert_array_equal(explorer.prediction.points, said.points)
    image = data.rgb_before[0] / np.float32(255)
    np.testing.assert_allclose(shown(explorer, "masks"), figures.blend(image, said.masks[0, :, 1:].reshape(48, 64, -1)))
    assert (screen(explorer) != before).any(axis=2).mean() > 0.005, "the picture did not follow"
    turned = explorer.poke[2]
    do(explorer, f"drag {x} {y} {x} {y}")
    assert explorer.poke[2] == turned, "a click alone keeps the direction"
    frozen = screen(explorer)
    explorer.canvas.draw()
    np.testing.assert_array_equal(screen(explorer), frozen, err_msg="drawing all shows something else than blitting")
    do(explorer, "key s")
    with Image.open(tmp_path / "explore_1.png") as saved:
        np.testing.assert_array_equal(np.array(saved), frozen, err_msg="saved incompletely")


def test_poke_shows_the_truth_with_the_error_and_is_taken_back(recorded):
    run, data, truth, scenes = recorded
    explorer = opened(seed=2)
    row = int(np.argmax(scenes == 2))
    x, y = on_object(explorer)
    said = do(explorer, f"drag {x} {y} {x + 5} {y + 5}", "key space")
    errors = errors_of_poke(run, data, truth, row)
    assert explorer.error == pytest.approx(100 * errors["error"] / errors["moving"], rel=1e-3)
    assert f"off by {explorer.error:.1f} cm" in said
    np.testing.assert_allclose(shown(explorer, "truth"), data.rgb_after[row] / 255, atol=1e-6)
    np.testing.assert_array_equal(explorer.poke, data.pokes[row], err_msg="without a simulator: the recorded poke")
    do(explorer, "key space", "key n", "key space", "key u")
    np.testing.assert_array_equal(explorer.poke, data.pokes[np.argmax(scenes == 3)])
    assert "no poke to take back" in do(explorer, "key u")
    del explorer.world.rows[1:]
    said = do(explorer, "key space", "key space")
    assert "last recorded poke" in said and np.array_equal(
        explorer.scene.images[0], data.rgb_after[np.argmax(scenes == 3)] / np.float32(255))


def test_plan_draws_every_round_and_takes_the_poke_that_cem_finds(recorded):
    run, data, _, _ = recorded
    explorer = opened(seed=1)
    assert "Nothing to plan" in do(explorer, "key p") and "background" in do(explorer, "goal 1 1 30 20")
    x, y = on_object(explorer)
    do(explorer, "key g", f"drag {x} {y} 38 26", "key g", f"goal {x} {y} 36 26")  # the same object: one mark
    np.testing.assert_allclose(explorer.goals, [[36, 26]])
    view, rng, explorer.frames, widths = explorer.view, np.random.default_rng(0), [], []
    rollout = partial(planning.roll, planning.learned_step(run, view), view, settings=explorer.settings)
    wanted = planning.plan(rollout, view, planning.goal_of(explorer.goals), data.camera, explorer.settings,
                           planning.Search(chamfer_weight=0.0), rng)
    lines, paint = explorer.art.elites, explorer.paint
    explorer.paint = lambda blit=True: (paint(blit), widths.append(np.ptp(lines.get_segments(), axis=0)[1].sum()
                                                                   if len(lines.get_segments()) else 0))
    do(explorer, "key p")
    np.testing.assert_array_equal(explorer.poke, wanted.pokes[0])
    assert len(set(map(id, explorer.frames))) == 5 and widths[-1] == 0, "four rounds, and the prediction"
    assert 0 < widths[3] < 0.7 * widths[0], "the elites do not narrow"
    assert f"after this poke {wanted.cost:.2f}" in explorer.art.text.get_text()


def test_the_predicted_picture_is_the_present_one_moved():
    rng = np.random.default_rng(0)
    image, flow, depth = rng.random((6, 9, 3)), np.zeros((6, 9, 2)), np.full((6, 9), 2.0)
    image[3:], depth[2, 2:4] = 0.5, 1.0  # most of it is the table
    flow[2, 2:4] = [3.0, 0]
    found = figures.next_picture(image, flow, depth)
    np.testing.assert_allclose(found[2, 5:7], image[2, 2:4], atol=1e-6, err_msg="moved against the flow?")
    np.testing.assert_allclose(found[2, 2:4], np.full((2, 3), 0.5), err_msg="a ghost is left")
    np.testing.assert_allclose(found[:, 7:], image[:, 7:], atol=1e-6)
    depth[2, 5:7] = 0.5
    hidden = figures.next_picture(image, flow, depth)
    np.testing.assert_allclose(hidden[2, 5:7], image[2, 5:7], atol=1e-6, err_msg="the nearer one is in front")


@pytest.mark.parametrize("sign", "+-")
def test_a_wrong_sign_in_a_student_s_warp_is_seen(sign, tmp_path, monkeypatch):
    text = carve.exercise_text(assignment_of("warping")).replace(
        '    raise NotImplementedError("Task 3.3: ', f"""    height, width = flow.shape[1:3]
    y, x = np.mgrid[:height, :width]
    return (bilinear_sample(next_images, np.stack([x, y], axis=-1).astype(flow.dtype) {sign} flow),
            np.ones(flow.shape[:3], bool))
    raise NotImplementedError("Task 3.3: """)
    (tmp_path / "warping.py").write_text(text)
    right = shown(opened(), "predicted")
    monkeypatch.setattr(explore, "take_written", partial(carve.take_written, replace=monkeypatch.setattr))
    explorer = opened(mine=[tmp_path])
    assert explorer.yours == ["warp_backward"], "what is not written yet stays the reference's"
    differs = np.abs(shown(explorer, "predicted") - right).max(axis=2) > 0.1
    assert differs.sum() > 10 if sign == "-" else not differs.any()
    assert "yours: warp_backward" in [text.get_text() for text in explorer.figure.texts]


def test_an_error_in_a_student_s_code_is_a_line_under_the_pictures(tmp_path, monkeypatch):
    text = carve.exercise_text(assignment_of("chamfer"))
    first = text.index('    raise NotImplementedError("Task 2.5')
    (tmp_path / "chamfer.py").write_text(text[:first] + "    return map_predicted @ map_observed\n" + text[first:])
    monkeypatch.setattr(explore, "take_written", partial(carve.take_written, replace=monkeypatch.setattr))
    explorer = opened(mine=[tmp_path])
    assert explorer.yours == ["chamfer_loss"]
    said = do(explorer, "key space")
    assert said.startswith("ValueError: matmul") and "line" in said and "map_observed" in said


@needs_bullet
def test_in_the_simulator_every_poke_can_be_tried_and_taken_back():
    explorer = opened(data=None, seed=1)
    x, y = on_object(explorer)
    first, poses = shown(explorer, "camera"), explorer.world.arena.poses()
    assert first.shape[0] > 48, "people are shown the fine picture"
    for to_x in (x + 6, x - 6):  # the finger finds room on one side at least
        do(explorer, f"drag {x} {y} {to_x} {y}", "key space")
        if explorer.world.history:
            break
    assert explorer.error < 3 and (shown(explorer, "camera") != first).any()
    assert shown(explorer, "truth").shape == (48, 64, 3) and len(explorer.art.true.get_segments())
    do(explorer, "key u")
    np.testing.assert_array_equal(shown(explorer, "camera"), first)
    np.testing.assert_allclose(explorer.world.arena.poses(), poses, atol=1e-6, err_msg="the picture alone went back")
    do(explorer, "key n")
    assert (shown(explorer, "camera") != first).any() and not explorer.world.history
    explorer.world.arena.__exit__()


# --- the command ----------------------------------------------------------------------------------

def test_a_script_saves_pictures_and_is_filmed(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "script").write_text("drag 30 20 34 16  # a poke\nkey space\n\nwait 0.5\nkey s\n")
    assert main(["explore", str(FOLDER), "--script", "script", "--demo", "out.gif"]) == 0
    with Image.open("explore_1.png") as picture, Image.open("out.gif") as film:
        assert picture.size == (930, 532) == film.size and film.n_frames > 3
    assert capsys.readouterr().out == "out.gif: 3 s\n"


@pytest.fixture(scope="module")
def blank():
    return opened()


@pytest.mark.parametrize("line", ["drag 1 2 3", "drag 1 2", "drag 1 2 3 x", "fly 1 2 3 4", "key", "key x", "wait",
                                  "wait long", "drag", "goal inf 1 2 3", "wait -1", "wait nan", "wait 1e9"])
def test_a_script_that_says_something_else_is_refused_in_one_line(line, blank):
    with pytest.raises(ValueError, match="^script, line 2: expected drag or goal X Y X Y, key K, or wait SEC.*'$"):
        explore.play(blank, ["wait 0", line])


@pytest.mark.parametrize("arguments, said", [
    (["--demo", "film.png"], "--demo: expected a name ending in .gif"), (["--mine", "."], "folder: expected one with"),
    (["no.npz"], "no.npz: no such file"), (["--mine", "syntax"], "mine: SyntaxError: "),
    (["--mine", "exits"], "mine: SystemExit: 4 (line 1: raise SystemExit(4))"),
    ([str(FOLDER), "--seed", "-1"], "seed: expected a whole number >= 0, got -1"),
    ([str(FOLDER), "--script", "undo"], "script: There is no poke to take back.")])
def test_what_cannot_be_explored_is_refused_in_one_line(arguments, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "undo").write_text("key u\nwait 0\n")
    for name, text in (("syntax", "def f(:"), ("exits", "raise SystemExit(4)")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "camera.py").write_text(text)
    assert main(["explore", "--script", "none", *arguments]) == 2
    assert capsys.readouterr().err.startswith(f"hind4sight explore: {said}")
