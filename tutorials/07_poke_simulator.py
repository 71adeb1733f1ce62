"""Poking: how a robot makes its own training data, with nobody to label it.

Question: a robot stands before a table with unknown objects. How does it find something worth poking, what does it
write down of a poke, and why is that enough to learn from?

Equations:
- Sec. IV-A, background subtraction and the grid: `scene.scene_of`, `interactions.occupied_grid`,
  `interactions.cells_of`; tests/test_scene.py, tests/test_interactions.py
- Sec. III-A and IV-A, a poke: `sim.arena.Arena.sample_poke`, `sim.arena.Arena.poke`, `geometry.poke_frame`;
  tests/test_sim_arena.py, tests/test_geometry.py
- Sec. IV-B, the data set: `sim.collection.collect_shard`; tests/test_sim_collection.py
- Sec. IV-C, true scene flow: `sim.truth.true_scene_flow`; tests/test_sim_truth.py

Time: 5 s. Pictures: 07_film.png, 07_hindsight.png, 07_grid.png.

Last lines to expect:
   median angle between an object's motion and the poke [degrees]: expected below 30, got 18.09
07_poke_simulator: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. The arena lives in Bullet, a physics engine (Python
# package pybullet). Where it is not installed, this lesson uses the shipped pokes of data_small instead, and says
# so.

# %%
import lesson  # first of all: it sets the number of BLAS threads

from dataclasses import asdict, replace

import numpy as np
from matplotlib.patches import Circle, FancyArrowPatch

from hind4sight_min import interactions, scene
from hind4sight_min.geometry import poke_frame, project, unproject
from hind4sight_min.lab.evaluation import MOVING
from hind4sight_min.lab.figures import BLUE, DISTANCES, ORANGE, OUTLINE, RED, SHARES
from hind4sight_min.lab.noise import add_depth_noise
from hind4sight_min.sim.arena import Arena, Settings
from hind4sight_min.sim.collection import collect_shard
from hind4sight_min.sim.photographs import photographs
from hind4sight_min.sim.truth import true_scene_flow
from hind4sight_min.training import scenes_of

options = lesson.begin("07_poke_simulator")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

# %% [markdown]
# ## One poke
#
# The arena is a table with low walls, half a metre wide. A fixed camera looks at it from the front and takes
# pictures of colour and of depth. The robot has one finger: a vertical cylinder that comes down at a *start*, moves
# in a straight line to a *target* and is lifted again. Sec. III-A writes a poke as three numbers,
#
#     u_t = (a_x, a_y, a_theta)
#
# the target on the table in metres, and the direction in radians from which the finger gets there.
#
# `sim.arena.Arena` is that arena. Here it also takes a picture every few steps of Bullet, to have a film to look
# at. The robot has no film: it takes one picture before the poke and one after.

# %%
FILMED = 40  # steps of 1/240 s from one picture of the film to the next


class FilmedArena(Arena):
    """An arena that also keeps pictures of what happens during a poke."""
    film, steps = (), 0

    def _step(self, count):
        for _ in range(count):
            super()._step(1)
            self.steps += 1
            if self.film and self.steps % FILMED == 0:
                self.film.append(self.observe()[0])


try:
    with FilmedArena(Settings(width=192, height=144), np.random.default_rng(23)) as arena:
        arena.new_scene()
        (rgb, depth, labels), empty_depth = arena.observe(), arena.empty_depth
        poke, start = arena.sample_poke(rgb, depth)
        arena.film, arena.steps = [rgb], 0
        at_rest = arena.poke(poke, start)
        film = [*arena.film, arena.observe()[0]]
        camera, settings, bullet = arena.camera, asdict(arena.settings), True
except RuntimeError as error:
    print(f"   NOTE: {error}\n   The shipped pokes of data_small are used instead; in place of a film, photographs.")
    recorded, truth = lesson.pokes()
    rgb, depth, labels = recorded.rgb_before[1], recorded.depth_before[1], truth.labels[1]
    poke, start, at_rest = recorded.pokes[1], recorded.starts[1], True
    film = list(photographs(recorded, truth, [1])[1])
    camera, settings, empty_depth, bullet = recorded.camera, recorded.settings, recorded.empty_depth, False
print(f"1. A poke from ({start[0]:.2f}, {start[1]:.2f}) m to ({poke[0]:.2f}, {poke[1]:.2f}) m, direction "
      f"{np.degrees(poke[2]):.0f} degrees; then everything {'came to rest' if at_rest else 'kept moving'}.")

# %% [markdown]
# ## Where is something to poke?
#
# The robot knows no objects, but it has seen the arena empty. *Background subtraction* (Sec. IV-A): a pixel is
# *occupied* where it is nearer to the camera than in the empty arena, by more than a threshold. The points of these
# pixels, seen from above, fall into the cells of a grid; a cell with at least one of them is occupied. The robot
# draws one occupied cell as the target and, 10 to 14 cm away from it, one free cell in which the finger can come
# down as the start.

# %%
THRESHOLD = scene.OCCUPIED  # m
NOISE = 0.0                 # m, standard deviation of the depth noise of Sec. IV-B; see the experiment below
scene.OCCUPIED = THRESHOLD
seen = add_depth_noise(depth, np.random.default_rng(0), NOISE)


def occupied_cells(pictures):
    """A Scene of B pictures -> the cells that something stands in, (B, rows, columns) bool."""
    return np.concatenate([interactions.occupied_grid(points[None], occupied, settings)
                           for points, occupied in zip(pictures.points, pictures.occupied)])


now = scene.scene_of(seen[None], rgb[None], empty_depth, camera, settings["arena"])
occupied, cells = now.occupied.reshape(depth.shape), occupied_cells(now)[0]
side, half = settings["cell"], settings["arena"] / 2
print(f"2. Nearer than the empty arena by more than {1000 * THRESHOLD:.0f} mm: {occupied.sum()} of {occupied.size} "
      f"pixels, {cells.sum()} of {cells.size} cells")


def arrow(axes, tail, tip):
    axes.add_patch(FancyArrowPatch(tail, tip, arrowstyle="-|>", mutation_scale=14, linewidth=2, color="black",
                                   shrinkA=0, shrinkB=0, path_effects=OUTLINE, zorder=5))


def picture(axes, image, title, **how):
    axes.set_title(title, fontsize=11)
    axes.set_xticks([])
    axes.set_yticks([])
    return axes.imshow(image, interpolation="nearest", **how)


path = np.array([[*start, 0.02], [*poke[:2], 0.02]])  # 2 cm above the table, m
figure, axes = plt.subplots(1, 4, figsize=(11, 2.7), layout="constrained", width_ratios=(1.2, 1.5, 1.2, 1.25))
picture(axes[0], rgb, "the scene and the poke")
arrow(axes[0], *project(path, camera))
shown = picture(axes[1], 100 * (empty_depth - seen), "empty depth minus depth", cmap=DISTANCES, vmin=0, vmax=6)
figure.colorbar(shown, ax=axes[1], label="[cm]", shrink=0.65)
picture(axes[2], occupied, "occupied pixels", cmap=SHARES)
axes[3].imshow(cells, origin="lower", extent=(-half, half, -half, half), cmap=SHARES, interpolation="nearest")
for radius in settings["poke_length"]:
    axes[3].add_patch(Circle(poke[:2], radius, fill=False, color="white", linestyle=":", linewidth=1.2))
arrow(axes[3], start, poke[:2])
axes[3].set(xlabel="x [m]", ylabel="y [m]", xticks=[-0.2, 0, 0.2], yticks=[-0.2, 0, 0.2])
axes[3].set_title("occupied cells, from above", fontsize=11)
figure.suptitle("One picture of the empty arena is enough to find targets; a start lies between the dotted rings",
                fontsize=11)
lesson.keep(options, figure, "grid")

middle, size = project(np.array([*poke[:2], 0.02]), camera), np.array([camera.width, camera.height]) // 2
left, top = np.clip(middle - size / 2, 0, size).astype(int)
fine = len(film[0]) // camera.height  # a photograph has more pixels than the camera of the model
part = np.s_[fine * top:fine * (top + size[1]), fine * left:fine * (left + size[0])]  # half of it, around the target
figure, axes = plt.subplots(1, len(film), figsize=(11, 2.4) if bullet else (8, 3.5), layout="constrained")
for number, (panel, frame) in enumerate(zip(axes, film)):
    ends = number in (0, len(film) - 1)
    picture(panel, frame[part], ("before" if number == 0 else "after") if ends else f"{number * FILMED / 240:.2f} s")
    for line in panel.spines.values():
        line.set(color=RED if ends else "0.8", linewidth=4)
figure.suptitle("The finger (white cylinder) pushes and is lifted; the robot keeps the framed two, in 64 x 48 pixels"
                if bullet else "All that the robot keeps of a poke: these two (photographs), in 64 x 48 pixels",
                fontsize=11)
lesson.keep(options, figure, "film")

# %% [markdown]
# ## Why "hindsight"?
#
# The robot wanted nothing in particular, so no poke can fail. What it keeps of each is
#
# - the colour and depth pictures before and after,
# - the poke u_t, and the cells of its start and its target.
#
# In hindsight this is a solved exercise, twice. For the *forward model*: given the first picture and u_t, what is the
# second picture? For the *inverse model*: given both pictures, which were the two cells? Neither answer needs a
# person. What nobody writes down is which pixel is which object and where each point went: the masks and motions
# must be found without that.
#
# `sim.collection.collect_shard` repeats this: look, draw a poke, poke, look again. After six pokes it sets up a new
# scene. Pokes after which something left the arena or the picture, or did not come to rest, are dropped and
# counted.
#
# **Predict before you run:** the robot aims at occupied cells. In what share of its pokes does anything move? And
# in what share do two objects or more?

# %%
POKES = 40 if options.quick else 120
if bullet:
    recorded, truth = collect_shard(Settings(), 1, 0, POKES)
else:
    recorded, truth = recorded[:POKES], truth[slice(POKES)]
exists = np.abs(truth.poses_before).sum(axis=2) > 0                                # (M, 7): which rows hold an object
shift = truth.poses_after[..., :3] - truth.poses_before[..., :3]                   # (M, 7, 3) m
moved = exists & (np.linalg.norm(shift, axis=2) > MOVING)                          # (M, 7)
counts = moved.sum(axis=1)
grids = occupied_cells(scenes_of(recorded)[0])                                     # (M, rows, columns)
print(f"3. {len(recorded)} pokes: something moves in {np.mean(counts > 0):.0%}, two objects or more in "
      f"{np.mean(counts > 1):.0%}. Only {grids.mean():.0%} of the cells are occupied.")

# %% [markdown]
# ## What is there to learn?
#
# Draw the motion of every object that moved as an arrow. In the arena's frame, left, there is no pattern: objects
# lie anywhere and are pushed anywhere. Now turn and shift each poke so that its target is the origin and its
# direction is the x axis, right: `geometry.poke_frame`. The pattern is plain, and it is the *same* for every poke.
# The network reads the points in this frame (lesson 08), so it need not learn each corner of the arena on its
# own.

# %%
rows, objects = np.nonzero(moved)
where = truth.poses_before[rows, objects][:, None, :3].astype(np.float32)          # (n, 1, 3) m, centres before
there = where + shift[rows, objects][:, None]
here_local, there_local = (poke_frame(points, recorded.pokes[rows])[:, 0] for points in (where, there))
local_shift = there_local - here_local
lengths = np.linalg.norm(local_shift[:, :2], axis=1)
first = counts[rows] == 1                                                          # pokes that moved one object only
forwards = np.degrees(np.abs(np.arctan2(local_shift[:, 1], local_shift[:, 0])))
clear = first & (lengths > 0.01)
print(f"4. Pokes that moved one object, by more than 1 cm: its motion is off the poke's direction by "
      f"{np.median(forwards[clear]):.0f} degrees (median), {np.mean(forwards[clear] < 45):.0%} are within 45 degrees")

figure, axes = plt.subplots(1, 3, figsize=(11, 3.9), layout="constrained", width_ratios=(1.15, 1.15, 0.8))
for panel, tails, tips, title in ((axes[0], where[:, 0], there[:, 0], "in the arena's frame"),
                                  (axes[1], here_local, there_local, "in the poke's frame")):
    for group, colour, label in ((first, BLUE, "the only object that moved"),
                                 (~first, ORANGE, "one of several")):
        panel.quiver(*tails[group, :2].T, *(tips - tails)[group, :2].T, color=colour, angles="xy", scale_units="xy",
                     scale=1, width=0.005, label=label if panel is axes[0] else None)
    panel.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    panel.set_title(title, fontsize=11)
axes[0].set(xlim=(-half, half), ylim=(-half, half + 0.08))
axes[1].set(xlim=(-0.12, 0.18), ylim=(-0.15, 0.15), xlabel="along the poke [m]", ylabel="across [m]")
axes[1].plot(0, 0, "k+", markersize=14, markeredgewidth=2.5, zorder=5, label="the target of every poke")
axes[1].legend(fontsize=8, loc="upper right")
axes[0].legend(fontsize=8, loc="upper right")
values, shares = np.unique(counts, return_counts=True)
axes[2].bar(values, shares / len(counts), color=BLUE, width=0.6)
axes[2].set(xlabel="objects that moved", ylabel="share of the pokes", xticks=values)
axes[2].set_title("most pokes move one object", fontsize=11)
figure.suptitle("The same motions twice: in the poke's frame nearly all point forwards", fontsize=11)
lesson.keep(options, figure, "hindsight")

# %% [markdown]
# **Now change this:** `NOISE = 0.0` to `NOISE = 0.01`, the depth noise of Sec. IV-B. Nearly all of the 400 cells are
# occupied, and the robot would poke at bare table. The Check "occupied pixels and the simulator's objects" objects.
# Raise `THRESHOLD`, too: at 0.04 the table is quiet, but a third of the objects' pixels are gone. (The shipped pokes
# were collected without noise; noise is added when a model is trained or evaluated, and `lab.noise.smooth_depth` then
# takes a part of it out again.)

# %% Check
print("5. Check")
row_of_four, from_afar = np.array([[[1.0, 0.995, 0.9, 0.0]]]), replace(camera, width=4, height=1)
four = scene.scene_of(row_of_four, np.zeros((1, 1, 4, 3)), np.ones((1, 4)), from_afar, 100.0).occupied
lesson.check("four pixels: 0, 5 mm and 10 cm nearer, missing; only the third is occupied (a digit each)",
             int(four[0] @ [1000, 100, 10, 1]), 10, within=0)
inside = np.abs(unproject(seen, camera)[..., :2]).max(axis=2) < half
both, either = (combine(occupied & inside, labels > 0).sum() for combine in (np.logical_and, np.logical_or))
lesson.check("occupied pixels and the simulator's objects, intersection over union", both / either, above=0.85)
lesson.check("cell of the place (0.01, -0.01) m, row 9, column 10", int(interactions.cells_of([0.01, -0.01], settings)),
             9 * 20 + 10, within=0)
points = unproject(seen, camera)[occupied & inside]
by_hand = {(int((y + half) // side), int((x + half) // side)) for x, y, _ in points}
lesson.check("cells that differ from a plain loop (rounding may cost one)",
             len(by_hand ^ set(zip(*np.nonzero(cells)))), 0, within=1)
travel = recorded.pokes[:, :2] - recorded.starts
turn = recorded.pokes[:, 2] - np.arctan2(travel[:, 1], travel[:, 0])
lesson.check("largest angle between a_theta and start-to-target [degrees]",
             float(np.degrees(np.abs((turn + np.pi) % (2 * np.pi) - np.pi)).max()), 0, within=0.1)
least, most = recorded.settings["poke_length"]
length = np.linalg.norm(travel, axis=1)
lesson.check("shortest path of a finger [m]", float(length.min()), above=least - 1e-4)
lesson.check("longest path of a finger [m]", float(length.max()), below=most + 1e-4)
hit = grids.reshape(len(grids), -1)[np.arange(len(grids)), interactions.cells_of(recorded.pokes[:, :2], settings)]
lesson.check("share of targets on an occupied cell", float(hit.mean()), 1, within=1e-9)
x, y, angle = recorded.pokes[0]
beside = np.float32([[[x - 0.05 * np.sin(angle), y + 0.05 * np.cos(angle), 0]]])
lesson.check("5 cm to the left of the target, in the poke's frame: distance to (0, 0.05, 0) [m]",
             float(np.linalg.norm(poke_frame(beside, recorded.pokes[:1]) - [0, 0.05, 0])), 0, within=1e-5)
turned = np.array([[0.1, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]])  # moved by 10 cm, turned by 90 degrees
flow = true_scene_flow(np.array([[[0.02, 0, 0.01]]]), np.array([[1]]), np.array([[0, 0, 0, 0, 0, 0, 1.0]]), turned)
lesson.check("true flow of a point at (2, 0, 1) cm, distance to (8, 2, 0) cm [m]",
             float(np.linalg.norm(flow[0, 0] - [0.08, 0.02, 0])), 0, within=1e-6)
lesson.check("share of pokes that move something", float(np.mean(counts > 0)), above=0.8)
lesson.check("median angle between an object's motion and the poke [degrees]", float(np.median(forwards[clear])),
             below=30)
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. In nearly all of them something moves, in about one of ten two objects or more. A target drawn from all cells would
#    nearly always be bare table; that is what background subtraction is for.
