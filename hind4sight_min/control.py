"""Planning in the simulator: tasks with a start and a goal, the closed loop, and the planners it is measured against.

Paper: Sec. IV-G. This file reads the simulator's truth to set goals and to measure; the planner sees pictures alone
(but for the oracle, which tries its pokes out in the simulator itself).
"""
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from . import check_whole, planning
from .geometry import project, unproject
from .interactions import load_npz, rotation_from_quaternion, save_npz, true_scene_flow
from .simulator import Arena, Settings
from .training import check_camera

FORMAT = "hind4sight_min plan 1"
SETTINGS = Settings(place_within=0.56)  # so that the finger gets behind every object
IN_THE_WAY = 0.5  # of both radii: how far beside the straight way the middle of an obstacle lies
FAR = (0.08, 0.14)  # m; how far a goal is from its object's place
REACHED = 0.4  # cost below which the goal counts as reached: less than followed marks and pixels can tell
GAIN = 0.05  # of the cost; a poke that is predicted to bring less is not worth its risk
TURN = np.pi / 4  # rad; goals are turned by at most this
POLICIES = ("learned", "oracle", "no_motion", "random", "greedy")


# --- tasks ----------------------------------------------------------------------------------------------------------

@dataclass
class Task:
    """A scene in its arena and a goal. movers: which objects are to move, indices, to measure by.

    marked (M,): the objects that a point is marked on, those and perhaps others that shall stay. marks (M, 2) px.
    goal_marks (M, 2) px: the same points in the goal picture. goal_poses (7, 7): as Arena.poses; truth, to measure by.
    goal: (rgb, depth) of the goal, or None where the user only said where the marks shall go.
    """
    arena: Arena
    movers: np.ndarray
    marked: np.ndarray
    marks: np.ndarray
    goal_marks: np.ndarray
    goal_poses: np.ndarray
    goal: tuple = None


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
            if obstacle and not _line_up(arena, rng):
                continue
            start, poses = arena.snapshot(), arena.poses()
            chosen = np.arange(1) if obstacle else rng.permutation(len(arena.bodies))[:movers]
            if len(chosen) == movers and _set_goal(arena, chosen, rng, -poses[0, :2] if obstacle else None):
                (rgb, depth, labels), goal_poses = arena.observe(), arena.poses()
                arena.restore(start)
                _, depth_now, labels_now = arena.observe()
                seen = [min(np.sum(labels == i + 1), np.sum(labels_now == i + 1)) for i in range(len(arena.bodies))]
                if min(seen) >= 12:
                    marked = np.append(chosen, 1) if obstacle else chosen
                    marks = np.array([_mark(labels_now, depth_now, arena.camera, i) for i in marked])
                    points = unproject(depth_now, arena.camera)[marks[:, 1], marks[:, 0]]
                    goal_marks = project(_carried(points, marked, poses, goal_poses), arena.camera)
                    yield Task(arena, chosen, marked, marks, goal_marks, goal_poses, (rgb, depth))
                    return
        raise ValueError(f"task: no scene for {movers} objects to move was found")


def marked_task(task, marks, goal_marks):
    """The scene of a task with marks and goals of the user's own, (M, 2) px each -> Task without a goal picture.

    Raises ValueError for marks that are not on objects and goals outside the walls, which no object can reach.
    """
    arena, settings = task.arena, asdict(task.arena.settings)
    _, depth, labels = arena.observe()
    points = planning.points_at(marks, depth, arena.empty_depth, arena.camera, settings)
    there = planning.places_at(goal_marks, points[:, 2], arena.camera, settings)
    marks = np.rint(marks).astype(int)
    movers = labels[marks[:, 1], marks[:, 0]].astype(int) - 1
    goal_poses = arena.poses()
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


def _carried(points, movers, before, after):
    """Points (M, 3) on the movers, carried along from their poses `before` to those `after`."""
    labels = np.asarray(movers) + 1
    return (points + true_scene_flow(np.asarray(points, np.float64), labels, before, after)).astype(np.float32)


# --- planners -------------------------------------------------------------------------------------------------------

def oracle_rollout(arena, view, labels, settings):
    """The simulator as a rollout: every sequence is carried out, and undone. labels (N + M,): truth."""
    start, poses = arena.snapshot(), arena.poses()

    def rollout(sequences):
        clouds = np.repeat(view.cloud[None, None], sequences.shape[1], axis=1).repeat(len(sequences), axis=0)
        starts = np.full(sequences.shape[:2] + (2,), np.nan)
        for j, sequence in enumerate(sequences):
            arena.restore(start)
            cloud = view.cloud
            for h, poke in enumerate(sequence):
                grid = planning.occupied_grid(cloud[None], view.occupied, settings)
                starts[j, h] = planning.first_start(planning.possible_starts(poke[None], grid, settings))[0]
                if np.isnan(starts[j, h]).any():
                    break
                arena.poke(poke, starts[j, h])
                cloud = view.cloud + true_scene_flow(view.cloud, labels, poses, arena.poses())
                clouds[j, h:] = cloud
        arena.restore(start)
        return clouds, starts
    return rollout


def greedy_poke(view, goal, camera, settings, rng):
    """Push the mark that is farthest from its goal straight at it -> a sequence of one poke (1, 3)."""
    marks = view.cloud[-view.marked:].astype(float)
    there = planning.places_at(goal.pixels, marks[:, 2], camera, settings)
    away = there - marks[:, :2]
    far = np.linalg.norm(away, axis=1).argmax()
    length = np.linalg.norm(away[far])
    target = marks[far, :2] + away[far] / length * min(0.02, length - 0.03)
    grid = planning.occupied_grid(view.cloud[None], view.occupied, settings)
    for turn in np.radians([0, 15, -15, 30, -30, 45, -45]):
        poke = np.float32([[*target, np.arctan2(away[far, 1], away[far, 0]) + turn]])
        if np.isfinite(planning.possible_starts(poke, grid, settings)).any():
            return poke
    return planning.draw_pokes(rng, 1, view, settings)[0]


# --- the closed loop ------------------------------------------------------------------------------------------------

def distances(poses, task):
    """How far the movers are from their goals: places in m, (M,), and orientations about the vertical in rad, (M,), NaN
    for round ones.
    """
    here, there = poses[task.movers], task.goal_poses[task.movers]
    turn = np.einsum("mij,mkj->mik", rotation_from_quaternion(here[:, 3:]), rotation_from_quaternion(there[:, 3:]))
    angle = np.abs(np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1]))
    angle[[task.arena.kinds[i] == "can" for i in task.movers]] = np.nan
    return np.linalg.norm(here[:, :2] - there[:, :2], axis=1), angle


def first_look(task):
    """A task as the robot meets it -> (rgb, depth, labels) of Arena.observe, planning.View, planning.Goal."""
    arena, settings = task.arena, asdict(task.arena.settings)
    rgb, depth, labels = arena.observe()
    marks = planning.points_at(task.marks, depth, arena.empty_depth, arena.camera, settings)
    view = planning.view_of(depth, arena.empty_depth, arena.camera, settings, marks)
    goal = planning.goal_of(task.goal_marks, arena.camera, settings, task.goal and task.goal[1], arena.empty_depth)
    return (rgb, depth, labels), view, goal


def next_poke(policy, task, view, labels, goal, run, search, rng, on_iteration=None):
    """What a planner would do now -> planning.Plan; costs of NaN where it has none."""
    arena, settings = task.arena, asdict(task.arena.settings)
    if policy in ("random", "greedy"):
        pokes = (planning.draw_pokes(rng, 1, view, settings)[0] if policy == "random"
                 else greedy_poke(view, goal, arena.camera, settings, rng))
        return planning.Plan(pokes, None, np.nan, np.nan)
    if policy == "oracle":
        rollout = oracle_rollout(arena, view, np.concatenate([labels.ravel(), task.marked + 1]), settings)
    else:
        learned = planning.learned_step(run, arena.camera, view)
        rollout = partial(planning.roll, learned if policy == "learned" else planning.no_motion_step, view,
                          settings=settings)
    return planning.plan(rollout, view, goal, arena.camera, settings, search, rng, on_iteration)


def closed_loop(task, run, policy, search, budget=10, seed=0, on_iteration=None):
    """Observe, plan, poke, until the goal is reached, no poke is predicted to help, or the budget is spent -> a dict.

    policy: one of POLICIES. run: the checkpoint; it also says where marked points went, whatever the policy.
    Of T pokes: rgb (T+1, H, W, 3), depth (T+1, H, W), poses (T+1, 7, 7), marks (T+1, M, 3) m as followed, pokes (T, 3),
    starts (T, 2) (NaN: the finger found no room), costs (T, 2): now and as planned, seconds (T,): of planning;
    distance (T+1, M) m, angle (T+1, M) rad; and the goal. Raises ValueError for a checkpoint of another camera, and
    planning.NoPoke where not even the first poke is possible; later on that ends the loop.
    """
    if policy not in POLICIES:
        raise ValueError(f"policy: expected one of {', '.join(POLICIES)}, got {policy!r}")
    check_whole("budget", budget, 1)
    arena, rng = task.arena, np.random.default_rng(seed)
    camera, empty, settings = arena.camera, arena.empty_depth, asdict(arena.settings)
    check_camera(run, camera)
    (rgb, depth, labels), view, goal = first_look(task)
    marks = view.cloud[-view.marked:]
    frames, poses, places = [(rgb, depth)], [arena.poses()], [marks]
    pokes, starts, costs, seconds = [], [], [], []
    while len(pokes) < budget:
        began = time.perf_counter()
        try:
            found = next_poke(policy, task, view, labels, goal, run, search, rng, on_iteration)
        except planning.NoPoke:
            if not pokes:
                raise
            break
        if found.now < REACHED or found.cost > found.now - GAIN:
            break
        poke = found.pokes[0]
        costs.append((found.now, found.cost))
        seconds.append(time.perf_counter() - began)
        moved, masks = planning.predict(run, camera, view, view.cloud[None], poke[None])
        grid = planning.occupied_grid(view.cloud[None], view.occupied, settings)
        options = planning.possible_starts(poke[None], grid, settings)[0]
        start = next((start for start in options[np.isfinite(options[:, 0])] if arena.descent_is_free(*start)), None)
        if start is not None:
            arena.poke(poke, start)
        pokes.append(poke)
        starts.append(np.full(2, np.nan) if start is None else start)
        next_rgb, depth, labels = arena.observe()
        try:
            next_view = planning.view_of(depth, empty, camera, settings, marks)
        except planning.NoPoke:  # the last object left the arena: what was done so far is kept
            next_view = None
        if next_view and start is not None:
            marks = planning.follow(view, rgb, poke, moved[0], masks[0], next_view, next_rgb)
            next_view = planning.view_of(depth, empty, camera, settings, marks)
        frames.append((next_rgb, depth))
        poses.append(arena.poses())
        places.append(marks)
        if next_view is None:
            break
        rgb, view = next_rgb, next_view
    measured = [distances(pose, task) for pose in poses]
    return {"rgb": np.stack([frame[0] for frame in frames]), "depth": np.stack([frame[1] for frame in frames]),
            "poses": np.stack(poses), "marks": np.stack(places), "pokes": np.array(pokes, np.float32).reshape(-1, 3),
            "starts": np.array(starts, np.float32).reshape(-1, 2), "costs": np.array(costs).reshape(-1, 2),
            "seconds": np.array(seconds), "distance": np.stack([each[0] for each in measured]),
            "angle": np.stack([each[1] for each in measured]),
            "goal_poses": task.goal_poses, "goal_marks": task.goal_marks, "movers": task.movers,
            **({"goal_rgb": task.goal[0], "goal_depth": task.goal[1]} if task.goal else {})}


def save_record(path, record, meta):
    """Write what `closed_loop` returned, whole or not at all; meta says how to make the task again, see `replay`."""
    save_npz(path, record, {"format": FORMAT, **meta})


def replay(path, settings=SETTINGS):
    """Carry out the pokes of a saved record in a fresh arena -> poses (T+1, 7, 7), those of the record.

    Bullet repeats itself to within some micrometres, unless objects collide with objects: that may amplify.
    Raises ValueError for a file that is no record.
    """
    record, meta = load_npz(path, FORMAT)
    with random_task(meta["seed"], meta["movers"], meta["obstacle"], settings) as task:
        poses = [task.arena.poses()]
        for poke, start in zip(record["pokes"], record["starts"]):
            if np.isfinite(start).all() and task.arena.descent_is_free(*start):
                task.arena.poke(poke, start)
            poses.append(task.arena.poses())
    return np.stack(poses)
