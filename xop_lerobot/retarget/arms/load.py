"""What the hands press against, felt in the torques of the arms."""

from __future__ import annotations

from itertools import pairwise

import mujoco
import numpy as np

from xop_lerobot.morphology.morphology import Morphology


class ArmLoad:
    r"""Estimates the force on each wrist from the measured torques of its arm.

    In slow motion the torques τ of an arm carry its weight g(q) and whatever presses on the hand.
    With J the translational Jacobian of the wrist over the arm's joints, the force of the hand on
    what it touches is the least-squares solution of

    .. math:: J^T f = \tau - g(q),

    smoothed over a while, since friction and swing are in the torques, too.

    Args:
        morphology: The robot.
        smoothing: Time constant [s].
    """

    def __init__(self, morphology: Morphology, smoothing: float = 0.3) -> None:
        self.smoothing = smoothing
        self._model = morphology.build_spec("full").compile()
        self._data = mujoco.MjData(self._model)
        self._jacobian = np.zeros((3, self._model.nv))
        self._arms = []
        driven = self._model.actuator_trnid[:, 0].tolist()
        for arm in morphology.arms:
            joints = [self._model.joint(joint) for joint in arm.joints]
            site = self._model.site(morphology.frames[arm.frame]).id
            dofs = np.array([int(joint.dofadr[0]) for joint in joints])
            self._arms.append((site, dofs, np.array([driven.index(joint.id) for joint in joints])))
        ends = np.cumsum([0, *(len(arm.joints) for arm in morphology.arms)])
        self.parts = tuple(slice(*pair) for pair in pairwise(ends.tolist()))
        """Which joints of all arms each arm has."""
        self.reset()

    def reset(self) -> None:
        """Forget what was felt."""
        self.force = np.zeros((len(self._arms), 3))
        """Force of each hand on what it touches, world axes [N]. Shape (arms, 3)."""

    def update(self, qpos: np.ndarray, effort: np.ndarray, dt: float) -> None:
        """Feel once.

        Args:
            qpos: Measured configuration. Shape (nq,).
            effort: Measured forces of all actuators [N m or N]. Shape (nu,). Of a robot that
                measures none, all zero, nothing is felt.
            dt: Time since the last update [s]; without any, nothing is felt.
        """
        if dt <= 0 or not effort.any():
            return
        model, data = self._model, self._data
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        weight = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 0, weight)
        share = -np.expm1(-dt / self.smoothing)
        for i, (site, dofs, actuators) in enumerate(self._arms):
            mujoco.mj_jacSite(model, data, self._jacobian, None, site)
            torque = effort[actuators] - weight[dofs]
            force = np.linalg.lstsq(self._jacobian[:, dofs].T, torque, rcond=0.1)[0]
            self.force[i] += share * (force - self.force[i])
