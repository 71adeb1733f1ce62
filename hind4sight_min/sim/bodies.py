"""Bodies in Bullet, whatever made them: how large they are, how round, whether they can be poked here; and objects of
one's own, of URDF files. Not in the paper.

An object of one's own (in `Settings.own`) is anything that has `add(bullet, rng)`, which makes a body in a world and
returns its number, and `plain`, a dict of plain JSON types with a "name": what data sets say of it. Its class has to be
in a module, for other processes to import.
"""
import glob
import importlib
import os
import re
import zlib
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from inspect import isbuiltin
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from .. import check_number
from ..scene import REACH, TALL

LARGEST = REACH / 2  # m from the middle to any corner: wherever it is poked, the model's box has the whole of it
LOW = 0.012  # m; background subtraction would hardly see what is lower
ROUND = 0.97  # a polygon of 13 corners; the turn of what is rounder cannot be seen
CUBE = np.array(list(product((-0.5, 0.5), repeat=3)))  # its corners


# --- Bullet -------------------------------------------------------------------------------------------------------

@contextmanager
def quietly():
    """Within the block nothing is printed: Bullet's C code does as it likes."""
    kept, null = {}, os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        kept[stream] = os.dup(stream)
        os.dup2(null, stream)
    try:
        yield
    finally:
        for stream, copy in kept.items():
            os.dup2(copy, stream)
            os.close(copy)
        os.close(null)


def new_world():
    """A Bullet world: Bullet's functions, for this world. Raises RuntimeError where pybullet is not installed."""
    try:
        with quietly():
            pybullet = importlib.import_module("pybullet")
    except ImportError:
        raise RuntimeError("the simulator needs pybullet, which is not installed: pip install pybullet "
                           "(ready-made for Python 3.11 and older; later versions compile it)") from None
    world = pybullet.connect(pybullet.DIRECT)
    return SimpleNamespace(**{name: partial(value, physicsClientId=world) if isbuiltin(value) else value
                              for name, value in vars(pybullet).items()})


# --- how large a body is ------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Extent:
    """How far a body reaches as it lies, from its middle (its centre of mass), in m.

    radius: in the plane; reach: in space; below: down to its lowest point; height: from there to its highest.
    roundness: of its outline from above, how far it reaches where it reaches least, over the radius; a disc has 1.
    """
    radius: float
    reach: float
    below: float
    height: float
    roundness: float


def corners(bullet, body):
    """What a body collides with, as balls: it is all that lies between them.

    -> where they are from its middle (n, 3) m, arena axes, as it lies; their radii (n,) m, 0 for a corner. Raises
    ValueError for shapes without bounds, without corners or of no finite size.
    """
    middle, places, radii = bullet.getBasePositionAndOrientation(body)[0], [], []
    for link in range(-1, bullet.getNumJoints(body)):
        position, turn = (bullet.getLinkState(body, link)[:2] if link >= 0
                          else bullet.getBasePositionAndOrientation(body))
        with quietly():  # all meshes of a link at once
            points = [np.reshape(bullet.getMeshData(body, link)[1], (-1, 3))]
        radii.append(np.zeros(len(points[0])))
        for _, _, kind, size, _, *frame in bullet.getCollisionShapeData(body, link):
            if kind == bullet.GEOM_MESH:
                continue
            local = {bullet.GEOM_BOX: CUBE * size, bullet.GEOM_SPHERE: np.zeros((1, 3)),
                     bullet.GEOM_CAPSULE: np.outer((-0.5, 0.5), (0, 0, size[0]))}.get(kind)
            if local is None:
                raise ValueError("expected boxes, spheres, cylinders, capsules and convex meshes to collide with")
            points.append(Rotation.from_quat(frame[1]).apply(local) + frame[0])
            radius = {bullet.GEOM_SPHERE: size[0], bullet.GEOM_CAPSULE: size[1]}.get(kind, 0)
            radii.append(np.full(len(local), radius))
        places.append(Rotation.from_quat(turn).apply(np.concatenate(points)) + position - middle)
    places, radii = np.concatenate(places), np.concatenate(radii)
    if not len(places) or not np.isfinite(places).all():
        raise ValueError("has no shape of finite size to collide with")
    return places, radii


def measure(bullet, body):
    """How far a body reaches as it lies -> Extent. Raises ValueError as `corners` does."""
    places, radii = corners(bullet, body)
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    reach = (places[:, :2] @ [np.cos(angle), np.sin(angle)] + radii[:, None]).max(axis=0)
    radius = (np.linalg.norm(places[:, :2], axis=1) + radii).max()
    bottom, top = (places[:, 2] - radii).min(), (places[:, 2] + radii).max()
    return Extent(radius, (np.linalg.norm(places, axis=1) + radii).max(), -bottom, top - bottom,
                  reach.min() / radius)


def check_pokable(bullet, body):
    """Measure a body that was just made -> Extent. Raises ValueError, saying why, for one that cannot be poked here;
    where it is too large, the error's `room` says how many times as large it could be.
    """
    if any(bullet.getJointInfo(body, joint)[2] != bullet.JOINT_FIXED for joint in range(bullet.getNumJoints(body))):
        raise ValueError("has joints that move; expected one rigid body")
    if not bullet.getDynamicsInfo(body, -1)[0] > 0:
        raise ValueError("has no mass, so that nothing moves it; expected one in kg")
    extent = measure(bullet, body)
    if extent.height < LOW:
        raise ValueError(f"is {extent.height:.4f} m high as it stands; expected {LOW:g} m or more, or it is not seen")
    room = 1 / max(extent.reach / LARGEST, extent.height / TALL)
    if room < 1:
        error = ValueError(f"reaches {extent.reach:.3f} m from its middle and is {extent.height:.3f} m high as it "
                           f"stands; expected at most {LARGEST:g} and {TALL:g} m")
        error.room = room
        raise error
    return extent


# --- objects of one's own -----------------------------------------------------------------------------------------

def add_own(bullet, own, rng):
    """Add an object of one's own to a world -> Bullet's number of it, its Extent. rng: the world's Generator, for what
    it draws. Raises ValueError naming one that cannot be made or poked.
    """
    try:
        body = own.add(bullet, rng)
        return body, check_pokable(bullet, body)
    except ValueError as error:
        error.args = f"{own.plain['name']}: {error}",
        raise


NAMED = re.compile(rb"""filename\s*=\s*["'](?:\w+://)?([^"']+)|^\s*(?:mtllib|map_Kd)\s+(\S.*?)\s*$""", re.MULTILINE)


@cache
def contents(path):
    """A checksum of a file and of what it names in turn (meshes, materials, pictures), and the names that are nowhere:
    Bullet looks in the folder of the file and in those above.
    """
    checksum, files, missing = 0, [Path(path)], []
    for file in files:  # grows on the way
        content = file.read_bytes()
        checksum = zlib.crc32(content, checksum)
        for names in NAMED.findall(content):
            name = os.fsdecode(b"".join(names))
            found = next((folder / name for folder in file.parents if os.path.isfile(folder / name)), None)
            if found is None:
                missing.append(name)
            elif found not in files:
                files.append(found)
    return checksum, missing


@dataclass(frozen=True)
class Urdf:
    """An object that Bullet loads from a URDF file, `scale` times as large as that says: as it stands there, in its own
    colours, with its own mass and friction. checksum: of its content when it was first read.
    """
    path: str
    scale: float
    checksum: int

    @property
    def plain(self):
        """What data sets say of it: no path of this machine."""
        return {"name": os.path.basename(self.path), "scale": self.scale, "checksum": self.checksum}

    def add(self, bullet, rng=None):
        """Load it into a world -> Bullet's number. Raises ValueError where it has changed or does not load."""
        checksum, missing = contents(self.path)
        if checksum != self.checksum:
            raise ValueError("has changed since it was first read")
        try:
            with quietly():
                return bullet.loadURDF(self.path, globalScaling=self.scale)
        except bullet.error:
            reason = f"it names {missing[0]}, which is not there" if missing else "expected a URDF file"
            raise ValueError(f"Bullet cannot load it: {reason}") from None


def files_named(path):
    """The files that a path or a pattern names, here or else among those that come with pybullet; itself, if none."""
    import pybullet_data
    if os.path.exists(path):
        return [path]
    examples = pybullet_data.getDataPath()
    there = [os.path.join(examples, name) for name in sorted(glob.glob(path, root_dir=examples))]
    return sorted(glob.glob(path)) or there or [path]


def floored(number):
    """A number above 0 with two digits, not above it."""
    unit = 10.0 ** (np.floor(np.log10(number)) - 1)
    return np.floor(number / unit) * unit


def read_urdfs(paths, scale=1.0):
    """URDF files, or patterns for them -> a tuple of Urdf, for `Settings.own`. Each is loaded: can it be poked?

    scale: how many times as large as they say. Raises ValueError that names the first that cannot be used, says why and
    how many there are.
    """
    check_number("scale", scale, above=0)
    bullet, found, wrong, least = new_world(), [], [], 1.0
    paths = [paths] if isinstance(paths, (str, Path)) else paths
    files = [os.path.abspath(file) for path in paths for file in files_named(str(path))]
    for path in files:
        try:
            if not os.path.isfile(path):
                raise ValueError(f"{path}: expected a URDF file, got "
                                 f"{'a folder' if os.path.isdir(path) else 'nothing there'}")
            if not os.path.getsize(path):
                raise ValueError(f"{path}: expected a URDF file, got an empty one")
            found.append(Urdf(path, float(scale), contents(path)[0]))
            bullet.removeBody(add_own(bullet, found[-1], None)[0])
        except ValueError as error:
            wrong.append(str(error))
            least = min(least, getattr(error, "room", 1))
    bullet.disconnect()
    if wrong:
        hint = f"; none is too large at a scale of {floored(scale * least):g}" if least < 1 else ""
        count = f" ({len(wrong)} of {len(files)} files cannot be used)" if len(files) > 1 else ""
        raise ValueError(wrong[0] + count + hint)
    return tuple(found)
