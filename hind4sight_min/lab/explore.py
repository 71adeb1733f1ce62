"""The explorer: click a target, drag the direction, and what the model thinks follows the mouse. Not in the paper.

It draws on any Matplotlib figure: in a window, in a notebook, or in memory, where a script moves the mouse. What
follows the mouse is drawn alone, over a copy of all the rest ("blitting").
"""
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..course.carve import take_written
from ..course.task import described
from ..disk.checkpoints import load_run
from ..disk.files import check_output, data_small
from ..geometry import Camera, optical_flow, project, rigid
from ..interactions import occupied_grid
from ..losses import chamfer_loss, distance_maps, seen_in_both
from ..networks import predict
from ..planning import SLACK, Search, first_start, goal_of, learned_step, plan, possible_starts, roll, view_of
from ..scene import scene_of
from . import figures
from .cameras import check_camera
from .evaluation import MOVING
from .marks import at_height, follow, places_at, points_at
from .scripts import play
from .worlds import world_of

KEYS = {" ": "poke!  [space]", "n": "next scene  [n]", "u": "undo  [u]", "g": "goals  [g]", "p": "plan  [p]",
        "s": "save  [s]"}
SIZE = 12.4, 7.1  # inches: fits a small laptop
SAME = 0.03  # m; a mark takes the place of one so near


class Explorer:
    """All that happens on an empty figure with a canvas. world: of worlds.py; run: the checkpoint; out: folder
    for saved pictures; yours: names of a student's functions that are at work.

    poke (3,), prediction, flow (H, W, 2) px: what is drawn. scene, view: what the camera sees now, without and with
    marked points; goals (M, 2) px: where these shall go. error: of the last poke carried out, cm. frames: a list to
    film on, or None. Raises ValueError for a camera that cannot show the run its arena.
    """
    keys = KEYS

    def __init__(self, figure, world, run, out=".", yours=()):
        check_camera(world.camera, Camera(**run.meta["camera"]))
        self.figure, self.canvas, self.world, self.run = figure, figure.canvas, world, run
        self.camera, self.settings, self.out, self.yours = world.camera, world.settings, Path(out), yours
        self.art = figures.explorer_panels(figure, self.camera, self.settings, KEYS)
        if yours:
            figure.text(0.99, 0.022, f"yours: {', '.join(yours)}", ha="right", color=figures.TRUE)
        self.rng, self.saved, self.frames, self.held, self.marking = np.random.default_rng(0), 0, None, None, False
        self.refused = None  # the last line that said what cannot be
        if self.canvas.manager:  # Matplotlib's own keys mean something else
            self.canvas.mpl_disconnect(self.canvas.manager.key_press_handler_id)
        for name, action in (("draw", self._drawn), ("button_press", partial(self.attempt, self._press)),
                             ("motion_notify", self._move), ("button_release", self._release),
                             ("key_press", partial(self.attempt, self._key))):
            self.canvas.mpl_connect(f"{name}_event", action)
        self.canvas.draw()
        self.attempt(self.look)
        self.attempt(self.show_scene)

    # --- drawing ---

    def _drawn(self, event):  # the rest has been, perhaps in another size
        if not self.canvas.is_saving():
            self.background = self.canvas.copy_from_bbox(self.figure.bbox)
            self.paint(blit=False)

    def paint(self, blit=True):
        """Put what follows the mouse over a copy of the rest."""
        self.canvas.restore_region(self.background)
        for artist in self.art.live:
            self.figure.draw_artist(artist)
        if blit:
            self.canvas.blit(self.figure.bbox)
        if blit and self.frames is not None:
            self.frames.append(np.array(self.canvas.buffer_rgba())[..., :3])

    def look(self):
        """Look at the world; until `show_scene` the other panels show what was: they are stale."""
        rgb, depth, photograph = self.world.look()
        self.scene = scene_of(depth[None], rgb[None], self.world.empty_depth, self.camera, self.settings["arena"])
        self.set_marks(np.zeros((0, 3)), np.zeros((0, 2)))
        self.stale = True
        self.art.images["camera"].set_data(photograph)

    def show_scene(self):
        """Draw what is looked at in all panels, with a poke to begin with."""
        image, valid = self.scene.images[0], self.scene.valid[0]
        self.art.images["seen"].set_data(image)
        for name in ("truth", "distance"):
            self.art.images[name].set_data(np.full(image.shape[:2], np.nan))
        self.art.points.set(offsets=self.scene.points[0, valid, :2], color=0.45 + 0.55 * image.reshape(-1, 3)[valid])
        self.art.true.set_segments([])
        self.poke, self.stale = self.world.suggested, False
        if self.poke is None:  # one at some object, away from the camera
            objects = self.scene.points[0, self.scene.occupied[0]]
            self.poke = np.float32([*objects[len(objects) // 2, :2], np.pi / 2])
        self.ask()
        self.canvas.draw()

    def ask(self):
        """Ask the model about the poke, and draw what it says."""
        image, points, valid = self.scene.images[0], self.scene.points[0], self.scene.valid[0]
        size, images = image.shape[:2], self.art.images
        self.prediction = predict(self.run.params, self.run.recipe.sizes, self.view.scene, self.poke[None])
        predicted, masks = self.prediction.points[0, :len(points)], self.prediction.masks[0, :len(points)]
        self.flow = (optical_flow(points, predicted, self.camera) * valid[:, None]).reshape(*size, 2)
        depth = np.where(valid, rigid(predicted, self.camera.camera_from_arena)[:, 2], np.inf).reshape(size)
        images["masks"].set_data(figures.blend(image, masks[:, 1:].reshape(*size, -1)))
        images["flow"].set_data(figures.flow_to_rgb(self.flow, figures.SHOWN / self.camera.pixel_size))
        images["predicted"].set_data(figures.next_picture(image, self.flow, depth))
        self.art.predicted.set_segments(figures.scene_flow_lines(points, predicted - points, valid))
        grid = occupied_grid(self.view.cloud[None], self.view.occupied, self.settings)
        start = first_start(possible_starts(self.poke[None], grid, self.settings))[0]
        self.draw_poke(start)
        x, y = np.round(self.poke[:2], 2) + 0.0  # no -0.00
        self.say(f"A poke to ({x:.2f}, {y:.2f}) m at {np.degrees(self.poke[2]):.0f}\u00b0. " + (
            "Space carries it out." if np.isfinite(start).all() else "No room for the finger: a mere guess."))

    def draw_poke(self, start):
        """Draw the poke from its start (2,) m, pale if that is NaN, and the marked points with where they shall go."""
        fits = np.isfinite(start).all()
        ends = np.stack([start if fits else self.poke[:2] - 0.1 * direction(self.poke), self.poke[:2]])
        for arrow, places in zip(self.art.arrows, [*2 * [figures.on_table(ends, self.camera)], ends]):
            arrow.set_positions(*places)
            arrow.set_alpha(1.0 if fits else 0.35)
        marks = project(self.view.marks, self.camera)
        self.art.rings.set_data(*marks.T)
        self.art.stars.set_data(*self.goals.T)
        self.art.ways.set_data(*np.stack([marks, self.goals, marks + np.nan], axis=1).reshape(-1, 2).T)
        for lines in (self.art.others, self.art.elites):
            lines.set_segments([])

    def say(self, text):
        """Write one line under the pictures."""
        self.art.text.set_text(text)

    # --- what mouse and keys do ---

    def attempt(self, action, *given):
        """Do it and draw. What cannot be is said in a line, as is what is wrong with a student's code."""
        try:
            action(*given)
        except (Exception, SystemExit) as error:
            if not (self.yours or isinstance(error, (ValueError, OSError))):
                raise
            self.refused = described(error) if self.yours else str(error)
            self.say(self.refused)
        self.paint()

    def _press(self, event):
        for key, text in self.art.buttons.items():
            if text.contains(event)[0]:
                self.act(key)
        if event.inaxes is self.art.axes["camera"]:
            if self.stale:
                self.show_scene()
            action, place = self.mark if self.marking or event.button == 3 else self.aim, [event.xdata, event.ydata]
            self.held = partial(self.attempt, action, np.array(place))
            self._move(event)

    def _move(self, event):
        if self.held and event.inaxes is self.art.axes["camera"]:
            self.held(np.array([event.xdata, event.ydata]))

    def _release(self, event):
        self._move(event)
        self.held = None

    def _key(self, event):
        if event.key in KEYS:
            self.act(event.key)

    def act(self, key):
        """What a key of KEYS does, and the button of its name."""
        if key == "u" and not self.world.history:
            raise ValueError("There is no poke to take back.")
        if key in "nu":
            (self.world.next if key == "n" else self.world.undo)()
            self.look()
        if self.stale and key != "s":
            self.show_scene()
        if key in (actions := {" ": self.carry_out, "p": self.plan, "s": self.save}):
            actions[key]()
        if key == "g":
            self.marking = not self.marking
            self.say("Drag objects to where they shall go; g again: pokes. The right mouse button always does this."
                     if self.marking else "Click where the finger shall stop, drag the way it pushes.")

    def aim(self, place, to):
        """The poke whose target is seen at pixel `place` (2,), in the direction of pixel `to`; a click keeps that."""
        column, row = np.rint(place).astype(int)
        point = self.scene.points[0, row * self.camera.width + column]
        along = at_height(to[None], point[2:], self.camera)[0] - point[:2]
        turned = np.abs(to - place).max() > 1  # px
        self.poke = np.float32([*point[:2], np.arctan2(along[1], along[0]) if turned else self.poke[2]])
        self.ask()

    def mark(self, place, to):
        """Mark the point of an object at pixel `place` (2,), which shall go to pixel `to`."""
        point = points_at(place[None], self.scene, self.camera)
        far = np.linalg.norm(places_at(to[None], point[:, 2], self.camera, self.settings) - point[:, :2])
        others = np.linalg.norm(self.view.marks - point, axis=1) > SAME
        self.set_marks(np.vstack([self.view.marks[others], point]), np.vstack([self.goals[others], to]))
        self.ask()
        self.say(f"{len(self.goals)} to move, this one by {100 * far:.0f} cm. p plans.")

    def set_marks(self, marks, goals):
        """Marked points (M, 3) m, and the pixels (M, 2) where they shall go."""
        self.view, self.goals = view_of(self.scene, marks), goals

    def carry_out(self):
        """Poke, and show what is true beside what was predicted."""
        scene, view, goals = self.scene, self.view, self.goals
        asked = self.poke
        self.poke, start, true = self.world.poke(view, self.poke)
        self.ask()
        self.look()
        points, predicted, after = scene.points, self.prediction.points[:, :scene.points.shape[1]], self.scene
        kept, next_kept = seen_in_both(scene.valid, after.valid, scene.occupied, after.occupied)
        maps, still = (distance_maps(each, after.points, kept, next_kept) for each in (predicted, points))
        self.art.images["truth"].set_data(after.images[0])
        self.art.images["distance"].set_data(100 * np.sqrt(maps[0]).reshape(scene.images.shape[1:3]))
        said = (f"Chamfer distance (Eq. 2), a sum: {1e4 * chamfer_loss(*maps)[0]:.0f} cm\u00b2; of no motion "
                f"{1e4 * chamfer_loss(*still)[0]:.0f}.")
        if true is not None:
            self.art.true.set_segments(figures.scene_flow_lines(points[0], true, scene.valid[0]))
            length, error = 100 * np.linalg.norm([true, predicted[0] - points[0] - true], axis=2)  # cm
            moving = scene.valid[0] & (length > 100 * MOVING)
            self.error = error[moving if moving.any() else scene.valid[0]].mean()
            said = (f"The points moved {length[moving].mean():.1f} cm" if moving.any() else "Nothing moved") + (
                f", the prediction is off by {self.error:.1f} cm. {said}")
        if len(goals):
            self.set_marks(follow(view, self.prediction, after), goals)
            left = at_height(goals, self.view.marks[:, 2], self.camera) - self.view.marks[:, :2]
            said = f"{100 * np.linalg.norm(left, axis=1).mean():.1f} cm to go. {said}"
        self.draw_poke(start)
        self.say(said if asked is self.poke else f"Recorded, no simulator. {said}")
        self.canvas.draw()

    def plan(self):
        """Find a poke by the cross entropy method; its candidates are drawn as they narrow, round by round."""
        if not len(self.goals):
            raise ValueError("Nothing to plan for: with the right mouse button drag an object to where it shall go.")
        search = Search(chamfer_weight=0.0)  # there is no picture of the goal

        def show(iteration, population, costs, mean, deviation):
            pokes = population[np.argsort(costs), 0]
            ends = pokes[:, :2] - 0.04 * direction(pokes), pokes[:, :2]
            lines = figures.arrow_lines(*figures.on_table(ends, self.camera))
            self.art.elites.set_segments(lines[:search.elites])
            self.art.others.set_segments(lines[search.elites:])
            self.art.arrows[0].set_alpha(0)
            self.say(f"CEM, round {iteration + 1} of {search.iterations}: the model is asked about {len(pokes)} pokes. "
                     f"Around the best {search.elites}, yellow, the next are drawn. Lowest cost {costs.min():.2f} cm.")
            self.paint()
            self.canvas.flush_events()
        rollout = partial(roll, learned_step(self.run, self.view), self.view, settings=self.settings)
        found = plan(rollout, self.view, goal_of(self.goals), self.camera, self.settings, search, self.rng, show)
        self.poke = found.pokes[0]
        self.ask()
        self.say(f"Plan: cost {found.now:.2f}, after this poke {found.cost:.2f} (cm beyond {100 * SLACK}, predicted).")

    def save(self):
        """Save the figure as a picture."""
        self.saved += 1
        path = self.out / f"explore_{self.saved}.png"
        figures.save_figure(self.figure, path)
        self.say(f"Saved as {path}")


def direction(pokes):
    """The unit vectors (..., 2) along pokes (..., 3)."""
    return np.stack([np.cos(pokes[..., 2]), np.sin(pokes[..., 2])], axis=-1)


# --- the command --------------------------------------------------------------------------------------------------

def explore(checkpoint=None, data=None, seed=0, mine=(), out=".", figure=None):
    """An Explorer -> it, which is to be kept. Arguments as the command's; figure: an empty one with a canvas.

    Not in the paper. Without a figure it opens a window, or in a notebook, after `%matplotlib widget`, a picture that
    minds the mouse. Raises RuntimeError where it can do neither.
    """
    run = load_run(checkpoint or data_small() / "checkpoint.npz")
    world = world_of(run, data, seed)
    if figure is None:
        import matplotlib.pyplot as plt
        with rc_context({"toolbar": "None"}):
            figure = plt.figure("hind4sight explore", figsize=SIZE)
        if plt.get_backend().lower() == "agg":
            raise RuntimeError("no window can be opened here; --script FILE and --demo OUT.gif need none")
    try:
        yours = [name for folder in mine or () for name in take_written(folder)]
        return Explorer(figure, world, run, out, yours)
    except (Exception, SystemExit) as error:
        if not mine or described(error) == f"ValueError: {error}":  # not the student's
            raise
        raise ValueError(f"mine: {described(error)}") from None


def run_explore(args):
    """`hind4sight explore`."""
    given = args.checkpoint, args.data, args.seed, args.mine, args.out
    if not args.script and not args.demo:
        import matplotlib.pyplot as plt
        explorer = explore(*given)
        plt.show()
        return explorer
    check_output("--demo", args.demo or "none.gif", ".gif")
    explorer = explore(*given, FigureCanvasAgg(Figure(SIZE, dpi=75)).figure)
    explorer.frames = [] if args.demo else None
    play(explorer, (Path(args.script).read_text() if args.script else explorer.world.demo).splitlines())
    if args.demo:
        figures.save_film(args.demo, explorer.frames, 0.1)
        print(f"{args.demo}: {len(explorer.frames) / 10:.0f} s")
    if args.script and explorer.refused:  # nobody may have been looking
        raise ValueError(f"script: {explorer.refused}")
