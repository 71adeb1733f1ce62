"""Point clouds: from a depth picture to points in metres, and back to pixels.

Question: a depth camera says how far away each pixel is. Where in the room is the thing that the pixel shows, and
which pixel shows a given place?

Equations:
- Sec. III-A, the raw point cloud P_t = (X_t, Y_t, Z_t): `geometry.unproject`; tests/test_geometry.py
- Sec. III-C, projection with known camera intrinsics: `geometry.project`, `geometry.Camera`; tests/test_geometry.py

Time: 3 s. Pictures: 01_views.png, 01_other.png, 01_table.png, 01_missing.png.

Last lines to expect:
   shift of the object's centre, invalid points left out / counted: expected below 0.2, got 0.03909
01_point_clouds: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. `geometry.unproject` and `geometry.project` are the two
# functions of this lesson; with your editor's "go to definition" each is one click away.

# %%
import lesson  # first of all: it sets the number of BLAS threads

from dataclasses import replace

import cv2
import numpy as np

from hind4sight_min import geometry
from hind4sight_min.lab.figures import BLUE, GREEN, PINK, RED

options = lesson.begin("01_point_clouds")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

# %% [markdown]
# ## One pixel by hand
#
# A pinhole camera is four numbers and a pose. The four numbers are the *intrinsics*: (cx, cy) is the pixel that the
# *optical axis* goes through, the line along which the camera looks; fx and fy are the focal length in pixels, one for
# columns and one for rows. A pixel in column u and row v with *depth* Z lies, in the camera's frame, at
#
#     X = (u - cx) Z / fx        Y = (v - cy) Z / fy        Z
#
# with X to the right, Y down and Z forward, in metres. Depth is measured along the optical axis: it is not the length
# of the ray. The *pose* is a 4 x 4 matrix that maps points of the camera's frame into the arena's frame, whose origin
# is the middle of the table's surface and whose z points up. A small camera, one metre above the table, looking down:

# %%
pose = np.array([[1.0, 0, 0, 0],   # arena x = X
                 [0, -1, 0, 0],    # arena y = -Y, because Y points down in the picture
                 [0, 0, -1, 1],    # arena z = 1 - Z, because the camera looks down from 1 m
                 [0, 0, 0, 1]])
small = geometry.Camera(width=5, height=4, fx=100, fy=50, cx=2, cy=1, arena_from_camera=pose)
small_depth = np.full((4, 5), 0.8)                     # (H, W) m: a flat thing, 20 cm above the table
corner = geometry.unproject(small_depth, small)[3, 4]  # row v = 3, column u = 4
print("1. Pixel (u, v) = (4, 3) at a depth of 0.8 m")
print("   by hand:    X = 2 * 0.8 / 100 = 0.016, Y = 2 * 0.8 / 50 = 0.032; arena: (0.016, -0.032, 0.2)")
print("   unproject: ", corner)

# %% [markdown]
# ## A real depth picture
#
# Now a picture of the test set, 64 x 48 pixels. A pixel is *valid* if it has a depth at all; more on that at the end.
# The cloud keeps the picture's layout: `points[v, u]` belongs to pixel (u, v). Where the package wants a list of points
# it flattens the picture row by row; `scene.scene_of` prepares pictures that way.
#
# **Predict before you run:** the camera sits 62 cm above the table and 46 cm in front of its middle, looking down at
# an angle. The table is flat. Along one *row* of the depth picture, does the depth of the table change? And along one
# *column*?

# %%
pokes, truth = lesson.pokes()
ROW = 148
camera, empty = pokes.camera, pokes.empty_depth
image, depth = pokes.rgb_before[ROW] / 255, pokes.depth_before[ROW]
points, valid = geometry.unproject(depth, camera), depth > 0  # P_t (H, W, 3) m, (H, W) bool
eye, forward = camera.arena_from_camera[:3, 3], camera.arena_from_camera[:3, 2]
print(f"2. Poke {ROW}: the camera at {eye} m looks along {np.round(forward, 2)}")

table = geometry.unproject(empty, camera)  # the empty arena
inside = (empty > 0) & (np.abs(table[..., :2]) < 0.22).all(axis=-1)  # away from the walls at 0.25 m
v, u = 24, 32
for name, line in ((f"row {v}", empty[v, inside[v]]), (f"column {u}", empty[inside[:, u], u])):
    print(f"   depth of the empty table along {name}: {line.min():.4f} to {line.max():.4f} m")

figure, axes = plt.subplots(1, 3, figsize=(11, 2.9), layout="constrained", width_ratios=(0.86, 1, 1), sharey=True)
panels = (("the picture $I_t$", image, {}, None),
          ("depth Z along the optical axis", depth, {"cmap": "viridis"}, "Z [m]"),
          ("height z in the arena's frame", 100 * points[..., 2], {"cmap": "magma"}, "z [cm]"))
for panel, (title, picture, how, label) in zip(axes, panels):
    shown = panel.imshow(picture, **how)
    panel.set(xlabel="column u [px]")
    panel.set_title(title, fontsize=11)
    if label:
        figure.colorbar(shown, ax=panel, label=label, shrink=0.75, pad=0.02)
axes[0].set_ylabel("row v [px]")
figure.suptitle("Depth mostly says how far down the table a pixel is; the arena's frame says what stands on it",
                fontsize=11)
lesson.keep(options, figure, "views")

# %% [markdown]
# Depth is not distance: the *distance* to the camera would grow along the row, too, towards both its ends. Taking one
# for the other is a common mistake, and a flat table shows it at once.
#
# ## A flat table is a test of the camera
#
# The table's surface is z = 0 by definition. Unproject the empty arena three times with something wrong, and look at
# the height of the table along one row and along one column.

# %%
u_grid, v_grid = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
ray = np.sqrt(1 + ((u_grid - camera.cx) / camera.fx) ** 2 + ((v_grid - camera.cy) / camera.fy) ** 2)
attempts = {
    "as it should be": table,
    "distance taken for depth": geometry.unproject((empty * ray).astype(np.float32), camera),
    "focal length 5 % too long": geometry.unproject(empty, replace(camera, fx=1.05 * camera.fx, fy=1.05 * camera.fy)),
    "centre half a pixel too low": geometry.unproject(empty, replace(camera, cy=camera.cy + 0.5)),
}
heights = {name: 1000 * attempt[..., 2] for name, attempt in attempts.items()}  # mm
print("3. Height of the table, which is 0: largest error in mm")
for name, height in heights.items():
    print(f"   {name}: {np.abs(height[inside]).max():.2f}")

figure, axes = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained", sharey=True)
colours = ("black", RED, BLUE, PINK)
styles = ("-", "--", "-.", ":")
for (name, height), colour, style in zip(heights.items(), colours, styles):
    axes[0].plot(u_grid[v, inside[v]], height[v, inside[v]], style, color=colour, linewidth=2, label=name)
    axes[1].plot(v_grid[inside[:, u], u], height[inside[:, u], u], style, color=colour, linewidth=2, label=name)
axes[0].set(xlabel=f"column u, along row {v} [px]", ylabel="height of the table [mm]")
axes[1].set(xlabel=f"row v, along column {u} [px]")
axes[1].legend(fontsize=9)
figure.suptitle("Each mistake bends, tilts or lifts the table in its own way", fontsize=11)
lesson.keep(options, figure, "table")

# %% [markdown]
# ## And back to pixels
#
# `project` is the way back: arena frame, camera frame, then x = fx X / Z + cx and y = fy Y / Z + cy. For the cloud of a
# picture it must return every pixel's own column and row. It also answers what *another* camera would see of the
# same cloud: only what the first one saw. Behind every object lies a part of the arena that is in no cloud.
#
# A point beside the camera has Z = 0 and no pixel. `project` takes Z to be at least `MIN_DEPTH`, 5 cm, so that a
# prediction gone wild gives a pixel far off, which a loss can handle, and never an infinite one, which it cannot.

# %%
pixels = geometry.project(points, camera)  # (H, W, 2) px: x, y
round_trip = np.abs(pixels - np.stack([u_grid, v_grid], axis=-1)).max()
print(f"4. Largest error of project(unproject(depth)): {round_trip:.6f} px")

right = camera.arena_from_camera[:3, 0]
behind = geometry.project(eye - 0.1 * forward + 0.02 * right, camera)  # 10 cm behind the camera, 2 cm to the right
print(f"   a point 10 cm behind the camera lands at pixel {behind}")

turn = np.eye(4)
turn[:3, :3] = geometry.so3_exp(np.array([0, 0, 1.2]))  # about z, by 1.2 rad: the camera walks around to the right
other = replace(camera, width=40, height=30, fx=camera.fx * 40 / 64, fy=camera.fy * 40 / 64, cx=19.5, cy=14.5,
                arena_from_camera=turn @ camera.arena_from_camera)  # and has fewer pixels


def splat(cloud, colours, seen_by):
    """Put every point (N, 3) into its nearest pixel of a camera's picture, the nearest point last -> (H, W, 3)."""
    picture = np.ones((seen_by.height, seen_by.width, 3))
    x, y = np.rint(geometry.project(cloud, seen_by)).astype(int).T
    far_to_near = np.argsort(-geometry.rigid(cloud, seen_by.camera_from_arena)[:, 2])
    far_to_near = far_to_near[((x >= 0) & (x < seen_by.width) & (y >= 0) & (y < seen_by.height))[far_to_near]]
    picture[y[far_to_near], x[far_to_near]] = colours[far_to_near]
    return picture


flat, paint = points[valid], image[valid]
seen = splat(flat, paint, other)
figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained", width_ratios=(1, 1, 0.75))
for panel, title, picture in ((axes[0], "the cloud in its own camera", splat(flat, paint, camera)),
                              (axes[1], "the same cloud in another camera", seen)):
    panel.imshow(picture)
    panel.set(xlabel="column u [px]", ylabel="row v [px]")
    panel.set_title(title, fontsize=11)
axes[2].scatter(*flat[:, :2].T, c=paint, s=5, linewidths=0, antialiased=False)
axes[2].set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-0.3, 0.3), ylim=(-0.3, 0.3))
axes[2].set_title("the same cloud from above", fontsize=11)
figure.suptitle("One camera sees the front of things: seen from elsewhere there are gaps (white) behind each object",
                fontsize=11)
lesson.keep(options, figure, "other")

# %% [markdown]
# ## Missing depth
#
# Real depth cameras return 0 where they could not measure. Our simulated ones miss nothing, so we punch a hole: 15 of
# the pixels of one object lose their depth. A depth of 0 becomes a point *at the camera*: finite numbers, far from
# where they belong. Nothing fails; averages just go wrong. So the package carries the validity mask along with every
# cloud, and counts a point only where the mask is true. Here the centre of one object, a mean of points under a mask,
# as the forward model takes the centre of each of its masks, with and without validity.
#
# **Predict before you run:** the object covers 53 pixels, and the camera is 77 cm away from it. By about how much does
# the centre move if 15 of the points lie at the camera?

# %%
label = np.argmax(np.bincount(truth.labels[ROW].ravel())[1:]) + 1  # the object that covers most pixels
on_object = truth.labels[ROW] == label
broken = depth.copy()
broken.flat[np.flatnonzero(on_object)[:15]] = 0
holed, holed_valid = geometry.unproject(broken, camera), broken > 0


def centre_of(cloud, weights):
    """Mean of the points (H, W, 3) under the weights (H, W) -> (3,) m."""
    return np.sum(cloud * weights[..., None], axis=(0, 1)) / weights.sum()


true_centre = centre_of(points, on_object)
naive_centre, masked_centre = centre_of(holed, on_object), centre_of(holed, on_object & holed_valid)
naive_error, masked_error = (100 * np.linalg.norm(c - true_centre) for c in (naive_centre, masked_centre))
print(f"5. {np.sum(~valid)} pixels miss their depth in the picture itself, {np.sum(~holed_valid)} after the hole, of "
      f"the object's {np.sum(on_object)}")
print(f"   the object's centre moves by {naive_error:.1f} cm if they count, by {masked_error:.1f} cm if not")

figure, axes = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained", width_ratios=(1, 0.8))
with_holes = plt.get_cmap("viridis").with_extremes(bad=RED)
shown = axes[0].imshow(np.where(holed_valid, broken, np.nan), cmap=with_holes)
axes[0].set(xlabel="column u [px]", ylabel="row v [px]")
axes[0].set_title("depth with a hole (orange)", fontsize=11)
figure.colorbar(shown, ax=axes[0], label="Z [m]", pad=0.02)
side = axes[1]
side.scatter(*holed[holed_valid][:, 1:].T, s=5, color="0.75", linewidths=0, label="points of the cloud")
side.scatter(*holed[on_object & holed_valid][:, 1:].T, s=10, color=GREEN, linewidths=0,
             label="the object's points")
side.scatter(*holed[~holed_valid][:, 1:].T, s=60, marker="x", color=RED, label="its points without depth")
side.plot(*naive_centre[1:], "D", color=RED, linestyle="", label="its centre, all points")
side.plot(*masked_centre[1:], "o", color="black", linestyle="", label="its centre, valid points")
side.set(aspect="equal", xlabel="y [m]", ylabel="z [m]", xlim=(-0.5, 0.32), ylim=(-0.03, 0.66))
side.annotate("the camera", eye[1:], (12, -4), textcoords="offset points", fontsize=9)
side.set_title("the cloud from the side", fontsize=11)
side.legend(fontsize=9, loc="upper left", bbox_to_anchor=(1.02, 1), frameon=False)
figure.suptitle("A pixel without depth is a point at the camera, and drags every average there", fontsize=11)
lesson.keep(options, figure, "missing")

# %% [markdown]
# **Now change this:** `[:15]] = 0` to `[:15]] = np.nan`, another sign for what is missing. These pixels are still not
# valid, because `depth > 0` is false for NaN as well. Yet the centre of the *valid* points becomes NaN, as NaN times a
# weight of 0 is NaN. (A missing depth of 0 is wrong but finite, and a weight of 0 takes it out of every sum.) The
# Checks "distance of a point without depth to the camera" and "shift of the object's centre" object.

# %% Check
print("6. Check")
for axis, wanted in zip("xyz", (0.016, -0.032, 0.2)):
    lesson.check(f"pixel (4, 3) by hand, {axis} [m]", float(corner["xyz".index(axis)]), wanted, within=1e-9)
lesson.check("largest height of the empty table [mm]", float(np.abs(heights["as it should be"][inside]).max()),
             below=0.5)
wall = (table[..., 2] > 0.005) & (table[..., 2] < 0.025) & (table[..., 0] > 0) & (np.abs(table[..., 1]) < 0.2)
lesson.check("the right wall stands at x = 0.25 m", float(np.median(table[wall, 0])), 0.25, within=0.005)
lesson.check("largest error of project(unproject(depth)) [px]", float(round_trip), below=0.01)
to_other = other.camera_from_arena
by_opencv, _ = cv2.projectPoints(flat.astype(float), cv2.Rodrigues(to_other[:3, :3])[0], to_other[:3, 3],
                                 np.array([[other.fx, 0, other.cx], [0, other.fy, other.cy], [0, 0, 1]]), None)
difference = np.abs(geometry.project(flat.astype(float), other) - by_opencv[:, 0]).max()
lesson.check("largest difference to OpenCV's projection in the other camera [px]", float(difference), below=1e-6)
middle, its_middle = (geometry.project(np.zeros(3), each) - (each.cx, each.cy) for each in (camera, other))
lesson.check("the origin does not turn: 40 / 64 as far above the middle as in the first picture [px]",
             float(its_middle[1]), float(middle[1]) * 40 / 64, within=1e-6)
lesson.check("column of the point behind the camera: fx * 0.02 / 0.05 + cx [px]", float(behind[0]),
             camera.fx * 0.4 + camera.cx, within=1e-6)
lesson.check("pixels without depth after the hole", int(np.sum(~holed_valid)), 15, within=0)
lesson.check("distance of a point without depth to the camera [m]",
             float(np.linalg.norm(holed[~holed_valid] - eye, axis=-1).max()), 0.0, within=1e-6)
lesson.check("shift of the object's centre, invalid points left out / counted", masked_error / naive_error, below=0.2)
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. Along a row it is the same everywhere: the camera is not tilted sideways, so a row of table points is parallel to
#    the picture. Along a column it grows towards the far wall.
# 2. By 15/53 of the way to the camera, some 22 cm. Leaving the 15 points out costs a few millimetres, as they were the
#    object's far end.
