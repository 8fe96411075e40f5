"""One-euro filter: strong smoothing at rest, little lag in motion."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import make_pose, quat_conjugate, quat_exp, quat_log, quat_multiply
from xop_lerobot.operator.frame import OperatorFrame


@dataclass
class OneEuroConfig:
    """Settings of the one-euro filter.

    Attributes:
        min_cutoff: Cut-off frequency at rest [Hz]; lower values smooth more.
        position_beta: Increase of the cut-off with a limb's speed [1/m]; higher values reduce the
            lag in motion.
        rotation_beta: Increase of the cut-off with a limb's turn rate [1/rad].
        speed_cutoff: Cut-off frequency of the speed estimates [Hz].
    """

    min_cutoff: float = 1.0
    position_beta: float = 40.0
    rotation_beta: float = 8.0
    speed_cutoff: float = 2.0

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            BadValue: If one is not a finite number above 0.
        """
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise BadValue(f"one_euro.{name} must be finite and above 0, got {value}")


def compute_share(cutoff: float, dt: float) -> float:
    r"""Filter gain of a new sample, :math:`\alpha = 1 / (1 + 1 / (2 \pi f_c\, dt))` [1]."""
    return 1 / (1 + 1 / (2 * math.pi * cutoff * dt))


class OneEuroPose:
    r"""First-order low-pass of a pose whose cut-off rises with its speed.

    .. math:: f_c = f_{min} + \beta |\dot{\hat x}|, \qquad
              \hat x_k = \hat x_{k-1} + \alpha(f_c) (x_k - \hat x_{k-1})

    for the position, and the same on the sphere for the orientation, where the difference is a
    rotation vector. The speed is that of the raw pose, itself smoothed.

    Args:
        config: Cut-off frequencies.

    References:
        [1] G. Casiez, N. Roussel, D. Vogel: 1€ Filter: A Simple Speed-based Low-pass Filter for
        Noisy Input in Interactive Systems. CHI 2012.
    """

    def __init__(self, config: OneEuroConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next pose passes unfiltered."""
        self._time: float | None = None
        self._raw = self._pose = np.zeros(7)
        self._velocity, self._turn = np.zeros(3), np.zeros(3)

    def update(self, time: float, pose: np.ndarray) -> np.ndarray:
        """Filter the pose of `time` [s], later than the last one. Shape (7,)."""
        pose = np.asarray(pose, dtype=float)
        if self._time is None:
            self._pose = pose.copy()
        else:
            self._pose = self._follow(time - self._time, pose)
        self._time, self._raw = time, pose.copy()
        return self._pose.copy()

    def _follow(self, dt: float, pose: np.ndarray) -> np.ndarray:
        c = self._config
        share = compute_share(c.speed_cutoff, dt)
        step = _compute_turn(self._raw[3:], pose[3:])
        self._velocity += share * ((pose[:3] - self._raw[:3]) / dt - self._velocity)
        self._turn += share * (step / dt - self._turn)
        speed, rate = (float(np.linalg.norm(v)) for v in (self._velocity, self._turn))
        last = self._pose
        move = compute_share(c.min_cutoff + c.position_beta * speed, dt)
        turn = compute_share(c.min_cutoff + c.rotation_beta * rate, dt)
        position = last[:3] + move * (pose[:3] - last[:3])
        quat = quat_multiply(last[3:], quat_exp(turn * _compute_turn(last[3:], pose[3:])))
        return make_pose(position, quat / np.linalg.norm(quat))


def _compute_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotation vector from `start` to `end` along the shorter arc [rad]. Shape (3,)."""
    between = quat_multiply(quat_conjugate(start), end)
    return quat_log(between if between[0] >= 0 else -between)


class OneEuro:
    """Smooths head and wrists of a stream; a lost limb restarts when it is seen again.

    Pinches are not filtered: their thresholds have hysteresis.

    Args:
        config: Cut-off frequencies.
    """

    def __init__(self, config: OneEuroConfig | None = None) -> None:
        self._limbs = [OneEuroPose(config or OneEuroConfig()) for _ in FRAMES]

    def reset(self) -> None:
        """Forget everything."""
        for limb in self._limbs:
            limb.reset()

    def smooth(self, frame: OperatorFrame) -> OperatorFrame:
        """Smooth the limbs of a frame, later than the last one."""
        poses = {}
        for name, limb, seen in zip(FRAMES, self._limbs, frame.tracked, strict=True):
            if seen:
                poses[name] = limb.update(frame.time, frame.pose(name))
            else:
                limb.reset()
        return dataclasses.replace(frame, **poses)


def make_one_euro(smoothing: float) -> OneEuro | None:
    """Make a filter whose cut-offs are divided by `smoothing`; None for 0."""
    if smoothing == 0:
        return None
    c = OneEuroConfig()
    return OneEuro(
        OneEuroConfig(
            c.min_cutoff / smoothing,
            c.position_beta / smoothing,
            c.rotation_beta / smoothing,
            c.speed_cutoff,
        )
    )
