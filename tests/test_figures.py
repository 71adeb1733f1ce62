"""Pictures: the colours of a flow against closed form, what each panel draws, and whole, repeatable files."""
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure

from hind4sight_min import figures
from hind4sight_min.figures import (PALETTE, colour_wheel, flow_to_rgb, interaction_figure, save_figure,
                                    training_figure)

H, W, K, ROWS, COLUMNS, ARENA = 6, 8, 3, 4, 5, 0.5
IMAGES = ["before", "masks", "flow", "after", "warped", "error", "distance_predicted", "distance_observed"]
ARENA_PANELS = ["scene_flow", "start", "end"]


def example(truth=False, **changed):
    """The arguments of a small made-up interaction: the block of pixels [2:4, 3:6] moves, as mask 1."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0.2:-0.2:H * 1j, -0.2:0.2:W * 1j]
    moving = np.zeros((H, W, 1))
    moving[2:4, 3:6] = 1
    arguments = {
        "image": rng.random((H, W, 3)), "next_image": rng.random((H, W, 3)),
        "points": np.stack([x, y, 0 * x], axis=-1), "scene_flow": moving * [0.03, 0.02, 0.0],
        "masks": np.concatenate([1 - moving, moving, 0 * moving], axis=2), "optical_flow": moving * [1.5, -2.0],
        "warped": rng.random((H, W, 3)), "distance_predicted": 1e-4 * rng.random((H, W)),
        "distance_observed": 4e-4 * rng.random((H, W)), "start_heatmap": rng.random((ROWS, COLUMNS)),
        "end_heatmap": rng.random((ROWS, COLUMNS)), "arena": ARENA, "poke": np.array([0.1, 0.0, 0.5]),
        "start": np.array([-0.05, -0.08]), "poke_pixels": np.array([[1.0, 4.0], [4.0, 3.0]]),
    }
    if truth:
        arguments.update(true_scene_flow=moving * [0.02, 0.03, 0.0], true_optical_flow=moving * [3.0, -4.0],
                         true_labels=2 * moving[..., 0].astype(int))
    return {**arguments, **changed}


def panels(figure):
    """{label: Axes} of the panels, without colour bars and insets."""
    return {axes.get_label(): axes for axes in figure.axes if axes.get_title()}


def picture(axes):
    return axes.images[0].get_array()


# --- colours -------------------------------------------------------------------------------------------

def test_no_motion_is_white():
    assert np.array_equal(flow_to_rgb(np.zeros((H, W, 2)), 3.0), np.ones((H, W, 3)))


@pytest.mark.parametrize("flow, rgb", [((2, 0), (1, 0, 0)), ((0, 2), (0.5, 1, 0)), ((-2, 0), (0, 1, 1)),
                                       ((0, -2), (0.5, 0, 1)), ((1, 0), (1, 0.5, 0.5))])
def test_directions_have_the_documented_colours(flow, rgb):
    np.testing.assert_allclose(flow_to_rgb(np.full((1, 1, 2), flow, float), 2.0)[0, 0], rgb, atol=1e-12)


def test_opposite_directions_have_complementary_colours():
    flow = np.random.default_rng(1).standard_normal((H, W, 2))
    saturation = np.minimum(np.linalg.norm(flow, axis=-1, keepdims=True) / 1.5, 1)
    both = flow_to_rgb(flow, 1.5) + flow_to_rgb(-flow, 1.5)
    np.testing.assert_allclose(both, np.broadcast_to(2 - saturation, both.shape), atol=1e-12)


def test_length_is_saturation_and_stops_at_the_scale():
    flow = np.random.default_rng(2).standard_normal((H, W, 2))
    unit = flow / np.linalg.norm(flow, axis=-1, keepdims=True)
    full = flow_to_rgb(2.0 * unit, 2.0)
    np.testing.assert_allclose(full.min(axis=-1), 0, atol=1e-12)
    np.testing.assert_allclose(flow_to_rgb(50.0 * unit, 2.0), full, atol=1e-12)
    np.testing.assert_allclose(flow_to_rgb(0.5 * unit, 2.0), 0.75 + 0.25 * full, atol=1e-12)
    np.testing.assert_allclose(full.max(axis=-1), 1)


@pytest.mark.parametrize("bad", [np.zeros((H, W, 3)), np.zeros((H, 2)), np.full((H, W, 2), np.nan)])
def test_bad_flow_is_named(bad):
    with pytest.raises(ValueError, match="^flow: expected"):
        flow_to_rgb(bad, 1.0)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_bad_scale_is_named(bad):
    with pytest.raises(ValueError, match="^scale: expected"):
        flow_to_rgb(np.zeros((H, W, 2)), bad)


def test_wheel_shows_each_direction_where_it_points():
    wheel = colour_wheel(9)
    assert wheel.shape == (9, 9, 4)
    np.testing.assert_allclose(wheel[4, 4], [1, 1, 1, 1])
    np.testing.assert_allclose(wheel[4, 8], [1, 0, 0, 1], atol=1e-12)    # right
    np.testing.assert_allclose(wheel[8, 4], [0.5, 1, 0, 1], atol=1e-12)  # down
    assert wheel[0, 0, 3] == 0 and wheel[8, 8, 3] == 0
    with pytest.raises(ValueError, match="^size: expected"):
        colour_wheel(1)


# --- one interaction ---------------------------------------------------------------------------------

def test_panels_without_truth():
    figure = interaction_figure(**example())
    assert isinstance(figure, Figure)
    assert list(panels(figure)) == IMAGES + ARENA_PANELS


def test_panels_with_truth():
    figure = interaction_figure(**example(truth=True))
    assert sorted(panels(figure)) == sorted(IMAGES + ARENA_PANELS + ["labels", "true_flow"])


def test_panels_draw_the_arrays_given():
    given = example(truth=True)
    drawn = panels(interaction_figure(**given))
    assert np.array_equal(picture(drawn["before"]), given["image"])
    assert np.array_equal(picture(drawn["after"]), given["next_image"])
    assert np.array_equal(picture(drawn["warped"]), given["warped"])
    np.testing.assert_allclose(picture(drawn["error"]), np.abs(given["image"] - given["warped"]).sum(axis=-1))
    np.testing.assert_allclose(picture(drawn["distance_predicted"]), 100 * np.sqrt(given["distance_predicted"]))
    np.testing.assert_allclose(picture(drawn["distance_observed"]), 100 * np.sqrt(given["distance_observed"]))
    assert np.array_equal(picture(drawn["start"]), given["start_heatmap"])
    assert np.array_equal(picture(drawn["end"]), given["end_heatmap"])
    # One scale for both flows: the longest of all, 5 px.
    np.testing.assert_allclose(picture(drawn["flow"]), flow_to_rgb(given["optical_flow"], 5.0))
    np.testing.assert_allclose(picture(drawn["true_flow"]), flow_to_rgb(given["true_optical_flow"], 5.0))
    assert "5.0 px" in drawn["flow"].texts[0].get_text()


def test_distances_share_their_colours():
    given = example()
    drawn = panels(interaction_figure(**given))
    limits = [drawn[name].images[0].get_clim() for name in ("distance_predicted", "distance_observed")]
    assert limits[0] == limits[1]
    assert limits[0] == (0, pytest.approx(100 * np.sqrt(given["distance_observed"].max())))


def test_error_is_not_drawn_where_it_is_not_counted():
    valid = np.ones((H, W), bool)
    valid[0, 0] = False
    flow = np.zeros((H, W, 2))
    flow[3, W - 1], flow[2, 0] = [2.0, 0.0], [-2.0, 0.0]  # out of the picture
    flow[0, 4], flow[H - 1, 4] = [0.0, -2.0], [0.0, 2.0]
    flow[4, W - 1] = [1e-6, 0.0]  # rounding
    mask = np.ma.getmaskarray(picture(panels(interaction_figure(**example(valid=valid, optical_flow=flow)))["error"]))
    assert np.argwhere(mask).tolist() == [[0, 0], [0, 4], [2, 0], [3, W - 1], [H - 1, 4]]
    shared = np.ones((H, W), bool)
    shared[1, 2] = False
    drawn = panels(interaction_figure(**example(valid=valid, shared=shared, optical_flow=flow)))
    assert np.argwhere(np.ma.getmaskarray(picture(drawn["error"]))).tolist() == [
        [0, 0], [0, 4], [1, 2], [2, 0], [3, W - 1], [H - 1, 4]]


def test_flow_without_depth_neither_shows_nor_sets_the_scale():
    valid = np.ones((H, W), bool)
    valid[0, 0] = False
    flow = example()["optical_flow"]
    flow[0, 0] = [1000.0, 0.0]
    drawn = panels(interaction_figure(**example(valid=valid, optical_flow=flow)))
    assert np.array_equal(picture(drawn["flow"])[0, 0], [1, 1, 1])
    assert "2.5 px" in drawn["flow"].texts[0].get_text()


@pytest.mark.parametrize("still", [(x, y) for x in (0, 1) for y in (0, 1)])
def test_the_wheel_lies_where_there_is_least_flow(still):
    flow = np.ones((H, W, 2))
    rows, columns = (slice(H // 2), slice(H // 2, None))[still[1]], (slice(W // 2), slice(W // 2, None))[still[0]]
    flow[rows, columns] = 0
    axes = panels(interaction_figure(**example(optical_flow=flow)))["flow"]
    x0, y0, x1, y1 = axes.child_axes[0].get_position().extents  # in the figure; the panel's own corners likewise
    left, bottom, right, top = axes.get_position().extents
    assert ((x0 + x1) / 2 > (left + right) / 2) == bool(still[0])
    assert ((y0 + y1) / 2 < (bottom + top) / 2) == bool(still[1])


def test_masks_are_coloured_over_grey():
    given = example(truth=True)
    drawn = panels(interaction_figure(**given))
    for label, colour in (("masks", PALETTE[0]), ("labels", PALETTE[1])):  # mask 1; object 2
        rgb, moving = picture(drawn[label]), given["masks"][..., 1] > 0
        np.testing.assert_allclose(np.ptp(rgb[~moving], axis=-1), 0, atol=1e-12)
        assert np.abs(rgb[moving] - colour).max() < 0.2


def test_arrows_are_the_horizontal_motion_of_moved_points():
    given = example(truth=True)
    axes = panels(interaction_figure(**given))["scene_flow"]
    moving = given["masks"][..., 1] > 0
    true, predicted = [arrows for arrows in axes.collections if hasattr(arrows, "U")]
    for arrows, flow in ((true, given["true_scene_flow"]), (predicted, given["scene_flow"])):
        np.testing.assert_allclose(arrows.get_offsets(), given["points"][moving][:, :2])
        np.testing.assert_allclose(np.stack([arrows.U, arrows.V], axis=-1), flow[moving][:, :2])
        assert arrows.scale == 1 and arrows.angles == "xy"
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    for place in (given["start"], given["poke"][:2], *(given["points"] + given["scene_flow"])[moving][:, :2]):
        assert (place > low).all() and (place < high).all()
    assert axes.get_aspect() == 1


def test_heatmaps_lie_on_the_arena_with_the_true_places_marked():
    given = example()
    drawn = panels(interaction_figure(**given))
    for name, place in (("start", given["start"]), ("end", given["poke"][:2])):
        assert drawn[name].images[0].get_extent() == [-ARENA / 2, ARENA / 2, -ARENA / 2, ARENA / 2]
        assert drawn[name].images[0].origin == "lower"
        np.testing.assert_allclose(drawn[name].lines[0].get_xydata(), [place])


def test_nothing_moves_and_nothing_has_depth(tmp_path):
    zero = np.zeros((H, W))
    given = example(scene_flow=np.zeros((H, W, 3)), optical_flow=np.zeros((H, W, 2)), distance_predicted=zero,
                    distance_observed=zero, valid=zero.astype(bool), start_heatmap=np.zeros((ROWS, COLUMNS)))
    save_figure(interaction_figure(**given), tmp_path / "still.png")


def test_the_poke_points_from_start_to_target():
    given = example()
    drawn = panels(interaction_figure(**given))
    for name, start, target in (("before", *given["poke_pixels"]), ("scene_flow", given["start"], given["poke"][:2])):
        outline = drawn[name].patches[0].get_path().vertices
        shaft, length = outline[0], np.linalg.norm(target - start)
        np.testing.assert_allclose(shaft, start, atol=0.02 * length)
        assert np.linalg.norm(outline - target, axis=1).min() < 0.1 * length
        assert len(drawn[name].patches) == 1


def test_title():
    def title(**changed):
        return interaction_figure(**example(**changed)).texts[0].get_text()

    assert "29\u00b0" in title()  # 0.5 rad
    assert title(title="row 7") == "row 7"


ARRAYS = [name for name in example(truth=True) if name != "arena"]


@pytest.mark.parametrize("name", [*ARRAYS, "valid", "shared"])
def test_a_wrong_shape_is_named(name):
    with pytest.raises(ValueError, match=f"^{name}: expected shape .*got \\(2, 3, 4, 5\\)"):
        interaction_figure(**example(truth=True, **{name: np.zeros((2, 3, 4, 5))}))


@pytest.mark.parametrize("name", ARRAYS)
def test_nan_is_named(name):
    bad = np.array(example(truth=True)[name], float)
    bad.flat[0] = np.nan
    with pytest.raises(ValueError, match=f"^{name}: expected finite"):
        interaction_figure(**example(truth=True, **{name: bad}))


@pytest.mark.parametrize("name, factor", [("image", 255), ("next_image", 255), ("distance_predicted", -1),
                                          ("distance_observed", -1), ("start_heatmap", -1)])
def test_a_value_out_of_range_is_named(name, factor):
    with pytest.raises(ValueError, match=f"^{name}: expected numbers in"):
        interaction_figure(**example(**{name: factor * example()[name]}))


@pytest.mark.parametrize("bad", [0.0, -0.5, np.nan])
def test_a_bad_arena_is_named(bad):
    with pytest.raises(ValueError, match="^arena: expected"):
        interaction_figure(**example(arena=bad))


# --- training ----------------------------------------------------------------------------------------

LOG = [{"epoch": i, "step": 10 * i, "learning_rate": 1e-3, "chamfer": 0.1 / i, "photometric": 3.0 - i,
        "inverse": 9.0 - i} for i in range(1, 6)]


def test_one_panel_per_term():
    figure = training_figure(LOG)
    assert list(panels(figure)) == ["chamfer", "photometric", "inverse"]
    for name, axes in panels(figure).items():
        np.testing.assert_allclose(axes.lines[0].get_xydata(), [(entry["step"], entry[name]) for entry in LOG])
        assert axes.get_yscale() == ("linear" if name == "photometric" else "log")  # the one that is not positive
    assert "Eq. 2" in panels(figure)["chamfer"].get_title()


def test_a_single_epoch_and_an_unknown_term(tmp_path):
    figure = training_figure([{"step": 1, "surprise": 2.0}])
    assert panels(figure)["surprise"].get_title() == "surprise"
    save_figure(figure, tmp_path / "one.png")


@pytest.mark.parametrize("log", [[], [{"step": 1}], [{"chamfer": 1.0}], [*LOG, {"step": 60, "chamfer": 1.0}],
                                 [{"step": 1, "chamfer": np.nan}]])
def test_a_bad_log_is_named(log):
    with pytest.raises(ValueError, match="^log: "):
        training_figure(log)


# --- files -------------------------------------------------------------------------------------------

def test_files_are_whole_and_the_same_each_time(tmp_path):
    figure = interaction_figure(**example(truth=True))
    save_figure(figure, tmp_path / "new/a.png")
    save_figure(figure, tmp_path / "new/b.png")
    save_figure(interaction_figure(**example(truth=True)), tmp_path / "new/c.png")
    files = sorted((tmp_path / "new").iterdir())
    assert [path.name for path in files] == ["a.png", "b.png", "c.png"]
    first, again, made_again = (path.read_bytes() for path in files)
    assert first == again == made_again
    assert first.startswith(b"\x89PNG") and b"Software" not in first


def test_a_failed_save_leaves_the_old_file_and_nothing_else(tmp_path):
    class Broken(Figure):
        def savefig(self, path, **how):
            path.write_bytes(b"half a pict")
            raise OSError("disk full")

    (tmp_path / "a.png").write_bytes(b"old")
    with pytest.raises(OSError, match="disk full"):
        save_figure(Broken(), tmp_path / "a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert (tmp_path / "a.png").read_bytes() == b"old"


def test_only_png(tmp_path):
    with pytest.raises(ValueError, match="^path: expected"):
        save_figure(Figure(), tmp_path / "a.pdf")
    assert not list(tmp_path.iterdir())


def test_pyplot_is_not_imported():
    code = "import sys, hind4sight_min.figures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


# --- planning --------------------------------------------------------------------------------------------------------

def rounds_of_cem(rng, count=8):
    starts = rng.uniform(5, 15, (count, 2))
    costs = np.where(np.arange(count) == 2, np.inf, rng.uniform(1, 5, count))
    return starts, starts + [4.0, 2.0], costs


def test_population_figure_has_a_panel_per_round_and_marks_the_best():
    rng = np.random.default_rng(0)
    rounds = [rounds_of_cem(rng) for _ in range(3)]
    figure = figures.population_figure(np.full((20, 24, 3), 0.5), rounds, [[3.0, 4.0]], [[10.0, 12.0]])
    assert [axes.get_label() for axes in figure.axes] == ["round 1", "round 2", "round 3"]
    for axes, (starts, targets, costs) in zip(figure.axes, rounds):
        assert "7 of 8 possible" in axes.get_title() and f"{costs.min():.2f}" in axes.get_title()
        drawn = {tuple(np.round(line.get_xdata(), 6)) for line in axes.lines}
        best = int(costs.argmin())
        assert (round(starts[best, 0], 6), round(targets[best, 0], 6)) in drawn
        assert (round(starts[2, 0], 6), round(targets[2, 0], 6)) not in drawn  # what cannot be is not drawn
        lines = [line for line in axes.lines if len(line.get_xdata()) == 2]
        colour = {round(line.get_xdata()[0], 6): line.get_color() for line in lines}
        possible = np.argsort(costs)[:-1]
        brightness = [sum(colour[round(starts[i, 0], 6)][:3]) for i in possible]
        assert (np.diff(brightness) <= 0).all() and brightness[0] > brightness[-1] + 1  # cheap is bright
        (arrow,) = axes.patches
        np.testing.assert_allclose(arrow._posA_posB, [starts[best], targets[best]])
    with pytest.raises(ValueError, match="rounds"):
        figures.population_figure(np.zeros((4, 4, 3)), [], [[1.0, 1.0]], [[1.0, 1.0]])
    with pytest.raises(ValueError, match="goals"):
        figures.population_figure(np.zeros((4, 4, 3)), rounds, [[1.0, 1.0]], np.zeros((2, 2)))


def test_save_sequence_writes_a_frame_per_picture_or_nothing(tmp_path):
    from PIL import Image
    rng = np.random.default_rng(1)
    images = rng.random((3, 12, 16, 3))
    arrows = np.array([[[2.0, 3], [6, 7]], [[np.nan, np.nan], [6, 7]]])
    figures.save_sequence(tmp_path / "plan.gif", images, images[0], arrows, np.full((3, 1, 2), 5.0), [[8.0, 8.0]],
                          [0.1, 0.05, 0.01])
    with Image.open(tmp_path / "plan.gif") as picture:
        assert picture.n_frames >= 3
        first = np.asarray(picture.convert("RGB"))
        picture.seek(1)
        assert (np.asarray(picture.convert("RGB")) != first).any()
    assert [path.name for path in tmp_path.iterdir()] == ["plan.gif"]
    with pytest.raises(ValueError, match=".gif"):
        figures.save_sequence(tmp_path / "plan.png", images, None, arrows, np.zeros((3, 1, 2)), [[8.0, 8.0]], [0, 0, 0])
    with pytest.raises(ValueError, match="images"):
        figures.save_sequence(tmp_path / "new.gif", 2 + images, None, arrows, np.zeros((3, 1, 2)), [[1, 1]], [0, 0, 0])
    assert not (tmp_path / "new.gif").exists()


def a_sequence(path):
    arrows = np.array([[[2.0, 3], [6, 7]], [[np.nan, np.nan], [6, 7]]])
    figures.save_sequence(path, np.random.default_rng(1).random((3, 12, 16, 3)), None, arrows, np.full((3, 1, 2), 5.0),
                          [[8.0, 8.0]], [0.1, 0.05, 0.01])


def test_save_sequence_draws_the_pokes_that_have_a_start(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "draw_arrow", lambda axes, start, target: drawn.append((*start, *target)))
    a_sequence(tmp_path / "plan.gif")
    assert drawn == [(2, 3, 6, 7)]


@pytest.mark.parametrize("name", ["marks", "goals", "arrows", "distances"])
def test_save_sequence_names_what_does_not_fit(tmp_path, name):
    arguments = {"arrows": np.zeros((2, 2, 2)), "marks": np.zeros((3, 1, 2)), "goals": np.zeros((1, 2)),
                 "distances": np.zeros(3)}
    arguments[name] = arguments[name][..., None]
    with pytest.raises(ValueError, match=name):
        figures.save_sequence(tmp_path / "plan.gif", np.zeros((3, 12, 16, 3)), None, **arguments)
    assert not list(tmp_path.iterdir())


def test_a_failed_save_sequence_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    from matplotlib.animation import PillowWriter
    a_sequence(tmp_path / "plan.gif")
    old, real, count = (tmp_path / "plan.gif").read_bytes(), PillowWriter.grab_frame, []

    def full_disk(self, **options):
        count.append(1)
        if len(count) == 2:
            raise OSError("disk full")
        real(self, **options)
    monkeypatch.setattr(PillowWriter, "grab_frame", full_disk)
    with pytest.raises(OSError, match="disk full"):
        a_sequence(tmp_path / "plan.gif")
    assert [path.name for path in tmp_path.iterdir()] == ["plan.gif"] and (tmp_path / "plan.gif").read_bytes() == old


def test_control_figure_draws_boxes_and_means():
    rng = np.random.default_rng(2)
    curves = {(planner, objects): rng.random((6, 4)) * 0.1 for planner in ("learned", "oracle") for objects in (1, 2)}
    figure = figures.control_figure(curves, 3)
    assert [axes.get_label() for axes in figure.axes] == ["objects 1", "objects 2"]
    for axes, objects in zip(figure.axes, (1, 2)):
        lines = {line.get_label(): line.get_ydata() for line in axes.lines}
        np.testing.assert_allclose(lines["learned model, mean"], 100 * curves["learned", objects].mean(axis=0))
        np.testing.assert_allclose(lines["the simulator as the model"], 100 * curves["oracle", objects].mean(axis=0))
        medians = [line.get_ydata()[0] for line in axes.lines if len(line.get_xdata()) == 2
                   and line.get_color() is figures.PREDICTED and line.get_ydata()[0] == line.get_ydata()[1]]
        np.testing.assert_allclose(medians, 100 * np.median(curves["learned", objects], axis=0))
