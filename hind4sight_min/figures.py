"""Every picture. Each function takes plain arrays and returns a `matplotlib.figure.Figure`; nothing is
shown, nothing is saved (but by `save_figure`), and pyplot with its global state is not used.

Image panels show pixels as they are, (0, 0) top left. Arena panels are seen from above, in metres: x to the
right, y up, so that the camera looks in from the lower edge.
"""
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch
from matplotlib.patheffects import Normal, withStroke
from matplotlib.ticker import LogFormatter

from .interactions import whole_file

# Okabe and Ito's colours, which colour-blind readers can tell apart: one per mask (or object).
PALETTE = np.array([(230, 159, 0), (86, 180, 233), (0, 158, 115), (204, 121, 167), (240, 228, 66), (0, 114, 178),
                    (213, 94, 0)]) / 255
PREDICTED, TRUE, POKE = PALETTE[5], PALETTE[6], "black"
SHOWN = 1e-3  # m; a shorter scene flow gets no arrow, as in the metrics over moving points
MAGMA = colormaps["magma"].with_extremes(bad="0.6")
OUTLINE = [withStroke(linewidth=3.5, foreground="white"), Normal()]  # lines stay visible on any picture


def _checked(name, value, *shape, low=-np.inf, high=np.inf):
    """`value` as a float array of this shape (None: any size) or a ValueError that says what is wrong."""
    value = np.asarray(value, float)
    if len(shape) != value.ndim or any(want not in (None, got) for want, got in zip(shape, value.shape)):
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name}: expected shape ({expected}), got {value.shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    if not ((value >= low) & (value <= high)).all():
        raise ValueError(f"{name}: expected numbers in [{low}, {high}], got {value.min():g} to {value.max():g}")
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
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"scale: expected a finite number of pixels > 0, got {scale}")
    hue = np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi)
    full = np.clip(np.abs((6 * hue[..., None] + [0, 4, 2]) % 6 - 3) - 1, 0, 1)
    saturation = np.minimum(np.linalg.norm(flow, axis=-1) / scale, 1)
    return 1 - saturation[..., None] * (1 - full)


def colour_wheel(size):
    """The legend of `flow_to_rgb`: (size, size, 4) RGBA, each direction and length where its arrow would end.

    Not in the paper. The rim is the length `scale`; outside of it the picture is transparent.
    Raises ValueError for a size below 2 pixels.
    """
    if size < 2:
        raise ValueError(f"size: expected at least 2 pixels, got {size}")
    v, u = np.mgrid[-1:1:size * 1j, -1:1:size * 1j]
    flow = np.stack([u, v], axis=-1)
    inside = np.linalg.norm(flow, axis=-1) <= 1
    return np.dstack([flow_to_rgb(flow, 1.0), inside])


# --- panels ----------------------------------------------------------------------------------------------

def show_image(axes, picture, title, **how):
    """One image panel: pixels as they are, no ticks. Returns the image, for a colour bar."""
    axes.set_title(title, fontsize=11)
    axes.set_xticks([])
    axes.set_yticks([])
    return axes.imshow(picture, interpolation="nearest", **how)


def _colour_bar(figure, image, axes, label, **how):
    bar = figure.colorbar(image, ax=axes, aspect=30, pad=0.02, **how)
    bar.set_label(label, fontsize=10)
    bar.ax.tick_params(labelsize=9)


def draw_arrow(axes, start, target):
    """The poke, with a white outline. The view stays as it is."""
    axes.add_patch(FancyArrowPatch(start, target, arrowstyle="-|>", mutation_scale=14, linewidth=2, color=POKE,
                                   shrinkA=0, shrinkB=0, path_effects=OUTLINE, zorder=5))


def _arena_panel(axes, title):
    axes.set_title(title, fontsize=11)
    axes.set_xlabel("x [m]", fontsize=10)
    axes.set_ylabel("y [m]", fontsize=10)
    axes.tick_params(labelsize=9)
    axes.locator_params(nbins=6)


def blend(image, weights):
    """Weights (H, W, K) of K colours over the grey image; what they leave of 1 stays grey."""
    colours = PALETTE[np.arange(weights.shape[2]) % len(PALETTE)]
    weights = 0.85 * weights  # the texture below stays visible
    grey = 0.3 + 0.7 * image.mean(axis=-1, keepdims=True)
    return np.clip((1 - weights.sum(axis=2, keepdims=True)) * grey + weights @ colours, 0, 1)


VIEW_RATIO = 1.6  # width to height of the scene flow panel


def _draw_scene_flow(axes, image, points, flows, start, target, arena):
    """Arrows, true to length, over the points in their image colours; the view holds all arrows and the poke."""
    axes.scatter(*points[:, :2].T, c=0.45 + 0.55 * image, s=14, linewidths=0)
    inside, handles = [start, target], []
    for flow, colour, width, label in flows:
        moved = np.linalg.norm(flow, axis=1) > SHOWN
        inside += [*points[moved, :2], *(points + flow)[moved, :2]]
        axes.quiver(*points[moved, :2].T, *flow[moved, :2].T, color=colour, angles="xy", scale_units="xy", scale=1,
                    units="inches", width=width, headwidth=0.06 / width, headlength=0.07 / width,
                    headaxislength=0.06 / width, zorder=4)
        handles.append(Line2D([], [], color=colour, linewidth=100 * width, label=f"{label}\n({moved.sum()} points)"))
    draw_arrow(axes, start, target)
    handles.append(Line2D([], [], color=POKE, linewidth=2, label="poke"))
    inside = np.clip(inside, -0.6 * arena, 0.6 * arena)  # a wild prediction may leave the view
    centre, half = (inside.max(axis=0) + inside.min(axis=0)) / 2, np.ptp(inside, axis=0) / 2 + 0.02
    half = max(half[1], half[0] / VIEW_RATIO) * np.array([VIEW_RATIO, 1])
    axes.set(aspect="equal", xlim=(centre[0] - half[0], centre[0] + half[0]),
             ylim=(centre[1] - half[1], centre[1] + half[1]))
    axes.legend(handles=handles, fontsize=10, loc="upper left", bbox_to_anchor=(1.01, 1.02), frameon=False)


def _draw_flows(panels, flows):
    """Optical flows on one scale, so that their colours compare; the wheel and its rim's length on the first."""
    scale = max(1.0, *(np.linalg.norm(flow, axis=-1).max() for *_, flow in flows))  # px
    for label, title, flow in flows:
        show_image(panels[label], flow_to_rgb(flow, scale), title)
    label, _, flow = flows[0]
    axes, length = panels[label], np.linalg.norm(flow, axis=-1)
    (middle_y, middle_x), quarters = np.array(length.shape) // 2, {}
    for x, columns in ((0.74, np.s_[middle_x:]), (0.02, np.s_[:middle_x])):  # in the quarter with the least flow
        for y, rows in ((0.68, np.s_[:middle_y]), (0.02, np.s_[middle_y:])):
            quarters[x, y] = length[rows, columns].sum()
    x, y = min(quarters, key=quarters.get)
    wheel = axes.inset_axes((x, y, 0.24, 0.30))
    wheel.imshow(colour_wheel(64))
    wheel.axis("off")
    beside, side = (x - 0.02, "right") if x > 0.5 else (x + 0.26, "left")
    axes.text(beside, y + 0.15, f"rim:\n{scale:.1f} px", fontsize=9, ha=side, va="center", transform=axes.transAxes)


def _draw_error(figure, axes, image, warped, flow, shared):
    """The photometric error of each pixel; grey where the flow leaves the picture or the pixel is not `shared`."""
    (height, width), margin = shared.shape, 1e-3  # px, as in losses.warp_backward
    v, u = np.mgrid[:height, :width]
    x, y = u + flow[..., 0], v + flow[..., 1]
    counted = shared & (x >= -margin) & (x <= width - 1 + margin) & (y >= -margin) & (y <= height - 1 + margin)
    error = np.abs(image - warped).sum(axis=-1)  # Eq. (3) before the sum over pixels
    shown = show_image(axes, np.ma.array(error, mask=~counted), "Photometric error $|I_t - \\hat I_t|$ (Eq. 3)\n"
                       "grey: not counted", cmap=MAGMA, vmin=0, vmax=max(0.1, (error * counted).max()))
    _colour_bar(figure, shown, axes, "sum over R, G, B", location="bottom", shrink=0.8)


def _draw_distances(figure, panels, maps):
    """Both distance maps, (H, W) m^2, as distances in cm on one scale."""
    titles = ("Distance predicted to observed\n$D_{\\hat P \\to P}$ (Eq. 2)",
              "Distance observed to predicted\n$D_{P \\to \\hat P}$ (Eq. 2)")
    distances = [100 * np.sqrt(squared) for squared in maps]
    top = max(0.1, *(distance.max() for distance in distances))
    for axes, title, distance in zip(panels, titles, distances):
        shown = show_image(axes, distance, title, cmap="viridis", vmin=0, vmax=top)
    _colour_bar(figure, shown, panels, "square root of D, cm", location="bottom", shrink=0.8)


def _draw_heatmap(figure, axes, heatmap, which, symbol, true, arena):
    """A heat-map over the arena's cells, and the true place in it."""
    _arena_panel(axes, f"Inverse model: {which} $\\hat {symbol}_t$ (Sec. III-E)")
    half = arena / 2
    shown = axes.imshow(heatmap, interpolation="nearest", origin="lower", cmap="cividis", vmin=0,
                        vmax=heatmap.max() or 1, extent=(-half, half, -half, half))
    axes.plot(*true, "o", markersize=11, fillstyle="none", color=TRUE, markeredgewidth=2, path_effects=OUTLINE,
              label=f"true {which}")
    corner = "lower right" if true[1] > 0 else "upper right"  # away from the mark
    axes.legend(fontsize=9, loc=corner, framealpha=0.85)
    _colour_bar(figure, shown, axes, "probability")


def _layout(images):
    """An empty figure: image panels in two rows, the three arena panels below -> Figure, {label: Axes}."""
    figure = Figure(figsize=(14, 8.5), dpi=100, layout="constrained")
    upper, lower = figure.add_gridspec(2, 1, height_ratios=(1.7, 1))
    columns = -(-len(images) // 2)
    cells = [*upper.subgridspec(2, columns)][:len(images)] + [*lower.subgridspec(1, 3, width_ratios=(1.7, 1, 1))]
    labels = [*images, "scene_flow", "start", "end"]
    return figure, {label: figure.add_subplot(cell, label=label) for label, cell in zip(labels, cells)}


# --- figures -----------------------------------------------------------------------------------------------

def interaction_figure(*, image, next_image, points, scene_flow, masks, optical_flow, warped, distance_predicted,
                       distance_observed, start_heatmap, end_heatmap, arena, poke, start, poke_pixels, valid=None,
                       shared=None, true_scene_flow=None, true_optical_flow=None, true_labels=None, title=None):
    """One interaction: what was seen, what the model says of it, and what the losses see of that. -> Figure

    Paper: the quantities of Fig. 3 and 4 (Eq. 1-3, Sec. III-C and III-E), for one poke.
    image, next_image (H, W, 3) in [0, 1]: I_t, I_{t+1}. points (H, W, 3) m, arena. scene_flow (H, W, 3) m,
    arena: P'_{t+1} - P_t. masks (H, W, K), 0 = background. optical_flow (H, W, 2) px. warped (H, W, 3): I'_t.
    distance_predicted, distance_observed (H, W) m^2: D_{P'->P} on frame t's grid, D_{P->P'} on frame t+1's.
    start_heatmap, end_heatmap (rows, columns), rows along y: A_t, B_t. arena: the arena's side in m.
    poke (3,), (m, m, rad). start (2,) m. poke_pixels (2, 2) px: the poke's start and target in the image.
    Optional: valid (H, W) bool, pixels with depth (default all); the flow of others is left out. shared (H, W)
    bool: pixels whose photometric error counts (default valid). true_scene_flow (H, W, 3) m, true_optical_flow
    (H, W, 2) px. true_labels (H, W) int: 0, or the number of the object that moved there. title: replaces the one
    that tells the poke.
    Each panel's Axes carry their name as label. A mask's colour is its place in PALETTE.
    Raises ValueError naming the argument for a wrong shape, a number that is not finite or out of its range.
    """
    image = _checked("image", image, None, None, 3, low=0, high=1)
    size = image.shape[:2]
    next_image = _checked("next_image", next_image, *size, 3, low=0, high=1)
    warped = _checked("warped", warped, *size, 3)
    points, scene_flow = _checked("points", points, *size, 3), _checked("scene_flow", scene_flow, *size, 3)
    masks, optical_flow = _checked("masks", masks, *size, None), _checked("optical_flow", optical_flow, *size, 2)
    maps = [_checked("distance_predicted", distance_predicted, *size, low=0),
            _checked("distance_observed", distance_observed, *size, low=0)]
    start_heatmap = _checked("start_heatmap", start_heatmap, None, None, low=0)
    end_heatmap = _checked("end_heatmap", end_heatmap, None, None, low=0)
    poke, start = _checked("poke", poke, 3), _checked("start", start, 2)
    poke_pixels = _checked("poke_pixels", poke_pixels, 2, 2)
    if not (np.isfinite(arena) and arena > 0):
        raise ValueError(f"arena: expected a finite number of metres > 0, got {arena}")
    valid = np.ones(size, bool) if valid is None else _checked("valid", valid, *size) > 0
    shared = valid if shared is None else valid & (_checked("shared", shared, *size) > 0)

    flows = [("flow", "Predicted optical flow\n(U, V), Sec. III-C", optical_flow * valid[..., None])]
    arrows = [(scene_flow[valid], PREDICTED, 0.013, "predicted")]
    if true_optical_flow is not None:
        true_optical_flow = _checked("true_optical_flow", true_optical_flow, *size, 2)
        flows.append(("true_flow", "True optical flow\n(same colours)", true_optical_flow * valid[..., None]))
    if true_scene_flow is not None:  # drawn first and wider, so that both are seen where they agree
        arrows.insert(0, (_checked("true_scene_flow", true_scene_flow, *size, 3)[valid], TRUE, 0.026, "true"))

    figure, panels = _layout(["before", "masks", *(["labels"] if true_labels is not None else []),
                              *(label for label, *_ in flows), "after", "warped", "error", "distance_predicted",
                              "distance_observed"])
    figure.suptitle(title or f"Poke to ({poke[0]:.2f}, {poke[1]:.2f}) m, direction {np.degrees(poke[2]):.0f}\u00b0",
                    fontsize=13)
    show_image(panels["before"], image, "Before: image $I_t$\nand the poke $u_t$")
    draw_arrow(panels["before"], *poke_pixels)
    show_image(panels["after"], next_image, "After: image $I_{t+1}$")
    show_image(panels["masks"], blend(image, masks[..., 1:]), "Predicted masks $m_t^k$ (Eq. 1)\na colour each")
    if true_labels is not None:
        true_labels = _checked("true_labels", true_labels, *size, low=0)
        moved = true_labels[..., None] == np.arange(1, int(true_labels.max()) + 1)
        show_image(panels["labels"], blend(image, moved.astype(float)),
                   "True objects that moved\n(colours of their own)")
    _draw_flows(panels, flows)
    show_image(panels["warped"], np.clip(warped, 0, 1),
               "$\\hat I_t$: $I_{t+1}$ warped back\nalong the flow, Sec. III-C")
    _draw_error(figure, panels["error"], image, warped, optical_flow, shared)
    _draw_distances(figure, [panels["distance_predicted"], panels["distance_observed"]], maps)
    _arena_panel(panels["scene_flow"], "Scene flow from above (Eq. 1)")
    _draw_scene_flow(panels["scene_flow"], image[valid], points[valid], arrows, start, poke[:2], arena)
    _draw_heatmap(figure, panels["start"], start_heatmap, "start", "A", start, arena)
    _draw_heatmap(figure, panels["end"], end_heatmap, "end", "B", poke[:2], arena)
    return figure


TERMS = {"chamfer": "$L_{CD}$ (Eq. 2), m$^2$", "distance_smoothness": "$L_{ds}$ (Eq. 5), m$^2$",
         "photometric": "$L_{rec}$ (Eq. 3), intensity", "flow_smoothness": "$L_{fs}$ (Eq. 4), px",
         "inverse": "$L_{inv}$ (Sec. III-E), nats", "sharing": "not in the paper"}


def training_figure(log):
    """How each loss term fell: one panel per term against the step, y logarithmic where all of it is positive.

    Paper: the terms of Eq. (6), before their weights.
    log: list of dicts, one per epoch: "step", and each term by name (the mean over the epoch); "epoch" and
    "learning_rate" are not drawn -> Figure.
    Raises ValueError for an empty log, a term missing from an epoch, or a value that is not finite.
    """
    if not log:
        raise ValueError("log: expected at least one epoch, got none")
    names = [name for name in log[0] if name not in ("epoch", "step", "learning_rate")]
    if not names or any(not {"step", *names} <= set(entry) for entry in log):
        raise ValueError(f"log: expected 'step' and the terms {names or '(any)'} in every epoch")
    values = {name: _checked(f"log: {name}", [entry[name] for entry in log], None) for name in ["step", *names]}
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(4 * columns, 2.8 * rows), dpi=100, layout="constrained")
    for i, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, i + 1, label=name)
        axes.plot(values["step"], values[name], ".-", color=PREDICTED, markersize=5, linewidth=1.5)
        if (values[name] > 0).all():
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(LogFormatter())  # 2e-02, and 20: shorter than powers of ten
            axes.yaxis.set_minor_formatter(LogFormatter())
        axes.set_title(f"{name.replace('_', ' ')}\n{TERMS.get(name, '')}".strip(), fontsize=11)
        axes.set_xlabel("step", fontsize=10)
        axes.tick_params(labelsize=9, which="both")
        axes.grid(alpha=0.3)
    return figure


# --- planning -------------------------------------------------------------------------------------------------------

GOAL = PALETTE[4]


def _draw_marks(axes, marks, goals):
    """The marked points as rings, where they shall be as stars, and a line from one to the other."""
    for mark, goal in zip(marks, goals):
        axes.plot(*np.transpose([mark, goal]), ":", color=GOAL, linewidth=1.5, path_effects=OUTLINE)
    axes.plot(*np.transpose(marks), "o", markersize=9, fillstyle="none", color=GOAL, markeredgewidth=2,
              path_effects=OUTLINE, label="marked point")
    axes.plot(*np.transpose(goals), "*", markersize=11, color=GOAL, markeredgecolor="black", label="its goal")


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
    colours = colormaps["cividis"]
    figure = Figure(figsize=(3.4 * len(rounds), 3.3), dpi=100, layout="constrained")
    for i, (starts, targets, costs) in enumerate(rounds):
        axes = figure.add_subplot(1, len(rounds), i + 1, label=f"round {i + 1}")
        possible = np.flatnonzero(np.isfinite(costs))
        show_image(axes, 0.45 + 0.5 * image.mean(axis=2, keepdims=True).repeat(3, axis=2),
                   f"Round {i + 1}: {len(possible)} of {len(costs)} possible\nlowest cost {np.min(costs):.2f}")
        for j in possible[np.argsort(-np.asarray(costs)[possible])]:
            shade = np.clip((costs[j] - low) / max(high - low, 1e-9), 0, 1)
            axes.plot(*np.transpose([starts[j], targets[j]]), color=colours(1 - shade), linewidth=1.2)
            axes.plot(*targets[j], ".", color=colours(1 - shade), markersize=5)
        if len(possible):
            best = int(np.argmin(costs))
            draw_arrow(axes, starts[best], targets[best])
        _draw_marks(axes, marks, goals)
        axes.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    figure.suptitle("CEM narrows its population down (yellow: cheap, blue: dear; arrow: the best of the round)",
                    fontsize=12)
    return figure


def save_sequence(path, images, goal_image, arrows, marks, goals, distances):
    """An animation of a planned sequence, written whole or not at all. Paper: Sec. IV-G, the figure of executed pokes.

    images (T+1, H, W, 3) in [0, 1]; goal_image (H, W, 3) or None; arrows (T, 2, 2) px: start and target of each poke
    (NaN: it could not be carried out); marks (T+1, M, 2) px; goals (M, 2) px; distances (T+1,) m: to the goals, mean.
    Raises ValueError for other shapes and for a path that does not end in .gif.
    """
    from matplotlib.animation import PillowWriter
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise ValueError(f"path: expected a name ending in .gif, got {path.name!r}")
    images = _checked("images", images, None, None, None, 3, low=0, high=1)
    goals = _checked("goals", goals, None, 2)
    marks = _checked("marks", marks, len(images), len(goals), 2)
    distances = _checked("distances", distances, len(images), low=0)
    if np.shape(arrows) != (len(images) - 1, 2, 2):
        raise ValueError(f"arrows: expected shape ({len(images) - 1}, 2, 2), got {np.shape(arrows)}")
    columns = 1 if goal_image is None else 2
    figure = Figure(figsize=(4.2 * columns, 3.7), dpi=80)
    figure.subplots_adjust(left=0.02, right=0.98, top=0.88, bottom=0.02, wspace=0.04)
    FigureCanvasAgg(figure)
    writer = PillowWriter(fps=1)
    with whole_file(path) as temporary:
        with writer.saving(figure, str(temporary), dpi=80):
            for t, image in enumerate(images):
                figure.clear()
                axes = figure.add_subplot(1, columns, 1)
                last = t == len(images) - 1
                text = f"after {t} pokes: {100 * distances[t]:.1f} cm to go"
                show_image(axes, image, text + ("" if last else f"\nnext: poke {t + 1}"))
                _draw_marks(axes, marks[t], goals)
                if not last and np.isfinite(arrows[t]).all():
                    draw_arrow(axes, *arrows[t])
                axes.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
                if goal_image is not None:
                    show_image(figure.add_subplot(1, columns, 2), goal_image, "goal\n")
                for _ in range(2 if last else 1):
                    writer.grab_frame()


def control_figure(curves, pokes):
    """Distance to the goals against the number of pokes: boxes over the scenes, a panel per number of objects to move.

    Paper: Sec. IV-G, its box plot. curves: {(planner, objects): (scenes, pokes + 1) m}; "learned" is drawn as boxes,
    its mean and those of all other planners as lines.
    """
    numbers = sorted({objects for _, objects in curves})
    names = {"learned": "learned model, mean", "oracle": "the simulator as the model", "random": "random pokes",
             "no_motion": "model of no motion"}
    styles = {"learned": (PREDICTED, "-"), "oracle": (PALETTE[2], "--"), "random": (PALETTE[3], ":"),
              "no_motion": ("0.4", "-.")}
    figure = Figure(figsize=(11, 3.8), dpi=100, layout="constrained")
    for i, objects in enumerate(numbers):
        axes = figure.add_subplot(1, len(numbers), i + 1, label=f"objects {objects}")
        for planner, (colour, line) in styles.items():
            if (planner, objects) in curves:
                distance = 100 * np.asarray(curves[planner, objects])
                if planner == "learned":
                    axes.boxplot(distance, positions=range(pokes + 1), widths=0.55, showfliers=True, flierprops={
                        "marker": ".", "markersize": 4}, medianprops={"color": PREDICTED}, manage_ticks=False)
                axes.plot(range(pokes + 1), distance.mean(axis=0), line, color=colour, linewidth=1.8,
                          label=names[planner])
        axes.set_title(f"{objects} object{'s' if objects > 1 else ''} to move", fontsize=11)
        axes.set(xlabel="pokes", ylim=(0, None), xticks=range(0, pokes + 1, 2))
        axes.grid(alpha=0.3, axis="y")
    figure.axes[0].set_ylabel("mean distance to the goals [cm]", fontsize=10)
    figure.axes[-1].legend(fontsize=8, loc="center right")
    figure.suptitle("Planned pokes bring the objects to their goals (boxes: quartiles over the scenes)", fontsize=12)
    return figure


# --- files ------------------------------------------------------------------------------------------------------------

def save_figure(figure, path):
    """Write a figure as PNG, whole or not at all; the same figure gives the same bytes, however often.

    Not in the paper. The figure's layout stays as saved: a second pass would move panels by a hair.
    Raises ValueError for a path that does not end in .png.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"path: expected a name ending in .png, got {path.name!r}")
    if figure.get_layout_engine():
        figure.get_layout_engine().execute(figure)
        figure.set_layout_engine("none")
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi="figure", metadata={"Software": None})
