"""The interface of a body: simulated or real, it is measured, commanded and stepped alike."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from xop_lerobot.low_level.policy import LowLevelPolicy


@dataclass(frozen=True)
class Measurement:
    """What a plant's sensors say, and in simulation the truth beside it.

    Attributes:
        time: Clock of the plant [s].
        qpos: Measured generalised position of the robot, MuJoCo order. Shape (nq,).
        qvel: Measured generalised velocity of the robot, MuJoCo order. Shape (nv,).
        effort: Actuator forces [N m or N]. Shape (nu,).
        true_qpos: The simulator's own position; `qpos` on hardware. Shape (nq,).
        true_qvel: The simulator's own velocity; `qvel` on hardware. Shape (nv,).
        fallen: Whether the robot has fallen.
        collision: Whether the robot touches anything but the ground under its feet or wheels.
        contacts: Names of what touches what, for messages.
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
    """A body. `apply` sets the actuators' targets, `step` lets time pass."""

    @abstractmethod
    def reset(self, seed: int | None = None) -> None:
        """Put the body at rest in its start posture; hardware moves there slowly."""

    @abstractmethod
    def measure(self) -> Measurement:
        """Read the sensors now."""

    @abstractmethod
    def apply(self, targets: np.ndarray) -> None:
        """Set the target of every actuator, in the model's order. Shape (nu,)."""

    def ramp(self, targets: np.ndarray) -> None:
        """Go to the targets of all actuators in a straight line, within the next `step`.

        Like `apply` for a body that cannot, or whose own controller does it.
        """
        self.apply(targets)

    def adapt(self, policy: LowLevelPolicy) -> None:
        """Take the motors that `policy` was trained with; `PolicyLoop` asks for it.

        Nothing by default: a body of metal has the motors that it has.
        """
        del policy

    @abstractmethod
    def step(self, dt: float) -> None:
        """Let `dt` [s] pass: simulate it, or wait for it on hardware."""

    @abstractmethod
    def render(self, camera: str) -> np.ndarray:
        """Picture of `camera`. Shape (height, width, 3), uint8.

        Raises:
            UnknownName: Listing the cameras.
        """

    def close(self) -> None:
        """Release everything; may be called twice."""
