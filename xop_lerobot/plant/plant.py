"""Interface of a plant, the robot's body: measured, commanded and stepped, simulated or real."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from xop_lerobot.low_level.policy import LowLevelPolicy


@dataclass(frozen=True)
class Measurement:
    """Sensor readings of a plant, with the true state in simulation.

    Attributes:
        time: Clock of the plant [s].
        qpos: Measured generalised position of the robot, MuJoCo order. Shape (nq,).
        qvel: Measured generalised velocity of the robot, MuJoCo order. Shape (nv,).
        effort: Actuator forces [N m or N]. Shape (nu,).
        true_qpos: The simulator's own position; `qpos` on hardware. Shape (nq,).
        true_qvel: The simulator's own velocity; `qvel` on hardware. Shape (nv,).
        fallen: Whether the robot has fallen.
        collision: Whether the robot touches anything but the ground under its feet or wheels.
        contacts: Names of the bodies in each collision, for messages.
    """

    time: float
    qpos: np.ndarray
    qvel: np.ndarray
    effort: np.ndarray
    true_qpos: np.ndarray
    true_qvel: np.ndarray
    fallen: bool = False
    collision: bool = False
    contacts: tuple[tuple[str, str], ...] = field(default=())


class Plant(ABC):
    """A robot's body. `apply` sets the actuators' targets, `step` advances time."""

    @abstractmethod
    def reset(self, seed: int | None = None) -> None:
        """Move to the initial posture, at rest; hardware moves there slowly."""

    @abstractmethod
    def measure(self) -> Measurement:
        """Read the sensors."""

    @abstractmethod
    def apply(self, targets: np.ndarray) -> None:
        """Set the target of every actuator, in the model's order. Shape (nu,)."""

    def ramp(self, targets: np.ndarray) -> None:
        """Interpolate linearly to the targets of all actuators during the next `step`.

        Same as `apply` for a body that cannot, or whose own controller interpolates.
        """
        self.apply(targets)

    def adapt(self, policy: LowLevelPolicy) -> None:
        """Adopt the motor gains that `policy` was trained with; called by `PolicyLoop`.

        No effect by default: real motors cannot be exchanged.
        """
        del policy

    @abstractmethod
    def step(self, dt: float) -> None:
        """Advance by `dt` [s]: simulate, or wait on hardware."""

    @abstractmethod
    def render(self, camera: str) -> np.ndarray:
        """Image of `camera`. Shape (height, width, 3), uint8.

        Raises:
            UnknownName: Listing the cameras.
        """

    def close(self) -> None:
        """Release everything; may be called twice."""
