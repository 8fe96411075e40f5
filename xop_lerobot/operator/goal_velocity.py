"""How fast the goals move, estimated from the goals themselves, for the preview of the MPC."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import rotation_error


@dataclass
class GoalVelocityConfig:
    """How goal velocities are estimated.

    Attributes:
        time_constant: Time constant of the low-pass filter [s].
        max_gap: Time between two goals over which the velocity is not known, so zero [s].
        max_linear: Largest speed that is believed [m/s].
        max_angular: Largest rotation speed that is believed [rad/s].
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

    The gain follows the time between goals, so the rate of the stream does not matter; a goal
    with the stamp of the last one is ignored. A tracking jump counts as the largest speed that
    is believed, and fades with the time constant.

    Args:
        config: Time constant and bounds.
    """

    def __init__(self, config: GoalVelocityConfig | None = None) -> None:
        self.config = config or GoalVelocityConfig()
        self.reset()

    def reset(self) -> None:
        """Forget all goals (at engage): the velocity is zero until two are known."""
        self._time: float | None = None
        self._poses: dict[str, np.ndarray] = {}
        self._velocities: dict[str, np.ndarray] = {}

    def update(self, time: float, poses: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Take the goals of `time` and return how fast they move.

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


def _limit(vector: np.ndarray, longest: float) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    return vector if length <= longest else vector * (longest / length)
