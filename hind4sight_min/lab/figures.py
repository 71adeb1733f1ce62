"""Every picture. Each function returns a `matplotlib.figure.Figure`; nothing is shown, and pyplot with its global state
is not used.

Image panels show pixels as they are, (0, 0) top left. Arena panels are seen from above, in metres: x to the right, y
up, so that the camera looks in from the lower edge. A panel's Axes carry their name as label.
"""
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from matplotlib.patheffects import Normal, withStroke

from ..disk.files import whole_file
from ..geometry import project
from ..interactions import grid_shape
from ..losses import distance_maps, seen_in_both, warp_backward
from .evaluation import MOVING, true_motion

# Okabe and Ito's colours, which colour-blind readers can tell apart: one per mask (or object).
PALETTE = np.array([(230, 159, 0), (86, 180, 233), (0, 158, 115), (204, 121, 167), (240, 228, 66), (0, 114, 178),
                    (213, 94, 0)]) / 255
PREDICTED, TRUE, GOAL, POKE = PALETTE[5], PALETTE[6], PALETTE[4], "black"
OUTLINE = [withStroke(linewidth=3.5, foreground="white"), Normal()]  # lines stay visible on any picture


def _checked(name, value, *shape, low=-np.inf, high=np.inf):
    """`value` as a float array of this shape (None: any size) or a ValueError that says what is wrong."""
    value = np.asarray(value, float)
    if len(shape) != value.ndim or any(want not in (None, got) for want, got in zip(shape, value.shape)):
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name}: expected shape ({expected}), got {value.shape}")
    if not ((value >= low) & (value <= high) & np.isfinite(value)).all():
        raise ValueError(f"{name}: expected finite numbers in [{low}, {high}], got {value.min():g} to {value.max():g}")
    return value


# --- optical flow as colours ---------------------------------------------------------------------------

def flow_to_rgb(flow, scale):
    """Optical flow as colours: hue says where to, saturation how far; white does not move.

    Not in the paper: the usual way to look at (U, V) of Sec. III-C.
    hue = atan2(V, U) / 2 pi, saturation = min(|(U, V)| / scale, 1), value = 1 (HSV): right is red, down
    yellow-green, left cyan, up violet; opposite directions have complementary colours.
    flow (H, W, 2) px, V down; scale: the length in px drawn in full colour -> (H, W, 3) in [0, 1].
    Raises ValueError for another shape, for NaN, and for a scale that is not positive.
    """
    flow = _checked("flow", flow, None, None, 2)
    if not 0 < scale < np.inf:
        raise ValueError(f"scale: expected a finite number of pixels > 0, got {scale}")
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


def draw_arrow(axes, start, target):
    """The poke, with a white outline, from start to target (2,) in the panel's units. Not in the paper."""
    axes.add_patch(FancyArrowPatch(start, target, arrowstyle="-|>", mutation_scale=14, linewidth=2, color=POKE,
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


BELOW, ARENA = {"location": "bottom", "shrink": 0.8}, {"xlabel": "x [m]", "ylabel": "y [m]"}
VIEW_RATIO = 1.6  # width to height of the scene flow panel


def _draw_scene_flow(axes, image, points, flows, start, target, arena):
    """Arrows, true to length, over the points in their image colours; the view holds all arrows and the poke."""
    axes.scatter(*points[:, :2].T, c=0.45 + 0.55 * image, s=14, linewidths=0)
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
    axes.set(title="Scene flow from above (Eq. 1)", aspect="equal", xlim=(left, right), ylim=(bottom, top), **ARENA)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.02), frameon=False)


def _draw_flows(panels, flows, target):
    """Optical flows (H, W, 2) on one scale; on the first the wheel, above or below, away from the target (2,) px."""
    scale = max(1.0, *(np.linalg.norm(flow, axis=-1).max() for *_, flow in flows))  # px
    for label, title, flow in flows:
        show_image(panels[label], flow_to_rgb(flow, scale), title)
    axes, y = panels[flows[0][0]], 0.68 if target[1] > len(flows[0][2]) / 2 else 0.02
    wheel = axes.inset_axes((0.02, y, 0.24, 0.30))
    wheel.imshow(colour_wheel(64))
    wheel.axis("off")
    axes.text(0.28, y + 0.15, f"rim:\n{scale:.1f} px", fontsize=9, va="center", transform=axes.transAxes)


def _draw_heatmaps(panels, heatmaps, true, arena):
    """Two heat-maps over the arena's cells, and the true place (2,) m in each."""
    for which, symbol, heatmap, place in zip(("start", "end"), "AB", heatmaps, true):
        axes, half = panels[which], arena / 2
        axes.set(title=f"Inverse model: {which} $\\hat {symbol}_t$ (Sec. III-E)", **ARENA)
        shown = axes.imshow(heatmap, interpolation="nearest", origin="lower", cmap="cividis", vmin=0,
                            extent=(-half, half, -half, half))
        axes.plot(*place, "o", markersize=11, fillstyle="none", color=TRUE, markeredgewidth=2, path_effects=OUTLINE,
                  label=f"true {which}")
        axes.legend(loc="lower right" if place[1] > 0 else "upper right", framealpha=0.85)  # away from the mark
        axes.figure.colorbar(shown, ax=axes, label="probability")


# --- one poke, one training run ------------------------------------------------------------------------------

def interaction_figure(interactions, row, answer, truth):
    """One poke: what was seen, what the model says of it, what the losses see of that, and what is true. -> Figure

    Paper: the quantities of Fig. 3 and 4 (Eq. 1-3, Sec. III-C and III-E). answer: of `evaluation.ask` for this row;
    truth: of the whole data set. A mask's colour is its place in PALETTE, an object's that of its number.
    """
    camera, settings, before, after = interactions.camera, interactions.settings, answer.before, answer.after
    poke, start, shape = interactions.pokes[row], interactions.starts[row], (camera.height, camera.width)
    image, points, valid = before.images[0], before.points[0], before.valid[0]
    true, true_pixels, moving = true_motion(interactions, truth, row)
    figure = Figure(figsize=(14, 8.5), dpi=100, layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.7, 1))
    panels = {**upper.subplot_mosaic([["before", "masks", "labels", "flow", "true_flow"],
                                      ["after", "warped", "error", "distance_predicted", "distance_observed"]]),
              **lower.subplot_mosaic([["scene_flow", "start", "end"]], width_ratios=(1.7, 1, 1))}
    figure.suptitle(f"Poke to ({poke[0]:.2f}, {poke[1]:.2f}) m, direction {np.degrees(poke[2]):.0f}\u00b0", fontsize=13)

    arrow = on_table([start, poke[:2]], camera)
    show_image(panels["before"], image, "Before: image $I_t$\nand the poke $u_t$")
    draw_arrow(panels["before"], *arrow)
    show_image(panels["after"], after.images[0], "After: image $I_{t+1}$")
    masks, labels = answer.prediction.masks[0].reshape(*shape, -1), truth.labels[row]
    show_image(panels["masks"], blend(image, masks[..., 1:]), "Predicted masks $m_t^k$ (Eq. 1)\na colour each")
    numbers = np.arange(1, 1 + max(1, labels.max()))
    moved = (labels[..., None] == numbers) & np.isin(numbers, labels[moving.reshape(shape)])
    show_image(panels["labels"], blend(image, moved.astype(float)), "True objects that moved\n(colours of their own)")
    seen = valid.reshape(*shape, 1)
    _draw_flows(panels, [("flow", "Predicted optical flow\n(U, V), Sec. III-C", answer.flow * seen),
                         ("true_flow", "True optical flow\n(same colours)", true_pixels.reshape(*shape, 2) * seen)],
                arrow[1])

    shared, next_shared = seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
    warped, in_view = warp_backward(after.images, answer.flow[None])
    show_image(panels["warped"], np.clip(warped[0], 0, 1),
               "$\\hat I_t$: $I_{t+1}$ warped back\nalong the flow, Sec. III-C")
    error = np.abs(image - warped[0]).sum(axis=-1)  # Eq. (3) before the sum over pixels
    error = np.ma.array(error, mask=~(shared.reshape(shape) & in_view[0]))
    shown = show_image(panels["error"], error, "Photometric error $|I_t - \\hat I_t|$ (Eq. 3)\ngrey: not counted",
                       cmap=colormaps["magma"].with_extremes(bad="0.6"), vmin=0)
    figure.colorbar(shown, ax=panels["error"], label="sum over R, G, B", **BELOW)

    maps = distance_maps(answer.prediction.points, after.points, shared, next_shared)
    distances, both = 100 * np.sqrt(maps), [panels["distance_predicted"], panels["distance_observed"]]
    titles = "predicted to observed\n$D_{\\hat P \\to P}$", "observed to predicted\n$D_{P \\to \\hat P}$"
    for axes, title, distance in zip(both, titles, distances):
        shown = show_image(axes, distance.reshape(shape), f"Distance {title} (Eq. 2)", vmin=0, vmax=distances.max())
    figure.colorbar(shown, ax=both, label="square root of D, cm", **BELOW)

    flows = [(true[valid], TRUE, 0.026, "true"),  # first and wider, so that both are seen where they agree
             ((answer.prediction.points[0] - points)[valid], PREDICTED, 0.013, "predicted")]
    _draw_scene_flow(panels["scene_flow"], image.reshape(-1, 3)[valid], points[valid], flows, start, poke[:2],
                     settings["arena"])
    _draw_heatmaps(panels, [each.reshape(grid_shape(settings)) for each in answer.heatmaps], (start, poke[:2]),
                   settings["arena"])
    return figure


TERMS = {"chamfer": "$L_{CD}$ (Eq. 2), m$^2$", "distance_smoothness": "$L_{ds}$ (Eq. 5), m$^2$",
         "photometric": "$L_{rec}$ (Eq. 3), intensity", "flow_smoothness": "$L_{fs}$ (Eq. 4), px",
         "inverse": "$L_{inv}$ (Sec. III-E), nats", "binary_masks": "points between masks"}


def training_figure(log):
    """How each loss term fell: one panel per term against the step, y logarithmic where all of it is positive.

    Paper: the terms of Eq. (6), before their weights.
    log: list of dicts, one per epoch: "step", and each term by name (the mean over the epoch); "epoch" and
    "learning_rate" are not drawn -> Figure.
    Raises ValueError for an empty log, a term missing from an epoch, or a value that is not finite.
    """
    names = [name for name in (log or [{}])[0] if name not in ("epoch", "step", "learning_rate")]
    if not names or any(not {"step", *names} <= set(entry) for entry in log):
        raise ValueError(f"log: expected one epoch or more, each with 'step' and the terms {names or '(any)'}")
    values = {name: _checked(f"log: {name}", [entry[name] for entry in log], None) for name in ["step", *names]}
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(4 * columns, 2.8 * rows), dpi=100, layout="constrained")
    for i, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, i + 1, label=name)
        axes.plot(values["step"], values[name], ".-", color=PREDICTED, markersize=5, linewidth=1.5)
        if (values[name] > 0).all():
            axes.set_yscale("log")
        axes.set(title=f"{name.replace('_', ' ')}\n{TERMS.get(name, '')}".strip(), xlabel="step")
        axes.grid(alpha=0.3)
    return figure


# --- planning -----------------------------------------------------------------------------------------------------

def arrows_of(pokes, settings, camera):
    """Pokes (J, 3) as arrows of the shortest length: starts and targets, pixels (J, 2) each. Not in the paper."""
    back = settings["poke_length"][0] * np.stack([np.cos(pokes[:, 2]), np.sin(pokes[:, 2])], axis=1)
    return on_table(pokes[:, :2] - back, camera), on_table(pokes[:, :2], camera)


def _planning_panel(axes, picture, title, marks, goals, arrow):
    """A picture with the marked points as rings, where they shall be as stars, a line from one to the other, and a poke
    (start, target), all in px.
    """
    show_image(axes, picture, title)
    for mark, goal in zip(marks, goals):
        axes.plot(*np.transpose([mark, goal]), ":", color=GOAL, linewidth=1.5, path_effects=OUTLINE)
    axes.plot(*np.transpose(marks), "o", markersize=9, fillstyle="none", color=GOAL, markeredgewidth=2,
              path_effects=OUTLINE)
    axes.plot(*np.transpose(goals), "*", markersize=11, color=GOAL, markeredgecolor="black")
    if arrow is not None and np.isfinite(arrow).all():
        draw_arrow(axes, *arrow)
    axes.set(xlim=(-0.5, picture.shape[1] - 0.5), ylim=(picture.shape[0] - 0.5, -0.5))


def population_figure(image, rounds, marks, goals):
    """How CEM's population converges: a panel per round, every candidate's first poke as a line on the picture.

    Paper: Sec. III-H. image (H, W, 3) in [0, 1]. rounds: a list of (starts (J, 2) px, targets (J, 2) px, costs (J,)),
    the costs infinite for pokes that cannot be. marks, goals (M, 2) px -> Figure.
    Raises ValueError for wrong shapes or no round.
    """
    image = _checked("image", image, None, None, 3, low=0, high=1)
    if not rounds:
        raise ValueError("rounds: expected at least one, got none")
    marks, goals = _checked("marks", marks, None, 2), _checked("goals", goals, len(marks), 2)
    finite = np.concatenate([np.asarray(costs)[np.isfinite(costs)] for *_, costs in rounds])
    low, high = (finite.min(), np.quantile(finite, 0.9)) if len(finite) else (0, 1)
    figure = Figure(figsize=(3.4 * len(rounds), 3.3), dpi=100, layout="constrained")
    for i, (starts, targets, costs) in enumerate(rounds):
        axes = figure.add_subplot(1, len(rounds), i + 1, label=f"round {i + 1}")
        dear_first = [j for j in np.argsort(costs)[::-1] if np.isfinite(costs[j])]
        _planning_panel(axes, 0.45 + 0.5 * image.mean(axis=2, keepdims=True).repeat(3, axis=2),
                        f"Round {i + 1}: {len(dear_first)} of {len(costs)} possible\nlowest cost {np.min(costs):.2f}",
                        marks, goals, (starts[dear_first[-1]], targets[dear_first[-1]]) if dear_first else None)
        for j in dear_first:
            colour = colormaps["cividis"](1 - np.clip((costs[j] - low) / max(high - low, 1e-9), 0, 1))
            axes.plot(*np.transpose([starts[j], targets[j]]), color=colour, linewidth=1.2)
            axes.plot(*targets[j], ".", color=colour, markersize=5)
    figure.suptitle("CEM narrows its population down (yellow: cheap, blue: dear; arrow: the best of the round)",
                    fontsize=12)
    return figure


def save_sequence(path, images, goal_image, arrows, marks, goals, distances):
    """An animation of a planned sequence, written whole or not at all. Paper: Sec. IV-G, the figure of executed pokes.

    images (T+1, H, W, 3) in [0, 1]; goal_image (H, W, 3) or None; arrows (T, 2, 2) px: start and target of each poke
    (NaN: it could not be carried out); marks (T+1, M, 2) px; goals (M, 2) px; distances (T+1,) m: to the goals, mean.
    Raises ValueError for other shapes. path: its name ends in .gif.
    """
    from matplotlib.animation import PillowWriter
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    images = _checked("images", images, None, None, None, 3, low=0, high=1)
    goals = _checked("goals", goals, None, 2)
    marks = _checked("marks", marks, len(images), len(goals), 2)
    distances = _checked("distances", distances, len(images), low=0)
    _checked("arrows", np.nan_to_num(arrows), len(images) - 1, 2, 2)
    columns = 1 if goal_image is None else 2
    figure = Figure(figsize=(4.2 * columns, 3.7), dpi=80)
    figure.subplots_adjust(left=0.02, right=0.98, top=0.88, bottom=0.02, wspace=0.04)
    FigureCanvasAgg(figure)
    writer = PillowWriter(fps=1)
    with whole_file(path) as temporary, writer.saving(figure, str(temporary), dpi=80):
        for t, image in enumerate(images):
            figure.clear()
            last = t == len(images) - 1
            title = f"after {t} pokes: {100 * distances[t]:.1f} cm to go" + ("" if last else f"\nnext: poke {t + 1}")
            _planning_panel(figure.add_subplot(1, columns, 1), image, title, marks[t], goals,
                            None if last else arrows[t])
            if goal_image is not None:
                show_image(figure.add_subplot(1, columns, 2), goal_image, "goal\n")
            for _ in range(2 if last else 1):
                writer.grab_frame()


STYLES = {"learned": ("learned model, mean", PREDICTED, "-"),
          "oracle": ("the simulator as the model", PALETTE[2], "--"),
          "random": ("random pokes", PALETTE[3], ":"), "no_motion": ("model of no motion", "0.4", "-.")}


def control_figure(curves, pokes):
    """Distance to the goals against the number of pokes: boxes over the scenes, a panel per number of objects to move.

    Paper: Sec. IV-G, its box plot. curves: {(planner, objects): (scenes, pokes + 1) m}; "learned" is drawn as boxes,
    its mean and those of all other planners as lines.
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
    figure.axes[-1].legend(fontsize=8)
    figure.suptitle("Planned pokes bring the objects to their goals (boxes: quartiles over the scenes)", fontsize=12)
    return figure


# --- files --------------------------------------------------------------------------------------------------------

def save_figure(figure, path):
    """Write a figure as PNG, whole or not at all; the same figure gives the same bytes, however often.

    Not in the paper. The figure's layout stays as saved: a second pass would move panels by a hair.
    Raises ValueError for a path that does not end in .png.
    """
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"path: expected a name ending in .png, got {Path(path).name!r}")
    with whole_file(path) as temporary:
        if figure.get_layout_engine():
            figure.get_layout_engine().execute(figure)
            figure.set_layout_engine("none")
        figure.savefig(temporary, dpi="figure", metadata={"Software": None})
