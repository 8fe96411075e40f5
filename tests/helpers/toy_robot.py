"""Two more robots, to prove that a robot is one morphology, one policy and one configuration.

A box with a mast that slides up and down, a head on it, and two arms of two hinges: one stands on
the floor, the other drives on two wheels and two casters. Both set every attribute of a morphology.
No file outside this one knows them.
"""

from __future__ import annotations

import math
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
from xop_lerobot.low_level.base_drive import BaseDrive
from xop_lerobot.low_level.factory import POLICIES
from xop_lerobot.low_level.policy import LowLevelPolicy, PolicyOutput
from xop_lerobot.morphology.contacts import Feet, Wheels
from xop_lerobot.morphology.effect import Acts, Effect
from xop_lerobot.morphology.morphology import (
    MORPHOLOGIES,
    ArmChain,
    ModelKind,
    Morphology,
    Servos,
    Variant,
    WheelDrive,
    Work,
)
from xop_lerobot.morphology.tuning import Driving, MpcConfig
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.session import get_session

MJCF = """
<mujoco model="toy">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="box" pos="0 0 0.2">
      <freejoint name="root"/>
      {stand}
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
    {drive}
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
    <site name="{side}_wrist" pos="0.2 0 0" xyaxes="1 0 0 0 0 {down}"/>
    <site name="{side}_palm" pos="0.3 0 0" xyaxes="1 0 0 0 0 {down}"/>
  </body>
</body>
"""
FOOT = """
<geom name="sole" type="box" size="0.3 0.3 0.2" mass="40" contype="2" conaffinity="1"/>
<site name="foot_0" pos="0.3 0.3 -0.2"/><site name="foot_1" pos="0.3 -0.3 -0.2"/>
<site name="foot_2" pos="-0.3 0.3 -0.2"/><site name="foot_3" pos="-0.3 -0.3 -0.2"/>
"""
WHEELS = """
<geom type="box" size="0.25 0.2 0.1" pos="-0.1 0 0" mass="40" contype="0" conaffinity="0"/>
<geom name="left_caster" type="sphere" size="0.05" pos="-0.3 0.1 -0.15" mass="0" condim="1"
  priority="1" contype="0" conaffinity="1"/>
<geom name="right_caster" type="sphere" size="0.05" pos="-0.3 -0.1 -0.15" mass="0" condim="1"
  priority="1" contype="0" conaffinity="1"/>
<body name="left_wheel" pos="0.1 0.25 -0.1">
  <joint name="left_wheel" axis="0 1 0" armature="0.1"/>
  <geom name="left_wheel" type="ellipsoid" size="0.1 0.03 0.1" mass="1" contype="0"
    conaffinity="1"/>
  <site name="left_axle"/>
</body>
<body name="right_wheel" pos="0.1 -0.25 -0.1">
  <joint name="right_wheel" axis="0 1 0" armature="0.1"/>
  <geom name="right_wheel" type="ellipsoid" size="0.1 0.03 0.1" mass="1" contype="0"
    conaffinity="1"/>
  <site name="right_axle"/>
</body>
"""
DRIVE = """
<velocity name="left_wheel" joint="left_wheel" kv="50" forcerange="-40 40" ctrlrange="-20 20"/>
<velocity name="right_wheel" joint="right_wheel" kv="50" forcerange="-40 40" ctrlrange="-20 20"/>
"""
SIDES = {"left": 0.2, "right": -0.2}
ARM_JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in ("shoulder", "elbow"))


def build_toy(stand: str, drive: str = "") -> mujoco.MjSpec:
    """A toy on what it stands on, driven by so many motors before the others."""
    arms = "".join(
        ARM.format(side=side, y=y, down=math.copysign(1, -y)) for side, y in SIDES.items()
    )
    motors = "".join(
        f'<position name="{joint}" joint="{joint}" kp="100" forcerange="-100 100"/>'
        for joint in ARM_JOINTS
    )
    return mujoco.MjSpec.from_string(
        MJCF.format(stand=stand, drive=drive, arms=arms, motors=motors)
    )


@MORPHOLOGIES.register("toy")
class Toy(Morphology):
    """On one foot, moved by a policy; it turns on the spot, and nothing tells how."""

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
    arm_limits = {"left_elbow": (-0.03, 0.03)}
    contact_points = ("foot_0", "foot_1", "foot_2", "foot_3")
    contact_groups = (contact_points,)
    contact_kind = Feet()
    effects = (Effect(Acts.JOINT, joint="lift", lag_s=0.1), Effect(Acts.TURN, modes=()))
    variants = {"v1": Variant()}
    fall_height = 0.1
    fall_tilt = 0.5
    work = Work(press=0.03, walk=(0.2, 0.3))
    ramps = False
    velocity_lag_s = 0.2
    rest = None
    pivot = 0.0
    drive = None
    driving = None
    support = ()
    servos = None
    largest_offset = 0.3
    posture_limits = {}
    standing_reach = 0.1
    point_heights, top_heights = (0.5, 1.0), (0.4, 0.8)
    hull_points = {}
    hull_hands = ()

    def build_spec(self, kind: ModelKind) -> mujoco.MjSpec:
        del kind
        return build_toy(FOOT)

    def standing_qpos(self) -> np.ndarray:
        return np.array([0, 0, 0.1999, 1, 0, 0, 0, *np.zeros(1 + len(ARM_JOINTS))])

    def mpc_config(self, mode: Mode) -> MpcConfig:
        del mode
        return MpcConfig(num_samples=8, horizon=5, noise_std={"lift": 0.02})


@MORPHOLOGIES.register("rolling_toy")
class RollingToy(Toy):
    """On two wheels and two casters; mast and wheels are on servos."""

    name = "rolling_toy"
    command_space = CommandSpace(
        (
            CommandDim("roll", "x.vel", "m/s", -0.8, 0.8, 0.0, 2.0, mobile_only=True),
            CommandDim("spin", "theta.vel", "rad/s", -1.0, 1.0, 0.0, 5.0, mobile_only=True),
            CommandDim("lift", "lift.pos", "m", -0.15, 0.15, 0.0, 0.5, max_accel=5.0),
        )
    )
    policies = ("toy_roll",)
    arm_rest = {"left_elbow": 0.02, "right_elbow": 0.02}
    arm_limits = {}
    contact_points = ("left_axle", "right_axle")
    contact_groups = (("left_axle",), ("right_axle",))
    contact_kind = Wheels()
    effects = (
        Effect(Acts.FORWARD),
        Effect(Acts.TURN),
        Effect(Acts.JOINT, joint="lift", lag_s=0.05, effort=2.0),
    )
    variants = {"v1": Variant(), "hand": Variant(targets=("left_wrist",), body=("lift",))}
    fall_height = 0.0
    fall_tilt = 0.4
    work = Work(press=0.0, tray=True)
    ramps = True
    velocity_lag_s = 0.0
    rest = None
    pivot = 0.1
    drive = WheelDrive(0.1, {"left_wheel": (1, 0, -0.25), "right_wheel": (1, 0, 0.25)})
    driving = Driving(
        speed=0.8,
        acceleration=1.0,
        braking=0.8,
        turn=1.0,
        turn_acceleration=2.0,
        turn_braking=2.0,
        centripetal=0.5,
        detour_speed=0.3,
        waist=0.1,
        waist_speed=0.5,
        arrival_twist=0.1,
        turning_twist=0.1,
        lean=0.05,
    )
    support = ((0.1, -0.25), (0.1, 0.25), (-0.3, 0.1), (-0.3, -0.1))
    servos = Servos(gap=0.1, load_share=0.9)
    largest_offset = 1.0
    posture_limits = {"lift": (-0.12, 0.12)}
    standing_reach = 0.2
    point_heights, top_heights = (0.5, 1.0), (0.4, 0.8)
    hull_points = {"left_axle": 0.2, "right_axle": 0.2, "head": 0.1, "left_palm": 0.05}
    hull_hands = ("left_palm",)

    def build_spec(self, kind: ModelKind) -> mujoco.MjSpec:
        del kind
        return build_toy(WHEELS, DRIVE)

    def standing_qpos(self) -> np.ndarray:
        arms = [self.arm_rest.get(joint, 0.0) for joint in ARM_JOINTS]
        return np.array([0, 0, 0.1997, 1, 0, 0, 0, 0, 0, 0, *arms])

    def mpc_config(self, mode: Mode) -> MpcConfig:
        noise = {"lift": 0.02}
        if mode is Mode.MOBILE:
            noise |= {"roll": 0.1, "spin": 0.2}
        return MpcConfig(num_samples=8, horizon=5, noise_std=noise)


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


@POLICIES.register("toy_roll")
class ToyRoll(BaseDrive):
    """Wheels, mast and arms do as they are told."""

    name = "toy_roll"

    def __init__(self, path: str | None = None) -> None:
        super().__init__(path, RollingToy())


@RobotConfig.register_subclass("xop_toy")
@dataclass(kw_only=True)
class XopToyConfig(XopRobotConfig):
    morphology: ClassVar[str] = "toy"


class XopToy(XopRobot):
    config_class = XopToyConfig
    name = "xop_toy"


def get_state(robot: XopRobot) -> RobotState:
    """What the robot has published last."""
    tick = get_session(robot.config.session).tick
    assert tick is not None
    return tick.state


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
