"""Draw docs/architecture.png: the paper's Fig. 3 with the function's name on every box and the shapes on every arrow.

    python docs/architecture.py [--out docs/architecture.png]

The shapes are measured on the second shipped test poke, that of lessons 00, 08 and 09; a name that is not in the code
ends the script.
"""
import argparse
import importlib
from pathlib import Path

import numpy as np

from hind4sight_min import networks, scene, training
from hind4sight_min.geometry import poke_frame
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab.figures import GREEN, ORANGE, SKY, save_figure

from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ROOT = Path(__file__).resolve().parent.parent
INPUT, FORWARD, INVERSE, LOSS = "0.92", *(0.65 + 0.35 * colour for colour in (SKY, GREEN, ORANGE))

# name -> (x, y of the middle, what stands in the box, colour)
BOXES = {
    "seen": (-0.3, 6.6, "before:\ndepth, $I_t$", INPUT),
    "scene": (3.2, 6.6, "scene.scene_of\npoints, objects", INPUT),
    "look": (6.95, 6.6, "scene.look\nwhat stands out\nnear the poke", INPUT),
    "poke": (6.95, 9.2, "poke $u_t$", INPUT),
    "local": (10.4, 9.2, "geometry.poke_frame\nnetworks.poke_features", FORWARD),
    "map": (14.8, 9.6, "networks.height_map\nnetworks.first_met", FORWARD),
    "encode": (10.4, 6.6, "networks.encode\nsiamese encoder", FORWARD),
    "trunk": (14.8, 7.7, "networks.forward_model\ntrunk and context", FORWARD),
    "masks": (18.9, 6.6, "networks.softmax\nmasks $m^k$", FORWARD),
    "motions": (18.9, 9.2, "networks._motions\ngeometry.so3_exp", FORWARD),
    "eq1": (23.4, 7.7, "geometry.transform_layer\nEq. (1)", FORWARD),
    "flow": (23.4, 5.7, "geometry.optical_flow\nprojection layer", FORWARD),
    "after": (-0.3, 2.2, "after:\ndepth, $I_{t+1}$", INPUT),
    "scene2": (3.2, 2.2, "scene.scene_of\npoints, objects", INPUT),
    "changed": (6.3, 4.0, "scene.most_changed\nof whole pictures", INVERSE),
    "inverse": (11.9, 4.0, "networks.inverse_model", INVERSE),
    "embed": (11.9, 2.2, "networks.state_embedding\nof $P'_{t+1}$ and $P_{t+1}$", INVERSE),
    "linv": (16.2, 3.2, "losses.inverse_loss\n$L_{act} + L_{sim}$", LOSS),
    "eq3": (23.4, 3.5, "losses.photometric_loss  Eq. (3)\nlosses.flow_smoothness_loss  Eq. (4)", LOSS),
    "binary": (19.4, 4.7, "losses.binary_mask_loss", LOSS),
    "eq25": (23.4, 1.4, "losses.chamfer_loss  Eq. (2)\nlosses.distance_smoothness_loss  Eq. (5)", LOSS),
    "eq6": (16.6, 0.9, "losses.full_loss\nEq. (6)", LOSS),
    "step": (12.6, 0.5, "training.adam\nor training.muon", LOSS),
}
# from, to, the key of `shapes` that goes along it
ARROWS = (("seen", "scene", "depth"), ("scene", "look", "points"), ("look", "encode", "looked"),
          ("look", "local", "looked"), ("poke", "local", "poke"), ("local", "map", "local"),
          ("local", "trunk", "features"), ("map", "trunk", "map"), ("encode", "trunk", "encoded"),
          ("trunk", "masks", "trunk"), ("trunk", "motions", "trunk"), ("masks", "motions", "masks"),
          ("masks", "eq1", "masks"), ("motions", "eq1", "motions"), ("eq1", "flow", "points"), ("flow", "eq3", "flow"),
          ("scene2", "embed", "points"), ("after", "scene2", "depth"),
          ("scene2", "changed", "points"), ("scene", "changed", "points"), ("changed", "inverse", "changed"),
          ("inverse", "linv", "heatmaps"), ("embed", "linv", "embedding"), ("linv", "eq6", "term"),
          ("eq3", "eq6", "term"), ("masks", "binary", "masks"), ("binary", "eq6", "term"), ("eq25", "eq6", "term"),
          ("eq6", "step", "gradient"))
NOTES = ((23.4, 2.75, "with the images $I_t$, $I_{t+1}$"),
         (23.4, 0.65, "of $P'_{t+1}$ and $P_{t+1}$, with both images"))


def measured_shapes():
    """What goes along the arrows, for one poke -> {key: text}."""
    data = load_interactions(ROOT / "data_small" / "test")[[1]]
    run = training.start_run(training.Recipe(), data)
    before, after = training.scenes_of(data)
    rows, seen = scene.look(before, data.pokes)
    looked = before.points[0][rows]
    found = networks.predict(run.params, run.recipe.sizes, before, data.pokes)
    evidence = scene.most_changed(before, after)
    heatmaps = networks.inverse_model(run.params, *evidence, training.cell_centres(data.settings))
    local, sizes = poke_frame(looked, data.pokes), run.recipe.sizes

    def text(*arrays):
        return " ".join(str(np.shape(array)[1:]).replace(",)", ")") for array in arrays)
    return {
        "depth": text(data.depth_before) + " m", "points": text(before.points) + " m", "looked": text(looked),
        "poke": text(data.pokes), "local": text(local), "features": text(networks.poke_features(local)),
        "map": text(networks.height_map(local, seen), networks.first_met(local, seen)),
        "encoded": text(networks.encode(run.params, looked)), "trunk": f"({looked.shape[1]}, {sizes.width})",
        "masks": f"({looked.shape[1]}, {sizes.masks})", "motions": text(found.rotations, found.translations),
        "flow": str((*before.images.shape[1:3], 2)) + " px", "changed": text(*evidence),
        "heatmaps": text(*heatmaps),
        "embedding": "2 x " + text(networks.state_embedding(run.params, before.points, before.occupied)),
        "term": "scalar", "gradient": str(run.vector.shape).replace(",", ""),
    }


def check_names():
    """Every name in a box is one of the code's."""
    for _, _, text, _ in BOXES.values():
        for word in text.split():
            module, _, name = word.partition(".")
            if name.isidentifier():
                getattr(importlib.import_module(f"hind4sight_min.{module}"), name)


WHOLE = (-1.6, 26.7, -0.1, 11.3)


def draw(view=WHOLE, badges=None):
    """The boxes in a view (left, right, bottom, top), some with a badge, {name of the box: text} -> Figure."""
    check_names()
    shapes = measured_shapes()
    left, right, bottom, top = view
    figure = Figure(figsize=(19 / 27.7 * (right - left), 8.4 / 11.4 * (top - bottom)), dpi=85)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.axis("off")
    halves = {}
    for name, (x, y, text, colour) in BOXES.items():
        if not (left < x < right and bottom < y < top):
            continue
        lines = text.replace("$", "").replace("\\", "").split("\n")
        halves[name] = np.array([0.25 + 0.068 * max(map(len, lines)), 0.17 * len(lines) + 0.17])
        width, height = 2 * halves[name]
        axes.add_patch(FancyBboxPatch((x - width / 2, y - height / 2), width, height, boxstyle="round,pad=0.04",
                                      facecolor=colour, edgecolor="0.3", zorder=3))
        axes.text(x, y, text, ha="center", va="center", fontsize=10.5, zorder=4)
        if badges and name in badges:
            axes.text(x - width / 2, y + height / 2 + 0.1, badges[name], ha="left", va="center", fontsize=13, zorder=6,
                      color="white", bbox=dict(boxstyle="round,pad=0.25", facecolor="black", edgecolor="white"))
    for start, end, key in ARROWS:
        if start not in halves or end not in halves:
            continue
        a, b = (np.array(BOXES[name][:2], float) for name in (start, end))
        along = b - a
        leave, arrive = (np.min((halves[name] + 0.06) / np.maximum(np.abs(along), 1e-9)) for name in (start, end))
        a, b = a + leave * along, b - arrive * along
        axes.add_patch(FancyArrowPatch(a, b, arrowstyle="-|>", mutation_scale=13, color="0.35", shrinkA=0, shrinkB=0,
                                       zorder=2))
        level = abs(along[1]) < 0.2 * abs(along[0])
        axes.text(*((a + b) / 2 + [0, 0.2 * level]), shapes[key], ha="center", va="center", fontsize=8.5, color="0.1",
                  zorder=5, bbox=dict(facecolor="white", edgecolor="none", pad=0.5, alpha=0.85 * (not level)))
    for x, y, text in NOTES:
        axes.text(x + 0.15, y, text, fontsize=9, color="0.3", ha="center")
    if view != WHOLE:
        return figure
    axes.text(-1.3, 10.85, "One poke through the model: functions of hind4sight_min in the boxes, shapes on the arrows "
              "(of one poke; everything has a batch axis B before it).", fontsize=13)
    count = shapes["looked"].partition(",")[0][1:]
    axes.text(-1.3, 10.4, f"64 x 48 pixels are 3,072 points; the model looks at {count} of them, which stand out near "
              "this poke's end. Grey: what is seen. Blue: forward model. Green: inverse model. Orange: losses.",
              fontsize=11)
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default=ROOT / "docs" / "architecture.png")
    save_figure(draw(), parser.parse_args().out)


if __name__ == "__main__":
    main()
