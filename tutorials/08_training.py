"""Training: masks emerge while the losses fall, though nobody ever showed one.

Question: no loss says what an object is. Do masks appear all the same, when, and what does the network get right first?

Equations:
- Eq. (6), the full loss: `training.loss_terms`, `losses.full_loss`; tests/test_training.py, tests/test_losses.py
- Not in the paper, a price on sharing an object between masks: `losses.sharing_loss`; tests/test_losses.py
- Eq. (3), why it wants a little noise: `training.Recipe`; tests/test_training.py
- Sec. III-G, the optimiser, batches, epochs: `training.optimiser_step`, `training.rows_of_step`, `training.learning_rate`, `training.train`; tests/test_training.py
- Sec. IV-C, the error on held-out pokes: `evaluation.evaluate`; tests/test_evaluation.py

Time: 35 s. Pictures: 08_emergence.gif, 08_kink.png, 08_masks.png, 08_losses.png.

Last lines to expect:
   held-out: IoU of the masks: expected above 0.4, got 0.6557
08_training: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. We train the whole model from scratch on the 400 pokes
# of data_small/train. data_small/test and the simulator's truth only measure.

# %%
import time

import lesson
import numpy as np
from matplotlib.animation import PillowWriter

from hind4sight_min import evaluation, losses, networks, training
from hind4sight_min.figures import PALETTE, TERMS, blend, flow_to_rgb
from hind4sight_min.geometry import project

options = lesson.begin("08_training")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

train, _ = lesson.pokes("train")  # _ is the truth: training never sees it
held_out, truth = lesson.pokes("test")
camera = train.camera
recipe = training.Recipe(steps=250)
if options.quick:
    recipe = training.Recipe(steps=120, batch=8, warmup=20, learning_rate=3e-3)

# %% [markdown]
# ## What a step does
#
# A *step* takes a batch of pokes, computes the gradient g of the full loss, Eq. (6), averaged over the batch, and
# hands it to the optimiser. The paper's is Adam (Sec. III-G). Adam keeps a running mean a of g and a running mean v of
# its square, both corrected for having started at 0, and moves every parameter by
#
#     - rate * a / (sqrt(v) + 1e-8)
#
# In the very first step a = g and v = g^2: every parameter moves by the rate, in the direction of the sign of its
# gradient, however small the gradient is. An *epoch* is as many steps as it takes to see every poke once.
#
# We leave that to the biases. The weights of a layer are a matrix, and its running mean A = U S V^T usually has a few
# large singular values and many small ones: a few directions have all the say. We move it along U V^T instead,
#
#     - rate * sqrt(larger of its two sizes) * U V^T
#
# so that every direction has the same say (the optimiser is called Muon; the root makes an entry move by the rate, in
# the root mean square, as in Adam's first step). `training.orthogonalised` comes near U V^T without an SVD. It was the
# largest single gain of all that docs/research-log.md lists under the network: a third of the steps do.
#
# The rate rises over the first steps, then falls to zero (`training.learning_rate`).

# %%
steps = np.arange(recipe.steps)
rates = np.array([training.learning_rate(recipe, step) for step in steps])
print(f"1. {recipe.steps} steps of {recipe.batch} pokes, {recipe.steps * recipe.batch / len(train):.1f} epochs; the "
      f"rate rises to {rates.max():.1e}")

# %% [markdown]
# ## A kink, and a little noise
#
# A fresh network's masks are everywhere: whatever it moves, it moves nearly everything. Let us do just that, move all
# that the model looks at by a hundredth of a pixel along the poke, and see what the photometric loss, Eq. (3), says
# to it. The object that was poked gains, as it did move that way. Everything else loses.
#
# Guess first: most of what is not the object is bare table. Which wins, for motions as small as that?

# %%
SHIFTS = np.array([-0.05, -0.02, -0.01, -0.005, 0, 0.002, 0.005, 0.01, 0.02, 0.05])  # px
NOISES = (0.0, recipe.image_noise)
rows = np.arange(100)
ends = [project(np.column_stack([places, np.full(len(rows), 0.02)]), camera)
        for places in (train.starts[rows], train.pokes[rows, :2])]
along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0], axis=1, keepdims=True)  # (100, 2)
change = []
for noise in NOISES:
    batch = training.make_batch(train, rows, rng=np.random.default_rng(0), image_noise=noise)
    inner = np.zeros(batch.images.shape[1:3], bool)
    inner[1:-1, 1:-1] = True  # the same pixels for all shifts: none leaves the window
    flows = [np.float32(shift * along[:, None, None]) * np.ones(batch.images.shape[:3] + (1,), np.float32)
             for shift in SHIFTS]
    counted = batch.shared & inner.ravel()
    loss = np.array([losses.photometric_loss(batch.images, batch.next_images, flow, counted).mean() for flow in flows])
    change.append(loss - loss[SHIFTS == 0])
change = np.array(change)  # (2, shifts)
for noise, values in zip(NOISES, change):
    print(f"2. Images with noise of SD {noise}: photometric loss is lowest for a shift of "
          f"{SHIFTS[values.argmin()]:.3f} px")

figure, panel = plt.subplots(figsize=(6.5, 3.4), layout="constrained")
for noise, values, colour, style in zip(NOISES, change, (PALETTE[6], PALETTE[5]), ("s:", "o-")):
    panel.plot(SHIFTS, values, style, color=colour, label=f"noise of SD {noise} on $I_t$")
panel.axhline(0, color="0.5", linewidth=1)
panel.axvline(0, color="0.5", linewidth=1)
panel.set(xlabel="everything moved along the poke by [px]", ylabel="change of the photometric loss")
panel.legend(fontsize=9)
panel.set_title("A kink at no motion holds everything in place; a little noise rounds it off", fontsize=11)
lesson.keep(options, figure, "kink")

# %% [markdown]
# What stands still wins: walls and the other objects have edges, too. A simulator renders them twice the same to the
# last bit, so the absolute value in Eq. (3) sits in its kink there, and to leave it costs the same per pixel in every
# direction, however small the motion. The object gains at the same rate, on fewer pixels. So no motion is a minimum. A
# network whose first motions are small and shared by all is pushed back into it, and its masks shrink to be safe.
#
# No camera takes the same picture twice. With noise of less than one grey level of 255 on I_t the kink becomes a
# bowl, flat at the bottom, and there the object's gain decides. That is what `Recipe.image_noise` is for. (On I_{t+1}
# noise would do harm: warping interpolates, which takes noise out, and so any motion of half a pixel would pay.)

# %% [markdown]
# ## Train, and look on
#
# `training.train` calls us back. After every few steps we keep what the model says of two held-out pokes, to draw
# later; after every epoch we measure it on more of them:
#
# - the *ratio*: squared error of the scene flow over the moving points, divided by that of predicting no motion;
# - the mean *cover*, 1 - m^0, how much of a point is not background, of points that move and of points that do not
#   (both among those that stand out around the target, which is all that the model looks at);
# - the *IoU*, intersection over union, of each moved object and its best mask, with every point given to its largest
#   mask.
#
# **Predict before you run:** will the cover of moving points rise at once, or fall first? (Fresh masks cover everything
# a little.)

# %%
SHOWN = [1, 29]           # held-out pokes to draw
MEASURED = np.arange(60)  # and to measure
run = training.start_run(recipe, train)
start_vector = run.vector.copy()
near = np.zeros((len(MEASURED), camera.height, camera.width), bool)  # the points that the model looks at
stand_out = training.make_batch(held_out, MEASURED).look  # rows of flattened windows
for picture, part, rows in zip(near, networks.windows(held_out.pokes[MEASURED], camera), stand_out):
    picture[part] = np.isin(np.arange(picture[part].size), rows).reshape(picture[part].shape)
near = near.reshape(len(MEASURED), -1)
moving = np.stack([evaluation.true_motion(held_out, truth, row)[2] for row in MEASURED])
snapshots, measured = [], []


def look(run):
    """Keep masks (2, H, W, K) and optical flow (2, H, W, 2) px of the held-out pokes to draw."""
    _, prediction, flow, *_ = evaluation.predict(run, held_out[SHOWN], np.arange(len(SHOWN)))
    snapshots.append((run.step, prediction.masks.reshape(flow.shape[:3] + (-1,)), flow))


def measure(run):
    """Keep (step, ratio, cover of moving points, cover of still points, IoU) of the held-out pokes to measure."""
    metrics = evaluation.evaluate(run, held_out[MEASURED], truth[MEASURED])
    cover = 1 - evaluation.predict(run, held_out, MEASURED)[1].masks[..., 0]  # (60, N)
    on, off = cover[near & moving].mean(), cover[near & ~moving].mean()
    measured.append((run.step, metrics["flow_mse_ratio"], on, off, metrics["mask_iou"]))


def every_few_steps(run):
    few = recipe.steps // 25
    often = run.step <= recipe.steps // 2 or run.step == recipe.steps  # more often where more happens
    if run.step % (few if often else 3 * few) == 0:
        look(run)


def every_epoch(run):
    measure(run)
    step, ratio, on, off, iou = measured[-1]
    print(f"   epoch {len(run.log):2d}, step {step}: Chamfer {1e4 * run.log[-1]['chamfer']:.0f} cm^2 a poke, ratio "
          f"{ratio:.2f}, cover of moving points {on:.2f}, of still ones {off:.3f}, IoU {iou:.2f}")


print("3. Training")
look(run)
measure(run)
began = time.perf_counter()
training.train(train, run, jobs=1, on_epoch=every_epoch, on_step=every_few_steps)
print(f"   {time.perf_counter() - began:.0f} s")
step, ratio, on, off, iou = np.array(measured).T  # each (epochs + 1,)

# %% [markdown]
# ## The losses, and what they never saw
#
# For each term of Eq. (6) the mean over each epoch, and a dotted line: what no motion costs. A fresh network
# predicts no motion, so its terms are these lines (of the inverse loss it is what a uniform guess costs). Flow
# smoothness goes the other way. No motion is perfectly smooth; to move anything at all costs something. (A sixth term,
# which is ours, is not drawn: `losses.sharing_loss`, a small price where near points move by different masks. All terms
# of Eq. (6) are as content with an object in two masks that move alike.)

# %%
fresh = training.start_run(recipe, train)
noisy = training.make_batch(train, np.arange(100), rng=np.random.default_rng(1), image_noise=recipe.image_noise)
level = training.loss_terms(fresh.params, recipe.sizes, noisy, camera)
level = {name: float(np.mean(values)) for name, values in level.items() if name in losses.PAPER_WEIGHTS}
epoch_end = [entry["step"] for entry in run.log]
shipped = evaluation.evaluate(training.load_run(lesson.data_small() / "checkpoint.npz"), held_out[MEASURED],
                              truth[MEASURED])
print(f"4. Ratio after {step[-1]:.0f} steps on {len(train)} pokes {ratio[-1]:.2f}, of the shipped checkpoint "
      f"{shipped['flow_mse_ratio']:.2f}; cover of moving / of still points: fresh {on[0] / off[0]:.1f}, at the end "
      f"{on[-1] / off[-1]:.0f}")
for name in level:
    print(f"   {name}: no motion {level[name]:.3g}, first epoch {run.log[0][name]:.3g}, last {run.log[-1][name]:.3g}")

figure, axes = plt.subplots(2, 4, figsize=(11, 5.2), layout="constrained")
for panel, name in zip(axes.flat, level):
    panel.plot(epoch_end, [entry[name] for entry in run.log], ".-", color=PALETTE[5])
    panel.axhline(level[name], color="0.5", linestyle=":")
    panel.set_title(f"{name.replace('_', ' ')}\n{TERMS[name]}", fontsize=10)
    panel.set_ylim(0, 1.1 * max(panel.get_ylim()[1], level[name]))
axes.flat[5].plot(steps, rates, color=PALETTE[6])
axes.flat[5].set_title("learning rate", fontsize=10)
axes.flat[5].set_ylim(0, None)
axes.flat[6].plot(step, ratio, ".-", color=PALETTE[5])
axes.flat[6].axhline(1, color="0.5", linestyle=":")
axes.flat[6].set_title("held-out: squared flow error\n/ no motion", fontsize=10)
axes.flat[6].set_ylim(0, None)
axes.flat[7].plot(step, on, ".-", color=PALETTE[6], label="cover, moving points")
axes.flat[7].plot(step, off, ".-", color=PALETTE[1], label="cover, still points")
axes.flat[7].plot(step, iou, ".-", color=PALETTE[2], label="IoU of the masks")
axes.flat[7].set_title("held-out: masks\n(no loss asks for them)", fontsize=10)
axes.flat[7].set_ylim(0, 1.5)
axes.flat[7].legend(fontsize=8, loc="upper center")
for panel in axes[1]:
    panel.set_xlabel("step")
figure.suptitle("The losses fall, most of them below what no motion costs (dotted); masks come with it",
                fontsize=11)
lesson.keep(options, figure, "losses")

# %% [markdown]
# ## See them emerge
#
# Each mask in a colour of its own, mixed by its share; grey is background. Two pokes that training never saw, cut
# to the windows in which the model looks. The last column shows the objects that really moved.

# %%
parts = networks.windows(held_out.pokes[SHOWN], camera)  # half the picture, around the target
pictures = [held_out.rgb_before[row][part] / 255 for row, part in zip(SHOWN, parts)]
arrows = [project(np.array([[*held_out.starts[row], 0.02], [*held_out.pokes[row, :2], 0.02]]), camera)
          - [part[1].start, part[0].start] for row, part in zip(SHOWN, parts)]
true_flow = [evaluation.true_motion(held_out, truth, row)[1].reshape(camera.height, camera.width, 2)[part]
             for row, part in zip(SHOWN, parts)]
longest = [np.linalg.norm(flow, axis=2).max() for flow in true_flow]
moved = [np.linalg.norm(flow, axis=2) > 0.1 for flow in true_flow]  # px


def panel_of(panel, picture, title=""):
    panel.set(xticks=[], yticks=[])
    panel.set_title(title, fontsize=10)
    return panel.imshow(picture, interpolation="nearest")


def poke_on(panel, i):
    panel.annotate("", arrows[i][1], arrows[i][0], arrowprops={"arrowstyle": "-|>", "color": "black", "linewidth": 2})


columns = [0, 2, 4, 6, 8, 12, len(snapshots) - 1]
figure, axes = plt.subplots(len(SHOWN), len(columns) + 1, figsize=(11, 2.9), layout="constrained")
for i, line in enumerate(axes):
    for panel, column in zip(line, columns):
        at, masks, _ = snapshots[column]
        panel_of(panel, blend(pictures[i], masks[i][parts[i]][..., 1:]), f"step {at}" if i == 0 else "")
    panel_of(line[-1], blend(pictures[i], moved[i][..., None].astype(float)), "truth" if i == 0 else "")
    poke_on(line[0], i)
figure.suptitle("Masks of two held-out pokes: first all a little, then hardly anything, then (part of) what moves",
                fontsize=11)
lesson.keep(options, figure, "masks")

figure = plt.figure(figsize=(7.2, 3.7), layout="constrained")
grid = figure.add_gridspec(2, 4, width_ratios=(1, 1, 1, 1.5))
shown = []
for i in range(len(SHOWN)):
    poke_on(panel_of(figure.add_subplot(grid[i, 0]), pictures[i], "the poke" if i == 0 else "").axes, i)
    shown.append((panel_of(figure.add_subplot(grid[i, 1]), pictures[i], "masks" if i == 0 else ""),
                  panel_of(figure.add_subplot(grid[i, 2]), pictures[i], "optical flow" if i == 0 else "")))
upper, lower = figure.add_subplot(grid[0, 3]), figure.add_subplot(grid[1, 3])
upper.plot(epoch_end, [1e4 * entry["chamfer"] for entry in run.log], ".-", color=PALETTE[5])
upper.set_title("Chamfer, training [cm$^2$]", fontsize=10)
upper.set_ylim(0, None)
lower.plot(step, iou, ".-", color=PALETTE[2])
lower.set_title("IoU of the masks, held-out", fontsize=10)
lower.set(xlabel="step", ylim=(0, 1))
marks = [panel.axvline(0, color=PALETTE[6], linewidth=2) for panel in (upper, lower)]
heading = figure.suptitle("step 0", fontsize=11)
options.out.mkdir(parents=True, exist_ok=True)
animation = options.out / "08_emergence.gif"
writer = PillowWriter(fps=4)
with writer.saving(figure, animation, dpi=70):
    for at, masks, flow in snapshots + snapshots[-1:] * 4:  # the last one stays for a while
        for i, (left, right) in enumerate(shown):
            left.set_data(blend(pictures[i], masks[i][parts[i]][..., 1:]))
            right.set_data(flow_to_rgb(flow[i][parts[i]], longest[i]))
        for mark in marks:
            mark.set_xdata([at, at])
        heading.set_text(f"step {at}")
        writer.grab_frame()
plt.close(figure)
print(f"   animation: {animation.name}, {animation.stat().st_size / 1000:.0f} kB")

# %% [markdown]
# What happened? At first the cover falls everywhere. A mask on the table drags table along, which costs Chamfer
# distance, and a smaller mask is the nearest way out. It falls least where something really moves, for there motion
# pays. Once the motion points the right way, the masks come back, on these points only.
#
# In the second row the mask keeps to the part of the object near the target. 400 pokes and some hundred steps are
# little; the shipped checkpoint saw 24,000 pokes, and its ratio on the same pokes is printed above.
#
# **Now change this:** give `Recipe` the option `image_noise=0.0`. What becomes of the cover and the ratio? (The Check
# cell will object.) Then put the noise back and switch the 2D terms off:
# `weights={**training.WEIGHTS, "photometric": 0.0, "flow_smoothness": 0.0}`. How much had they brought in so few
# steps? (docs/research-log.md says what they bring in many: turns, and masks that do not spill onto the table.)

# %% Check
print("5. Check")
made_up = {name: np.array([number, number + 2.0]) for number, name in enumerate(training.WEIGHTS, 1)}  # two pokes each
expected = sum(weight * (number + 1) for number, weight in enumerate(training.WEIGHTS.values(), 1))
lesson.check("Eq. (6) by hand, ratio", float(losses.full_loss(made_up, training.WEIGHTS)) / expected, 1.0, within=1e-9)
for name in made_up:  # each term on its own, or a small one could be lost in the sum
    alone = {other: float(other == name) for other in made_up}
    lesson.check(f"Eq. (6) with {name} alone", float(losses.full_loss(made_up, alone)), made_up[name].mean(),
                 within=1e-9)
one = training.start_run(recipe, train)
gradients = np.random.default_rng(0).standard_normal((3, one.vector.size)).astype(np.float32)
mean, square, by_hand = 0.0, 0.0, one.vector.astype(float)
for number, gradient in enumerate(gradients.astype(float), 1):
    before = one.params
    training.optimiser_step(one, gradients[number - 1], 1e-3)
    if number == 1:
        moves = {name: value - before[name] for name, value in one.params.items()}
        lesson.check("Adam's first step: mean |move| of a bias / rate", float(np.abs(moves["motion_1_b"]).mean() / 1e-3),
                     1, within=1e-3)
        u, _, vt = np.linalg.svd(training.unflatten(gradients[0], one.layout)["motion_1_w"], full_matrices=False)
        expected = -1e-3 * np.sqrt(max(moves["motion_1_w"].shape)) * u @ vt
        lesson.check("a matrix's first step and U V^T, cosine",
                     float(np.sum(moves["motion_1_w"] * expected) / np.linalg.norm(moves["motion_1_w"])
                           / np.linalg.norm(expected)), above=0.95)
    mean, square = 0.9 * mean + 0.1 * gradient, 0.999 * square + 0.001 * gradient ** 2
    by_hand -= 1e-3 * (mean / (1 - 0.9 ** number)) / (np.sqrt(square / (1 - 0.999 ** number)) + 1e-8)
biases = np.concatenate([value.ravel() for name, value in training.unflatten(one.vector - by_hand, one.layout).items()
                         if value.ndim == 1])
lesson.check("three steps of Adam by hand, largest difference of a bias / rate", float(np.abs(biases).max() / 1e-3),
             below=1e-2)
middle = recipe.steps // 2
lesson.check("learning rate half-way / peak", training.learning_rate(recipe, middle) / recipe.learning_rate, 0.5,
             within=1e-6)
lesson.check("without noise: least loss of any shift / that of none", float(change[0][SHIFTS != 0].min()), above=0.01)
lesson.check("with noise: loss of the best shift forwards, less that of none", float(change[1][SHIFTS > 0].min()),
             below=-0.005)
lesson.check("with noise: the same backwards", float(change[1][SHIFTS < 0].min()), above=0.005)
seen = np.concatenate([training.rows_of_step(recipe, len(train), number)[0]
                       for number in range(len(train) // recipe.batch)])
lesson.check("pokes seen in the first epoch", len(np.unique(seen)), len(train), within=0)
fresh_terms = training.loss_terms(fresh.params, recipe.sizes, training.make_batch(train, np.arange(4)), camera)
lesson.check("fresh: flow smoothness of no motion [px]", float(np.max(fresh_terms["flow_smoothness"])), 0, within=0.1)
lesson.check("Chamfer distance, last epoch / no motion", run.log[-1]["chamfer"] / level["chamfer"],
             below=0.8 if options.quick else 0.5)
lesson.check("held-out: ratio before training", float(ratio[0]), 1, within=1e-3)
lesson.check("held-out: ratio at the end", float(ratio[-1]), below=0.85 if options.quick else 0.45)
lesson.check("animation [kB]", animation.stat().st_size / 1000, above=10, below=400)
lesson.check("cover of moving / of still points, fresh", float(on[0] / off[0]), 1, within=0.25)
lesson.check("cover of moving / of still points at the end", float(on[-1] / off[-1]), above=3 if options.quick else 10)
if not options.quick:
    lesson.check("held-out: IoU of the masks", float(iou[-1]), above=0.4)
print(f"{options.name}: all checks passed")
