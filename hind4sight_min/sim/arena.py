"""The poke arena in Bullet: scenes, pictures, pokes. Paper: Sec. IV-A and IV-B; sizes, camera and finger are ours.

pybullet is imported only when an Arena is made; everything else in the package works without it.
"""
import tempfile
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np

from .. import check_number, check_whole
from ..disk.files import plain, whole_file
from ..geometry import Camera
from ..interactions import cell_centres, finger_fits, occupied_grid
from ..scene import scene_of
from .bodies import ROUND, add_own, measure, new_world
from .objects import KINDS, TEXTURES, draw_shape, draw_texture, mesh, prism

MAX_OBJECTS = 7
TIME_STEP = 1 / 240  # s
SUPERSAMPLE = 3  # odd: the middle sample of a block of rays lies on the pixel's centre
NEAR, FAR = 0.2, 2.0  # m from the camera; the renderer sees what lies between
TOPPLING = 720  # steps that a scene of own objects has to come to rest in: they may fall over
PARK_HEIGHT = 1.0  # m; the finger waits up here, out of the camera's sight


def some_of(names, known):
    """Whether these are one or more of those that are known."""
    return isinstance(names, (tuple, list)) and bool(names) and all(name in [*known] for name in names)


@dataclass(frozen=True)
class Settings:
    """Everything that decides what the simulator draws. Lengths in m, force in N, speed in m/s, pictures in pixels.

    The finger's path has a length within `poke_length`; scenes are thrown away after `pokes_per_scene`.
    `place_within` is the part of the arena in which a new scene's objects are put down. own: objects of one's own
    (sim/bodies.py); with some, half of all objects are of these, and all of them where `kinds` is empty.
    Raises ValueError naming what cannot work.
    """
    objects_min: int = 3
    objects_max: int = MAX_OBJECTS
    kinds: tuple = ("carton", "can", "bracket", "pot", "book")
    textures: tuple = ("stripes", "checks", "dots", "patches")
    arena: float = 0.5
    cell: float = 0.025
    wall_height: float = 0.03
    place_within: float = 0.95
    pokes_per_scene: int = 6
    poke_length: tuple = (0.10, 0.14)
    finger_radius: float = 0.01
    finger_force: float = 5.0  # 25 N squeeze objects out of corners like seeds
    finger_speed: float = 0.25
    width: int = 64
    height: int = 48
    own: tuple = ()

    def __post_init__(self):
        for name, kind, value in [(field.name, field.type, getattr(self, field.name)) for field in fields(self)]:
            if kind is int:
                check_whole(name, value, 1)
            elif kind is float:
                check_number(name, value, above=0)
        cells, length = self.arena / self.cell, self.poke_length
        paths = isinstance(length, tuple) and len(length) == 2 and 0 < length[0] < length[1] < self.arena
        own = isinstance(self.own, tuple) and all(hasattr(each, "add") and hasattr(each, "plain") for each in self.own)
        for good, name, expected in (
                (self.objects_min <= self.objects_max <= MAX_OBJECTS, "objects_max", f"objects_min to {MAX_OBJECTS}"),
                (some_of(self.kinds, KINDS) or self.own and not self.kinds, "kinds", f"some of {', '.join(KINDS)}"),
                (own, "own", "a tuple of what read_urdfs makes, or of other objects that have add and plain"),
                (some_of(self.textures, TEXTURES), "textures", f"some of {', '.join(TEXTURES)}"),
                (self.arena <= 0.5, "arena", "at most 0.5 m, which the camera sees"),
                (abs(cells - round(cells)) < 1e-6, "cell", "one that the arena has a whole number of"),
                (self.place_within <= 1, "place_within", "a share of the arena, at most 1"),
                (paths, "poke_length", "(least, most) in m, shorter than the arena"),
                (16 <= self.width <= 1280 and self.width * 3 == self.height * 4, "width", "4/3 of height, 16 to 1280")):
            if not good:
                raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)}")

    @property
    def plain(self):
        """As data sets record it, plain JSON types. Own objects appear where there are any: older ones know of none."""
        own = {"own": [each.plain for each in self.own]} if self.own else {}
        return plain({**{name: value for name, value in vars(self).items() if name != "own"}, **own})


# Fewer objects, none that topples, near the middle: what a model learns within minutes. data_small is so, with 25 N.
MIDDLE = {"objects_max": 4, "place_within": 0.7, "kinds": ("carton", "can", "bracket", "pot")}


# --- the camera ---------------------------------------------------------------------------------------------------

def arena_camera(width, height):
    """The fixed Camera: in front of the arena, looking down at 54 degrees; the same view at any size, in pixels.

    Not in the paper, which only says that the camera is fixed.
    """
    eye, target, right = np.array([0, -0.46, 0.62]), np.array([0, -0.018, 0]), np.array([1.0, 0, 0])
    forward = (target - eye) / np.linalg.norm(target - eye)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    focal = height / 2 / np.tan(np.radians(34.5) / 2)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, pose)


# --- the arena ----------------------------------------------------------------------------------------------------

class Arena:
    """One Bullet world: a walled table, a finger on three prismatic joints, a camera. A context manager.

    Of the present scene's objects: bodies, Bullet's numbers; kinds, names of own objects among them; and, measured as
    they lay when the scene began, radii, how far they reach from their middles in the plane, m, and round, whether
    their shape would hide a turn about the vertical. empty_depth (H, W) m: the arena without any. bullet: Bullet's
    functions, for this world. All is drawn from the Generator `rng`. Raises RuntimeError where pybullet is not
    installed.
    """

    def __init__(self, settings, rng):
        self.bullet = new_world()
        self.settings, self.rng, self.camera = settings, rng, arena_camera(settings.width, settings.height)
        self.bodies, self.kinds, self.radii, self.round = [], [], [], []
        self._build()
        self.empty_depth = self.observe()[1]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.bullet.disconnect()

    def _build(self):
        p, s = self.bullet, self.settings
        p.setGravity(0, 0, -9.81)
        p.setPhysicsEngineParameter(fixedTimeStep=TIME_STEP, deterministicOverlappingPairs=1)
        half, thick, high, white = s.arena / 2, 0.01, s.wall_height / 2, [0.9, 0.9, 0.88, 1]
        boxes = [([0, 0, -0.02], [1.0, 1.0, 0.02], [0.62, 0.60, 0.56, 1], 0.6)]  # the table, then the walls
        for sign in (-1, 1):
            boxes += [([sign * (half + thick), 0, high], [thick, half + 2 * thick, high], white, 0.3),
                      ([0, sign * (half + thick), high], [half, thick, high], white, 0.3)]
        for position, size, colour, friction in boxes:
            body = p.createMultiBody(0, p.createCollisionShape(p.GEOM_BOX, halfExtents=size),
                                     p.createVisualShape(p.GEOM_BOX, halfExtents=size, rgbaColor=colour), position)
            p.changeDynamics(body, -1, lateralFriction=friction)
        self._finger = self._build_finger()
        self._place_finger(0, 0, PARK_HEIGHT)
        opengl_from_arena = np.diag([1.0, -1, -1, 1]) @ self.camera.camera_from_arena
        self._view, self._textures = opengl_from_arena.T.ravel().tolist(), []
        with tempfile.TemporaryDirectory() as folder:
            for i in range(24):
                path = Path(folder) / f"texture_{i}.png"
                picture = draw_texture(s.textures[i % len(s.textures)], self.rng)[..., ::-1]
                with whole_file(path) as temporary:  # raises where the disk is full
                    temporary.write_bytes(cv2.imencode(".png", picture)[1])
                self._textures.append(p.loadTexture(str(path)))

    def _build_finger(self):
        """A vertical cylinder that slides along x, y and z: it stalls at its force limit, it cannot tilt."""
        p, zeros, upright = self.bullet, [[0, 0, 0]] * 3, [[0, 0, 0, 1]] * 3
        cylinder = p.createCollisionShape(p.GEOM_CYLINDER, radius=self.settings.finger_radius, height=0.2)
        finger = p.createMultiBody(
            baseMass=0, basePosition=[0, 0, 0.105],  # the tip is 5 mm above the table when z = 0
            linkMasses=[0.3] * 3, linkCollisionShapeIndices=[-1, -1, cylinder], linkVisualShapeIndices=[-1] * 3,
            linkPositions=zeros, linkOrientations=upright, linkInertialFramePositions=zeros,
            linkInertialFrameOrientations=upright, linkParentIndices=[0, 1, 2],
            linkJointTypes=[p.JOINT_PRISMATIC] * 3, linkJointAxis=[[1, 0, 0], [0, 1, 0], [0, 0, 1]])
        p.changeDynamics(finger, 2, lateralFriction=0.3)
        return finger

    def _place_finger(self, *position):
        p = self.bullet
        for joint, value in enumerate(position):
            p.resetJointState(self._finger, joint, value, 0)
            p.setJointMotorControl2(self._finger, joint, p.POSITION_CONTROL, targetPosition=value, force=1000)

    def _step(self, count):
        for _ in range(count):
            self.bullet.stepSimulation()

    def settle(self, limit=240):
        """Step until every object is at rest; False if one still moves after `limit` steps."""
        for _ in range(limit // 12):
            self._step(12)
            if all(np.abs(self.bullet.getBaseVelocity(body)).max() < 0.01 for body in self.bodies):
                return True
        return False

    def new_scene(self):
        """Put down a fresh random set of objects, apart from each other, and let them settle.

        Raises ValueError when they do not fit in 100 tries.
        """
        s = self.settings
        for _ in range(100):
            for body in self.bodies:
                self.bullet.removeBody(body)
            self.bodies, self.kinds, self.radii, places = [], [], [], []
            for _ in range(self.rng.integers(s.objects_min, s.objects_max + 1)):
                self._put_down(self._draw_kind(), places)
            if len(self.bodies) >= s.objects_min and self.settle(TOPPLING if s.own else 240):
                extents = [measure(self.bullet, body) for body in self.bodies]
                self.radii = [extent.radius for extent in extents]
                self.round = [extent.roundness > ROUND for extent in extents]
                return
        raise ValueError(f"objects: {s.objects_min} do not fit into {s.place_within:.0%} of a {s.arena} m arena")

    def _draw_kind(self):
        """A kind's name, or an object of one's own."""
        groups = [group for group in (self.settings.kinds, self.settings.own) if group]
        group = groups[self.rng.integers(2)] if len(groups) > 1 else groups[0]
        return group[self.rng.integers(len(group))]

    def _put_down(self, kind, places):
        """Put an object where there is room for it, apart from those at `places`, which grows; if there is."""
        s, rng, own = self.settings, self.rng, not isinstance(kind, str)
        if own:
            body, extent = add_own(self.bullet, kind, rng)
            radius = extent.radius
        else:
            shape = draw_shape(kind, rng)
            radius = max(np.linalg.norm(outline, axis=1).max() for outline in shape[0])
        reach = min(s.arena * s.place_within / 2, s.arena / 2 - radius - 0.004)  # clear of the walls
        for _ in range(100):
            xy = rng.uniform(-reach, reach, 2)
            if all(np.linalg.norm(xy - place) > radius + other + 0.004 for place, other in zip(places, self.radii)):
                places.append(xy)
                self.radii.append(radius)
                self.kinds.append(kind.plain["name"] if own else kind)
                self.bodies.append(self._stand(body, extent, xy) if own else self._add_object(kind, *shape, xy))
                return
        if own:
            self.bullet.removeBody(body)

    def _stand(self, body, extent, xy):
        """Stand a body that was just made on the table, turned about the vertical at random -> its number."""
        p, angle = self.bullet, self.rng.uniform(0, 2 * np.pi)
        turn = [0, 0, np.sin(angle / 2), np.cos(angle / 2)]
        turned = p.multiplyTransforms([0, 0, 0], turn, [0, 0, 0], p.getBasePositionAndOrientation(body)[1])[1]
        p.resetBasePositionAndOrientation(body, [*xy, extent.below + 0.001], turned)
        return body

    def _add_object(self, kind, outlines, area, height, taper, xy):
        p, rng, (density, friction) = self.bullet, self.rng, KINDS[kind][-2:]
        if len(outlines) == 1:
            collision = p.createCollisionShape(p.GEOM_MESH, vertices=prism(outlines[0], height, taper).tolist())
        else:
            collision = p.createCollisionShapeArray(
                shapeTypes=[p.GEOM_BOX] * len(outlines),
                halfExtents=[[*(corners[2] - corners[0]) / 2, height / 2] for corners in outlines],
                collisionFramePositions=[[*(corners[0] + corners[2]) / 2, 0] for corners in outlines])
        vertices, normals, uvs, indices = mesh(outlines, height, taper)
        visual = p.createVisualShape(p.GEOM_MESH, vertices=vertices, normals=normals, uvs=uvs, indices=indices)
        mass, angle = density * area * height * (1 + taper + taper ** 2) / 3, rng.uniform(0, 2 * np.pi)
        body = p.createMultiBody(mass, collision, visual, [*xy, height / 2 + 0.001],
                                 [0, 0, np.sin(angle / 2), np.cos(angle / 2)])
        p.changeDynamics(body, -1, lateralFriction=rng.uniform(*friction))
        p.changeVisualShape(body, -1, textureUniqueId=self._textures[rng.integers(len(self._textures))],
                            rgbaColor=[1, 1, 1, 1])
        return body

    def poses(self):
        """(MAX_OBJECTS, 7) float32: position and quaternion (x, y, z, w) of every object, zeros beyond the last."""
        result = np.zeros((MAX_OBJECTS, 7), np.float32)
        for i, body in enumerate(self.bodies):
            result[i] = np.concatenate(self.bullet.getBasePositionAndOrientation(body))
        return result

    def put(self, index, xy, turn=0.0):
        """Lift object `index` over to xy (2,) m and turn it by `turn` rad about the vertical, upright as it stood."""
        p, body = self.bullet, self.bodies[index]
        position, quaternion = p.getBasePositionAndOrientation(body)
        turned = p.multiplyTransforms([0, 0, 0], [0, 0, np.sin(turn / 2), np.cos(turn / 2)], [0, 0, 0], quaternion)[1]
        p.resetBasePositionAndOrientation(body, [*xy, position[2] + 0.001], turned)

    def move_to(self, poses):
        """Put the objects where they stood when `poses` gave these, (MAX_OBJECTS, 7)."""
        for body, pose in zip(self.bodies, poses):
            self.bullet.resetBasePositionAndOrientation(body, pose[:3].tolist(), pose[3:].tolist())

    def _render(self, fine):
        """What Bullet draws with `fine` x `fine` rays a pixel -> rgb, z-buffer and bodies, (fine H, fine W, ...)."""
        p, c, scale = self.bullet, self.camera, NEAR / (self.camera.fx * fine)
        # Bullet's renderer samples at a pixel's corner; this frustum puts the corners of the fine picture where the
        # camera model wants the pixel centres.
        x, y = fine * c.cx + (fine - 1) / 2, fine * c.cy + (fine - 1) / 2
        projection = p.computeProjectionMatrix(-x * scale, (fine * c.width - x) * scale,
                                               -(fine * c.height - 1 - y) * scale, (1 + y) * scale, NEAR, FAR)
        width, height, rgba, zbuffer, bodies = p.getCameraImage(
            fine * c.width, fine * c.height, self._view, projection, shadow=0, lightDirection=[0.3, -0.6, 1.0],
            renderer=p.ER_TINY_RENDERER)
        rgb = np.reshape(rgba, (height, width, 4)).astype(np.uint8)[..., :3]
        return rgb, np.reshape(zbuffer, (height, width)), np.reshape(bodies, (height, width))

    def photograph(self, poses=None, width=640):
        """The picture of `observe` for people: (s H, s W, 3) uint8, with the whole s that makes it about `width` wide.

        Not in the paper. poses (MAX_OBJECTS, 7): where the objects shall be in it; afterwards they are where they were.
        """
        p, times = self.bullet, max(1, round(width / self.camera.width))
        if poses is not None:
            now = p.saveState()
            self.move_to(poses)
        rgb = self._render(2 * times)[0]  # twice as fine, so that edges are smooth
        if poses is not None:
            p.restoreState(now)
            p.removeState(now)
        return cv2.resize(rgb, (times * self.camera.width, times * self.camera.height), interpolation=cv2.INTER_AREA)

    def observe(self):
        """Look at the arena -> rgb (H, W, 3) uint8, depth (H, W) float32 m, labels (H, W) uint8 (truth)."""
        c, fine = self.camera, SUPERSAMPLE
        rgb, zbuffer, bodies = self._render(fine)
        rgb = cv2.resize(rgb, (c.width, c.height), interpolation=cv2.INTER_AREA)
        zbuffer, bodies = (each[fine // 2::fine, fine // 2::fine] for each in (zbuffer, bodies))
        depth = FAR * NEAR / (FAR - (FAR - NEAR) * zbuffer.astype(float))
        labels = np.zeros(depth.shape, np.uint8)
        for i, body in enumerate(self.bodies):
            labels[bodies == body] = i + 1
        return rgb, depth.astype(np.float32), labels

    def sample_poke(self, rgb, depth):
        """A random poke at what background subtraction sees: an occupied cell as target, a free one as start.

        Paper: Sec. IV-A. The picture, (H, W, 3) uint8 and (H, W) m -> poke (3,), start (2,) float32, or None where no
        start is free.
        """
        s, settings = self.settings, vars(self.settings)
        scene = scene_of(depth[None], rgb[None], self.empty_depth, self.camera, s.arena)
        grid, centres = occupied_grid(scene.points, scene.occupied[0], settings), cell_centres(settings)
        if not grid.any():
            return None
        target = centres[self.rng.choice(np.flatnonzero(grid))]
        length = np.linalg.norm(target - centres, axis=1)
        possible = finger_fits(centres[None], grid, settings)[0]
        possible &= (length >= s.poke_length[0]) & (length <= s.poke_length[1])
        for start in centres[self.rng.permutation(np.flatnonzero(possible))]:
            if self.descent_is_free(*start):
                dx, dy = target - start
                return np.float32([*target, np.arctan2(dy, dx)]), np.float32(start)
        return None

    def descent_is_free(self, x, y):
        """Whether the finger can come down at (x, y) m: a tall cylinder, lowered, fills the column of its descent."""
        self._place_finger(x, y, 0)
        self.bullet.performCollisionDetection()
        free = not any(self.bullet.getClosestPoints(self._finger, body, 0.002, linkIndexA=2) for body in self.bodies)
        self._place_finger(0, 0, PARK_HEIGHT)
        return free

    def poke(self, poke, start):
        """Lower the finger at `start` (2,) m, push in a straight line to the target of `poke` (3,), lift it.

        Both axes share the speed in proportion, so the path is straight, to a millimetre while they gather speed; each
        gives up at the force limit.
        Returns True when everything came to rest.
        """
        p, s = self.bullet, self.settings
        self._place_finger(*start, 0)
        travel = np.asarray(poke[:2], float) - start
        length = np.linalg.norm(travel)
        for joint in (0, 1):
            p.setJointMotorControl2(self._finger, joint, p.POSITION_CONTROL, targetPosition=float(poke[joint]),
                                    maxVelocity=abs(travel[joint]) / length * s.finger_speed + 1e-4,
                                    force=s.finger_force)
        self._step(int(length / s.finger_speed / TIME_STEP) + 40)  # the last 40 close the final centimetre
        self._place_finger(0, 0, PARK_HEIGHT)
        return self.settle()
