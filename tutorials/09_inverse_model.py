"""The inverse model, and where gradients go: which poke was it, which layer learns first, which loss pulls hardest.

Question: can two clouds tell which poke lies between them? And when all losses pull at once at a network that has
learnt nothing yet, where do their gradients arrive, and how strong is each?

Equations:
- Sec. III-E, heat-maps of the poke: `networks.inverse_model`, `scene.most_changed`, `losses.heatmap_cross_entropy`;
  tests/test_networks.py, tests/test_scene.py, tests/test_inverse_loss.py
- Sec. III-E, the inverse loss: `losses.inverse_loss`, `losses.embedding_loss`, `networks.state_embedding`;
  tests/test_inverse_loss.py, tests/test_networks.py
- Eq. (6), the gradient of every term: `training.chunk_gradient`; tests/test_training.py

Time: 4 s. Pictures: 09_heatmaps.png, 09_gradients.png.

Last lines to expect:
   gradient of the 3D terms of Eq. (6) against a finite difference, ratio: expected 1 within 0.001, got 1
09_inverse_model: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. The *fresh* and the *shipped* network are those of lesson
# 08.

# %%
import lesson  # first of all: it sets the number of BLAS threads

from dataclasses import replace

import autograd.numpy as anp
import numpy as np
from autograd import grad
from matplotlib.colors import LogNorm

from hind4sight_min import losses, networks, ops, training
from hind4sight_min.disk import checkpoints
from hind4sight_min.interactions import cell_centres, cells_of, grid_shape
from hind4sight_min.lab.evaluation import poke_errors, poke_from_heatmaps
from hind4sight_min.lab.figures import BLUE, GREEN, ORANGE, RED, SHARES, SKY
from hind4sight_min.scene import most_changed

options = lesson.begin("09_inverse_model")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

data, truth = lesson.pokes()
shipped = checkpoints.load_run(lesson.data_small() / "checkpoint.npz")
fresh = training.start_run(shipped.recipe, data)
camera, settings = data.camera, data.settings
ROW = 1

# %% [markdown]
# ## Backwards: which poke was it?
#
# The *inverse model* (Sec. III-E) sees both clouds and answers with two *heat-maps*, probabilities over the cells
# of the arena's grid: where the finger started, and its target. `scene.most_changed` picks the points that
# changed most; all but the encoder's features is said relative to their centre, so that a poke learnt in one corner is
# known in all. The first half of the inverse loss, L_act, is the sum of both heat-maps' cross entropies, and a cross
# entropy is minus the logarithm of the probability at the true cell. The other half, L_sim, wants the state embedding
# of P'_{t+1} to be that of P_{t+1}.
#
# **Predict before you run:** there are 400 cells. What does a heat-map cost that knows nothing? And which of the two
# will be the harder to tell, the start or the target?

# %%
many = data[:40]
*changed, amount = most_changed(*training.scenes_of(many))  # points before and after (B, M, 3), weights (B, M)
centres = cell_centres(settings)
start_cells, end_cells = cells_of(many.starts, settings), cells_of(many.pokes[:, :2], settings)
logits = {name: networks.inverse_model(run.params, *changed, amount, centres)
          for name, run in (("fresh", fresh), ("shipped", shipped))}  # (start, target), each (B, cells)
entropy = {name: [losses.heatmap_cross_entropy(*each).mean() for each in zip(pair, (start_cells, end_cells))]
           for name, pair in logits.items()}
maps = {name: [networks.softmax(each) for each in pair] for name, pair in logits.items()}
guesses = np.array([poke_from_heatmaps(start, end, settings) for start, end in zip(*maps["shipped"])])
target_error, direction_error = poke_errors(guesses, many.pokes)
for name, (start, end) in entropy.items():
    print(f"1. {name}: cross entropy of the start {start:.2f}, of the target {end:.2f}; "
          f"log({len(centres)}) = {np.log(len(centres)):.2f} nats")
print(f"   shipped: target off by {100 * np.median(target_error):.1f} cm (median)")

half = settings["arena"] / 2
figure, axes = plt.subplots(1, 4, figsize=(11, 3.2), layout="constrained")
counts = amount[ROW] > 1e-6 * amount[ROW].max()  # the others hardly changed at all
for clouds, colour, label in zip(changed, (BLUE, RED), ("before", "after")):
    axes[0].scatter(*clouds[ROW, counts, :2].T, s=4 + 200 * amount[ROW, counts], color=colour, label=label,
                    linewidths=0)
axes[0].legend(fontsize=8, loc="upper right")
axes[0].set_title("the points that\nchanged most", fontsize=11)
for panel, name, which, title in ((axes[1], "fresh", 1, "fresh: target"), (axes[2], "shipped", 0, "shipped: start"),
                                  (axes[3], "shipped", 1, "shipped: target")):
    map_ = maps[name][which][ROW].reshape(grid_shape(settings))
    shown = panel.imshow(map_, origin="lower", extent=(-half, half, -half, half), cmap=SHARES, norm=LogNorm(1e-4, 1),
                         interpolation="nearest")
    panel.plot(*(data.pokes[ROW, :2] if which else data.starts[ROW]), "o", markersize=12, fillstyle="none",
               color=RED, markeredgewidth=2)
    true_cell = (end_cells if which else start_cells)[ROW]
    panel.set_title(f"{title},\n{map_.ravel()[true_cell]:.1%} at the true cell", fontsize=11)
for panel in axes:
    panel.set(aspect="equal", xlim=(-half, half), ylim=(-half, half), xlabel="x [m]", xticks=[-0.2, 0, 0.2],
              yticks=[-0.2, 0, 0.2])
axes[0].set_ylabel("y [m]")
figure.colorbar(shown, ax=axes, label="probability of a cell", shrink=0.8)
figure.suptitle(f"One poke: before training any cell may be it, after it a few do, near the true ones (circles). Over "
                f"{len(many)} pokes the target is off by {100 * np.median(target_error):.1f} cm (median)", fontsize=11)
lesson.keep(options, figure, "heatmaps")

# %% [markdown]
# ## Which layer learns first?
#
# **Predict before you run:** the fresh network's motions are all the identity. Take the gradient of the Chamfer
# distance, Eq. (2), with respect to every layer of the forward model. Which layers get one in the very first step:
# encoder, trunk, masks, the three layers of the motions? Hint: what does a mask change while all motions are the
# same?

# %%
KICK = 0.0  # standard deviation of what is added to the weights of the last motion layer; see the experiment below
LAYERS = ("encoder_1", "encoder_2", "trunk_0", "trunk_1", "trunk_2", "mask", "motion_1", "motion_2", "motion_3")
train, _ = lesson.pokes("train")
beginner = training.start_run(training.Recipe(batch=8), train)
kick = {name: np.zeros(shape, np.float32) for name, shape in beginner.layout.items()}
kick["motion_3_w"] += KICK * np.random.default_rng(0).standard_normal(kick["motion_3_w"].shape).astype(np.float32)
beginner.vector = beginner.vector + np.concatenate([value.ravel() for value in kick.values()])


def layer_gradients(run):
    """The norm of the Chamfer term's gradient with respect to the weights of each layer, an array like LAYERS."""
    chamfer = replace(run.recipe, weights={"chamfer": training.WEIGHTS["chamfer"]}, batch=8)
    _, gradient = training.chunk_gradient(training.unsupervised, run.vector, run.layout, chamfer, train[:8], 0)
    found = ops.unflatten(gradient, run.layout)
    return np.array([np.linalg.norm(found[f"{name}_w"]) for name in LAYERS])


first = {0: layer_gradients(beginner)}
scenes, _ = training.scenes_of(train[:8])
scene_flow = networks.predict(beginner.params, beginner.recipe.sizes, scenes, train.pokes[:8]).points - scenes.points
print(f"2. Before the first step: longest motion {100 * np.abs(scene_flow).max():.2f} cm")
for step in range(1, 11):
    training.training_step(train, beginner)
    if step in (1, 10):
        first[step] = layer_gradients(beginner)
for step, norms in first.items():
    print(f"   gradients after {step:2d} steps:", ", ".join(f"{name} {norm:.1e}" for name, norm in zip(LAYERS, norms)))

# %% [markdown]
# ## How hard does each term pull?
#
# Eq. (6) adds up five terms, each with its weight; here a sixth joins them, a price on points that are half background
# (`losses.binary_mask_loss`). It is tempting to choose the weights so that the weighted *values* are alike. But a
# network is moved by gradients. We compare, at the shipped parameters: a term's weighted value, the norm of its
# weighted gradient for one poke (median), and that of the mean gradient over the pokes. The mean is what moves the
# network; where it is far smaller than a single poke's, the pokes disagree.

# %%
AUDITED = 6 if options.quick else 24
audit = {}
for term, weight in training.WEIGHTS.items():
    alone = replace(shipped.recipe, weights={term: 1.0}, batch=1)
    found = [training.chunk_gradient(training.unsupervised, shipped.vector, shipped.layout, alone, data[[row]], row)
             for row in range(AUDITED)]
    gradients = np.stack([gradient for _, gradient in found])
    audit[term] = weight * np.array([np.mean([values[term] for values, _ in found]),
                                     np.median(np.linalg.norm(gradients, axis=1)),
                                     np.linalg.norm(gradients.mean(axis=0))])
    print(f"3. {term}, weight {weight:g}: value {audit[term][0]:.3g}, one poke's gradient {audit[term][1]:.3g}, "
          f"mean gradient {audit[term][2]:.3g}")

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
for i, (step, norms) in enumerate(first.items()):
    left.bar(np.arange(len(LAYERS)) + 0.27 * (i - 1), np.maximum(norms, 1e-4), 0.27, color=(SKY, ORANGE, BLUE)[i],
             label=f"after {step} step{'s' * (step != 1)}")
left.set(yscale="log", ylim=(1e-4, 1e3), ylabel="norm of the Chamfer term's gradient")
left.set_xticks(range(len(LAYERS)), LAYERS, rotation=40, ha="right")
left.set_title("The first step reaches one layer only", fontsize=11)
left.legend(fontsize=9, loc="upper left")
for i, (label, colour) in enumerate((("value", GREEN), ("one poke's gradient", SKY),
                                     ("mean gradient", BLUE))):
    right.bar(np.arange(len(audit)) + 0.27 * (i - 1), [values[i] for values in audit.values()], 0.27, color=colour,
              label=label)
right.set(yscale="log", ylim=(0.01, 3e3), ylabel="times the weight")
right.set_xticks(range(len(audit)), [name.replace("_", "\n") for name in audit], fontsize=8)
right.set_title("What a term costs, and how hard it pulls", fontsize=11)
right.legend(fontsize=9, loc="upper right")
figure.suptitle("Which layer learns first, and which term pulls hardest", fontsize=11)
lesson.keep(options, figure, "gradients")

# %% [markdown]
# docs/research-log.md tells what this audit was good for: weights that looked harmless by their values let flow
# smoothness pull harder than the Chamfer distance, and the predictions got worse as it was switched on.
#
# **Now change this:** `KICK = 0.0` to `KICK = 0.05`. The fresh motions are then no longer the identity, and all layers
# get a gradient in the first step; the Check "first step: largest gradient of another layer" objects. You would still
# rather start from the identity: look at the longest motion that the network now predicts before it has learnt
# anything.

# %% Check
print("4. Check")
lesson.check("fresh: cross entropy of the target [nats]", entropy["fresh"][1], np.log(len(centres)), within=0.4)
three, second = np.array([[0.0, np.log(3), 0]]), np.array([1])  # shares 1/5, 3/5, 1/5
lesson.check("cross entropy by hand, -log(3 / 5) [nats]", float(losses.heatmap_cross_entropy(three, second)[0]),
             np.log(5 / 3), within=1e-9)
lesson.check("shipped: median target error [m]", float(np.median(target_error)), below=0.05)
others = np.delete(first[0], LAYERS.index("motion_3"))
lesson.check("first step: largest gradient of another layer / the last motion layer's",
             float(others.max() / first[0][LAYERS.index("motion_3")]), below=1e-4)
lesson.check("after one step: the masks' gradient / the last motion layer's",
             float(first[1][LAYERS.index("mask")] / first[1][LAYERS.index("motion_3")]), above=1e-4)
# The 2D terms sample pictures, which OpenCV does in float32; the inverse loss is cut off at the encoder on purpose.
smooth = {name: training.WEIGHTS[name] for name in ("chamfer", "distance_smoothness")}
batch = training.make_batch(data[[ROW]], shipped.recipe, np.random.default_rng(0))
batch = replace(batch, **{name: replace(scene, points=scene.points.astype(float), images=scene.images.astype(float))
                          for name, scene in (("before", batch.before), ("after", batch.after))})


def loss_at(vector):
    terms = training.loss_terms(ops.unflatten(vector, shipped.layout), shipped.recipe.sizes, batch, camera, smooth)
    return anp.sum(sum(weight * terms[name] for name, weight in smooth.items()))  # Eq. (6) by hand


vector = shipped.vector.astype(float)
direction = vector / np.linalg.norm(vector)  # all parameters a little larger
slope = grad(loss_at)(vector) @ direction
difference = (loss_at(vector + 1e-6 * direction) - loss_at(vector - 1e-6 * direction)) / 2e-6
lesson.check("gradient of the 3D terms of Eq. (6) against a finite difference, ratio",
             float(slope / difference), 1, within=1e-3)
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. log(400) = 5.99 nats: every cell has the probability 1/400. The start is harder: the target lies at what moved, but
#    of the start only the direction shows, not how far off the finger came down.
# 2. One layer, the last of the motions. While all motions are the same, Eq. (1) gives the same points whatever the
#    masks; and the last layer's weights are 0, so nothing passes through it to the layers below. What is left of the
#    others' gradients is rounding. One step later the motions differ from "stay", and everything learns. This is why
#    Sec. III-G's start is a good one: the first thing that can happen is that something moves.
