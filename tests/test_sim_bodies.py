"""Objects of one's own: bodies are measured, URDF files loaded or refused, and data sets say what lay in them."""
import json
import shutil
from dataclasses import dataclass

import numpy as np
import pytest

from hind4sight_min.geometry import unproject
from hind4sight_min.lab import cli
from hind4sight_min.lab.control import SETTINGS, random_task
from hind4sight_min.lab.processes import parallel_map
from hind4sight_min.sim import bodies, collection
from hind4sight_min.sim.arena import Arena, Settings
from hind4sight_min.sim.bodies import ROUND, Urdf, add_own, measure, new_world, read_urdfs
from hind4sight_min.sim.collection import collect, collect_shard

pytest.importorskip("pybullet", reason="pybullet is not installed")
BOX = '<box size="0.08 0.06 0.05"/>'
WEDGE = "\n".join(f"{kind} {numbers}" for kind, numbers in [
    ("v", "0 0 0"), ("v", "0.06 0 0"), ("v", "0 0.08 0"), ("v", "0 0 0.04"),
    ("f", "1 3 2"), ("f", "1 2 4"), ("f", "2 3 4"), ("f", "1 4 3")])
FAST = dict(kinds=(), width=32, height=24)
ALONE = dict(kinds=(), objects_min=1, objects_max=1)


def link(name, geometry, mass=0.3, inertia="0 0 0", axes="0 0 0", place="0 0 0", turn="0 0 0", solid=True):
    shapes = [f'<{kind}><origin xyz="{place}" rpy="{turn}"/><geometry>{geometry}</geometry>{colour}</{kind}>' for
              kind, colour in (("visual", '<material name="m"><color rgba="0.9 0.1 0.1 1"/></material>'),
                               ("collision", ""))[:1 + solid]]
    return (f'<link name="{name}"><contact><lateral_friction value="0.7"/></contact><inertial>'
            f'<origin xyz="{inertia}" rpy="{axes}"/><mass value="{mass}"/>'
            f'<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>{"".join(shapes)}</link>')


def jointed(kind):
    return (link("a", '<box size="0.04 0.02 0.02"/>') + link("b", '<sphere radius="0.02"/>') + f'<joint name="j" '
            f'type="{kind}"><parent link="a"/><child link="b"/><origin xyz="0.03 0 0"/><axis xyz="0 0 1"/></joint>')


def urdf(path, joint=None, geometry=BOX, **changed):
    """Write a URDF file, of a red box of 8 x 6 x 5 cm unless told otherwise -> its path."""
    content = jointed(joint) if joint else link("a", geometry, **changed)
    path.parent.mkdir(exist_ok=True)
    path.write_text(f'<robot name="r">{content}</robot>')
    return path


# --- measuring ------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("changed, radius, reach, below, height, roundness", [
    ({}, 0.05, 0.0025 ** 0.5 * 1.118, 0.025, 0.05, 0.6),
    (dict(turn="0 0 0.5236"), 0.05, 0.0559, 0.025, 0.05, 0.6),  # 30 degrees: a step of the angles looked along
    (dict(turn="1.5707963 0 0"), np.hypot(0.04, 0.025), 0.0559, 0.03, 0.06, 0.025 / np.hypot(0.04, 0.025)),
    (dict(inertia="0.01 0 0.005"), np.hypot(0.05, 0.03), 0.0656, 0.03, 0.05, 0.03 / np.hypot(0.05, 0.03)),
    (dict(geometry='<cylinder radius="0.03" length="0.06"/>'), 0.03, 0.0424, 0.03, 0.06, 0.9952),
    (dict(geometry='<sphere radius="0.03"/>'), 0.03, 0.03, 0.03, 0.06, 1),
    (dict(geometry='<sphere radius="0.03"/>', place="0.01 0 0"), 0.04, 0.04, 0.03, 0.06, 0.5),
    (dict(geometry='<capsule radius="0.02" length="0.06"/>', turn="0 1.5707963 0"), 0.05, 0.05, 0.02, 0.04, 0.4),
    (dict(geometry='<mesh filename="wedge.obj" scale="0.5 0.5 0.5"/>'), 0.04, 0.04, 0, 0.02, 0),
    (dict(joint="fixed"), 0.05, 0.05, 0.02, 0.04, 0.2775)], ids=str)
def test_extents_by_hand(tmp_path, changed, radius, reach, below, height, roundness):
    (tmp_path / "wedge.obj").write_text(WEDGE)
    bullet = new_world()
    body, found = add_own(bullet, read_urdfs([urdf(tmp_path / "a.urdf", **changed)])[0], None)
    expected = [radius, reach, below, height, roundness]
    names = "radius", "reach", "below", "height", "roundness"
    for name, value in zip(names, expected):
        assert getattr(found, name) == pytest.approx(value, abs=2e-3 if name == "roundness" else 2e-4), (
            f"{name}: about the middle of the shape, not that of its mass?")
    assert (found.roundness > ROUND) == (roundness > 0.9)
    angle, turn = 0.7, bullet.getBasePositionAndOrientation(body)[1]
    turned = bullet.multiplyTransforms([0] * 3, [0, 0, np.sin(angle / 2), np.cos(angle / 2)], [0] * 3, turn)[1]
    bullet.resetBasePositionAndOrientation(body, [0.1, -0.2, 0.3], turned)
    again = measure(bullet, body)
    for name, value in zip(names, expected):
        tolerance = 0.02 if name == "roundness" else 2e-4  # it is looked at from 180 sides
        assert getattr(again, name) == pytest.approx(value, abs=tolerance), f"{name} changes with place and turn"
    bullet.disconnect()


def test_kinds_are_measured_as_any_body_is():
    sizes = {"can": (0.0239, 0.0341), "pot": (0.0299, 0.0421), "carton": (0.0344, 0.0506), "bracket": (0.04, 0.08)}
    seen = set()
    with Arena(Settings(kinds=tuple(sizes), width=16, height=12), np.random.default_rng(1)) as arena:
        for _ in range(6):
            arena.new_scene()
            seen |= set(arena.kinds)
            for kind, radius, is_round in zip(arena.kinds, arena.radii, arena.round, strict=True):
                assert is_round == (kind == "can"), kind
                assert sizes[kind][0] < radius < sizes[kind][1], kind
    assert seen == set(sizes)


# --- in the arena ---------------------------------------------------------------------------------------------

@pytest.mark.parametrize("inertia, scale", [("0 0 0", 1), ("0.01 0 0.02", 0.8)])
def test_a_box_from_a_file_stands_in_the_arena_as_it_stands_in_the_file(tmp_path, inertia, scale):
    own = read_urdfs([urdf(tmp_path / "a.urdf", inertia=inertia)], scale)
    with Arena(Settings(own=own, width=256, height=192, **ALONE), np.random.default_rng(3)) as arena:
        arena.new_scene()
        (rgb, depth, labels), pose, bullet = arena.observe(), arena.poses()[0].astype(float), arena.bullet
        mass, friction = bullet.getDynamicsInfo(arena.bodies[0], -1)[:2]
    assert (mass, friction) == pytest.approx((0.3, 0.7)) and arena.kinds == ["a.urdf"] and not arena.round[0]
    shift = scale * np.array([float(number) for number in inertia.split()])
    assert arena.radii[0] == pytest.approx(np.hypot(scale * 0.04 + shift[0], scale * 0.03), abs=1e-4)
    assert pose[2] == pytest.approx(scale * 0.025 + shift[2], abs=1e-3), "it does not stand on the table"
    points = unproject(depth.astype(float), arena.camera)
    turn = 2 * np.arctan2(pose[5], pose[6])
    local = (points - pose[:3]) @ [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]] + shift
    inside = (np.abs(local) < scale * np.array([0.04, 0.03, 0.025]) + 5e-4).all(axis=2) & (points[..., 2] > 2e-3)
    assert labels.any() and (inside == (labels == 1))[points[..., 2] > 2e-3].all(), "its mask is not the box"
    assert (rgb[labels == 1][:, 0] > 2 * rgb[labels == 1][:, 1]).mean() > 0.97, "not in its own colour"
    top = local[inside & (points[..., 2] > scale * 0.05 - 2e-3)]
    np.testing.assert_allclose(np.ptp(top[:, :2], axis=0), [scale * 0.08, scale * 0.06], atol=0.005)


def test_it_is_put_down_as_it_stands_in_the_file_just_above_the_table(tmp_path, monkeypatch):
    monkeypatch.setattr(Arena, "settle", lambda self, limit: True)
    own = read_urdfs(urdf(tmp_path / "a.urdf", inertia="0.01 0 -0.015", axes="1.5707963 0 0"), 0.8)
    with Arena(Settings(own=own, width=16, height=12, **ALONE), np.random.default_rng(3)) as arena:
        arena.new_scene()
        extent, pose = measure(arena.bullet, arena.bodies[0]), arena.poses()[0]
    assert extent.height == pytest.approx(0.04, abs=1e-5), "it lies on its side: the axes of its inertia are its own"
    assert pose[2] - extent.below == pytest.approx(0.001, abs=1e-6) and extent.below == pytest.approx(0.008, abs=1e-5)


def test_half_of_the_objects_are_own_where_there_are_kinds_too_and_all_where_there_are_none(tmp_path):
    own = read_urdfs([urdf(tmp_path / f"{i}.urdf", geometry=f'<box size="0.03 0.03 0.0{i}"/>') for i in (2, 3, 4)])
    for kinds, share in ((("can",), 0.5), ((), 1)):
        drawn = []
        settings = Settings(kinds=kinds, own=own, objects_min=7, objects_max=7, place_within=0.9, width=16, height=12)
        with Arena(settings, np.random.default_rng(0)) as arena:
            for _ in range(10):
                arena.new_scene()
                drawn += arena.kinds
                for i, body in enumerate(arena.bodies):
                    assert not any(arena.bullet.getClosestPoints(body, other, 0.002) for other in arena.bodies[:i])
        assert set(drawn) == {*kinds, "2.urdf", "3.urdf", "4.urdf"}
        assert np.mean([name != "can" for name in drawn]) == pytest.approx(share, abs=0.15)
    settings = Settings(own=own, objects_min=2, objects_max=7, place_within=0.2, **FAST)
    with Arena(settings, np.random.default_rng(0)) as arena:
        for _ in range(5):
            arena.new_scene()
            assert arena.bullet.getNumBodies() == len(arena.bodies) + 6, "what found no room is left"


@dataclass(frozen=True)
class Brick:
    """An object of one's own that no file describes, of random length."""
    longest: float

    @property
    def plain(self):
        return {"name": "brick", "longest": self.longest}

    def add(self, bullet, rng):
        size = [rng.uniform(0.03, self.longest) / 2, 0.015, 0.02]
        return bullet.createMultiBody(0.2, bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=size),
                                      bullet.createVisualShape(bullet.GEOM_BOX, halfExtents=size))


def test_anything_that_adds_a_body_will_do_and_too_large_a_one_is_named():
    with parallel_map(2) as spread:
        shards = [*spread(collect_shard, [Settings(own=(Brick(0.09),), **FAST)] * 2, [4] * 2, [0, 1], [3] * 2)]
    again = collect_shard(Settings(own=(Brick(0.09),), **FAST), 4, 1, 3)
    for name, value in vars(again[1]).items():
        np.testing.assert_array_equal(getattr(shards[1][1], name), value, "another process draws other objects")
    assert again[0].settings["own"] == [{"name": "brick", "longest": 0.09}]
    with pytest.raises(ValueError, match="^brick: reaches 0.[0-9]* m from its middle"):
        collect_shard(Settings(own=(Brick(5.0),), **FAST), 4, 0, 3)


# --- data sets ------------------------------------------------------------------------------------------------

def test_data_sets_know_their_objects_by_content_wherever_the_files_lie(tmp_path, monkeypatch):
    monkeypatch.setattr(collection, "SHARD_POKES", 3)
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "wedge.obj").write_text(WEDGE)
    urdf(tmp_path / "here" / "wedge.urdf", geometry='<mesh filename="package://wedge.obj"/>')
    urdf(tmp_path / "here" / "box.urdf")
    shutil.copytree(tmp_path / "here", tmp_path / "there")
    for folder in ("here", "there"):
        settings = Settings(own=read_urdfs([tmp_path / folder / "*.urdf"], 0.8), **FAST)
        with parallel_map(1 if folder == "here" else 2) as spread:
            collect(tmp_path / f"from {folder}", 6, 1, settings, spread)
    shards = [sorted((tmp_path / f"from {folder}").glob("shard_*")) for folder in ("here", "there")]
    assert [path.read_bytes() for path in shards[0]] == [path.read_bytes() for path in shards[1]]
    assert len(shards[0]) == 4
    own = collection.load_shard(shards[0][0]).settings["own"]
    assert [(each["name"], each["scale"]) for each in own] == [("box.urdf", 0.8), ("wedge.urdf", 0.8)]
    assert str(tmp_path) not in json.dumps(own)
    (tmp_path / "here" / "wedge.obj").write_text(WEDGE.replace("0.04", "0.05"))  # the mesh, not the URDF itself
    bodies.contents.cache_clear()
    changed = Settings(own=read_urdfs([tmp_path / "here" / "*.urdf"], 0.8), **FAST)
    assert [a["checksum"] == b["checksum"] for a, b in zip(changed.plain["own"], own)] == [True, False]
    with pytest.raises(ValueError, match="other settings"):
        collect(tmp_path / "from here", 6, 1, changed)
    with pytest.raises(ValueError, match="^box.urdf: has changed since it was first read"):
        collect_shard(Settings(own=(Urdf(str(tmp_path / "here" / "box.urdf"), 1.0, 123),), **FAST), 1, 0, 1)
    assert "own" not in Settings().plain, "data sets from before could not be completed"


def test_a_task_can_be_made_of_own_objects(tmp_path):
    own = read_urdfs([urdf(tmp_path / "a.urdf", geometry='<box size="0.05 0.04 0.05"/>'),
                      urdf(tmp_path / "b.urdf", geometry='<cylinder radius="0.025" length="0.04"/>')])
    with random_task(4, 2, settings=Settings(**{**vars(SETTINGS), "kinds": (), "own": own})) as task:
        assert set(task.arena.kinds) <= {"a.urdf", "b.urdf"} and len(task.movers) == 2
        assert task.arena.round == [kind == "b.urdf" for kind in task.arena.kinds]
    assert cli.main(["plan", "--urdf", str(tmp_path / "?.urdf"), "--scale", "0.9", "--policy", "greedy", "--budget",
                     "1", "--out", str(tmp_path / "plan")]) == 0
    assert (tmp_path / "plan" / "plan.gif").exists()


# --- what is refused ------------------------------------------------------------------------------------------

@pytest.mark.parametrize("changed, words", [
    (None, "nothing.urdf: expected a URDF file, got nothing there"),
    ("", "a.urdf: expected a URDF file, got an empty one"),
    ("hello", "a.urdf: Bullet cannot load it: expected a URDF file"),
    ("<mujoco/>", "a.urdf: Bullet cannot load it: expected a URDF file"),
    (dict(geometry='<mesh filename="no.obj"/>'), "a.urdf: Bullet cannot load it: it names no.obj, which is not there"),
    (dict(mass=0), "a.urdf: has no mass"),
    (dict(joint="continuous"), "a.urdf: has joints that move; expected one rigid body"),
    (dict(solid=False), "a.urdf: has no shape of finite size"),
    (dict(geometry='<plane normal="0 0 1"/>'), "a.urdf: expected boxes, spheres"),
    (dict(geometry='<box size="0.2 0.06 0.05"/>'), "a.urdf: reaches 0.107 m from its middle and is 0.050 m high as it "
                                                   "stands; expected at most .*; none is too large at a scale of 0.6"),
    (dict(geometry='<box size="0.05 0.05 0.01"/>'), "a.urdf: is 0.0100 m high as it stands; expected 0.012")], ids=str)
def test_what_cannot_be_poked_is_refused_in_one_line_before_any_work(tmp_path, capfd, changed, words):
    path = tmp_path / "a.urdf"
    if changed is None:
        path = tmp_path / "nothing.urdf"
    elif isinstance(changed, str):
        path.write_text(changed)
    else:
        urdf(path, **changed)
    assert cli.main(["collect", str(tmp_path / "out"), "--pokes", "1", "--urdf", str(path)]) == 2
    out, error = capfd.readouterr()
    assert error.count("\n") == 1 and not out, "Bullet's own messages are printed"
    with pytest.raises(ValueError, match=words) as caught:
        read_urdfs([path])
    assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()


def test_of_many_files_the_first_is_named_the_others_counted_and_a_scale_is_proposed(tmp_path):
    for name, size in (("a", 0.06), ("b", 0.2), ("c", 0.4)):
        urdf(tmp_path / f"{name}.urdf", geometry=f'<box size="{size} 0.05 0.05"/>')
    with pytest.raises(ValueError, match="^b.urdf: reaches .*2 of 3 files cannot be used.*at a scale of 0.34$"):
        read_urdfs([tmp_path / "?.urdf"])
    assert len(read_urdfs([tmp_path / "?.urdf"], 0.34)) == 3
    with pytest.raises(ValueError, match="a folder"):
        read_urdfs(tmp_path)


@pytest.mark.parametrize("scale", [0, -1.0, float("nan"), float("inf"), "1", None])
def test_scales_that_cannot_be_are_refused(scale):
    with pytest.raises(ValueError, match="^scale: expected a finite number > 0, got "):
        read_urdfs([], scale)


def test_the_examples_that_come_with_pybullet_are_found_and_bad_ones_among_them_named(capsys):
    duck, *blobs = read_urdfs(["duck_vhacd.urdf", "random_urdfs/00[0-2]/*.urdf"], 0.6)
    assert [each.plain["name"] for each in (duck, *blobs)] == ["duck_vhacd.urdf", "000.urdf", "001.urdf", "002.urdf"]
    with pytest.raises(ValueError, match="^168.urdf: .* high as it stands"):  # its mesh has no numbers
        read_urdfs(["random_urdfs/168/*.urdf"])
    assert cli.main(["collect", "nowhere", "--scale", "2"]) == 2
    assert capsys.readouterr().err.startswith("hind4sight collect: --scale: expected --urdf with it")
