"""Where a robot comes to rest beside its command: observed, and counted on."""

from __future__ import annotations

import numpy as np

from xop_lerobot.retarget.model.command_model import CommandModel

_QUIET = 0.03  # distance of the lagged command from the command at which a robot rests, of scale


class OffsetObserver:
    r"""Low-passed difference between height and joints and what was commanded, at rest.

    .. math:: \bar a \leftarrow a + (\bar a - a)e^{-dt/T},\qquad
              o \leftarrow o + (1 - e^{-dt/\tau})(q - \bar a - o)

    A low-level policy holds a waist or a height beside the command, by a few hundredths, to keep
    its balance. The short horizon sees the motion towards the command, not where it ends. With o
    in the extrapolated terminal cost the controller has no steady offset, as with the drift of a
    walking base. It learns only where the lagged command \bar a has caught up with a.

    Args:
        command_model: What a command does, and with what lag.
        time_constant: τ [s].
        largest: Largest offset, in shares of a command's scale.

    Attributes:
        settled: The lagged command. Shape (k,).
        offset: o; zero for velocities. Shape (k,).
    """

    def __init__(
        self, command_model: CommandModel, time_constant: float = 0.6, largest: float = 0.2
    ) -> None:
        self.command_model, self.time_constant = command_model, time_constant
        self.largest = largest
        space = command_model.space
        self._scale = (space.high - space.low) / 2
        self.reset(space.neutral)

    def reset(self, command: np.ndarray) -> None:
        """Forget everything: the robot rests at `command`. Shape (k,)."""
        self.settled = np.array(command, dtype=float)
        self.offset = np.zeros(len(self.settled))
        self._last: float | None = None

    def update(
        self, time: float, qpos: np.ndarray, command: np.ndarray, *, learns: bool = True
    ) -> None:
        """Take what has happened since the last call.

        Args:
            time: The robot's clock [s].
            qpos: Configuration. Shape (nq,).
            command: Command executed since then. Shape (k,).
            learns: Whether offsets are counted on; if not, they are forgotten.
        """
        last, self._last = self._last, time
        if last is None or time <= last:
            return
        dt = time - last
        model = self.command_model
        self.settled = model.settle(self.settled, command, dt)
        if not learns:
            self.offset = np.zeros(len(self.settled))
            return
        beside = model.read(qpos) - self.settled - self.offset
        quiet = np.abs(command - self.settled) < _QUIET * self._scale
        known = quiet & ~model.is_velocity() & np.isfinite(beside)
        gain = -np.expm1(-dt / self.time_constant)
        moved = self.offset + gain * np.where(known, beside, 0.0)
        reach = self.largest * self._scale
        self.offset = np.clip(moved, -reach, reach)
