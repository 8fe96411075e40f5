"""Static gravity loads of joints relative to the torque limits of their motors."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from xop_lerobot.morphology.morphology import Morphology


class StaticLoad:
    r"""Torques that hold joints against gravity, divided by the limits of their motors.

    .. math:: \tau_i = m_i g\; a_i \cdot ((c_i - p_i) \times e_z)

    with a and p the joint's axis and anchor, m and c mass and centre of mass of the joint's
    subtree. A servo at its torque limit gives way, and the chain above it folds.

    Args:
        model: The robot's model.
        joints: Joints whose load counts; those without a torque limit are left out.
        share: Fraction of the limit up to which a load has no excess [1].

    Attributes:
        limits: Torque limits [N m]. Shape (n,).
        joints: Names of the joints that have one.
    """

    def __init__(self, model: mujoco.MjModel, joints: Iterable[str], share: float) -> None:
        self._model, self._data, self.share = model, mujoco.MjData(model), share
        limits = _find_limits(model)
        self._loaded = np.array(
            [i for i in (model.joint(name).id for name in joints) if i in limits], dtype=int
        )
        self.limits = np.array([limits[i] for i in self._loaded])
        self.joints = tuple(model.joint(i).name for i in self._loaded)
        hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
        self._moving = np.flatnonzero(hinge)
        self._dofs = model.jnt_dofadr[self._moving]
        self._bodies = model.jnt_bodyid[self._loaded]
        self._moving_bodies = model.jnt_bodyid[self._moving]
        above = _find_ancestors(model)
        # Whether hinge j moves the whole subtree of loaded joint i (j is i, or between i and the
        # root), or only a part of it (j is inside the subtree).
        self._carries = above[np.ix_(self._bodies, self._moving_bodies)]
        self._hangs = above[np.ix_(self._moving_bodies, self._bodies)].T & ~self._carries
        mass = model.body_subtreemass
        self._weight = mass[self._bodies] * -float(model.opt.gravity[2])
        self._part = mass[self._moving_bodies] / mass[self._bodies][:, None]

    def compute(self, data: mujoco.MjData) -> np.ndarray:
        """Signed torques over their limits, after `mj_comPos` [1]. Shape (n,)."""
        arm, axis = self._compute_arms(data)
        torque = self._weight * (axis[:, 0] * arm[:, 1] - axis[:, 1] * arm[:, 0])
        return torque / self.limits

    def compute_excess(self, qpos: np.ndarray) -> np.ndarray:
        """Loads beyond their `share` in a batch of configurations [1]. (m, nq) -> (m, n)."""
        data, load = self._data, np.empty((len(qpos), len(self.joints)))
        for i, configuration in enumerate(qpos):
            data.qpos[:] = configuration
            mujoco.mj_kinematics(self._model, data)
            mujoco.mj_comPos(self._model, data)
            load[i] = self.compute(data)
        return np.maximum(np.abs(load) - self.share, 0.0)

    def _compute_arms(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        loaded = self._loaded
        return data.subtree_com[self._bodies] - data.xanchor[loaded], data.xaxis[loaded]

    def linearise_excess(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        r"""Compute the loads beyond their `share`, and their derivative by :math:`\dot q`.

        Shapes (n,), (n, nv). Needs `mj_comPos` first.
        """
        load = self.compute(data)
        excess = np.abs(load) - self.share
        jacobian = np.zeros((len(load), self._model.nv))
        beyond = np.flatnonzero(excess > 0)
        if len(beyond):
            by_joints = self._differentiate(data)[beyond]
            jacobian[np.ix_(beyond, self._dofs)] = np.sign(load[beyond])[:, None] * by_joints
        return np.maximum(excess, 0.0), jacobian

    def _differentiate(self, data: mujoco.MjData) -> np.ndarray:
        """Derivative of `compute` by each hinge. Shape (n, m)."""
        arm, axis = self._compute_arms(data)
        turning = data.xaxis[self._moving]  # (m, 3)
        own = data.subtree_com[self._moving_bodies] - data.xanchor[self._moving]
        part = _cross_level(turning, own)  # velocity of the mass above each hinge
        arm_by = np.where(self._carries, _cross_level(turning, arm[:, None]), 0.0)
        arm_by += self._hangs * self._part * part[:, None]
        axis_by = np.where(self._carries, _cross_level(turning, axis[:, None]), 0.0)
        change = axis_by[0] * arm[:, 1, None] + axis[:, 0, None] * arm_by[1]
        change -= axis_by[1] * arm[:, 0, None] + axis[:, 1, None] * arm_by[0]
        return (self._weight / self.limits)[:, None] * change


def _cross_level(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """X and Y of a cross product, as the first axis. (..., 3) -> (2, ...)."""
    return np.array(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
        ]
    )


def make_static_load(morphology: Morphology, model: mujoco.MjModel) -> StaticLoad | None:
    """Static loads of the servos of a stiff body; None if a policy moves the body."""
    if morphology.servos is None:
        return None
    joints = [effect.joint for effect in morphology.effects if effect.joint]
    return StaticLoad(model, joints, morphology.servos.load_share)


def _find_limits(model: mujoco.MjModel) -> dict[int, float]:
    """Largest torque of the motor on each joint that has one with a limit [N m]."""
    limits = {}
    for i in range(model.nu):
        on_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        if on_joint and model.actuator_forcelimited[i]:
            limits[int(model.actuator_trnid[i, 0])] = float(model.actuator_forcerange[i].max())
    return limits


def _find_ancestors(model: mujoco.MjModel) -> np.ndarray:
    """Mask [i, j]: body j is body i or one of its ancestors. Shape (nbody, nbody), bool."""
    above = np.eye(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        above[body] |= above[model.body_parentid[body]]
    return above
