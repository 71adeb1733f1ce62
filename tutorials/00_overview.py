"""Overview: what the lessons are for, why in this order, and what the symbols stand for.

Question: a robot pokes things, looks before and after, and learns how they move. What is computed from what on the way
from two pictures to a gradient, and which lesson takes which part of it apart?

Equations:
- Fig. 3, the whole model: `networks.predict`, `training.loss_terms`; tests/test_networks.py, tests/test_training.py
- Sec. III-C, projection layer, scene flow to optical flow: `geometry.optical_flow`; tests/test_geometry.py

Time: 3 s. Pictures: 00_symbols.png, 00_architecture.png.

Last lines to expect:
   largest value of D_{P'->P} / the same by brute force: expected 1 within 0.001, got 1
00_overview: all checks passed
"""
# %% [markdown]
# Thirteen lessons, this one included, take the model apart until each part is small enough to check by hand. Step
# through one with the cells below, or run the whole file; a lesson takes seconds and ends with *Checks*, which say what
# came out and what should have. Each asks you to *predict* something before you run it; the answers are at the end of
# the file. *Now change this* says what to change and which Check will object.
#
# ## What you should know before
#
# NumPy arrays and their shapes; what a derivative is; what a rotation is. More exactly, these three:
#
# **Predict before you run:** (a) What is the shape of `np.ones((4, 1)) * np.ones(3)`? (b) f(x) = x^2. By about how much
# does f(3) change when 3 becomes 3.001? (c) Where does a quarter turn about the z axis take the point (1, 0, 0)?
#
# If you can answer them, go on; if not, an hour with any introduction to NumPy, to derivatives or to rotation matrices
# will do.

# %%
import lesson  # first of all: it sets the number of BLAS threads

import ast
import re

import numpy as np

from hind4sight_min import geometry, losses, networks, training
from hind4sight_min.disk import checkpoints
from hind4sight_min.lab.figures import RED, blend, draw_arrow, draw_wheel, on_table, show_flow, show_image

options = lesson.begin("00_overview")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

print("1. (a)", (np.ones((4, 1)) * np.ones(3)).shape, f" (b) {3.001 ** 2 - 3 ** 2:.6f}  (c)",
      np.round(geometry.so3_exp(np.array([0, 0, np.pi / 2])) @ [1, 0, 0], 6))

# %% [markdown]
# ## Why in this order
#
# - **01** makes points of a depth picture, **02** moves them: the two things that everything else speaks of.
# - **03** writes a derivative by hand and catches it when it is wrong. It comes before the losses because two of them
#   hold such derivatives, and in 04 and 05 you follow their gradients: you should know what you trust.
# - **04**, **05** and **06** are the losses: geometry, colours, smoothness. None of them needs a network. You move an
#   object yourself and see what each loss says to it.
# - **07** is where the data come from: the robot, its pokes, and why nobody needs to label them.
# - **08** and **09** are the networks, forward (what will this poke do?) and inverse (which poke was it?).
# - **10** trains them, **11** measures them, **12** plans with them.
#
# In a hurry: 01, 02, 04, 08, 10.
#
# ## One poke through the model
#
# The picture of docs/architecture.md: the functions of the package in the boxes, the shapes of what passes along the
# arrows. The black labels say which lessons are about a box; they are read from the lessons' opening docstrings. 01 is
# inside of `scene.scene_of` and 03 inside of the losses; 11 and 12 begin where the picture ends.

# %%
print("2. The lessons about each box")
architecture = lesson.architecture()
FUNCTION = re.compile(r"\b[a-z]\w*\.[a-z_]\w*\b")
named = {}  # function -> numbers of the lessons that are about it
for path in sorted((lesson.ROOT / "tutorials").glob("[0-9][0-9]_*.py")):
    if path.stem != options.name:
        for function in FUNCTION.findall(ast.get_docstring(ast.parse(path.read_text()))):
            named.setdefault(function, set()).add(path.name[:2])
functions = {box: FUNCTION.findall(text) for box, (_, _, text, _) in architecture.BOXES.items()}
where = {box: sorted(set().union(*(named.get(each, ()) for each in found)))
         for box, found in functions.items() if found}
for box, numbers in where.items():
    print(f"   {' '.join(functions[box])}: {', '.join(numbers)}")
lesson.keep(options, architecture.draw(badges={box: " ".join(numbers) for box, numbers in where.items() if numbers}),
            "architecture", dpi=85)

# %% [markdown]
# ## The symbols
#
# The lessons, the code and the paper call things by the same names. Before a poke at time t and after it, at t + 1:
#
#     I_t, I_{t+1}               pictures, in [0, 1]                                        01, 05
#     P_t, P_{t+1}               point clouds, in the arena's frame [m]                     01
#     u_t = (a_x, a_y, a_theta)  a poke: its target on the table [m], its direction [rad]   07
#     m^k, R_k, T_k              K masks, and the rotation and translation of each          02, 08
#     P'_{t+1}                   the predicted cloud, Eq. (1) [m]                           02
#     P'_{t+1} - P_t             scene flow [m]                                             02
#     U, V                       optical flow, to the right and down [px]                   05
#     I'_t                       I_{t+1} warped back along (U, V)                           05
#     D_{P'->P}, D_{P->P'}       distance maps, predicted to observed cloud and back [m^2]  04
#     L_CD, L_rec, L_fs, L_ds    the losses of Eq. (2), (3), (4), (5)                       04, 05, 06, 06
#     L_inv = L_act + L_sim      the inverse loss: heat-maps, state embeddings              09
#     s_t, s_{t+1}, s'_{t+1}     state embeddings, of P_t, P_{t+1}, P'_{t+1}                08, 09
#     B, H, W, N, K              pokes, rows and columns of a picture, points (H W), masks
#
# A prime means "predicted, or made from what is predicted". Points that are *valid* have a depth; *occupied* ones
# belong to something that stands in the arena. Here is what the symbols are for one poke that the shipped model was not
# trained on.

# %%
pokes, _ = lesson.pokes()
ROW = 1
one, camera, shape = pokes[[ROW]], pokes.camera, pokes.depth_before.shape[1:]
run = checkpoints.load_run(lesson.data_small() / "checkpoint.npz")
before, after = training.scenes_of(one)
answer = networks.predict(run.params, run.recipe.sizes, before, one.pokes)
scene_flow = answer.points - before.points
flow = geometry.optical_flow(before.points, answer.points, camera).reshape(1, *shape, 2)
warped, _ = losses.warp_backward(after.images, flow)
shared = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
maps = losses.distance_maps(answer.points, after.points, *shared)
print("3. For one poke (B = 1)")
for symbol, array, unit in (("I_t", before.images, ""), ("P_t", before.points, " m"), ("u_t", one.pokes, " m, m, rad"),
                            ("m^k", answer.masks, ""), ("R_k", answer.rotations, ""),
                            ("T_k", answer.translations, " m"), ("P'_{t+1}", answer.points, " m"),
                            ("U, V", flow, " px"), ("I'_t", warped, ""), ("D_{P'->P}", maps[0], " m^2")):
    print(f"   {symbol:10s} shape {str(array.shape):15s} from {array.min():8.2g} to {array.max():8.2g}{unit}")

longest = max(1.0, np.linalg.norm(flow, axis=-1).max())  # px
root = [100 * np.sqrt(each.reshape(shape)) for each in maps]  # cm
figure, axes = plt.subplots(2, 4, figsize=(11, 5.3), layout="constrained")
show_image(axes[0, 0], before.images[0], "$I_t$ and the poke $u_t$")
draw_arrow(axes[0, 0], *on_table([pokes.starts[ROW], pokes.pokes[ROW, :2]], camera))
show_image(axes[1, 0], after.images[0], "$I_{t+1}$")
masks = answer.masks.reshape(*shape, -1)
show_image(axes[0, 1], blend(before.images[0], masks[..., 1:]), "masks $m^1, m^2$; grey: $m^0$")
show_image(axes[1, 1], np.clip(warped[0], 0, 1), "$I'_t$: $I_{t+1}$ warped back")
show_flow(axes[0, 2], flow[0], longest, "$(U, V)$")
draw_wheel(axes[0, 2], longest, low=False)
moves = np.flatnonzero(np.linalg.norm(scene_flow[0], axis=1) > 0.002)[::4]  # arrows of some of them
axes[1, 2].scatter(*before.points[0, :, :2].T, s=5, c=before.images.reshape(-1, 3), linewidths=0)
axes[1, 2].quiver(*before.points[0, moves, :2].T, *scene_flow[0, moves, :2].T, color=RED, angles="xy",
                  scale_units="xy", scale=1, width=0.008)
axes[1, 2].set(aspect="equal", xlim=(-0.27, 0.27), ylim=(-0.26, 0.16), xticks=[], yticks=[])
axes[1, 2].set_title("$P_t$ and $P'_{t+1}$ from above", fontsize=11)
for panel, map_, name in zip(axes[:, 3], root, ("P' \\to P", "P \\to P'")):
    shown = show_image(panel, map_, f"$D_{{{name}}}$", vmax=max(1.0, *(each.max() for each in root)))
figure.colorbar(shown, ax=axes[:, 3], label="$\\sqrt{D}$ [cm]", shrink=0.7)
figure.suptitle("One poke in symbols: what is seen (left), what is predicted (middle), what is compared (right)",
                fontsize=11)
lesson.keep(options, figure, "symbols")

# %% [markdown]
# **Predict before you run:** if the prediction were perfect, which two of these pictures would look alike, and what
# would the two on the right show?
#
# **Now change this:** `optical_flow(before.points, answer.points, camera)` to `optical_flow(answer.points,
# before.points, camera)`. (U, V) then points backwards, and in I'_t the object lies on the wrong side of where it was.
# The Check "where the flow says each point will appear" objects; nothing else knows the difference.

# %% Check
print("4. Check")
numbers = sorted(path.name[:2] for path in (lesson.ROOT / "tutorials").glob("[0-9][0-9]_*.py"))
lesson.check("lessons, numbered without a gap", int(numbers == [f"{n:02d}" for n in range(13)]), 1, within=0)
lesson.check("boxes of the architecture that no lesson is about", sum(not numbers for numbers in where.values()), 0,
             within=0)
lesson.check("masks of a point, their sum, largest error", float(np.abs(masks.sum(axis=2) - 1).max()), below=1e-5)
v, u = np.mgrid[:shape[0], :shape[1]]
lesson.check("where the flow says each point will appear, largest error [px]",
             float(np.abs(np.stack([u, v], axis=-1) + flow[0] - geometry.project(answer.points[0], camera).reshape(
                 *shape, 2)).max()), below=0.01)
far = maps[0][0].argmax()
squared = np.sum((after.points[0, shared[1][0]] - answer.points[0, far]) ** 2, axis=1)
lesson.check("largest value of D_{P'->P} / the same by brute force", float(maps[0][0, far] / squared.min()), 1,
             within=1e-3)
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. (a) (4, 3): an axis of length 1 is repeated, a missing one is added in front. (b) By 0.006: the slope of x^2 at 3
#    is 2 * 3, times 0.001. (c) To (0, 1, 0).
# 2. I'_t would look like I_t, wherever both pictures show the same. The distance maps would be dark everywhere: each
#    predicted point would lie on an observed one, and the other way round.
