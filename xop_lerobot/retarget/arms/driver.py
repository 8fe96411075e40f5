"""Targets of arms and grippers for one tick, by inverse kinematics or from the plan.

`ArmDriver` is the entry point. `compute_wrist_goals` moves wrist goals with a head that is off its
own goal; `ServoFilter` removes encoder noise from the joints of stiff servos below the arms.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import FRAMES, Goal, RobotState
from xop_lerobot.core.transforms import (
    level_pose,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_from_matrix,
    quat_multiply,
    rotation_error,
)
from xop_lerobot.morphology.effect import Acts
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.arms.contact import ArmBias, ArmHold, ArmLoad, ArmYield
from xop_lerobot.retarget.arms.ik import ARM_MAX_DT, ARM_MAX_RATE, ArmIk


def compute_wrist_goals(
    goals: Mapping[str, np.ndarray],
    head: np.ndarray,
    max_offset: float = 0.15,
    max_turn: float = 0.4,
) -> dict[str, np.ndarray]:
    """Move wrist goals along with a head that is not at its goal.

    A working hand must be where the operator's is in the world, whatever the head does; but a
    robot that walks half a metre behind its goal must not stretch its arms ahead of itself. So
    the goal in the world applies within `max_offset` and `max_turn` of the goal relative to the
    robot's own head, and is clamped to that distance beyond, without a discontinuity.

    Args:
        goals: Goal poses in the world by tracked frame. Shapes (7,).
        head: Present pose of the robot's head. Shape (7,).
        max_offset: Distance up to which the goal in the world applies [m].
        max_turn: Angle up to which it applies [rad].

    Returns:
        Goals of every frame but the head. Shapes (7,).
    """
    wrists = {name: pose for name, pose in goals.items() if name != "head"}
    if "head" not in goals:
        return wrists
    carry = pose_multiply(level_pose(head), pose_inverse(level_pose(goals["head"])))
    return {
        name: _approach(pose_multiply(carry, pose), pose, max_offset, max_turn)
        for name, pose in wrists.items()
    }


def _approach(start: np.ndarray, end: np.ndarray, max_offset: float, max_turn: float) -> np.ndarray:
    """Move from one pose towards another by at most a distance and an angle. Shape (7,)."""
    offset = end[:3] - start[:3]
    turn = rotation_error(end[3:], start[3:])
    offset *= min(1.0, max_offset / max(float(np.linalg.norm(offset)), 1e-9))
    turn *= min(1.0, max_turn / max(float(np.linalg.norm(turn)), 1e-9))
    return make_pose(start[:3] + offset, quat_multiply(quat_exp(turn), start[3:]))


class ServoFilter:
    r"""Estimates the angles of servos from their targets and noisy encoders.

    A stiff servo follows its target s with a first-order lag, :math:`\dot m = (s - m)/T`, up to a
    slowly changing offset b such as sag, which is observed from the measured angle q:

    .. math:: b \leftarrow b + (1 - e^{-dt/\tau})(q - m - b), \qquad \hat q = m + b.

    White noise of q is reduced by :math:`\sqrt{dt/2\tau}`, and commanded motion is not delayed.

    Args:
        lag: T of each joint [s]. Shape (n,).
        time_constant: τ [s].
    """

    def __init__(self, lag: np.ndarray, *, time_constant: float = 0.4) -> None:
        self.lag, self.time_constant = lag, time_constant
        self.reset()

    def reset(self) -> None:
        """Restart from the next measurement."""
        self._model: np.ndarray | None = None
        self._offset = np.zeros(len(self.lag))

    def update(self, targets: np.ndarray, angles: np.ndarray, dt: float) -> np.ndarray:
        """Estimate the present angles.

        Args:
            targets: Targets of the servos since the last update [rad]. Shape (n,).
            angles: Measured angles [rad]. Shape (n,).
            dt: Time since the last update [s].

        Returns:
            Estimated angles [rad]. Shape (n,).
        """
        if self._model is None:
            self._model, self._offset = targets.copy(), angles - targets
            return angles.copy()
        self._model += -np.expm1(-dt / self.lag) * (targets - self._model)
        error = angles - self._model - self._offset
        self._offset += -np.expm1(-dt / self.time_constant) * error
        return self._model + self._offset


class SteadyBody:
    """Configuration of the body below the arms, with the joints of stiff servos filtered.

    Args:
        morphology: The robot; `servos` tells whether its body is on stiff servos.
        model: Any model of it, for the addresses of the joints.
    """

    def __init__(self, morphology: Morphology, model: mujoco.MjModel) -> None:
        effects = morphology.effects if morphology.servos else ()
        held = [i for i, effect in enumerate(effects) if effect.acts is Acts.JOINT]
        self._entries = np.array(held, dtype=int)
        joints = [model.joint(effects[i].joint) for i in held]
        self._address = np.array([int(joint.qposadr[0]) for joint in joints], dtype=int)
        self._filter = ServoFilter(np.array([effects[i].lag_s for i in held]))

    def reset(self) -> None:
        """Restart from the next configuration."""
        self._filter.reset()

    def update(self, qpos: np.ndarray, command: np.ndarray, dt: float) -> np.ndarray:
        """Return the filtered configuration.

        Args:
            qpos: Measured configuration. Shape (nq,).
            command: Command being executed. Shape (k,).
            dt: Time since the last update [s].
        """
        if not len(self._address):
            return qpos
        steady = qpos.copy()
        angles = qpos[self._address]
        steady[self._address] = self._filter.update(command[self._entries], angles, dt)
        return steady


BIAS_TIME = 1.5
"""Time constant of the arm offsets [s]. With 0.5 s the soft arms of G1 oscillate with a box that
they hold."""
PRESSING = (5.0, 15.0)
"""Contact forces from which the offsets of an arm are learned more slowly, and no longer [N]. A
contact keeps the hand from its goal; taken for an offset, it would make the force grow until
`max_bias` is reached, to 100 N on G1, and bend the wrists and the whole robot."""


class ArmDriver:
    """Computes continuous arm targets from goals and plan.

    Arms with a joint that the plan decides are excluded from the inverse kinematics. When the set
    of these joints changes, when the arms were driven by another source, and on engagement, it
    restarts from the executed targets, so that they never step.

    Args:
        morphology: The robot.
        holds_place: Whether the retargeter closes the loop on the position of the head
            (`Retargeter.holds_place`).
        arm_limits: Joint limits of the arms imposed by the low-level policy [rad].
    """

    def __init__(
        self,
        morphology: Morphology,
        *,
        holds_place: bool = True,
        arm_limits: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    ) -> None:
        self.morphology = morphology
        self.holds_place = holds_place
        self.ik = ArmIk(morphology, arm_limits=arm_limits)
        self.bias = ArmBias(self.ik.joint_range, time_constant=BIAS_TIME)
        self._body = SteadyBody(morphology, self.ik.model)
        self.load = ArmLoad(morphology)
        self.hold = ArmHold()
        self.giving = ArmYield()
        self._data = mujoco.MjData(self.ik.model)
        self._joints = [joint for arm in morphology.arms for joint in arm.joints]
        self.forget()

    def forget(self) -> None:
        """Restart from the executed targets at the next tick."""
        self._wanted = self._sent = np.zeros(0)
        self._decided: frozenset[str] = frozenset()

    def note(self, arms: np.ndarray) -> None:
        """Record the targets that were sent. Shape (m,)."""
        self._sent = arms[: self.ik.num_joints]

    def compute(
        self,
        state: RobotState,
        goal: Goal,
        head: np.ndarray,
        decided: Mapping[str, float],
        dt: float,
    ) -> np.ndarray:
        """Compute the targets of arms and grippers.

        Args:
            state: Present state of the robot.
            goal: Goals of wrists and grippers.
            head: Pose of the robot's head. Shape (7,).
            decided: Targets of the joints that the plan decides [rad].
            dt: Time since the last tick [s].

        Returns:
            Joint targets [rad], then gripper openings [m]. Shape (m,).
        """
        num_joints, executed = self.ik.num_joints, state.arms[: self.ik.num_joints]
        if not np.array_equal(executed, self._sent) or self._decided != frozenset(decided):
            self._wanted = executed
            self.bias.reset()
            self._body.reset()
            self.load.reset()
            self.hold.reset()
            self.giving.reset()
        self._decided = frozenset(decided)
        self.load.update(state.qpos, state.effort, dt)
        # With raw encoders of the body, the hands would visibly compensate their noise.
        body = self._body.update(state.qpos, state.command, dt)
        wrists = self._find_wrists(goal, head, body, dt)
        last, wanted = self._wanted, self.ik.solve(body, self._wanted, wrists, dt)
        planned = np.zeros(num_joints, dtype=bool)
        for name, angle in decided.items():
            i = self._joints.index(name)
            reach = ARM_MAX_RATE * min(dt, ARM_MAX_DT)
            wanted[i] = np.clip(angle, executed[i] - reach, executed[i] + reach)
            planned[i] = True
        self._wanted = wanted
        offset = state.qpos[self.ik.qpos_address] - executed
        self.bias.update(offset, wanted - last, dt, self._compute_freedom())
        # No bias on planned joints: the policy's offset is part of the plan's prediction.
        targets = np.where(planned, wanted, self.bias.compute_targets(wanted))
        return np.concatenate([targets, self.compute_grippers(goal)])

    def _find_wrists(
        self, goal: Goal, head: np.ndarray, body: np.ndarray, dt: float
    ) -> dict[str, np.ndarray]:
        """Goal poses of the wrists in the world, after contact behaviour. Shapes (7,)."""
        goals = self._find_ik_goals(goal)
        hands = [arm.frame for arm in self.morphology.arms if arm.frame in goals]
        if len(hands) != 2:  # bimanual behaviour needs a left and a right hand
            return compute_wrist_goals(goals, head)
        left, right = hands
        walking = goal.mode is Mode.MOBILE
        self.hold.update(self.load.force, goals[right][:3] - goals[left][:3])
        self.giving.update(self.hold.squeeze, dt)
        if not self.holds_place or (self.hold.is_holding and walking):
            # A carried object moves with the body, however far that is from its goal: stretching
            # the arms sideways would shear the object.
            wrists = compute_wrist_goals(goals, head, max_offset=0.0, max_turn=0.0)
        else:
            wrists = compute_wrist_goals(goals, head)
        wrists = self.hold.smooth(
            {name: wrists[name] for name in hands},
            head,
            self._compute_head(body),
            dt,
            walking=walking,
        )
        places = self.giving.part(wrists[left][:3], wrists[right][:3])
        return {
            name: make_pose(place, wrists[name][3:])
            for name, place in zip(hands, places, strict=True)
        }

    def _compute_head(self, qpos: np.ndarray) -> np.ndarray:
        """Pose of the head in a configuration. Shape (7,)."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.ik.model, self._data)
        site = self._data.site(self.morphology.frames["head"])
        return make_pose(site.xpos, quat_from_matrix(site.xmat.reshape(3, 3)))

    def _compute_freedom(self) -> np.ndarray:
        """Factor on the learning rate of each joint: 1 in free space, 0 in contact. (n,)."""
        freedom = np.ones(self.ik.num_joints)
        gentle, hard = PRESSING
        for part, force in zip(self.load.parts, self.load.force, strict=True):
            freedom[part] = np.clip((hard - np.linalg.norm(force)) / (hard - gentle), 0, 1)
        return freedom

    def _find_ik_goals(self, goal: Goal) -> dict[str, np.ndarray]:
        """Goals except those of arms that the plan decides."""
        taken = {
            arm.frame for arm in self.morphology.arms if not self._decided.isdisjoint(arm.joints)
        }
        return {name: pose for name, pose in goal.poses.items() if name not in taken}

    def compute_grippers(self, goal: Goal) -> np.ndarray:
        """Openings of the grippers [m], in the order of `arms`."""
        grips: dict[str, float] = dict(zip(FRAMES[1:], goal.grips, strict=True))
        openings = []
        for arm in self.morphology.arms:
            if arm.gripper:
                closed, opened = arm.gripper_range
                openings.append(opened + grips.get(arm.frame, 0.0) * (closed - opened))
        return np.array(openings)
