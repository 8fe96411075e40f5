"""Limits of the actions that a robot executes, shared by teleoperator and robot."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from xop_lerobot.core.command import RobotAction, check_vector
from xop_lerobot.morphology.morphology import Morphology

ARM_MAX_SPEED = 6.0
"""Largest speed of arm targets [rad/s]; the speed of grippers is not limited."""


def limit_action(
    morphology: Morphology,
    action: RobotAction,
    previous: RobotAction,
    dt: float,
    arm_limits: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> RobotAction:
    """Limit an action to the bounds and rates that a robot can execute within `dt`.

    Teleoperator and robot both call it, so that the recorded action is the executed one; the
    function is idempotent. Actions are rounded to single precision, as stored in datasets, so that
    a replayed action equals the recorded one bit by bit.

    Args:
        morphology: The robot.
        action: Desired action.
        previous: Action executed last.
        dt: Time since `previous` [s].
        arm_limits: Joint limits of the arms imposed by the low-level policy [rad].

    Raises:
        BadShape: If the command or the arms have the wrong size.
        BadValue: If the command or the arms hold a number that is not finite.
    """
    command = morphology.command_space.limit(action.command, previous.command, dt, action.mode)
    num_joints = sum(len(arm.joints) for arm in morphology.arms)
    arms = check_vector("arms", action.arms, len(morphology.arm_names)).copy()
    for joint, (low, high) in arm_limits.items():
        index = morphology.arm_names.index(joint)
        arms[index] = min(max(arms[index], low), high)
    reach = ARM_MAX_SPEED * dt
    arms[:num_joints] = np.clip(
        arms[:num_joints], previous.arms[:num_joints] - reach, previous.arms[:num_joints] + reach
    )
    return round_action(RobotAction(command, action.mode, arms))


def round_action(action: RobotAction) -> RobotAction:
    """Round an action to single precision, as datasets store it."""
    return RobotAction(_to_single(action.command), action.mode, _to_single(action.arms))


def _to_single(vector: np.ndarray) -> np.ndarray:
    return vector.astype(np.float32).astype(float)
