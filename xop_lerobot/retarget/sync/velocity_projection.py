"""Projection of a measured velocity on what the contacts with the ground allow."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from xop_lerobot.retarget.sync.config import SyncConfig
from xop_lerobot.retarget.sync.contacts import Contact

_LEAST_PIVOT = 1e-15  # of a Cholesky factor


def project_velocity(
    qvel: np.ndarray, variance: np.ndarray, jacobian: np.ndarray, constraint: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    r"""Find the likeliest velocity under the soft constraint :math:`J v \approx 0`.

    .. math::

        \min_v\ \tfrac12 \lVert v - \tilde v \rVert^2_{S^{-1}} + \tfrac12 \lVert J v
        \rVert^2_{R^{-1}}
        \quad\Rightarrow\quad v = \tilde v - S J^\top (J S J^\top + R)^{-1} J \tilde v

    with S and R diagonal: the update of a Kalman filter whose measurement is "the contact does
    not move" (Hartley et al., Contact-aided invariant extended Kalman filtering, RSS 2018, have
    the same for the base). One linear solve of the size of the constraint.

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
    r"""How badly a measured velocity fits a contact: 1 on average if it holds.

    .. math:: \tfrac1m (J \tilde v)^\top (J S J^\top + R)^{-1} J \tilde v

    Arguments are those of `project_velocity`.
    """
    total = (jacobian * variance) @ jacobian.T
    total.flat[:: len(total) + 1] += constraint
    slip = jacobian @ qvel
    return float(slip @ solve_positive(total, slip)) / len(slip)


def solve_positive(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Solve a small positive definite system by MuJoCo's Cholesky, in a third of NumPy's time.

    Args:
        matrix: Is overwritten. Shape (n, n).
        vector: Shape (n,).

    Raises:
        numpy.linalg.LinAlgError: If the matrix is not positive definite.
    """
    if mujoco.mju_cholFactor(matrix, _LEAST_PIVOT) < len(matrix):
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    solution = np.empty(len(vector))
    mujoco.mju_cholSolve(solution, matrix, vector)
    return solution


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

    def compute_jacobian(self, data: mujoco.MjData, index: int) -> np.ndarray:
        """Compute J of one contact, kinematics up to date. Shape (m, nv)."""
        contact = self.contacts[index]
        rotation = data.xmat[contact.body].reshape(3, 3)
        point = data.xpos[contact.body] + rotation @ contact.point
        if contact.rolls:
            point[2] -= contact.radius
        jacobian = np.empty((6, self.model.nv))
        mujoco.mj_jac(self.model, data, jacobian[:3], jacobian[3:], point, contact.body)
        if not self.wheeled:
            return jacobian
        if contact.rolls:
            return jacobian[:3]
        return np.stack([(rotation @ contact.axis) @ jacobian[:3], jacobian[2]])

    def compute_variance(self, index: int, landing: float) -> np.ndarray:
        """Variance of each row of J v of one contact.

        Args:
            index: Which contact.
            landing: How much of a touch-down is left in it, 0 to 1.

        Returns:
            Shape (m,).
        """
        config = self.config
        linear = config.contact_velocity**2 + (landing * config.touchdown_velocity) ** 2
        if self.wheeled:
            return np.full(3 if self.contacts[index].rolls else 2, linear)
        angular = config.contact_rate**2 + (landing * config.touchdown_rate) ** 2
        return np.array([linear] * 3 + [angular] * 3)

    def compute_level_jacobian(self, data: mujoco.MjData) -> np.ndarray:
        """Compute J of the roll and pitch rate of a base on wheels, world axes. Shape (2, nv)."""
        jacobian = np.empty((3, self.model.nv))
        mujoco.mj_jacBody(self.model, data, None, jacobian, self._base)
        return jacobian[:2]
