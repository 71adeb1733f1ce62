"""Pictures: the colours of a flow against closed form, what each panel draws, and whole, repeatable files."""
from functools import cache

import numpy as np
import pytest
from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure
from PIL import Image

from hind4sight_min import training
from hind4sight_min.geometry import Camera, unproject
from hind4sight_min.interactions import Interactions
from hind4sight_min.lab import figures
from hind4sight_min.lab.evaluation import Answer
from hind4sight_min.networks import Prediction
from hind4sight_min.sim.truth import Truth

H, W, ARENA = 6, 8, 0.5
BLOCK = np.zeros((H, W), bool)
BLOCK[2:4, 3:6] = True  # where object 2 stands; it moves, and mask 1 says so
POSE = np.diag([1.0, -1, -1, 1])
POSE[2, 3] = 0.5
CAMERA = Camera(W, H, 10.0, 10.0, 3.5, 2.5, POSE)  # half a metre above the table, looking down: 5 cm a pixel
SHIFT, TRUE_SHIFT = np.float32([0.03, 0.02, 0]), np.float32([0.02, 0.03, 0])
PANELS = ["before", "masks", "labels", "flow", "true_flow", "after", "warped", "error", "distance_predicted",
          "distance_observed", "scene_flow", "start", "end"]


def example(flow=(1.0, 0.0), missing=(), poke=(0.1, 0.0, 0.5), moves=1.0):
    """The arguments of `interaction_figure` for a made-up poke; `missing`: pixels without depth."""
    rng = np.random.default_rng(0)
    depth = np.full((2, H, W), 0.5, np.float32)
    depth[0][BLOCK] = depth[1][np.roll(BLOCK, 1, axis=1)] = 0.46
    for pixel in missing:
        depth[0][pixel] = 0
    rgb = rng.integers(0, 256, (2, H, W, 3), np.uint8)
    data = Interactions(rgb[:1], rgb[1:], depth[:1], depth[1:], np.float32([poke]), np.float32([[-0.05, -0.08]]),
                        np.full((H, W), 0.5, np.float32), CAMERA, {"settings": {"arena": ARENA, "cell": 0.125}})
    before, after = training.scenes_of(data)
    moving = BLOCK.reshape(1, -1, 1) * np.float32(moves)
    masks = np.concatenate([1 - moving, moving, 0 * moving], axis=2)
    prediction = Prediction(before.points + moving * SHIFT, masks, None, None)
    heatmaps = tuple(rng.random((2, 16)))
    answer = Answer(before, after, prediction, (BLOCK[..., None] * np.float32(flow)).astype(np.float32), heatmaps)
    poses = np.zeros((1, 7, 7), np.float32)
    poses[..., 6] = 1
    poses_after = poses.copy()
    poses_after[0, 1, :3] = moves * TRUE_SHIFT
    return data, 0, answer, Truth(2 * BLOCK[None].astype(np.uint8), poses, poses_after)


def panels(figure):
    """{label: Axes} of the panels, without colour bars and insets."""
    return {axes.get_label(): axes for axes in figure.axes if axes.get_title()}


@cache
def drawn_example():
    """The example's pokes, answer and {label: Axes}, once for all tests: drawing takes long."""
    data, _, answer, _ = given = example()
    return data, answer, panels(figures.interaction_figure(*given))


def picture(axes):
    return axes.images[0].get_array()


# --- colours --------------------------------------------------------------------------------------

@pytest.mark.parametrize("flow, rgb", [((0, 0), (1, 1, 1)), ((2, 0), (1, 0, 0)), ((0, 2), (0.5, 1, 0)),
                                       ((-2, 0), (0, 1, 1)), ((0, -2), (0.5, 0, 1)), ((1, 0), (1, 0.5, 0.5))])
def test_directions_have_the_documented_colours(flow, rgb):
    found = figures.flow_to_rgb(np.full((1, 1, 2), flow, float), 2.0)[0, 0]
    np.testing.assert_allclose(found, rgb, atol=1e-12, err_msg="U and V swapped, or V taken as up?")


def test_length_is_saturation():
    flow = np.random.default_rng(1).standard_normal((H, W, 2))
    length = np.linalg.norm(flow, axis=-1, keepdims=True)
    full = figures.flow_to_rgb(2.0 * flow / length, 2.0)
    np.testing.assert_allclose(full.min(axis=-1), 0, atol=1e-12)
    np.testing.assert_allclose(figures.flow_to_rgb(50.0 * flow / length, 2.0), full, atol=1e-12)
    np.testing.assert_allclose(figures.flow_to_rgb(0.5 * flow / length, 2.0), 0.75 + 0.25 * full, atol=1e-12)


@pytest.mark.parametrize("flow, scale, name", [
    (np.zeros((H, W, 3)), 1.0, "flow"), (np.zeros((H, 2)), 1.0, "flow"), (np.full((H, W, 2), np.nan), 1.0, "flow"),
    *[(np.zeros((H, W, 2)), scale, "scale") for scale in (0.0, -1.0, np.nan, np.inf)]])
def test_bad_flow_and_scale_are_named(flow, scale, name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        figures.flow_to_rgb(flow, scale)


def test_wheel_shows_each_direction_where_it_points():
    wheel = figures.colour_wheel(9)
    assert wheel.shape == (9, 9, 4) and wheel[0, 0, 3] == wheel[8, 8, 3] == 0
    for pixel, rgb in (((4, 4), (1, 1, 1)), ((4, 8), (1, 0, 0)), ((8, 4), (0.5, 1, 0))):  # middle, right, down
        np.testing.assert_allclose(wheel[pixel], [*rgb, 1], atol=1e-12)


# --- one poke -------------------------------------------------------------------------------------

def test_panels_draw_what_they_say():
    data, answer, drawn = drawn_example()
    assert list(drawn) == PANELS
    image, next_image = data.rgb_before[0] / 255, data.rgb_after[0] / 255
    np.testing.assert_allclose(picture(drawn["before"]), image, atol=1e-7)
    np.testing.assert_allclose(picture(drawn["after"]), next_image, atol=1e-7)
    warped = np.where(BLOCK[..., None], np.roll(next_image, -1, axis=1), next_image)  # the block from one pixel right
    np.testing.assert_allclose(picture(drawn["warped"]), warped, atol=1e-6, err_msg="warped against the flow?")
    np.testing.assert_allclose(picture(drawn["error"]).data, np.abs(image - warped).sum(axis=-1), atol=1e-6)
    for name, heatmap in zip(("start", "end"), answer.heatmaps):
        assert np.array_equal(picture(drawn[name]), heatmap.reshape(4, 4))


def test_flows_share_a_scale_and_show_only_what_has_depth():
    given = example(flow=(3.0, 4.0), missing=[(2, 4)])
    drawn = panels(figures.interaction_figure(*given))
    seen = BLOCK.copy()
    seen[2, 4] = False
    np.testing.assert_allclose(picture(drawn["flow"]), figures.flow_to_rgb(seen[..., None] * [3.0, 4.0], 5.0))
    pixels = 10 / 0.46 * np.array([0.02, -0.03])  # of the true shift; y is up on the table, down in the picture
    np.testing.assert_allclose(picture(drawn["true_flow"]), figures.flow_to_rgb(seen[..., None] * pixels, 5.0),
                               atol=1e-5)
    assert "5.0 px" in drawn["flow"].texts[0].get_text()


def test_distances_are_those_to_the_nearest_point_on_one_scale():
    data, _, answer, _ = given = example(missing=[(2, 3)])
    drawn = panels(figures.interaction_figure(*given))
    # Table that is covered before or after has no counterpart.
    now, then, seen = BLOCK.copy(), np.roll(BLOCK, 1, axis=1), np.ones((H, W), bool)
    now[2, 3] = seen[2, 3] = False
    kept, next_kept = (seen & (now | ~then)).ravel(), (then | ~now).ravel()
    predicted, observed = answer.prediction.points[0], unproject(data.depth_after[0], CAMERA).reshape(-1, 3)
    apart = 100 * np.linalg.norm(predicted[:, None] - observed, axis=2)
    expected = {"distance_predicted": apart[:, next_kept].min(axis=1) * kept,
                "distance_observed": apart[kept].min(axis=0) * next_kept}
    top = max(map(np.max, expected.values()))
    assert min(map(np.max, expected.values())) < 0.9 * top
    for name, distance in expected.items():
        np.testing.assert_allclose(picture(drawn[name]).ravel(), distance, atol=1e-4)
        assert drawn[name].images[0].get_clim() == (0, pytest.approx(top, rel=1e-4))


@pytest.mark.parametrize("flow, out", [((0, 0), []), ((3, 0), [(2, 5), (3, 5)]), ((-4, 0), [(2, 3), (3, 3)]),
                                       ((0, 3), [(3, 3), (3, 4), (3, 5)])])
def test_error_is_grey_where_it_is_not_counted(flow, out):
    drawn = panels(figures.interaction_figure(*example(flow=flow, missing=[(0, 0)])))
    covered = [(2, 6), (3, 6)]  # table before, block after
    grey = np.argwhere(np.ma.getmaskarray(picture(drawn["error"])))
    assert sorted(map(tuple, grey)) == sorted([(0, 0), *covered, *out])


@pytest.mark.parametrize("y, above", [(0.1, False), (-0.1, True)])
def test_the_wheel_is_away_from_the_poke(y, above):
    axes = panels(figures.interaction_figure(*example(poke=(0.1, y, 0.5))))["flow"]
    assert (axes.child_axes[0].get_position().y0 > np.mean([axes.get_position().y0, axes.get_position().y1])) == above


def test_masks_and_true_objects_are_coloured_over_grey():
    _, _, drawn = drawn_example()
    for label, colour in (("masks", figures.PALETTE[0]), ("labels", figures.PALETTE[1])):  # mask 1; object 2
        rgb = picture(drawn[label])
        np.testing.assert_allclose(np.ptp(rgb[~BLOCK], axis=-1), 0, atol=1e-12)
        assert np.abs(rgb[BLOCK] - colour).max() < 0.2
    still = picture(panels(figures.interaction_figure(*example(moves=0.0)))["labels"])
    np.testing.assert_allclose(np.ptp(still, axis=-1), 0, atol=1e-12, err_msg="an object that stayed is coloured")


def test_arrows_are_the_horizontal_motion_of_moved_points():
    data, answer, drawn = drawn_example()
    axes = drawn["scene_flow"]
    points = answer.before.points[0][BLOCK.ravel()]
    true, predicted = [arrows for arrows in axes.collections if hasattr(arrows, "U")]
    for arrows, flow in ((true, TRUE_SHIFT), (predicted, SHIFT)):
        np.testing.assert_allclose(arrows.get_offsets(), points[:, :2])
        np.testing.assert_allclose(np.stack([arrows.U, arrows.V], axis=-1), np.tile(flow[:2], (6, 1)), atol=1e-6)
        assert arrows.scale == 1 and arrows.angles == "xy"
        colour = figures.TRUE if arrows is true else figures.PREDICTED
        np.testing.assert_allclose(arrows.get_facecolor()[0, :3], colour, err_msg="true and predicted swapped?")
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    for place in (data.starts[0], data.pokes[0, :2], *(points + SHIFT)[:, :2]):
        assert (place > low).all() and (place < high).all()
    assert axes.get_aspect() == 1


def test_the_poke_and_the_true_cells_are_marked():
    data, _, drawn = drawn_example()
    ends = [data.starts[0], data.pokes[0, :2]]
    pixels = [(3.5 + 20 * x, 2.5 - 20 * y) for x, y in ends]  # 5 cm a pixel
    for name, (start, target) in (("before", pixels), ("scene_flow", ends)):
        (arrow,) = drawn[name].patches
        np.testing.assert_allclose(arrow._posA_posB, [start, target], rtol=1e-5)
    for name, place in zip(("start", "end"), ends):
        assert drawn[name].images[0].get_extent() == [-ARENA / 2, ARENA / 2, -ARENA / 2, ARENA / 2]
        assert drawn[name].images[0].origin == "lower"
        np.testing.assert_allclose(drawn[name].lines[0].get_xydata(), [place])
    assert "29\u00b0" in drawn["before"].figure.figure._suptitle.get_text()  # 0.5 rad


def test_nothing_moves_and_hardly_anything_has_depth(tmp_path):
    given = example(flow=(0, 0), moves=0.0, missing=[pixel for pixel in np.ndindex(H, W) if pixel != (5, 0)])
    figures.save_figure(figures.interaction_figure(*given), tmp_path / "still.png")


# --- training -------------------------------------------------------------------------------------

LOG = [{"epoch": i, "step": 10 * i, "learning_rate": 1e-3, "chamfer": 0.1 / i, "photometric": 3.0 - i,
        "surprise": 9.0 - i} for i in range(1, 6)]


def test_one_panel_per_term():
    drawn = panels(figures.training_figure(LOG))
    assert list(drawn) == ["chamfer", "photometric", "surprise"]
    for name, axes in drawn.items():
        np.testing.assert_allclose(axes.lines[0].get_xydata(), [(entry["step"], entry[name]) for entry in LOG])
        assert axes.get_yscale() == ("linear" if name == "photometric" else "log")  # the one that is not positive
    assert "Eq. 2" in drawn["chamfer"].get_title() and drawn["surprise"].get_title() == "surprise"
    assert set(figures.TERMS) == set(training.WEIGHTS)


# --- planning -------------------------------------------------------------------------------------

def sequence(path, camera=CAMERA):
    rng = np.random.default_rng(1)
    record = {"rgb": rng.integers(0, 256, (3, H, W, 3), np.uint8), "goal_rgb": np.zeros((H, W, 3), np.uint8),
              "marks": np.float32([[[0.05 * t, 0.0, 0.0]] for t in range(3)]), "goal_marks": np.array([[6.0, 4.0]]),
              "distance": np.array([[0.1], [0.05], [0.01]]), "starts": np.array([[-0.1, 0.0], [np.nan, np.nan]]),
              "pokes": np.array([[0.1, 0.05, 0.5], [0.1, 0.0, 0.0]])}
    figures.save_sequence(path, record, camera)


def test_save_sequence_draws_a_frame_per_picture_and_the_pokes_that_have_a_start(tmp_path, monkeypatch):
    frames, grab = [], PillowWriter.grab_frame

    def look(writer):
        axes = writer.fig.axes[0]
        frames.append((axes.get_title(), [arrow._posA_posB for arrow in axes.patches], axes.lines[1].get_xydata()))
        grab(writer)
    monkeypatch.setattr(PillowWriter, "grab_frame", look)
    sequence(tmp_path / "plan.gif")
    titles, arrows, marks = zip(*frames)
    assert [title.split(": ")[1][:6] for title in titles] == ["10.0 c", "5.0 cm", "1.0 cm", "1.0 cm"]
    np.testing.assert_allclose(arrows[0], [[[1.5, 2.5], [5.5, 1.5]]], err_msg="x / 5 cm to the right, y / 5 cm up")
    assert not any(arrows[1:]), "a poke without a start, or after the last picture"
    np.testing.assert_allclose(np.ravel(marks), [3.5, 2.5, 4.5, 2.5, 5.5, 2.5, 5.5, 2.5], atol=1e-6)
    with Image.open(tmp_path / "plan.gif") as film:
        assert film.n_frames >= 3


def test_control_figure_draws_boxes_and_means():
    rng = np.random.default_rng(2)
    curves = {(planner, objects): rng.random((6, 4)) * 0.1 for planner in ("learned", "oracle") for objects in (1, 2)}
    figure = figures.control_figure(curves, 3)
    assert [axes.get_label() for axes in figure.axes] == ["objects 1", "objects 2"]
    for axes, objects in zip(figure.axes, (1, 2)):
        lines = {line.get_label(): line.get_ydata() for line in axes.lines}
        for planner in ("learned", "oracle"):
            np.testing.assert_allclose(lines[figures.STYLES[planner][0]], 100 * curves[planner, objects].mean(axis=0))
        medians = [line.get_ydata()[0] for line in axes.lines if line.get_color() is figures.PREDICTED
                   and len(line.get_xdata()) == 2 and np.ptp(line.get_ydata()) == 0]
        np.testing.assert_allclose(medians, 100 * np.median(curves["learned", objects], axis=0))


# --- files ----------------------------------------------------------------------------------------

def test_the_same_figure_gives_the_same_bytes(tmp_path):
    figure = figures.interaction_figure(*example())
    for name, each in (("a", figure), ("b", figure), ("c", figures.interaction_figure(*example()))):
        figures.save_figure(each, tmp_path / f"new/{name}.png")
    first, again, made_again = (path.read_bytes() for path in sorted((tmp_path / "new").iterdir()))
    assert first == again == made_again
    assert first.startswith(b"\x89PNG") and b"Software" not in first
    with pytest.raises(ValueError, match="^path: expected"):
        figures.save_figure(Figure(), tmp_path / "a.pdf")


@pytest.mark.parametrize("name, write, where, method", [
    ("a.png", lambda path: figures.save_figure(Figure(), path), Figure, "savefig"),
    ("a.gif", sequence, PillowWriter, "finish")])
def test_a_failed_save_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, name, write, where, method):
    def full_disk(*_, **__):
        raise OSError("disk full")
    (tmp_path / name).write_bytes(b"old")
    monkeypatch.setattr(where, method, full_disk)
    with pytest.raises(OSError, match="disk full"):
        write(tmp_path / name)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [(name, b"old")]
