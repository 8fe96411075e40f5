"""The action of one control tick: plan and arm inverse kinematics, within the robot's limits."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.low_level.policy import LowLevelPolicy
from xop_lerobot.morphology.limits import limit_action
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.arms.driver import ArmDriver
from xop_lerobot.retarget.plan_follower import PlanFollower
from xop_lerobot.retarget.smoothing import CommandSmoother

RETREAT_RATE = 1.0
"""Speed at which arms return to their rest posture when the robot will not stand still [rad/s]."""


class WholeBodyController:
    """Computes the actions that drive a robot or hold it in place.

    Per tick, `hold` or `drive` gives the desired action, `limit` the one that is executed.

    Args:
        morphology: The robot.
        policy: Its low-level policy.
        follower: Provides the plan in force.
        dt: Control period [s].

    Attributes:
        arms: Inverse kinematics of the arms.
    """

    def __init__(
        self, morphology: Morphology, policy: LowLevelPolicy, follower: PlanFollower, dt: float
    ) -> None:
        self._morphology, self._follower, self._dt = morphology, follower, dt
        self._arm_limits = policy.arm_limits
        self.arms = ArmDriver(
            morphology,
            holds_place=follower.retargeter.holds_place,
            arm_limits=policy.arm_limits,
        )
        self._smoother = CommandSmoother(morphology.command_space, dt)

    def reset(self) -> None:
        """Forget the executed actions."""
        self._smoother.reset()
        self.arms.forget()

    def hold(self, state: RobotState, *, retreats: bool) -> RobotAction:
        """Hold in place: velocities stop, the posture stays.

        Args:
            state: Present state of the robot.
            retreats: Whether the arms slowly return to their rest posture. If a holding robot
                moves, they are the cause: in some arm postures a low-level policy walks off.
        """
        command = self._morphology.command_space.compute_rest(state.command, state.mode)
        arms = state.arms
        if retreats:
            reach = RETREAT_RATE * self._dt
            arms = arms + np.clip(self._morphology.rest_action().arms - arms, -reach, reach)
        return RobotAction(command, Mode.STATIONARY, arms)

    def drive(self, state: RobotState, goal: Goal, head: np.ndarray, dt: float) -> RobotAction:
        """Follow the goal by plan and arm kinematics.

        Args:
            state: Present state of the robot.
            goal: Present goal.
            head: Pose of the robot's head. Shape (7,).
            dt: Time since the last tick [s].
        """
        self._follower.update(state, goal)
        current = self._follower.current
        decided = current.get_arms(state.time) if current is not None else {}
        arms = self.arms.compute(state, goal, head, decided, dt)
        space = self._morphology.command_space
        if current is None:  # the background planner is still at its first one
            command = space.compute_rest(state.command, state.mode)
        else:
            command = current.get_command(state.time, space)
        return RobotAction(command, goal.mode, arms)

    def limit(self, state: RobotState, wanted: RobotAction) -> RobotAction:
        """Limit an action to bounds, rates and accelerations; the robot applies the same limits."""
        command, mode = self._smoother.smooth(
            wanted.command, wanted.mode, state.command, state.mode
        )
        previous = RobotAction(state.command, state.mode, state.arms)
        smooth = RobotAction(command, mode, wanted.arms)
        action = limit_action(self._morphology, smooth, previous, self._dt, self._arm_limits)
        self._smoother.note(state.command, action.command)
        self.arms.note(action.arms)
        return action
