"""Gait clock of a policy: phases that advance, stop or reset."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.low_level.description import Clock
from xop_lerobot.low_level.policy import POLICY_DT

NEAR = 0.05
"""Tolerance of the phase at which a clock that ``"stops"`` stops and starts [cycles]."""


class GaitClock:
    """Gait phases of a batch of robots; see `Clock`.

    Args:
        table: Description of the clock.

    Attributes:
        initial: Phases of a robot that has not walked yet. Shape (p,).

    Raises:
        BadValue: If `phases` and `standing_phases` differ in number, or a clock that stops has no
            `standing_phases`.
    """

    def __init__(self, table: Clock) -> None:
        self._table = table
        self._phases = np.array(table.phases)
        standing = table.standing_phases
        if standing is not None and len(standing) != len(table.phases):
            raise BadValue(
                f"the clock has {len(table.phases)} phases and {len(standing)} standing_phases"
            )
        if standing is None and table.standing == "stops":
            raise BadValue("a clock that stops must have standing_phases")
        self._standing = None if standing is None else np.array(standing)
        self.initial = self._phases
        if table.standing == "stops" and self._standing is not None:
            self.initial = self._standing

    def step(self, phases: np.ndarray, stands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Advance the clock by 20 ms.

        Args:
            phases: Phases before. Shape (n, p).
            stands: Mask of the robots that stand. Shape (n,), bool.

        Returns:
            Phases for the observation, and those to remember. Shapes (n, p).
        """
        table, still = self._table, stands[:, None]
        later = np.remainder(phases + POLICY_DT / table.period, 1.0)
        if table.standing == "resets":
            later = np.where(still, self._phases, later)
        elif table.standing == "stops" and self._standing is not None:
            near = np.abs(later - self._standing[0]) < NEAR
            later = np.where(still & near.any(axis=1, keepdims=True), self._standing, later)
            later = np.where(~still & near.all(axis=1, keepdims=True), self._phases, later)
        shown = later if table.advance == "before" else phases
        if self._standing is not None and table.standing != "stops":
            shown = np.where(still, self._standing, shown)
        if table.stance is not None:
            shown = stretch(shown, table.stance)
        return shown, later


def stretch(phases: np.ndarray, stance: float) -> np.ndarray:
    """Map the first `stance` of a cycle to its first half, the rest to its second half."""
    swing = 0.5 + 0.5 * (phases - stance) / (1 - stance)
    return np.where(phases < stance, 0.5 * phases / stance, swing)
