"""State synchronisation: estimate a simulator state consistent with sensors and ground contacts.

`StateSync.synchronise` is called once a tick with the measured state, and returns the state that
the planner's simulation starts from.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import mink
import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import freeze
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.sync.config import SyncConfig, SyncStatus
from xop_lerobot.retarget.sync.contacts import StanceMemory, make_contacts
from xop_lerobot.retarget.sync.filters import (
    ContactVelocity,
    SensorFilter,
    VelocityBias,
    compute_disagreement,
    project_velocity,
    solve_positive,
)
from xop_lerobot.retarget.sync.task import SyncTask

logger = logging.getLogger(__name__)

_DAMPING = 1e-9  # regularisation of the SQP's Hessian
_LANDED = 0.01  # remaining effect of touch-down below which a foot counts as at rest [1]
_LEARNING = 0.05  # change of the logarithm of the observed velocity noise per tick [1]
_MAX_NOISE = 100.0  # largest observed variance of the velocities over the configured one [1]
_CURVATURE = (0.3, 1.0, 2.0)
"""Error of the mean of two velocities relative to their difference: for the base's linear velocity,
which changes slowly; for its tilt and the joints, which oscillate between two ticks of a gait; and
for its heading, where the lidar is then better than integration [1]."""
_BOUND_SLACK = 1e-9  # tolerance of the joint limits [rad]


@dataclass(frozen=True)
class Synced:
    """A synchronised state.

    Attributes:
        qpos: Generalised position, MuJoCo order; read-only. Shape (nq,).
        qvel: Generalised velocity, MuJoCo order; read-only. Shape (nv,).
        residual: Root mean square of the remaining heights of the active contacts over their
            equilibrium [m]; 0 without a contact.
        status: How the solve ended.
        iterations: Steps of the SQP.
        correction: Distance of the base from its measurement [m].
        rotation: Angle of the base from its measurement [rad].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    residual: float
    status: SyncStatus
    iterations: int
    correction: float = 0.0
    rotation: float = 0.0

    @property
    def health(self) -> dict[str, float]:
        """Health metrics for a recording, by name."""
        return {"sync_residual": self.residual, "sync_status": float(self.status)}


class StateSync:
    r"""Solves Eq. 4 once per tick for the initial state of the planner's simulation.

    1. Predict the last state by its velocity.
    2. Find the active contacts (`StanceMemory`), and project the measured velocity, blended with
       the one that the plan predicted, on their constraints (`project_velocity`).
    3. Fuse measurement and prediction (`SensorFilter`). The height also keeps the information of
       earlier contacts, since a foot during touch-down gives little.
    4. Solve Eq. 4 by SQP (`SyncTask`), each step by mink and DAQP within the joint limits.

    Args:
        morphology: The robot.
        model: Its planning model.
        config: Standard deviations of sensors and contacts.

    Attributes:
        failures: Number of ticks that fell back to the measurement since the last `reset`.
        num_qps: Number of steps that needed DAQP since the last `reset`.
    """

    def __init__(
        self, morphology: Morphology, model: mujoco.MjModel, config: SyncConfig | None = None
    ) -> None:
        self.morphology, self.model = morphology, model
        self.config = config = config or SyncConfig()
        self._kind = kind = morphology.contact_kind
        self.contacts = make_contacts(morphology, model, equilibrium=config.equilibrium)
        self.task = SyncTask(model, self.contacts, kind, config)
        self.stance = StanceMemory(self.contacts, kind, config)
        self._contact_velocity = ContactVelocity(model, self.contacts, kind, config)
        self._configuration = mink.Configuration(model)
        self._limit = mink.ConfigurationLimit(model, gain=1.0)
        limited = model.jnt_limited.astype(bool)
        limited &= model.jnt_type != mujoco.mjtJoint.mjJNT_FREE
        self._limited_qpos = model.jnt_qposadr[limited]
        self._limited_dofs = model.jnt_dofadr[limited]
        self._range = model.jnt_range[limited]
        scale = self.task.joint_scale
        self._velocity_variance = np.square(
            np.concatenate(
                [[config.velocity] * 3, [config.gyro] * 3, config.joint_rate * scale],
            )
        )
        linear, other, heading = _CURVATURE
        self._curvature = np.array([linear] * 3 + [other] * (model.nv - 3))
        self._curvature[5] = heading
        self._filter = SensorFilter(model, 1 / self.task.cost, config.gate)
        self._bias = VelocityBias(config.bias_s)
        self.failures = self.num_qps = 0
        self.reset()

    def reset(self) -> None:
        """Discard all memory: the robot may have been moved."""
        self.failures = self.num_qps = 0
        self._last: Synced | None = None
        self._seen = (np.zeros(0), np.zeros(0))
        self._last_time = -np.inf
        self._forget()

    @property
    def time(self) -> float:
        """Time of the last measurement [s]; minus infinity before the first."""
        return self._last_time

    def _forget(self) -> None:
        self._filter.reset()
        self.stance.reset()
        self._bias.reset()
        self._noise = 1.0
        self._base_variance = np.full(3, np.inf)
        self._height_variance = math.inf
        self._is_new = True

    def synchronise(
        self,
        time: float,
        qpos: np.ndarray,
        qvel: np.ndarray,
        mode: Mode,
        expected: np.ndarray | None = None,
    ) -> Synced:
        """Estimate the state from measurement, contacts and memory; never raises.

        Args:
            time: The robot's clock [s].
            qpos: Measured generalised position. Shape (nq,).
            qvel: Measured generalised velocity. Shape (nv,).
            mode: Mode of the robot, which decides on the active contacts.
            expected: Linear velocity of the base at `time` as the planner predicted it from the
                last state, world axes [m/s]; None without a prediction. Shape (3,).

        Returns:
            The state. If the solve fails, the measurement with status `MEASUREMENT`; if the
            measurement is not finite, the last good state. Repeating a measurement with the same
            time returns the same state again.
        """
        try:
            if not (np.isfinite(qpos).all() and np.isfinite(qvel).all() and np.isfinite(time)):
                return self._fall_back(qpos, qvel)
            qpos, qvel = np.asarray(qpos), np.asarray(qvel)
            if self._last is not None and self._is_seen(time, qpos, qvel):
                return self._last
            self._last = self._solve(float(time), qpos, qvel, mode, expected)
            self._seen = (qpos.copy(), qvel.copy())
        except Exception as error:  # a control loop must not die of a failed estimate
            if not self.failures:
                logger.warning("state synchronisation failed: %r; the measurement is used", error)
            self._forget()
            return self._fall_back(qpos, qvel)
        return self._last

    def _is_seen(self, time: float, qpos: np.ndarray, qvel: np.ndarray) -> bool:
        """Whether this repeats the last measurement: the robot was read twice in one tick."""
        same = zip((qpos, qvel), self._seen, strict=True)
        return time == self._last_time and all(np.array_equal(*pair) for pair in same)

    def _fall_back(self, qpos: np.ndarray, qvel: np.ndarray) -> Synced:
        self.failures += 1
        finite = bool(np.isfinite(qpos).all() and np.isfinite(qvel).all())
        if not finite and self._last is not None:
            qpos, qvel = self._last.qpos, self._last.qvel
        return Synced(freeze(qpos), freeze(qvel), 0.0, SyncStatus.MEASUREMENT, 0)

    def _solve(
        self,
        time: float,
        qpos: np.ndarray,
        qvel: np.ndarray,
        mode: Mode,
        expected: np.ndarray | None,
    ) -> Synced:
        config, configuration = self.config, self._configuration
        dt = time - self._last_time
        if not (config.recursive and 0 < dt <= config.max_gap_s):
            self._forget()
        last = None if self._is_new else self._last
        if last is None:
            dt, guess = 0.0, qpos
        else:
            guess = last.qpos.copy()
            mujoco.mj_integratePos(self.model, guess, last.qvel, dt)
        configuration.update(guess)
        self.stance.update_contacts(configuration.data, mode, dt)
        if config.recursive:
            qvel = qvel.copy()
            qvel[:3] = self._bias.update(qpos[:3], qvel[:3], dt)
        if last is None or self._kind.tells_speed:
            expected = None
        velocity, variance = self._project(qvel, expected)
        mean, carried = velocity, variance
        if last is not None:
            mean = 0.5 * (velocity + last.qvel)
            change = np.square(velocity - last.qvel) - 2 * variance  # beyond mere noise
            carried = variance + np.square(self._curvature) * np.maximum(change, 0)
        measured, restarted = self._filter.update(qpos, mean, carried, dt)
        configuration.update(measured)
        if restarted:  # the prediction was wrong, and with it contacts and projected velocity
            self.stance.reset()
            self.stance.update_contacts(configuration.data, mode, 0.0)
            velocity, _ = self._project(qvel)
            last = None
        std = self._filter.std
        self.stance.remember(
            self.task.compute_places(configuration.data),
            dt,
            self._filter.base_noise,
            (std[0], std[5]),
            # The noisier the velocities, the less they reveal creeping feet: shorten the memory.
            self.config.memory_s / math.sqrt(self._noise),
        )
        if last is not None:  # scalar Kalman update of the height with the last solution
            height = last.qpos[2] + mean[2] * dt
            variance = std[2] ** 2
            share = variance / (variance + self._height_variance + carried[2] * dt * dt)
            measured[2] += share * (height - measured[2])
            std[2] *= math.sqrt(1 - share)
        self.task.set_measurement(measured, std)
        active, contact_std = self.stance.active, self.stance.compute_std()
        self.task.set_active(active, contact_std, self.stance.places)
        row = self._kind.height_row
        self._height_variance = 1 / (std[2] ** -2 + sum(one[row] ** -2 for one in contact_std))
        iterations, bounded = self._descend()
        self._last_time, self._is_new = time, False
        errors = self.task.compute_height_errors(configuration)
        status = SyncStatus.BOUNDED if bounded else SyncStatus.OK
        solution = configuration.data.qpos
        return Synced(
            qpos=freeze(solution),
            qvel=freeze(velocity),
            residual=float(np.sqrt(np.mean(np.square(errors)))) if errors.size else 0.0,
            status=SyncStatus.RESTARTED if restarted else status,
            iterations=iterations,
            correction=float(np.linalg.norm(solution[:3] - qpos[:3])),
            rotation=_compute_angle(solution[3:7], qpos[3:7]),
        )

    def _project(
        self, qvel: np.ndarray, expected: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Project the velocity on the constraints of the active contacts.

        Args:
            qvel: Measured velocity. Shape (nv,).
            expected: Predicted linear velocity of the base; None without one. Shape (3,).

        Returns:
            Velocity and its variances. Shapes (nv,), (nv,).
        """
        variance = self._noise * self._velocity_variance
        if not self.config.project_velocity:
            return qvel, variance
        if expected is not None:
            qvel, variance = self._blend(qvel, variance, expected)
        self._base_variance = variance[:3]
        data, stance = self._configuration.data, self.stance
        jacobians, variances, disagreements = [], [], []
        for index in stance.active:
            landing = stance.get_landing(index)
            jacobian = self._contact_velocity.compute_jacobian(data, index)
            allowed = self._contact_velocity.compute_variance(index, landing)
            disagreement = compute_disagreement(qvel, variance, jacobian, allowed)
            if landing < _LANDED:
                disagreements.append(disagreement)
            excess = disagreement / self.config.gate - 1
            if excess > 1:  # the foot slips or swings
                stance.release(index)
            if excess > 0:  # inflate its variance in proportion to the disagreement
                own = np.square(jacobian) @ variance
                allowed = allowed + excess * (own + allowed)
            jacobians.append(jacobian)
            variances.append(allowed)
        if disagreements and self.config.recursive:
            self._observe_noise(min(disagreements))
        if jacobians and self._kind.keeps_level:
            jacobians.append(self._contact_velocity.compute_level_jacobian(data))
            variances.append(np.full(2, self.config.contact_rate**2))
        if not jacobians:
            return qvel, variance
        velocity, left = project_velocity(
            qvel, variance, np.concatenate(jacobians), np.concatenate(variances)
        )
        self._base_variance = left[:3]
        return velocity, left

    def _blend(
        self, qvel: np.ndarray, variance: np.ndarray, expected: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Fuse the measured linear velocity of the base with the predicted one (Kalman update).

        A prediction beyond the gate is ignored: a pushed robot does not move as planned.

        Returns:
            Velocity and its variances. Shapes (nv,), (nv,).
        """
        own, prior = variance[:3], self._base_variance + self.config.prediction**2
        error = expected - qvel[:3]
        if not (np.square(error) < self.config.gate**2 * (own + prior)).all():
            return qvel, variance
        gain = own / (own + prior)
        qvel, variance = qvel.copy(), variance.copy()
        qvel[:3] += gain * error
        variance[:3] *= 1 - gain
        return qvel, variance

    def _observe_noise(self, disagreement: float) -> None:
        """Adapt the noise of the velocities so that the median of `disagreement` is 1.

        The median is robust to slipping or swinging feet, which disagree far more than noise.
        """
        self._noise *= math.exp(math.copysign(_LEARNING, disagreement - 1))
        self._noise = min(max(self._noise, 1.0), _MAX_NOISE)

    def _descend(self) -> tuple[int, bool]:
        """Run the SQP from the present configuration.

        Returns:
            Number of steps, and whether a joint limit was active in the last one.
        """
        bounded, iterations = False, 0
        while iterations < self.config.iterations:
            step, bounded = self._compute_step()
            self._configuration.integrate_inplace(step, 1.0)
            iterations += 1
            if np.abs(step).max() < self.config.tolerance:
                break
        return iterations, bounded

    def _compute_step(self) -> tuple[np.ndarray, bool]:
        r"""One step of the SQP: :math:`\min_d \frac12 d^\top H d + c^\top d` within limits.

        H is positive definite, so an unconstrained minimum within the limits is the solution, and
        DAQP is only called if it lies outside.
        """
        jacobian, error, _ = self.task.compute_qp_residual(self._configuration)
        hessian = jacobian.T @ jacobian
        hessian.flat[:: len(hessian) + 1] += _DAMPING
        step = solve_positive(hessian, error @ jacobian)
        reached = self._configuration.data.qpos[self._limited_qpos] + step[self._limited_dofs]
        low, high = self._range[:, 0] - _BOUND_SLACK, self._range[:, 1] + _BOUND_SLACK
        if not ((reached < low) | (reached > high)).any():
            return step, False
        self.num_qps += 1
        step = mink.solve_ik(
            self._configuration,
            [self.task],
            1.0,
            solver="daqp",
            damping=_DAMPING,
            limits=[self._limit],
        )
        return step, True


def _compute_angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two orientations [rad]."""
    return 2 * float(np.arccos(min(1.0, abs(float(a @ b)))))
