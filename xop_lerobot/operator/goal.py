"""Goals of head and hands, their velocities, and blending to hands that are found again."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.state import FRAMES, Goal
from xop_lerobot.core.transforms import (
    compute_minimum_jerk,
    level_pose,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_multiply,
    rotation_error,
)
from xop_lerobot.operator.alignment import Alignment
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import grip_from_pinch

BLEND_S = 1.0
"""Time of blending from a held goal to the tracked hand [s]."""
SETBACK = 2.0
"""Factor on the duration of a tracking loss by which a blend is set back [1]."""
SETBACK_SPEED = 1.0
"""Speed at which the hand's displacement during a loss counts as a setback [m/s]."""


@dataclass(frozen=True)
class _Blend:
    """Blend of a hand's goal from its held pose to the tracked hand.

    Attributes:
        begin: Start, or continuation after a loss [s].
        phase: Elapsed share of the blend at `begin`, from 0 to 1.
        offset: Offset of the goal from the hand at `begin`: metres, and a rotation vector [rad].
            Shape (6,).
    """

    begin: float
    phase: float
    offset: np.ndarray


class HandBlend:
    """Blends goals of hands from their held pose relative to the head to the tracked hands.

    While a hand is lost its goal stands still (`Alignment`). From the first frame in which it is
    seen again, and from an engagement on, the goal moves with the hand at an offset that shrinks to
    zero: at phase x it is 1 − u(x) of the first one, where u is minimum-jerk.

    A hand that is lost briefly does not restart its blend: it continues from an earlier phase, set
    back by `SETBACK` times the duration of the loss. So hands that flicker at the edge of the view
    are still followed, while one that was lost for long, or is found far away, returns slowly.

    Args:
        duration: Duration of a full blend [s].
    """

    def __init__(self, duration: float = BLEND_S) -> None:
        self.duration = duration
        self.reset()

    def reset(self) -> None:
        """Forget all hands."""
        # Poses are relative to the head, along its heading.
        self._last: dict[str, np.ndarray] = {}  # where the goals were
        self._seen: dict[str, np.ndarray] = {}  # where the hands were seen
        self._lost: dict[str, tuple[float, float]] = {}  # since when, and the phase until then
        self._blends: dict[str, _Blend] = {}

    def engage(self, head: np.ndarray, robot: Mapping[str, np.ndarray]) -> None:
        """Start from the robot's present hand poses.

        Args:
            head: Pose of the robot's head. Shape (7,).
            robot: Poses of its frames, robot world. Shapes (7,).
        """
        self.reset()
        body = pose_inverse(level_pose(head))
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
        level = level_pose(goals["head"])
        for name, seen in zip(FRAMES[1:], tracked[1:], strict=True):
            if name in goals:
                goal = pose_multiply(pose_inverse(level), goals[name])
                local = self._lead(time, name, goal, seen)
                if local is not goal:  # an unblended goal is passed on bit for bit
                    blended[name] = pose_multiply(level, local)
                self._last[name] = local
        return blended

    def _lead(self, time: float, name: str, goal: np.ndarray, seen: bool) -> np.ndarray:
        """Goal of a hand relative to the head. Shape (7,)."""
        if not seen:
            if name not in self._lost:
                self._lost[name] = time, self._compute_phase(time, name)
            return self._last.get(name, goal)
        if name in self._lost:
            self._find(time, name, goal)
        self._seen[name] = goal
        phase = self._compute_phase(time, name)
        if phase >= 1:
            self._blends.pop(name, None)
            return goal
        blend = self._blends[name]
        share = (1 - compute_minimum_jerk(phase)) / (1 - compute_minimum_jerk(blend.phase))
        turned = quat_multiply(quat_exp(share * blend.offset[3:]), goal[3:])
        return make_pose(goal[:3] + share * blend.offset[:3], turned)

    def _find(self, time: float, name: str, goal: np.ndarray) -> None:
        """Start or continue blending towards a hand that is seen again."""
        since, phase = self._lost.pop(name)
        away = float(np.linalg.norm(goal[:3] - self._seen.get(name, goal)[:3]))
        setback = max(SETBACK * (time - since), away / SETBACK_SPEED) / self.duration
        offset = _compute_offset(self._last[name], goal)
        self._blends[name] = _Blend(time, max(phase - setback, 0.0), offset)

    def _compute_phase(self, time: float, name: str) -> float:
        """Elapsed share of a hand's blend, 1 if there is none."""
        if name not in self._blends:
            return 1.0
        blend = self._blends[name]
        return min(blend.phase + (time - blend.begin) / self.duration, 1.0)


def _compute_offset(pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Offset of a pose from a goal, along the axes of both. Shape (6,)."""
    return np.concatenate([pose[:3] - goal[:3], rotation_error(pose[3:], goal[3:])])


@dataclass
class GoalVelocityConfig:
    """Settings of the goal velocity filter.

    Attributes:
        time_constant: Time constant of the low-pass filter [s].
        max_gap: Time between two goals above which the velocity is set to zero [s].
        max_linear: Limit of the linear velocity [m/s].
        max_angular: Limit of the angular velocity [rad/s].
    """

    time_constant: float = 0.1
    max_gap: float = 0.5
    max_linear: float = 2.0
    max_angular: float = 4.0

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            BadValue: If one is not a finite number above 0.
        """
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise BadValue(f"goal_velocity.{name} must be finite and above 0, got {value}")


class GoalVelocity:
    r"""Low-passed finite differences :math:`v \leftarrow v + (1 - e^{-dt/\tau})(\dot x - v)`.

    The gain depends on the time between goals, so the stream's rate does not matter; a goal with
    the previous stamp is ignored. A tracking jump is limited to the largest velocity, and decays
    with the time constant.

    Args:
        config: Time constant and limits.
    """

    def __init__(self, config: GoalVelocityConfig | None = None) -> None:
        self.config = config or GoalVelocityConfig()
        self.reset()

    def reset(self) -> None:
        """Forget all goals (at engage): the velocity is zero until two goals are known."""
        self._time: float | None = None
        self._poses: dict[str, np.ndarray] = {}
        self._velocities: dict[str, np.ndarray] = {}

    def update(self, time: float, poses: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Update with the goals of `time` and return their velocities.

        Args:
            time: The robot's clock [s].
            poses: Goal poses by frame, robot world. Shapes (7,).

        Returns:
            Linear [m/s] then angular [rad/s] velocity of each, world axes. Shapes (6,).
        """
        dt = math.inf if self._time is None else time - self._time
        if dt == 0 and poses.keys() == self._poses.keys():
            return {name: value.copy() for name, value in self._velocities.items()}
        known = 0 < dt <= self.config.max_gap
        self._velocities = {
            name: self._filter(name, pose, dt) if known and name in self._poses else np.zeros(6)
            for name, pose in poses.items()
        }
        self._time = time
        self._poses = {name: np.array(pose, dtype=float) for name, pose in poses.items()}
        return {name: value.copy() for name, value in self._velocities.items()}

    def _filter(self, name: str, pose: np.ndarray, dt: float) -> np.ndarray:
        last = self._poses[name]
        linear = _limit((pose[:3] - last[:3]) / dt, self.config.max_linear)
        angular = _limit(rotation_error(pose[3:], last[3:]) / dt, self.config.max_angular)
        velocity = self._velocities[name]
        gain = -math.expm1(-dt / self.config.time_constant)
        return velocity + gain * (np.concatenate([linear, angular]) - velocity)


class GoalMaker:
    """Makes the goal of each tick from the frame of an engaged operator.

    Args:
        has_person: Whether a person wears a headset. Hands of recordings and scripts are followed
            as given, even where they are lost.
    """

    def __init__(self, *, has_person: bool) -> None:
        self._has_person = has_person
        self._velocity, self._blend = GoalVelocity(), HandBlend()

    def reset(self) -> None:
        """Forget all goals."""
        self._velocity.reset()

    def engage(self, poses: Mapping[str, np.ndarray]) -> None:
        """Start an engagement with the robot's frames at `poses`. Shapes (7,)."""
        self._velocity.reset()
        self._blend.reset()
        if self._has_person:
            self._blend.engage(poses["head"], poses)

    def make(
        self,
        time: float,
        frame: OperatorFrame | None,
        alignment: Alignment,
        mode: Mode,
        freed: Mapping[str, np.ndarray] | None = None,
    ) -> Goal | None:
        """Make a goal; None while not engaged.

        Args:
            time: The robot's clock [s].
            frame: The operator's frame, None before the first.
            alignment: Mapping from the operator to the robot.
            mode: Requested mode.
            freed: Poses that a constraint has kept from their goals until now, None otherwise:
                hands blend from there to their goals. Shapes (7,).
        """
        if frame is None or not alignment.is_engaged:
            return None
        goals = alignment.goal_poses(frame)
        if freed is not None:
            self._blend.engage(goals["head"], freed)
        seen = frame.tracked if self._has_person else np.ones(len(FRAMES), dtype=bool)
        blended = self._blend.apply(time, goals, seen)
        velocities = self._velocity.update(time, blended)
        return Goal(blended, velocities, mode, grip_from_pinch(frame.pinch))


def _limit(vector: np.ndarray, longest: float) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    return vector if length <= longest else vector * (longest / length)
