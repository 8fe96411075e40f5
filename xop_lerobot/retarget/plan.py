"""Interface of retargeters, the plans that they return, and playback of plans over time.

A `Retargeter` turns a robot state and a goal into a `Plan`. `StampedPlan` places a plan on the
robot's clock, and `PlanTrack` selects the plan in force at a given time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.command import CommandSpace, Mode
from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.obstacles import Obstacle


class Status(IntEnum):
    """How a solve ended."""

    OK = 0
    DIVERGED = 1
    """No sample had a finite cost: the plan holds the last command."""


@dataclass(frozen=True)
class Plan:
    """A retargeter's answer.

    Attributes:
        command: Command to execute now, before limits. Shape (k,).
        commands: The planned sequence, one for each control step. Shape (H, k).
        mode: Mode that the plan was made for.
        qpos: Predicted positions under the plan's best sample; empty for `direct`. (H + 1, nq).
        arms: Targets of the arm joints that the plan decides, by joint, one per control step
            [rad]; the other joints are left to inverse kinematics. Shapes (H,).
        cost: Cost of the best sample by term.
        health: Further health metrics by name: `intervention` (see `Intervention`) and `risk`.
        status: How the solve ended.
        effective_samples: Effective sample size of the update [1].
        timings: Time spent, by part [s]; ``"solve"`` is the total.
    """

    command: np.ndarray
    commands: np.ndarray
    mode: Mode
    qpos: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    arms: Mapping[str, np.ndarray] = field(default_factory=dict)
    cost: Mapping[str, float] = field(default_factory=dict)
    health: Mapping[str, float] = field(default_factory=dict)
    status: Status = Status.OK
    effective_samples: float = 1.0
    timings: Mapping[str, float] = field(default_factory=dict)


class Retargeter(ABC):
    """Turns a goal into commands for the low-level policy.

    Attributes:
        cost_names: Names of the cost terms of its plans, in order.
        frames: Tracked frames that it controls; inverse kinematics of the arms follow the others.
        holds_place: Whether it closes the loop on the head's position. If not, wrist goals move
            with the head: their positions in the world are lost as soon as the robot walks.
    """

    cost_names: tuple[str, ...] = ()
    frames: tuple[str, ...] = ("head",)
    holds_place: bool = True

    @abstractmethod
    def reset(self, state: RobotState) -> None:
        """Discard all plans; the next one starts from the command that `state` executes."""

    @abstractmethod
    def plan(self, state: RobotState, goal: Goal) -> Plan:
        """Compute the plan from `state` towards `goal`."""

    @abstractmethod
    def control_period(self, mode: Mode) -> float:
        """Time between two plans in `mode` [s]."""

    def configure(
        self,
        configs: Mapping[Mode, MpcConfig] | None = None,
        targets: tuple[str, ...] | None = None,
        body: tuple[str, ...] | None = None,
        constraints: frozenset[str] | None = None,
    ) -> None:
        """Change settings from the next solve on; no effect for a retargeter without settings."""
        del configs, targets, body, constraints

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Replace the obstacles to avoid; no effect for a retargeter that ignores obstacles."""
        del obstacles

    def close(self) -> None:
        """Release threads; may be called twice."""


GRACE_S = 0.1
"""Time for which the last command of an expired plan is held before velocities stop [s]."""
_KEPT = 4  # plans that a track keeps: a delayed one may not be due yet


class StampedPlan(NamedTuple):
    """A plan with its times on the robot's clock.

    Attributes:
        plan: The plan.
        time: Time at which its first command is due [s].
        measured: Time at which the state that it is based on was measured [s].
        period: Time between two plans in its mode [s].
    """

    plan: Plan
    time: float
    measured: float
    period: float = 0.0

    def get_step(self, time: float) -> int:
        """Index of the command due at `time`; clamped to the first and the last one."""
        step = round((time - self.time) / POLICY_DT)
        return min(max(step, 0), len(self.plan.commands) - 1)

    def has_run_out(self, time: float) -> bool:
        """Whether `time` is more than `GRACE_S` past the end of the plan."""
        # A plan shorter than the control period has to last until the next one.
        length = max(len(self.plan.commands) * POLICY_DT, self.period)
        return time - self.time > length + GRACE_S

    def get_command(self, time: float, space: CommandSpace) -> np.ndarray:
        """The command due at `time`, with neutral velocities once the plan has run out. (k,)."""
        command = self.plan.commands[self.get_step(time)]
        if self.has_run_out(time):
            return np.where(space.mobile_only, space.neutral, command)
        return command

    def get_arms(self, time: float) -> dict[str, float]:
        """Targets of the arm joints that the plan decides, at `time` [rad]."""
        step = self.get_step(time)
        return {name: float(angles[step]) for name, angles in self.plan.arms.items()}

    def compute_health(self, time: float) -> dict[str, float]:
        """Health metrics of the plan at `time` for a recording, by name."""
        return {
            "solve_time": self.plan.timings.get("solve", 0.0),
            "plan_age": time - self.measured,
            "effective_samples": self.plan.effective_samples,
            "status": float(self.plan.status),
            **self.plan.health,
        }


class PlanTrack:
    """The last few plans; each is in force from its due time until that of the next one.

    Args:
        plans: Plans in the order in which they were made.
    """

    def __init__(self, plans: Iterable[StampedPlan] = ()) -> None:
        self._plans: deque[StampedPlan] = deque(plans, maxlen=_KEPT)

    def copy(self) -> PlanTrack:
        """Return a track with the same plans."""
        return PlanTrack(self._plans)

    def add(self, plan: StampedPlan) -> None:
        """Add the newest plan."""
        self._plans.append(plan)

    def clear(self) -> None:
        """Discard all plans."""
        self._plans.clear()

    @property
    def newest(self) -> StampedPlan | None:
        """The plan that was added last."""
        return self._plans[-1] if self._plans else None

    def at(self, time: float) -> StampedPlan | None:
        """The plan in force at `time`: the newest that is due, else the oldest; None if empty."""
        for plan in reversed(self._plans):
            if plan.time <= time + POLICY_DT / 2:
                return plan
        return self._plans[0] if self._plans else None


def overlay_arms(arms: np.ndarray, names: tuple[str, ...], decided: Mapping[str, float]) -> None:
    """Overwrite the entries of `arms`, in the order of `names`, by the targets in `decided`."""
    for name, angle in decided.items():
        arms[names.index(name)] = angle
