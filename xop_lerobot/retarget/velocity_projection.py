"""Projection of a measured velocity on what the contacts with the ground allow."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from xop_lerobot.retarget.sync_config import SyncConfig
from xop_lerobot.retarget.sync_contacts import Contact


def project_velocity(
    qvel: np.ndarray, std: np.ndarray, jacobian: np.ndarray, constraint_std: np.ndarray
) -> np.ndarray:
    r"""Find the likeliest velocity under the soft constraint :math:`J v \approx 0`.

    .. math::

        \min_v\ \tfrac12 \lVert v - \tilde v \rVert^2_{S^{-1}} + \tfrac12 \lVert J v
        \rVert^2_{R^{-1}}
        \quad\Rightarrow\quad v = \tilde v - S J^\top (J S J^\top + R)^{-1} J \tilde v

    with :math:`S = diag(std^2)`, :math:`R = diag(constraint\_std^2)`: the update of a Kalman
    filter whose measurement is "the contact does not move" (Hartley et al., Contact-aided
    invariant extended Kalman filtering, RSS 2018, have the same for the base). One linear solve
    of the size of the constraint.

    Args:
        qvel: Measured velocity ṽ. Shape (nv,).
        std: Its standard deviations. Shape (nv,).
        jacobian: J. Shape (m, nv).
        constraint_std: Standard deviation of each row of J v [unit of the row]. Shape (m,).

    Returns:
        The projected velocity. Shape (nv,).

    Raises:
        numpy.linalg.LinAlgError: If the solve is singular.
    """
    spread = np.square(std)[:, None] * jacobian.T  # S J^T  (nv, m)
    total = jacobian @ spread
    total.flat[:: len(total) + 1] += np.square(constraint_std)
    return qvel - spread @ np.linalg.solve(total, jacobian @ qvel)


class ContactVelocity:
    r"""Jacobian of the velocities that are zero while the contacts hold.

    - Standing foot: velocity of its point [m/s] and its angular velocity [rad/s], 6 rows.
    - Rolling wheel without slip: velocity of the wheel's material point that touches the ground,
      :math:`c - r e_z`, 3 rows: nothing sideways, nothing vertical, forward velocity of the centre
      equal to wheel speed times radius.
    - Wheel whose turning is no joint of the model: velocity of its centre along the axle and
      vertical, 2 rows.
    - On wheels also roll and pitch rate of the base, 2 rows, since all wheels stay down.

    Args:
        model: Robot on a free base.
        contacts: Its feet or wheels.
        wheeled: Whether they are wheels.
        config: Standard deviations.
    """

    def __init__(
        self, model: mujoco.MjModel, contacts: Sequence[Contact], wheeled: bool, config: SyncConfig
    ) -> None:
        self.model, self.contacts, self.wheeled = model, tuple(contacts), wheeled
        self.config = config
        self._base = int(model.jnt_bodyid[0])

    def compute_jacobian(
        self, data: mujoco.MjData, active: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute J and the standard deviation of each row, kinematics up to date.

        Args:
            data: Pose of the robot.
            active: Indices of the contacts that hold.

        Returns:
            Jacobian (m, nv) and standard deviations (m,).
        """
        if not active:
            return np.zeros((0, self.model.nv)), np.zeros(0)
        velocity, rate = self.config.contact_velocity, self.config.contact_rate
        jacobian = np.zeros((6 * len(active) + 3, self.model.nv))
        std = np.full(len(jacobian), velocity)
        row = 0
        jacp, jacr = np.zeros((2, 3, self.model.nv))
        for index in active:
            contact = self.contacts[index]
            rotation = data.xmat[contact.body].reshape(3, 3)
            point = data.xpos[contact.body] + rotation @ contact.point
            if contact.rolls:
                point[2] -= contact.radius
            mujoco.mj_jac(self.model, data, jacp, jacr, point, contact.body)
            if not self.wheeled:
                jacobian[row : row + 3], jacobian[row + 3 : row + 6] = jacp, jacr
                std[row + 3 : row + 6] = rate
                row += 6
            elif contact.rolls:
                jacobian[row : row + 3] = jacp
                row += 3
            else:
                jacobian[row], jacobian[row + 1] = (rotation @ contact.axis) @ jacp, jacp[2]
                row += 2
        if self.wheeled:
            mujoco.mj_jacBody(self.model, data, None, jacr, self._base)
            jacobian[row : row + 2] = jacr[:2]
            std[row : row + 2] = rate
            row += 2
        return jacobian[:row], std[:row]
