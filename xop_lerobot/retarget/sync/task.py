"""Residuals of the state synchronisation (Eq. 4), as a single mink task."""

from __future__ import annotations

from collections.abc import Sequence

import mink
import mujoco
import numpy as np

from xop_lerobot.core.transforms import skew
from xop_lerobot.morphology.contacts import Contact, ContactKind
from xop_lerobot.retarget.sync.config import SyncConfig
from xop_lerobot.retarget.sync.contacts import compute_height


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
    each contact          see `Feet` and `Wheels`                        `rows`
    ===================== ============================================== ========= ============

    Steps are in the tangent space of MuJoCo's free joint: linear in the world, angular in the body.

    A single task instead of several of mink's is faster: constant rows are filled once, and one
    pass over the contacts gives both residual and Jacobian.

    Args:
        model: Robot with a free base.
        contacts: Its feet or wheels.
        kind: Kind of the contacts.
        config: Standard deviations, whose inverses are the task's costs.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        contacts: Sequence[Contact],
        kind: ContactKind,
        config: SyncConfig,
    ) -> None:
        self.contacts, self.kind, self.config = tuple(contacts), kind, config
        self.model = model
        self._num_own = num_own = model.nv
        rows = num_own + kind.rows * len(self.contacts)
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
        """Noise of each joint relative to that of a hinge. Shape (nv - 6,)."""
        own = [*[config.position] * 3, config.tilt, config.tilt, config.heading]
        self._base_cost = np.concatenate([1 / np.array(own), 1 / (config.joint * self.joint_scale)])
        self._own_cost = self._base_cost
        super().__init__(cost=self._base_cost, gain=1.0, lm_damping=0.0)

    def set_measurement(self, qpos: np.ndarray, std: np.ndarray | None = None) -> None:
        """Set the measurement and its accuracy.

        Args:
            qpos: Generalised position. Shape (nq,).
            std: Standard deviation along each degree of freedom, of the orientation in world
                axes; as configured by default. Shape (nv,).
        """
        self._measured = qpos
        self._own_cost = self._base_cost if std is None else 1 / std

    def set_active(
        self, active: Sequence[int], std: Sequence[np.ndarray], stance: np.ndarray
    ) -> None:
        """Set the active contacts, their accuracies and their locations.

        Args:
            active: Indices of the active contacts.
            std: Standard deviation of each row of each active contact; infinite to ignore a row.
                Shapes (`kind.rows`,).
            stance: x, y and heading of every contact. Shape (contacts, 3).
        """
        self._active, self._stance = tuple(active), stance
        self.cost = np.concatenate([self._own_cost, *(1 / one for one in std)])

    def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
        """Compute all residuals, unweighted. Shape (rows,)."""
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
        # MuJoCo gives log(R~^T R) in body axes. Rotate it to log(R R~^T) in world axes, in which
        # tilt and heading are separate components.
        mujoco.mju_quat2Mat(self._rotation, qpos[3:7])
        rotation = self._rotation.reshape(3, 3)
        turn = rotation @ self._difference[3:6]
        error[3:6] = turn
        jacobian[3:6, 3:6] = _inverse_left_jacobian(turn) @ rotation if turn.any() else rotation
        row = self._num_own
        for index in self._active:
            contact, end = self.contacts[index], row + self.kind.rows
            rotation = data.xmat[contact.body].reshape(3, 3)
            point = data.xpos[contact.body] + rotation @ contact.point
            mujoco.mj_jac(self.model, data, self._jacp, self._jacr, point, contact.body)
            self.kind.fill_residuals(
                contact,
                rotation,
                point,
                self._stance[index],
                self._jacp,
                self._jacr,
                error[row:end],
                jacobian[row:end],
            )
            row = end


def _inverse_left_jacobian(turn: np.ndarray) -> np.ndarray:
    r"""Inverse left Jacobian of SO(3): :math:`\log(e^{[d]} e^{[\theta]}) = \theta + J_l^{-1} d`.

    :math:`J_l^{-1} = I - \frac12[\theta] + (\frac1{\theta^2} - \frac{1+\cos\theta}
    {2\theta\sin\theta})[\theta]^2` (Solà et al., A micro Lie theory, Eq. 146).
    """
    cross = skew(turn)
    angle = float(np.sqrt(turn @ turn))
    if angle < 1e-4:  # limit of the series; its next term is below 1e-12
        factor = 1 / 12
    else:
        factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    return np.eye(3) - 0.5 * cross + factor * cross @ cross
