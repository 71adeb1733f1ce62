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

def _show(axes, picture, title, **how):
    """One image panel: pixels as they are, no ticks. Returns the image, for a colour bar."""
    axes.set_title(title, fontsize=11)
    axes.set_xticks([])
    axes.set_yticks([])
    return axes.imshow(picture, interpolation="nearest", **how)


def _colour_bar(figure, image, axes, label, **how):
    bar = figure.colorbar(image, ax=axes, aspect=30, pad=0.02, **how)
    bar.set_label(label, fontsize=10)
    bar.ax.tick_params(labelsize=9)


def _arrow(axes, start, target):
    """The poke, with a white outline. The view stays as it is."""
    axes.add_patch(FancyArrowPatch(start, target, arrowstyle="-|>", mutation_scale=14, linewidth=2, color=POKE,
                                   shrinkA=0, shrinkB=0, path_effects=OUTLINE, zorder=5))


def _arena_panel(axes, title):
    axes.set_title(title, fontsize=11)
    axes.set_xlabel("x [m]", fontsize=10)
    axes.set_ylabel("y [m]", fontsize=10)
    axes.tick_params(labelsize=9)
    axes.locator_params(nbins=6)


def _blend(image, weights):
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
    _arrow(axes, start, target)
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
        _show(panels[label], flow_to_rgb(flow, scale), title)
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
    (height, width), margin = shared.shape, 0.01  # px: rounding alone carries no pixel of the rim out of view
    v, u = np.mgrid[:height, :width]
    x, y = u + flow[..., 0], v + flow[..., 1]
    counted = shared & (x > -margin) & (x < width - 1 + margin) & (y > -margin) & (y < height - 1 + margin)
    error = np.abs(image - warped).sum(axis=-1)  # Eq. (3) before the sum over pixels
    shown = _show(axes, np.ma.array(error, mask=~counted), "Photometric error $|I_t - \\hat I_t|$ (Eq. 3)\n"
                  "grey: not counted", cmap=MAGMA, vmin=0, vmax=max(0.1, (error * counted).max()))
    _colour_bar(figure, shown, axes, "sum over R, G, B", location="bottom", shrink=0.8)


def _draw_distances(figure, panels, maps):
    """Both distance maps, (H, W) m^2, as distances in cm on one scale."""
    titles = ("Distance predicted to observed\n$D_{\\hat P \\to P}$ (Eq. 2)",
              "Distance observed to predicted\n$D_{P \\to \\hat P}$ (Eq. 2)")
    distances = [100 * np.sqrt(squared) for squared in maps]
    top = max(0.1, *(distance.max() for distance in distances))
    for axes, title, distance in zip(panels, titles, distances):
        shown = _show(axes, distance, title, cmap="viridis", vmin=0, vmax=top)
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
    _show(panels["before"], image, "Before: image $I_t$\nand the poke $u_t$")
    _arrow(panels["before"], *poke_pixels)
    _show(panels["after"], next_image, "After: image $I_{t+1}$")
    _show(panels["masks"], _blend(image, masks[..., 1:]), "Predicted masks $m_t^k$ (Eq. 1)\na colour each")
    if true_labels is not None:
        true_labels = _checked("true_labels", true_labels, *size, low=0)
        moved = true_labels[..., None] == np.arange(1, int(true_labels.max()) + 1)
        _show(panels["labels"], _blend(image, moved.astype(float)), "True objects that moved\n(colours of their own)")
    _draw_flows(panels, flows)
    _show(panels["warped"], np.clip(warped, 0, 1), "$\\hat I_t$: $I_{t+1}$ warped back\nalong the flow, Sec. III-C")
    _draw_error(figure, panels["error"], image, warped, optical_flow, shared)
    _draw_distances(figure, [panels["distance_predicted"], panels["distance_observed"]], maps)
    _arena_panel(panels["scene_flow"], "Scene flow from above (Eq. 1)")
    _draw_scene_flow(panels["scene_flow"], image[valid], points[valid], arrows, start, poke[:2], arena)
    _draw_heatmap(figure, panels["start"], start_heatmap, "start", "A", start, arena)
    _draw_heatmap(figure, panels["end"], end_heatmap, "end", "B", poke[:2], arena)
    return figure


TERMS = {"chamfer": "$L_{CD}$ (Eq. 2), m$^2$", "distance_smoothness": "$L_{ds}$ (Eq. 5), m$^2$",
         "photometric": "$L_{rec}$ (Eq. 3), intensity", "flow_smoothness": "$L_{fs}$ (Eq. 4), px",
         "inverse": "$L_{inv}$ (Sec. III-E), nats"}


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
