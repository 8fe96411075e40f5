"""A filter of the measured pose that is carried by the measured velocity."""

from __future__ import annotations

import mujoco
import numpy as np

_GROUPS = (slice(0, 3), slice(3, 5), slice(5, 6), slice(6, None))
"""Degrees of freedom that one sensor measures: position, tilt, heading, joints."""

_LEARNING = 0.05  # share of the newest sample in a sensor's observed noise
_NOISE_RANGE = (0.1, 10.0)  # observed noise over the configured one
_LEAST_NOISE, _MOST_NOISE = np.square(_NOISE_RANGE)
_TRENDS = np.array([[0.3], [0.1]])  # share of the newest sample in the mean disagreements
_TREND_STD = np.sqrt(_TRENDS / (2 - _TRENDS))  # standard deviation of such a mean of noise


class SensorFilter:
    r"""A Kalman filter per degree of freedom: measured positions over integrated velocities.

    Between two ticks the last estimate is carried on by the velocity, so that fast motion makes
    no lag; the new measurement corrects it by a gain between 0 and 1:

    .. math::

        \bar x = x_{k-1} \oplus v \Delta t, \quad \bar P = P_{k-1} + Q \Delta t^2, \quad
        x_k = \bar x \oplus K e, \quad e = \tilde x_k \ominus \bar x, \quad
        K = \bar P / (\bar P + R)

    with R the variance of a measured position, Q that of the velocity. Orientation errors are in
    the world's axes, so that tilt and heading keep their own sensors.

    - R is observed: of white noise, :math:`E (e_k - e_{k-1})^2 \approx 2 R`, whatever offset
      or drift the sensor has besides. It starts as configured and stays within a tenth and ten
      times of that (standard deviations).
    - A pose of the base that repeats to the last bit is the lidar's last one, held: no news of
      position and heading.
    - A measurement further away than `gate` standard deviations, or on average over a few ticks
      further than that average of mere noise would be, begins its sensor anew.

    Args:
        model: Robot on a free base.
        position_std: Of the measured position along each degree of freedom, the orientation's
            about world axes [m, rad]. Shape (nv,).
        gate: See above [1].
    """

    def __init__(self, model: mujoco.MjModel, position_std: np.ndarray, gate: float) -> None:
        self.model = model
        self._configured = np.square(position_std)
        self._gate = gate
        self._qpos, self._held = model.qpos0.copy(), np.full(3, np.nan)
        # A robot without joints has no encoders.
        starts = [group.start for group in _GROUPS if group.start < model.nv]
        self._starts = np.array(starts)
        self._sizes = np.diff([*starts, model.nv])
        self._level = np.ones(len(starts))  # observed noise over the configured one, variances
        self._noise = self._configured.copy()
        self._variance = self._noise
        self._innovation = np.zeros(model.nv)
        self._trend = np.zeros((len(_TRENDS), model.nv))
        self._is_new = True

    def reset(self) -> None:
        """Forget everything."""
        self._is_new = True

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of the estimate along each degree of freedom. Shape (nv,)."""
        return np.sqrt(self._variance)

    @property
    def base_noise(self) -> tuple[float, float]:
        """Observed standard deviation of a measured position [m] and heading [rad] of the base."""
        return float(np.sqrt(self._noise[0])), float(np.sqrt(self._noise[5]))

    def update(
        self, qpos: np.ndarray, qvel: np.ndarray, variance: np.ndarray, dt: float
    ) -> tuple[np.ndarray, bool]:
        """Take in a measurement.

        Args:
            qpos: Measured position. Shape (nq,).
            qvel: Mean velocity since the last update. Shape (nv,).
            variance: Its variances. Shape (nv,).
            dt: That time [s].

        Returns:
            The estimate (nq,), and whether the base's pose began anew.
        """
        if self._is_new:
            self._start(qpos)
            return qpos.copy(), False
        estimate = self._qpos
        mujoco.mj_integratePos(self.model, estimate, qvel, dt)
        predicted = self._variance + variance * (dt * dt)
        error = np.empty(self.model.nv)
        mujoco.mj_differentiatePos(self.model, error, 1.0, estimate, qpos)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, estimate[3:7])
        rotation = rotation.reshape(3, 3)
        error[3:6] = rotation @ error[3:6]
        fresh = np.ones(self.model.nv, dtype=bool)
        if np.array_equal(qpos[:3], self._held):
            fresh[:3] = fresh[5] = False
        self._held = qpos[:3].copy()
        lost = self._find_lost(error, predicted, fresh)
        self._observe_noise(error, variance * (dt * dt), fresh & ~lost)
        gain = np.where(fresh, predicted / (predicted + self._noise), 0.0)
        gain[lost] = 1.0
        step = gain * error
        step[3:6] = rotation.T @ step[3:6]
        mujoco.mj_integratePos(self.model, estimate, step, 1.0)
        self._variance = np.where(lost, self._noise, (1 - gain) * predicted)
        return estimate.copy(), bool(lost[:6].any())

    def _start(self, qpos: np.ndarray) -> None:
        self._qpos, self._held = qpos.copy(), qpos[:3].copy()
        self._level = np.ones(len(self._starts))
        self._noise = self._configured.copy()
        self._variance = self._noise.copy()
        self._innovation[:] = self._trend[:] = 0
        self._is_new = False

    def _observe_noise(self, error: np.ndarray, carried: np.ndarray, fresh: np.ndarray) -> None:
        """Follow the white noise of each sensor by what differs from one sample to the next."""
        difference = 0.5 * (np.square(error - self._innovation) - carried) / self._configured
        seen = np.add.reduceat(difference, self._starts) / self._sizes
        useful = np.logical_and.reduceat(fresh, self._starts)
        rate = np.where(useful, _LEARNING, 0.0)
        self._level += rate * (np.clip(seen, 0.0, _MOST_NOISE) - self._level)
        self._level = np.maximum(self._level, _LEAST_NOISE)
        self._noise = self._configured * np.repeat(self._level, self._sizes)
        self._innovation = np.where(fresh, error, self._innovation)

    def _find_lost(self, error: np.ndarray, variance: np.ndarray, fresh: np.ndarray) -> np.ndarray:
        """Entries that disagree once by too much, or by less for several ticks. Shape (nv,)."""
        ratio = error / np.sqrt(variance + self._noise)
        self._trend += np.where(fresh, _TRENDS * (ratio - self._trend), 0.0)
        lost = np.abs(ratio) > self._gate
        lost |= (np.abs(self._trend) > self._gate * _TREND_STD).any(axis=0)
        lost &= fresh
        if not lost.any():
            return lost
        for group in _GROUPS[:3]:
            lost[group] = lost[group].any() & fresh[group]
        self._trend[:, lost] = 0
        return lost
