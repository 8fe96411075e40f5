"""The interface of a cost term and what it is given."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.morphology.tuning import CostWeights


@dataclass(frozen=True)
class Evaluation:
    """A batch of predictions to be scored.

    Attributes:
        qpos: Predicted positions; step 0 is the start. Shape (K, H + 1, nq).
        qvel: Predicted velocities. Shape (K, H + 1, nv).
        commands: Commands that are tried, before the rate limits. Shape (K, H, k).
        executed: The command being executed. Shape (k,).
        reference: The command that costs nothing. Shape (k,).
        poses: Predicted pose of each tracked frame. Shapes (K, H + 1, 7). As all that is read
            off the simulator, step 0 is the start, and the others are one physics step before
            the end of each control step.
        points: Predicted position of contact and hull sites. Shapes (K, H + 1, 3).
        velocities: Predicted velocity of contact sites [m/s]. Shapes (K, H + 1, 3).
        terminal_points: Position of those sites at the end of the extrapolation. Shape (K, 3).
        com: Predicted centre of mass, of robots with a support area. Shape (K, H + 1, 3).
        terminal_qpos: Position at the end of the extrapolation. Shape (K, nq).
        terminal_com: Centre of mass then, of robots with a support area. Shape (K, 3).
        goals: Goal of each tracked frame at every step. Shapes (H + 1, 7).
        terminal_poses: Pose of each tracked frame at the end of the extrapolation. (K, 7).
        terminal_goals: Goal of each tracked frame then. Shapes (7,).
        facing: Where a base on wheels shall face, as long as that counts, 0 to 1. Shape (2,).
        mode: Mode of the robot.
        dt: Time between steps [s].
        weights: The weights.
        upright: Tracked frames whose hand is to stay level.
        balance: Where the centre of mass shall rest on the base, of robots with a support area;
            None: where it does as the robot stands. Shape (2,).
        drives: Whether anything that is decided moves the base over the ground.
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
    com: np.ndarray
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


class Cost(ABC):
    """One term of the cost.

    Sums over a horizon are means over its steps, so that a weight means the same for every
    horizon.
    """

    name: str

    @abstractmethod
    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample, its weight included. Shape (K,)."""
