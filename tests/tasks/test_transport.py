"""Non-prehensile transport: the toy on the palm, obstacles, the opening, and what counts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from carry import Carry

from xop_lerobot.core.transforms import make_pose, quat_multiply
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.tasks import non_prehensile_transport as transport
from xop_lerobot.tasks.furniture import Touching, compute_tilt
from xop_lerobot.tasks.stage import Stage

TASK = "non_prehensile_transport"
ROBOTS = ("g1", "rby1")
FLIP = np.array([0.0, 1, 0, 0])


def make_stage(robot: str, seed: int = 0) -> tuple[Stage, PolicyLoop]:
    morphology = make_morphology(robot)
    stage = Stage(morphology, TASK)
    loop = PolicyLoop(morphology, stage.plant, make_policy(morphology.policies[0]))
    loop.reset(seed, start=stage.start)
    stage.reset(seed)
    return stage, loop


def run(stage: Stage, loop: PolicyLoop, seconds: float) -> None:
    for _ in range(round(seconds / 0.02)):
        loop.advance(0.02)
        stage.update()


def drop_into(stage: Stage, height: float = -0.05) -> None:
    """Put the toy over the opening, or into it, and let it go."""
    stage.plant.data.eq_active[:] = 0
    opening = stage.task.objects["opening"].pose
    stage.plant.set_object_pose("toy", opening + [0, 0, height, 0, 0, 0, 0])


@pytest.mark.parametrize("robot", ROBOTS)
def test_opening_is_ten_by_five_centimetres_and_the_toy_fits(robot):
    stage, _ = make_stage(robot)
    seen = stage.task.objects
    assert tuple(2 * seen["opening"].size[:2]) == (0.10, 0.05)
    assert np.hypot(*(2 * np.array(transport.TOY[1:]))) < 0.05
    top = seen["container"].pose[2] + seen["container"].size[2]
    assert top == pytest.approx(seen["opening"].pose[2])


@pytest.mark.parametrize("robot", ROBOTS)
def test_palm_begins_up_with_the_toy_on_it(robot):
    stage, _ = make_stage(robot)
    palm = stage.plant.get_site_pose("left_palm")
    up = compute_tilt(quat_multiply(palm[3:], FLIP))
    assert up < 0.1
    toy = stage.task.objects["toy"].pose
    assert np.linalg.norm(toy[:3] - palm[:3]) < 0.1
    assert Touching(stage.plant, "toy").find() <= {"robot"}


@pytest.mark.parametrize("robot", ROBOTS)
def test_toy_is_held_until_the_palm_is_level_and_still(robot):
    stage, loop = make_stage(robot)
    run(stage, loop, 1.2)
    assert stage.status.figures["carried"] == 0
    run(stage, loop, 1.0)
    assert stage.status.figures["carried"] == 1


def test_toy_lies_on_a_palm_at_rest():
    stage, loop = make_stage("rby1")
    run(stage, loop, 2.0)
    palm = stage.plant.get_site_pose("left_palm")[:3]
    before = stage.plant.get_object_pose("toy")[:3] - palm
    run(stage, loop, 4.0)
    after = stage.plant.get_object_pose("toy")[:3] - stage.plant.get_site_pose("left_palm")[:3]
    assert np.linalg.norm(after - before) < 0.003
    assert not stage.status.failure


@pytest.mark.parametrize("robot", ROBOTS)
def test_nothing_touches_the_robot_at_the_start(robot):
    stage, _ = make_stage(robot)
    for seed in range(15):
        stage.plant.reset(seed)
        stage.reset(seed)
        assert stage.plant.measure().contacts in ((), (("left_wrist_yaw_link", "toy"),),
                                                  (("ee_left", "toy"),))  # fmt: skip


def test_obstacle_stands_between_palm_and_opening_and_hinders():
    """A palm that goes straight at its height would run into it."""
    stage, _ = make_stage("rby1")
    assert isinstance(stage.task, transport.NonPrehensileTransport)
    for seed in range(15):
        stage.reset(seed)
        seen, palm = stage.task.objects, stage.task.start_palm
        obstacle, opening = seen["obstacle_0"], seen["opening"].pose
        assert opening[1] < obstacle.pose[1] < palm[1]
        assert abs(obstacle.pose[0] - palm[0]) < obstacle.size[1]
        assert obstacle.pose[2] + obstacle.size[2] > palm[2] + 0.015


def test_touching_an_obstacle_loses():
    stage, _ = make_stage("rby1")
    stage.plant.take_touches = lambda: {("ee_left", "container")}
    assert not stage.update().failure
    stage.plant.take_touches = lambda: {("ee_left", "obstacle_0")}
    status = stage.update()
    assert status.failure == "the ee_left touched obstacle_0"
    assert status.done


def test_toy_on_the_floor_is_lost():
    stage, loop = make_stage("rby1")
    stage.plant.data.eq_active[:] = 0
    stage.plant.set_object_pose("toy", make_pose(np.array([1.0, 1.0, 0.02]), np.eye(4)[0]))
    run(stage, loop, 0.2)
    assert stage.status.failure == "the toy was dropped"


@pytest.mark.parametrize("height", [0.05, -0.05])
def test_toy_in_the_container_is_success(height):
    stage, loop = make_stage("rby1")
    drop_into(stage, height)
    run(stage, loop, 1.5)
    assert stage.status.success


def test_toy_on_the_rim_is_none():
    stage, loop = make_stage("rby1")
    drop_into(stage, 0.2)
    opening = stage.task.objects["opening"].pose
    beside = opening + [0, transport.OPENING[0] + 0.06, 0, 0, 0, 0, 0]
    stage.plant.set_object_pose("toy", beside)
    run(stage, loop, 1.0)
    assert not stage.status.success


@pytest.mark.slow
def test_arm_alone_carries_the_toy_over_the_obstacle_and_delivers_it():
    """By kinematics, in reach without driving: so it is for torso and arm together."""
    carry = Carry("rby1", seed=0)
    carry.deliver()
    status = carry.stage.status
    assert status.success, status.failure
    assert status.collisions == ()
    tilts = [figures["tilt_rad"] for figures in carry.figures if figures["carried"]]
    assert np.median(tilts) < 0.03  # the end of it is the release


def test_tray_is_flat_and_on_the_hand():
    stage, _ = make_stage("rby1")
    model = stage.plant.model
    tray = model.geom("left_tray")
    assert tuple(2 * tray.size[:2]) == (0.1, 0.1)
    gap = mujoco.mj_geomDistance(
        model, stage.plant.data, tray.id, model.geom("left_hand").id, 1.0, None
    )
    assert abs(gap) < 0.001
