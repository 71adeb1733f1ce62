"""The forward model: how one small perceptron per point becomes masks and motions.

Question: what turns a point cloud and a poke into masks and rigid motions, and what does such a network say before it
has learnt anything?

Equations:
- Not in the paper, where the model looks and what the finger meets: `scene.look`, `networks.first_met`,
  `networks.height_map`; tests/test_scene.py, tests/test_networks.py
- Sec. III-A, the poke as a frame: `geometry.poke_frame`, `networks.poke_features`;
  tests/test_geometry.py, tests/test_networks.py
- Sec. III-E and III-G, the siamese encoder and the state embedding: `networks.encode`, `networks.state_embedding`;
  tests/test_networks.py
- Sec. III-A, Eq. (1), masks and motions: `networks.forward_model`, `networks.softmax`, `networks.predict`,
  `geometry.so3_exp`, `geometry.transform_layer`; tests/test_networks.py, tests/test_eq1_transform.py
- Sec. III-G, initialisation: `networks.init_parameters`; tests/test_networks.py

Time: 4 s. Pictures: 08_what_if.png, 08_masks.png, 08_architecture.png.

Last lines to expect:
   imagined pokes: mean mask on the other objects: expected below 0.3, got 0.01
08_forward_model: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. Two networks of the same shape appear side by side: a
# *fresh* one with random parameters, and the *shipped* one, data_small/checkpoint.npz, which was trained without
# labels.

# %%
import lesson  # first of all: it sets the number of BLAS threads

import numpy as np

from hind4sight_min import geometry, networks, training
from hind4sight_min.disk import checkpoints
from hind4sight_min.lab.evaluation import true_motion
from hind4sight_min.lab.figures import BLUE, SHARES, blend, draw_arrow, draw_wheel, show_flow, show_image
from hind4sight_min.scene import Scene, look

options = lesson.begin("08_forward_model")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

data, truth = lesson.pokes()
shipped = checkpoints.load_run(lesson.data_small() / "checkpoint.npz")
fresh = training.start_run(shipped.recipe, data)
sizes, camera = shipped.recipe.sizes, data.camera
count = {name: int(np.prod(shape)) for name, shape in shipped.layout.items()}
each_point = sum(size for name, size in count.items() if name.startswith(("encoder", "trunk", "mask")))
print(f"1. {sum(count.values())} parameters in {len(count)} arrays, {each_point} of them in layers that run on every "
      "point")

# %% [markdown]
# ## The way through the network
#
# The upper half of docs/architecture.md: from the cloud (left) and the poke to the predicted cloud and its optical flow
# (right). The numbers along the arrows are shapes: 105 points of one poke enter with 3 coordinates each, and leave with
# 3 masks each.

# %%
lesson.keep(options, lesson.architecture().draw(view=(5.0, 26.2, 5.0, 10.4)), "architecture", dpi=85)

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
# What tells the points about each other is *context*: the maximum and a weighted sum of a layer's features over all
# points that it looks at, handed back to every point. Neither a maximum nor a sum minds an order. So a shuffled cloud
# must give the same answer, shuffled.
#
# Most of a picture is table that stays. So the model looks only at points that stand out from the empty arena, or lie
# next to one that does, and of those only at the ones in a box around where the poke ends, 14 cm to each side
# (`scene.look`); all others are background. The box is in metres: it holds the same things in a picture of any size.
# `networks.predict` asks the *forward model* about these points and puts its answer back among the others.
#
# What a finger does to an object depends on where it meets it, which a perceptron learns slowly from coordinates:
# `networks.first_met` says it, in weights over the points, those of the sum above. `networks.height_map` says what
# stands around the target, `networks.wall_map` adds the walls, and both are part of the context too.

# %%
ROW = 1
one, image = data[[ROW]], data.rgb_before[ROW] / 255
before, after = training.scenes_of(one)  # points (1, N, 3) m, valid (1, N), occupied (1, N), ...
rows, seen = look(before, one.pokes)     # (1, M): where the model looks
order = np.random.default_rng(0).permutation(before.points.shape[1])
in_another_order = (each[:, order] for each in (before.points, before.valid, before.occupied, before.stands_out))
mixed = Scene(*in_another_order, arena=before.arena)
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
# Motion 0 is the background's and always "stay". All but the encoder's features is said in the *poke's frame*, in which
# the target is the origin and the poke goes along x. Sec. III-G starts with mask 0 ahead of the others and with motions
# that are the identity.
#
# **Predict before you run:** in the fresh network the background's logit is 0 and that of each of the two movers about
# -1, at every point. What share of a point does the background get? And how far does this network move anything?

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
    for k in range(sizes.masks):
        shown = show_image(line[k + 1], masks[0, ..., k], f"{name}: mask $m^{k}$", cmap=SHARES, vmin=0, vmax=1)
    show_flow(line[-1], flow[0], longest, f"{name}: optical flow")
show_image(axes[0, 0], image, "before, and the poke")
show_flow(axes[1, 0], true_flow, longest, "true optical flow")
draw_wheel(axes[1, 0], longest, low=False)
poke_arrow(axes[0, 0], data.starts[ROW], data.pokes[ROW])
figure.colorbar(shown, ax=axes, label="share of each point", shrink=0.8)
figure.suptitle("Before training: nearly the same masks wherever it looks, no motion. After it: masks on what moves",
                fontsize=11)
lesson.keep(options, figure, "masks")

# %% [markdown]
# ## What if?
#
# Here is one scene and four pokes that nobody carried out, one at each object. The network never had a list of objects.
# What it calls an object is what moves together.
#
# **Predict before you run:** one scene, four pokes: are the masks the same four times, because the objects are?

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
    axes[1, poke].quiver(*cloud[moves, :2].T, *scene_flow[poke, moves, :2].T, color=BLUE, angles="xy",
                         scale_units="xy", scale=1, width=0.008)
    axes[1, poke].set(aspect="equal", xlim=(-0.25, 0.25), ylim=(-0.18, 0.20), xlabel="x [m]")
axes[1, 0].set_ylabel("y [m]")
figure.suptitle("One scene, four imagined pokes: masks and predicted motion (lower line, from above) follow the poke",
                fontsize=11)
lesson.keep(options, figure, "what_if")

# %% [markdown]
# **Now change this:** `np.column_stack([objects[:, :2], angles])` to `np.column_stack([objects[:, :2] + 0.12,
# angles])`: all four pokes miss by 12 cm in x and in y. Most masks vanish, and where a poke happens to end near another
# object, that one gets the mask. The Check "imagined pokes: mean mask on the object that is poked" objects.

# %% Check
print("5. Check")
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
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. A little more than half: e^0 / (e^0 + 2 e^-1) = 0.58 (0.57, as logits are bounded). Not all of it: a mask of
#    nothing could not learn, for whatever its motion does, nothing changes. It moves nothing, as all its motions are
#    the identity.
# 2. No. The masks are a function of the cloud *and of the poke*: they say what this poke will move.
