"""Disturbance observers of the command model: base drift, and steady-state offsets of joints.

Both estimate the part of the measured motion that the command model does not explain. Added to its
predictions, they make the controller free of steady-state offset.
"""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.transforms import quat_yaw, wrap_angle
from xop_lerobot.retarget.model.command_model import CommandModel

_MAX = np.array([0.3, 0.3, 0.4])  # largest drift [m/s, m/s, rad/s]; beyond it is a stumble


class DriftObserver:
    r"""Low-passed difference of measured and commanded base velocity.

    .. math:: b \leftarrow b + (1 - e^{-dt/\tau})(v_{measured} - v_{command} - b)

    along and across the heading, and about the vertical. The command is lagged like the policy's
    response; otherwise every start and stop would look like drift. A walking policy drifts by
    several centimetres per second, more when it leans; the horizon is too short to tell that from
    the sway of the gait. With b in the extrapolated terminal cost the controller has no steady
    offset (an output disturbance model, as in offset-free model predictive control, Pannocchia and
    Rawlings, 2003).

    Args:
        command_model: Gives the commanded base velocity.
        time_constant: τ [s], several strides.
        lag_s: Time constant of the base's response to a command; may be 0 [s].

    Attributes:
        drift: b: along, across [m/s], yaw rate [rad/s]. Shape (3,).
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
        """Update with the base pose at `time` and the command executed since the last update.

        Args:
            time: The robot's clock [s].
            qpos: Configuration. Shape (nq,).
            command: Command. Shape (k,).
            moving: Whether the base follows velocity commands; if not, the drift is zero.
        """
        if not np.isfinite(qpos[:7]).all():
            return
        yaw = float(quat_yaw(qpos[3:7]))
        # Track the centre of rotation, which pure turning does not move.
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


_QUIET = 0.03  # error of the lagged command below which an entry has settled [half ranges]


class OffsetObserver:
    r"""Low-passed difference of height and joints from their command, at rest.

    .. math:: \bar a \leftarrow a + (\bar a - a)e^{-dt/T},\qquad
              o \leftarrow o + (1 - e^{-dt/\tau})(q - \bar a - o)

    To keep its balance, a low-level policy holds waist or height a few hundredths off the command.
    The short horizon sees the motion towards the command, not where it ends. With o in the
    extrapolated terminal cost the controller has no steady offset, as with the drift of a walking
    base. An entry learns only while its lagged command \bar a has converged to a.

    Args:
        command_model: Gives the lags.
        time_constant: τ [s].
        largest: Bound of the offset, as a fraction of half the range of an entry [1].

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
        """Reset the offsets; the robot is at rest at `command`. Shape (k,)."""
        self.settled = np.array(command, dtype=float)
        self.offset = np.zeros(len(self.settled))
        self._last: float | None = None

    def update(
        self, time: float, qpos: np.ndarray, command: np.ndarray, *, learns: bool = True
    ) -> None:
        """Update with the configuration at `time` and the command since the last update.

        Args:
            time: The robot's clock [s].
            qpos: Configuration. Shape (nq,).
            command: Command executed since the last update. Shape (k,).
            learns: Whether to estimate offsets; if not, they are zero.
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
