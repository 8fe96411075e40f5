"""Where a base on wheels shall face, to drive after what is tracked."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from xop_lerobot.core.transforms import compute_heading, quat_yaw
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.costs.lateral import compute_facing


class FacingRule:
    """Finds the facing for the first target; see `compute_facing`.

    Args:
        morphology: The robot.
        resting: How far ahead of the base each tracked frame is at rest [m].
    """

    def __init__(self, morphology: Morphology, resting: Mapping[str, float]) -> None:
        self._pivot, self._resting = morphology.pivot, dict(resting)
        self._hands = {arm.frame for arm in morphology.arms}

    def compute(
        self,
        qpos: np.ndarray,
        poses: Mapping[str, np.ndarray],
        then: Mapping[str, np.ndarray],
        dt: float,
        room: float = math.inf,
        ahead: Mapping[str, float] | None = None,
    ) -> np.ndarray:
        """Compute where the base shall face. A hand looks nowhere: for it, as it faces now.

        Args:
            qpos: Configuration now. Shape (nq,).
            poses: Pose of each tracked frame now. Shapes (7,).
            then: Its goal in `dt`. Shapes (1, 7).
            dt: Time to get there [s].
            room: How far the arms let the waist twist [rad].
            ahead: How far ahead of the base frames will be, where not as at rest [m].

        Returns:
            Direction in the world, as long as it counts. Shape (2,).
        """
        heading, pivot = float(quat_yaw(qpos[3:7])), self._pivot
        for name, goals in then.items():
            missing = goals[0, :2] - poses[name][:2]
            velocity, look = missing / dt, heading
            if name not in self._hands:
                look = float(compute_heading(goals[0, 3:]))
                resting = (ahead or {}).get(name, self._resting[name])
                end = goals[0, :2] + (pivot - resting) * _direction(look)
                velocity = (end - qpos[:2] - pivot * _direction(heading)) / dt
            speed = float(np.hypot(*missing)) / dt
            return compute_facing(heading, velocity, look, speed, room)
        return np.zeros(2)


def _direction(heading: float) -> np.ndarray:
    """Unit vector of a heading. Shape (2,)."""
    return np.array([np.cos(heading), np.sin(heading)])
