"""The networks: how one small perceptron per point becomes masks, motions and heat-maps.

Question: what turns a point cloud and a poke into masks and rigid motions, and two clouds into the poke between them?
What does such a network say before it has learnt anything, and which of its layers learns first?

Equations:
- Not in the paper, where the model looks and what the finger meets: `scene.look`, `networks.first_met`;
  tests/test_scene.py, tests/test_networks.py
- Sec. III-E and III-G, the siamese encoder and the state embedding: `networks.encode`, `networks.state_embedding`;
  tests/test_networks.py
- Sec. III-A, Eq. (1), masks and motions: `networks.forward_model`, `networks.predict`, `geometry.transform_layer`;
  tests/test_networks.py, tests/test_eq1_transform.py
- Sec. III-E, heat-maps of the poke: `networks.inverse_model`, `scene.most_changed`, `losses.heatmap_cross_entropy`;
  tests/test_networks.py, tests/test_scene.py, tests/test_inverse_loss.py
- Sec. III-G, initialisation: `networks.init_parameters`; tests/test_networks.py
- Eq. (6), the gradient of every term: `training.chunk_gradient`; tests/test_training.py

Time: 6 s. Pictures: 07_what_if.png, 07_masks.png, 07_heatmaps.png, 07_gradients.png.

Last lines to expect:
   gradient of the 3D terms of Eq. (6) against a finite difference, ratio: expected 1 within 0.001, got 1
07_networks: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. Two networks of the same shape appear side by side: a
# *fresh* one with random parameters, and the *shipped* one, data_small/checkpoint.npz, which was trained without
# labels.

# %%
import lesson  # first of all: it sets the number of BLAS threads

from dataclasses import replace

import autograd.numpy as anp
import numpy as np
from autograd import grad

from hind4sight_min import geometry, losses, networks, ops, training
from hind4sight_min.disk import checkpoints
from hind4sight_min.interactions import cell_centres, cells_of, grid_shape
from hind4sight_min.lab.evaluation import poke_errors, poke_from_heatmaps, true_motion
from hind4sight_min.lab.figures import PALETTE, blend, draw_arrow, flow_to_rgb
from hind4sight_min.scene import Scene, look, most_changed

options = lesson.begin("07_networks")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

data, truth = lesson.pokes()
shipped = checkpoints.load_run(lesson.data_small() / "checkpoint.npz")
fresh = training.start_run(shipped.recipe, data)
sizes, camera, settings = shipped.recipe.sizes, data.camera, data.settings
count = {name: int(np.prod(shape)) for name, shape in shipped.layout.items()}
each_point = sum(size for name, size in count.items() if name.startswith(("encoder", "trunk", "mask")))
print(f"1. {sum(count.values())} parameters in {len(count)} arrays, {each_point} of them in layers that run on every "
      "point")

# %% [markdown]
# ## A perceptron that knows no pixels
#
# Write P_t for the cloud of the picture before the poke, N points in metres, and u_t for the poke. Every layer is
#
#     z = x W + b,  y = max(z, 0.1 z)
#
# applied to each point by itself (`networks.layer`). The *siamese encoder* (Sec. III-E) is two such layers on 20
# fixed functions of a point's position, `networks.encoder_features`; siamese means that the clouds before and after
# share its parameters. The sum of its features over the points of objects is the *state embedding* s_t
# (`networks.state_embedding`); that of the predicted cloud P'_{t+1} is to be like that of the observed one, P_{t+1}.
#
# What tells the points about each other is *context*: the maximum and weighted sums of a layer's features over the
# whole cloud, handed back to every point. Neither a maximum nor a sum minds an order. So a shuffled cloud must give the
# same answer, shuffled.
#
# Most of a picture is table that stays. So the model looks only at points that stand out from the empty arena, or lie
# next to one that does, and of those only at the ones in a box around where the poke ends, 14 cm to each side
# (`scene.look`); all others are background. The box is in metres: it holds the same things in a picture of any size.
# `networks.predict` asks the *forward model* about these points and puts its answer back among the others.
#
# What a finger does to an object depends on where it meets it, which a perceptron learns slowly from coordinates:
# `networks.first_met` says it, in weights over the points. `networks.height_map` says what stands around the target.

# %%
ROW = 1
one, image = data[[ROW]], data.rgb_before[ROW] / 255
before, after = training.scenes_of(one)  # points (1, N, 3) m, valid (1, N), occupied (1, N), ...
rows, seen = look(before, one.pokes)     # (1, M): where the model looks
order = np.random.default_rng(0).permutation(before.points.shape[1])
mixed = Scene(*(each[:, order] for each in (before.points, before.valid, before.occupied, before.stands_out)))
straight, shuffled = (networks.predict(shipped.params, sizes, scene, one.pokes) for scene in (before, mixed))
order_matters = np.abs(straight.points[:, order] - shuffled.points).max()
print(f"2. The model looks at {seen.sum()} points of {before.points.shape[1]}; shuffling them changes the "
      f"predicted ones by at most {order_matters:.1e} m")

# %% [markdown]
# ## Masks and motions: fresh and shipped
#
# From the features of each point comes a *mask* m^k for each of K = 3 motions: three numbers that add up to 1. From
# the features pooled under each mask comes its motion: a rotation R_k and a translation T_k. They move the cloud by
# Eq. (1),
#
#     P'_{t+1} = sum_k m^k (R_k P_t + T_k)
#
# Motion 0 is the background's and always "stay". Everything is said in the *poke's frame*, in which the target is
# the origin and the poke goes along x. Sec. III-G starts with mask 0 ahead of the others and with motions that are
# the identity.

# %%
def answer_of(run, scene, pokes):
    """The forward model on a Scene -> masks (B, H, W, K), optical flow (B, H, W, 2) px, scene flow (B, N, 3) m."""
    prediction, shape = networks.predict(run.params, run.recipe.sizes, scene, pokes), scene.images.shape[:3]
    flow = geometry.optical_flow(scene.points, prediction.points, camera)
    return prediction.masks.reshape(*shape, -1), flow.reshape(*shape, 2), prediction.points - scene.points


def poke_arrow(panel, start, poke):
    draw_arrow(panel, *geometry.project(np.array([[*start, 0.02], [*poke[:2], 0.02]]), camera))


answers = {name: answer_of(run, before, one.pokes) for name, run in (("fresh", fresh), ("shipped", shipped))}
true_flow = true_motion(data, truth, ROW)[1].reshape(image.shape[:2] + (2,))
longest = np.linalg.norm(true_flow, axis=2).max()
for name, (masks, _, scene_flow) in answers.items():
    shares = masks.reshape(-1, sizes.masks)[rows[seen], 0]
    print(f"3. {name}: of a point that it looks at, the background has between {shares.min():.3f} and "
          f"{shares.max():.3f}; the longest motion is {100 * np.linalg.norm(scene_flow, axis=2).max():.2f} cm")

figure, axes = plt.subplots(2, sizes.masks + 2, figsize=(11, 4.0), layout="constrained")
for line, (name, (masks, flow, _)) in zip(axes, answers.items()):
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
scenes, _ = training.scenes_of(data[np.full(4, SCENE)])  # the same one four times
masks, _, scene_flow = answer_of(shipped, scenes, pokes)
covered = 1 - masks[..., 0].reshape(4, -1)  # (poke, point): not background
labels = truth.labels[SCENE].ravel()
on = np.array([[mask[labels == label].mean() for label in range(1, 5)] for mask in covered])  # (poke, object)
table = covered[:, labels == 0].mean()
print(f"4. Mean mask on the object that is poked {np.diag(on).mean():.2f}, on the others "
      f"{on[~np.eye(4, dtype=bool)].mean():.2f}, on the table {table:.4f}")

figure, axes = plt.subplots(2, 4, figsize=(11, 4.7), layout="constrained")
for poke in range(4):
    axes[0, poke].imshow(blend(scenes.images[poke], masks[poke][..., 1:]))
    poke_arrow(axes[0, poke], starts[poke], pokes[poke])
    axes[0, poke].set(xticks=[], yticks=[])
    axes[0, poke].set_title(f"masks, if the poke is {np.degrees(angles[poke]):.0f}\u00b0", fontsize=11)
    cloud, moves = scenes.points[poke], np.linalg.norm(scene_flow[poke], axis=1) > 0.002
    axes[1, poke].scatter(*cloud[cloud[:, 2] > 0.008, :2].T, color="0.6", s=7, linewidths=0)
    axes[1, poke].quiver(*cloud[moves, :2].T, *scene_flow[poke, moves, :2].T, color=PALETTE[5], angles="xy",
                         scale_units="xy", scale=1, width=0.008)
    axes[1, poke].set(aspect="equal", xlim=(-0.25, 0.25), ylim=(-0.18, 0.20), xlabel="x [m]")
axes[1, 0].set_ylabel("y [m]")
figure.suptitle("One scene, four imagined pokes: the masks and the predicted motion (seen from above) follow the poke",
                fontsize=11)
lesson.keep(options, figure, "what_if")

# %% [markdown]
# ## Backwards: which poke was it?
#
# The *inverse model* (Sec. III-E) sees both clouds and answers with two *heat-maps*, probabilities over the cells
# of the arena's grid: where the finger started, and its target. `scene.most_changed` picks the points that
# changed most; everything is said relative to their centre, so that a poke learnt in one corner is known in all.
# The loss of a heat-map is its cross entropy, minus the logarithm of the probability at the true cell. Knowing
# nothing costs log(number of cells).

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
    print(f"5. {name}: cross entropy of the start {start:.2f}, of the target {end:.2f}; "
          f"log({len(centres)}) = {np.log(len(centres)):.2f} nats")
print(f"   shipped: target off by {100 * np.median(target_error):.1f} cm (median)")

half = settings["arena"] / 2
figure, axes = plt.subplots(1, 4, figsize=(11, 3.4), layout="constrained")
counts = amount[ROW] > 1e-6 * amount[ROW].max()  # the others hardly changed at all
for clouds, colour, label in zip(changed, (PALETTE[5], PALETTE[6]), ("before", "after")):
    axes[0].scatter(*clouds[ROW, counts, :2].T, s=4 + 200 * amount[ROW, counts], color=colour, label=label,
                    linewidths=0)
axes[0].legend(fontsize=8, loc="upper right")
axes[0].set_title("the points that changed most", fontsize=11)
for panel, name, which, title in ((axes[1], "fresh", 1, "fresh: target"), (axes[2], "shipped", 0, "shipped: start"),
                                  (axes[3], "shipped", 1, "shipped: target")):
    map_ = maps[name][which][ROW].reshape(grid_shape(settings))
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
_, _, scene_flow = answer_of(beginner, training.scenes_of(train[:8])[0], train.pokes[:8])
print(f"6. Before the first step: longest motion {100 * np.abs(scene_flow).max():.2f} cm")
for step in range(1, 11):
    training.training_step(train, beginner)
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
# Eq. (6) adds up five terms, each with a weight lambda. It is tempting to choose the weights so that the weighted
# *values* are alike. But a network is moved by gradients. We compare, at the shipped parameters: a term's weighted
# value, the norm of its weighted gradient for one poke (median), and that of the mean gradient over the pokes. The mean
# is what moves the network; where it is far smaller than a single poke's, the pokes disagree.

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
by_hand = networks.encoder_features(before.points)
for name in ("encoder_1", "encoder_2"):
    by_hand = by_hand @ shipped.params[name + "_w"] + shipped.params[name + "_b"]
    by_hand = np.where(by_hand > 0, by_hand, 0.1 * by_hand)
lesson.check("encoder, largest difference to two layers by hand",
             float(np.abs(networks.encode(shipped.params, before.points) - by_hand).max()), below=1e-4)
summed = networks.STATE_GAIN * by_hand[0, before.occupied[0]].sum(axis=0)
embedding = networks.state_embedding(shipped.params, before.points, before.occupied)[0]
lesson.check("state embedding, largest difference to the sum over the points of objects, relative",
             float(np.abs(embedding - summed).max() / np.abs(summed).max()), below=1e-5)
lesson.check("shuffled points, largest difference [m]", float(order_matters), below=1e-4)
x, y, angle = data.pokes[ROW]
beyond = np.float32([[[x + 0.1 * np.cos(angle), y + 0.1 * np.sin(angle), 0]]])
lesson.check("10 cm beyond the target, in the poke's frame: distance to (0.1, 0, 0) [m]",
             float(np.linalg.norm(geometry.poke_frame(beyond, one.pokes) - [0.1, 0, 0])), below=1e-5)
elsewhere = np.delete(straight.masks[0], rows[seen], axis=0)
lesson.check("where it does not look: least share of the background", float(elsewhere[:, 0].min()), 1, within=0)
lesson.check("fresh: longest motion [m]", float(np.abs(answers["fresh"][2]).max()), below=1e-5)
e = np.exp(6 * np.tanh(-1 / 6))  # a mover's logit starts at -1, bounded by 6 tanh(. / 6)
even = {**fresh.params, "mask_w": 0 * fresh.params["mask_w"]}  # without the random part of the mask layer
share = networks.predict(even, sizes, before, one.pokes).masks[0, rows[seen], 0]
lesson.check("fresh: background's share of a point that it looks at, from its bias alone", float(share.mean()),
             1 / (1 + (sizes.masks - 1) * e), within=1e-4)
turn, target = (each[0] for each in geometry.poke_axes(one.pokes))
local = (before.points[0] - target) @ turn
moved = sum(straight.masks[0, :, k, None] * (local @ straight.rotations[0, k].T + straight.translations[0, k])
            for k in range(sizes.masks))
lesson.check("Eq. (1) by hand, largest difference [m]",
             float(np.abs(moved @ turn.T + target - straight.points[0]).max()), below=1e-5)
squares = straight.rotations @ np.swapaxes(straight.rotations, 2, 3)
lesson.check("rotations, largest entry of R R^T - I", float(np.abs(squares - np.eye(3)).max()), below=1e-4)
lesson.check("imagined pokes: mean mask on the object that is poked", float(np.diag(on).mean()), above=0.5)
lesson.check("imagined pokes: mean mask on the other objects", float(on[~np.eye(4, dtype=bool)].mean()), below=0.3)
lesson.check("fresh: cross entropy of the target [nats]", entropy["fresh"][1], np.log(len(centres)), within=0.4)
lesson.check("shipped: median target error [m]", float(np.median(target_error)), below=0.05)
others = np.delete(first[0], LAYERS.index("motion_3"))
lesson.check("first step: largest gradient of another layer / the last motion layer's",
             float(others.max() / first[0][LAYERS.index("motion_3")]), below=1e-4)
lesson.check("after one step: the masks' gradient / the last motion layer's",
             float(first[1][LAYERS.index("mask")] / first[1][LAYERS.index("motion_3")]), above=1e-4)
# The 2D terms sample pictures, which OpenCV does in float32; the inverse loss is cut off at the encoder on purpose.
smooth = {name: training.WEIGHTS[name] for name in ("chamfer", "distance_smoothness")}
batch = training.make_batch(one, shipped.recipe, np.random.default_rng(0))
batch = replace(batch, **{name: replace(scene, points=scene.points.astype(float), images=scene.images.astype(float))
                          for name, scene in (("before", batch.before), ("after", batch.after))})


def loss_at(vector):
    terms = training.loss_terms(ops.unflatten(vector, shipped.layout), sizes, batch, camera, smooth)
    return anp.sum(sum(weight * terms[name] for name, weight in smooth.items()))  # Eq. (6) by hand


vector = shipped.vector.astype(float)
direction = vector / np.linalg.norm(vector)  # all parameters a little larger
slope = grad(loss_at)(vector) @ direction
difference = (loss_at(vector + 1e-6 * direction) - loss_at(vector - 1e-6 * direction)) / 2e-6
lesson.check("gradient of the 3D terms of Eq. (6) against a finite difference, ratio",
             float(slope / difference), 1, within=1e-3)
print(f"{options.name}: all checks passed")
