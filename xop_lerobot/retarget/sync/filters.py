"""Filters of the measured state, applied before Eq. 4.

`SensorFilter` fuses measured positions and velocities; `ContactVelocity` and `project_velocity`
impose the stance constraint on velocities; `VelocityBias` observes the bias of the base velocity
against its position.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from xop_lerobot.morphology.contacts import Contact, ContactKind
from xop_lerobot.retarget.sync.config import SyncConfig

_GROUPS = (slice(0, 3), slice(3, 5), slice(5, 6), slice(6, None))
"""Degrees of freedom by sensor: position, tilt, heading, joints."""

_LEARNING = 0.05  # share of the newest sample in a sensor's observed noise
_NOISE_RANGE = (0.1, 10.0)  # bounds of the observed noise relative to the configured one (std)
_LEAST_NOISE, _MOST_NOISE = np.square(_NOISE_RANGE)
_TRENDS = np.array([[0.3], [0.1]])  # share of the newest sample in two running mean innovations
_TREND_STD = np.sqrt(_TRENDS / (2 - _TRENDS))  # standard deviation of such a mean of unit noise


class SensorFilter:
    r"""Scalar Kalman filters of all degrees of freedom: positions over integrated velocities.

    Between two ticks the estimate is propagated by the velocity, so that fast motion causes no
    lag; the new measurement corrects it with a gain between 0 and 1:

    .. math::

        \bar x = x_{k-1} \oplus v \Delta t, \quad \bar P = P_{k-1} + Q \Delta t^2, \quad
        x_k = \bar x \oplus K e, \quad e = \tilde x_k \ominus \bar x, \quad
        K = \bar P / (\bar P + R)

    with R the variance of a measured position, Q that of the velocity. Orientation errors are in
    world axes, so that tilt and heading keep their own sensors.

    - R is estimated: for white noise :math:`E (e_k - e_{k-1})^2 \approx 2 R`, whatever offset or
      drift the sensor has besides. It starts as configured and stays within a tenth and ten times
      of that (standard deviations).
    - A base position that repeats bit by bit is a held lidar sample: it carries no new information
      on position and heading.
    - A measurement off by more than `gate` standard deviations, or whose mean innovation over a
      few ticks is larger than noise explains, restarts the filter of its sensor.

    Args:
        model: Robot with a free base.
        position_std: Standard deviation of the measured position along each degree of freedom, of
            the orientation about world axes [m, rad]. Shape (nv,).
        gate: Gate in standard deviations, see above [1].
    """

    def __init__(self, model: mujoco.MjModel, position_std: np.ndarray, gate: float) -> None:
        self.model = model
        self._configured = np.square(position_std)
        self._gate = gate
        self._qpos, self._held = model.qpos0.copy(), np.full(3, np.nan)
        # A robot without joints has no group of encoders.
        starts = [group.start for group in _GROUPS if group.start < model.nv]
        self._starts = np.array(starts)
        self._sizes = np.diff([*starts, model.nv])
        self._level = np.ones(len(starts))  # observed over configured variance of each sensor
        self._noise = self._configured.copy()
        self._variance = self._noise
        self._innovation = np.zeros(model.nv)
        self._trend = np.zeros((len(_TRENDS), model.nv))
        self._is_new = True

    def reset(self) -> None:
        """Restart from the next measurement."""
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
        """Predict by the velocity and correct by a measurement.

        Args:
            qpos: Measured position. Shape (nq,).
            qvel: Mean velocity since the last update. Shape (nv,).
            variance: Variances of that velocity. Shape (nv,).
            dt: Time since the last update [s].

        Returns:
            The estimate (nq,), and whether the base's pose was restarted.
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
        if np.array_equal(qpos[:3], self._held):  # a held lidar sample: no position, no heading
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
        """Estimate the white noise of each sensor from the differences of its innovations."""
        difference = 0.5 * (np.square(error - self._innovation) - carried) / self._configured
        seen = np.add.reduceat(difference, self._starts) / self._sizes
        useful = np.logical_and.reduceat(fresh, self._starts)
        rate = np.where(useful, _LEARNING, 0.0)
        self._level += rate * (np.clip(seen, 0.0, _MOST_NOISE) - self._level)
        self._level = np.maximum(self._level, _LEAST_NOISE)
        self._noise = self._configured * np.repeat(self._level, self._sizes)
        self._innovation = np.where(fresh, error, self._innovation)

    def _find_lost(self, error: np.ndarray, variance: np.ndarray, fresh: np.ndarray) -> np.ndarray:
        """Mask of entries beyond the gate, at once or on average over a few ticks. (nv,)."""
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


_LEAST_PIVOT = 1e-15  # smallest pivot of a Cholesky factor of full rank


def project_velocity(
    qvel: np.ndarray, variance: np.ndarray, jacobian: np.ndarray, constraint: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    r"""Most likely velocity under the soft constraint :math:`J v \approx 0`.

    .. math::

        \min_v\ \tfrac12 \lVert v - \tilde v \rVert^2_{S^{-1}} + \tfrac12 \lVert J v
        \rVert^2_{R^{-1}}
        \quad\Rightarrow\quad v = \tilde v - S J^\top (J S J^\top + R)^{-1} J \tilde v

    with S and R diagonal: a Kalman update with the measurement "the contact does not move"
    (Hartley et al., Contact-aided invariant extended Kalman filtering, RSS 2018, use it for the
    base). One linear solve of the size of the constraint.

    Args:
        qvel: Measured velocity ṽ [m/s, rad/s]. Shape (nv,).
        variance: Diagonal of S. Shape (nv,).
        jacobian: J. Shape (m, nv).
        constraint: Diagonal of R, variance of each row of J v. Shape (m,).

    Returns:
        The projected velocity (nv,), and its variances (nv,).

    Raises:
        numpy.linalg.LinAlgError: If the solve is singular.
    """
    if not len(jacobian):
        return qvel, variance
    spread = variance[:, None] * jacobian.T  # S J^T  (nv, m)
    total = jacobian @ spread
    total.flat[:: len(total) + 1] += constraint
    gain = np.linalg.solve(total, spread.T)  # (m, nv)
    left = np.maximum(variance - np.einsum("ij,ji->i", spread, gain), 1e-12)
    return qvel - (jacobian @ qvel) @ gain, left


def compute_disagreement(
    qvel: np.ndarray, variance: np.ndarray, jacobian: np.ndarray, constraint: np.ndarray
) -> float:
    r"""Normalised innovation squared of a contact constraint: 1 on average if the contact holds.

    .. math:: \tfrac1m (J \tilde v)^\top (J S J^\top + R)^{-1} J \tilde v

    Arguments are those of `project_velocity`.
    """
    total = (jacobian * variance) @ jacobian.T
    total.flat[:: len(total) + 1] += constraint
    slip = jacobian @ qvel
    return float(slip @ solve_positive(total, slip)) / len(slip)


def solve_positive(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Solve a small positive definite system by MuJoCo's Cholesky, three times as fast as NumPy.

    Args:
        matrix: System matrix; overwritten. Shape (n, n).
        vector: Right-hand side. Shape (n,).

    Raises:
        numpy.linalg.LinAlgError: If the matrix is not positive definite.
    """
    if mujoco.mju_cholFactor(matrix, _LEAST_PIVOT) < len(matrix):
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    solution = np.empty(len(vector))
    mujoco.mju_cholSolve(solution, matrix, vector)
    return solution


class ContactVelocity:
    """Jacobians and variances of the velocities that are zero while contacts hold.

    `Feet` and `Wheels` select the m rows of each contact. On wheels the roll and pitch rate of the
    base are zero, too (2 rows), since all wheels stay on the ground.

    Args:
        model: Robot with a free base.
        contacts: Its feet or wheels.
        kind: Kind of the contacts.
        config: Standard deviations.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        contacts: Sequence[Contact],
        kind: ContactKind,
        config: SyncConfig,
    ) -> None:
        self.model, self.contacts, self.kind = model, tuple(contacts), kind
        self.config = config
        self._base = int(model.jnt_bodyid[0])

    def compute_jacobian(self, data: mujoco.MjData, index: int) -> np.ndarray:
        """Compute J of one contact from up-to-date kinematics. Shape (m, nv)."""
        contact = self.contacts[index]
        rotation = data.xmat[contact.body].reshape(3, 3)
        point = data.xpos[contact.body] + rotation @ contact.point
        if contact.rolls:
            point[2] -= contact.radius  # the material point that touches the ground is at rest
        jacobian = np.empty((6, self.model.nv))
        mujoco.mj_jac(self.model, data, jacobian[:3], jacobian[3:], point, contact.body)
        return self.kind.select_velocities(contact, rotation, jacobian)

    def compute_variance(self, index: int, landing: float) -> np.ndarray:
        """Variance of each row of J v of one contact.

        Args:
            index: Index of the contact.
            landing: Remaining effect of its touch-down, 0 to 1.

        Returns:
            Shape (m,).
        """
        config = self.config
        linear = config.contact_velocity**2 + (landing * config.touchdown_velocity) ** 2
        angular = config.contact_rate**2 + (landing * config.touchdown_rate) ** 2
        return self.kind.arrange_variance(self.contacts[index], linear, angular)

    def compute_level_jacobian(self, data: mujoco.MjData) -> np.ndarray:
        """Compute J of the roll and pitch rate of a base on wheels, world axes. Shape (2, nv)."""
        jacobian = np.empty((3, self.model.nv))
        mujoco.mj_jacBody(self.model, data, None, jacobian, self._base)
        return jacobian[:2]


_LIMIT = 0.5  # largest plausible bias of a velocity estimator [m/s]
_JUMP = 0.3  # distance from which the position has jumped rather than drifted [m]


class VelocityBias:
    r"""Observes the bias b of the measured base velocity against the measured position.

    A critically damped second-order observer with the time constant T:

    .. math::

        \hat p \leftarrow \hat p + (\tilde v - b)\,\Delta t,\quad e = \tilde p - \hat p,\quad
        \hat p \leftarrow \hat p + \tfrac{2\Delta t}{T} e,\quad
        b \leftarrow b - \tfrac{\Delta t}{T^2} e

    T is large on purpose: white noise of 1 cm at 25 Hz leaves less than 1 mm/s in b, and a delayed
    position little more during acceleration.

    Args:
        time_constant: T [s].
    """

    def __init__(self, time_constant: float) -> None:
        self._time_constant = time_constant
        self.bias = np.zeros(3)
        """b, world axes [m/s]. Shape (3,)."""
        self.reset()

    def reset(self) -> None:
        """Forget position and bias."""
        self.bias = np.zeros(3)
        self._position: np.ndarray | None = None
        self._held = np.full(3, np.nan)
        self._age = 0.0

    def update(self, position: np.ndarray, velocity: np.ndarray, dt: float) -> np.ndarray:
        """Update the bias by a measurement, and return the velocity without it.

        Args:
            position: Measured position of the base [m]. Shape (3,).
            velocity: Its measured velocity, world axes [m/s]. Shape (3,).
            dt: Time since the last measurement [s].

        Returns:
            Velocity [m/s]. Shape (3,).
        """
        if self._position is None:
            self._position, self._held = position.copy(), position.copy()
            return velocity - self.bias
        self._position = self._position + (velocity - self.bias) * dt
        self._age += dt
        if not np.array_equal(position, self._held):  # else a held sample
            error = position - self._position
            self._held = position.copy()
            if float(error @ error) > _JUMP**2:
                self._position = position.copy()
            else:
                share = min(self._age / self._time_constant, 0.5)
                self._position = self._position + 2 * share * error
                self.bias = self.bias - share / self._time_constant * error
                self.bias = np.clip(self.bias, -_LIMIT, _LIMIT)
            self._age = 0.0
        return velocity - self.bias
