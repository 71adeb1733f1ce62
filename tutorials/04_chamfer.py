"""The Chamfer distance: pulling one cloud onto another without knowing which point is which.

Question: two point clouds show the same scene before and after a poke, and nobody says which point went where.
What number tells us how well a predicted motion explains the second cloud, and does its gradient lead there?

Equations:
- Eq. (2), distance transforms and Chamfer distance: `losses.distance_maps`, `losses.chamfer_loss`,
  `ops.nearest_squared_distances`; tests/test_eq2_chamfer.py, tests/test_ops.py
- Not in the paper, which points count: `losses.seen_in_both`; tests/test_eq2_chamfer.py
- Sec. IV-B, depth noise: `lab.noise.add_depth_noise`; tests/test_noise.py

Time: 3 s. Pictures: 04_maps.png, 04_gradient.png, 04_basin.png.

Last lines to expect:
   angle of the summed pull to the true motion [degrees]: expected below 15, got 1.542
04_chamfer: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. `losses.distance_maps` is Eq. (2) as the package has it;
# with your editor's "go to definition" it is one click away.

# %%
import lesson  # first of all: it sets the number of BLAS threads

from dataclasses import replace

import autograd.numpy as anp
import numpy as np
from autograd import grad

from hind4sight_min import losses, ops
from hind4sight_min.lab.evaluation import true_motion
from hind4sight_min.lab.figures import BLUE, DISTANCES, GREEN, RED
from hind4sight_min.lab.noise import add_depth_noise
from hind4sight_min.training import scenes_of

options = lesson.begin("04_chamfer")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

# %% [markdown]
# ## Nearest neighbours by hand
#
# Write P' for the *predicted* cloud P'_{t+1} (the points of the first picture, moved by the model) and P for the
# *observed* one, P_{t+1} (the points of the second picture). For every point of P' we look up the nearest point of P,
# and the other way round:
#
#     D_{P'->P}(i) = min_j |P'_i - P_j|^2        D_{P->P'}(j) = min_i |P'_i - P_j|^2
#
# One number per point, in square metres. Laid out on the pixels the points came from, each is a *distance map*. The
# sum of both maps is the Chamfer distance, Eq. (2). Three points against two, small enough to check by eye:

# %%
predicted = np.array([[[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]]])  # (B=1, N=3, 3)
observed = np.array([[[0.1, 0, 0], [1.0, 0.2, 0]]])              # (B=1, M=2, 3)
to_observed = ops.nearest_squared_distances(predicted, observed, np.ones((1, 2), bool))
to_predicted = ops.nearest_squared_distances(observed, predicted, np.ones((1, 3), bool))
print("1. Three points against two")
print("   predicted -> observed:", to_observed[0])   # 0.1^2, 0.2^2, 4^2 + 0.2^2
print("   observed -> predicted:", to_predicted[0])  # 0.1^2, 0.2^2: nobody asks for the point at 5

# %% [markdown]
# Why both directions? The third predicted point is 4 m away from everything. Only the first map says so: every
# *observed* point has a good partner without it. The other way round, an observed point that no predicted point
# explains shows only in the second map. One direction alone can be cheated.
#
# ## Two real clouds
#
# Poke 1 of the test set pushes one object 6 cm over the table. Points without depth, and bits of table that the object
# covers or uncovers, have no counterpart in the other cloud; `seen_in_both` leaves them out. The true motion comes from
# the simulator: we use it here to see what the loss *should* like best. Training never reads it.

# %%
interactions, truth = lesson.pokes()
ROW = 1
poke, shape = interactions[[ROW]], interactions.depth_before.shape[1:]


def clouds(poke):
    """A record of one poke -> P_t and P_{t+1}, (1, N, 3) m, and which of their points have a counterpart, (1, N)."""
    before, after = scenes_of(poke)
    return before.points, after.points, *losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)


before, after, counted, next_counted = clouds(poke)
true_flow, _, moving = true_motion(interactions, truth, ROW)  # (N, 3) m, and which points move
still_maps = losses.distance_maps(before, after, counted, next_counted)
true_maps = losses.distance_maps(before + true_flow, after, counted, next_counted)
still, best = (float(losses.chamfer_loss(*maps)[0]) for maps in (still_maps, true_maps))
print(f"2. Poke {ROW}: Chamfer distance without motion {1e4 * still:.1f} cm^2, along the true flow "
      f"{1e4 * best:.1f} cm^2")

figure, axes = plt.subplots(1, 4, figsize=(11, 2.9), layout="constrained")
titles = ("no motion: $D_{P' \\to P}$", "no motion: $D_{P \\to P'}$", "true flow: $D_{P' \\to P}$",
          "true flow: $D_{P \\to P'}$")
for panel, title, map_ in zip(axes, titles, (*still_maps, *true_maps)):
    shown = panel.imshow(100 * np.sqrt(map_[0].reshape(shape)), cmap=DISTANCES, vmin=0, vmax=4)
    panel.set_title(title, fontsize=11)
    panel.set_xticks([])
    panel.set_yticks([])
figure.colorbar(shown, ax=axes, label="$\\sqrt{D}$ [cm]", shrink=0.8)
figure.suptitle("The distance maps light up where the object was and where it is, and go dark along the true flow",
                fontsize=11)
lesson.keep(options, figure, "maps")

# %% [markdown]
# ## Where does the gradient point?
#
# **Predict before you run:** start from no motion, P'_{t+1} = P_t. Minus the gradient of the Chamfer distance,
# taken at each predicted point, is the direction in which the loss wants that point to go. Which points get an arrow
# at all? Do the arrows on the object all point along the true motion?

# %%
def chamfer_of(cloud):
    return anp.sum(losses.chamfer_loss(*losses.distance_maps(cloud, after, counted, next_counted)))


pull = -grad(chamfer_of)(before)[0]  # (N, 3)
on_object = moving & counted[0]
length = np.linalg.norm(pull, axis=1)


def angle(a, b):
    """Angle between vectors (..., 3) as seen from above, in degrees."""
    a, b = a[..., :2], b[..., :2]
    cosine = np.sum(a * b, axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


single = angle(pull[on_object], true_flow[on_object])
summed = angle(pull[on_object].sum(axis=0), true_flow[on_object].sum(axis=0))
share = float((single < 60).mean())
print(f"3. Of the arrows on the object, {share:.0%} are within 60 degrees of its true motion; their sum is off by "
      f"{summed:.0f} degrees. Of the table's {np.sum(counted[0] & ~moving)} points {np.sum(length[~moving] > 1e-3)} "
      "get an arrow.")

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained", sharex=True, sharey=True)
middle = before[0, moving, :2].mean(axis=0) + true_flow[moving, :2].mean(axis=0) / 2
ends = np.concatenate([before[0, on_object] + each[on_object] for each in (0 * pull, pull / 8, true_flow)])[:, :2]
ends = ends[np.isfinite(ends).all(axis=1)]  # a gradient that is none is for the checks to tell
for panel, arrows, title, colour in ((left, pull / 8, "minus the gradient of Eq. (2), an eighth as long", BLUE),
                                     (right, true_flow, "the true scene flow, true to length", RED)):
    panel.scatter(*before[0, counted[0], :2].T, s=14, color="0.7", label="first cloud $P_t$", linewidths=0)
    panel.scatter(*after[0, next_counted[0] & (after[0, :, 2] > 0.01), :2].T, s=16, marker="x", color=GREEN,
                  label="second cloud $P_{t+1}$, objects and walls only", linewidths=1)
    panel.quiver(*before[0, on_object, :2].T, *arrows[on_object, :2].T, color=colour, angles="xy", scale_units="xy",
                 scale=1, width=0.005, label=title)
    panel.set(aspect="equal", xlim=(ends[:, 0].min() - 0.02, ends[:, 0].max() + 0.02),  # every arrow ends in the frame
              ylim=(ends[:, 1].min() - 0.02, ends[:, 1].max() + 0.02), xlabel="x [m]", ylabel="y [m]")
    panel.set_title(title, fontsize=11)
total = pull[on_object].mean(axis=0)
left.quiver(*middle, *total[:2], color="black", angles="xy", scale_units="xy", scale=1, width=0.012, zorder=5,
            label="the mean of these arrows, not shortened")
handles = {each.get_label(): each for panel in (left, right) for each in panel.collections}
figure.legend(handles.values(), handles.keys(), fontsize=9, ncols=3, loc="outside lower center")
figure.suptitle("Seen from above: single points are pulled to the nearest edge; only the object as a whole is pulled "
                "right", fontsize=11)
lesson.keep(options, figure, "gradient")

# %% [markdown]
# Single points are bad guides, but *summed over the object* the pull is right. This is why the model moves whole masks
# rigidly (Eq. 1) and not points one by one: the mask does the summing.
#
# ## How far does the slope reach, and what does noise do to it?
#
# Move the object by 0 to 2 times its true motion and draw the Chamfer distance. Then add the paper's depth noise: a
# standard deviation of 1 cm at the median depth, drawn anew for each picture. Now every table point finds a *spurious
# match*, whatever the object does: noise lifts the whole curve. What matters is whether its minimum stays where it
# was.

# %%
rng = np.random.default_rng(0)
scales = np.linspace(0, 2, 21)


def curve(poke):
    """Chamfer distance in cm^2 with the object moved by every scale times its true motion."""
    first, second, here, there = clouds(poke)
    maps = [losses.distance_maps(first + np.float32(scale) * true_flow, second, here, there) for scale in scales]
    return np.array([1e4 * losses.chamfer_loss(*each)[0] for each in maps])


def with_noise(poke):
    return replace(poke, depth_before=add_depth_noise(poke.depth_before, rng, 0.01),
                   depth_after=add_depth_noise(poke.depth_after, rng, 0.01))


clean = curve(poke)
noisy = np.mean([curve(with_noise(poke)) for _ in range(5)], axis=0)
print(f"4. Lowest at {scales[clean.argmin()]:.1f} times the true motion without noise, at {scales[noisy.argmin()]:.1f} "
      f"with noise, which lifts the curve from {clean.min():.0f} to {noisy.min():.0f} cm^2")

figure, axes = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained")
for panel, values, title, colour in ((axes[0], clean, "no noise", BLUE),
                                     (axes[1], noisy, "1 cm depth noise, mean of 5 draws", RED)):
    panel.plot(scales, values, "o-", color=colour, markersize=4)
    panel.axvline(1, color="0.5", linestyle=":", label="true motion")
    panel.set(xlabel="object moved by this many times its true motion", ylabel="Chamfer distance [cm$^2$]")
    panel.set_title(title, fontsize=11)
    panel.legend(fontsize=9)
figure.suptitle("One wide valley with its floor at the true motion; noise lifts it and leaves the floor in place",
                fontsize=11)
lesson.keep(options, figure, "basin")

# %% [markdown]
# **Now change this:** `*losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)` to
# `before.valid, after.valid`. The table that the object covers or uncovers then counts, though nothing can be near it
# in the other cloud: the true motion costs ten times as much, the lowest cost lies a little short of it, and the table
# around the object gets arrows. A network learns from that to drag the table along, as our first checkpoint did
# (docs/research-log.md). The Check "Chamfer along the true flow / without motion" objects.

# %% Check
print("5. Check")
lesson.check("three points against two, predicted -> observed", float(to_observed.sum()), 0.01 + 0.04 + 16.04,
             within=1e-9)
squared = np.sum((before[0][:, None] - after[0]) ** 2, axis=2)  # brute force, (N, N)
there = squared[:, next_counted[0]].min(axis=1) * counted[0]
back = squared[counted[0]].min(axis=0) * next_counted[0]
lesson.check("predicted -> observed, largest difference to brute force [m^2]",
             float(np.abs(there - still_maps[0][0]).max()), below=1e-6)
lesson.check("observed -> predicted, the same [m^2]", float(np.abs(back - still_maps[1][0]).max()), below=1e-6)
lesson.check("Eq. (2) without motion / by brute force", still / float(there.sum() + back.sum()), 1.0, within=1e-4)
lesson.check("Chamfer along the true flow / without motion", best / still, above=0, below=0.1)
lesson.check("scale at which the noise-free curve is lowest", float(scales[clean.argmin()]), 1.0, within=0.15)
lesson.check("share of single arrows within 60 degrees of the true motion", share, above=0.3, below=0.9)
lesson.check("angle of the summed pull to the true motion [degrees]", float(summed), below=15)
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. Points that stay have themselves as nearest neighbour and get no arrow: the table is quiet by itself. On the object
#    the arrows do not agree. A single point is pulled to the nearest edge of the other cloud, and the few points
#    nearest to the far side collect the pull of all the observed points there (the long arrows).
