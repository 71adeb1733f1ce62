"""Every picture. Each function returns a `matplotlib.figure.Figure`; nothing is shown, and pyplot with its global state
is not used.

Image panels show pixels as they are, (0, 0) top left. Arena panels are seen from above, in metres: x to the right, y
up, so that the camera looks in from the lower edge. A panel's Axes carry their name as label.
"""
from types import SimpleNamespace

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle
from matplotlib.patheffects import Normal, withStroke

from .. import check_number
from ..disk.files import check_output, whole_file
from ..geometry import project
from ..interactions import grid_shape
from ..losses import distance_maps, seen_in_both, warp_backward
from .evaluation import MOVING, true_motion

# --- the palette of every picture ------------------------------------------------------------------------
# Okabe and Ito's colours: readers with any of the common colour-vision deficiencies tell each from each.
ORANGE, SKY, GREEN, PINK, YELLOW, BLUE, RED = np.array([
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (204, 121, 167), (240, 228, 66), (0, 114, 178), (213, 94, 0)]) / 255
PALETTE = np.array([ORANGE, SKY, BLUE, RED, YELLOW, GREEN, PINK])  # one per mask or object; least like grey first
PREDICTED, TRUE, GOAL, POKE = BLUE, RED, YELLOW, "black"
TERM_COLOURS = {"chamfer": BLUE, "distance_smoothness": SKY, "photometric": RED, "flow_smoothness": ORANGE,
                "inverse": GREEN, "binary_masks": PINK}
DISTANCES, ERRORS, SHARES = "viridis", "magma", "cividis"  # colour maps: brighter is more, to every eye
OUTLINE = [withStroke(linewidth=3.5, foreground="white"), Normal()]  # lines stay visible on any picture


# --- optical flow as colours ---------------------------------------------------------------------------

def flow_to_rgb(flow, scale):
    """Optical flow as colours: hue says where to, saturation how far; white does not move.

    Not in the paper: the usual way to look at (U, V) of Sec. III-C.
    hue = atan2(V, U) / 2 pi, saturation = min(|(U, V)| / scale, 1), value = 1 (HSV): right is red, down
    yellow-green, left cyan, up violet; opposite directions have complementary colours.
    flow (H, W, 2) px, V down; scale: the length in px drawn in full colour -> (H, W, 3) in [0, 1].
    Raises ValueError for another shape, for NaN, and for a scale that is not positive.
    """
    if flow.ndim != 3 or flow.shape[2] != 2 or not np.isfinite(flow).all():
        raise ValueError(f"flow: expected finite pixels (H, W, 2), got shape {flow.shape}, or NaN or infinity")
    check_number("scale", scale, above=0)
    hue = np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi)
    full = np.clip(np.abs((6 * hue[..., None] + [0, 4, 2]) % 6 - 3) - 1, 0, 1)
    saturation = np.minimum(np.linalg.norm(flow, axis=-1) / scale, 1)
    return 1 - saturation[..., None] * (1 - full)


def colour_wheel(size):
    """The legend of `flow_to_rgb`: (size, size, 4) RGBA, each direction and length where its arrow would end.

    Not in the paper. The rim is the length `scale`; outside of it the picture is transparent.
    """
    v, u = np.mgrid[-1:1:size * 1j, -1:1:size * 1j]
    flow = np.stack([u, v], axis=-1)
    return np.dstack([flow_to_rgb(flow, 1.0), np.linalg.norm(flow, axis=-1) <= 1])


# --- panels ----------------------------------------------------------------------------------------------

def show_image(axes, picture, title, **how):
    """One image panel: pixels as they are, no ticks. Returns the image, for a colour bar. Not in the paper."""
    axes.set_title(title, fontsize=11)
    axes.set(xticks=[], yticks=[])
    return axes.imshow(picture, interpolation="nearest", **how)


def show_flow(axes, flow, scale, title):
    """Optical flow (H, W, 2) px as an image panel. Not in the paper. scale: as for `flow_to_rgb`.

    At every third pixel each way an arrow, true to length, says the same to those who cannot tell the colours.
    """
    shown = show_image(axes, flow_to_rgb(flow, scale), title)
    some = np.zeros(flow.shape[:2], bool)
    some[1::3, 1::3] = np.linalg.norm(flow[1::3, 1::3], axis=-1) > 0.1 * scale
    if some.any():
        rows, columns = np.nonzero(some)
        axes.quiver(columns, rows, *flow[some].T, angles="xy", scale_units="xy", scale=1, width=0.006, color="black")
    return shown


def draw_arrow(axes, start, target):
    """The poke, with a white outline, from start to target (2,) in the panel's units -> the patch. Not in the paper."""
    return axes.add_patch(FancyArrowPatch(start, target, arrowstyle="-|>", mutation_scale=14, linewidth=2, color=POKE,
                                          shrinkA=0, shrinkB=0, path_effects=OUTLINE, zorder=5))


def blend(image, weights):
    """Weights (H, W, K) of K colours over the grey image (H, W, 3); what they leave of 1 stays grey. Not in the paper.

    -> (H, W, 3) in [0, 1].
    """
    colours = PALETTE[np.arange(weights.shape[2]) % len(PALETTE)]
    weights = 0.85 * weights  # the texture below stays visible
    grey = 0.3 + 0.7 * image.mean(axis=-1, keepdims=True)
    return np.clip((1 - weights.sum(axis=2, keepdims=True)) * grey + weights @ colours, 0, 1)


def on_table(places, camera):
    """Places (..., 2) m on the arena's plane -> pixels (..., 2). Not in the paper."""
    places = np.asarray(places, float)
    return project(np.concatenate([places, 0 * places[..., :1]], axis=-1), camera)


def next_picture(image, flow, depth):
    """The next picture as predicted: each of its pixels takes its colour from where it comes from in this one.

    Not in the paper, which warps I_{t+1} back to compare (Sec. III-C); here the same `warp_backward` goes along the
    reversed flow. Of points that land on one pixel the nearest counts. Where none lands something comes to sight that
    nobody knows: it gets the colour that most of the picture has. image (H, W, 3) in [0, 1], flow (H, W, 2) px, depth
    (H, W) m of the predicted points -> (H, W, 3) in [0, 1].
    """
    height, width = depth.shape
    there = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + flow
    far_first = np.argsort(-depth, axis=None)
    moved = np.linalg.norm(flow, axis=-1) > 0.25  # px
    back = np.full(flow.shape, np.nan, np.float32)
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1), None):  # all around, against gaps; then, above that, the nearest
        cells = (np.rint(there) if corner is None else np.floor(there) + corner).astype(int)
        lands = (cells >= 0).all(axis=-1) & (cells < [width, height]).all(axis=-1) & (moved | (corner is None))
        order = far_first[lands.ravel()[far_first]]
        columns, rows = cells.reshape(-1, 2)[order].T
        back[rows, columns] = -flow.reshape(-1, 2)[order]
    warped = np.clip(warp_backward(image[None], np.nan_to_num(back)[None])[0][0], 0, 1)
    unknown = cv2.dilate(np.uint8(np.isnan(back[..., 0])), np.ones((3, 3), np.uint8)) > 0  # and the blurred rim
    unknown &= ~(np.linalg.norm(back, axis=-1) > 0.25)
    return np.where(unknown[..., None], np.median(image, axis=(0, 1)), warped)


def arrow_lines(starts, ends):
    """Arrows from starts to ends (n, 2) as polylines (n, 5, 2), which can be moved quickly. Not in the paper."""
    back = 0.3 * (starts - ends)
    aside = back[:, ::-1] * [0.5, -0.5]
    return np.stack([starts, ends, ends + back + aside, ends, ends + back - aside], axis=1)


def scene_flow_lines(points, flow, valid):
    """Some of the points (N, 3) m that move, as arrows seen from above: polylines (n, 5, 2). Not in the paper."""
    moving = np.flatnonzero(valid & (np.linalg.norm(flow, axis=1) > MOVING))
    moving = moving[::len(moving) // 16 + 1]
    return arrow_lines(points[moving, :2], (points + flow)[moving, :2])


BELOW, ARENA = {"location": "bottom", "shrink": 0.8}, {"xlabel": "x [m]", "ylabel": "y [m]"}
VIEW_RATIO = 1.6  # width to height of the scene flow panel


def _draw_scene_flow(axes, image, points, flows, start, target, arena):
    """Arrows, true to length, over the points in their image colours; the view holds all arrows and the poke."""
    axes.scatter(*points[:, :2].T, c=0.45 + 0.55 * image, s=14, linewidths=0)
    axes.plot([], [], "o", color="0.75", markersize=4, label="points seen,\nin their colours")
    inside = [start, target]
    for flow, colour, width, label in flows:
        moved = np.linalg.norm(flow, axis=1) > MOVING
        inside += [*points[moved, :2], *(points + flow)[moved, :2]]
        axes.quiver(*points[moved, :2].T, *flow[moved, :2].T, color=colour, angles="xy", scale_units="xy", scale=1,
                    units="inches", width=width, headwidth=0.06 / width, headlength=0.07 / width,
                    headaxislength=0.06 / width, zorder=4)
        axes.plot([], [], color=colour, linewidth=100 * width, label=f"{label}\n({moved.sum()} points)")
    draw_arrow(axes, start, target)
    axes.plot([], [], color=POKE, label="poke")
    inside = np.clip(inside, -0.6 * arena, 0.6 * arena)  # a wild prediction may leave the view
    centre, half = (inside.max(axis=0) + inside.min(axis=0)) / 2, np.ptp(inside, axis=0) / 2 + 0.02
    half = max(half[1], half[0] / VIEW_RATIO) * np.array([VIEW_RATIO, 1])
    (left, bottom), (right, top) = centre - half, centre + half
    axes.set(title="Scene flow, from above (Eq. 1)", aspect="equal", xlim=(left, right), ylim=(bottom, top), **ARENA)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.02), frameon=False)


def draw_wheel(axes, scale, low, right=False):
    """The legend of a flow in a corner of its panel: the wheel, and what its rim is, px. Not in the paper."""
    x, y = 0.54 if right else 0.02, 0.02 if low else 0.68
    wheel = axes.inset_axes((x, y, 0.24, 0.30))
    wheel.imshow(colour_wheel(64))
    wheel.axis("off")
    axes.text(x + 0.26, y + 0.15, f"rim:\n{scale:.1f} px", fontsize=9, va="center", transform=axes.transAxes)


def _draw_heatmap(axes, heatmap, place, arena, which, symbol):
    """A heat-map over the arena's cells, and the true place (2,) m in it."""
    half = arena / 2
    axes.set(title=f"Inverse model: {which} $\\hat {symbol}_t$ (Sec. III-E)", **ARENA)
    shown = axes.imshow(heatmap, interpolation="nearest", origin="lower", cmap=SHARES, vmin=0,
                        extent=(-half, half, -half, half))
    axes.plot(*place, "o", markersize=11, fillstyle="none", color=TRUE, markeredgewidth=2, path_effects=OUTLINE,
              label=f"true {which}")
    axes.legend(loc="lower right" if place[1] > 0 else "upper right", framealpha=0.85)  # away from the mark
    axes.figure.colorbar(shown, ax=axes, label="probability")


def _draw_losses(panels, answer):
    """What Eq. (3) and (2) compare: the warped image and its error, and the distance maps."""
    before, after, image = answer.before, answer.after, answer.before.images[0]
    valid, next_valid = seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
    warped, in_view = warp_backward(after.images, answer.flow[None])
    show_image(panels["warped"], np.clip(warped[0], 0, 1),
               "$\\hat I_t$: $I_{t+1}$ warped back along the flow;\nideally $I_t$, Sec. III-C")
    error = np.abs(image - warped[0]).sum(axis=-1)  # Eq. (3) before the sum over pixels
    error = np.ma.array(error, mask=~(valid.reshape(error.shape) & in_view[0]))
    shown = show_image(panels["error"], error, "Photometric error $|I_t - \\hat I_t|$ (Eq. 3)\ngrey: not counted",
                       cmap=colormaps[ERRORS].with_extremes(bad="0.6"), vmin=0)
    panels["error"].figure.colorbar(shown, ax=panels["error"], label="sum over R, G, B", **BELOW)
    distances = 100 * np.sqrt(distance_maps(answer.prediction.points, after.points, valid, next_valid))  # cm
    both = [panels["distance_predicted"], panels["distance_observed"]]
    titles = "predicted to observed\n$D_{\\hat P \\to P}$", "observed to predicted\n$D_{P \\to \\hat P}$"
    for axes, title, distance in zip(both, titles, distances):
        shown = show_image(axes, distance.reshape(error.shape), f"Distance {title} (Eq. 2)", cmap=DISTANCES,
                           vmin=0, vmax=distances.max())
    both[0].figure.colorbar(shown, ax=both, label="square root of D, cm", **BELOW)


# --- one poke, one training run ------------------------------------------------------------------------------

WHOLE = ["photo_before", "photo_after"]  # panels of the whole picture; the others show what its frame holds
NEAR_POKE = ["before", "after", "masks", "labels", "flow", "true_flow", "warped", "error", "distance_predicted",
             "distance_observed"]


def _interaction_panels(truth):
    """An empty figure -> it, and {label: Axes}. truth: whether there are panels for it."""
    figure = Figure(figsize=(13, 12.2), dpi=100, layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(3.05, 1))
    true_labels, true_flow = ("labels", "true_flow") if truth else (".", ".")  # a dot is an empty place
    return figure, {**upper.subplot_mosaic([["photo_before", "before", "masks", "flow"],
                                            ["photo_after", "after", true_labels, true_flow],
                                            ["warped", "error", "distance_predicted", "distance_observed"]]),
                    **lower.subplot_mosaic([["scene_flow", "start", "end"]], width_ratios=(1.7, 1, 1))}


def _draw_pictures(panels, images, photographs, arrow):
    """What the camera sees and what the model gets of it, before and after; the poke on what was before."""
    height, width = images[0].shape[:2]
    place = {"extent": (-0.5, width - 0.5, height - 0.5, -0.5)}  # a photograph's axes too are the model's pixels
    whole = images if photographs is None else photographs
    for name, symbol, image, photograph in zip(("before", "after"), ("I_t", "I_{t+1}"), images, whole):
        poke = ", and the poke $u_t$" if name == "before" else ""
        show_image(panels[f"photo_{name}"], photograph, f"{name.capitalize()}{poke}:\nwhat the camera sees", **place)
        show_image(panels[name], image, f"What the model gets: ${symbol}$,\n{width} x {height} pixels (framed part)")
    for name in ("photo_before", "before"):
        draw_arrow(panels[name], *arrow)


def zoom(near, whole, target, size):
    """Show half of the picture, around the poke's target (2,) px, and frame that part where the whole is shown.

    Not in the paper. near, whole: Axes; size: (width, height) px of the model's picture.
    """
    size = np.array(size)
    low = np.clip(target - size / 4, 0, size / 2) - 0.5
    for axes in near:
        axes.set(xlim=(low[0], low[0] + size[0] / 2), ylim=(low[1] + size[1] / 2, low[1]))
    for axes in whole:
        axes.add_patch(Rectangle(low, *(size / 2), fill=False, color="white", linewidth=1.5))


def _draw_motion(panels, interactions, row, answer, truth):
    """Masks, optical flow and scene flow, and beside them what is true, if that is known."""
    poke, start, before = interactions.pokes[row], interactions.starts[row], answer.before
    image, points, valid = before.images[0], before.points[0], before.valid[0]
    show_image(panels["masks"], blend(image, answer.prediction.masks[0, :, 1:].reshape(*image.shape[:2], -1)),
               "Predicted masks $m_t^k$ (Eq. 1):\na colour each, grey stays")
    flows = {"flow": answer.flow}
    arrows = [((answer.prediction.points[0] - points)[valid], PREDICTED, 0.013, "predicted")]
    if truth is not None:
        true, flows["true_flow"], moving = true_motion(interactions, truth, row)
        arrows.insert(0, (true[valid], TRUE, 0.026, "true"))  # first and wider, so that both are seen where they agree
        labels = truth.labels[row]
        numbers = np.arange(1, 1 + max(1, labels.max()))
        moved = (labels[..., None] == numbers) & np.isin(numbers, labels[moving.reshape(labels.shape)])
        show_image(panels["labels"], blend(image, moved.astype(float)),
                   "True objects that moved:\na colour each, grey stayed")
    flows = {name: (flow.reshape(-1, 2) * valid[:, None]).reshape(*image.shape[:2], 2) for name, flow in flows.items()}
    scale = max(1.0, *(np.linalg.norm(flow, axis=-1).max() for flow in flows.values()))  # px
    for name, title in (("flow", "Predicted optical flow\n(U, V), Sec. III-C"), ("true_flow", "True optical flow\n")):
        if name in flows:
            show_flow(panels[name], flows[name], scale, title)
    draw_wheel(panels["flow"], scale, poke[1] >= start[1], poke[0] < start[0])  # what moves leaves room behind
    _draw_scene_flow(panels["scene_flow"], image.reshape(-1, 3)[valid], points[valid], arrows, start, poke[:2],
                     interactions.settings["arena"])


def interaction_figure(interactions, row, answer, truth=None, photographs=None):
    """One poke: what was seen, what the model says of it, what the losses see of that, and what is true. -> Figure

    Paper: the quantities of Fig. 3 and 4 (Eq. 1-3, Sec. III-C and III-E). answer: of `evaluation.ask` for this row;
    truth: of the whole data set; without one its panels are left out. photographs: (before, after) of this row, of
    `sim.photographs`, in the place of the model's small pictures. A mask's colour is its place in PALETTE, an object's
    that of its number.
    """
    camera, poke, start = interactions.camera, interactions.pokes[row], interactions.starts[row]
    figure, panels = _interaction_panels(truth is not None)
    arrow = on_table([start, poke[:2]], camera)
    _draw_pictures(panels, (answer.before.images[0], answer.after.images[0]), photographs, arrow)
    _draw_motion(panels, interactions, row, answer, truth)
    _draw_losses(panels, answer)
    zoom([panels[name] for name in NEAR_POKE if name in panels], [panels[name] for name in WHOLE], arrow[1],
         (camera.width, camera.height))
    for which, symbol, heatmap, place in zip(("start", "end"), "AB", answer.heatmaps, (start, poke[:2])):
        _draw_heatmap(panels[which], heatmap.reshape(grid_shape(interactions.settings)), place,
                      interactions.settings["arena"], which, symbol)
    figure.suptitle(f"Poke to ({poke[0]:.2f}, {poke[1]:.2f}) m, direction {np.degrees(poke[2]):.0f}\u00b0", fontsize=13)
    return figure


TERMS = {"chamfer": "$L_{CD}$ (Eq. 2), m$^2$", "distance_smoothness": "$L_{ds}$ (Eq. 5), m$^2$",
         "photometric": "$L_{rec}$ (Eq. 3), intensity", "flow_smoothness": "$L_{fs}$ (Eq. 4), px",
         "inverse": "$L_{inv}$ (Sec. III-E), nats", "binary_masks": "points between masks"}


def training_figure(log, no_motion={}):
    """How each loss term fell: one panel per term against the step, y logarithmic where all of it is positive.

    Paper: the terms of Eq. (6), before their weights.
    log: of `runs.train_saving`: dicts, one per epoch, of "step" and each term by name (the mean over the epoch);
    "epoch" and "learning_rate" are not drawn. no_motion: the same of a model that moves nothing, dashed -> Figure.
    """
    names = [name for name in log[0] if name not in ("epoch", "step", "learning_rate")]
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(4 * columns, 2.8 * rows), dpi=100, layout="constrained")
    for i, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, i + 1, label=name)
        values = [entry[name] for entry in log]
        axes.plot([entry["step"] for entry in log], values, ".-", color=TERM_COLOURS.get(name, "black"), markersize=5,
                  linewidth=1.5)
        if name in no_motion:
            axes.axhline(no_motion[name], linestyle="--", color="0.4", linewidth=1.2, label="no motion")
            axes.legend(fontsize=8)
        if min(values) > 0:
            axes.set_yscale("log")
        axes.set(title=f"{name.replace('_', ' ')}\n{TERMS.get(name, '')}".strip(), xlabel="step")
        axes.grid(alpha=0.3)
    return figure


# --- the explorer -------------------------------------------------------------------------------------------------

EXPLORER = [["camera", "camera", "masks", "above"], ["camera", "camera", "flow", "above"],
            ["seen", "predicted", "truth", "distance"]]
TITLES = {"camera": "Now: click where the finger shall stop, drag the way it pushes",
          "masks": "Masks: what moves as one; grey stays", "flow": "Optical flow: where pixels go; white stays",
          "above": "Scene flow: where the points go, from above", "seen": "What the model sees: {} x {} pixels",
          "predicted": "Predicted: these pixels, warped by optical flow", "truth": "What really happened, after poke!",
          "distance": "Predicted to nearest seen point, in cm (Eq. 2)"}
SHOWN = 0.08  # m; so much flow has the full colour
BLANK = "0.93"  # grey


def explorer_panels(figure, camera, settings, buttons):
    """What the explorer draws on an empty figure -> a namespace of its artists. Not in the paper.

    live: those that follow the mouse, which are drawn by hand, in this order. axes, images: by the names in EXPLORER;
    image coordinates are pixels of the model's picture, whatever picture is shown. buttons: {key: text}.
    """
    width, height, half = camera.width, camera.height, 0.53 * settings["arena"]
    axes = figure.subplot_mosaic(EXPLORER, gridspec_kw={"left": 0.01, "right": 0.945, "top": 0.965, "bottom": 0.14,
                                                        "wspace": 0.06, "hspace": 0.17})
    images = {name: show_image(axes[name], np.full((height, width), np.nan), "", vmin=0, vmax=3,  # cm
                               extent=(-0.5, width - 0.5, height - 0.5, -0.5),
                               cmap=colormaps[DISTANCES].with_extremes(bad=BLANK)) for name in axes if name != "above"}
    for name, title in TITLES.items():
        axes[name].set_title(title.format(width, height), fontsize=9.5)
        axes[name].spines[:].set_visible(name == "above")
    bar = axes["distance"].inset_axes((0.1, -0.09, 0.6, 0.05))
    figure.colorbar(images["distance"], cax=bar, orientation="horizontal")
    above, view = axes["above"], axes["camera"]
    above.set(aspect="equal", anchor="N", xlim=(-half, half), ylim=(-half, half), **ARENA)
    above.yaxis.tick_right()
    above.yaxis.set_label_position("right")
    wheel = above.inset_axes((0.76, -0.38, 0.22, 0.22))
    wheel.imshow(colour_wheel(96))
    wheel.axis("off")
    above.text(0.74, -0.35, f"optical flow's colours, rim: {SHOWN / camera.pixel_size:.0f} px", fontsize=8.5,
               ha="right", transform=above.transAxes)

    def lines(axes, colour, width, label=None):
        axes.plot([], [], color=colour, label=label)
        return axes.add_collection(LineCollection([], colors=[colour], linewidths=width))
    art = SimpleNamespace(
        axes=axes, images=images, points=above.scatter([], [], s=9, linewidths=0),
        true=lines(above, TRUE, 2.6, "true, after poke!"),
        predicted=lines(above, PREDICTED, 1.1, "predicted"),
        others=lines(view, "white", 0.8), elites=lines(view, GOAL, 1.6),
        arrows=[draw_arrow(each, (0, 0), (1, 1)) for each in (view, axes["seen"], above)],
        ways=view.plot([], [], ":", color=GOAL, linewidth=1.5, path_effects=OUTLINE)[0],
        rings=view.plot([], [], "o", color=GOAL, markersize=11, fillstyle="none", markeredgewidth=2,
                        path_effects=OUTLINE)[0],
        stars=view.plot([], [], "*", color=GOAL, markersize=13, markeredgecolor="black")[0],
        text=view.text(0.012, 0.068, "", fontsize=10.5, transform=figure.transFigure),
        buttons={key: figure.text(0.02 + 0.125 * i, 0.022, text, bbox={"boxstyle": "round", "facecolor": BLANK,
                                                                       "edgecolor": "0.5"})
                 for i, (key, text) in enumerate(buttons.items())})
    above.legend(loc="upper left", bbox_to_anchor=(0, -0.14), fontsize=8.5, frameon=False)
    art.live = [*(images[name] for name in ("masks", "flow", "predicted")), art.predicted, art.others, art.elites,
                *art.arrows, art.ways, art.rings, art.stars, art.text]
    for artist in art.live:
        artist.set_animated(True)
    return art


# --- planning -----------------------------------------------------------------------------------------------------

def save_sequence(path, record, camera):
    """An animation of executed pokes: marked points as rings, where they shall be as stars, the next poke, the goal.

    Paper: Sec. IV-G, its figure of a sequence. record: of `control.closed_loop`; with "photographs", of each state, and
    "goal_photograph" these are shown, and beside them what the model gets. path: its name ends in .gif; it is written
    whole or not at all.
    """
    from matplotlib.animation import PillowWriter
    last, pictures = len(record["pokes"]), record.get("photographs", record["rgb"])
    distance = 100 * record["distance"].mean(axis=1)  # cm
    beside = [(record["rgb"], f"what the model gets:\n{camera.width} x {camera.height} pixels")]
    beside = beside if "photographs" in record else []
    if "goal_rgb" in record:
        beside.append(([record.get("goal_photograph", record["goal_rgb"])] * (last + 1), "the goal\n"))
    figure = Figure(figsize=(4.2 * (1 + len(beside)), 3.7), dpi=80)
    margins = {"left": 0.01, "right": 0.99, "top": 0.88, "bottom": 0.02, "wspace": 0.04}
    writer, place = PillowWriter(fps=1), {"extent": (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)}
    with whole_file(path) as temporary, writer.saving(figure, str(temporary), dpi=80):
        for t, picture in enumerate(pictures):
            figure.clear()
            panels = figure.subplots(1, 1 + len(beside), squeeze=False, gridspec_kw=margins)[0]
            title = f"after {t} pokes: {distance[t]:.1f} cm to go"
            show_image(panels[0], picture, title if t == last else f"{title}\nnext: poke {t + 1}", **place)
            _draw_marks(panels[0], record, t, camera)
            for axes, (others, name) in zip(panels[1:], beside):
                show_image(axes, others[t], name, **place)
            for _ in range(2 if t == last else 1):
                writer.grab_frame()


def _draw_marks(axes, record, t, camera):
    """Marked points and their goals after t pokes, and the next poke, if the finger found room for it."""
    marks, goals = project(record["marks"][t], camera), record["goal_marks"]
    for mark, goal in zip(marks, goals):
        axes.plot(*np.transpose([mark, goal]), ":", color=GOAL, linewidth=1.5, path_effects=OUTLINE)
    axes.plot(*marks.T, "o", markersize=9, fillstyle="none", color=GOAL, markeredgewidth=2, path_effects=OUTLINE)
    axes.plot(*goals.T, "*", markersize=11, color=GOAL, markeredgecolor="black")
    if t < len(record["pokes"]) and np.isfinite(record["starts"][t]).all():
        draw_arrow(axes, *on_table([record["starts"][t], record["pokes"][t, :2]], camera))
    axes.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5))


def save_film(path, frames, seconds):
    """Write pictures (H, W, 3) uint8 as a GIF that goes on for ever, whole or not at all. Not in the paper.

    One palette for all: what is frequent, and what is rare but of its own colour. seconds: how long each is shown.
    Raises ValueError for a path that does not end in .gif.
    """
    from PIL import Image
    check_output("path", path, ".gif")
    some = Image.fromarray(np.concatenate(frames[::len(frames) // 8 + 1])[::2, ::2])
    frequent, rare = (some.quantize(count, method).getpalette() for count, method in (
        (192, Image.Quantize.MEDIANCUT), (64, Image.Quantize.MAXCOVERAGE)))
    palette = Image.new("P", (1, 1))
    palette.putpalette(frequent[:3 * 192] + rare[:3 * 64])
    first, *others = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    with whole_file(path) as temporary:
        first.save(temporary, save_all=True, append_images=others, duration=round(1000 * seconds), loop=0)


STYLES = {"learned": ("learned model, up to three pokes ahead", PREDICTED, "-"),
          "oracle": ("the simulator as the model, one ahead", GREEN, "--"),
          "random": ("random pokes", PINK, ":"), "no_motion": ("model of no motion", "0.4", "-.")}


def control_figure(curves, pokes):
    """Distance to the goals against the number of pokes: boxes over the scenes, a panel per number of objects to move.

    Paper: Sec. IV-G, its box plot. curves: {(planner, objects): (scenes, pokes + 1) m}; "learned" is drawn as boxes,
    its mean and those of the other planners of STYLES as lines.
    """
    numbers = sorted({objects for _, objects in curves})
    figure = Figure(figsize=(11, 3.8), dpi=100, layout="constrained")
    for i, objects in enumerate(numbers):
        axes = figure.add_subplot(1, len(numbers), i + 1, label=f"objects {objects}")
        for planner, (name, colour, line) in STYLES.items():
            if (planner, objects) in curves:
                distance = 100 * np.asarray(curves[planner, objects])
                if planner == "learned":
                    axes.boxplot(distance, positions=range(pokes + 1), widths=0.55, flierprops={
                        "marker": ".", "markersize": 4}, medianprops={"color": PREDICTED}, manage_ticks=False)
                axes.plot(range(pokes + 1), distance.mean(axis=0), line, color=colour, linewidth=1.8, label=name)
        axes.set(title=f"{objects} object{'s' if objects > 1 else ''} to move", xlabel="pokes", ylim=(0, None),
                 xticks=range(0, pokes + 1, 2))
        axes.grid(alpha=0.3, axis="y")
    figure.axes[0].set_ylabel("mean distance to the goals [cm]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(STYLES))
    figure.suptitle("Planned pokes bring the objects to their goals (boxes: quartiles over the scenes, lines: means)",
                    fontsize=12)
    return figure


# --- files --------------------------------------------------------------------------------------------------------

def save_figure(figure, path):
    """Write a figure as PNG, whole or not at all; the same figure gives the same bytes, however often.

    Not in the paper. The figure's layout stays as saved: a second pass would move panels by a hair.
    Raises ValueError for a path that does not end in .png.
    """
    check_output("path", path, ".png")
    with whole_file(path) as temporary:
        if figure.get_layout_engine():
            figure.get_layout_engine().execute(figure)
            figure.set_layout_engine("none")
        figure.savefig(temporary, dpi="figure", metadata={"Software": None})
