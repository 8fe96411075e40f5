"""Where the arms should reach when the body is not where the head's goal is."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from xop_lerobot.core.transforms import (
    compute_heading,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_from_yaw,
    quat_multiply,
    rotation_error,
)


def compute_wrist_goals(
    goals: Mapping[str, np.ndarray],
    head: np.ndarray,
    max_offset: float = 0.15,
    max_turn: float = 0.4,
) -> dict[str, np.ndarray]:
    """Move wrist goals along with a head that is not at its goal.

    A hand that works must be where the operator's is in the world, whatever the head does; a
    robot that walks half a metre behind its goal must not stretch its arms ahead of itself. So
    the goal in the world holds while it is within `max_offset` and `max_turn` of the goal that
    goes with the robot's own head, and is held at that distance beyond. The change is continuous.

    Args:
        goals: Goal poses in the world by tracked frame. Shapes (7,).
        head: The robot's head now. Shape (7,).
        max_offset: Distance up to which the goal in the world holds [m].
        max_turn: Turn up to which it holds [rad].

    Returns:
        Goals of every frame but the head. Shapes (7,).
    """
    wrists = {name: pose for name, pose in goals.items() if name != "head"}
    if "head" not in goals:
        return wrists
    carry = pose_multiply(_level(head), pose_inverse(_level(goals["head"])))
    return {
        name: _approach(pose_multiply(carry, pose), pose, max_offset, max_turn)
        for name, pose in wrists.items()
    }


def _level(pose: np.ndarray) -> np.ndarray:
    """Place and heading of a pose, without its tilt. Shape (7,)."""
    return make_pose(pose[:3], quat_from_yaw(compute_heading(pose[3:])))


def _approach(start: np.ndarray, end: np.ndarray, max_offset: float, max_turn: float) -> np.ndarray:
    """Go from one pose towards another, at most so far. Shape (7,)."""
    offset = end[:3] - start[:3]
    turn = rotation_error(end[3:], start[3:])
    offset *= min(1.0, max_offset / max(float(np.linalg.norm(offset)), 1e-9))
    turn *= min(1.0, max_turn / max(float(np.linalg.norm(turn)), 1e-9))
    return make_pose(start[:3] + offset, quat_multiply(quat_exp(turn), start[3:]))
