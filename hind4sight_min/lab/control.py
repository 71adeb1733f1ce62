"""The control experiment: tasks with a start and a goal, the closed loop, and the planners it is measured against.

Paper: Sec. IV-G. The simulator's truth sets the goals and measures. Planners go by pictures alone, but for the oracle,
which tries its pokes out in the simulator. One thing they are all told that no picture shows: before the finger comes
down, Bullet is asked whether its way is free (`carry_out`). The first start of a poke where it is gets used; where it
is nowhere free, the poke is spent.
"""
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .. import check_whole
from ..geometry import Camera, project, unproject
from ..interactions import occupied_grid
from ..networks import predict
from ..planning import (SLACK, NoPoke, Plan, View, draw_pokes, first_start, goal_of, learned_step, moved_scene, plan,
                        possible_starts, roll, view_of)
from ..scene import scene_of
from ..sim.arena import MIDDLE, Arena, Settings
from ..sim.truth import true_scene_flow
from .cameras import check_camera
from .marks import follow, places_at, points_at

SETTINGS = Settings(**{**MIDDLE, "place_within": 0.56})  # so that the finger gets behind every object
IN_THE_WAY = 0.5  # of both radii: how far beside the straight way the middle of an obstacle lies
FAR = (0.08, 0.14)  # m; how far a goal is from its object's place
NEAR = 2.0  # cost below which places are right and turns are left, about
GAIN = 0.01  # in units of the cost; a poke that is predicted to bring less is not worth its risk
SLOW = 0.1  # a plan must end below the lowest cost yet by this share of it, or a longer one is looked for
AHEAD = 3  # pokes: of two objects that swap one makes room, the other comes, the first follows
TRIES = 32  # pokes of which a sequence that is drawn takes the best as its next
CLEAR = 0.015, 0.02  # m; what passes nearer by something else pushes it; the second where a mark shall stay
PASSES = 0.05, 0.03  # share of the points that move that may be predicted to do so
STAYS = 0.002  # m; a mark that shall stay may be predicted to move so far
KEEP_OFF = 0.05  # m; no nearer to it may the finger's target be
TURN = np.pi / 4  # rad; goals are turned by at most this
POLICIES = ("learned", "oracle", "no_motion", "random", "greedy")


# --- tasks --------------------------------------------------------------------------------------------------------

def settings_for(run, settings=SETTINGS):
    """Settings, those of the test scenes, in pictures of the size that a run was trained with if they are 4:3."""
    width, height = run.meta["camera"]["width"], run.meta["camera"]["height"]
    return replace(settings, width=width, height=height) if 3 * width == 4 * height else settings


@dataclass
class Task:
    """A scene in its arena and a goal.

    movers, marked (M,): which objects are to move, and which have a marked point: those, perhaps one that shall stay.
    marks, goal_marks (M, 2) px: where these points are and shall be. goal: (rgb, depth) of the goal, or None where the
    user only said where the marks shall go. goal_poses (7, 7): as Arena.poses; truth, to measure by.
    """
    arena: Arena
    movers: np.ndarray
    marked: np.ndarray
    marks: np.ndarray
    goal_marks: np.ndarray
    goal_poses: np.ndarray
    goal: tuple = None

    @property
    def settings(self):
        """The arena's Settings as a dict."""
        return vars(self.arena.settings)

    @property
    def stays(self):
        """(M,) bool: marked points that shall be where they are."""
        return np.linalg.norm(self.goal_marks - self.marks, axis=1) * self.arena.camera.pixel_size < SLACK


@contextmanager
def random_task(seed, movers, obstacle=False, settings=SETTINGS):
    """The fixed test task of a seed: three or four objects, `movers` of them to be moved by 8 to 14 cm and turned.

    obstacle: one object to be moved by 18 cm, and another one half-way, across half of it, that is marked to stay.
    Draws scenes until the goal is one that the objects can be in: apart from each other, in sight, inside the walls.
    """
    if obstacle and movers != 1:
        raise ValueError(f"movers: expected 1 with an obstacle, got {movers}")
    check_whole("seed", seed, 0)
    rng = np.random.default_rng([seed, movers, obstacle])
    with Arena(settings, rng) as arena:
        for _ in range(200):
            arena.new_scene()
            task = _draw_goal(arena, movers, obstacle, rng)
            if task:
                yield task
                return
        raise ValueError(f"task: no scene for {movers} objects to move was found")


def _draw_goal(arena, movers, obstacle, rng):
    """A Task for the scene that stands in the arena, or None where the goal that was drawn cannot be."""
    if obstacle and not _line_up(arena, rng):
        return None
    start, poses = arena.bullet.saveState(), arena.poses()
    chosen = np.arange(1) if obstacle else rng.permutation(len(arena.bodies))[:movers]
    if len(chosen) < movers or not _set_goal(arena, chosen, rng, -poses[0, :2] if obstacle else None):
        return None
    (rgb, depth, labels), goal_poses = arena.observe(), arena.poses()
    arena.bullet.restoreState(start)
    _, depth_now, labels_now = arena.observe()
    if any(np.sum(picture == i + 1) < 12 for picture in (labels, labels_now) for i in range(len(arena.bodies))):
        return None  # hardly in sight
    marked = np.append(chosen, 1) if obstacle else chosen
    marks = np.array([_mark(labels_now, depth_now, arena.camera, i) for i in marked])
    points = unproject(depth_now, arena.camera)[marks[:, 1], marks[:, 0]]
    there = points + true_scene_flow(points, marked + 1, poses, goal_poses)
    goal_marks = project(there, arena.camera)
    return Task(arena, chosen, marked, marks, goal_marks, goal_poses, (rgb, depth))


def marked_task(task, marks, goal_marks):
    """The scene of a task with marks and goals of the user's own, (M, 2) px each -> Task without a goal picture.

    Raises ValueError for marks that are not on objects and goals outside the walls, which no object can reach.
    """
    arena = task.arena
    rgb, depth, labels = arena.observe()
    points = points_at(marks, scene_in(arena, rgb, depth), arena.camera)
    there = places_at(goal_marks, points[:, 2], arena.camera, task.settings)
    marks, goal_poses = np.rint(marks).astype(int), arena.poses()
    movers = labels[marks[:, 1], marks[:, 0]].astype(int) - 1
    goal_poses[movers, :2] += there - points[:, :2]
    return Task(arena, movers, movers, marks, np.asarray(goal_marks, np.float32), goal_poses)


def _line_up(arena, rng):
    """Put object 0 on one side, object 1 half across the way to the other; are all others out of the way?"""
    angle = rng.uniform(-np.pi, np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    beside = np.array([-along[1], along[0]]) * rng.choice([-1, 1]) * sum(arena.radii[:2]) * IN_THE_WAY
    arena.put(0, 0.09 * along)
    arena.put(1, beside)
    others = arena.poses()[2:len(arena.bodies), :2]
    apart = np.linalg.norm(others[:, None] - [0.09 * along, beside, -0.09 * along], axis=2).min(initial=1)
    return apart > 0.09 and sum(arena.radii[:2]) < 0.085 and arena.settle()


def _set_goal(arena, movers, rng, opposite=None):
    """Put the movers where they shall be -> whether they can stand there."""
    half, poses = arena.settings.arena / 2 * arena.settings.place_within, arena.poses()
    places = {i: pose[:2] for i, pose in enumerate(poses[:len(arena.bodies)]) if i not in movers}
    for i in movers:
        for _ in range(50):
            angle, length = rng.uniform(-np.pi, np.pi), rng.uniform(*FAR)
            xy = poses[i, :2] + length * np.array([np.cos(angle), np.sin(angle)]) if opposite is None else opposite
            if np.abs(xy).max() < half and all(np.linalg.norm(xy - place) > arena.radii[i] + arena.radii[j] + 0.01
                                               for j, place in places.items()):
                break
        else:
            return False
        places[i] = xy
        arena.put(i, xy, rng.uniform(-TURN, TURN))
    wanted = [places[i] for i in sorted(places)]
    return arena.settle() and np.abs(arena.poses()[:len(places), :2] - wanted).max() < 0.01


def _mark(labels, depth, camera, index):
    """The pixel (x, y) a user would mark on an object: of its top, the one nearest to the middle."""
    rows, columns = np.nonzero(labels == index + 1)
    points = unproject(depth, camera)[rows, columns]
    top = points[:, 2] > points[:, 2].max() - 0.006
    away = np.linalg.norm(points[:, :2] - points[top, :2].mean(axis=0), axis=1) + 10 * ~top
    return np.array([columns[away.argmin()], rows[away.argmin()]])


# --- planners -----------------------------------------------------------------------------------------------------

def oracle_rollout(arena, view, labels, settings):
    """The simulator as a rollout: every sequence is carried out, and undone. labels (N + M,): truth."""
    start, poses = arena.bullet.saveState(), arena.poses()

    def step(clouds, pokes):
        place = first_start(possible_starts(pokes, occupied_grid(clouds, view.occupied, settings), settings))[0]
        if np.isfinite(place).all():
            arena.poke(pokes[0], place)
        return (view.cloud + true_scene_flow(view.cloud, labels, poses, arena.poses()))[None]

    def rollout(sequences):
        found = []
        for sequence in sequences:
            arena.bullet.restoreState(start)
            found.append(roll(step, view, sequence[None], settings))
        arena.bullet.restoreState(start)
        return tuple(np.concatenate(each) for each in zip(*found))
    return rollout


def careful(rollout, view, stays):
    """A rollout without the plans that would push more than they say: their starts are NaN. Not in the paper.

    The model sees what the finger meets, less well what that meets in turn. So hardly anything may be predicted to
    `pass_through` something else, and no mark that stays, (M,) bool, to move by more than STAYS; nor is what it marks
    poked, for small pokes are foreseen worst.
    """
    def checked(sequences):
        clouds, starts = rollout(sequences)
        clear, passes = CLEAR[any(stays)], PASSES[any(stays)]
        before = np.concatenate([np.repeat(view.cloud[None, None], len(clouds), axis=0), clouds[:, :-1]], axis=1)
        marks = np.flatnonzero(stays) + len(view.cloud) - view.marked
        near = np.linalg.norm(sequences[:, :, None, :2] - view.cloud[marks, :2], axis=3) < KEEP_OFF
        refused = (near | (np.linalg.norm((clouds - before)[:, :, marks], axis=3) > STAYS)).any(axis=2)
        for which in np.argwhere(~refused):
            here, there = (each[tuple(which)][view.occupied, :2] for each in (before, clouds))
            refused[tuple(which)] = pass_through(here, there, clear) > passes
        return clouds, np.where(refused[..., None], np.nan, starts)
    return checked


def pass_through(before, after, clear):
    """Of the points that move: the share that on its way comes nearer than `clear` m to the place of a point that goes
    less than half as far. before, after (n, 2) m, on the plane of the arena -> a number.
    """
    length = np.linalg.norm(after - before, axis=1)
    moves = length > clear
    if not moves.any():
        return 0.0
    way = [before[moves] + part * (after - before)[moves] for part in (1 / 3, 2 / 3, 1)]
    distance, nearest = cKDTree(before).query(np.stack(way))
    return np.mean((distance < clear) & (length[nearest] < length[moves] / 2))


def greedy_poke(view, goal, camera, settings, rng):
    """Push the mark that is farthest from its goal straight at it -> a sequence of one poke (1, 3)."""
    marks = view.marks.astype(float)
    away = places_at(goal.pixels, marks[:, 2], camera, settings) - marks[:, :2]
    far = np.linalg.norm(away, axis=1).argmax()
    length = np.linalg.norm(away[far])
    target = marks[far, :2] + away[far] / length * min(0.02, length - 0.03)
    grid = occupied_grid(view.cloud[None], view.occupied, settings)
    for turn in np.radians([0, 15, -15, 30, -30, 45, -45]):
        poke = np.float32([[*target, np.arctan2(away[far, 1], away[far, 0]) + turn]])
        if np.isfinite(possible_starts(poke, grid, settings)).any():
            return poke
    return draw_pokes(rng, 1, view, settings)[0]


def draw_sequences(cost, rng, rollout, view, settings, search, rest):
    """A first population for CEM, (J, H, 3), grown poke by poke: the first as `draw_pokes` gives it, every next one the
    best of TRIES in the scene where those before led; a sequence after which the finger finds no room is dropped. And
    `rest`, if it has H pokes.

    Not in the paper: of sequences drawn at once hardly one makes room for an object and brings it there. It costs
    10,000 pokes where H is 3 and J 64; all of CEM 256 where H is 1.
    """
    def longer(sequence):  # -> a list of one, or none where the finger then finds no room
        there = View(moved_scene(view, rollout(sequence[None])[0][:, -1]), view.marked)
        try:
            following = draw_pokes(rng, TRIES, there, settings)
        except NoPoke:
            return []
        tried = np.concatenate([np.repeat(sequence[None], TRIES, axis=0), following], axis=1)
        return [tried[np.argmin(cost(tried))]]

    sequences = draw_pokes(rng, search.candidates, view, settings)
    for _ in range(search.horizon - 1):
        sequences = [each for sequence in sequences for each in longer(sequence)]
    if len(rest) == search.horizon:
        sequences = [rest, *sequences]
    if not len(sequences):
        raise NoPoke(f"plan: no room for {search.horizon} pokes in a row")
    return np.stack(sequences)


def next_plan(policy, task, view, labels, goal, run, rng, search, rest=()):
    """What a planner would do now -> planning.Plan; costs of NaN where it has none. labels (H, W): for the oracle.
    rest (n, 3): what is left of the plan before.
    """
    arena, settings = task.arena, task.settings
    if policy in ("random", "greedy"):
        pokes = (draw_pokes(rng, 1, view, settings)[0] if policy == "random"
                 else greedy_poke(view, goal, arena.camera, settings, rng))
        return Plan(pokes, np.nan, np.nan)

    def planned(rollout):
        return plan(rollout, view, goal, arena.camera, settings, search, rng, draw=partial(
            draw_sequences, rng=rng, rollout=rollout, view=view, settings=settings, search=search, rest=rest))

    if policy == "oracle":
        return planned(oracle_rollout(arena, view, np.append(labels.ravel(), task.marked + 1), settings))
    step = learned_step(run, view) if policy == "learned" else lambda clouds, pokes: clouds
    rollout = partial(roll, step, view, settings=settings)
    if policy == "learned":
        try:
            return planned(careful(rollout, view, task.stays))
        except NoPoke:
            pass  # then without care
    return planned(rollout)


def choose_plan(ask, search, ahead, rest, lowest, left):
    """The Plan to follow: of those that are tried the one that gains most per poke. Not in the paper.

    Tried in turn, until one is enough: as many pokes as `rest`, what the last plan has left; as many as `search` says;
    and, unless the goal is near, `ahead`; none longer than `left`, the budget. Enough: it ends below `lowest`, the
    lowest cost yet, by SLOW of it. ask: (search, rest) -> Plan, `next_plan`. Raises NoPoke where none finds any.
    """
    plans = []
    for horizon in dict.fromkeys(min(pokes, left) for pokes in (len(rest), search.horizon, ahead)):
        last = plans[-1] if plans else None
        enough = last and not last.cost > (1 - SLOW) * min(lowest, last.now)  # where there are no costs, any is
        near = last and last.now <= NEAR
        if not horizon or enough or near and horizon > search.horizon:
            continue
        try:
            plans.append(ask(replace(search, horizon=horizon), rest))
        except NoPoke as none:
            reason = none
    if not plans:
        raise reason
    return max(plans, key=lambda plan: (plan.now - plan.cost) / len(plan.pokes))


# --- the closed loop ----------------------------------------------------------------------------------------------

def scene_in(arena, rgb, depth):
    """One picture of an arena -> Scene."""
    return scene_of(depth[None], rgb[None], arena.empty_depth, arena.camera, arena.settings.arena)


def first_look(task):
    """A task as the robot meets it -> (rgb, depth, labels) of Arena.observe, planning.View, planning.Goal."""
    observed = task.arena.observe()
    scene = scene_in(task.arena, *observed[:2])
    view = view_of(scene, points_at(task.marks, scene, task.arena.camera))
    return observed, view, goal_of(task.goal_marks, task.goal and scene_in(task.arena, *task.goal))


def carry_out(arena, view, poke, settings):
    """Poke (3,) from the first start that pictures allow and Bullet finds free -> that start (2,) m, NaN if none is."""
    starts = possible_starts(poke[None], occupied_grid(view.cloud[None], view.occupied, settings), settings)[0]
    for start in starts[np.isfinite(starts[:, 0])]:
        if arena.descent_is_free(*start):
            arena.poke(poke, start)
            return start
    return np.full(2, np.nan)


def distances(poses, task):
    """How far the movers are from their goals: places in m, (M,), and orientations about the vertical in rad, (M,), NaN
    for round ones.
    """
    here, there = poses[task.movers], task.goal_poses[task.movers]
    turn = (Rotation.from_quat(here[:, 3:]) * Rotation.from_quat(there[:, 3:]).inv()).as_matrix()
    angle = np.abs(np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1]))
    angle[[task.arena.round[i] for i in task.movers]] = np.nan
    return np.linalg.norm(here[:, :2] - there[:, :2], axis=1), angle


def closed_loop(task, run, policy, search, budget=10, seed=0, ahead=AHEAD):
    """Observe, plan, poke, until no poke is predicted to help or the budget is spent -> a dict.

    policy: one of POLICIES. run: the checkpoint; it also says where marked points went, whatever the policy. ahead:
    how many pokes to plan in a row where one hardly helps, see `choose_plan`; where a mark shall stay, `search.horizon`
    instead, for to look further took 20 s and moved what stays as often.
    stopped: why it ended, a sentence. Of T pokes: rgb (T+1, H, W, 3), poses (T+1, 7, 7), marks (T+1, M, 3) m as
    followed, distance (T+1, M) m, angle (T+1, M) rad; pokes (T, 3), starts (T, 2) m, NaN where the finger found no
    room; and of the task movers, goal_marks, goal_rgb. Raises ValueError for a camera that cannot show the run its
    arena, and NoPoke where not even the first poke is possible; later on that ends the loop, as an empty arena does.
    """
    if policy not in POLICIES:
        raise ValueError(f"policy: expected one of {', '.join(POLICIES)}, got {policy!r}")
    check_whole("budget", budget, 1, 1000)
    arena, rng = task.arena, np.random.default_rng(seed)
    check_camera(arena.camera, Camera(**run.meta["camera"]))
    (rgb, depth, labels), view, goal = first_look(task)
    states, pokes, starts = [(rgb, arena.poses(), view.marks, *distances(arena.poses(), task))], [], []
    ahead = search.horizon if task.stays.any() else ahead
    stopped, rest, lowest = f"the budget of pokes, {budget}, is spent", [], np.inf
    while len(pokes) < budget:
        try:
            ask = partial(next_plan, policy, task, view, labels, goal, run, rng)
            found = choose_plan(ask, search, ahead, rest, lowest, budget - len(pokes))
        except NoPoke as none:
            if not pokes:
                raise
            stopped = str(none)
            break
        if found.cost > found.now - GAIN:
            stopped = f"no poke would help, the model says; what is left costs {found.now:.2f}"
            break
        pokes.append(found.pokes[0])
        starts.append(carry_out(arena, view, pokes[-1], task.settings))
        rest, lowest = [], min(lowest, found.now)
        (rgb, depth, labels), marks = arena.observe(), view.marks
        scene = scene_in(arena, rgb, depth)
        if np.isfinite(starts[-1]).all():  # else the poke is spent, and its plan with it
            rest = found.pokes[1:]
            marks = follow(view, predict(run.params, run.recipe.sizes, view.scene, pokes[-1][None]), scene)
        states.append((rgb, arena.poses(), marks, *distances(arena.poses(), task)))
        if not scene.occupied.any():
            stopped = "the last object has left the arena"
            break
        view = view_of(scene, marks)
    record = dict(zip(("rgb", "poses", "marks", "distance", "angle"), map(np.stack, zip(*states))))
    return {**record, "stopped": stopped, "pokes": np.float32(pokes).reshape(-1, 3),
            "starts": np.float32(starts).reshape(-1, 2), "movers": task.movers, "goal_marks": task.goal_marks,
            **({"goal_rgb": task.goal[0]} if task.goal else {})}


def photographed(record, task, width=384):
    """The record of a closed loop with "photographs" of its states and, where it has a goal, a "goal_photograph".

    Not in the paper. The task's arena still holds its objects; width: of a photograph, px.
    """
    goal = {"goal_photograph": task.arena.photograph(task.goal_poses, width)} if task.goal else {}
    return {**record, **goal, "photographs": [task.arena.photograph(poses, width) for poses in record["poses"]]}
