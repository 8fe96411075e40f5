"""The direct mapping: what the head does, the robot is told to do, wherever it stands by now."""

from __future__ import annotations

import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import (
    make_pose,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.direct import DirectRetargeter


@pytest.fixture(scope="module", params=["g1", "rby1"])
def robot(request):
    morphology = make_morphology(request.param)
    plant = Simulation(morphology, kind="planning")
    loop = PolicyLoop(morphology, plant, make_policy(morphology.policies[0], None))
    loop.reset(0)
    state = loop.state
    head = plant.get_site_pose(morphology.frames["head"])
    return morphology, plant.model, state, head


def plan(robot, pose, velocity=(0, 0, 0, 0, 0, 0), mode=Mode.MOBILE):
    morphology, model, state, _ = robot
    retargeter = DirectRetargeter(morphology, model)
    retargeter.reset(state)
    goal = Goal({"head": pose}, {"head": np.array(velocity, dtype=float)}, mode)
    command = retargeter.plan(state, goal).command
    return dict(zip(morphology.command_space.names, command, strict=True))


def turned(robot, yaw):
    head = robot[3]
    return make_pose(head[:3], quat_multiply(quat_from_yaw(yaw), head[3:]))


@pytest.mark.parametrize("yaw", [0.0, 0.8, 2.5])
def test_who_walks_ahead_makes_the_robot_walk_ahead(robot, yaw):
    """Also where the robot has drifted and looks elsewhere than the person."""
    ahead = turned(robot, yaw)
    velocity = (*quat_rotate(ahead[3:], np.array([0.4, 0, 0]))[:2], 0, 0, 0, 0.1)
    command = plan(robot, ahead, velocity)
    assert command["vx" if "vx" in command else "v"] == pytest.approx(0.4, abs=0.02)
    assert command.get("vy", 0.0) == pytest.approx(0, abs=0.02)
    assert command["yaw_rate"] == pytest.approx(0.1)
    standing = plan(robot, ahead, velocity, Mode.STATIONARY)
    assert standing["yaw_rate"] == 0


@pytest.mark.parametrize("mode", list(Mode))
def test_a_heading_out_of_reach_bends_nothing(robot, mode):
    """Roll and pitch of the waist are not used up for a heading that it cannot turn to."""
    straight = plan(robot, turned(robot, 0.0), mode=mode)
    away = plan(robot, turned(robot, 2.8), mode=mode)
    waist = {"waist_yaw", "torso_5", "head_0"}
    for name, value in straight.items():
        if name not in waist:
            assert away[name] == pytest.approx(value, abs=0.06), name


def test_a_lean_is_a_lean_wherever_the_robot_looks(robot):
    """The head's pitch, in its own heading, becomes the robot's."""
    lean = quat_from_rpy(0.0, 0.2, 0.0)
    head = robot[3]
    bent = make_pose(head[:3], quat_multiply(head[3:], lean))
    there = make_pose(head[:3], quat_multiply(quat_from_yaw(2.8), bent[3:]))
    here, away = plan(robot, bent), plan(robot, there)
    for name in ("waist_pitch", "waist_roll"):
        if name in here:
            assert away[name] == pytest.approx(here[name], abs=0.03)


def test_what_drifted_in_motion_does_not_turn_the_waist_at_rest(robot):
    """The switch to standing makes no step: the waist turns from there on."""
    morphology, model, state, _ = robot
    retargeter = DirectRetargeter(morphology, model)
    retargeter.reset(state)
    name = "waist_yaw" if "waist_yaw" in morphology.command_space.names else "torso_5"
    index = morphology.command_space.index(name)
    moving = retargeter.plan(state, Goal({"head": turned(robot, 0.8)}, mode=Mode.MOBILE))
    standing = retargeter.plan(state, Goal({"head": turned(robot, 0.8)}))
    assert standing.command[index] == pytest.approx(moving.command[index], abs=0.02)
    looking = retargeter.plan(state, Goal({"head": turned(robot, 1.2)}))
    assert looking.command[index] - standing.command[index] == pytest.approx(0.4, abs=0.05)
