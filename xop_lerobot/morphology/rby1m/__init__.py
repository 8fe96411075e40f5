"""Rainbow Robotics RB-Y1 M v1.3: the upper body of RB-Y1 on four mecanum wheels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.command import CommandDim, CommandSpace, Mode
from xop_lerobot.morphology.contacts import Contact, Wheels
from xop_lerobot.morphology.morphology import ModelKind, WheelDrive
from xop_lerobot.morphology.rby1 import (
    GRIPPER_OPEN,
    RBY1,
    TORSO_READY,
    make_neck_dims,
    make_torso_dims,
)
from xop_lerobot.morphology.rby1m.links import HALF_LENGTH, HALF_WIDTH, LINKS, WHEEL_RADIUS
from xop_lerobot.morphology.rby1m.mpc import CONFIGS, EFFECTS, PIVOT, SUPPORT

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.tuning import MpcConfig

BASE_HEIGHT = -0.00034
"""Height of the base frame at rest [m]; wheels sink in by their compliance."""


class MecanumWheels(Wheels):
    """Wheels with rollers that move in any direction, and whose rotation is not a model joint.

    So they give no information on the base velocity, except that its vertical part is zero.
    """

    tells_speed = False

    def select_velocities(
        self, contact: Contact, rotation: np.ndarray, jacobian: np.ndarray
    ) -> np.ndarray:
        """Vertical velocity of the centre. Shape (1, nv)."""
        del contact, rotation
        return jacobian[2:3]

    def arrange_variance(self, contact: Contact, linear: float, angular: float) -> np.ndarray:
        """Variance of that velocity. Shape (1,)."""
        del contact, angular
        return np.array([linear])


class RBY1M(RBY1):
    """RB-Y1 M; attributes that are not set here are those of RB-Y1 A."""

    name = "rby1m"
    command_space = CommandSpace(
        (
            # name, key, unit, low, high, neutral, largest rate and acceleration
            CommandDim("vx", "x.vel", "m/s", -1.0, 1.0, 0.0, 1.5, mobile_only=True, max_accel=50.0),
            CommandDim("vy", "y.vel", "m/s", -0.7, 0.7, 0.0, 1.5, mobile_only=True, max_accel=50.0),
            CommandDim(
                "yaw_rate",
                "theta.vel",
                "rad/s",
                -1.2,
                1.2,
                0.0,
                3.0,
                mobile_only=True,
                max_accel=100.0,
            ),
            *make_torso_dims(),
            *make_neck_dims(),
        )
    )
    policies = ("mecanum_drive",)
    contact_points = (
        "front_right_wheel_center",
        "front_left_wheel_center",
        "rear_right_wheel_center",
        "rear_left_wheel_center",
    )
    contact_groups = tuple((point,) for point in contact_points)
    contact_kind = MecanumWheels()
    effects = EFFECTS
    pivot = PIVOT
    support = SUPPORT
    drive = WheelDrive(
        WHEEL_RADIUS,
        {
            "wheel_fr": (1, 1, HALF_LENGTH + HALF_WIDTH),
            "wheel_fl": (1, -1, -HALF_LENGTH - HALF_WIDTH),
            "wheel_rr": (1, -1, HALF_LENGTH + HALF_WIDTH),
            "wheel_rl": (1, 1, -HALF_LENGTH - HALF_WIDTH),
        },
    )
    driving = None  # it can move sideways, so it needs no path

    def build_spec(self, kind: ModelKind) -> mujoco.MjSpec:
        """Build RB-Y1 M without a scene."""
        from xop_lerobot.morphology.rby1m.model import build_rby1m  # noqa: PLC0415

        return build_rby1m(kind)

    def standing_qpos(self) -> np.ndarray:
        """Configuration at the ready pose, grippers open: free joint, then the joints. (33,)."""
        angles = dict(self.arm_rest)
        angles |= {f"torso_{i}": ready for i, ready in enumerate(TORSO_READY)}
        angles |= {f"gripper_finger_{side}1": GRIPPER_OPEN for side in "lr"}
        angles |= {f"gripper_finger_{side}2": -GRIPPER_OPEN for side in "lr"}
        joints = [angles.get(link.joint.name, 0.0) for link in LINKS if link.joint is not None]
        return np.array([0.0, 0, BASE_HEIGHT, 1, 0, 0, 0, *joints])

    def mpc_config(self, mode: Mode) -> MpcConfig:
        """Parameters of the model predictive controller in `mode`."""
        return CONFIGS[mode]
