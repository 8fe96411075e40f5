"""Interface of cost terms, and the predicted quantities that they are computed from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.morphology.tuning import CostWeights


@dataclass(frozen=True)
class Evaluation:
    """A batch of predictions to score.

    Attributes:
        qpos: Predicted positions; step 0 is the start. Shape (K, H + 1, nq).
        qvel: Predicted velocities. Shape (K, H + 1, nv).
        commands: Sampled commands, before the rate limits. Shape (K, H, k).
        executed: The command being executed. Shape (k,).
        reference: The command of zero control cost. Shape (k,).
        poses: Predicted pose of each tracked frame. Shapes (K, H + 1, 7). As in all sensor
            readings, step 0 is the start, and step k is one physics step before the end of
            control step k.
        points: Predicted position of contact and hull sites. Shapes (K, H + 1, 3).
        velocities: Predicted velocity of contact sites [m/s]. Shapes (K, H + 1, 3).
        terminal_points: Position of those sites at the end of the extrapolation. Shapes (K, 3).
        terminal_qpos: Position at the end of the extrapolation. Shape (K, nq).
        terminal_com: Centre of mass at that time, of robots with a support area. Shape (K, 3).
        goals: Goal of each tracked frame at every step. Shapes (H + 1, 7).
        terminal_poses: Pose of each tracked frame at the end of the extrapolation. (K, 7).
        terminal_goals: Goal of each tracked frame at that time. Shapes (7,).
        facing: Desired heading of a wheeled base as a direction in the world, whose length is its
            weight, 0 to 1. Shape (2,).
        mode: Mode of the robot.
        dt: Time between steps [s].
        weights: The weights.
        upright: Tracked frames of hands that are kept level.
        balance: Desired rest position of the centre of mass on the base, of robots with a support
            area; None for that of the standing robot. Shape (2,).
        drives: Whether any free entry moves the base over the ground.
        extrapolates: Whether the end of the extrapolation is later than the last step.
        scale_control: Whether the control cost measures each entry in half its range.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    commands: np.ndarray
    executed: np.ndarray
    reference: np.ndarray
    poses: Mapping[str, np.ndarray]
    points: Mapping[str, np.ndarray]
    velocities: Mapping[str, np.ndarray]
    terminal_points: Mapping[str, np.ndarray]
    terminal_qpos: np.ndarray
    terminal_com: np.ndarray
    goals: Mapping[str, np.ndarray]
    terminal_poses: Mapping[str, np.ndarray]
    terminal_goals: Mapping[str, np.ndarray]
    facing: np.ndarray
    mode: Mode
    dt: float
    weights: CostWeights
    upright: tuple[str, ...] = ()
    drives: bool = True
    balance: np.ndarray | None = None
    extrapolates: bool = True
    scale_control: bool = True


class Cost(ABC):
    """One term of the cost.

    Sums over the horizon are implemented as means over its steps, so that weights do not depend
    on the horizon. A term must not mix samples.

    Attributes:
        name: Name of the term in `Plan.cost` and in datasets.
    """

    name: str

    @abstractmethod
    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Weighted cost of every sample. Shape (K,)."""
