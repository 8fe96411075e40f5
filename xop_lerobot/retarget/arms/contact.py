"""Arms in contact: force estimation, bimanual holding, compliance, and steady-state correction.

`ArmLoad` estimates contact forces from arm torques, `ArmHold` keeps a bimanually held object fixed
relative to the body, `ArmYield` limits the squeezing force, and `ArmBias` observes and corrects the
steady-state error of the arm joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import mujoco
import numpy as np

from xop_lerobot.core.transforms import (
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_multiply,
    rotation_error,
)
from xop_lerobot.morphology.morphology import Morphology

HELD = (4.0, 2.0)
"""Forces of the hands towards each other at which holding begins and ends (hysteresis) [N]."""
CARRYING_S, HOLDING_S, FREE_S = 1.5, 0.6, 0.1
"""Time constants of the goals relative to the body: hands that hold an object in mobile mode, in
stationary mode, and hands that have released it [s]."""
CAUGHT_UP = 0.003
"""Distance of free hands from their goals at which the smoothing ends [m]."""


class ArmHold:
    """Smooths the goals of hands that hold an object between them, relative to the robot's head.

    A walking robot sways by centimetres. Hands that are fixed in the world have to move against
    that sway, never quite in phase, and shear the object between them until it slips. So while an
    object is held, their goals relative to the body change slowly, and the object sways with the
    body.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget a held object."""
        self.is_holding = False
        self.squeeze = 0.0
        """Squeezing force: the smaller of the forces of the hands towards each other [N]."""
        self._poses: dict[str, np.ndarray] = {}

    def update(self, forces: np.ndarray, across: np.ndarray) -> None:
        """Detect whether an object is held.

        Args:
            forces: Forces of the left and the right hand on the environment, world axes [N].
                Shape (2, 3).
            across: Vector from the left to the right hand [m]. Shape (3,).
        """
        direction = across / max(float(np.linalg.norm(across)), 1e-6)
        self.squeeze = min(float(forces[0] @ direction), -float(forces[1] @ direction))
        self.is_holding = self.squeeze > (HELD[1] if self.is_holding else HELD[0])

    def smooth(
        self,
        goals: Mapping[str, np.ndarray],
        head: np.ndarray,
        steady_head: np.ndarray,
        dt: float,
        *,
        walking: bool = False,
    ) -> dict[str, np.ndarray]:
        """Smooth the goals while an object is held, and briefly after its release.

        Args:
            goals: Wrist poses in the world. Shapes (7,).
            head: Measured pose of the robot's head. Shape (7,).
            steady_head: Pose of the head in the filtered configuration that the arms are solved
                for. Smoothed goals are attached to it, as they would tremble with the noise of
                `head` otherwise. Shape (7,).
            dt: Time since the last tick [s].
            walking: Whether the robot may be walking.

        Returns:
            Goals in the world. Shapes (7,).
        """
        back = pose_inverse(head)
        local = {name: pose_multiply(back, pose) for name, pose in goals.items()}
        if not self.is_holding and self._poses.keys() != local.keys():  # nothing was held before
            self._poses = {}
            return dict(goals)
        held_s = CARRYING_S if walking else HOLDING_S
        share = -np.expm1(-max(dt, 0.0) / (held_s if self.is_holding else FREE_S))
        for name, pose in local.items():
            last = self._poses.get(name, pose)
            turn = quat_exp(share * rotation_error(pose[3:], last[3:]))
            position = last[:3] + share * (pose[:3] - last[:3])
            self._poses[name] = make_pose(position, quat_multiply(turn, last[3:]))
        if not self.is_holding:
            far = max(float(np.linalg.norm(self._poses[n][:3] - local[n][:3])) for n in local)
            if far < CAUGHT_UP:
                self._poses = {}
                return dict(goals)
        return {name: pose_multiply(steady_head, self._poses[name]) for name in local}


class ArmBias:
    r"""Observes the steady-state offset of each arm joint from its target, and compensates it.

    To keep its balance, a learned low-level policy moves the arms off their targets, by 0.2 rad
    with the hands forward; servos sag. Per joint, with :math:`s` the executed target and :math:`q`
    the measured angle,

    .. math:: b \leftarrow b + (1 - e^{-dt/\tau})\,(q - s - b), \qquad |b| \le b_{max},

    and the target to send for a desired angle :math:`q^*` is :math:`q^* - b` within the joint's
    limits. It is a disturbance observer, not an integral of the tracking error: nothing winds up
    at a limit or at an unreachable goal.

    While the arms move, :math:`q - s` is lag and swing rather than offset. So nothing is learned
    until the low-passed speeds of all desired angles have been small for a while.

    Args:
        joint_range: Limits of the joints [rad]. Shape (n, 2).
        time_constant: τ [s].
        max_bias: Largest offset that is compensated [rad].
        max_speed: Speed of a desired angle above which nothing is learned [rad/s].
        smoothing: Time constant of the low-pass filter of that speed [s].
        rest_s: Time for which the arms must have been slow [s].
    """

    def __init__(
        self,
        joint_range: np.ndarray,
        *,
        time_constant: float = 0.5,
        max_bias: float = 0.3,
        max_speed: float = 0.5,
        smoothing: float = 0.4,
        rest_s: float = 0.2,
    ) -> None:
        self.joint_range = joint_range
        self.time_constant, self.max_bias = time_constant, max_bias
        self.max_speed, self.smoothing, self.rest_s = max_speed, smoothing, rest_s
        self.reset()

    def reset(self) -> None:
        """Set the offsets to zero."""
        self.bias = np.zeros(len(self.joint_range))
        """Estimated offsets [rad]. Shape (n,)."""
        self._velocity = np.zeros(len(self.joint_range))
        self._slow_s = 0.0

    def update(
        self, offset: np.ndarray, moved: np.ndarray, dt: float, free: np.ndarray | None = None
    ) -> None:
        """Update the offsets by one tick.

        Args:
            offset: Measured angles less the targets executed last, q − s [rad]. Shape (n,).
            moved: Change of the desired angles since the last update [rad]. Shape (n,).
            dt: Time since the last update [s]; nothing is learned if it is not positive.
            free: Factor on the learning rate of each joint, 1 for an arm in free space, 0 for one
                in firm contact; 1 by default. Shape (n,).
        """
        if dt <= 0:
            return
        share = -np.expm1(-dt / self.smoothing)
        self._velocity += share * (moved / dt - self._velocity)
        is_slow = np.abs(self._velocity).max(initial=0.0) <= self.max_speed
        self._slow_s = self._slow_s + dt if is_slow else 0.0
        if self._slow_s < self.rest_s:
            return
        share = -np.expm1(-dt / self.time_constant) * (1.0 if free is None else free)
        bias = self.bias + share * (offset - self.bias)
        self.bias = np.clip(bias, -self.max_bias, self.max_bias)

    def compute_targets(self, wanted: np.ndarray) -> np.ndarray:
        """Targets that bring the joints to the angles `wanted` [rad]. Shapes (n,)."""
        return np.clip(wanted - self.bias, *self.joint_range.T)


class ArmLoad:
    r"""Estimates the force on each wrist from the measured torques of its arm.

    In slow motion the torques τ of an arm balance gravity g(q) and the contact force. With J the
    translational Jacobian of the wrist by the arm's joints, the force of the hand on the
    environment is the least-squares solution of

    .. math:: J^T f = \tau - g(q),

    low-passed, since the torques also contain friction and swing.

    Args:
        morphology: The robot.
        smoothing: Time constant of the low-pass filter [s].
    """

    def __init__(self, morphology: Morphology, smoothing: float = 0.3) -> None:
        self.smoothing = smoothing
        self._model = morphology.build_spec("full").compile()
        self._data = mujoco.MjData(self._model)
        self._jacobian = np.zeros((3, self._model.nv))
        self._arms = []
        on_joint = self._model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        driven = np.where(on_joint, self._model.actuator_trnid[:, 0], -1).tolist()
        for arm in morphology.arms:
            joints = [self._model.joint(joint) for joint in arm.joints]
            site = self._model.site(morphology.frames[arm.frame]).id
            dofs = np.array([int(joint.dofadr[0]) for joint in joints])
            self._arms.append((site, dofs, np.array([driven.index(joint.id) for joint in joints])))
        ends = np.cumsum([0, *(len(arm.joints) for arm in morphology.arms)])
        self.parts = tuple(slice(*pair) for pair in pairwise(ends.tolist()))
        """Slice of each arm's joints among those of all arms."""
        self.reset()

    def reset(self) -> None:
        """Set the forces to zero."""
        self.force = np.zeros((len(self._arms), 3))
        """Force of each hand on the environment, world axes [N]. Shape (arms, 3)."""

    def update(self, qpos: np.ndarray, effort: np.ndarray, dt: float) -> None:
        """Update the forces by one measurement.

        Args:
            qpos: Measured configuration. Shape (nq,).
            effort: Measured forces of all actuators [N m or N]; all zero from a robot without
                torque measurement, which then estimates no force. Shape (nu,).
            dt: Time since the last update [s]; ignored if it is not positive.
        """
        if dt <= 0 or not effort.any():
            return
        model, data = self._model, self._data
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        weight = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 0, weight)  # at zero velocity: gravity alone
        share = -np.expm1(-dt / self.smoothing)
        for i, (site, dofs, actuators) in enumerate(self._arms):
            mujoco.mj_jacSite(model, data, self._jacobian, None, site)
            torque = effort[actuators] - weight[dofs]
            # rcond drops directions in which a nearly singular arm cannot measure force.
            force = np.linalg.lstsq(self._jacobian[:, dofs].T, torque, rcond=0.1)[0]
            self.force[i] += share * (force - self.force[i])


MAX_SQUEEZE = 60.0
"""Squeezing force above which the hands yield [N]: enough for a 4 kg box with a friction of 0.7
that is accelerated by 0.1 g, and within the wrist torques of G1 and RB-Y1."""
GAIN = 2e-4
"""Yielding speed per newton above the limit [m/s/N]. With arms of up to 10 N/mm and a force
estimate that lags by 0.3 s, the hands settle within about a second, without oscillation."""
MAX_YIELD = 0.06
"""Largest displacement of a yielding hand [m]."""


class ArmYield:
    r"""Admittance of two hands that squeeze an object too hard: moves their goals apart.

    The operator of a headset does not feel how hard the robot presses. On stiff servos a
    centimetre means a hundred newtons: the wrists reach their torque limits, bend, and let go. So
    each hand is displaced away from the other by w,

    .. math:: \dot w = k (F - F_{max}), \quad 0 \le w \le w_{max},

    with F the squeezing force. w is never negative: a weak grip is not tightened.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Set the displacement to zero."""
        self.displacement = 0.0
        """Present displacement w of each hand [m]."""

    def update(self, squeeze: float, dt: float) -> None:
        """Update the displacement.

        Args:
            squeeze: Squeezing force [N].
            dt: Time since the last update [s].
        """
        displacement = self.displacement + GAIN * dt * (squeeze - MAX_SQUEEZE)
        self.displacement = float(np.clip(displacement, 0.0, MAX_YIELD))

    def part(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move the positions of the left and the right hand apart [m]. Shapes (3,)."""
        across = right - left
        shift = self.displacement * across / max(float(np.linalg.norm(across)), 1e-6)
        return left - shift, right + shift
