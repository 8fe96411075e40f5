"""Rainbow Robotics RB-Y1 A v1.2: differential-drive base, 6-joint torso, two 7-joint arms."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.command import CommandDim, CommandSpace, Mode
from xop_lerobot.morphology.contacts import Wheels
from xop_lerobot.morphology.morphology import (
    ArmChain,
    ModelKind,
    Morphology,
    Servos,
    Variant,
    WheelDrive,
    Work,
)
from xop_lerobot.morphology.rby1.links import LINKS
from xop_lerobot.morphology.rby1.mpc import (
    DRIVING,
    EFFECTS,
    HULL,
    PIVOT,
    POSTURE_LIMITS,
    STANDING_REACH,
    SUPPORT,
    V2_CONFIG,
    mpc_config,
)
from xop_lerobot.morphology.rby1.shapes import TRACK, WHEEL_RADIUS
from xop_lerobot.morphology.tuning import PaperParameters

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.tuning import MpcConfig

TORSO_READY = tuple(math.radians(angle) for angle in (0, 45, -90, 45, 0, 0))
"""Torso angles at the ready pose [rad]."""

ARM_READY = tuple(math.radians(angle) for angle in (0, 5, 0, -120, 0, 45, 0))
"""Left arm angles at the ready pose [rad]; joints 0, 2, 4 and 6 are 0, joint 1 is mirrored."""

TORSO_RATES = (0.4, 0.5, 0.8, 0.6, 0.5, 1.2)
"""Rate limits of the torso commands [rad/s]. The joints allow 2.09 and 3.14, but `torso_1` carries
57 kg: reversing it at full rate takes more than its 270 N m, and the torso folds."""

NECK_ACCELERATION = 60.0
"""Largest acceleration of the neck commands [rad/s²]; the head is light."""

BASE_HEIGHT = -0.0006
"""Height of the base frame at rest [m]; wheels and casters sink in by their compliance."""

GRIPPER_OPEN = 0.05
"""Position of one finger of an open gripper [m]."""


def make_torso_dims() -> tuple[CommandDim, ...]:
    """Make the command entries of the torso, with the limits of the link table."""
    joints = {link.joint.name: link.joint for link in LINKS if link.joint is not None}
    dims = []
    for i, ready in enumerate(TORSO_READY):
        low, high = joints[f"torso_{i}"].limits or (-math.pi, math.pi)
        name = f"torso_{i}"
        rate = TORSO_RATES[i]
        key = f"{name}.pos"
        dims.append(CommandDim(name, key, "rad", low, high, ready, rate, max_accel=10 * rate))
    return tuple(dims)


def make_neck_dims() -> tuple[CommandDim, ...]:
    """Return the command entries of the neck: it turns and nods without the torso."""
    joints = {link.joint.name: link.joint for link in LINKS if link.joint is not None}
    dims = []
    for name in ("head_0", "head_1"):
        joint = joints[name]
        low, high = joint.limits or (-math.pi, math.pi)
        dims.append(
            CommandDim(
                name,
                f"{name}.pos",
                "rad",
                low,
                high,
                0.0,
                joint.velocity,
                max_accel=NECK_ACCELERATION,
                alone=True,
            )
        )
    return tuple(dims)


class RBY1(Morphology):
    """RB-Y1 A with the command base velocity and torso joint angles."""

    name = "rby1"
    command_space = CommandSpace(
        (
            # name, key, unit, low, high, neutral, largest rate and acceleration
            CommandDim("v", "x.vel", "m/s", -1.2, 1.2, 0.0, 1.5, mobile_only=True, max_accel=50.0),
            CommandDim(
                "yaw_rate",
                "theta.vel",
                "rad/s",
                -1.5,
                1.5,
                0.0,
                3.0,
                mobile_only=True,
                max_accel=100.0,
            ),
            *make_torso_dims(),
            *make_neck_dims(),
        )
    )
    policies = ("diff_drive",)
    frames = {"head": "head", "left_wrist": "left_wrist", "right_wrist": "right_wrist"}
    base_body = "base"
    arms = tuple(
        ArmChain(
            f"{side}_wrist",
            tuple(f"{side}_arm_{i}" for i in range(len(ARM_READY))),
            f"{side}_gripper",
            (0.0, GRIPPER_OPEN),
        )
        for side in ("left", "right")
    )
    arm_rest = {
        f"{side}_arm_{i}": -angle if side == "right" and i == 1 else angle
        for side in ("left", "right")
        for i, angle in enumerate(ARM_READY)
    }
    contact_points = ("left_wheel_center", "right_wheel_center")
    contact_groups = (("left_wheel_center",), ("right_wheel_center",))
    variants = {
        "v1": Variant(
            paper={
                Mode.STATIONARY: PaperParameters(30, 3, 0.01, 25.0),
                Mode.MOBILE: PaperParameters(30, 10, 0.01, 10.0),
            }
        ),
        # The paper's Version 2: the left hand controls torso and left arm, in either mode.
        "v2": Variant(
            targets=("left_wrist",),
            body=(
                *(f"torso_{i}" for i in range(len(TORSO_READY))),
                *(f"left_arm_{i}" for i in range(len(ARM_READY))),
            ),
            configs=dict.fromkeys(Mode, V2_CONFIG),
            paper=dict.fromkeys(Mode, PaperParameters(50, 3, 0.01, 25.0)),
        ),
    }
    effects = EFFECTS
    velocity_lag_s = 0.0
    pivot = PIVOT
    support = SUPPORT
    # A servo at its torque limit may rest anywhere in its range.
    largest_offset = 1.0
    # In motion the servos lag by 0.05 rad, for a moment by 0.2 rad when bending quickly; a torso
    # that folds keeps an error of 0.3 to 1.5 rad.
    servos = Servos(gap=0.15)
    posture_limits = POSTURE_LIMITS
    standing_reach = STANDING_REACH
    # The wheel joints turn about -Y, hence the negative coefficients.
    drive = WheelDrive(
        WHEEL_RADIUS, {"right_wheel": (-1, 0, -0.5 * TRACK), "left_wheel": (-1, 0, 0.5 * TRACK)}
    )
    driving = DRIVING
    point_heights, top_heights = (0.25, 1.5), (0.3, 1.3)
    # An object would fall through the gap between the fingers: the hand needs a tray.
    work = Work(press=0.01, tray=True)
    hull_points = HULL
    hull_hands = ("left_palm", "right_palm")
    fall_height = -0.2
    fall_tilt = 0.35
    contact_kind = Wheels()
    # Its servos follow within 10 ms, so steps of the targets would shake the hands.
    ramps = True

    def build_spec(self, kind: ModelKind) -> mujoco.MjSpec:
        """Build RB-Y1 without a scene."""
        from xop_lerobot.morphology.rby1.model import build_rby1  # noqa: PLC0415

        return build_rby1(kind)

    def standing_qpos(self) -> np.ndarray:
        """Configuration at the ready pose, grippers open: free joint, then the joints. (35,)."""
        angles = dict(self.arm_rest)
        angles |= {f"torso_{i}": ready for i, ready in enumerate(TORSO_READY)}
        angles |= {f"gripper_finger_{side}1": -GRIPPER_OPEN for side in "lr"}
        angles |= {f"gripper_finger_{side}2": GRIPPER_OPEN for side in "lr"}
        joints = [angles.get(link.joint.name, 0.0) for link in LINKS if link.joint is not None]
        return np.array([0.0, 0, BASE_HEIGHT, 1, 0, 0, 0, *joints])

    def mpc_config(self, mode: Mode) -> MpcConfig:
        """Parameters of the model predictive controller in `mode`."""
        return mpc_config(mode)
