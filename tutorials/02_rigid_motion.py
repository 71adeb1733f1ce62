"""Rigid motion: six numbers per object, masks that say who moves, and why an angle of zero needs care.

Question: how can a network say "this object shifts and turns, that one stays" with a few numbers that gradient descent
can improve, starting from "nothing moves"?

Equations:
- Sec. III-A, a rigid motion [R, T] in SE(3): `geometry.so3_exp`; tests/test_eq1_transform.py
- Eq. (1), transform layer: `geometry.transform_layer`; tests/test_eq1_transform.py
- Sec. IV-C, true scene flow: `sim.truth.true_scene_flow`, `lab.evaluation.true_motion`; tests/test_sim_truth.py,
  tests/test_evaluation.py

Time: 4 s. Pictures: 02_masks.png, 02_blend.png, 02_exp.png, 02_zero.png.

Last lines to expect:
   half and half at 120 degrees, shrinks to cos 60: expected 0.5 within 1e-09, got 0.5
02_rigid_motion: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. `geometry.so3_exp` and `geometry.transform_layer` are the
# two functions of this lesson; with your editor's "go to definition" each is one click away.

# %%
import lesson  # first of all: it sets the number of BLAS threads

import autograd.numpy as anp
import numpy as np
from autograd import grad
from scipy.linalg import expm, expm_frechet
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from hind4sight_min import geometry
from hind4sight_min.lab.evaluation import true_motion
from hind4sight_min.lab.figures import BLUE, GREEN, ORANGE, RED, SKY
from hind4sight_min.lab.se3nets import association_loss

options = lesson.begin("02_rigid_motion")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

# %% [markdown]
# ## A turn is three numbers
#
# A rotation matrix R has nine entries, and most choices of nine numbers are no rotation. A *rotation vector* w has
# three and every choice is one: its direction is the axis, its length t = |w| the angle in radians. Turning by a tiny w
# moves a point p by the cross product w x p. Write [w]x for the 3 x 3 matrix with [w]x p = w x p, and I for the
# identity. A turn by w is n turns by w / n, one after the other, for ever larger n:
#
#     R = lim (I + [w]x / n)^n = exp([w]x) = I + sin(t)/t [w]x + (1 - cos t)/t^2 [w]x^2
#
# The limit is the matrix exponential; its closed form on the right is known as Rodrigues' formula, and `so3_exp`
# computes it. Watch the limit at work on three quarters of a turn about z:

# %%
def cross_matrix(w):
    """[w]x of one rotation vector (3,) -> (3, 3)."""
    return np.cross(w, np.eye(3)).T


quarter = geometry.so3_exp(np.array([0, 0, np.pi / 2]))
print("1. A quarter turn about z takes (1, 0, 0) to", np.round(quarter @ [1, 0, 0], 3))
w = np.array([0, 0, 1.5 * np.pi])
figure, axes = plt.subplots(1, 2, figsize=(11, 3.9), layout="constrained", width_ratios=(1, 1.2))
steps, lengths = (8, 24, 72), []
for n, colour in zip(steps, (RED, ORANGE, GREEN)):
    path = [np.array([1.0, 0, 0])]
    for _ in range(n):
        path.append(path[-1] + cross_matrix(w / n) @ path[-1])
    lengths.append(np.linalg.norm(path[-1]))
    axes[0].plot(*np.array(path)[:, :2].T, ".-", color=colour, markersize=4, label=f"{n} steps")
    print(f"   three quarters of a turn in {n} small steps: the point ends {lengths[-1]:.3f} from the axis")
angles = np.linspace(0, 1.5 * np.pi, 100)
circle = geometry.so3_exp(angles[:, None] * [0, 0, 1])[:, :2, 0]  # where (1, 0, 0) goes: the first column
axes[0].plot(*circle.T, color="black", linewidth=2, label="so3_exp")
axes[0].set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
axes[0].set_title("the path of the point (1, 0, 0)", fontsize=11)
axes[0].legend(fontsize=9)
counts = np.unique(np.logspace(0.5, 4, 15).astype(int))
powers = [np.linalg.matrix_power(np.eye(3) + cross_matrix(w / n), n) for n in counts]
errors = [np.abs(power - geometry.so3_exp(w)).max() for power in powers]
axes[1].loglog(counts, errors, "o-", color=BLUE)
axes[1].set(xlabel="number n of small steps", ylabel="largest error of a matrix entry")
axes[1].set_title("$(I + [w]_\\times / n)^n$ against so3_exp", fontsize=11)
axes[1].grid(alpha=0.3)
figure.suptitle("Small steps along the tangent spiral outwards; the more there are, the closer they come to the turn",
                fontsize=11)
lesson.keep(options, figure, "exp")

# %% [markdown]
# A rigid motion also shifts: p goes to R p + T, three more numbers. The package calls the six together a *twist*. One
# choice is left: a turn about which point? If it were the middle of the table, an error of 10 degrees would throw an
# object at the wall, 25 cm away, off by 4 cm. So the network says how the object turns about its own centre c, and
# by how much d that centre shifts. R (p - c) + c + d = R p + T gives T = c - R c + d.
#
# ## Masks: who moves
#
# Eq. (1) moves every point by K rigid motions, weighted by its K *masks* m^k, which are between 0 and 1 and sum to 1:
#
#     P'_{t+1} = sum_k m^k (R_k P_t + T_k)
#
# Mask 0 is the background, whose motion is the identity. First by hand, a point with a background mask of 0.25 and a
# mask of 0.75 for a motion that turns by 90 degrees about z and shifts by 1 m along x:

# %%
point = np.array([[[1.0, 0, 0]]])                                      # (B=1, N=1, 3)
masks = np.array([[[0.25, 0.75]]])                                     # (B, N, K=2)
rotations = geometry.so3_exp(np.array([[[0, 0, 0], [0, 0, np.pi / 2]]]))  # (B, K, 3, 3)
translations = np.array([[[0.0, 0, 0], [1, 0, 0]]])                    # (B, K, 3)
moved = geometry.transform_layer(point, masks, rotations, translations)[0, 0]
print("2. By hand: 0.25 * (1, 0, 0) + 0.75 * ((0, 1, 0) + (1, 0, 0)) = (1, 0.75, 0)")
print("   transform_layer:", np.round(moved, 6))

# %% [markdown]
# Now poke 92 of the test set, in which the finger pushes one object against another and both turn. The simulator knows
# which object every pixel shows and where each object was and is. With these as masks and motions, Eq. (1) must give
# the true scene flow of every point, and it does: two motions describe all that moves here. This is what the network
# has to find; it is never shown.

# %%
pokes, truth = lesson.pokes()
ROW = 92
camera, image = pokes.camera, pokes.rgb_before[ROW] / 255
cloud = geometry.unproject(pokes.depth_before[ROW], camera).reshape(1, -1, 3).astype(float)  # P_t
true_flow, _, moving = true_motion(pokes, truth, ROW)  # (N, 3) m, and which points move
labels = truth.labels[ROW].ravel()                                # (N,): 0 is the background, i + 1 is object i
movers = np.unique(labels[moving])
true_masks = (labels[:, None] == np.concatenate([[0], movers])).astype(float)[None]  # (1, N, K)
true_masks[..., 0] = 1 - true_masks[..., 1:].sum(axis=-1)                            # what does not move is background
before, after = (poses[ROW, movers - 1].astype(float) for poses in (truth.poses_before, truth.poses_after))
turn_before, turn_after = (Rotation.from_quat(poses[:, 3:]) for poses in (before, after))
turns = (turn_after * turn_before.inv()).as_matrix()                    # R = R_after R_before^T
shifts = after[:, :3] - np.einsum("kij,kj->ki", turns, before[:, :3])  # T = c_after - R c_before
true_rotations = np.concatenate([np.eye(3)[None], turns])[None]         # (1, K, 3, 3), the background's first
true_translations = np.concatenate([np.zeros((1, 3)), shifts])[None]    # (1, K, 3)
predicted = geometry.transform_layer(cloud, true_masks, true_rotations, true_translations)
flow_error = np.linalg.norm(predicted[0] - cloud[0] - true_flow, axis=1).max()
true_angles = np.degrees(np.arctan2(turns[:, 1, 0], turns[:, 0, 0]))  # the objects stay upright: turns about z
print(f"3. Poke {ROW}: {len(movers)} objects move and turn by {', '.join(f'{a:.0f}' for a in true_angles)} degrees; "
      f"largest difference of Eq. (1) to the true scene flow {1000 * flow_error:.4f} mm")

figure, axes = plt.subplots(1, 3, figsize=(11, 3.3), layout="constrained", width_ratios=(1, 1, 1.1))
axes[0].imshow(image)
axes[0].set_title("the picture before the poke", fontsize=11)
colours = [RED, BLUE]
tinted = 0.4 + 0.6 * image.mean(axis=-1, keepdims=True).repeat(3, axis=-1)
for k, colour in enumerate(colours, 1):
    tinted[labels.reshape(tinted.shape[:2]) == movers[k - 1]] = colour
axes[1].imshow(tinted)
axes[1].set_title("the masks: one colour each, grey is $m^0$", fontsize=11)
for panel in axes[:2]:
    panel.set(xticks=[], yticks=[])
axes[2].scatter(*cloud[0, :, :2].T, s=4, color="0.8", linewidths=0, antialiased=False)
for k, colour in enumerate(colours, 1):
    mine = labels == movers[k - 1]
    axes[2].quiver(*cloud[0, mine, :2].T, *(predicted - cloud)[0, mine, :2].T, color=colour, angles="xy",
                   scale_units="xy", scale=1, width=0.006)
x, y = cloud[0, moving, :2].mean(axis=0) + true_flow[moving, :2].mean(axis=0) / 2
view = {"aspect": "equal", "xlim": (x - 0.13, x + 0.13), "ylim": (y - 0.11, y + 0.11), "xlabel": "x [m]",
        "ylabel": "y [m]"}
axes[2].set(**view)
axes[2].set_title("the scene flow from above (grey: what stays)", fontsize=11)
figure.suptitle("Two masks and two rigid motions describe all that this poke moved", fontsize=11)
lesson.keep(options, figure, "masks")

# %% [markdown]
# ## A soft mask is not a smaller motion
#
# A network's masks are soft: a point may belong to a mask by 0.5 and to the background by 0.5. If the mask only shifts,
# the point moves half as far.
#
# **Predict before you run:** and if the mask *turns* by 180 degrees about z? Where does a point go that lies 3 cm from
# the axis and belongs to that mask by 0.5?

# %%
side = np.linspace(-0.03, 0.03, 7)
square = np.stack([*np.meshgrid(side, side), np.zeros((7, 7))], axis=-1).reshape(-1, 3)
square = square[(square[:, 0] < 0.005) | (square[:, 1] < 0.005)][None]  # without a corner, so that a turn is seen
half = np.full((1, square.shape[1], 2), 0.5)
blend_angles, shrink = np.array([60, 120, 180]), []
figure, axes = plt.subplots(1, 3, figsize=(11, 3.9), layout="constrained", sharex=True, sharey=True)
for panel, degrees in zip(axes, blend_angles):
    twist = np.array([[[0, 0, 0], [0, 0, np.radians(degrees)]]])
    turned = np.matmul(square, geometry.so3_exp(twist)[0, 1].T)
    blended = geometry.transform_layer(square, half, geometry.so3_exp(twist), np.zeros((1, 2, 3)))
    shrink.append(np.linalg.norm(blended) / np.linalg.norm(square))
    for corners, colour, marker, size, label in ((square, "0.7", "s", 5, "before"),
                                                 (turned, SKY, "x", 5, "mask 1: turned"),
                                                 (blended, RED, "o", 4, "mask 0.5: blended")):
        panel.plot(*100 * corners[0, :, :2].T, marker, color=colour, markersize=size, label=label)
    panel.set(aspect="equal", xlabel="x [cm]")
    panel.set_title(f"turn by {degrees} degrees: shrinks to {shrink[-1]:.2f}", fontsize=11)
axes[0].set_ylabel("y [cm]")
figure.legend(*axes[0].get_legend_handles_labels(), fontsize=9, loc="outside lower center", ncols=3)
figure.suptitle("Half stay and half turn is not half a turn: the blend of Eq. (1) shrinks what it moves", fontsize=11)
lesson.keep(options, figure, "blend")
print("4. Blended half and half with the identity, a turn by", *blend_angles, "degrees shrinks things to",
      *np.round(shrink, 3))

# %% [markdown]
# So an object that turns cannot be described by a mask of 0.5, whatever its motion: the prediction is smaller than the
# object. No term of the loss asks for crisp masks, but a true prediction needs them.
#
# ## Why an angle of zero needs care
#
# Sec. III-G of the paper initialises the motions to the identity: w = 0. The very first gradient is taken there, where
# Rodrigues' formula divides 0 by 0. Here is the formula as one would type it, and as one would then mend it, with a
# `where` that replaces the quotients at zero. Both are differentiated by autograd and both return NaN: the derivative
# of the *unused* branch of `where` is multiplied by 0, and 0 times NaN is NaN. After one step every parameter that this
# gradient reaches is NaN. `so3_exp` has no quotient of its own: sin(t)/t is a *sinc*, which autograd knows how to
# differentiate at zero, and (1 - cos t)/t^2 is half the square of another. Under the root of t = |w| stands a tiny
# 1e-12, which keeps its derivative finite.

# %%
def typed_in(w, mend=False):
    """Rodrigues' formula as printed; with mend=True the quotients are replaced at t = 0."""
    t = anp.sqrt(anp.sum(w * w))
    a, b = anp.sin(t) / t, (1 - anp.cos(t)) / (t * t)
    if mend:
        a, b = anp.where(t == 0, 1.0, a), anp.where(t == 0, 0.5, b)
    zero = 0 * w[0]
    matrix = anp.array([[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])
    return np.eye(3, dtype=np.float32) + a * matrix + b * anp.dot(matrix, matrix)


rng = np.random.default_rng(0)
pull = rng.standard_normal((3, 3)).astype(np.float32)  # the loss is sum(pull * R): its gradient to R is `pull`
axis = np.array([2.0, -3.0, 6.0]) / 7
versions = {"as typed in": typed_in, "mended with where": lambda w: typed_in(w, mend=True), "so3_exp": geometry.so3_exp}
at_zero = {}
print("5. The gradient of sum(pull * R) at an angle of exactly zero, in float32")
for name, version in versions.items():
    with np.errstate(all="ignore"):
        at_zero[name] = grad(lambda w: anp.sum(pull * version(w)))(np.zeros(3, np.float32))
    print(f"   {name}: {at_zero[name]}")
expected_at_zero = np.array([np.sum(pull * cross_matrix(e)) for e in np.eye(3)])  # dR = [dw]x at w = 0

small = np.logspace(-7, 0.4, 60)
gradient_errors = {"as typed in": [], "so3_exp": []}
for t in small:
    w32 = (t * axis).astype(np.float32)
    matrix = cross_matrix(w32.astype(float))
    exact = np.array([np.sum(pull * expm_frechet(matrix, cross_matrix(e), compute_expm=False)) for e in np.eye(3)])
    for name, values in gradient_errors.items():
        found = grad(lambda w: anp.sum(pull * versions[name](w)))(w32)
        values.append(np.linalg.norm(found - exact) / np.linalg.norm(exact))
worst = {name: max(values) for name, values in gradient_errors.items()}
print(f"   away from zero, largest relative error: {worst['as typed in']:.0e} as typed in, {worst['so3_exp']:.0e} by "
      "so3_exp")

# %% [markdown]
# Close to zero the typed-in formula returns numbers, but 1 - cos t subtracts two nearly equal ones and loses digits; in
# float32 nothing is left of it below t = 0.0002. `so3_exp` takes 2 sin^2(t / 2) for it, which subtracts nothing.
#
# Does it work? Let an optimiser find the motions of the two objects from where each of their points truly went, which
# is what SE3-Nets are trained with (Sec. IV-D; `lab.se3nets.association_loss`). The masks are given. It starts at a
# twist of exactly zero, as the network does, and has nothing but the gradient through `so3_exp` and `transform_layer`.

# %%
targets = cloud + true_flow
centres = np.array([cloud[0, labels == label].mean(axis=0) for label in movers])  # (K-1, 3) m: turn about these
everywhere = np.ones(cloud.shape[:2], bool)


def moved_by(twists):
    """Twists as one vector: per object a turn (3, rad) and a shift (3, cm) -> predicted points (1, N, 3) m."""
    twists = anp.reshape(twists, (len(movers), 6))
    rotations = geometry.so3_exp(twists[:, :3])
    turned = anp.matmul(rotations, centres[:, :, None])[:, :, 0]
    translations = centres - turned + twists[:, 3:] / 100  # T = c - R c + d
    return geometry.transform_layer(cloud, true_masks, anp.concatenate([np.eye(3)[None], rotations])[None],
                                    anp.concatenate([np.zeros((1, 3)), translations])[None])


def squared_error(twists):
    """Mean over the points that move, in cm^2."""
    return 1e4 * anp.sum(association_loss(moved_by(twists), targets, everywhere)) / moving.sum()


path = [np.zeros(6 * len(movers))]
found = minimize(squared_error, path[0], jac=grad(squared_error), method="BFGS",
                 callback=lambda twists: path.append(twists.copy()))
found_angles = np.degrees(found.x.reshape(-1, 6)[:, 2])
print(f"6. Squared error {squared_error(path[0]):.1f} cm^2 at zero, {found.fun:.6f} after {found.nit} steps")
print("   turns found:", *np.round(found_angles, 2), "degrees, true:", *np.round(true_angles, 2))

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.9), layout="constrained")
for (name, values), colour in zip(gradient_errors.items(), (RED, BLUE)):
    left.loglog(small, values, color=colour, linewidth=2, label=name)
left.set(xlabel="angle t [rad]", ylabel="relative error of the gradient")
left.set_title("float32: as typed in, digits get lost; at zero it is NaN", fontsize=11)
left.legend(fontsize=9)
left.grid(alpha=0.3)
right.scatter(*cloud[0, :, :2].T, s=4, color="0.8", linewidths=0, antialiased=False)
right.plot(*targets[0, moving, :2].T, "s", fillstyle="none", color="black", markersize=6, label="true targets")
for k, colour in enumerate(colours, 1):
    mine = labels == movers[k - 1]
    history = np.array([moved_by(x)[0, mine, :2] for x in path])  # (steps, points, 2)
    right.plot(history[..., 0], history[..., 1], color=colour, linewidth=0.7, alpha=0.5)
    right.plot(*history[-1].T, ".", color=colour, markersize=6, label=f"object {k}, and its way there")
right.set(**view)
right.set_title("the optimiser's way, point by point (grey: what stays)", fontsize=11)
right.legend(fontsize=9, loc="upper left")
figure.suptitle("so3_exp keeps its digits down to zero, so an optimiser can start there and find both motions",
                fontsize=11)
lesson.keep(options, figure, "zero")

# %% [markdown]
# **Now change this:** `rotations = geometry.so3_exp(twists[:, :3])` to `rotations = anp.stack([typed_in(w, mend=True)
# for w in twists[:, :3]])`. The optimiser never leaves zero, and the Check "largest error of the turns found from zero"
# objects. Then let `path` begin with `np.full(6 * len(movers), 0.001)` instead of zeros: it arrives as before. Such an
# error stays hidden until somebody starts where Sec. III-G says.

# %% Check
print("7. Check")
lesson.check("quarter turn about z, entry R[1, 0]", float(quarter[1, 0]), 1.0, within=1e-9)
w = np.array([0.3, -0.5, 0.8])
lesson.check("largest difference of so3_exp to the matrix exponential",
             float(np.abs(geometry.so3_exp(w) - expm(cross_matrix(w))).max()), below=1e-9)
lesson.check("largest error of so3_exp's gradient at zero", float(np.abs(at_zero["so3_exp"] - expected_at_zero).max()),
             below=1e-5)
lesson.check("largest relative error of so3_exp's gradient elsewhere", worst["so3_exp"], below=1e-5)
lesson.check("the same of the formula as typed in", worst["as typed in"], above=1e-5)
for axis, wanted in ((0, 1.0), (1, 0.75)):
    lesson.check(f"a point in two masks, {'xyz'[axis]} [m]", float(moved[axis]), wanted, within=1e-9)
on_masks = grad(lambda masks: anp.sum(geometry.transform_layer(point, masks, rotations, translations)))(masks)[0, 0]
lesson.check("gradient of x + y + z to mask 1: 1 + 1 + 0", float(on_masks[1]), 2.0, within=1e-9)
x0, step = np.linspace(-0.4, 0.5, 6 * len(movers)), 1e-5
by_hand = [(squared_error(x0 + step * e) - squared_error(x0 - step * e)) / (2 * step) for e in np.eye(len(x0))]
lesson.check("gradient to the twists against central differences, relative error",
             float(np.linalg.norm(grad(squared_error)(x0) - by_hand) / np.linalg.norm(by_hand)), below=1e-5)
lesson.check("largest difference of Eq. (1) to the true scene flow [mm]", float(1000 * flow_error), below=0.2)
lesson.check("largest error of the turns found from zero [degrees]", float(np.abs(found_angles - true_angles).max()),
             below=0.1)
lesson.check("half and half at 120 degrees, shrinks to cos 60", float(shrink[1]), 0.5, within=1e-9)
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. Onto the axis. In the plane of the turn, the mean of the identity and a turn by t is a turn by t / 2 times cos(t /
#    2), and cos(90 degrees) is 0.
