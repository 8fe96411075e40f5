"""A hand that is found again is taken up little by little."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import (
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_from_yaw,
    quat_multiply,
    rotation_error,
)
from xop_lerobot.operator.interpolation import compute_heading, compute_minimum_jerk

BLEND_S = 1.0
"""Time in which a hand's goal goes from where it was held to where the hand is [s]."""
SETBACK = 2.0
"""A loss sets a hand back on its way by so many times as long as it took."""
SETBACK_SPEED = 1.0
"""It does so by no less than the time in which the hand would have gone at this speed [m/s]."""


@dataclass(frozen=True)
class _Way:
    """A goal on its way to a hand.

    Attributes:
        begin: When it set out, or went on after a loss [s].
        phase: How much of the whole way's time had passed then, from 0 to 1.
        offset: Of the goal from the hand then: metres, and a rotation vector [rad]. Shape (6,).
    """

    begin: float
    phase: float
    offset: np.ndarray


class HandBlend:
    """Leads goals of hands from where they stood, seen from the head, to where the hands are.

    While a hand is lost its goal stands still (`Alignment`). From the first frame in which it
    is seen again, and from an engagement on, the goal goes with the hand, at an offset that
    shrinks to nothing: it is a fraction 1 − u of the first one, u being a minimum jerk.

    A hand that is lost for a moment, on the way or after it, does not set out anew: it goes on
    from a phase that is earlier by twice that moment. So hands that come and go at the edge of
    the view are followed, and one that was lost for long, or is found far from there, comes back
    slowly.

    Args:
        duration: Time of a whole way [s].
    """

    def __init__(self, duration: float = BLEND_S) -> None:
        self.duration = duration
        self.reset()

    def reset(self) -> None:
        """Forget all hands."""
        # Poses are from the head along its heading.
        self._last: dict[str, np.ndarray] = {}  # where the goals were
        self._seen: dict[str, np.ndarray] = {}  # where the hands were seen
        self._lost: dict[str, tuple[float, float]] = {}  # since when, and the phase until then
        self._ways: dict[str, _Way] = {}

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
                self._last[name] = pose_multiply(body, robot[name])
                self._lost[name] = -math.inf, 0.0

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
            if name not in self._lost:
                self._lost[name] = time, self._compute_phase(time, name)
            return self._last.get(name, goal)
        if name in self._lost:
            self._find(time, name, goal)
        self._seen[name] = goal
        phase = self._compute_phase(time, name)
        if phase >= 1:
            self._ways.pop(name, None)
            return goal
        way = self._ways[name]
        share = (1 - compute_minimum_jerk(phase)) / (1 - compute_minimum_jerk(way.phase))
        turned = quat_multiply(quat_exp(share * way.offset[3:]), goal[3:])
        return make_pose(goal[:3] + share * way.offset[:3], turned)

    def _find(self, time: float, name: str, goal: np.ndarray) -> None:
        """A hand is seen again: its goal sets out for it, or goes on."""
        since, phase = self._lost.pop(name)
        away = float(np.linalg.norm(goal[:3] - self._seen.get(name, goal)[:3]))
        setback = max(SETBACK * (time - since), away / SETBACK_SPEED) / self.duration
        offset = _compute_offset(self._last[name], goal)
        self._ways[name] = _Way(time, max(phase - setback, 0.0), offset)

    def _compute_phase(self, time: float, name: str) -> float:
        """How much of the time of a hand's way has passed, 1 where it is on none."""
        if name not in self._ways:
            return 1.0
        way = self._ways[name]
        return min(way.phase + (time - way.begin) / self.duration, 1.0)


def _compute_offset(pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Offset of a pose from a goal, along the axes of both. Shape (6,)."""
    return np.concatenate([pose[:3] - goal[:3], rotation_error(pose[3:], goal[3:])])


def _level(head: np.ndarray) -> np.ndarray:
    """The head's place and heading without its nod and tilt. Shape (7,)."""
    return make_pose(head[:3], quat_from_yaw(compute_heading(head[3:])))
