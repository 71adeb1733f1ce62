"""The animation at the top of the README: one poke, predicted and true, then three objects brought to their goals.

    python docs/hero.py
    python docs/hero.py --seed 4 --out runs/hero.gif

Everything in it is the shipped model at work on scenes it never saw, from --seed on; nothing is picked by hand: the
poke is the first whose predicted motion is long enough to see. Needs pybullet; a minute or two. The same seed and
model give the same file.
"""
import argparse
import sys
from pathlib import Path

import numpy as np

from hind4sight_min import planning  # before Matplotlib: it sets the number of BLAS threads
from hind4sight_min.disk import checkpoints
from hind4sight_min.disk.files import check_output, whole_file
from hind4sight_min.geometry import project
from hind4sight_min.lab import control
from hind4sight_min.lab.cli import data_small
from hind4sight_min.lab.figures import GOAL, OUTLINE, PALETTE, blend, draw_arrow, on_table
from hind4sight_min.networks import predict
from hind4sight_min.sim.arena import Arena
from hind4sight_min.sim.truth import true_scene_flow

from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from PIL import Image  # noqa: E402

OUT = Path(__file__).resolve().parent / "hero.gif"
WIDTH, HEIGHT = 384, 288  # px of a photograph; two stand side by side, pixel by pixel
CANVAS = 800, 370  # px
SEEN = 0.05  # m, on average over the points that move: what is long enough to see
CARD, INK, DIM = "#22272e", "#f0f3f6", "#adbac7"  # a card of its own, for light pages and dark ones
COLOURS = 255


# --- what happens -------------------------------------------------------------------------------------------------

def film_pokes(arena, every):
    """From now on the arena keeps pictures of its pokes -> a list that grows by a list of photographs a poke.

    every: steps of the simulator, of 1/240 s, from one to the next.
    """
    films, step, poke = [], arena._step, arena.poke

    def filmed_steps(count):
        for _ in range(count // every):
            step(every)
            films[-1].append(arena.photograph(width=WIDTH))
        step(count % every)

    def filmed_poke(*where):
        films.append([])
        arena._step = filmed_steps
        try:
            return poke(*where)
        finally:
            arena._step = step
    arena.poke = filmed_poke
    return films


def one_poke(run, seed):
    """A poke that the model predicts to move something well: what was seen, predicted and then came -> a dict."""
    settings = control.settings_for(run)
    with Arena(settings, np.random.default_rng(seed)) as arena:
        while True:
            arena.new_scene()
            rgb, depth, labels = arena.observe()
            drawn = arena.sample_poke(rgb, depth)
            if drawn is None:
                continue
            scene = control.scene_in(arena, rgb, depth)
            found = predict(run.params, run.recipe.sizes, scene, drawn[0][None])
            flow = found.points[0] - scene.points[0]
            moving = np.linalg.norm(flow, axis=1) > 0.005  # m
            if moving.any() and np.linalg.norm(flow[moving], axis=1).mean() > SEEN:
                break
        photograph, poses = arena.photograph(width=WIDTH), arena.poses()
        films = film_pokes(arena, 10)
        arena.poke(*drawn)
        true = true_scene_flow(scene.points[0].reshape(*labels.shape, 3), labels, poses, arena.poses()).reshape(-1, 3)
        moved = np.linalg.norm(true, axis=1) > 0.001  # m
        error = np.linalg.norm(flow - true, axis=1)[moved].mean()
        return {"camera": arena.camera, "rgb": rgb, "photograph": photograph, "start": drawn[1], "target": drawn[0][:2],
                "film": films[0], "after": arena.photograph(width=WIDTH), "points": scene.points[0], "flow": flow,
                "moving": moving, "masks": found.masks[0], "error": error,
                "motion": np.linalg.norm(true, axis=1)[moved].mean()}


def planned(run, seed):
    """Three objects brought to their goals -> the record of the closed loop, photographs and films with it."""
    with control.random_task(seed, 3, settings=control.settings_for(run)) as task:
        arena = task.arena
        films = film_pokes(arena, 30)
        record = control.closed_loop(task, run, "learned", planning.Search(), 10, seed)
        return {**control.photographed(record, task, WIDTH), "camera": arena.camera, "films": films}


# --- how it looks -------------------------------------------------------------------------------------------------

class Stage:
    """Two pictures side by side on a card, each with a line above it, and one below both; frames are kept."""

    def __init__(self, width, height):  # of the model's pictures, px, in which everything is drawn
        self.view = -0.5, width - 0.5, height - 0.5, -0.5
        self.figure = Figure(figsize=np.array(CANVAS) / 100, dpi=100, facecolor=CARD)
        self.canvas, self.frames, self.seconds = FigureCanvasAgg(self.figure), [], []

    def show(self, seconds, left, right, caption, draw=None):
        """Add a frame. left, right: (picture, line above it); draw(axes, axes): what is drawn over them."""
        self.figure.clear()
        both = []
        for i, (picture, title) in enumerate((left, right)):
            x, (wide, high) = (CANVAS[0] - 10 - WIDTH if i else 10), CANVAS
            axes = self.figure.add_axes((x / wide, 42 / high, WIDTH / wide, HEIGHT / high))
            axes.imshow(picture, interpolation="nearest", extent=self.view, aspect="auto")
            axes.set(xlim=self.view[:2], ylim=self.view[2:])
            axes.axis("off")
            axes.set_title(title, color=INK, fontsize=12)
            both.append(axes)
        self.figure.text(0.5, 0.045, caption, color=DIM, fontsize=11.5, ha="center", va="center")
        if draw:
            draw(*both)
        self.canvas.draw()
        self.frames.append(np.asarray(self.canvas.buffer_rgba())[..., :3].copy())
        self.seconds.append(seconds)

    def save(self, path):
        """Write the frames as a GIF with one palette, whole or not at all."""
        marks = np.uint8(255 * PALETTE)[np.arange(CANVAS[0]) * len(PALETTE) // CANVAS[0]]
        few = [np.tile(marks, (100, 1, 1)), *self.frames[::max(1, len(self.frames) // 10)]]  # small marks keep theirs
        palette = Image.fromarray(np.concatenate(few)).quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
        first, *others = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
                          for frame in self.frames)
        with whole_file(path) as temporary:
            first.save(temporary, save_all=True, append_images=others, loop=0,
                       duration=[round(1000 * each) for each in self.seconds])


def tell_poke(stage, found):
    """One poke: what is seen, asked, predicted and true."""
    camera, before, start, target = (found[name] for name in ("camera", "photograph", "start", "target"))
    arrow, small = on_table([start, target], camera), found["rgb"]
    points, flow, moving = (found[name] for name in ("points", "flow", "moving"))
    masks = found["masks"][:, 1:].reshape(camera.height, camera.width, -1)
    times = len(before) // camera.height  # a mask has the model's pixels, a photograph more
    masked = blend(before / 255, masks.repeat(times, axis=0).repeat(times, axis=1))
    colours = PALETTE[found["masks"][moving, 1:].argmax(axis=1)]
    pixels = project(np.stack([points[moving], (points + flow)[moving]]), camera)  # (2, n, 2)

    def poke(*both):
        for axes in both:
            draw_arrow(axes, *arrow)

    def arrows(axes, other):
        some = (np.rint(pixels[0]) % 3 == 1).all(axis=1)  # every third pixel each way: the masks stay visible
        axes.quiver(*pixels[0, some].T, *(pixels[1] - pixels[0])[some].T, color="black", angles="xy",
                    scale_units="xy", scale=1, width=0.005)
        poke(other)

    def dots(share):
        def draw(axes, _):
            axes.scatter(*(pixels[0] + share * (pixels[1] - pixels[0])).T, c=colours, s=16, edgecolors="black",
                         linewidths=0.4)
        return draw
    gets = f"what the model gets: {camera.width} x {camera.height}, with depth"
    seen = (before, "what the camera sees"), (small, gets)
    stage.show(2.5, *seen, "A robot pokes things to learn how they move. Nobody labels anything.")
    stage.show(2.0, *seen, "It is about to push along the arrow. What will move, and where to?", poke)
    stage.show(3.0, (masked, "predicted: masks (colour), motion (arrows)"), (before, "before"),
               "The model says what moves as one, and where to, from one picture and the poke.", arrows)
    film = [*found["film"], found["after"]]
    for i, picture in enumerate(film):
        share = min(i / (len(film) - 6), 1)  # the last pictures are of rest
        stage.show(0.08, (before, "predicted"), (picture, "what happens"), "The same push, imagined and real.",
                   dots(share))
    stage.show(3.5, (found["after"], "the prediction, over what came"), (found["after"], "what came"),
               f"Off by {100 * found['error']:.1f} cm after a motion of {100 * found['motion']:.1f} cm.", dots(1))


def tell_plan(stage, record):
    """Three objects on their way to their goals: marked points as rings, where they shall be as stars."""
    camera, goals, count = record["camera"], record["goal_marks"], len(record["pokes"])
    marks = project(record["marks"], camera)
    arrows = on_table(np.stack([record["starts"], record["pokes"][:, :2]], axis=1), camera)
    left, films = 100 * record["distance"].mean(axis=1), iter(record["films"])
    goal = record["goal_photograph"], "the goal: a picture"

    def marked(t, arrow=False):
        def draw(axes, other):
            for mark, place in zip(marks[t], goals):
                axes.plot(*np.transpose([mark, place]), ":", color=GOAL, linewidth=1.8, path_effects=OUTLINE)
            axes.plot(*marks[t].T, "o", markersize=10, fillstyle="none", color=GOAL, markeredgewidth=2.2,
                      path_effects=OUTLINE)
            for each in (axes, other):
                each.plot(*goals.T, "*", markersize=12, color=GOAL, markeredgecolor="black")
            if arrow and np.isfinite(arrows[t]).all():
                draw_arrow(axes, *arrows[t])
        return draw
    stage.show(3.0, (record["photographs"][0], "now"), goal, "Rings are to come to the stars.", marked(0))
    for t in range(count):
        caption = f"Poke {t + 1}, planned with the model: {left[t]:.1f} cm to go, on average"
        stage.show(0.7, (record["photographs"][t], "now"), goal, caption, marked(t, True))
        for picture in next(films) if np.isfinite(arrows[t]).all() else ():
            stage.show(0.12, (picture, "now"), goal, caption, lambda _, other: other.plot(
                *goals.T, "*", markersize=12, color=GOAL, markeredgecolor="black"))
    stage.show(4.0, (record["photographs"][count], f"after {count} pokes"), goal,
               f"{left[count]:.1f} cm from the goals, on average; at first it was {left[0]:.1f} cm.", marked(count))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1, help="of the two scenes (1)")
    parser.add_argument("--checkpoint", default=data_small() / "checkpoint.npz", help="the model (the shipped one)")
    parser.add_argument("--out", type=Path, default=OUT, help="a .gif (docs/hero.gif)")
    args = parser.parse_args()
    check_output("--out", args.out, ".gif")
    run = checkpoints.load_run(args.checkpoint)
    stage = Stage(run.meta["camera"]["width"], run.meta["camera"]["height"])
    tell_poke(stage, one_poke(run, args.seed))
    tell_plan(stage, planned(run, args.seed))
    stage.save(args.out)
    print(f"{args.out}: {len(stage.frames)} frames, {sum(stage.seconds):.0f} s, {args.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    try:
        main()
    except (ValueError, RuntimeError, OSError) as error:
        print(f"hero.py: {error}", file=sys.stderr)
        sys.exit(2)
