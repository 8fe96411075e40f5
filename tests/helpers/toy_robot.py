"""A third robot, to prove that a robot is one morphology and one configuration.

A box on the floor with a mast that slides up and down, a head on it, and two arms of two hinges.
No file outside this one knows it.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from typing import Any, ClassVar

# LeRobot makes a calibration folder for every robot and reads its place at import.
os.environ.setdefault("HF_LEROBOT_HOME", tempfile.mkdtemp(prefix="lerobot-"))

import mujoco
import numpy as np
from lerobot.robots.config import RobotConfig

from lerobot_robot_xop.config_xop import XopRobotConfig
from lerobot_robot_xop.xop_robot import XopRobot
from lerobot_teleoperator_xop import Xop, XopConfig
from xop_lerobot.core.command import CommandDim, CommandSpace, Mode
from xop_lerobot.core.state import RobotState
from xop_lerobot.low_level.factory import POLICIES
from xop_lerobot.low_level.policy import LowLevelPolicy, PolicyOutput
from xop_lerobot.morphology.contacts import Feet
from xop_lerobot.morphology.effect import Acts, Effect
from xop_lerobot.morphology.morphology import MORPHOLOGIES, ArmChain, ModelKind, Morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.session import get_session

MJCF = """
<mujoco>
  <worldbody>
    <body name="box" pos="0 0 0.2">
      <freejoint name="root"/>
      <geom type="box" size="0.3 0.3 0.2" mass="40" contype="2" conaffinity="1"/>
      <site name="foot_0" pos="0.3 0.3 -0.2"/><site name="foot_1" pos="0.3 -0.3 -0.2"/>
      <site name="foot_2" pos="-0.3 0.3 -0.2"/><site name="foot_3" pos="-0.3 -0.3 -0.2"/>
      <body name="mast" pos="0 0 0.5">
        <joint name="lift" type="slide" axis="0 0 1" range="-0.2 0.2" damping="40"/>
        <geom type="cylinder" size="0.05 0.3" mass="2" contype="0" conaffinity="0"/>
        <site name="head" pos="0 0 0.3"/>
        <camera name="head" pos="0.1 0 0.3" xyaxes="0 -1 0 0.3 0 1"/>
        <camera name="back" pos="-0.1 0 0.3" xyaxes="0 1 0 -0.3 0 1"/>
        {arms}
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="lift" joint="lift" kp="4000" forcerange="-400 400"/>
    {motors}
  </actuator>
</mujoco>
"""
ARM = """
<body name="{side}_upper" pos="0 {y} 0.2">
  <joint name="{side}_shoulder" axis="0 1 0" range="-2 2" damping="2"/>
  <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2" mass="0.5" contype="0" conaffinity="0"/>
  <body name="{side}_lower" pos="0 0 -0.2">
    <joint name="{side}_elbow" axis="0 1 0" range="-2 2" damping="2"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0.2 0 0" mass="0.5" contype="0" conaffinity="0"/>
    <site name="{side}_wrist" pos="0.2 0 0"/>
  </body>
</body>
"""
SIDES = {"left": 0.2, "right": -0.2}
ARM_JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in ("shoulder", "elbow"))


@MORPHOLOGIES.register("toy")
class Toy(Morphology):
    name = "toy"
    command_space = CommandSpace(
        (
            CommandDim("lift", "lift.pos", "m", -0.15, 0.15, 0.0, 0.5),
            CommandDim("spin", "theta.vel", "rad/s", -1.0, 1.0, 0.0, 5.0, mobile_only=True),
        )
    )
    policies = ("toy_hold",)
    frames = {name: name for name in ("head", "left_wrist", "right_wrist")}
    base_body = "box"
    arms = tuple(ArmChain(f"{side}_wrist", (f"{side}_shoulder", f"{side}_elbow")) for side in SIDES)
    arm_rest = {}
    contact_points = ("foot_0", "foot_1", "foot_2", "foot_3")
    contact_groups = (contact_points,)
    effects = (Effect(Acts.JOINT, joint="lift", lag_s=0.1), Effect(Acts.TURN, modes=()))
    fall_height = 0.1
    fall_tilt = 0.5
    contact_kind = Feet()

    def build_spec(self, kind: ModelKind) -> mujoco.MjSpec:
        del kind
        arms = "".join(ARM.format(side=side, y=y) for side, y in SIDES.items())
        motors = "".join(
            f'<position name="{joint}" joint="{joint}" kp="100"/>' for joint in ARM_JOINTS
        )
        return mujoco.MjSpec.from_string(MJCF.format(arms=arms, motors=motors))

    def standing_qpos(self) -> np.ndarray:
        return np.array([0, 0, 0.2, 1, 0, 0, 0, *np.zeros(1 + len(ARM_JOINTS))])

    def mpc_config(self, mode: Mode) -> MpcConfig:
        del mode
        return MpcConfig(num_samples=8, horizon=5, noise_std={"lift": 0.02})


@POLICIES.register("toy_hold")
class ToyHold(LowLevelPolicy):
    """The mast goes where the command says, the arms where their targets are."""

    name = "toy_hold"
    memory_size = 1

    def __init__(self, path: str | None = None) -> None:
        del path

    def initial_memory(self, n: int = 1) -> np.ndarray:
        return np.zeros((n, 1))

    def act(self, qpos, qvel, command, arms, memory, mode) -> PolicyOutput:
        del qpos, qvel, mode
        targets = np.concatenate([command[:, :1], arms], axis=1)
        return PolicyOutput(targets, memory + 1)


@RobotConfig.register_subclass("xop_toy")
@dataclass(kw_only=True)
class XopToyConfig(XopRobotConfig):
    morphology: ClassVar[str] = "toy"


class XopToy(XopRobot):
    config_class = XopToyConfig
    name = "xop_toy"


def get_state(robot: XopRobot) -> RobotState:
    """What the robot has published last."""
    state = get_session(robot.config.session).state
    assert state is not None
    return state


def observe(robot: XopRobot) -> RobotState:
    robot.get_observation()
    return get_state(robot)


SMALL: dict[str, Any] = {"width": 64, "height": 48}


def make_toy(session: str, **settings) -> XopToy:
    """A toy robot with small pictures."""
    return XopToy(XopToyConfig(session=session, **(SMALL | settings)))


def make_teleop(session: str, retargeter: str = "direct", **device) -> Xop:
    """A teleoperator that plays a built-in script."""
    settings: dict[str, Any] = {"type": "scripted", "path": "g1_squat_walk_reach", **device}
    return Xop(
        XopConfig(
            session=session,
            device=DeviceConfig(**settings),
            retargeter=RetargeterConfig(type=retargeter),
        )
    )
