"""Arms and grippers of one tick: by inverse kinematics, or as the plan has decided.

Wrist goals are relative to the head where the body is not where the head's goal is
(`compute_wrist_goals`); `ServoFilter` takes the noise of encoders out of joints on stiff servos.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.morphology import Morphology


def compute_wrist_goals(
    goals: Mapping[str, np.ndarray],
    head: np.ndarray,
    max_offset: float = 0.15,
    max_turn: float = 0.4,
) -> dict[str, np.ndarray]:
    """Move wrist goals along with a head that is not at its goal.

    A hand that works must be where the operator's is in the world, whatever the head does; a
    robot that walks half a metre behind its goal must not stretch its arms ahead of itself. So
    the goal in the world holds while it is within `max_offset` and `max_turn` of the goal that
    goes with the robot's own head, and is held at that distance beyond. The change is continuous.

    Args:
        goals: Goal poses in the world by tracked frame. Shapes (7,).
        head: The robot's head now. Shape (7,).
        max_offset: Distance up to which the goal in the world holds [m].
        max_turn: Turn up to which it holds [rad].

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
    """Go from one pose towards another, at most so far. Shape (7,)."""
    offset = end[:3] - start[:3]
    turn = rotation_error(end[3:], start[3:])
    offset *= min(1.0, max_offset / max(float(np.linalg.norm(offset)), 1e-9))
    turn *= min(1.0, max_turn / max(float(np.linalg.norm(turn)), 1e-9))
    return make_pose(start[:3] + offset, quat_multiply(quat_exp(turn), start[3:]))


class ServoFilter:
    r"""Estimates where servos hold their joints, from what they were told and where they are seen.

    A stiff servo follows its target s as a first-order lag, :math:`\dot m = (s - m)/T`, but for
    an offset that changes slowly, such as a sag. So of the measured angle q only the slow part of
    what the lag does not explain is believed,

    .. math:: b \leftarrow b + (1 - e^{-dt/\tau})(q - m - b), \qquad \hat q = m + b.

    White noise of q is damped by :math:`\sqrt{dt/2\tau}`, and no motion that was asked for is late.

    Args:
        lag: T of each joint [s]. Shape (n,).
        time_constant: τ [s].
    """

    def __init__(self, lag: np.ndarray, *, time_constant: float = 0.4) -> None:
        self.lag, self.time_constant = lag, time_constant
        self.reset()

    def reset(self) -> None:
        """Start anew from the next measurement."""
        self._model: np.ndarray | None = None
        self._offset = np.zeros(len(self.lag))

    def update(self, targets: np.ndarray, angles: np.ndarray, dt: float) -> np.ndarray:
        """Estimate the angles of now.

        Args:
            targets: What the servos have been told since the last update [rad]. Shape (n,).
            angles: Measured [rad]. Shape (n,).
            dt: Time since then [s].

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
    """The configuration that the arms hang on, with the joints of stiff servos filtered.

    Args:
        morphology: The robot; says whether its body is on stiff servos.
        model: Any model of it, to find the joints.
    """

    def __init__(self, morphology: Morphology, model: mujoco.MjModel) -> None:
        effects = morphology.effects if morphology.servos else ()
        held = [i for i, effect in enumerate(effects) if effect.acts is Acts.JOINT]
        self._entries = np.array(held, dtype=int)
        joints = [model.joint(effects[i].joint) for i in held]
        self._address = np.array([int(joint.qposadr[0]) for joint in joints], dtype=int)
        self._filter = ServoFilter(np.array([effects[i].lag_s for i in held]))

    def reset(self) -> None:
        """Start anew from the next configuration."""
        self._filter.reset()

    def update(self, qpos: np.ndarray, command: np.ndarray, dt: float) -> np.ndarray:
        """Return the configuration of now.

        Args:
            qpos: As measured. Shape (nq,).
            command: Command that is executed. Shape (k,).
            dt: Time since the last update [s].
        """
        if not len(self._address):
            return qpos
        steady = qpos.copy()
        angles = qpos[self._address]
        steady[self._address] = self._filter.update(command[self._entries], angles, dt)
        return steady


BIAS_TIME = 1.5
"""Time in which offsets of the arms are learned [s]. With 0.5 s the arms of G1, which are soft,
swing a box that they hold between them."""
PRESSING = (5.0, 15.0)
"""Force of a hand from which its arm's offsets are learned more slowly, and no more [N]. What a
hand presses against keeps it from its goal; taken for an offset, the press would grow until
`max_bias`, to 100 N with G1, and bend wrists and whole robot aside."""


class ArmDriver:
    """Computes arm targets, and knows the last ones so that they go on without a step.

    Arms of which the plan decides a joint are left out of the inverse kinematics. When that
    changes, when somebody else has driven the arms, and at an engagement, it starts anew from
    the targets that are executed.

    Args:
        morphology: The robot.
        holds_place: Whether the body is brought to where its goal is (`Retargeter.holds_place`).
        arm_limits: Angles that the robot's low-level policy keeps arm joints within [rad].
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
        """Start anew from the executed targets at the next tick."""
        self._wanted = self._sent = np.zeros(0)
        self._decided: frozenset[str] = frozenset()

    def note(self, arms: np.ndarray) -> None:
        """Take down the targets that were sent. Shape (m,)."""
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
            state: The robot now.
            goal: Goals of the wrists and how far the hands are closed.
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
        # What the encoders of the body tremble by, the hands would make up for in earnest.
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
        # The plan's prediction has the offset of the low-level policy in it.
        targets = np.where(planned, wanted, self.bias.compute_targets(wanted))
        return np.concatenate([targets, self.compute_grippers(goal)])

    def _find_wrists(
        self, goal: Goal, head: np.ndarray, body: np.ndarray, dt: float
    ) -> dict[str, np.ndarray]:
        """Where the wrists shall be in the world. Shapes (7,)."""
        goals = self._find_ik_goals(goal)
        hands = [arm.frame for arm in self.morphology.arms if arm.frame in goals]
        if len(hands) != 2:  # a left and a right hand
            return compute_wrist_goals(goals, head)
        left, right = hands
        walking = goal.mode is Mode.MOBILE
        self.hold.update(self.load.force, goals[right][:3] - goals[left][:3])
        self.giving.update(self.hold.squeeze, dt)
        if not self.holds_place or (self.hold.is_holding and walking):
            # What is carried goes with the body, however far that is from its goal: arms that
            # stretch aside shear what is between them.
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
        """How freely each joint's arm moves, from 1 down to 0 for one that presses. Shape (n,)."""
        freedom = np.ones(self.ik.num_joints)
        gentle, hard = PRESSING
        for part, force in zip(self.load.parts, self.load.force, strict=True):
            freedom[part] = np.clip((hard - np.linalg.norm(force)) / (hard - gentle), 0, 1)
        return freedom

    def _find_ik_goals(self, goal: Goal) -> dict[str, np.ndarray]:
        """Goals without those of the arms that the plan decides."""
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
