"""Obstacles: distances against MuJoCo and brute force, what of a scene counts, the YAML file."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_robot_xop import XopG1, XopG1Config
from lerobot_teleoperator_xop import Xop, XopConfig
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import quat_exp, quat_from_rpy, quat_rotate
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import MORPHOLOGIES, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget import factory
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.costs import CollisionCost
from xop_lerobot.retarget.factory import make_retargeter
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.obstacles import (
    SHAPES,
    BadObstacles,
    Obstacle,
    ObstacleSet,
    load_obstacles,
    make_obstacles,
)
from xop_lerobot.session import RobotInfo
from xop_lerobot.teleoperation import Teleoperation, TeleoperationConfig

BOX = Obstacle(
    "box", np.array([0.5, -0.2, 0.4]), quat_from_rpy(0.2, 0.4, 0.9), np.array([0.3, 0.1, 0.2])
)
SCENE = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 1"/>
  <geom name="wall" type="box" size="0.1 2 1" pos="3 0 1"/>
  <geom name="picture" type="box" size="0.1 1 1" pos="2 0 1" contype="0" conaffinity="0"/>
  <geom name="ball" type="sphere" size="0.3" pos="-1 0 0.3"/>
  <geom name="egg" type="ellipsoid" size="0.1 0.2 0.3" pos="-2 0 0.3"/>
  <body pos="0 1 0.5" euler="0 0 90"><geom name="post" type="cylinder" size="0.1 0.5"/>
    <body pos="0 0 0.6"><geom name="rail" type="capsule" size="0.05" fromto="0 0 0 1 0 0"/></body>
  </body>
  <body name="door"><joint axis="0 0 1"/><geom name="door" type="box" size="0.5 0.05 1"/></body>
  <body name="parcel" pos="1 1 1"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
</worldbody></mujoco>"""


def draw_obstacles(rng: np.random.Generator, count: int) -> list[Obstacle]:
    """Obstacles of every shape in turn, anywhere, any way up."""
    obstacles = []
    for i in range(count):
        shape, half = SHAPES[i % len(SHAPES)], rng.uniform(0.1, 0.5, 3)
        if shape != "box":
            half[1] = half[0]
            half[2] = half[0] if shape == "sphere" else half[0] + rng.uniform(0.05, 0.5)
        quat = quat_exp(rng.normal(size=3))
        obstacles.append(Obstacle(f"{shape}_{i}", rng.uniform(-1, 1, 3), quat, half, shape))
    return obstacles


def test_all_at_once_equals_one_by_one():
    rng = np.random.default_rng(0)
    obstacles = draw_obstacles(rng, 13)
    points = rng.uniform(-1.5, 1.5, (6, 5, 4, 3))
    distances = ObstacleSet(obstacles).compute_distances(points)
    assert distances.shape == (6, 5, 4, 13)
    for j, obstacle in enumerate(obstacles):
        np.testing.assert_allclose(distances[..., j], obstacle.compute_distance(points), atol=1e-12)
    some = np.array([7, 2])
    np.testing.assert_array_equal(
        ObstacleSet(obstacles).compute_distances(points, some), distances[..., some]
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_distances_equal_those_of_mujoco(shape):
    """To a small sphere; MuJoCo measures depths along other directions, so outside alone."""
    sizes = {"box": "0.3 0.1 0.2", "sphere": "0.3", "cylinder": "0.2 0.3", "capsule": "0.2 0.3"}
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco><worldbody>
  <geom type="{shape}" size="{sizes[shape]}" pos="0.2 0.1 0.3" euler="20 40 60"/>
  <body><freejoint/><geom type="sphere" size="0.01"/></body>
</worldbody></mujoco>""")
    (obstacle,) = make_obstacles(model)
    assert obstacle.shape == shape
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    checked = 0
    for _ in range(100):
        data.qpos[:3] = rng.uniform(-1, 1.5, 3)
        mujoco.mj_kinematics(model, data)
        expected = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
        if expected > 0.01:
            got = obstacle.compute_distance(data.qpos[:3]) - 0.01
            # MuJoCo's general convex solver stops at a tolerance of its own.
            assert got == pytest.approx(expected, abs=1e-4 if shape == "cylinder" else 1e-6)
            checked += 1
    assert checked > 60


@given(st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(np.array))
def test_distance_to_a_box_equals_brute_force(point):
    """The nearest of many points of the surface, in the box's own frame."""
    surface = sample_surface(BOX.half_size, 25)
    world = BOX.position + quat_rotate(BOX.quat, surface)
    nearest = np.linalg.norm(world - point, axis=1).min()
    distance = BOX.compute_distance(point)
    assert abs(abs(distance) - nearest) < 0.02  # the spacing of the points


def sample_surface(half: np.ndarray, count: int) -> np.ndarray:
    grid = np.linspace(-1, 1, count)
    u, v = (g.ravel() for g in np.meshgrid(grid, grid))
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            face = np.stack([u, v], axis=1)
            faces.append(np.insert(face, axis, sign, axis=1))
    return np.concatenate(faces) * half


@pytest.mark.parametrize(
    "shape, local, distance",
    [
        ("box", [0.4, 0, 0], 0.1),  # beside a face
        ("box", [0.3, 0, 0], 0.0),  # on it
        ("box", [0.0, 0.0, 0.0], -0.1),  # the thinnest way out of the middle
        ("box", [0.6, 0.5, 0.2], 0.5),  # off an edge, 3-4-5
        ("sphere", [0.0, 0.0, 0.1], -0.2),
        ("cylinder", [0.0, 0.0, 0.0], -0.3),
        ("cylinder", [0.1, 0.0, 0.45], -0.05),  # below the lid
        ("cylinder", [0.0, 0.6, 0.9], 0.5),  # off the rim, 3-4-5
        ("capsule", [0.0, 0.0, 0.9], 0.4),  # above the cap
        ("capsule", [0.2, 0.0, 0.1], -0.1),
    ],
)
def test_distance_on_cases_made_by_hand(shape, local, distance):
    half = {"box": [0.3, 0.1, 0.2], "sphere": [0.3] * 3}.get(shape, [0.3, 0.3, 0.5])
    obstacle = Obstacle("it", np.array([1.0, 2, 3]), BOX.quat, np.array(half), shape)
    point = obstacle.position + quat_rotate(obstacle.quat, np.array(local))
    assert obstacle.compute_distance(point) == pytest.approx(distance, abs=1e-12)
    assert ObstacleSet([obstacle]).compute_distances(point)[0] == pytest.approx(distance, abs=1e-12)


def test_near_obstacles_are_all_that_is_near():
    rng = np.random.default_rng(2)
    obstacles = ObstacleSet(draw_obstacles(rng, 40))
    left_out = 0
    for _ in range(30):
        points = rng.uniform(-3, 3, 3) + rng.uniform(-0.3, 0.3, (8, 3))
        near = set(obstacles.find_near(points, 0.5).tolist())
        really = set(np.flatnonzero((obstacles.compute_distances(points) < 0.5).any(0)).tolist())
        assert really <= near
        left_out += 40 - len(near)
    assert left_out > 600
    assert len(obstacles.find_near(np.full((2, 3), np.nan), 0.5)) == 40  # nothing is known


def test_no_obstacles_give_no_distances():
    assert ObstacleSet().compute_distances(np.zeros((2, 3))).shape == (2, 0)
    assert len(ObstacleSet().find_near(np.zeros((2, 3)), 1.0)) == 0


# -- from a scene --------------------------------------------------------------------------


def test_obstacles_are_what_is_fixed_and_solid():
    model = mujoco.MjModel.from_xml_string(SCENE)
    obstacles = {obstacle.name: obstacle for obstacle in make_obstacles(model)}
    assert set(obstacles) == {"wall", "ball", "egg", "post", "rail"}
    shapes = {name: obstacle.shape for name, obstacle in obstacles.items()}
    assert shapes == {
        "wall": "box", "ball": "sphere", "egg": "box", "post": "cylinder", "rail": "capsule",
    }  # fmt: skip
    np.testing.assert_allclose(obstacles["wall"].position, [3, 0, 1])
    np.testing.assert_allclose(obstacles["post"].half_size, [0.1, 0.1, 0.5])
    # The rail leads along the world's Y from the post, 1 m and two caps long.
    rail = obstacles["rail"]
    np.testing.assert_allclose(rail.position, [0, 1.5, 1.1], atol=1e-9)
    assert rail.compute_distance(np.array([0, 2.15, 1.1])) == pytest.approx(0.1)
    assert rail.compute_distance(np.array([0.15, 1.5, 1.1])) == pytest.approx(0.1)


def test_what_moves_counts_where_it_is_if_it_is_named():
    model = mujoco.MjModel.from_xml_string(SCENE)
    at_start = {each.name: each for each in make_obstacles(model, movable=["parcel"])}
    np.testing.assert_allclose(at_start["parcel"].position, [1, 1, 1])
    data = mujoco.MjData(model)
    data.qpos[1:4] = [-1, 2, 0.1]
    now = {each.name: each for each in make_obstacles(model, ["parcel"], data)}
    np.testing.assert_allclose(now["parcel"].position, [-1, 2, 0.1])
    with pytest.raises(UnknownName) as raised:
        make_obstacles(model, movable=["crate"])
    assert str(raised.value) == "unknown movable body 'crate'. Known: door, parcel"


@pytest.mark.parametrize("scene, count", [("empty", 0), ("room", 4), ("tabletop", 5)])
def test_the_scenes_have_their_walls_and_tables(scene, count):
    """The robot in the scene is none of its obstacles."""
    model = build_model(make_morphology("rby1"), "full", scene=scene)
    assert len(make_obstacles(model)) == count


def test_an_obstacle_has_a_shape_and_sizes():
    with pytest.raises(UnknownName) as raised:
        Obstacle("a", np.zeros(3), np.array([1.0, 0, 0, 0]), np.ones(3), "cone")
    assert str(raised.value) == (
        "unknown shape of an obstacle 'cone'. Known: box, capsule, cylinder, sphere"
    )
    with pytest.raises(BadValue) as bad:
        Obstacle("a", np.zeros(3), np.array([1.0, 0, 0, 0]), np.array([1.0, 0, 1]))
    assert str(bad.value) == "obstacle 'a': sizes must be positive, got [1. 0. 1.]"


# -- from a file ---------------------------------------------------------------------------

FILE = """
obstacles:
  - {name: wall, shape: box, position: [2, 0, 1.25], rpy: [0, 0, 1.5708], size: [4, 0.1, 2.5]}
  - {name: pillar, shape: cylinder, position: [0, 1, 1], radius: 0.2, length: 2}
  - {shape: sphere, position: [1, 1, 0.3], radius: 0.3}
  - {shape: capsule, position: [0, 0, 1], rpy: [0, 1.5708, 0], radius: 0.1, length: 1}
"""


def write(folder, text: str) -> str:
    path = folder / "obstacles.yaml"
    path.write_text(text)
    return str(path)


def test_a_file_gives_its_obstacles(tmp_path):
    wall, pillar, ball, pipe = load_obstacles(write(tmp_path, FILE))
    assert [each.name for each in (wall, pillar, ball, pipe)] == [
        "wall", "pillar", "sphere_3", "capsule_4",
    ]  # fmt: skip
    # 4 m long, turned by a quarter: along Y.
    assert wall.compute_distance(np.array([2, 2.5, 1])) == pytest.approx(0.5, abs=1e-4)
    assert pillar.compute_distance(np.array([0.5, 1, 1])) == pytest.approx(0.3)
    assert ball.compute_distance(np.array([1, 1, 1])) == pytest.approx(0.4)
    assert pipe.compute_distance(np.array([0.7, 0, 1])) == pytest.approx(0.2, abs=1e-4)


@pytest.mark.parametrize(
    "text, fault",
    [
        ("walls: []", "must hold 'obstacles:' and a list of them"),
        ("obstacles:", "must hold 'obstacles:' and a list of them"),
        ("obstacles: [3]", "obstacle 1: must be keys and values, got 3"),
        (
            "obstacles: [{shape: cone}]",
            "obstacle 1: unknown shape 'cone'. Known: box, capsule, cylinder, sphere",
        ),
        ("obstacles: [{name: a, shape: box}]", "obstacle 1 ('a'): a box needs 'position'"),
        (
            "obstacles: [{shape: sphere, position: [0, 0, 0], radius: 1, length: 2}]",
            "obstacle 1: unknown key 'length'. Known of a sphere: "
            "name, position, radius, rpy, shape",
        ),
        (
            "obstacles: [{shape: box, position: [0, 0], size: [1, 1, 1]}]",
            "obstacle 1: 'position' must be a list of 3 numbers [m], got [0, 0]",
        ),
        (
            "obstacles: [{shape: sphere, position: [0, 0, 0], radius: wide}]",
            "obstacle 1: 'radius' must be a number [m], got 'wide'",
        ),
        (
            "obstacles: [{shape: sphere, position: [0, 0, .nan], radius: 1}]",
            "obstacle 1: 'position' must be finite, got [0, 0, nan]",
        ),
        (
            "obstacles: [{shape: box, position: [0, 0, 0], size: [1, -1, 1]}]",
            "obstacle 1: 'size' must be positive [m], got [1, -1, 1]",
        ),
        (
            "obstacles: [{shape: capsule, position: [0, 0, 0], radius: 0.3, length: 0.5}]",
            "obstacle 1: 'length' holds both caps, so it must be at least twice the radius, "
            "0.6 m, got 0.5",
        ),
        (
            "obstacles: [{name: a, shape: sphere, position: [0, 0, 0], radius: 1}, "
            "{name: a, shape: sphere, position: [0, 0, 0], radius: 1}]",
            "the name 'a' is used twice",
        ),
    ],
)
def test_a_fault_of_the_file_is_named(tmp_path, text, fault):
    path = write(tmp_path, text)
    with pytest.raises(BadObstacles) as raised:
        load_obstacles(path)
    assert str(raised.value) == f"obstacles '{path}': {fault}"


def test_a_file_that_is_not_there_or_no_yaml(tmp_path):
    with pytest.raises(BadObstacles) as raised:
        load_obstacles(tmp_path / "none.yaml")
    expected = f"obstacles '{tmp_path / 'none.yaml'}': cannot be read: No such file or directory"
    assert str(raised.value) == expected
    with pytest.raises(BadObstacles, match="is no YAML"):
        load_obstacles(write(tmp_path, "obstacles: ["))


BLIND = {
    ("g1", "mpc"): "robot 'g1' does not avoid obstacles. Robots that do: rby1, rby1m",
    ("rby1", "direct"): "retargeter 'direct' does not avoid obstacles. Retargeters that do: mpc",
}


@pytest.fixture(autouse=True)
def without_toys(monkeypatch):
    """Robots that other tests have registered are in no text."""
    monkeypatch.setattr(factory, "MORPHOLOGIES", MORPHOLOGIES.built_in)


@pytest.mark.parametrize("robot, kind", BLIND)
def test_a_file_that_would_be_ignored_is_refused(tmp_path, robot, kind):
    morphology = make_morphology(robot)
    config = RetargeterConfig(type=kind, threads=1, obstacles=write(tmp_path, FILE))
    with pytest.raises(BadValue) as refusal:
        make_retargeter(
            config,
            morphology,
            make_policy(morphology.policies[0]),
            build_model(morphology, "planning"),
        )
    text = f"obstacles '{config.obstacles}' would be ignored: {BLIND[robot, kind]}"
    assert str(refusal.value) == text


def test_it_is_refused_before_anything_is_recorded(tmp_path):
    robot = XopG1(XopG1Config(session="obstacles", cameras=[]))
    retargeter = RetargeterConfig(obstacles=write(tmp_path, FILE))
    with pytest.raises(
        BadValue, match="robot 'g1' does not avoid obstacles. Robots that do: rby1, rby1m"
    ):
        Xop(XopConfig(session="obstacles", retargeter=retargeter))
    robot.disconnect()


@pytest.mark.parametrize("robot, kind", BLIND)
def test_a_scene_whose_obstacles_are_ignored_is_warned_of_once(caplog, robot, kind):
    factory._warn_once.cache_clear()
    morphology = make_morphology(robot)
    for _ in range(2):
        factory.warn_of_scene(kind, morphology, "room")
        factory.warn_of_scene(kind, morphology, "empty")
        factory.warn_of_obstacles(kind, morphology, "tabletop", 1)
    count = len(make_obstacles(build_model(morphology, "full", scene="room")))
    assert caplog.messages == [
        f"{count} obstacles in scene 'room' ignored: {BLIND[robot, kind]}.",
        f"1 obstacle in scene 'tabletop' ignored: {BLIND[robot, kind]}.",
    ]


def test_no_warning_where_they_are_kept_clear_of(caplog):
    factory.warn_of_scene("mpc", make_morphology("rby1"), "room")
    factory.warn_of_obstacles("mpc", make_morphology("rby1"), "room", 3)
    assert caplog.messages == []


def test_who_drives_a_g1_in_a_room_is_warned(caplog):
    factory._warn_once.cache_clear()
    morphology = make_morphology("g1")
    info = RobotInfo("xop_g1", morphology, "default", None, "room", 25, 0)
    config = TeleoperationConfig(retargeter=RetargeterConfig(type="direct"))
    Teleoperation(config, info).disconnect()
    assert "in scene 'room' ignored: retargeter 'direct' does not avoid obstacles" in caplog.text


def test_a_file_adds_to_the_scene(tmp_path):
    morphology = make_morphology("rby1")
    model = build_model(morphology, "planning")
    scene = make_obstacles(build_model(morphology, "full", scene="room"))
    config = RetargeterConfig(threads=1, obstacles=write(tmp_path, FILE))
    retargeter = make_retargeter(config, morphology, make_policy("diff_drive"), model, scene)
    assert isinstance(retargeter, MpcRetargeter)
    (collision,) = (cost for cost in retargeter.problem.costs if isinstance(cost, CollisionCost))
    names = [obstacle.name for obstacle in collision.obstacles.obstacles]
    assert names == [
        *(obstacle.name for obstacle in scene),
        "wall",
        "pillar",
        "sphere_3",
        "capsule_4",
    ]
    retargeter.close()
