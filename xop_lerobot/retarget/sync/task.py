"""The residuals of the state synchronisation, as one task for mink."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mink
import mujoco
import numpy as np

from xop_lerobot.retarget.sync.config import SyncConfig
from xop_lerobot.retarget.sync.contacts import Contact, compute_height


class SyncTask(mink.Task):
    r"""All residuals of Eq. 4, stacked.

    With the measurement :math:`(\tilde p, \tilde\theta, \tilde q)` and, for every active contact,
    its point :math:`c_i = p + R(\theta) p_{c,i}(q)`:

    ===================== ============================================== ========= ============
    residual              formula                                        rows      unit
    ===================== ============================================== ========= ============
    base position         :math:`p - \tilde p`                           3         m
    base orientation      :math:`\log(R \tilde R^\top)`, world axes      3         rad
    joints                :math:`q - \tilde q`                           nv - 6    rad, m
    foot, position        :math:`c_i - p^{world}_{c,i}`                  3 a foot  m
    foot, flat            :math:`R R_{c,i} e_z - e_z`                    3 a foot  1
    foot, heading         :math:`\psi(R R_{c,i} e_x) - \psi^{world}_i`   1 a foot  rad
    wheel, height         :math:`e_z^\top c_i - r_i`                     1 a wheel m
    wheel, axle           :math:`e_z^\top R R_{c,i} e_y`                 1 a wheel 1
    ===================== ============================================== ========= ============

    Heading is an addition: the paper knows where a foot stands but not where it points. Steps
    are in the tangent space of MuJoCo's free joint: linear in the world, angular in the body.

    One task instead of mink's stock ones: rows that never change are filled once, and one pass
    over the contacts gives residual and Jacobian.

    Args:
        model: Robot on a free base.
        contacts: Its feet or wheels.
        wheeled: Whether they are wheels.
        config: Standard deviations; the task's cost is one over them.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        contacts: Sequence[Contact],
        wheeled: bool,
        config: SyncConfig,
    ) -> None:
        self.contacts, self.wheeled, self.config = tuple(contacts), wheeled, config
        self.model = model
        self._num_own = num_own = model.nv
        self._per_contact = 2 if wheeled else 7
        self.height_row = 0 if wheeled else 2
        """Which of the rows of a contact is its height."""
        rows = num_own + self._per_contact * len(self.contacts)
        self._jacobian = np.zeros((rows, model.nv))
        self._jacobian[:num_own] = np.eye(num_own)
        self._error = np.zeros(rows)
        self._jacp, self._jacr = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        self._difference = np.zeros(model.nv)
        self._active: tuple[int, ...] = ()
        self._measured = model.qpos0.copy()
        self._rotation = np.empty(9)
        self._stance = np.zeros((len(self.contacts), 3))
        slides = model.jnt_type[model.dof_jntid[6:]] == mujoco.mjtJoint.mjJNT_SLIDE
        self.joint_scale = np.where(slides, 0.1, 1.0)
        """Noise of each joint over that of a hinge. Shape (nv - 6,)."""
        own = [*[config.position] * 3, config.tilt, config.tilt, config.heading]
        self._base_cost = np.concatenate([1 / np.array(own), 1 / (config.joint * self.joint_scale)])
        self._own_cost = self._base_cost
        super().__init__(cost=self._base_cost, gain=1.0, lm_damping=0.0)

    def set_measurement(self, qpos: np.ndarray, std: np.ndarray | None = None) -> None:
        """Set what was measured, and how well.

        Args:
            qpos: Generalised position. Shape (nq,).
            std: Standard deviation along each degree of freedom, the orientation's in world
                axes; the configured ones by default. Shape (nv,).
        """
        self._measured = qpos
        self._own_cost = self._base_cost if std is None else 1 / std

    def set_active(
        self, active: Sequence[int], std: Sequence[np.ndarray], stance: np.ndarray
    ) -> None:
        """Set which contacts count, how much, and where they stand.

        Args:
            active: Indices of contacts.
            std: Standard deviation of each row of each of them; infinite for none. Shapes (7,)
                for a foot, (2,) for a wheel.
            stance: x, y and heading of every contact. Shape (contacts, 3).
        """
        self._active, self._stance = tuple(active), stance
        self.cost = np.concatenate([self._own_cost, *(1 / one for one in std)])

    def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
        """Compute all residuals, without weights. Shape (rows,)."""
        self._evaluate(configuration.data)
        return self._error[: len(self.cost)].copy()

    def compute_jacobian(self, configuration: mink.Configuration) -> np.ndarray:
        """Compute their derivative by the tangent of the configuration. Shape (rows, nv)."""
        self._evaluate(configuration.data)
        return self._jacobian[: len(self.cost)].copy()

    def compute_qp_residual(
        self, configuration: mink.Configuration
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Compute weighted Jacobian and weighted negative residual in one pass."""
        self._evaluate(configuration.data)
        rows = len(self.cost)
        return (
            self.cost[:, None] * self._jacobian[:rows],
            -self.cost * self._error[:rows],
            0.0,
        )

    def compute_height_errors(self, configuration: mink.Configuration) -> np.ndarray:
        """Height of each active contact over its equilibrium [m]. Shape (active,)."""
        data = configuration.data
        return np.array([compute_height(self.contacts[i], data) for i in self._active])

    def compute_places(self, data: mujoco.MjData) -> np.ndarray:
        """Compute x, y [m] and heading [rad] of every contact. Shape (contacts, 3)."""
        places = np.empty((len(self.contacts), 3))
        for row, contact in enumerate(self.contacts):
            rotation = data.xmat[contact.body].reshape(3, 3)
            places[row, :2] = (data.xpos[contact.body] + rotation @ contact.point)[:2]
            forward = rotation @ contact.forward
            places[row, 2] = np.arctan2(forward[1], forward[0])
        return places

    def _evaluate(self, data: mujoco.MjData) -> None:
        error, jacobian = self._error, self._jacobian
        qpos, measured = data.qpos, self._measured
        mujoco.mj_differentiatePos(self.model, self._difference, 1.0, measured, qpos)
        error[: self._num_own] = self._difference
        # log(R R~^T) in the world's axes, where tilt and heading are apart, is log(R~^T R) turned.
        mujoco.mju_quat2Mat(self._rotation, qpos[3:7])
        rotation = self._rotation.reshape(3, 3)
        turn = rotation @ self._difference[3:6]
        error[3:6] = turn
        jacobian[3:6, 3:6] = _inverse_left_jacobian(turn) @ rotation if turn.any() else rotation
        row = self._num_own
        for index in self._active:
            evaluate = self._evaluate_wheel if self.wheeled else self._evaluate_foot
            evaluate(data, index, row)
            row += self._per_contact

    def _evaluate_foot(self, data: mujoco.MjData, index: int, row: int) -> None:
        contact, error, jacobian = self.contacts[index], self._error, self._jacobian
        rotation = data.xmat[contact.body].reshape(3, 3)
        point = data.xpos[contact.body] + rotation @ contact.point
        mujoco.mj_jac(self.model, data, self._jacp, self._jacr, point, contact.body)
        stance = self._stance[index]
        error[row : row + 2] = point[:2] - stance[:2]
        error[row + 2] = point[2] - contact.height
        jacobian[row : row + 3] = self._jacp
        up, forward = rotation @ contact.axis, rotation @ contact.forward
        error[row + 3 : row + 6] = up
        error[row + 5] -= 1
        jacobian[row + 3 : row + 6] = -_skew(up) @ self._jacr
        # psi = atan2(f_y, f_x), f' = omega x f
        length = forward[0] ** 2 + forward[1] ** 2
        turn = np.array([-forward[0] * forward[2], -forward[1] * forward[2], length]) / length
        jacobian[row + 6] = turn @ self._jacr
        error[row + 6] = _wrap(math.atan2(forward[1], forward[0]) - stance[2])

    def _evaluate_wheel(self, data: mujoco.MjData, index: int, row: int) -> None:
        contact, error, jacobian = self.contacts[index], self._error, self._jacobian
        rotation = data.xmat[contact.body].reshape(3, 3)
        point = data.xpos[contact.body] + rotation @ contact.point
        mujoco.mj_jac(self.model, data, self._jacp, self._jacr, point, contact.body)
        axle = rotation @ contact.axis
        error[row], error[row + 1] = point[2] - contact.height, axle[2]
        jacobian[row] = self._jacp[2]
        jacobian[row + 1] = axle[1] * self._jacr[0] - axle[0] * self._jacr[1]  # (w x axle)_z


def _wrap(angle: float) -> float:
    """Wrap to [-pi, pi) [rad]."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _skew(v: np.ndarray) -> np.ndarray:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _inverse_left_jacobian(turn: np.ndarray) -> np.ndarray:
    r"""Inverse left Jacobian of SO(3): :math:`\log(e^{[d]} e^{[\theta]}) = \theta + J_l^{-1} d`.

    :math:`J_l^{-1} = I - \frac12[\theta] + (\frac1{\theta^2} - \frac{1+\cos\theta}
    {2\theta\sin\theta})[\theta]^2` (Solà et al., A micro Lie theory, Eq. 146).
    """
    skew = _skew(turn)
    angle = float(np.sqrt(turn @ turn))
    if angle < 1e-4:  # the series' next term is under 1e-12
        factor = 1 / 12
    else:
        factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    return np.eye(3) - 0.5 * skew + factor * skew @ skew
