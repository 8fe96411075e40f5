"""What a robot executes of an action: the one limit that teleoperator and robot share."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from xop_lerobot.core.command import RobotAction, check_vector
from xop_lerobot.morphology.morphology import Morphology

ARM_MAX_SPEED = 6.0
"""Largest speed of arm targets that a robot executes [rad/s]; grippers are not limited."""


def limit_action(
    morphology: Morphology,
    action: RobotAction,
    previous: RobotAction,
    dt: float,
    arm_limits: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> RobotAction:
    """What of `action` a robot executes after `previous` within `dt` [s].

    Teleoperator and robot both call it, so that the recorded action is the executed one:
    limiting twice is limiting once. Datasets hold single precision, so actions are rounded to
    it, and a replayed action is the recorded one to the last bit.

    Args:
        morphology: The robot.
        action: What is wanted.
        previous: What was executed last.
        dt: Time since then [s].
        arm_limits: Angles that the robot's low-level policy keeps arm joints within [rad].

    Raises:
        BadShape: If the command or the arms have the wrong size.
        BadValue: If the command or the arms hold a number that is not finite.
    """
    command = morphology.command_space.limit(action.command, previous.command, dt, action.mode)
    num_joints = sum(len(arm.joints) for arm in morphology.arms)
    arms = check_vector("arms", action.arms, len(morphology.arm_names)).copy()
    for joint, (low, high) in arm_limits.items():
        place = morphology.arm_names.index(joint)
        arms[place] = min(max(arms[place], low), high)
    reach = ARM_MAX_SPEED * dt
    arms[:num_joints] = np.clip(
        arms[:num_joints], previous.arms[:num_joints] - reach, previous.arms[:num_joints] + reach
    )
    return round_action(RobotAction(command, action.mode, arms))


def round_action(action: RobotAction) -> RobotAction:
    """The same in single precision, as datasets hold it."""
    return RobotAction(_to_single(action.command), action.mode, _to_single(action.arms))


def _to_single(vector: np.ndarray) -> np.ndarray:
    return vector.astype(np.float32).astype(float)
