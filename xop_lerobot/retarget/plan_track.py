"""Plans in time: which one counts at an instant, and what it says then."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.command import CommandSpace
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.retarget.plan import Plan

GRACE_S = 0.1
"""How long the last command of a plan that has ended is held before the robot brakes [s]."""
_KEPT = 4


class StampedPlan(NamedTuple):
    """A plan and the times of the robot's clock that it belongs to.

    Attributes:
        plan: The plan.
        time: When its first command is due [s].
        measured: When the state was measured that it comes from [s].
        period: Time from plan to plan in its mode [s].
    """

    plan: Plan
    time: float
    measured: float
    period: float = 0.0

    def get_step(self, time: float) -> int:
        """Index of the entry that is due at `time`; the first before, the last after its end."""
        step = round((time - self.time) / POLICY_DT)
        return min(max(step, 0), len(self.plan.commands) - 1)

    def has_run_out(self, time: float) -> bool:
        """Whether `time` is beyond all that the plan, or holding its end, can be good for."""
        length = max(len(self.plan.commands) * POLICY_DT, self.period)
        return time - self.time > length + GRACE_S

    def get_command(self, time: float, space: CommandSpace) -> np.ndarray:
        """The command that is due at `time`. Once it has run out, velocities are neutral. (k,)."""
        command = self.plan.commands[self.get_step(time)]
        if self.has_run_out(time):
            return np.where(space.mobile_only, space.neutral, command)
        return command

    def get_arms(self, time: float) -> dict[str, float]:
        """Targets of the arm joints that the plan decides, at `time` [rad]."""
        step = self.get_step(time)
        return {name: float(angles[step]) for name, angles in self.plan.arms.items()}

    def predict_velocity(self, time: float) -> np.ndarray | None:
        """Predicted linear velocity of the base at `time`, world axes [m/s].

        Returns:
            Shape (3,); None beyond what was predicted.
        """
        velocities, step = self.plan.velocities, (time - self.time) / POLICY_DT
        if not -0.5 <= step <= len(velocities) - 0.5:  # half a step is nothing
            return None
        step = min(max(step, 0.0), len(velocities) - 1.0)
        first = min(int(step), max(len(velocities) - 2, 0))
        pair = velocities[first : first + 2]
        velocity = pair[0] + (step - first) * (pair[-1] - pair[0])
        return velocity if np.isfinite(velocity).all() else None


class PlanTrack:
    """The last few plans; each counts from when it is due until the next one is.

    Args:
        plans: Plans in the order in which they were made.
    """

    def __init__(self, plans: Iterable[StampedPlan] = ()) -> None:
        self._plans: deque[StampedPlan] = deque(plans, maxlen=_KEPT)

    def copy(self) -> PlanTrack:
        """Return one with the same plans."""
        return PlanTrack(self._plans)

    def add(self, plan: StampedPlan) -> None:
        """Add the newest plan."""
        self._plans.append(plan)

    def clear(self) -> None:
        """Forget all plans."""
        self._plans.clear()

    @property
    def newest(self) -> StampedPlan | None:
        """The plan that was added last."""
        return self._plans[-1] if self._plans else None

    def at(self, time: float) -> StampedPlan | None:
        """The plan that counts at `time`: the newest that is due, else the oldest; or none."""
        for plan in reversed(self._plans):
            if plan.time <= time + POLICY_DT / 2:
                return plan
        return self._plans[0] if self._plans else None


def overlay_arms(arms: np.ndarray, names: tuple[str, ...], decided: Mapping[str, float]) -> None:
    """Write the targets in `decided` over those in `arms`, which are in the order of `names`."""
    for name, angle in decided.items():
        arms[names.index(name)] = angle
