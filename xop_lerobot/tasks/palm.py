"""The open left palm: arm posture that turns it up at the start, and a tray fitted to it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.transforms import make_pose, pose_inverse, pose_multiply, quat_from_rpy
from xop_lerobot.morphology.links import FLOOR_BIT, OBJECT_BIT
from xop_lerobot.retarget.arms.ik import ArmIk
from xop_lerobot.tasks.layout import Pad, Reach

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.morphology import Morphology

PALM_UP = quat_from_rpy(math.pi, 0, 0)
"""Orientation of a palm that faces up, fingers forward: Z, out of the back of the hand, is down."""
TRAY_HALF = (0.05, 0.05, 0.003)
"""Half extents of the tray on hands without a flat palm: along, across, thickness [m]."""
BARE_EDGE = 0.034
"""Distance from the middle of a hand without a tray to its edge [m]."""
_STEPS, _DT = 150, 0.04
"""Inverse kinematics: iterations, and time step [s]."""


def find_start_arms(
    morphology: Morphology, position: np.ndarray, palm_in_wrist: np.ndarray
) -> dict[str, float]:
    """Find left arm angles that hold the palm up at `position` while the robot stands.

    Args:
        morphology: The robot.
        position: Position of the palm's site, robot at the origin, heading along X [m]. Shape (3,).
        palm_in_wrist: Pose of the palm's site in the wrist's frame. Shape (7,).
    """
    arm = morphology.arms[0]
    ik = ArmIk(morphology)
    goal = pose_multiply(make_pose(position, PALM_UP), pose_inverse(palm_in_wrist))
    joints = [joint for each in morphology.arms for joint in each.joints]
    angles = np.array([morphology.arm_rest.get(joint, 0.0) for joint in joints])
    standing = morphology.standing_qpos()
    for _ in range(_STEPS):
        angles = ik.solve(standing, angles, {arm.frame: goal}, _DT)
    return {joint: float(angles[joints.index(joint)]) for joint in arm.joints}


def add_tray(spec: mujoco.MjSpec, site: str, pad: Pad) -> None:
    """Add a flat plate of 10 cm by 10 cm without a rim to the palm side of a hand.

    Its edge towards the wrist is where the hand begins. It has no mass.
    """
    import mujoco  # noqa: PLC0415

    frame = next(each for each in spec.sites if each.name == site)
    offset = make_pose(
        np.array([compute_tray_forward(pad), 0, -pad.depth - TRAY_HALF[2]]),
        np.array([1.0, 0, 0, 0]),
    )
    pose = pose_multiply(make_pose(np.array(frame.pos), np.array(frame.quat)), offset)
    frame.parent.add_geom(
        name="left_tray",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=TRAY_HALF,
        pos=pose[:3],
        quat=pose[3:],
        mass=0,
        rgba=(0.20, 0.22, 0.25, 1),
        contype=0,
        conaffinity=FLOOR_BIT | OBJECT_BIT,
        group=2,
    )


def compute_tray_forward(pad: Pad) -> float:
    """Offset of the tray's middle ahead of the palm's site [m]."""
    return pad.wrist_end + 0.002 + TRAY_HALF[0]


def compute_start(reach: Reach, left: float) -> np.ndarray:
    """Start position of the palm: the rest position, slightly nearer and higher. Shape (3,)."""
    return np.array([0.92 * reach.forward, left, reach.height + 0.03])
