"""What the arms do beside their targets: observed slowly, and taken out of what is sent."""

from __future__ import annotations

import numpy as np


class ArmBias:
    r"""Observes the offset of each arm joint from its target, to send targets without it.

    A learned low-level policy moves the arms beside their targets to keep its balance, by 0.2
    rad with the hands forward, and servos sag. Per joint, with :math:`s` the target that was
    executed and :math:`q` the measured angle,

    .. math:: b \leftarrow b + (1 - e^{-dt/\tau})\,(q - s - b), \qquad |b| \le b_{max},

    and the target to send for a wanted angle :math:`q^*` is :math:`q^* - b` within the joint's
    limits. It is an observer of the plant's own offset, not an integral of the tracking error:
    nothing winds up at a limit or at a goal out of reach.

    While the arms move, :math:`q - s` is lag and swing, no offset; so nothing is learned until
    the wanted angles of all joints, smoothed against noise, have been slow for a while.

    Args:
        joint_range: Limits of the joints [rad]. Shape (n, 2).
        time_constant: τ [s].
        max_bias: Largest offset that is taken out [rad].
        max_speed: Speed of a wanted angle from which on nothing is learned [rad/s].
        smoothing: Time constant over which that speed is smoothed [s].
        rest_s: For how long the arms must have been slow [s].
    """

    def __init__(
        self,
        joint_range: np.ndarray,
        *,
        time_constant: float = 0.5,
        max_bias: float = 0.3,
        max_speed: float = 0.5,
        smoothing: float = 0.4,
        rest_s: float = 0.2,
    ) -> None:
        self.joint_range = joint_range
        self.time_constant, self.max_bias = time_constant, max_bias
        self.max_speed, self.smoothing, self.rest_s = max_speed, smoothing, rest_s
        self.reset()

    def reset(self) -> None:
        """Forget the offsets."""
        self.bias = np.zeros(len(self.joint_range))
        """The offsets now [rad]. Shape (n,)."""
        self._velocity = np.zeros(len(self.joint_range))
        self._slow_s = 0.0

    def update(
        self, offset: np.ndarray, moved: np.ndarray, dt: float, free: np.ndarray | None = None
    ) -> None:
        """Learn from one tick.

        Args:
            offset: Measured angles less the targets executed last, q − s [rad]. Shape (n,).
            moved: How far the wanted angles have moved since the last update [rad]. Shape (n,).
            dt: Time since then [s]; without any, nothing is learned.
            free: Factor on the rate at which each joint learns, 1 for a free arm, 0 for one that
                presses as hard as it may. Shape (n,).
        """
        if dt <= 0:
            return
        share = -np.expm1(-dt / self.smoothing)
        self._velocity += share * (moved / dt - self._velocity)
        is_slow = np.abs(self._velocity).max(initial=0.0) <= self.max_speed
        self._slow_s = self._slow_s + dt if is_slow else 0.0
        if self._slow_s < self.rest_s:
            return
        share = -np.expm1(-dt / self.time_constant) * (1.0 if free is None else free)
        bias = self.bias + share * (offset - self.bias)
        self.bias = np.clip(bias, -self.max_bias, self.max_bias)

    def compute_targets(self, wanted: np.ndarray) -> np.ndarray:
        """Targets [rad] that bring the joints to `wanted` [rad]. Shapes (n,)."""
        return np.clip(wanted - self.bias, *self.joint_range.T)
