"""Observers of what a command does not explain: drift of the base, and offsets at rest."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.transforms import quat_yaw, wrap_angle
from xop_lerobot.retarget.model.command_model import CommandModel

_MAX = np.array([0.3, 0.3, 0.4])  # [m/s, m/s, rad/s]; more is a stumble, not a drift


class DriftObserver:
    r"""Low-passed difference of measured and commanded base velocity.

    .. math:: b \leftarrow b + (1 - e^{-dt/\tau})(v_{measured} - v_{command} - b)

    along and across the heading, and about the vertical. The command counts with the lag of a
    policy that takes it up, or else every start and stop would look like a drift. A walking
    policy drifts by several centimetres a second, by more when it leans; the horizon is too
    short to tell that from the sway of the gait. With b in the extrapolated terminal cost the
    controller has no steady offset (an output disturbance model, as in offset-free model
    predictive control, Pannocchia and Rawlings, 2003).

    Args:
        command_model: What a command asks of the base.
        time_constant: τ [s], several strides.
        lag_s: Time constant with which the base takes a command up; may be 0 [s].
    """

    def __init__(
        self, command_model: CommandModel, time_constant: float = 3.0, lag_s: float = 0.3
    ) -> None:
        self.command_model, self.time_constant, self.lag_s = command_model, time_constant, lag_s
        self.reset()

    def reset(self) -> None:
        """Forget everything: no drift."""
        self.drift = np.zeros(3)
        self._expected = np.zeros(3)
        self._last: tuple[float, np.ndarray] | None = None

    def update(self, time: float, qpos: np.ndarray, command: np.ndarray, moving: bool) -> None:
        """Take the base's pose at `time` [s] and the command executed since the last one.

        Args:
            time: The robot's clock [s].
            qpos: Configuration. Shape (nq,).
            command: Command. Shape (k,).
            moving: Whether the base follows velocities at all; if not, there is no drift.
        """
        if not np.isfinite(qpos[:7]).all():
            return
        yaw = float(quat_yaw(qpos[3:7]))
        # The point about which the base turns: turning alone does not move it.
        pivot = self.command_model.pivot * np.array([np.cos(yaw), np.sin(yaw)])
        planar = np.array([*(qpos[:2] + pivot), yaw])
        last, self._last = self._last, (time, planar)
        if not moving:
            self.drift, self._expected = np.zeros(3), np.zeros(3)
            return
        if last is None or time <= last[0]:
            return
        dt = time - last[0]
        moved = planar - last[1]
        moved[2] = wrap_angle(moved[2])
        cosine, sine = np.cos(planar[2]), np.sin(planar[2])
        velocity = np.array(
            [cosine * moved[0] + sine * moved[1], cosine * moved[1] - sine * moved[0], moved[2]]
        )
        twist = self.command_model.compute_twist(command)
        taken_up = -np.expm1(-dt / self.lag_s) if self.lag_s > 0 else 1.0
        self._expected += taken_up * (twist - self._expected)
        excess = velocity / dt - self._expected
        gain = -np.expm1(-dt / self.time_constant)
        self.drift = np.clip(self.drift + gain * (excess - self.drift), -_MAX, _MAX)


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
