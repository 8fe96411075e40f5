"""Unitree G1 with 29 degrees of freedom, in the revision that FALCON was trained on.

A biped whose legs and waist are controlled by a whole-body policy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.command import CommandDim, CommandSpace, Mode
from xop_lerobot.morphology.contacts import Feet
from xop_lerobot.morphology.g1.links import LINKS
from xop_lerobot.morphology.g1.mpc import EFFECTS, STANDING_REACH, mpc_config
from xop_lerobot.morphology.g1.shapes import FOOT_POINTS
from xop_lerobot.morphology.morphology import ArmChain, ModelKind, Morphology, Work

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.tuning import MpcConfig

ARM_JOINTS = (
    "shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow",
    "wrist_roll", "wrist_pitch", "wrist_yaw",
)  # fmt: skip

STANDING = {"hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2}
"""FALCON's default leg angles [rad]; all other joints except the arms are at 0."""

STANDING_HEIGHT = 0.7836
"""Pelvis height at which the contact spheres carry the robot's weight at `STANDING` [m]."""

ARM_REST = {"shoulder_pitch": 0.0, "shoulder_roll": 0.1, "elbow": 0.2}
"""Rest angles of the left arm [rad]: elbows at the sides, forearms forward, palms inward."""

ELBOW_MIN = 0.1
"""Lower limit of the elbows in inverse kinematics [rad]; at 0 the forearm is perpendicular to the
upper arm. Further bent, the low-level policy pushes the arms aside by 0.3 to 1 rad and finally
falls."""


def _mirrored(side: str, joint: str, angle: float) -> float:
    """Mirror a left-arm angle to `side`: roll and yaw change sign on the right."""
    return -angle if side == "right" and joint.endswith(("roll", "yaw")) else angle


class G1(Morphology):
    """Unitree G1 with the command height, waist angles and base velocity."""

    name = "g1"
    command_space = CommandSpace(
        (
            CommandDim("height", "height.pos", "m", 0.36, 0.78, 0.75, 0.25, max_accel=5.0),
            CommandDim("waist_yaw", "waist_yaw.pos", "rad", -1.0, 1.0, 0.0, 2.0, max_accel=20.0),
            CommandDim("waist_roll", "waist_roll.pos", "rad", -0.5, 0.5, 0.0, 2.0, max_accel=20.0),
            CommandDim(
                "waist_pitch", "waist_pitch.pos", "rad", -0.5, 0.5, 0.0, 0.7, max_accel=20.0
            ),
            CommandDim(
                "vx",
                "x.vel",
                "m/s",
                -1.0,
                1.0,
                0.0,
                3.0,
                mobile_only=True,
                sway=0.15,
                sway_rate=0.1,
                max_accel=100.0,
            ),
            CommandDim(
                "vy",
                "y.vel",
                "m/s",
                -0.6,
                0.6,
                0.0,
                3.0,
                mobile_only=True,
                sway=0.1,
                sway_rate=0.1,
                max_accel=100.0,
            ),
            CommandDim(
                "yaw_rate",
                "theta.vel",
                "rad/s",
                -1.0,
                1.0,
                0.0,
                5.0,
                mobile_only=True,
                max_accel=100.0,
            ),
        )
    )
    policies = ("default",)
    frames = {"head": "head", "left_wrist": "left_wrist", "right_wrist": "right_wrist"}
    base_body = "pelvis"
    arms = tuple(
        ArmChain(f"{side}_wrist", tuple(f"{side}_{joint}_joint" for joint in ARM_JOINTS))
        for side in ("left", "right")
    )
    arm_rest = {
        f"{side}_{joint}_joint": _mirrored(side, joint, angle)
        for side in ("left", "right")
        for joint, angle in ARM_REST.items()
    }
    arm_limits = {f"{side}_elbow_joint": (ELBOW_MIN, 2.0) for side in ("left", "right")}
    contact_points = tuple(
        f"{side}_foot_{i}" for side in ("left", "right") for i in range(len(FOOT_POINTS))
    )
    contact_groups = (contact_points[: len(FOOT_POINTS)], contact_points[len(FOOT_POINTS) :])
    effects = EFFECTS
    fall_height = 0.35
    fall_tilt = 0.8
    contact_kind = Feet()
    standing_reach = STANDING_REACH
    point_heights, top_heights = (0.25, 1.3), (0.3, 1.1)
    # Its arms do not reach a container from where it stands, so it walks there first.
    work = Work(press=0.02, walk=(0.5, 0.7))

    def build_spec(self, kind: ModelKind) -> mujoco.MjSpec:
        """Build G1 without a scene."""
        from xop_lerobot.morphology.g1.model import build_g1  # noqa: PLC0415

        return build_g1(kind)

    def standing_qpos(self) -> np.ndarray:
        """Configuration standing at the origin: free joint, then the joints. Shape (36,)."""
        angles = []
        for link in LINKS:
            if link.joint is None:
                continue
            name = link.joint.name
            kind = name.removesuffix("_joint").removeprefix("left_").removeprefix("right_")
            angles.append(self.arm_rest.get(name, STANDING.get(kind, 0.0)))
        return np.array([0.0, 0, STANDING_HEIGHT, 1, 0, 0, 0, *angles])

    def mpc_config(self, mode: Mode) -> MpcConfig:
        """Parameters of the model predictive controller in `mode`."""
        return mpc_config(mode)
