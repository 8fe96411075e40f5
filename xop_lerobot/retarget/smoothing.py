"""Acceleration limits of commands, so that the robot can follow them without overshoot."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.command import CommandSpace, Mode, check_vector

_AT_REST = 1e-9  # rounding error below which a velocity counts as neutral [unit of the entry]


class CommandSmoother:
    r"""Moves a command towards the desired one within its bounds, rates and accelerations.

    .. math:: |a_n - a_{n-1}| \le \dot a_{max}\,dt, \qquad
              |a_n - 2 a_{n-1} + a_{n-2}| \le \ddot a_{max}\,dt^2

    It brakes in time: a constant desired command is reached without overshoot, and a bound is
    never crossed. When the mode becomes stationary, velocities stop in the same way, at
    `stop_rate`; the robot switches to that mode once they are zero.

    Args:
        space: The command space; entries without a `max_accel` have only a rate limit.
        dt: Control period [s].
    """

    def __init__(self, space: CommandSpace, dt: float) -> None:
        self.space, self.dt = space, dt
        self._gain = space.max_accel * dt * dt  # largest change of the step between two ticks
        self.reset()

    def reset(self) -> None:
        """Forget the previous commands: the next one starts from rest."""
        self._sent: np.ndarray | None = None
        self._step = np.zeros(len(self.space))

    def smooth(
        self, command: np.ndarray, mode: Mode, executed: np.ndarray, executed_mode: Mode
    ) -> tuple[np.ndarray, Mode]:
        """Compute the command to send; call `note` with the one that was sent in the end.

        Args:
            command: Desired command. Shape (k,).
            mode: Desired mode.
            executed: Command being executed. Shape (k,).
            executed_mode: Mode being executed.

        Returns:
            The command, (k,), and the mode to send: still mobile while velocities are stopping,
            still stationary while the posture is outside the bounds of mobile mode.
        """
        space, stops = self.space, False
        command = check_vector("command", command, len(space))
        if mode is Mode.STATIONARY and executed_mode is Mode.MOBILE:
            stops, mode = True, Mode.MOBILE
            command = np.where(space.mobile_only, space.neutral, command)
            command = np.clip(command, *space.bounds(Mode.STATIONARY))
        if mode is Mode.MOBILE and executed_mode is Mode.STATIONARY:
            low, high = space.bounds(mode)
            outside = (executed < low - _AT_REST) | (executed > high + _AT_REST)
            if outside.any():  # a squatting robot has to stand up before it walks
                mode, command = Mode.STATIONARY, np.clip(command, low, high)
        if self._sent is None or not np.array_equal(executed, self._sent):
            self._step = np.zeros(len(space))  # the robot was driven by another source meanwhile
        wanted = space.limit(command, None, self.dt, mode)
        step = space.limit(command, executed, self.dt, mode) - executed
        step = np.sign(step) * np.minimum(
            np.abs(step), compute_braking_step(np.abs(wanted - executed), self._gain)
        )
        step = space.straighten(step, wanted - executed)
        step = np.clip(step, self._step - self._gain, self._step + self._gain)
        # A step towards a bound must leave room to brake before it.
        low, high = space.bounds(mode)
        rise = compute_braking_step(np.maximum(high - executed, 0), self._gain)
        fall = compute_braking_step(np.maximum(executed - low, 0), self._gain)
        reach = (space.stop_rate if stops else space.max_rate) * self.dt
        step = np.clip(step, -np.minimum(fall, reach), np.minimum(rise, reach))
        sent = executed + step
        if stops and self._is_at_rest(executed, sent):
            return sent, Mode.STATIONARY
        return sent, mode

    def _is_at_rest(self, executed: np.ndarray, sent: np.ndarray) -> bool:
        """Whether velocities are neutral and stationary mode would not change the command."""
        space = self.space
        moving = space.mobile_only & (np.abs(sent - space.neutral) > _AT_REST)
        low, high = space.bounds(Mode.STATIONARY)
        outside = (sent < low - _AT_REST) | (sent > high + _AT_REST)
        kept = space.limit(sent, executed, self.dt, Mode.STATIONARY)
        close = np.allclose(kept, sent, rtol=0, atol=_AT_REST)
        return close and not (moving | outside).any()

    def note(self, executed: np.ndarray, sent: np.ndarray) -> None:
        """Record the command that was finally sent after `executed`. Shapes (k,)."""
        self._step, self._sent = sent - executed, np.array(sent)


def compute_braking_step(distance: np.ndarray, gain: np.ndarray) -> np.ndarray:
    r"""Largest step from which a stop within `distance` is possible, shrinking by `gain` per step.

    With n steps to go, :math:`\sum_{i<n} (s - i g) = d` gives :math:`s = d/n + (n - 1) g/2`; n
    is the smallest number for which the last step is not negative.

    Args:
        distance: Non-negative distance d to the stopping point. Shape (k,).
        gain: Largest change g of the step; infinite for no limit. Shape (k,).

    Returns:
        The step, at most `distance`. Shape (k,).
    """
    limited = np.isfinite(gain)
    g = np.where(limited, gain, 1.0)
    # The factor keeps an exact integer from being rounded down by floating-point error.
    n = 1 + np.floor((np.sqrt(1 + 8 * distance / g) - 1) / 2 * (1 + 1e-12))
    return np.where(limited, distance / n + (n - 1) * g / 2, distance)
