"""Arms in contact: loads on the hands, a bimanually held object, and hands that squeeze too hard.

`ArmLoad` estimates contact forces from the torques of the arms, `ArmHold` keeps an object that both
hands hold fixed relative to the body, `ArmYield` gives way to too much force; `ArmBias` observes
by how much arms miss their targets, and corrects it slowly.
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
"""Force of either hand towards the other from which something is held, and below which it is not
any more [N]."""
CARRYING_S, HOLDING_S, FREE_S = 1.5, 0.6, 0.1
"""Time constants with which hands that carry something, that hold it, and free ones take up where
they shall be against the body [s]; free hands that have once done so are not smoothed at all."""
CAUGHT_UP = 0.003
"""Free hands so near to their goals are no longer smoothed [m]."""


class ArmHold:
    """Smooths the goals of hands that press on each other, as seen from the robot's head.

    A robot that walks sways by centimetres. Hands that stay where they are in the world all the
    while have to swing against the body, neither of them quite in time, and shear what is between
    them until it slips. So their goals against the body change slowly while something is held;
    what they hold sways with the body.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Hold nothing."""
        self.is_holding = False
        self.squeeze = 0.0
        """Force of either hand towards the other, the smaller of both [N]."""
        self._poses: dict[str, np.ndarray] = {}

    def update(self, forces: np.ndarray, across: np.ndarray) -> None:
        """Find out whether something is held.

        Args:
            forces: Of the left and the right hand on what they touch, world [N]. Shape (2, 3).
            across: From the left hand to the right one [m]. Shape (3,).
        """
        way = across / max(float(np.linalg.norm(across)), 1e-6)
        self.squeeze = min(float(forces[0] @ way), -float(forces[1] @ way))
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
        """Smooth the goals as the hands need it.

        Args:
            goals: Wrist poses in the world. Shapes (7,).
            head: Pose of the robot's head that they belong to. Shape (7,).
            steady_head: Pose of the head of the body that the arms are computed for. What is
                smoothed is put back to there; it would tremble by the difference. Shape (7,).
            dt: Time since the last tick [s].
            walking: Whether the robot may be walking.

        Returns:
            Goals in the world. Shapes (7,).
        """
        back = pose_inverse(head)
        local = {name: pose_multiply(back, pose) for name, pose in goals.items()}
        if not self.is_holding and self._poses.keys() != local.keys():
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
    r"""Observes the offset of each arm joint from its target, to send targets without it.

    A learned low-level policy moves the arms beside their targets to keep its balance, by 0.2
    rad with the hands forward, and servos sag. Per joint, with :math:`s` the target that was
    executed and :math:`q` the measured angle,

    .. math:: b \leftarrow b + (1 - e^{-dt/\tau})\,(q - s - b), \qquad |b| \le b_{max},

    and the target to send for a wanted angle :math:`q^*` is :math:`q^* - b` within the joint's
    limits. It is an observer of the plant's own offset, not an integral of the tracking error:
    nothing winds up at a limit or at a goal out of reach.

    While the arms move, :math:`q - s` is lag and swing, no offset; so nothing is learned until
    the wanted angles of all joints, smoothed against noise, have been slow for a while.

    Args:
        joint_range: Limits of the joints [rad]. Shape (n, 2).
        time_constant: τ [s].
        max_bias: Largest offset that is taken out [rad].
        max_speed: Speed of a wanted angle from which on nothing is learned [rad/s].
        smoothing: Time constant over which that speed is smoothed [s].
        rest_s: For how long the arms must have been slow [s].
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
        """Forget the offsets."""
        self.bias = np.zeros(len(self.joint_range))
        """The offsets now [rad]. Shape (n,)."""
        self._velocity = np.zeros(len(self.joint_range))
        self._slow_s = 0.0

    def update(
        self, offset: np.ndarray, moved: np.ndarray, dt: float, free: np.ndarray | None = None
    ) -> None:
        """Learn from one tick.

        Args:
            offset: Measured angles less the targets executed last, q − s [rad]. Shape (n,).
            moved: How far the wanted angles have moved since the last update [rad]. Shape (n,).
            dt: Time since then [s]; without any, nothing is learned.
            free: Factor on the rate at which each joint learns, 1 for a free arm, 0 for one that
                presses as hard as it may. Shape (n,).
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
        """Targets [rad] that bring the joints to `wanted` [rad]. Shapes (n,)."""
        return np.clip(wanted - self.bias, *self.joint_range.T)


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
        on_joint = self._model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        driven = np.where(on_joint, self._model.actuator_trnid[:, 0], -1).tolist()
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


MOST_SQUEEZE = 60.0
"""Hands that squeeze harder than so give way [N]: enough for a box of 4 kg with a friction of 0.7
that is accelerated by 0.1 g, and within what the wrists of both robots can do."""
GAIN = 2e-4
"""How fast a hand gives way per newton over the limit [m/s/N]. With arms of up to 10 N/mm and a
force that is felt 0.3 s late, this comes to rest within about a second, without swinging."""
MOST_WAY = 0.06
"""Farthest that a hand gives way [m]."""


class ArmYield:
    r"""Moves the goals of both hands apart while they squeeze what is between them too hard.

    Nobody feels through a headset how hard a robot presses. Arms on stiff servos turn a
    centimetre into a hundred newtons: their wrists reach their largest torque, bend, and let go.
    So each hand gives way by w against the other,

    .. math:: \dot w = k (F - F_{max}), \quad 0 \le w \le w_{max},

    with F the force with which they squeeze. Who squeezes less gets no help: w is never negative.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Give way no more."""
        self.way = 0.0
        """How far each hand has given way [m]."""

    def update(self, squeeze: float, dt: float) -> None:
        """Take up how hard the hands squeeze.

        Args:
            squeeze: Force of either hand towards the other [N].
            dt: Time since the last update [s].
        """
        way = self.way + GAIN * dt * (squeeze - MOST_SQUEEZE)
        self.way = float(np.clip(way, 0.0, MOST_WAY))

    def part(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move the places of the left and the right hand apart [m]. Shapes (3,)."""
        across = right - left
        way = self.way * across / max(float(np.linalg.norm(across)), 1e-6)
        return left - way, right + way
