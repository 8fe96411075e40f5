"""A hand that is found again is taken up little by little."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from xop_lerobot.operator.interpolation import (
    compute_heading,
    compute_minimum_jerk,
    interpolate_poses,
)
from xop_lerobot.state import FRAMES
from xop_lerobot.transforms import make_pose, pose_inverse, pose_multiply, quat_from_yaw

BLEND_S = 1.0
"""Time in which a hand's goal goes from where it was held to where the hand is [s]."""


class HandBlend:
    """Leads goals of hands from where they stood, seen from the head, to where the hands are.

    While a hand is lost its goal stands still (`Alignment`). From the first frame in which it
    is seen again, and from an engagement on, the goal is a fraction u of the way, u being a
    minimum jerk from 0 to 1.

    Args:
        duration: Time that it takes [s].
    """

    def __init__(self, duration: float = BLEND_S) -> None:
        self.duration = duration
        self.reset()

    def reset(self) -> None:
        """Forget all hands."""
        # All from the head along its heading.
        self._held: dict[str, np.ndarray] = {}  # where a hand is led from
        self._last: dict[str, np.ndarray] = {}
        self._found_at: dict[str, float] = {}  # infinite while it is lost

    def engage(self, head: np.ndarray, robot: Mapping[str, np.ndarray]) -> None:
        """Begin where the robot's own hands are.

        Args:
            head: Pose of the robot's head. Shape (7,).
            robot: Poses of its frames, robot world. Shapes (7,).
        """
        self.reset()
        body = pose_inverse(_level(head))
        for name in FRAMES[1:]:
            if name in robot:
                self._held[name] = self._last[name] = pose_multiply(body, robot[name])
                self._found_at[name] = math.inf

    def apply(
        self, time: float, goals: Mapping[str, np.ndarray], tracked: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Blend the goals of the hands.

        Args:
            time: The robot's clock [s].
            goals: Goal poses by frame, robot world, the head's among them. Shapes (7,).
            tracked: Whether head, left and right wrist are seen. Shape (3,), bool.

        Returns:
            The goals to follow. Shapes (7,).
        """
        blended = dict(goals)
        if "head" not in goals:
            return blended
        level = _level(goals["head"])
        for name, seen in zip(FRAMES[1:], tracked[1:], strict=True):
            if name in goals:
                goal = pose_multiply(pose_inverse(level), goals[name])
                local = self._lead(time, name, goal, seen)
                if local is not goal:  # a goal that is followed stays as it is to the last bit
                    blended[name] = pose_multiply(level, local)
                self._last[name] = local
        return blended

    def _lead(self, time: float, name: str, goal: np.ndarray, seen: bool) -> np.ndarray:
        """Where the goal of a hand goes, seen from the head. Shape (7,)."""
        if not seen:
            if self._found_at.get(name) != math.inf:  # lost just now, perhaps in a blend
                self._held[name] = self._last.get(name, goal)
                self._found_at[name] = math.inf
            return self._held[name]
        if name not in self._held:
            return goal
        if self._found_at[name] == math.inf:
            self._found_at[name] = time
        u = compute_minimum_jerk((time - self._found_at[name]) / self.duration)
        if u >= 1:
            del self._held[name]
            return goal
        return interpolate_poses(self._held[name], goal, u)


def _level(head: np.ndarray) -> np.ndarray:
    """The head's place and heading without its nod and tilt. Shape (7,)."""
    return make_pose(head[:3], quat_from_yaw(compute_heading(head[3:])))
