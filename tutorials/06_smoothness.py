"""Smoothness that stops at edges: tidying up flow fields and distance maps.

Question: many predictions explain two pictures almost equally well. Which of them should a model prefer, and what does
a preference for smooth fields do to the rims of objects?

Equations:
- Eq. (4), smoothness of the flow: `losses.flow_smoothness_loss`, `losses.edge_weights`,
  `losses.edge_aware_smoothness`; tests/test_eq4_flow_smoothness.py
- Eq. (5), smoothness of the distance maps: `losses.distance_smoothness_loss`; tests/test_eq5_distance_smoothness.py
- Eq. (2) and (3) for comparison: `losses.chamfer_loss`, `losses.photometric_loss`; tests/test_eq2_chamfer.py,
  tests/test_eq3_photometric.py

Time: 5 s. Pictures: 06_flows.png, 06_follow.png, 06_edges.png, 06_maps.png, 06_holes.png.

Last lines to expect:
   share of pokes in which the factor of L_ds is larger: expected above 0.7, got 0.85
06_smoothness: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. `losses.flow_smoothness_loss` is Eq. (4) as the package has
# it, `losses.distance_smoothness_loss` Eq. (5); with your editor's "go to definition" each is one click away.

# %%
import lesson  # first of all: it sets the number of BLAS threads

import autograd.numpy as anp
import numpy as np
from autograd import grad
from scipy.ndimage import binary_dilation, binary_erosion

from hind4sight_min import geometry, losses, training
from hind4sight_min.lab.evaluation import true_motion
from hind4sight_min.lab.figures import BLUE, DISTANCES, SHARES, TERM_COLOURS, RED, draw_wheel, flow_to_rgb

options = lesson.begin("06_smoothness")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

# %% [markdown]
# ## A step by hand
#
# Write U and V for the optical flow in pixels (lesson 05) and I_t for the picture before the poke. Eq. (4) adds up the
# steps of the flow between neighbouring pixels, across and down, each with a weight that is small where the picture has
# an edge:
#
#     L_fs = sum_xy |grad U| e^(-|grad I_t|) + |grad V| e^(-|grad I_t|)
#
# `grad` is the difference between neighbours. Rigid objects move as a whole, so inside of them the flow changes slowly
# or not at all; at their rims it jumps, and there the picture usually has an edge. How fast the weight falls depends on
# the numbers in I_t. Ours are between 0 and 1, and the package takes exp(-40 |grad I_t|), with |grad I_t| the mean over
# the three colours (`EDGE_SHARPNESS`; more on it below). A row of four pixels whose flow jumps by 2 pixels:

# %%
flow_row = np.array([[0.0, 0], [0, 0], [2, 0], [2, 0]]).reshape(1, 1, 4, 2)  # (B=1, H=1, W=4, (U, V))
rows = {"a flat picture": [0.5, 0.5, 0.5, 0.5],
        "an edge of 0.05 at the jump": [0.5, 0.5, 0.55, 0.55],
        "the same edge elsewhere": [0.5, 0.55, 0.55, 0.55]}
all_seen = np.ones((1, 4), bool)
by_hand = {}
print("1. L_fs of a jump by 2 px")
for name, grey in rows.items():
    picture = np.repeat(np.reshape(grey, (1, 1, 4, 1)), 3, axis=3)
    by_hand[name] = float(losses.flow_smoothness_loss(flow_row, picture, all_seen)[0])
    print(f"   {name}: {by_hand[name]:.4f}")
print(f"   by hand 2, 2 exp(-40 * 0.05) = {2 * np.exp(-2):.4f}, and 2 again")

# %% [markdown]
# ## Four flows of a real poke
#
# Poke 146 of the test set pushes a striped object by 2 cm. The simulator knows its true optical flow. To compare: no
# motion at all; a flow that *spills*, where a rim of two pixels of table moves along with the object; and the true flow
# with an error of half a pixel (standard deviation) at every pixel.
#
# **Predict before you run:** rank the four by Eq. (4). Which is the cheapest?

# %%
interactions, truth = lesson.pokes()
camera, shape = interactions.camera, interactions.depth_before.shape[1:]
rng = np.random.default_rng(0)


class Poke:
    """One poke whose truth we look at: its scenes, its true flow, and the object that moved, if it was just one."""

    def __init__(self, row):
        self.before, self.after = before, after = training.scenes_of(interactions[[row]])
        self.shared = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
        self.scene_flow, pixels, moving = true_motion(interactions, truth, row)  # (N, 3) m, (N, 2) px, (N,)
        self.flow = pixels.reshape(1, *shape, 2)
        labels = truth.labels[row].ravel()
        movers = np.unique(labels[moving])
        self.single = len(movers) == 1
        self.on_object = (labels == movers[0]).reshape(shape) if self.single else np.zeros(shape, bool)
        self.motion = np.linalg.norm(self.scene_flow[self.on_object.ravel()].mean(axis=0)) if self.single else 0.0
        self.rim = binary_dilation(self.on_object, iterations=2) & ~self.on_object  # two pixels around it
        self.core = binary_erosion(self.on_object, iterations=2)                    # all but its outer two pixels

    def spilled(self):
        flow = self.flow.copy()
        flow[0, self.rim] = self.flow[0, self.on_object].mean(axis=0)
        return flow

    def holed(self, filled=0.0):
        """The scene flow with the object's core moved by only a share `filled` of its motion."""
        flow = self.scene_flow.copy()
        flow[self.core.ravel()] *= np.float32(filled)
        return flow

    def terms(self, scene_flow):
        """For a scene flow (N, 3) m: L_CD, L_ds, L_rec and L_fs, and the two distance maps."""
        before, after, flow = self.before, self.after, self.pixels_of(scene_flow)
        maps = losses.distance_maps(before.points + scene_flow[None], after.points, *self.shared)
        return np.array([losses.chamfer_loss(*maps)[0],
                         losses.distance_smoothness_loss(*maps, before.images, after.images, *self.shared)[0],
                         losses.photometric_loss(before.images, after.images, flow, self.shared[0])[0],
                         self.flow_smoothness(flow)]), maps

    def pixels_of(self, scene_flow):
        """Scene flow (N, 3) m -> optical flow (1, H, W, 2) px."""
        points = self.before.points
        return geometry.optical_flow(points, points + scene_flow[None], camera).reshape(self.flow.shape)

    def flow_smoothness(self, flow):
        return losses.flow_smoothness_loss(flow, self.before.images, self.before.valid)[0]


ROW = 146
poke = Poke(ROW)
noise = 0.5 * rng.standard_normal(poke.flow.shape).astype(np.float32)
flows = {"no motion": 0 * poke.flow, "true flow": poke.flow, "spilled": poke.spilled(),
         "half a pixel of noise": poke.flow + noise}
costs = {name: float(poke.flow_smoothness(flow)) for name, flow in flows.items()}
print(f"2. Poke {ROW}: L_fs of " + ", ".join(f"{name} {cost:.1f} px" for name, cost in costs.items()))

window = np.s_[24:48, 34:62]  # around the object
longest = float(np.linalg.norm(poke.flow, axis=-1).max())
across, down = losses.edge_weights(poke.before.images)
figure, axes = plt.subplots(2, 3, figsize=(11, 5.9), layout="constrained")
axes[0, 0].imshow(poke.before.images[0][window])
axes[0, 0].set_title("the picture $I_t$", fontsize=11)
for panel, weights, name in ((axes[0, 1], across, "to the right"), (axes[0, 2], down, "down")):
    shown = panel.imshow(weights[0][window], cmap=SHARES, vmin=0, vmax=1)
    panel.set_title(f"weight of a step {name}", fontsize=11)
figure.colorbar(shown, ax=axes, label="$e^{-40 |\\nabla I_t|}$", shrink=0.48, anchor=(0, 1))
for panel, name in zip(axes[1], list(flows)[1:]):
    panel.imshow(flow_to_rgb(flows[name][0], longest)[window])
    panel.set_title(f"{name}: $L_{{fs}}$ = {costs[name]:.0f} px", fontsize=11)
draw_wheel(axes[1, 0], longest, low=True)
for panel in axes.flat:
    panel.set(xticks=[], yticks=[])
figure.suptitle("Steps are nearly free at the object's rim and stripes (dark) and cost in full on the table (bright)",
                fontsize=11)
lesson.keep(options, figure, "flows")

# %% [markdown]
# Eq. (4) must never be strong enough to win against the other losses. It is there to decide between flows that the
# others find alike, such as the true one and the spilled one: plain table looks the same when it is shifted by a pixel
# or two.
#
# ## How sharp should the weight be?
#
# The paper prints exp(-|grad I|). For a picture between 0 and 1 that is never below e^-1: no edge would make a step
# cheap. Try other sharpnesses on pokes that pushed one object by 1 to 3 cm, and price three flows: the true one, the
# spilled one, and one with a *hole*, in which the object's core stays behind and only its outer two pixels move.

# %%
group = []
for row in range(len(interactions)):
    candidate = Poke(row)
    if candidate.single and 0.01 < candidate.motion < 0.03 and candidate.core.sum() >= 4:
        group.append(candidate)
    if len(group) == (15 if options.quick else 60):
        break


def sharpened(sharpness, function):
    """function() with another EDGE_SHARPNESS."""
    usual, losses.EDGE_SHARPNESS = losses.EDGE_SHARPNESS, sharpness
    try:
        return function()
    finally:
        losses.EDGE_SHARPNESS = usual


three = [(p.flow, p.spilled(), p.pixels_of(p.holed())) for p in group]
sharpnesses = np.array([1, 2.5, 5, 10, 20, 40, 80, 160])
prices = np.array([sharpened(s, lambda: [[p.flow_smoothness(flow) for flow in each] for p, each in zip(group, three)])
                   for s in sharpnesses]).mean(axis=1)  # (sharpnesses, flows) px, the mean over the pokes
spill_ratio, hole_ratio = prices[:, 1] / prices[:, 0], prices[:, 2] / prices[:, 0]
usual = int(np.flatnonzero(sharpnesses == losses.EDGE_SHARPNESS)[0])
print(f"3. Mean L_fs of {len(group)} pokes")
for i in (0, usual):
    print(f"   exp(-{sharpnesses[i]:g} |grad I|): true {prices[i, 0]:.1f} px, spilled {prices[i, 1]:.1f}, with a hole "
          f"{prices[i, 2]:.1f}")

figure, axes = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
for i, (name, colour, style) in enumerate((("true flow", "black", "o-"), ("spilled", RED, "s-"),
                                           ("with a hole", BLUE, "^-"))):
    axes[0].loglog(sharpnesses, prices[:, i], style, color=colour, label=name)
axes[1].semilogx(sharpnesses, spill_ratio, "s-", color=RED, label="spilled / true")
axes[1].semilogx(sharpnesses, hole_ratio, "^-", color=BLUE, label="with a hole / true")
for panel in axes:
    panel.axvline(losses.EDGE_SHARPNESS, color="0.5", linestyle=":", label="the package's 40")
    panel.set(xlabel="sharpness s in $e^{-s |\\nabla I_t|}$")
    panel.legend(fontsize=9)
axes[0].set(ylabel="mean $L_{fs}$ [px]")
axes[1].set(ylabel="times the true flow's price", ylim=(0, None))
figure.suptitle("With a sharp weight the true flow becomes cheap and a spill stays dear", fontsize=11)
lesson.keep(options, figure, "edges")

# %% [markdown]
# As printed, the spilled flow costs less than twice the true one; with 40 it costs some twenty times as much. Sharper
# still? The hole's curve on the left says what is lost: a textured object is full of edges, and inside of it steps
# become free as well.
#
# ## Where does the gradient lead?
#
# Start from the spilled flow of poke 146 and follow minus the gradient of Eq. (4) alone, once with its weights and once
# with weights of 1 everywhere (sharpness 0). Watch how much of the true motion is left on the object and on the rim.

# %%
def follow(flow, sharpness, steps=400, rate=0.02):
    """Gradient descent on L_fs -> the flows after every step, (steps + 1, 1, H, W, 2) px."""
    slope = grad(lambda f: anp.sum(losses.flow_smoothness_loss(f, poke.before.images, poke.before.valid)))

    def descend():
        path = [flow]
        for _ in range(steps):
            path.append(path[-1] - np.float32(rate) * slope(path[-1]))
        return np.array(path)
    return sharpened(sharpness, descend)


paths = {"edge-aware": follow(poke.spilled(), losses.EDGE_SHARPNESS), "without edges": follow(poke.spilled(), 0.0)}
true_length = np.linalg.norm(poke.flow[0, poke.on_object], axis=-1).mean()
left_over = {(name, where): np.linalg.norm(path[:, 0, mask], axis=-1).mean(axis=1) / true_length
             for name, path in paths.items() for where, mask in (("object", poke.on_object), ("rim", poke.rim))}
print("4. Share of the true motion left after following Eq. (4) for 400 steps")
for (name, where), values in left_over.items():
    print(f"   {name}, {where}: {values[-1]:.2f}")

figure, axes = plt.subplots(1, 4, figsize=(11, 3.1), layout="constrained", width_ratios=(1, 1, 1, 1.5))
for panel, (title, flow) in zip(axes, (("start: spilled", poke.spilled()), ("edge-aware", paths["edge-aware"][-1]),
                                       ("without edges", paths["without edges"][-1]))):
    panel.imshow(flow_to_rgb(flow[0], longest)[window])
    panel.contour(poke.on_object[window], levels=[0.5], colors="black", linewidths=0.8)
    panel.set(xticks=[], yticks=[])
    panel.set_title(title, fontsize=11)
for (name, where), values in left_over.items():
    axes[3].plot(values, "-" if where == "object" else "--", color=BLUE if name == "edge-aware" else RED,
                 label=f"{where}, {name}")
axes[3].set(xlabel="step", ylabel="share of the true motion", ylim=(0, 1.05))
axes[3].legend(fontsize=8)
figure.suptitle("With its weights, Eq. (4) flattens the spill and leaves the object (outlined) its motion",
                fontsize=11)
lesson.keep(options, figure, "follow")

# %% [markdown]
# ## Holes, and Eq. (5)
#
# An object that moves by less than its own size overlaps with where it was. In the overlap, points of the first cloud
# find close neighbours in the second, though these are other bits of the object. The Chamfer distance, Eq. (2), takes
# that for "did not move". So a mask with a hole, whose core stays behind, costs it little. Eq. (5) treats the two
# distance maps of lesson 04 as Eq. (4) treats the flow:
#
#     L_ds = sum_xy |grad D_{P->P'}| e^(-|grad I_{t+1}|) + |grad D_{P'->P}| e^(-|grad I_t|)
#
# The paper prints I_{t+1} in both terms; D_{P'->P} lies on the grid of the first picture, so the package takes I_t
# there. A hole makes the maps uneven inside the object: D is large where the moved points left a gap, and zero beside
# it.

# %%
none = np.zeros_like(poke.scene_flow)
scenes = {"no motion": none, "with a hole": poke.holed(), "true flow": poke.scene_flow}
results = {name: poke.terms(flow) for name, flow in scenes.items()}
matched = np.sqrt(results["no motion"][1][0][0].reshape(shape)[poke.on_object]) < 0.005
print(f"5. Poke {ROW}: without motion, {matched.mean():.0%} of the object's points have a neighbour within 5 mm")
for name, (values, _) in results.items():
    print(f"   {name}: L_CD {1e4 * values[0]:.1f} cm^2, L_ds {1e4 * values[1]:.1f} cm^2")
gains = [results["no motion"][0][0] - results[name][0][0] for name in ("with a hole", "true flow")]
print(f"   of what the true flow saves in L_CD, the one with a hole saves {gains[0] / gains[1]:.0%}")

figure, axes = plt.subplots(2, 3, figsize=(11, 5.9), layout="constrained")
for column, (name, (values, maps)) in zip(axes.T, results.items()):
    for panel, map_, symbol in zip(column, maps, ("P' \\to P", "P \\to P'")):
        shown = panel.imshow(100 * np.sqrt(map_[0].reshape(shape))[window], cmap=DISTANCES, vmin=0, vmax=2)
        panel.set(xticks=[], yticks=[])
        panel.set_title(f"{name}: $D_{{{symbol}}}$", fontsize=11)
    column[1].set_xlabel(f"$L_{{CD}}$ = {1e4 * values[0]:.0f} cm$^2$, $L_{{ds}}$ = {1e4 * values[1]:.0f} cm$^2$")
figure.colorbar(shown, ax=axes, label="$\\sqrt{D}$ [cm]", shrink=0.6)
figure.suptitle("The object's core is dark even without motion; a hole shows as bright patches beside dark ones",
                fontsize=11)
lesson.keep(options, figure, "maps")

# %% [markdown]
# Is that so for other pokes? Close the hole step by step in all of the group, by letting the core move by 0 to 100 % of
# its true motion, and divide each loss by its value without a hole.

# %%
shares = np.linspace(0, 1, 6)
curves = np.array([[p.terms(p.holed(share))[0] for share in shares] for p in group])  # (pokes, shares, terms)
factors = curves / curves[:, -1:]
medians = np.median(factors, axis=0)  # (shares, terms)
wins = float((factors[:, 0, 1] > factors[:, 0, 0]).mean())
rise = (curves[:, 0] - curves[:, -1]).mean(axis=0)
styles = {"chamfer": ("$L_{CD}$, Eq. (2)", "o-"),
          "distance_smoothness": ("$L_{ds}$, Eq. (5)", "s-"),
          "photometric": ("$L_{rec}$, Eq. (3)", "^-"),
          "flow_smoothness": ("$L_{fs}$, Eq. (4)", "d-")}
print(f"6. What a hole does to each loss, {len(group)} pokes: median factor; mean rise times its weight in training")
for i, key in enumerate(styles):
    print(f"   {key}: {medians[0, i]:.2f}; {training.WEIGHTS[key] * rise[i]:.2f}")
print(f"   the factor of L_ds is larger than that of L_CD in {wins:.0%} of the pokes")

figure, axes = plt.subplots(1, 2, figsize=(11, 3.8), layout="constrained")
for i, (key, (name, style)) in enumerate(styles.items()):
    axes[0].plot(100 * shares, medians[:, i], style, color=TERM_COLOURS[key], label=name)
axes[0].set(xlabel="how far the core moves [% of its true motion]", ylabel="loss / loss without a hole")
axes[0].legend(fontsize=9)
axes[0].set_title(f"as the hole closes, median of {len(group)} pokes", fontsize=11)
axes[1].plot(*factors[:, 0, :2].T, "o", color=BLUE, markersize=5, alpha=0.7)
axes[1].axline((1, 1), slope=1, color="0.5", linestyle=":", label="the same factor")
axes[1].set(xlabel="$L_{CD}$ with a hole / without", ylabel="$L_{ds}$ with a hole / without")
axes[1].legend(fontsize=9)
axes[1].set_title("with the core left behind, one dot per poke", fontsize=11)
figure.suptitle("A hole raises the smoothness terms by a larger factor than the Chamfer distance", fontsize=11)
lesson.keep(options, figure, "holes")

# %% [markdown]
# The factor says how clearly a loss sees the hole, the weighted rise how loudly it says so. By the weights of this
# package the smoothness terms speak softly: L_CD and L_rec pay most for a hole. The smoothness terms decide where those
# two find two flows alike.
#
# **Now change this:** `0.01 < candidate.motion < 0.03` to `0.05 < candidate.motion < 0.09`. These objects hardly
# overlap with where they were, so a core that is left behind finds no close neighbours, and a hole raises L_CD by much
# more. The Check "median factor of L_CD with a hole" objects.

# %% Check
print("7. Check")
lesson.check("a jump by 2 px, flat picture [px]", by_hand["a flat picture"], 2.0, within=1e-6)
lesson.check("at an edge of 0.05: 2 e^-2", by_hand["an edge of 0.05 at the jump"], 2 * np.exp(-2), within=1e-4)
lesson.check("with the edge elsewhere", by_hand["the same edge elsewhere"], 2.0, within=1e-6)
edge = np.repeat(np.reshape([0.5, 0.5, 0.55, 0.55], (1, 1, 4, 1)), 3, axis=3)
upright, v_column = edge.reshape(1, 4, 1, 3), np.array([[0, 0], [0, 0], [0, 2], [0, 5.0]]).reshape(1, 4, 1, 2)
last_missing = np.array([[True, True, True, False]])
lesson.check("the same in a column, V = 0, 0, 2, 5, the last pixel without depth",
             float(losses.flow_smoothness_loss(v_column, upright, last_missing)[0]), 2 * np.exp(-2), within=1e-4)
slope = grad(lambda flow: anp.sum(losses.flow_smoothness_loss(flow, edge, all_seen)))(flow_row)[0, 0, :, 0]
for column, wanted in ((1, -np.exp(-2)), (2, np.exp(-2))):
    lesson.check(f"gradient to U at column {column} of the jump", float(slope[column]), wanted, within=1e-4)
step_up, high = np.array([[0, 0, 1, 1.0]]), np.array([[0, 3, 3, 3.0]])  # D_{P'->P} and D_{P->P'}
lesson.check("Eq. (5) by hand: D_{P'->P} jumps by 1 at the edge in I_t, D_{P->P'} by 3 in a flat I_{t+1}",
             float(losses.distance_smoothness_loss(step_up, high, edge, 0 * edge, all_seen, all_seen)[0]),
             3 + np.exp(-2), within=1e-4)
slopes = grad(lambda maps: anp.sum(losses.distance_smoothness_loss(maps[0], maps[1], edge, 0 * edge, all_seen,
                                                                   all_seen)))(np.stack([step_up, high]))[:, 0]
for name, map_, column, wanted in (("D_{P'->P}", 0, 2, np.exp(-2)), ("D_{P->P'}", 1, 1, 1.0)):
    lesson.check(f"gradient of Eq. (5) to {name} beyond the jump", float(slopes[map_, column]), wanted, within=1e-4)
    lesson.check("and before it", float(slopes[map_, column - 1]), -wanted, within=1e-4)
lesson.check("L_fs without motion", costs["no motion"], 0.0, within=1e-6)
lesson.check("L_fs spilled / true, mean over the group", float(spill_ratio[usual]), above=8)
lesson.check("the same as the paper prints it", float(spill_ratio[0]), above=1, below=3)
lesson.check("true motion left on the object after following Eq. (4)", float(left_over["edge-aware", "object"][-1]),
             above=0.9)
lesson.check("and on the spilled rim", float(left_over["edge-aware", "rim"][-1]), below=0.5)
lesson.check("on the object without the weights", float(left_over["without edges", "object"][-1]), below=0.5)
lesson.check("median factor of L_CD with a hole", float(medians[0, 0]), above=1.1, below=1.8)
lesson.check("share of pokes in which the factor of L_ds is larger", wins, above=0.7)
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. No motion, then the true flow, the spilled one, the noisy one. Nothing is smoother than nothing, which is why Eq.
#    (4) alone would teach a model to move nothing.
