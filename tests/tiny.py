"""Pokes that need no simulator: a block on a tilted view of a table, somewhere else afterwards. For tests only."""
from dataclasses import replace

import numpy as np

from hind4sight_min.geometry import Camera
from hind4sight_min.interactions import Interactions
from hind4sight_min.networks import Sizes
from hind4sight_min.sim.truth import Truth
from hind4sight_min.training import Recipe, start_run

SETTINGS = {"arena": 0.5, "cell": 0.025, "poke_length": [0.10, 0.14], "finger_radius": 0.01}
SIZES = Sizes(masks=3, width=8, head=10, embedding=6, inverse=9)
TINY = Recipe(steps=6, batch=5, warmup=2, seed=3, sizes=SIZES)


def camera(width=16, height=12, focal=20.0, x=0.0):
    """In front of the arena at `x`, looking down; principal point off the centre, and fx is not fy."""
    pose = np.eye(4)
    forward = np.array([0, 0.46, -0.62]) / np.hypot(0.46, 0.62)
    pose[:3] = np.stack([[1, 0, 0], np.cross(forward, [1, 0, 0]), forward, [x, -0.46, 0.62]], axis=1)
    return Camera(width, height, focal, 1.1 * focal, width / 2 - 0.3, height / 2 - 0.8, pose)


def tiny_pokes(count=7, seed=0, cam=None):
    """A table at z = 0 and a block 6 cm high and 10 cm wide, elsewhere before and after; the poke ends between."""
    rng, cam = np.random.default_rng(seed), cam or camera()
    size, scale = (cam.height, cam.width), cam.height // 12
    v, u = np.mgrid[:cam.height, :cam.width]
    rays = np.stack([(u - cam.cx) / cam.fx, (v - cam.cy) / cam.fy, np.ones(size)], axis=-1)
    rays, eye = rays @ cam.arena_from_camera[:3, :3].T, cam.arena_from_camera[:3, 3]

    def depth_of(height):
        return ((height - eye[2]) / rays[..., 2]).astype(np.float32)
    depth = np.repeat(depth_of(0.0)[None, None], count, axis=1).repeat(2, axis=0)
    rgb = rng.integers(60, 200, (2, count, *size, 3), dtype=np.uint8)
    places = np.empty((2, count, 2))
    for when in (0, 1):
        for i in range(count):
            top, left = scale * rng.integers(3, 7), scale * rng.integers(4, 9)
            block = slice(top, top + 3 * scale), slice(left, left + 3 * scale)
            depth[(when, i, *block)] = depth_of(0.06)[block]
            rgb[(when, i, *block, 0)] = 255
            middle = eye + rays[top + scale, left + scale] * depth[when, i, top + scale, left + scale]
            places[when, i] = middle[:2]
    pokes = np.column_stack([places.mean(axis=0), rng.uniform(-3, 3, count)]).astype(np.float32)
    starts = pokes[:, :2] - 0.11 * np.stack([np.cos(pokes[:, 2]), np.sin(pokes[:, 2])], axis=1)
    meta = {"settings": SETTINGS, "camera": cam.plain}
    return Interactions(rgb[0], rgb[1], depth[0], depth[1], pokes, starts, depth_of(0.0), cam, meta)


def random_run(recipe=TINY, seed=0, data=None):
    """A run away from its identity initialisation."""
    run = start_run(recipe, tiny_pokes() if data is None else data)
    run.vector = run.vector + 0.1 * np.random.default_rng(seed).standard_normal(run.vector.shape).astype(np.float32)
    return run


def doubled(batch):
    """A Batch in float64, for finite differences."""
    def double(scene):
        return replace(scene, points=scene.points.astype(float), images=scene.images.astype(float))
    return replace(batch, before=double(batch.before), after=double(batch.after), pokes=batch.pokes.astype(float),
                   evidence=tuple(value.astype(float) for value in batch.evidence))


def still_truth(labels):
    """The Truth of pokes with these labels (B, H, W) that move nothing; move its poses_after."""
    poses = np.zeros((len(labels), 7, 7), np.float32)
    poses[..., 6] = 1
    return Truth(labels.astype(np.uint8), poses, poses.copy())
