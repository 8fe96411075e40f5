"""A filter of the measured pose that is carried by the measured velocity."""

from __future__ import annotations

import mujoco
import numpy as np


class SensorFilter:
    r"""A Kalman filter per degree of freedom: measured positions over integrated velocities.

    Between two ticks the last estimate is carried on by the velocity, so that fast motion makes
    no lag; the new measurement corrects it by a gain between 0 and 1:

    .. math::

        \bar x = x_{k-1} \oplus \tfrac12 (v_{k-1} + \tilde v_k) \Delta t, \quad
        \bar P = P_{k-1} + Q \Delta t^2, \quad
        x_k = \bar x \oplus K (\tilde x_k \ominus \bar x), \quad K = \bar P / (\bar P + R)

    with R the variance of a measured position, Q that of a velocity. Orientation errors are in
    the world's axes, so that tilt and heading keep their own sensors.

    Args:
        model: Robot on a free base.
        position_std: Of the measured position along each degree of freedom, the orientation's
            about world axes [m, rad]. Shape (nv,).
        velocity_std: Of the velocity that carries it [m/s, rad/s]. Shape (nv,).
        gate: Disagreement at which an entry begins anew, in standard deviations [1].
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        position_std: np.ndarray,
        velocity_std: np.ndarray,
        gate: float,
    ) -> None:
        self.model = model
        self._noise, self._process = np.square(position_std), np.square(velocity_std)
        self._gate = gate
        self._qpos = model.qpos0.copy()
        self._variance: np.ndarray | None = None
        self._measured = np.full(model.nq, np.nan)
        self._innovation = np.zeros(model.nv)
        self._trend = np.zeros(model.nv)

    def reset(self) -> None:
        """Forget everything."""
        self._variance = None
        self._measured = np.full_like(self._measured, np.nan)

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of the estimate along each degree of freedom. Shape (nv,)."""
        return np.sqrt(self._noise if self._variance is None else self._variance)

    def update(self, qpos: np.ndarray, qvel: np.ndarray, dt: float) -> tuple[np.ndarray, bool]:
        """Take in a measurement.

        Args:
            qpos: Measured position. Shape (nq,).
            qvel: Velocity over the time since the last update. Shape (nv,).
            dt: That time [s].

        Returns:
            The estimate, and whether the pose of the base began anew. Shape (nq,).
        """
        if self._variance is None:
            self._start(qpos)
            return qpos.copy(), False
        estimate, turned = self._qpos, np.zeros(self.model.nv)
        mujoco.mj_integratePos(self.model, estimate, qvel, dt)
        variance = self._variance + self._process * (dt * dt)
        innovation = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, innovation, 1.0, estimate, qpos)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, estimate[3:7])
        rotation = rotation.reshape(3, 3)
        innovation[3:6] = rotation @ innovation[3:6]
        gain = variance / (variance + self._noise)
        if np.array_equal(qpos[:3], self._measured[:3]):
            # The lidar's last pose again: no news of position and heading.
            gain[:3] = gain[5] = 0.0
        lost = self._find_lost(innovation, variance, gain > 0)
        gain[lost] = 1.0
        turned[:] = gain * innovation
        turned[3:6] = rotation.T @ turned[3:6]
        mujoco.mj_integratePos(self.model, estimate, turned, 1.0)
        self._variance = np.where(lost, self._noise, (1 - gain) * variance)
        self._measured = qpos.copy()
        return estimate.copy(), bool(lost[:6].any())

    def _start(self, qpos: np.ndarray) -> None:
        self._qpos, self._measured = qpos.copy(), qpos.copy()
        self._variance = self._noise.copy()
        self._trend[:] = 0

    def _find_lost(
        self, innovation: np.ndarray, variance: np.ndarray, fresh: np.ndarray
    ) -> np.ndarray:
        """Entries that disagree once by too much, or a little less for several ticks."""
        spread = np.sqrt(variance + self._noise)
        blend = np.where(fresh, 0.3, 0.0)
        self._trend += blend * (innovation / spread - self._trend)
        # A mean with forgetting 0.3 has 0.42 of the noise of one tick.
        lost = fresh & (
            (np.abs(innovation) > self._gate * spread)
            | (
                np.abs(self._trend) > 0.42 * self._gate  # noqa: PLR2004
            )
        )
        for part in (slice(0, 3), slice(3, 6)):
            if lost[part].any():
                lost[part] = fresh[part]
        self._trend[lost] = 0
        return lost
