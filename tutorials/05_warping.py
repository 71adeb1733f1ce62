"""Warping: judging a predicted 3D motion by the colours of two pictures, and why that needs a good start.

Question: a model says where every point goes. Without knowing where it truly went, can the two pictures tell how good
the prediction is, and in which direction it should change?

Equations:
- Sec. III-C, projection layer, scene flow to optical flow: `geometry.optical_flow`; tests/test_geometry.py
- Sec. III-C, backward warping: `losses.warp_backward`, `ops.bilinear_sample`; tests/test_eq3_photometric.py,
  tests/test_ops.py
- Eq. (3), photometric loss: `losses.photometric_loss`, `losses.seen_in_both`; tests/test_eq3_photometric.py

Time: 6 s. Pictures: 05_warp.png, 05_basin.png, 05_stripes.png, 05_gradient.png.

Last lines to expect:
   the same at 5 cm: expected below 0.7, got 0.3125
05_warping: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. `losses.photometric_loss` is Eq. (3) as the package has it;
# with your editor's "go to definition" it is one click away.

# %%
import lesson  # first of all: it sets the number of BLAS threads

import autograd.numpy as anp
import numpy as np
from autograd import grad
from matplotlib.patheffects import withStroke
from scipy.ndimage import map_coordinates

from hind4sight_min import geometry, losses
from hind4sight_min.lab.evaluation import true_motion
from hind4sight_min.lab.figures import BLUE, DISTANCES, ERRORS, RED, colour_wheel, flow_to_rgb
from hind4sight_min.training import scenes_of

options = lesson.begin("05_warping")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

# %% [markdown]
# ## From scene flow to optical flow
#
# The *scene flow* of a point is its motion in space, P'_{t+1} - P_t, in metres. Its *optical flow* (U, V) is the motion
# of its pixel, in pixels: U to the right, V down. The projection layer projects both ends and subtracts (Sec. III-C):
#
#     U = x' - x        V = y' - y        with x = fx X / Z + cx, y = fy Y / Z + cy  (lesson 01)
#
# Three motions of a point, each 1 cm long: along the picture's rows near the camera, the same further away, and along
# the ray that leads to the camera. The last is invisible to the picture; only depth can see it.

# %%
interactions, truth = lesson.pokes()
camera = interactions.camera
eye = camera.arena_from_camera[:3, 3]
near, far = np.array([0.05, -0.2, 0.0]), np.array([0.05, 0.2, 0.0])
depths = [geometry.rigid(point, camera.camera_from_arena)[2] for point in (near, far)]
sideways = [geometry.optical_flow(point, point + [0.01, 0, 0], camera) for point in (near, far)]
to_eye = (eye - near) / np.linalg.norm(eye - near)
along_ray = geometry.optical_flow(near, near + 0.01 * to_eye, camera)
print("1. A motion of 1 cm in pixels")
for name, flow, depth in zip(("near", "far"), sideways, depths):
    print(f"   sideways, {name}: {flow[0]:.3f}; by hand fx * 0.01 / Z = {camera.fx * 0.01 / depth:.3f}")
print(f"   along the ray to the camera: {np.linalg.norm(along_ray):.3f}")

# %% [markdown]
# ## Backward warping by hand
#
# Write I_t for the picture before the poke and I_{t+1} for the one after. If the flow is right, the pixel (x, y) of I_t
# shows the same bit of the world as the place (x + U, y + V) of I_{t+1}. So we read I_{t+1} there, for every pixel of
# I_t: the result, I'_t, should look like I_t. It is called *backward* because the colours come back along the flow.
# Every pixel of I'_t gets one colour; pushing the colours forward instead would leave holes and collisions. The place
# is usually between pixels; then the colour is the mean of the four around it, the nearer the heavier (*bilinear*). A
# row of five grey values:

# %%
row = np.array([0, 0.1, 0.4, 0.2, 0.3], np.float32).reshape(1, 1, 5, 1)  # I_{t+1}: (B=1, H=1, W=5, C=1)


def flow_right(pixels, shape=(1, 1, 5)):
    """An optical flow (B, H, W, 2) of so many pixels to the right everywhere."""
    return np.stack([np.full(shape, pixels, np.float32), np.zeros(shape, np.float32)], axis=-1)


print("2. The row", row.ravel(), "warped backward")
for pixels in (1, 0.5, -2):
    warped, in_view = losses.warp_backward(row, flow_right(pixels))
    print(f"   U = {pixels}: I'_t = {np.round(warped.ravel(), 3)}, in view: {in_view.ravel().astype(int)}")

# %% [markdown]
# Where the flow points out of the picture there is nothing to compare with, so `in_view` is false and the pixel costs
# nothing. Eq. (3), the photometric loss, sums up what is left, over pixels and colours:
#
#     L_rec = sum_xy |I_t - I'_t|_1
#
# ## A real poke
#
# Poke 158 of the test set pushes a striped object by 7 cm. The simulator knows its true scene flow, with which we
# ask what the loss *should* like best. Training never reads it.

# %%
ROW = 158
before, after = scenes_of(interactions[[ROW]])
image, next_image = before.images, after.images  # I_t, I_{t+1}: (1, H, W, 3) in [0, 1]
shared, next_shared = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)  # (1, N) bool
shape = image.shape[1:3]
true_flow, true_pixels, moving = true_motion(interactions, truth, ROW)  # (N, 3) m, (N, 2) px, (N,) bool
labels = truth.labels[ROW].ravel()
on_object = labels == np.bincount(labels[moving]).argmax()  # (N,): the pixels that show the object that moves most


def pixels_of(scene_flow):
    """Scene flow (N, 3) m -> optical flow (1, H, W, 2) px."""
    return anp.reshape(geometry.optical_flow(before.points, before.points + scene_flow[None], camera), (1, *shape, 2))


none = np.zeros_like(true_flow)
flows = {"no motion": pixels_of(none), "the true flow": pixels_of(true_flow)}
costs = {name: float(losses.photometric_loss(image, next_image, flow, shared)[0]) for name, flow in flows.items()}
uncorrected = {name: float(losses.photometric_loss(image, next_image, flow, before.valid)[0])
               for name, flow in flows.items()}
length = np.linalg.norm(true_pixels[on_object], axis=1)
print(f"3. Poke {ROW}: the object moves by {length.mean():.1f} pixels on average. Photometric loss")
for text, values in (("what both pictures show", costs), ("all pixels", uncorrected)):
    print(f"   {text}: " + ", ".join(f"{values[name]:.1f} for {name}" for name in flows))

warped, in_view = losses.warp_backward(next_image, flows["the true flow"])
counted = (shared.reshape(1, *shape) & in_view)[0]
errors = [np.where(counted, np.abs(image - losses.warp_backward(next_image, flow)[0])[0].sum(axis=-1), np.nan)
          for flow in flows.values()]
window = np.s_[14:48, 18:52]  # around the object
grey = plt.get_cmap(ERRORS).with_extremes(bad="0.6")
figure, axes = plt.subplots(2, 3, figsize=(11, 6.2), layout="constrained")
panels = [("$I_t$, before", image[0]), ("$I_{t+1}$, after", next_image[0]),
          (f"true optical flow (the wheel's rim: {length.max():.0f} px)",
           flow_to_rgb(flows["the true flow"][0], length.max())),
          ("$I'_t$: $I_{t+1}$ warped back along it", np.clip(warped[0], 0, 1)),
          (f"$|I_t - I_{{t+1}}|$, no motion: loss {costs['no motion']:.1f}", errors[0]),
          (f"$|I_t - I'_t|$, true flow: loss {costs['the true flow']:.1f}", errors[1])]
for panel, (title, picture) in zip(axes.flat, panels):
    shown = panel.imshow(picture[window], cmap=grey, vmin=0, vmax=2)
    panel.set_title(title, fontsize=11)
    panel.set(xticks=[], yticks=[])
wheel = axes[0, 2].inset_axes((0.02, 0.02, 0.2, 0.2))
wheel.imshow(colour_wheel(64))
wheel.axis("off")
figure.colorbar(shown, ax=axes, label="difference, sum over R, G, B", shrink=0.48, anchor=(0, 0))
figure.suptitle("Warped back along the true flow, the object lies where it was; its second copy does not count (grey)",
                fontsize=11)
lesson.keep(options, figure, "warp")

# %% [markdown]
# Why is the object in I'_t twice? A table pixel that the object covers later does not move. It reads I_{t+1} at its own
# place and finds the object there. That is no error of the flow, so it should not count: `losses.seen_in_both` (lesson
# 03) leaves out the table that only one picture shows. If all pixels count, the covered table adds the same to both
# sums above, and the only way to lower that part would be to move the table.
#
# ## Why the basin is narrow
#
# The slope of Eq. (3) at one pixel comes from the colours around the place that it reads, and from nowhere else (Sec.
# III-D says the same). A pixel knows whether half a pixel further would be better, not what waits five pixels away. Two
# rows of a picture, both moved by 10 pixels: one soft bump, and stripes that repeat every 8 pixels.

# %%
u = np.arange(120)
textures = {"one soft bump": np.exp(-((u - 40) / 8.0) ** 2),
            "stripes": np.exp(-((u - 40) / 18.0) ** 6) * (0.5 + 0.5 * np.cos(2 * np.pi * u / 8))}
tried = np.linspace(-4, 24, 225)  # multiples of 1/8 px
profiles, lows = {}, {}
figure, axes = plt.subplots(2, 2, figsize=(11, 4.6), layout="constrained", width_ratios=(1, 1.2), sharex="col")
for (name, texture), (left, right), colour in zip(textures.items(), axes, (BLUE, RED)):
    bumps = texture.astype(np.float32).reshape(1, 1, -1, 1)
    moved = np.roll(bumps, 10, axis=2)
    everywhere = np.ones((1, len(u)), bool)
    values = profiles[name] = np.array([losses.photometric_loss(bumps, moved, flow_right(pixels, (1, 1, len(u))),
                                                                everywhere)[0] for pixels in tried])
    inner = values[1:-1]
    lows[name] = tried[1:-1][(inner < values[:-2]) & (inner < values[2:]) & (inner < values.max() / 2)]
    left.plot(u, bumps.ravel(), color="0.6", label="$I_t$")
    left.plot(u, moved.ravel(), color=colour, label="$I_{t+1}$, moved by 10 px")
    left.set(ylabel="brightness", title=name)
    left.title.set_fontsize(11)
    left.legend(fontsize=9, loc="upper right")
    right.plot(tried, values, color=colour)
    right.axvline(10, color="0.5", linestyle=":", label="true flow")
    right.set(ylabel="photometric loss")
print("4. Local minima of the loss, below half its maximum: " + "; ".join(
    f"{name} at U = {', '.join(f'{low:g}' for low in found)} px" for name, found in lows.items()))
axes[0, 1].set_title("the loss for every flow tried", fontsize=11)
axes[0, 1].legend(fontsize=9)
for panel, label in zip(axes[1], ("column [px]", "flow U tried [px]")):
    panel.set_xlabel(label)
figure.suptitle("A bump pulls from afar; stripes pull to the nearest stripe, right or wrong", fontsize=11)
lesson.keep(options, figure, "stripes")

# %% [markdown]
# ## The landscape of a real poke
#
# Move the object by its true motion plus an *offset* on the table, up to 8 cm each way, and draw both losses: the
# photometric one and the Chamfer distance of lesson 04. Offset 0 is the truth. From every offset, walk to the lowest
# neighbour until none is lower. The *basin* of the truth is where such a walk ends within 1 cm of it.
#
# **Predict before you run:** "no motion", where every network starts, lies 7 cm from the truth. Is it in the basin of
# the photometric loss? And from 5 cm away, does minus the gradient still point roughly towards the truth?

# %%
def both_losses(offset):
    """Photometric loss and Chamfer distance in cm^2, the object moved by its true motion plus `offset` (3,) m."""
    scene_flow = true_flow + on_object[:, None] * offset
    photometric = losses.photometric_loss(image, next_image, pixels_of(scene_flow), shared)
    maps = losses.distance_maps(before.points + scene_flow[None], after.points, shared, next_shared)
    return photometric[0], 1e4 * losses.chamfer_loss(*maps)[0]


def basin(values):
    """Landscape (n, n) over `offsets` -> (n, n) bool: does the walk downhill end within 1 cm of offset 0?"""
    def walk(i, j):
        while True:
            near = [(values[k, l], k, l) for k in range(max(i - 1, 0), min(i + 2, len(values)))
                    for l in range(max(j - 1, 0), min(j + 2, len(values)))]
            if min(near)[1:] == (i, j):
                return np.hypot(offsets[i], offsets[j]) < 0.0101
            _, i, j = min(near)
    return np.array([[walk(i, j) for j in range(len(values))] for i in range(len(values))])


offsets = np.linspace(-0.08, 0.08, 17 if options.quick else 33)  # m
landscape = np.array([[both_losses(np.float32([dx, dy, 0])) for dx in offsets] for dy in offsets])  # (y, x, 2)
basins = [basin(landscape[..., i]) for i in (0, 1)]
shares = [float(found.mean()) for found in basins]
start = -true_flow[on_object].mean(axis=0)  # the offset at which the object, on average, stays
print(f"5. Basin of the truth: {shares[0]:.0%} of all offsets for the photometric loss, {shares[1]:.0%} for Chamfer")

figure, axes = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained", sharey=True)
for panel, i, title, label in ((axes[0], 0, "photometric loss, Eq. (3)", "loss"),
                               (axes[1], 1, "Chamfer distance, Eq. (2)", "cm$^2$")):
    half = 100 * (offsets[-1] + (offsets[1] - offsets[0]) / 2)
    shown = panel.imshow(landscape[..., i], origin="lower", extent=(-half, half, -half, half), cmap=DISTANCES)
    rim = 100 * np.concatenate([[2 * offsets[0] - offsets[1]], offsets, [2 * offsets[-1] - offsets[-2]]])
    panel.contour(rim, rim, np.pad(basins[i], 1).astype(float), levels=[0.5], colors="white", linewidths=2)
    panel.plot(0, 0, "+", color="white", markersize=12, markeredgewidth=2)
    panel.plot(*100 * start[:2], "o", color=RED, markeredgecolor="white", markersize=9)
    panel.annotate("no motion", 100 * start[:2], (8, 4), textcoords="offset points", color="white", fontsize=10,
                   path_effects=[withStroke(linewidth=2, foreground="black")])
    panel.set(xlabel="offset in x [cm]")
    panel.set_title(f"{title}: basin {shares[i]:.0%} of the offsets", fontsize=11)
    figure.colorbar(shown, ax=panel, label=label)
axes[0].set_ylabel("offset in y [cm]")
figure.suptitle("Inside the white outline, downhill leads to the truth (+): a spot for colours, all of it for geometry",
                fontsize=11)
lesson.keep(options, figure, "basin")

# %% [markdown]
# Each ripple is a stripe laid on the next one. Beyond the ripples the object's pixels read plain table, and the loss
# says little. Now the gradients: on rings around the truth, how often does minus the gradient to the offset point
# within 60 degrees of the way to the truth? A random direction does so in a third of the cases. And how long is it?

# %%
radii = np.array([0.25, 0.5, 1, 1.5, 2, 3, 4, 5, 6, 7]) / 100  # m
directions = [np.array([np.cos(a), np.sin(a), 0]) for a in np.linspace(0, 2 * np.pi, 8 if options.quick else 16, False)]


def pulls(offset):
    """Minus the gradient of both losses to the offset, on the table -> (2, 2), the photometric one first."""
    return np.array([-grad(lambda x: both_losses(x)[i])(offset.astype(np.float32))[:2] for i in (0, 1)])


found = np.array([[pulls(radius * d) for d in directions] for radius in radii])  # (rings, directions, losses, 2)
norms = np.linalg.norm(found, axis=-1)
cosines = -np.einsum("rdlx,dx->rdl", found, np.array(directions)[:, :2]) / np.maximum(norms, 1e-9)
right_way = (cosines > 0.5).mean(axis=1)  # (rings, losses)
strength = norms.mean(axis=1) / norms.mean(axis=1).max(axis=0)
print("6. Share of the gradients that point the right way")
for text, ring in (("5 mm", 1), ("5 cm", 7)):
    print(f"   {text} from the truth: {right_way[ring, 0]:.0%} photometric, {right_way[ring, 1]:.0%} Chamfer")

figure, axes = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained")
for i, name, colour, style in ((0, "photometric, Eq. (3)", RED, "o-"),
                               (1, "Chamfer, Eq. (2)", BLUE, "s-")):
    axes[0].plot(100 * radii, right_way[:, i], style, color=colour, label=name)
    axes[1].plot(100 * radii, strength[:, i], style, color=colour, label=name)
axes[0].axhline(1 / 3, color="0.5", linestyle=":", label="a random direction")
axes[0].set(xlabel="distance to the truth [cm]", ylabel="share within 60 degrees", ylim=(0, 1.05))
axes[0].set_title("does the gradient point the right way?", fontsize=11)
axes[1].set(xlabel="distance to the truth [cm]", ylabel="mean length / its maximum", ylim=(0, 1.05))
axes[1].set_title("how strong is it?", fontsize=11)
axes[0].legend(fontsize=9)
figure.suptitle("Chamfer brings the object near and then fades; there the pictures take over", fontsize=11)
lesson.keep(options, figure, "gradient")

# %% [markdown]
# So the two losses divide the work. (At no motion at all something else happens, and a little noise on the images
# helps: `training.Recipe.image_noise`, lesson 10.)
#
# **Now change this:** `ROW = 158` to `ROW = 173`. The lowest photometric loss is then in a corner of the landscape, 11
# cm from the truth: more than half of the object's pixels read outside of the picture there, where nothing is compared
# and nothing costs (`in_view`). From that term alone, a network could learn to throw things out of sight. The Check
# "offset of the lowest photometric loss" objects.

# %% Check
print("7. Check")
lesson.check("1 cm sideways, far, by hand fx * 0.01 / Z [px]", float(sideways[1][0]), camera.fx * 0.01 / depths[1],
             within=1e-6)
lesson.check("1 cm along the ray [px]", float(np.linalg.norm(along_ray)), 0.0, within=1e-6)
half = losses.warp_backward(row, flow_right(0.5))
for column, wanted in ((0, 0.05), (2, 0.3)):
    lesson.check(f"the row read half a pixel to the right, column {column}", float(half[0][0, 0, column, 0]), wanted,
                 within=1e-6)
lesson.check("its pixels in view", int(half[1].sum()), 4, within=0)
seen = np.array([[True, False, True, True, True]])  # a hole in column 1
lesson.check("Eq. (3) with a hole by hand: 0.05 + 0.1 + 0.05", float(losses.photometric_loss(row, row, flow_right(0.5),
                                                                                          seen)[0]), 0.2, within=1e-6)
ramp = 0.1 * np.arange(5, dtype=np.float32).reshape(1, 1, 5, 1)  # against ramp + 0.3 the loss is 0.1 |U - 3| per pixel
all_seen = np.ones((1, 5), bool)
slope = grad(lambda flow: anp.sum(losses.photometric_loss(ramp + 0.3, ramp, flow, all_seen)))(flow_right(0.5))
lesson.check("its gradient to U on a ramp of 0.1 per pixel", float(slope[0, 0, 1, 0]), -0.1, within=1e-6)
lesson.check("and to V", float(np.abs(slope[..., 1]).max()), 0.0, within=1e-6)
y, x = np.mgrid[:shape[0], :shape[1]] + np.moveaxis(flows["the true flow"][0].astype(float), 2, 0)[::-1]
by_scipy = np.stack([map_coordinates(channel, [y, x], order=1, mode="nearest")
                     for channel in np.moveaxis(next_image[0].astype(float), 2, 0)], axis=-1)
by_scipy = float((np.abs(image[0] - by_scipy) * counted[..., None]).sum())
lesson.check("Eq. (3) along the true flow / the same with SciPy", costs["the true flow"] / by_scipy, 1.0, within=0.01)
lesson.check("what the covered table would add to it", uncorrected["the true flow"] - costs["the true flow"], above=5)
lesson.check("photometric loss, true flow / no motion", costs["the true flow"] / costs["no motion"], above=0, below=0.7)
lesson.check("number of minima, one soft bump", len(lows["one soft bump"]), 1, within=0)
lesson.check("number of minima, stripes", len(lows["stripes"]), 3, within=0)
lowest = np.unravel_index(landscape[..., 0].argmin(), landscape.shape[:2])
lesson.check("offset of the lowest photometric loss [cm]", 100 * float(np.hypot(*offsets[list(lowest)])), 0.0,
             within=0.8)
lesson.check("basin of the photometric loss, share of the offsets", shares[0], above=0, below=0.25)
lesson.check("basin of the Chamfer distance", shares[1], above=0.8)
lesson.check("share of photometric gradients that point the right way at 5 mm", float(right_way[1, 0]), above=0.8)
lesson.check("the same at 5 cm", float(right_way[7, 0]), below=0.7)
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. Neither. The basin is a spot around the truth, about as wide as a stripe; no motion lies far outside. From 5 cm
#    away the gradient of the colours is little better than a random direction, while Chamfer's still points the right
#    way.
