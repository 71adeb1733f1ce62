"""The poke arena in Bullet: scenes, pokes, observations, collection. Paper: Sec. IV-A and IV-B.

pybullet is imported only when an Arena is made; everything else in the package works without it.
"""
import json
import tempfile
import time
from collections import Counter
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from . import check_whole, worker_pool
from .geometry import Camera, look_at
from .interactions import (OCCUPIED, Interactions, Truth, cell_centres, cells_of, find_shards, grid_shape, load_shard,
                           save_shard, standing, truth_path)
from .objects import KINDS, TEXTURES, centred, draw_texture, prism, prism_mesh

MAX_OBJECTS = 7
SHARD_POKES = 100  # one shard is one Bullet world with its own seed, so the data do not depend on --jobs
PARK_HEIGHT = 1.0  # m; the finger waits up here, out of the camera's sight


@dataclass(frozen=True)
class Settings:
    """Everything that decides what the simulator draws. Lengths in m, forces in N, speeds in m/s.

    The finger's path has a length within `poke_length`; scenes are thrown away after `pokes_per_scene`.
    `place_within` is the part of the arena in which a new scene's objects are put down.
    """
    objects_min: int = 3
    objects_max: int = 4
    kinds: tuple = ("carton", "can", "bracket", "pot")
    textures: tuple = ("stripes", "checks", "dots", "patches")
    arena: float = 0.5
    cell: float = 0.025
    wall_height: float = 0.03
    place_within: float = 0.7
    pokes_per_scene: int = 6
    poke_length: tuple = (0.10, 0.14)
    finger_radius: float = 0.01
    finger_force: float = 25.0
    finger_speed: float = 0.25
    width: int = 64
    height: int = 48

    def __post_init__(self):
        for name in ("kinds", "textures", "poke_length"):  # JSON has lists where we have tuples
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("objects_min", "objects_max", "pokes_per_scene", "width", "height"):
            if not isinstance(getattr(self, name), int):
                raise ValueError(f"{name}: expected a whole number, got {getattr(self, name)}")
        if not (1 <= self.objects_min <= self.objects_max <= MAX_OBJECTS):
            raise ValueError(f"objects: expected 1 <= minimum <= maximum <= {MAX_OBJECTS}, "
                             f"got {self.objects_min} to {self.objects_max}")
        for name in ("arena", "cell", "wall_height", "place_within", "pokes_per_scene", "finger_radius", "finger_force",
                     "finger_speed"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name}: expected a finite number > 0, got {getattr(self, name)}")
        cells = self.arena / self.cell
        if self.arena > 0.5 or abs(cells - round(cells)) > 1e-6:
            raise ValueError(f"arena, cell: expected an arena of at most 0.5 m, which the camera sees, in whole cells, "
                             f"got {self.arena} and {self.cell}")
        if self.place_within > 1:
            raise ValueError(f"place_within: expected a share of the arena, at most 1, got {self.place_within}")
        length = self.poke_length
        if not (isinstance(length, tuple) and len(length) == 2 and 0 < length[0] < length[1] < self.arena):
            raise ValueError(f"poke_length: expected (least, most) in m, shorter than the arena, got {length}")
        for name, known in (("kinds", KINDS), ("textures", TEXTURES)):
            for value in getattr(self, name) or [None]:
                if value not in known:
                    raise ValueError(f"{name}: expected some of {', '.join(known)}, got {value!r}")
        if self.width < 16 or self.height < 12 or self.width * 3 != self.height * 4:
            raise ValueError(f"width, height: expected 4:3 and at least 16 x 12, got {self.width} x {self.height}")


# --- the arena ---------------------------------------------------------------------------------------------

def arena_camera(width, height):
    """The fixed camera: in front of the arena, looking down at 54 degrees; symmetric about x = 0."""
    focal = height / 2 / np.tan(np.radians(34.5) / 2)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2,
                  look_at([0, -0.46, 0.62], [0, -0.018, 0]))


class Arena:
    """One Bullet world: a walled table, a finger on three prismatic joints, a camera. A context manager.

    `bullet_seconds` adds up the time spent inside stepping and rendering.
    Raises RuntimeError where pybullet is not installed.
    """
    TIME_STEP = 1 / 240
    SUPERSAMPLE = 3  # odd: the middle sample of a block of rays lies on the pixel's centre
    NEAR, FAR = 0.2, 2.0

    def __init__(self, settings, rng):
        try:
            import pybullet
        except ImportError:
            raise RuntimeError("the simulator needs pybullet, which is not installed: pip install pybullet "
                               "(ready-made for Python 3.11 and older; later versions compile it)") from None
        self.settings, self.rng, self.bullet = settings, rng, pybullet
        self.camera = arena_camera(settings.width, settings.height)
        self._plain_settings = asdict(settings)
        self.bullet_seconds = 0.0
        self.bodies, self.kinds, self.radii, self.pokes_in_scene = [], [], [], 0
        self._client = pybullet.connect(pybullet.DIRECT)
        self._folder = tempfile.TemporaryDirectory()
        self._build()
        self.empty_depth = self.observe()[1]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.bullet.disconnect(self._client)
        self._folder.cleanup()

    def _build(self):
        p, s = self.bullet, self.settings
        p.setGravity(0, 0, -9.81, physicsClientId=self._client)
        p.setPhysicsEngineParameter(fixedTimeStep=self.TIME_STEP, deterministicOverlappingPairs=1,
                                    physicsClientId=self._client)
        self._static_box([0, 0, -0.02], [1.0, 1.0, 0.02], [0.62, 0.60, 0.56, 1], friction=0.6)
        half, thick, high, white = s.arena / 2, 0.01, s.wall_height / 2, [0.9, 0.9, 0.88, 1]
        for sign in (-1, 1):
            self._static_box([sign * (half + thick), 0, high], [thick, half + 2 * thick, high], white, 0.3)
            self._static_box([0, sign * (half + thick), high], [half, thick, high], white, 0.3)
        self._build_finger()
        # Bullet's software renderer samples at a pixel's corner; this frustum puts the corners of the fine
        # picture where the camera model wants the pixel centres. See test_simulator for the check.
        fine, c = self.SUPERSAMPLE, self.camera
        scale = self.NEAR / (c.fx * fine)
        cx, cy = fine * c.cx + (fine - 1) / 2, fine * c.cy + (fine - 1) / 2
        w, h = fine * c.width, fine * c.height
        self._projection = p.computeProjectionMatrix(-cx * scale, (w - cx) * scale, -(h - 1 - cy) * scale,
                                                     (1 + cy) * scale, self.NEAR, self.FAR)
        opengl_from_arena = np.diag([1.0, -1, -1, 1]) @ c.camera_from_arena
        self._view = opengl_from_arena.T.ravel().tolist()
        self._textures = []
        for i in range(24):
            path = str(Path(self._folder.name) / f"texture_{i}.png")
            style = s.textures[i % len(s.textures)]
            cv2.imwrite(path, draw_texture(style, self.rng)[..., ::-1])
            self._textures.append(p.loadTexture(path, physicsClientId=self._client))

    def _static_box(self, position, half_extents, colour, friction):
        p, client = self.bullet, self._client
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half_extents, physicsClientId=client)
        look = p.createVisualShape(p.GEOM_BOX, halfExtents=half_extents, rgbaColor=colour, physicsClientId=client)
        body = p.createMultiBody(0, shape, look, position, physicsClientId=client)
        p.changeDynamics(body, -1, lateralFriction=friction, physicsClientId=client)

    def _build_finger(self):
        """A vertical cylinder that slides along x, y and z: it stalls at its force limit, it cannot tilt."""
        p, client, radius = self.bullet, self._client, self.settings.finger_radius
        cylinder = p.createCollisionShape(p.GEOM_CYLINDER, radius=radius, height=0.2, physicsClientId=client)
        self._finger = p.createMultiBody(
            baseMass=0, basePosition=[0, 0, 0.105],  # the tip is 5 mm above the table when z = 0
            linkMasses=[0.3] * 3, linkCollisionShapeIndices=[-1, -1, cylinder], linkVisualShapeIndices=[-1] * 3,
            linkPositions=[[0, 0, 0]] * 3, linkOrientations=[[0, 0, 0, 1]] * 3,
            linkInertialFramePositions=[[0, 0, 0]] * 3, linkInertialFrameOrientations=[[0, 0, 0, 1]] * 3,
            linkParentIndices=[0, 1, 2], linkJointTypes=[p.JOINT_PRISMATIC] * 3,
            linkJointAxis=[[1, 0, 0], [0, 1, 0], [0, 0, 1]], physicsClientId=client)
        p.changeDynamics(self._finger, 2, lateralFriction=0.3, physicsClientId=client)
        self._place_finger(0, 0, PARK_HEIGHT)

    def _place_finger(self, x, y, z):
        p = self.bullet
        for joint, value in enumerate((x, y, z)):
            p.resetJointState(self._finger, joint, value, 0, physicsClientId=self._client)
            p.setJointMotorControl2(self._finger, joint, p.POSITION_CONTROL, targetPosition=value,
                                    force=1000, physicsClientId=self._client)

    def _step(self, count):
        start = time.perf_counter()
        step, client = self.bullet.stepSimulation, self._client
        for _ in range(count):
            step(physicsClientId=client)
        self.bullet_seconds += time.perf_counter() - start

    def settle(self, limit=240):
        """Step until every object is at rest; False if one still moves after `limit` steps."""
        for _ in range(limit // 12):
            self._step(12)
            speeds = [np.abs(v).max() for body in self.bodies
                      for v in self.bullet.getBaseVelocity(body, physicsClientId=self._client)]
            if not speeds or max(speeds) < 0.01:
                return True
        return False

    # -- scenes --

    def new_scene(self):
        """Put down a fresh random set of objects, apart from each other, and let them settle.

        Raises ValueError when they do not fit in 100 tries.
        """
        p, s, rng = self.bullet, self.settings, self.rng
        for _ in range(100):
            for body in self.bodies:
                p.removeBody(body, physicsClientId=self._client)
            self.bodies, self.kinds, placed = [], [], []
            for _ in range(rng.integers(s.objects_min, s.objects_max + 1)):
                kind = s.kinds[rng.integers(len(s.kinds))]
                outlines, height, taper = KINDS[kind][0](rng)
                radius = max(np.linalg.norm(o, axis=1).max() for o in centred(outlines)[0])
                for _ in range(100):
                    xy = rng.uniform(-0.5, 0.5, 2) * s.arena * s.place_within
                    if all(np.linalg.norm(xy - other) > radius + size + 0.004 for other, size in placed):
                        placed.append((xy, radius))
                        self.bodies.append(self._add_object(kind, outlines, height, taper, xy))
                        self.kinds.append(kind)
                        break
            self.pokes_in_scene, self.radii = 0, [size for _, size in placed]
            if len(self.bodies) >= s.objects_min and self.settle():
                return
        raise ValueError(f"objects: {s.objects_min} of them do not fit into {s.place_within:.0%} of a {s.arena} m "
                         "arena")

    def _add_object(self, kind, outlines, height, taper, xy):
        p, rng, client = self.bullet, self.rng, self._client
        _, density, friction = KINDS[kind]
        outlines, area = centred(outlines)
        if len(outlines) == 1:
            shape = p.createCollisionShape(p.GEOM_MESH, vertices=prism(outlines[0], height, taper).tolist(),
                                           physicsClientId=client)
        else:  # every outline of a compound is a rectangle
            middles, halves = zip(*[((o[0] + o[2]) / 2, (o[2] - o[0]) / 2) for o in outlines])
            shape = p.createCollisionShapeArray(
                shapeTypes=[p.GEOM_BOX] * len(outlines), halfExtents=[[*h, height / 2] for h in halves],
                collisionFramePositions=[[*m, 0] for m in middles], physicsClientId=client)
        vertices, normals, uvs, indices = [], [], [], []
        for outline in outlines:
            v, n, t, i = prism_mesh(outline, height, taper)
            indices += [k + len(vertices) for k in i]
            vertices, normals, uvs = vertices + v, normals + n, uvs + t
        look = p.createVisualShape(p.GEOM_MESH, vertices=vertices, normals=normals, uvs=uvs, indices=indices,
                                   physicsClientId=client)
        mass = density * area * height * (1 + taper + taper ** 2) / 3
        angle = rng.uniform(0, 2 * np.pi)
        body = p.createMultiBody(mass, shape, look, [*xy, height / 2 + 0.001],
                                 [0, 0, np.sin(angle / 2), np.cos(angle / 2)], physicsClientId=client)
        p.changeDynamics(body, -1, lateralFriction=rng.uniform(*friction), physicsClientId=client)
        p.changeVisualShape(body, -1, textureUniqueId=self._textures[rng.integers(len(self._textures))],
                            rgbaColor=[1, 1, 1, 1], physicsClientId=client)
        return body

    def poses(self):
        """(MAX_OBJECTS, 7) float32: position and quaternion (x, y, z, w) of every object, zeros beyond the last."""
        result = np.zeros((MAX_OBJECTS, 7), np.float32)
        for i, body in enumerate(self.bodies):
            position, quaternion = self.bullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
            result[i] = [*position, *quaternion]
        return result

    def put(self, index, xy, turn=0.0):
        """Lift object `index` over to xy (2,) m and turn it by `turn` rad about the vertical, upright as it stood."""
        p, client = self.bullet, self._client
        position, quaternion = p.getBasePositionAndOrientation(self.bodies[index], physicsClientId=client)
        turned = p.multiplyTransforms([0, 0, 0], [0, 0, np.sin(turn / 2), np.cos(turn / 2)], [0, 0, 0], quaternion)[1]
        p.resetBasePositionAndOrientation(self.bodies[index], [*xy, position[2] + 0.001], turned,
                                          physicsClientId=client)

    def snapshot(self):
        """The state of the world, for `restore`; Bullet keeps it until the arena is closed."""
        return self.bullet.saveState(physicsClientId=self._client)

    def restore(self, state):
        self.bullet.restoreState(state, physicsClientId=self._client)

    # -- observations --

    def observe(self):
        """Look at the arena -> rgb (H, W, 3) uint8, depth (H, W) float32 m, labels (H, W) uint8 (truth)."""
        c, fine = self.camera, self.SUPERSAMPLE
        size = (fine * c.height, fine * c.width)
        start = time.perf_counter()
        _, _, rgba, zbuffer, segments = self.bullet.getCameraImage(
            size[1], size[0], self._view, self._projection, shadow=0, lightDirection=[0.3, -0.6, 1.0],
            renderer=self.bullet.ER_TINY_RENDERER, physicsClientId=self._client)
        self.bullet_seconds += time.perf_counter() - start
        rgb = np.reshape(np.asarray(rgba, np.uint8), (*size, 4))[..., :3]
        rgb = cv2.resize(rgb, (c.width, c.height), interpolation=cv2.INTER_AREA)
        middle = slice(fine // 2, None, fine)
        zbuffer = np.reshape(np.asarray(zbuffer, np.float64), size)[middle, middle]
        depth = self.FAR * self.NEAR / (self.FAR - (self.FAR - self.NEAR) * zbuffer)
        segments = np.reshape(np.asarray(segments), size)[middle, middle]
        labels = np.zeros(segments.shape, np.uint8)
        for i, body in enumerate(self.bodies):
            labels[segments == body] = i + 1
        return rgb, depth.astype(np.float32), labels

    # -- pokes --

    def sample_poke(self, depth):
        """A random poke at what background subtraction sees: an occupied cell as target, a free one as start.

        Paper: Sec. IV-A. depth (H, W) m -> (poke (3,), start (2,)) float32, or None where no start is free.
        """
        s, rng, settings = self.settings, self.rng, self._plain_settings
        occupied = occupied_cells(depth, self.empty_depth, self.camera, settings)
        free = cv2.dilate(occupied.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
        centres = cell_centres(settings)
        free &= (np.abs(centres).max(axis=1) < s.arena / 2 - s.finger_radius).reshape(free.shape)
        targets = np.flatnonzero(occupied)
        if len(targets) == 0:
            return None
        target = centres[rng.choice(targets)]
        distance = np.linalg.norm(centres - target, axis=1)
        starts = np.flatnonzero(free.ravel() & (distance >= s.poke_length[0]) & (distance <= s.poke_length[1]))
        for start in rng.permutation(starts):
            if self.descent_is_free(*centres[start]):
                dx, dy = target - centres[start]
                return np.float32([*target, np.arctan2(dy, dx)]), np.float32(centres[start])
        return None

    def descent_is_free(self, x, y):
        """The finger is a tall cylinder: lowered, it fills the whole column of its descent."""
        self._place_finger(x, y, 0)
        p, client = self.bullet, self._client
        p.performCollisionDetection(physicsClientId=client)
        free = not any(p.getClosestPoints(self._finger, body, 0.002, linkIndexA=2, physicsClientId=client)
                       for body in self.bodies)
        self._place_finger(0, 0, PARK_HEIGHT)
        return free

    def poke(self, poke, start):
        """Lower the finger at `start` (2,) m, push in a straight line to the target of `poke` (3,), lift it.

        Both axes share the speed in proportion, so the path is straight; each gives up at the force limit.
        Returns True when everything came to rest.
        """
        p, s = self.bullet, self.settings
        self._place_finger(*start, 0)
        travel = np.asarray(poke[:2], float) - start
        length = np.linalg.norm(travel)
        for joint in (0, 1):
            p.setJointMotorControl2(self._finger, joint, p.POSITION_CONTROL, targetPosition=float(poke[joint]),
                                    maxVelocity=abs(travel[joint]) / length * s.finger_speed + 1e-4,
                                    force=s.finger_force, physicsClientId=self._client)
        self._step(int(length / s.finger_speed / self.TIME_STEP) + 40)  # the last 40 close the final centimetre
        self._place_finger(0, 0, PARK_HEIGHT)
        return self.settle()


def occupied_cells(depth, empty_depth, camera, settings, threshold=OCCUPIED):
    """Which cells of the arena's grid hold something: those of occupied pixels inside the walls. Paper: Sec. IV-A.

    depth, empty_depth (H, W) m; threshold: of `occupied_pixels`, m -> (rows, columns) bool.
    """
    points, objects = standing(depth, empty_depth, camera, settings, threshold)
    occupied = np.zeros(grid_shape(settings), bool)
    occupied.ravel()[cells_of(points[objects][:, :2], settings)] = True
    return occupied


# --- collection ----------------------------------------------------------------------------------------------

def collect_shard(settings, seed, index, pokes):
    """Collect one shard -> (Interactions, Truth, seconds inside Bullet). The same arguments give the same data.

    Interactions are dropped, and counted in meta["counts"], when an object left the arena, is out of the
    camera's sight, or never came to rest. Raises ValueError for settings under which that is nearly always so.
    """
    rng = np.random.default_rng([seed, index])
    kept, counts = [], Counter(kept=0, left_arena=0, out_of_view=0, not_at_rest=0, no_free_start=0)
    with Arena(settings, rng) as arena:
        arena.new_scene()
        before = arena.observe(), arena.poses()
        while len(kept) < pokes:
            drawn = arena.sample_poke(before[0][1])
            trouble = "no_free_start"
            if drawn is not None:
                at_rest = arena.poke(*drawn)
                after = arena.observe(), arena.poses()
                trouble = _trouble(arena, before[0][2], after, at_rest)
            if trouble is None:
                kept.append((before, after, drawn))
                arena.pokes_in_scene += 1
                before = after
            counts[trouble or "kept"] += 1
            if counts.total() > 20 * (len(kept) + 10):
                raise ValueError(f"settings: hardly a poke can be used ({dict(counts)})")
            if trouble or arena.pokes_in_scene == settings.pokes_per_scene:
                arena.new_scene()
                before = arena.observe(), arena.poses()
    befores, afters, drawns = zip(*kept)
    meta = {"seed": seed, "shard": index, "settings": asdict(settings), "counts": dict(counts)}
    interactions = Interactions(
        *(np.stack([frame[0][i] for frame in frames]) for i in (0, 1) for frames in (befores, afters)),
        pokes=np.stack([d[0] for d in drawns]), starts=np.stack([d[1] for d in drawns]),
        empty_depth=arena.empty_depth, camera=arena.camera, meta=json.loads(json.dumps(meta)))
    truth = Truth(np.stack([b[0][2] for b in befores]), np.stack([b[1] for b in befores]),
                  np.stack([a[1] for a in afters]))
    return interactions, truth, arena.bullet_seconds


def _trouble(arena, labels_before, after, at_rest):
    """Why this interaction must be dropped, or None."""
    (_, _, labels), poses = after
    count = len(arena.bodies)
    xy, z = np.abs(poses[:count, :2]).max(), poses[:count, 2]
    if xy > arena.settings.arena / 2 or (z < 0).any():
        return "left_arena"
    if not at_rest:
        return "not_at_rest"
    seen = [np.isin(np.arange(1, count + 1), picture).all() for picture in (labels_before, labels)]
    return None if all(seen) else "out_of_view"


def _collect_job(folder, settings, seed, index, pokes):
    start = time.perf_counter()
    path = Path(folder) / f"shard_{index:04d}.npz"
    interactions, truth, inside = collect_shard(settings, seed, index, pokes)
    save_shard(path, interactions, truth)
    return interactions.meta["counts"], inside, time.perf_counter() - start


def collect(folder, pokes, seed, settings=Settings(), jobs=1, progress=None):
    """Collect `pokes` interactions into `folder`; shards already there from the same call are kept.

    progress(done, total) is called after every shard. Returns a dict: counts of kept and dropped pokes,
    seconds, and the share of the workers' time spent inside Bullet's stepping and rendering (None if no shard was
    missing).
    Raises ValueError for bad counts or a folder with other data in it.
    """
    for name, value, least in (("pokes", pokes, 1), ("jobs", jobs, 1), ("seed", seed, 0)):
        check_whole(name, value, least)
    folder, start = Path(folder), time.perf_counter()
    sizes = {f"shard_{i:04d}.npz": min(SHARD_POKES, pokes - first)
             for i, first in enumerate(range(0, pokes, SHARD_POKES))}
    counts, inside, total, missing = Counter(), 0.0, 0.0, dict(sizes)
    for path in find_shards(folder):
        old = load_shard(path)
        if (old.meta["seed"], old.meta["settings"], len(old)) != (seed, json.loads(json.dumps(asdict(settings))),
                                                                 sizes.get(path.name)):
            raise ValueError(f"{path}: holds data of another seed, other settings or another number of pokes")
        if truth_path(path).exists():
            counts.update(old.meta["counts"])
            del missing[path.name]
    todo = [(str(folder), settings, seed, list(sizes).index(name), size) for name, size in missing.items()]
    done = pokes - sum(job[4] for job in todo)

    def account(job, result):
        nonlocal inside, total, done
        counts.update(result[0])
        inside, total, done = inside + result[1], total + result[2], done + job[4]
        if progress:
            progress(done, pokes)

    if jobs == 1 or len(todo) <= 1:
        for job in todo:
            account(job, _collect_job(*job))
    else:
        with worker_pool(min(jobs, len(todo))) as pool:
            futures = {pool.submit(_collect_job, *job): job for job in todo}
            try:
                for future in as_completed(futures):
                    account(futures[future], future.result())
            except BaseException:
                pool.shutdown(cancel_futures=True)  # what has not begun is left for the next call
                raise
    return {"counts": dict(counts), "seconds": time.perf_counter() - start,
            "share_in_bullet": inside / total if total else None}
