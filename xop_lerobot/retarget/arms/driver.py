"""Arms and grippers of one tick: by inverse kinematics, or as the plan has decided."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import FRAMES, Goal, RobotState
from xop_lerobot.core.transforms import make_pose, quat_from_matrix
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.arms.bias import ArmBias
from xop_lerobot.retarget.arms.hold import ArmHold
from xop_lerobot.retarget.arms.ik import ARM_MAX_DT, ARM_MAX_RATE, ArmIk
from xop_lerobot.retarget.arms.load import ArmLoad
from xop_lerobot.retarget.arms.servo_filter import SteadyBody
from xop_lerobot.retarget.arms.wrist_goals import compute_wrist_goals
from xop_lerobot.retarget.arms.yielding import ArmYield

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
