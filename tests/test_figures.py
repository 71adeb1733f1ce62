"""Pictures: the colours of a flow against closed form, what each panel draws, and whole, repeatable files."""
from functools import cache

import cv2
import numpy as np
import pytest
from matplotlib.animation import PillowWriter
from PIL import Image
from tiny import still_truth

from hind4sight_min import training
from hind4sight_min.geometry import Camera
from hind4sight_min.interactions import Interactions
from hind4sight_min.lab import figures
from hind4sight_min.lab.evaluation import Answer
from hind4sight_min.networks import Prediction

H, W, ARENA = 6, 8, 0.5
BLOCK = np.zeros((H, W), bool)
BLOCK[2:4, 3:6] = True  # where object 2 stands; it moves, and mask 1 says so
MOVED = np.roll(BLOCK, 1, axis=1)  # where it stands afterwards
POSE = np.diag([1.0, -1, -1, 1])
POSE[2, 3] = 0.5
CAMERA = Camera(W, H, 10.0, 10.0, 3.5, 2.5, POSE)  # half a metre above the table, looking down: 5 cm a pixel
SHIFT, TRUE_SHIFT = np.float32([0.03, 0.02, 0]), np.float32([0.02, 0.03, 0])
PANELS = ["photo_before", "before", "masks", "flow", "photo_after", "after", "labels", "true_flow", "warped", "error",
          "distance_predicted", "distance_observed", "scene_flow", "start", "end"]


def example(flow=(1.0, 0.0), missing=(), moves=1.0):
    """The arguments of `interaction_figure` for a made-up poke; `missing`: pixels without depth."""
    rng = np.random.default_rng(0)
    depth = np.full((2, H, W), 0.5, np.float32)
    depth[0][BLOCK] = depth[1][MOVED] = 0.46
    for pixel in missing:
        depth[0][pixel] = 0
    rgb = rng.integers(0, 256, (2, H, W, 3), np.uint8)
    poke, start = np.float32([[0.1, 0.0, 0.5]]), np.float32([[-0.05, -0.08]])
    data = Interactions(rgb[:1], rgb[1:], depth[:1], depth[1:], poke, start,
                        np.full((H, W), 0.5, np.float32), CAMERA, {"settings": {"arena": ARENA, "cell": 0.125}})
    before, after = training.scenes_of(data)
    moving = BLOCK.reshape(1, -1, 1) * np.float32(moves)
    masks = np.concatenate([1 - moving, moving, 0 * moving], axis=2)
    prediction = Prediction(before.points + moving * SHIFT, masks, None, None)
    heatmaps = tuple(rng.random((2, 16)))
    answer = Answer(before, after, prediction, (BLOCK[..., None] * np.float32(flow)).astype(np.float32), heatmaps)
    truth = still_truth(2 * BLOCK[None])
    truth.poses_after[0, 1, :3] = moves * TRUE_SHIFT
    return data, 0, answer, truth


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

DEFICIENCIES = {  # what is left of linear RGB: Machado, Oliveira and Fernandes (2009), the strongest form of each
    "protanopia": [(0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)],
    "deuteranopia": [(0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.01182, 0.04294, 0.968881)],
    "tritanopia": [(1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.3039)]}


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
def test_the_palette_survives(deficiency):
    linear = np.power(figures.PALETTE, 2.2) @ np.transpose(DEFICIENCIES[deficiency])
    left = np.float32(np.clip(linear, 0, 1) ** (1 / 2.2))
    lab = cv2.cvtColor(left[:, None], cv2.COLOR_RGB2LAB)[:, 0]
    apart = np.linalg.norm(lab[:, None] - lab, axis=2) + 99 * np.eye(len(lab))
    assert apart.min() > 12, "two colours look alike"  # 2.3 is what one just notices
    assert apart[:3, :3].min() > 24, "the colours of the first masks look alike"

@pytest.mark.parametrize("flow, rgb", [((0, 0), (1, 1, 1)), ((2, 0), (1, 0, 0)), ((0, 2), (0.5, 1, 0)),
                                       ((-2, 0), (0, 1, 1)), ((0, -2), (0.5, 0, 1)), ((1, 0), (1, 0.5, 0.5)),
                                       ((50, 0), (1, 0, 0))])
def test_directions_have_the_documented_colours(flow, rgb):
    found = figures.flow_to_rgb(np.full((1, 1, 2), flow, float), 2.0)[0, 0]
    np.testing.assert_allclose(found, rgb, atol=1e-12, err_msg="U and V swapped, or V taken as up?")


@pytest.mark.parametrize("flow, scale, name", [
    (np.zeros((H, W, 3)), 1.0, "flow"), (np.full((H, W, 2), np.nan), 1.0, "flow"),
    (np.zeros((H, W, 2)), 0.0, "scale"), (np.zeros((H, W, 2)), np.nan, "scale")])
def test_bad_flow_and_scale_are_named(flow, scale, name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        figures.flow_to_rgb(flow, scale)


# --- one poke -------------------------------------------------------------------------------------

def test_panels_draw_what_they_say():
    data, answer, drawn = drawn_example()
    assert list(drawn) == PANELS
    image, next_image = data.rgb_before[0] / 255, data.rgb_after[0] / 255
    for name, expected in (("before", image), ("after", next_image)):
        np.testing.assert_allclose(picture(drawn[name]), expected, atol=1e-7)
    warped = np.where(BLOCK[..., None], np.roll(next_image, -1, axis=1), next_image)  # the block from one pixel right
    np.testing.assert_allclose(picture(drawn["warped"]), warped, atol=1e-6, err_msg="warped against the flow?")
    np.testing.assert_allclose(picture(drawn["error"]).data, np.abs(image - warped).sum(axis=-1), atol=1e-6)
    grey = np.argwhere(np.ma.getmaskarray(picture(drawn["error"])))
    np.testing.assert_array_equal(grey, [(2, 6), (3, 6)], err_msg="table that the block covers is not counted")
    # The nearest observed point, and the nearest predicted one, where there is a counterpart.
    kept, next_kept = (BLOCK | ~MOVED).ravel(), (MOVED | ~BLOCK).ravel()
    apart = 100 * np.linalg.norm(answer.prediction.points[0][:, None] - answer.after.points[0], axis=2)
    for name, distance in (("distance_predicted", apart[:, next_kept].min(axis=1) * kept),
                           ("distance_observed", apart[kept].min(axis=0) * next_kept)):
        np.testing.assert_allclose(picture(drawn[name]).ravel(), distance, atol=1e-4)
    pixels = 10 / 0.46 * TRUE_SHIFT[:2] * [1, -1]  # of the true shift; y is up on the table, down in the picture
    for name, flow in (("flow", [1.0, 0.0]), ("true_flow", pixels)):
        expected = figures.flow_to_rgb(BLOCK[..., None] * flow, max(1, np.linalg.norm(pixels)))  # on one scale
        np.testing.assert_allclose(picture(drawn[name]), expected, atol=1e-5)
    for name, heatmap in zip(("start", "end"), answer.heatmaps):
        assert np.array_equal(picture(drawn[name]), heatmap.reshape(4, 4))


def test_masks_and_true_objects_are_coloured_over_grey():
    _, _, drawn = drawn_example()
    for label, colour in (("masks", figures.PALETTE[0]), ("labels", figures.PALETTE[1])):  # mask 1; object 2
        rgb = picture(drawn[label])
        np.testing.assert_allclose(np.ptp(rgb[~BLOCK], axis=-1), 0, atol=1e-12)
        assert np.abs(rgb[BLOCK] - colour).max() < 0.2


def test_nothing_moves_and_hardly_anything_has_depth():
    given = example(flow=(0, 0), moves=0.0, missing=[pixel for pixel in np.ndindex(H, W) if pixel != (5, 0)])
    still = picture(panels(figures.interaction_figure(*given))["labels"])
    np.testing.assert_allclose(np.ptp(still, axis=-1), 0, atol=1e-12, err_msg="an object that stayed is coloured")


def test_arrows_are_the_horizontal_motion_of_moved_points():
    _, answer, drawn = drawn_example()
    points = answer.before.points[0][BLOCK.ravel()]
    true, predicted = [arrows for arrows in drawn["scene_flow"].collections if hasattr(arrows, "U")]
    for arrows, flow, colour in ((true, TRUE_SHIFT, figures.TRUE), (predicted, SHIFT, figures.PREDICTED)):
        np.testing.assert_allclose(arrows.get_offsets(), points[:, :2])
        np.testing.assert_allclose(np.stack([arrows.U, arrows.V], axis=-1), np.tile(flow[:2], (6, 1)), atol=1e-6)
        np.testing.assert_allclose(arrows.get_facecolor()[0, :3], colour, err_msg="true and predicted swapped?")


def test_the_poke_and_the_true_cells_are_marked():
    data, _, drawn = drawn_example()
    ends = [data.starts[0], data.pokes[0, :2]]
    pixels = [(3.5 + 20 * x, 2.5 - 20 * y) for x, y in ends]  # 5 cm a pixel
    for name, (start, target) in (("before", pixels), ("photo_before", pixels), ("scene_flow", ends)):
        arrow = drawn[name].patches[0]
        np.testing.assert_allclose(arrow._posA_posB, [start, target], rtol=1e-5)
    for name, place in zip(("start", "end"), ends):
        assert drawn[name].images[0].get_extent() == [-ARENA / 2, ARENA / 2, -ARENA / 2, ARENA / 2]
        assert drawn[name].images[0].origin == "lower"
        np.testing.assert_allclose(drawn[name].lines[0].get_xydata(), [place])
    assert "29\u00b0" in drawn["before"].figure.figure._suptitle.get_text()  # 0.5 rad


def test_photographs_are_shown_whole_and_all_else_near_the_poke():
    data, row, answer, _ = example()
    photographs = np.random.default_rng(1).integers(0, 256, (2, 10 * H, 10 * W, 3), np.uint8)
    drawn = panels(figures.interaction_figure(data, row, answer, None, photographs))
    assert "labels" not in drawn and "true_flow" not in drawn
    target = 3.5 + 20 * 0.1, 2.5  # px
    for name, photograph in zip(("photo_before", "photo_after"), photographs):
        assert (picture(drawn[name]) == photograph).all() and drawn[name].get_xlim() == (-0.5, W - 0.5), name
        (left, bottom), right = drawn[name].patches[-1].get_xy(), drawn["before"].get_xlim()[1]
        assert (left, right - left) == (drawn["before"].get_xlim()[0], W / 2), "the frame is not what the others show"
        np.testing.assert_allclose((left, bottom), np.subtract(target, (W / 4, H / 4)) - 0.5, err_msg="not around it")


def test_a_flow_is_also_drawn_as_arrows():
    flow = np.zeros((H, W, 2))
    flow[1, 4], flow[4, 7], flow[2, 2] = (2, -1), (0, 3), (1, 1)  # the last lies between those that get an arrow
    axes = figures.Figure().add_subplot()
    figures.show_flow(axes, flow, 3.0, "")
    (arrows,) = [each for each in axes.collections if hasattr(each, "U")]
    found = np.column_stack([arrows.get_offsets(), arrows.U, arrows.V])
    np.testing.assert_allclose(found, [(4, 1, 2, -1), (7, 4, 0, 3)], err_msg="x and y, or U and V, swapped?")


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
    drawn = panels(figures.training_figure(LOG, {"photometric": 0.7}))
    assert len(drawn["chamfer"].lines) == 1 and set(drawn["photometric"].lines[1].get_ydata()) == {0.7}, "no motion"


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
        assert len(writer.fig.axes) == 2, "the picture, and the goal's"
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


def test_control_figure_draws_the_mean_of_every_planner():
    curves = {(planner, objects): np.random.default_rng(objects).random((6, 4)) * 0.1 * len(planner)
              for planner in ("learned", "oracle") for objects in (1, 2)}
    for axes, objects in zip(figures.control_figure(curves, 3).axes, (1, 2), strict=True):
        lines = {line.get_label(): line.get_ydata() for line in axes.lines}
        for planner in ("learned", "oracle"):
            np.testing.assert_allclose(lines[figures.STYLES[planner][0]], 100 * curves[planner, objects].mean(axis=0))


# --- files ----------------------------------------------------------------------------------------

def test_the_same_figure_gives_the_same_bytes(tmp_path):
    figure = figures.training_figure(LOG)
    for name in "ab":
        figures.save_figure(figure, tmp_path / f"new/{name}.png")
    first, again = (path.read_bytes() for path in sorted((tmp_path / "new").iterdir()))
    assert first == again and first.startswith(b"\x89PNG") and b"Software" not in first
    with pytest.raises(ValueError, match="^path: expected"):
        figures.save_figure(figure, tmp_path / "a.pdf")
