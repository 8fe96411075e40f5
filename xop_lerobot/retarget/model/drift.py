"""What a base does beyond its command: the slow part is observed, and counted on."""

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
