"""What a retargeter returns, and the interface of retargeters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal, RobotState
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
        mode: The mode it is for.
        qpos: Predicted positions under the plan's best sample; empty for `direct`. (H + 1, nq).
        velocities: Predicted linear velocity of the base under that sample, world axes [m/s]; empty
            for `direct`. Shape (H + 1, 3).
        arms: Targets of the arm joints that the retargeter decided itself, by joint, one for
            each control step [rad]; the others are left to inverse kinematics. Shapes (H,).
        cost: Cost of the best sample by term.
        health: Further figures by name: `intervention` (see `Intervention`) and `risk`.
        status: How the solve ended.
        effective_samples: Effective sample size of the update [1].
        timings: Time spent, by part [s]; ``"solve"`` is the whole.
    """

    command: np.ndarray
    commands: np.ndarray
    mode: Mode
    qpos: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    velocities: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
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
        frames: The tracked frames it drives; the arms' inverse kinematics follow the others.
        holds_place: Whether it brings the head back to its goal's place. Of one that does not,
            arms go with the head: the place of their goals in the world is lost with the first
            step.
    """

    cost_names: tuple[str, ...] = ()
    frames: tuple[str, ...] = ("head",)
    holds_place: bool = True

    @abstractmethod
    def reset(self, state: RobotState) -> None:
        """Forget all plans; the next one starts from the command that `state` executes."""

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
        """Change settings from the next solve on; nothing for a retargeter that has none."""
        del configs, targets, body, constraints

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Keep clear of these and no others from the next solve on, where it does so at all."""
        del obstacles

    def close(self) -> None:
        """Release threads; may be called twice."""
