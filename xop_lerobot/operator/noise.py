"""Involuntary motion of a person: postural sway and hand tremor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from xop_lerobot.core.transforms import (
    compute_heading,
    make_pose,
    quat_exp,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.operator.frame import OperatorFrame

SWAY_BAND = (0.1, 1.0)
"""Band of postural sway [Hz]."""
TREMOR_BAND = (8.0, 12.0)
"""Band of physiological tremor [Hz]."""
HEAD_SWAY = (4e-3, 2.5e-3, 0.7e-3)
"""RMS of the head's sway forward, sideways and up [m]."""
HEAD_TURN = (0.2, 0.3, 0.4)
"""RMS of the head's roll, pitch and yaw while still [deg]."""
WRIST_DRIFT = (1.5e-3, 1.5e-3, 1.5e-3)
"""RMS of the drift of a held wrist against the body [m]."""
WRIST_TURN = (0.5, 0.5, 0.5)
"""RMS of the slow rotation of a held wrist [deg]."""
TREMOR = (1e-4, 1e-4, 1e-4)
"""RMS of the hand's tremor [m]."""
COMPONENTS = 16


class BandNoise:
    """Smooth random motion with all its power in a band; a function of seed and time alone.

    A sum of sinusoids with random frequencies and phases, the slower the stronger (amplitude
    ∝ 1/f), scaled to the RMS asked for.

    Args:
        rng: Source of frequencies and phases.
        band: Lowest and highest frequency [Hz].
        rms: RMS of each axis [any unit]. Shape (3,).
    """

    def __init__(
        self, rng: np.random.Generator, band: tuple[float, float], rms: tuple[float, ...]
    ) -> None:
        size = (COMPONENTS, len(rms))
        self._omega = 2 * np.pi * rng.uniform(*band, size)
        self._phase = rng.uniform(0, 2 * np.pi, size)
        weight = 1 / self._omega
        self._amplitude = np.sqrt(2) * np.array(rms) * weight / np.linalg.norm(weight, axis=0)

    def at(self, time: float) -> np.ndarray:
        """Value at `time` [s]. Shape (3,)."""
        return (self._amplitude * np.sin(self._omega * time + self._phase)).sum(axis=0)


@dataclass(frozen=True)
class Sway:
    """Offsets of one instant.

    Attributes:
        head: Offset of the head in its heading frame [m]. Shape (3,).
        head_turn: Rotation vector of the head [rad]. Shape (3,).
        wrists: Offset of left and right wrist in the heading frame [m]. Shape (2, 3).
        wrist_turns: Rotation vectors of the wrists [rad]. Shape (2, 3).
    """

    head: np.ndarray
    head_turn: np.ndarray
    wrists: np.ndarray
    wrist_turns: np.ndarray


class HumanNoise:
    """Sway and tremor of one person; the wrists sway with the body.

    Args:
        seed: Seed; the same seed is the same person at the same moment.
        scale: Scale of everything, 0 for none.
    """

    def __init__(self, seed: int, scale: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        self.scale = scale
        self._head = BandNoise(rng, SWAY_BAND, HEAD_SWAY)
        self._head_turn = BandNoise(rng, SWAY_BAND, tuple(np.radians(HEAD_TURN)))
        self._wrists = [
            (
                BandNoise(rng, SWAY_BAND, WRIST_DRIFT),
                BandNoise(rng, TREMOR_BAND, TREMOR),
                BandNoise(rng, SWAY_BAND, tuple(np.radians(WRIST_TURN))),
            )
            for _ in range(2)
        ]

    def at(self, time: float) -> Sway:
        """Offsets at `time` [s]."""
        head = self._head.at(time)
        wrists = [head + drift.at(time) + tremor.at(time) for drift, tremor, _ in self._wrists]
        turns = [turn.at(time) for _, _, turn in self._wrists]
        return Sway(
            head=self.scale * head,
            head_turn=self.scale * self._head_turn.at(time),
            wrists=self.scale * np.array(wrists),
            wrist_turns=self.scale * np.array(turns),
        )

    def disturb(self, frame: OperatorFrame) -> OperatorFrame:
        """The frame of a person who sways and trembles at its time."""
        sway = self.at(frame.time)
        turn = quat_from_yaw(compute_heading(frame.head[3:]))

        def move(pose: np.ndarray, offset: np.ndarray, rotation: np.ndarray) -> np.ndarray:
            quat = quat_multiply(pose[3:], quat_exp(rotation))
            return make_pose(pose[:3] + quat_rotate(turn, offset), quat)

        return replace(
            frame,
            head=move(frame.head, sway.head, sway.head_turn),
            left_wrist=move(frame.left_wrist, sway.wrists[0], sway.wrist_turns[0]),
            right_wrist=move(frame.right_wrist, sway.wrists[1], sway.wrist_turns[1]),
        )
