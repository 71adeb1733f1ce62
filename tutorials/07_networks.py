"""The networks: how one small perceptron per point becomes masks, motions and heat-maps.

Question: what turns a point cloud and a poke into masks and rigid motions, and two clouds into the poke between them?
What does such a network say before it has learnt anything, and which of its layers learns first?

Equations:
- Not in the paper, where the model looks and what the finger meets: `networks.windows`, `networks.standing_out`, `networks.contact`; tests/test_networks.py
- Sec. III-E and III-G, the siamese encoder and the state embedding: `networks.encode`, `networks.state_embedding`; tests/test_networks.py
- Sec. III-A, Eq. (1), masks and motions: `networks.forward_model`, `networks.poke_frame`, `geometry.transform_layer`; tests/test_networks.py, tests/test_geometry.py
- Sec. III-E, heat-maps of the poke: `networks.inverse_model`, `networks.most_changed`, `losses.heatmap_cross_entropy`; tests/test_networks.py, tests/test_losses.py
- Sec. III-G, initialisation: `networks.init_parameters`; tests/test_networks.py
- Eq. (6), the gradient of every term: `training.batch_gradient`; tests/test_training.py

Time: 7 s. Pictures: 07_what_if.png, 07_masks.png, 07_heatmaps.png, 07_gradients.png.

Last lines to expect:
   gradient of the 3D terms of Eq. (6) against a finite difference, ratio: expected 1 within 0.001, got 1
07_networks: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. Two networks of the same shape appear side by side: a
# *fresh* one with random parameters, and the *shipped* one, data_small/checkpoint.npz, which was trained without
# labels.

# %%
from dataclasses import fields, replace

import lesson
import numpy as np

from hind4sight_min import evaluation, geometry, losses, networks, ops, training
from hind4sight_min.figures import PALETTE, blend, draw_arrow, flow_to_rgb

options = lesson.begin("07_networks")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

data, truth = lesson.pokes()
shipped = training.load_run(lesson.data_small() / "checkpoint.npz")
fresh = training.start_run(shipped.recipe, data)
sizes, camera, settings = shipped.recipe.sizes, data.camera, data.meta["settings"]
count = {name: int(np.prod(shape)) for name, shape in shipped.layout.items()}
each_point = sum(size for name, size in count.items() if name.startswith(("encoder", "trunk", "mask")))
print(f"1. {sum(count.values())} parameters in {len(count)} arrays, {each_point} of them in layers that run on every "
      "point")

# %% [markdown]
# ## A perceptron that knows no pixels
#
# Write P for the cloud of the picture before the poke, N points in metres, and u for the poke. Every layer is
#
#     z = x W + b,  y = max(z, 0.1 z)
#
# applied to each point by itself (`networks.layer`). The *siamese encoder* (Sec. III-E) is two such layers on 20
# fixed functions of a point's position, `networks.encoder_features`; siamese means that the clouds before and after
# share its parameters. The sum of its features over the points of objects is the *state embedding* s_t
# (`networks.state_embedding`); that of the predicted cloud is to be like that of the cloud that was observed.
#
# What tells the points about each other is *context*: the maximum and weighted sums of a layer's features over the
# whole cloud (`ops.pool`), handed back to every point. Neither a maximum nor a sum minds an order. So a shuffled
# cloud must give the same answer, shuffled. We try this on the whole forward model, with a batch of one poke.
#
# Most of a picture is table that stays. So the model looks at a window around the target (`networks.windows`), and
# there at the points that stand out from the empty arena, or are next to one that does (`networks.standing_out`); all
# others are background. What a finger does to an object depends on where it meets it, which a perceptron learns slowly
# from coordinates: `networks.contact` says it.

# %%
ROW = 1
batch = training.make_batch(data, np.array([ROW]))  # points (1, n, 3) m, valid (1, n), pokes (1, 3), ...
look = ops.at_rows(batch.look)
points, valid = batch.points[look], batch.valid[look]  # (1, M, 3), (1, M)
order = np.random.default_rng(0).permutation(points.shape[1])
straight = networks.forward_model(shipped.params, sizes, points, valid, batch.pokes)
shuffled = networks.forward_model(shipped.params, sizes, points[:, order], valid[:, order], batch.pokes)
order_matters = np.abs(straight.points[:, order] - shuffled.points).max()
print(f"2. The model looks at {points.shape[1]} points of {data.depth_before[ROW].size}; shuffling them changes the "
      f"predicted ones by at most {order_matters:.1e} m")

# %% [markdown]
# ## Masks and motions: fresh and shipped
#
# From the features of each point comes a *mask* m^k for each of K = 4 motions: four numbers that add up to 1. From
# the features pooled under each mask comes its motion: a rotation R_k and a translation T_k. They move the cloud by
# Eq. (1),
#
#     P'_i = sum_k m^k_i (R_k P_i + T_k)
#
# Motion 0 is the background's and always "stay". Everything is said in the *poke's frame*, in which the target is
# the origin and the poke goes along x. Sec. III-G starts with mask 0 ahead of the others and with motions that are
# the identity.
#
# `evaluation.predict` puts the answer back into the picture; where the model does not look all is background.

# %%
def predictions(run, pokes):
    """The model on a data set -> masks (B, H, W, K), optical flow (B, H, W, 2) px, P (B, N, 3) and P' (B, N, 3) m."""
    whole, prediction, flow, *_ = evaluation.predict(run, pokes, np.arange(len(pokes)))
    return prediction.masks.reshape(flow.shape[:3] + (-1,)), flow, whole.points, prediction.points


def poke_arrow(panel, start, poke):
    draw_arrow(panel, *geometry.project(np.array([[*start, 0.02], [*poke[:2], 0.02]]), camera))


one = data[np.array([ROW])]
image = data.rgb_before[ROW] / 255
answers = {"fresh": predictions(fresh, one), "shipped": predictions(shipped, one)}
true_flow = evaluation.true_motion(data, truth, ROW)[1].reshape(image.shape[:2] + (2,))
longest = np.linalg.norm(true_flow, axis=2).max()
inside = networks.windows(data.pokes[[ROW]], camera)[0]
for name, (masks, flow, before, after) in answers.items():
    shares = masks[0][inside].reshape(-1, sizes.masks)[batch.look[0], 0]
    print(f"3. {name}: of a point that it looks at, the background has between {shares.min():.3f} and "
          f"{shares.max():.3f}; the longest motion is {100 * np.linalg.norm(after - before, axis=2).max():.2f} cm")

figure, axes = plt.subplots(2, 6, figsize=(11, 3.6), layout="constrained")
for line, (name, (masks, flow, *_)) in zip(axes, answers.items()):
    line[0].imshow(image if name == "fresh" else flow_to_rgb(true_flow, longest))
    line[0].set_title("before, and the poke" if name == "fresh" else "true optical flow", fontsize=10)
    for k in range(sizes.masks):
        shown = line[k + 1].imshow(masks[0, ..., k], cmap="viridis", vmin=0, vmax=1)
        line[k + 1].set_title(f"{name}: mask $m^{k}$", fontsize=10)
    line[-1].imshow(flow_to_rgb(flow[0], longest))
    line[-1].set_title(f"{name}: optical flow", fontsize=10)
poke_arrow(axes[0, 0], data.starts[ROW], data.pokes[ROW])
for panel in axes.flat:
    panel.set(xticks=[], yticks=[])
figure.colorbar(shown, ax=axes, label="share of each point", shrink=0.8)
figure.suptitle("Before training: nearly the same masks wherever it looks, no motion. After it: masks on what moves",
                fontsize=11)
lesson.keep(options, figure, "masks")

# %% [markdown]
# ## What if?
#
# The masks are a function of the cloud *and of the poke*. Here is one scene and four pokes that nobody carried out,
# one at each object. The network never had a list of objects. What it calls an object is what moves together.

# %%
SCENE = 116
objects = truth.poses_before[SCENE, :4]
angles = np.radians([0, 90, 180, 270])
pokes = np.column_stack([objects[:, :2], angles]).astype(np.float32)
starts = pokes[:, :2] - np.float32(0.12) * np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
imagined = replace(data[np.full(4, SCENE)], pokes=pokes, starts=starts)
masks, _, before, after = predictions(shipped, imagined)
covered = 1 - masks[..., 0].reshape(4, -1)  # (poke, point): not background
labels = truth.labels[SCENE].ravel()
on = np.array([[mask[labels == label].mean() for label in range(1, 5)] for mask in covered])  # (poke, object)
table = covered[:, labels == 0].mean()
print(f"4. Mean mask on the object that is poked {np.diag(on).mean():.2f}, on the others "
      f"{on[~np.eye(4, dtype=bool)].mean():.2f}, on the table {table:.4f}")

figure, axes = plt.subplots(2, 4, figsize=(11, 4.7), layout="constrained")
scene = data.rgb_before[SCENE] / 255
for poke in range(4):
    axes[0, poke].imshow(blend(scene, masks[poke][..., 1:]))
    poke_arrow(axes[0, poke], starts[poke], pokes[poke])
    axes[0, poke].set(xticks=[], yticks=[])
    axes[0, poke].set_title(f"masks, if the poke is {np.degrees(angles[poke]):.0f}\u00b0", fontsize=11)
    moves = np.linalg.norm(after[poke] - before[poke], axis=1) > 0.002
    standing = before[poke, :, 2] > 0.008
    axes[1, poke].scatter(*before[poke, standing, :2].T, color="0.6", s=7, linewidths=0)
    axes[1, poke].quiver(*before[poke, moves, :2].T, *(after[poke] - before[poke])[moves, :2].T, color=PALETTE[5],
                         angles="xy", scale_units="xy", scale=1, width=0.008)
    axes[1, poke].set(aspect="equal", xlim=(-0.25, 0.25), ylim=(-0.18, 0.20), xlabel="x [m]")
axes[1, 0].set_ylabel("y [m]")
figure.suptitle("One scene, four imagined pokes: the masks and the predicted motion (seen from above) follow the poke",
                fontsize=11)
lesson.keep(options, figure, "what_if")

# %% [markdown]
# ## Backwards: which poke was it?
#
# The *inverse model* (Sec. III-E) sees both clouds and answers with two *heat-maps*, probabilities over the cells
# of the arena's grid: where the finger started, and its target. `networks.most_changed` picks the points that
# changed most; everything is said relative to their centre, so that a poke learnt in one corner is known in all.
# The loss of a heat-map is its cross entropy, minus the logarithm of the probability at the true cell. Knowing
# nothing costs log(number of cells).

# %%
rows = np.arange(40)
many = training.make_batch(data, rows)
maps = {name: networks.inverse_model(run.params, many.before, many.after, many.change, many.cells)
        for name, run in (("fresh", fresh), ("shipped", shipped))}  # logits (start, target), each (B, cells)
entropy = {name: [float(losses.heatmap_cross_entropy(logits, cells).mean())
                  for logits, cells in zip(pair, (many.start_cells, many.end_cells))] for name, pair in maps.items()}
probabilities = {name: [np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True) for logits in pair]
                 for name, pair in maps.items()}
guesses = evaluation.poke_from_heatmaps(*probabilities["shipped"], settings)
target_error, direction_error = evaluation.poke_errors(guesses, many.pokes)
for name, (start, end) in entropy.items():
    print(f"5. {name}: cross entropy of the start {start:.2f}, of the target {end:.2f}; "
          f"log({len(many.cells)}) = {np.log(len(many.cells)):.2f} nats")
print(f"   shipped: target off by {100 * np.median(target_error):.1f} cm (median)")

half = settings["arena"] / 2
figure, axes = plt.subplots(1, 4, figsize=(11, 3.4), layout="constrained")
for cloud, colour, label in ((many.before[ROW], PALETTE[5], "before"), (many.after[ROW], PALETTE[6], "after")):
    axes[0].scatter(*cloud[:, :2].T, s=4 + 200 * many.change[ROW], color=colour, label=label, linewidths=0)
axes[0].legend(fontsize=8, loc="upper right")
axes[0].set_title("the points that changed most", fontsize=11)
for panel, name, which, title in ((axes[1], "fresh", 1, "fresh: target"), (axes[2], "shipped", 0, "shipped: start"),
                                  (axes[3], "shipped", 1, "shipped: target")):
    map_ = probabilities[name][which][ROW].reshape(data.grid_shape)
    panel.imshow(map_, origin="lower", extent=(-half, half, -half, half), cmap="cividis", vmin=0,
                 vmax=max(map_.max(), 0.02), interpolation="nearest")
    panel.plot(*(data.pokes[ROW, :2] if which else data.starts[ROW]), "o", markersize=12, fillstyle="none",
               color=PALETTE[6], markeredgewidth=2)
    panel.set_title(f"{title}, max {map_.max():.3f}", fontsize=11)
for panel in axes:
    panel.set(aspect="equal", xlim=(-half, half), ylim=(-half, half), xlabel="x [m]", xticks=[-0.2, 0, 0.2],
              yticks=[-0.2, 0, 0.2])
axes[0].set_ylabel("y [m]")
figure.suptitle("The inverse model narrows two uniform heat-maps down to the true cells (circles)", fontsize=11)
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
beginner = training.start_run(training.Recipe(), train)
kick = {name: np.zeros(shape, np.float32) for name, shape in beginner.layout.items()}
kick["motion_3_w"] += KICK * np.random.default_rng(0).standard_normal(kick["motion_3_w"].shape).astype(np.float32)
beginner.vector = beginner.vector + np.concatenate([value.ravel() for value in kick.values()])
fixed = training.make_batch(train, np.arange(16))
only_chamfer = {name: weight * (name == "chamfer") for name, weight in training.WEIGHTS.items()}


def layer_gradients(run):
    """The norm of the Chamfer term's gradient with respect to the weights of each layer, an array like LAYERS."""
    _, gradient = training.batch_gradient(run.vector, run.layout, run.recipe.sizes, fixed, camera, only_chamfer)
    found = training.unflatten(gradient, run.layout)
    return np.array([np.linalg.norm(found[f"{name}_w"]) for name in LAYERS])


first = {0: layer_gradients(beginner)}
untrained = training.predict_clouds(beginner.params, beginner.recipe.sizes, fixed)
print(f"6. Before the first step: longest motion {100 * np.abs(untrained.points - fixed.points).max():.2f} cm")
with training.workers(1) as gradients:
    for step in range(1, 11):
        training.training_step(train, beginner, gradients)
        if step in (1, 10):
            first[step] = layer_gradients(beginner)
for step, norms in first.items():
    print(f"   gradients after {step:2d} steps:", ", ".join(f"{name} {norm:.1e}" for name, norm in zip(LAYERS, norms)))

# %% [markdown]
# In the first step one layer learns, the last of the motions. While all motions are the same, Eq. (1) gives the
# same points whatever the masks; and the last layer's weights are 0, so nothing passes through it to the layers
# below. What is left of the others' gradients is rounding. One step later the motions differ from "stay", and
# everything learns. This is why Sec. III-G's start is a good one: the first thing that can happen is that something
# moves.
#
# ## How hard does each term pull?
#
# Eq. (6) adds up five terms, each with a weight lambda; a sixth, `losses.sharing_loss`, is ours. It is tempting to
# choose the weights so that the weighted *values* are alike. But a network is moved by gradients. We compare, at the
# shipped parameters: a term's weighted value, the norm of its weighted gradient for one poke (median), and that of the
# mean gradient over the pokes. The mean is what moves the network; where it is far smaller than a single poke's, the
# pokes disagree.

# %%
AUDITED = 10 if options.quick else 24
audit = {}
for term, weight in training.WEIGHTS.items():
    alone = {name: float(name == term) for name in training.WEIGHTS}
    found = [training.batch_gradient(shipped.vector, shipped.layout, sizes, training.make_batch(data, np.array([row])),
                                     camera, alone) for row in range(AUDITED)]
    gradients = np.stack([gradient for _, gradient in found])
    audit[term] = weight * np.array([np.mean([values[term] for values, _ in found]),
                                     np.median(np.linalg.norm(gradients, axis=1)),
                                     np.linalg.norm(gradients.mean(axis=0))])
    print(f"7. {term}, weight {weight:g}: value {audit[term][0]:.3g}, one poke's gradient {audit[term][1]:.3g}, "
          f"mean gradient {audit[term][2]:.3g}")

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
for i, (step, norms) in enumerate(first.items()):
    left.bar(np.arange(len(LAYERS)) + 0.27 * (i - 1), np.maximum(norms, 1e-4), 0.27, color=PALETTE[(1, 0, 5)[i]],
             label=f"after {step} step{'s' * (step != 1)}")
left.set(yscale="log", ylim=(1e-4, 1e3), ylabel="norm of the Chamfer term's gradient")
left.set_xticks(range(len(LAYERS)), LAYERS, rotation=40, ha="right")
left.set_title("The first step reaches one layer only", fontsize=11)
left.legend(fontsize=9, loc="upper left")
for i, (label, colour) in enumerate((("value", PALETTE[2]), ("one poke's gradient", PALETTE[1]),
                                     ("mean gradient", PALETTE[5]))):
    right.bar(np.arange(len(audit)) + 0.27 * (i - 1), [values[i] for values in audit.values()], 0.27, color=colour,
              label=label)
right.set(yscale="log", ylim=(0.01, 3e3), ylabel="times the weight")
right.set_xticks(range(len(audit)), [name.replace("_", "\n") for name in audit])
right.set_title("What a term costs, and how hard it pulls", fontsize=11)
right.legend(fontsize=9, loc="upper right")
figure.suptitle("Which layer learns first, and which term pulls hardest", fontsize=11)
lesson.keep(options, figure, "gradients")

# %% [markdown]
# docs/research-log.md tells what this audit was good for: weights that looked harmless by their values let flow
# smoothness pull harder than the Chamfer distance, and the predictions got worse as it was switched on.
#
# **Now change this:** set `KICK = 0.05`. The fresh motions are then no longer the identity. Which layers get a
# gradient in the first step now? And why would you still rather start from the identity? (Look at the longest
# motion that the network predicts before it has learnt anything.)

# %% Check
print("8. Check")
features = networks.encoder_features(batch.points)
by_hand = features
for name in ("encoder_1", "encoder_2"):
    by_hand = by_hand @ shipped.params[name + "_w"] + shipped.params[name + "_b"]
    by_hand = np.where(by_hand > 0, by_hand, 0.1 * by_hand)
lesson.check("encoder, largest difference to two layers by hand",
             float(np.abs(networks.encode(shipped.params, batch.points) - by_hand).max()), below=1e-4)
summed = networks.STATE_GAIN * by_hand[0, batch.occupied[0]].sum(axis=0)
embedding = networks.state_embedding(shipped.params, batch.points, batch.occupied)[0]
lesson.check("state embedding, largest difference to the sum over the points of objects, relative",
             float(np.abs(embedding - summed).max() / np.abs(summed).max()), below=1e-5)
lesson.check("shuffled points, largest difference [m]", float(order_matters), below=1e-4)
x, y, angle = data.pokes[ROW]
beyond = np.float32([[[x + 0.1 * np.cos(angle), y + 0.1 * np.sin(angle), 0]]])
lesson.check("10 cm beyond the target, in the poke's frame: distance to (0.1, 0, 0) [m]",
             float(np.linalg.norm(networks.poke_frame(beyond, data.pokes[[ROW]]) - [0.1, 0, 0])), below=1e-5)
lesson.check("fresh: longest motion [m]", float(np.abs(answers["fresh"][3] - answers["fresh"][2]).max()), below=1e-5)
e = np.exp(6 * np.tanh(-1 / 6))  # a mover's logit starts at -1, bounded by 6 tanh(. / 6)
even = {**fresh.params, "mask_w": 0 * fresh.params["mask_w"]}  # without the random part of the mask layer
share = networks.forward_model(even, sizes, points, valid, batch.pokes).masks[..., 0]
lesson.check("fresh: background's share of a point, from its bias alone", float(share.mean()), 1 / (1 + 3 * e),
             within=1e-4)
axes_, origin = networks.poke_axes(batch.pokes)
local = (points[0] - origin[0]) @ axes_[0]
moved = sum(straight.masks[0, :, k, None] * (local @ straight.rotations[0, k].T + straight.translations[0, k])
            for k in range(sizes.masks))
lesson.check("Eq. (1) by hand, largest difference [m]",
             float(np.abs(moved @ axes_[0].T + origin[0] - straight.points[0]).max()), below=1e-5)
squares = straight.rotations @ np.swapaxes(straight.rotations, 2, 3)
lesson.check("rotations, largest entry of R R^T - I", float(np.abs(squares - np.eye(3)).max()), below=1e-4)
lesson.check("imagined pokes: mean mask on the object that is poked", float(np.diag(on).mean()), above=0.5)
lesson.check("imagined pokes: mean mask on the other objects", float(on[~np.eye(4, dtype=bool)].mean()), below=0.3)
lesson.check("fresh: cross entropy of the target [nats]", entropy["fresh"][1], np.log(len(many.cells)), within=0.4)
lesson.check("shipped: median target error [m]", float(np.median(target_error)), below=0.05)
others = np.delete(first[0], LAYERS.index("motion_3"))
lesson.check("first step: largest gradient of another layer / the last motion layer's",
             float(others.max() / first[0][LAYERS.index("motion_3")]), below=1e-4)
lesson.check("after one step: the masks' gradient / the last motion layer's",
             float(first[1][LAYERS.index("mask")] / first[1][LAYERS.index("motion_3")]), above=1e-4)
double = replace(batch, **{field.name: getattr(batch, field.name).astype(float) for field in fields(batch)
                           if getattr(getattr(batch, field.name), "dtype", None) == np.float32})
# The 2D terms sample pictures, which OpenCV does in float32; the inverse loss is cut off at the encoder on purpose.
smooth = {name: weight * (name in ("chamfer", "distance_smoothness")) for name, weight in training.WEIGHTS.items()}
def loss_at(vector):
    terms = training.loss_terms(training.unflatten(vector, shipped.layout), sizes, double, camera)
    return sum(weight * float(terms[name].mean()) for name, weight in smooth.items())  # Eq. (6) by hand


vector = shipped.vector.astype(float)
_, gradient = training.batch_gradient(vector, shipped.layout, sizes, double, camera, smooth)
direction = vector / np.linalg.norm(vector)  # all parameters a little larger
slope = gradient @ direction
difference = (loss_at(vector + 1e-6 * direction) - loss_at(vector - 1e-6 * direction)) / 2e-6
lesson.check("gradient of the 3D terms of Eq. (6) against a finite difference, ratio",
             float(slope / difference), 1, within=1e-3)
print(f"{options.name}: all checks passed")
