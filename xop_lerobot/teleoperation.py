"""From the operator to the robot: device, alignment, retargeter and arm kinematics in one."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from xop_lerobot.command import Mode, RobotAction
from xop_lerobot.link import RobotInfo, TickRecord
from xop_lerobot.low_level.policy import POLICY_DT, make_policy
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.operator.alignment import Alignment, AlignmentConfig, EngageRefused, is_lost
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import DoublePinchDetector, grip_from_pinch
from xop_lerobot.operator.goal_velocity import GoalVelocity
from xop_lerobot.plant.policy_loop import limit_action
from xop_lerobot.retarget.arm_bias import ArmBias
from xop_lerobot.retarget.arm_ik import ArmIk
from xop_lerobot.retarget.background import BackgroundPlanner
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.costs.collision import Obstacle, make_obstacles
from xop_lerobot.retarget.factory import make_retargeter
from xop_lerobot.retarget.kinematics import SiteKinematics
from xop_lerobot.retarget.plan import Plan
from xop_lerobot.retarget.wrist_goals import compute_wrist_goals
from xop_lerobot.state import FRAMES, Goal, RobotState

logger = logging.getLogger(__name__)


@dataclass
class TeleoperationConfig:
    """What a teleoperation is made of.

    Attributes:
        device: Where the operator's motion comes from.
        alignment: How it is laid on the robot.
        retargeter: How goals become commands.
    """

    device: DeviceConfig = field(default_factory=DeviceConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    retargeter: RetargeterConfig = field(default_factory=RetargeterConfig)


class Teleoperation:
    """One operator drives one robot: `step` turns a robot state into an action.

    While nobody is engaged, the robot is asked to hold the posture it is in. A device that
    engages by itself does so as soon as the robot has settled; loss of the head's tracking ends
    an engagement, and the next one aligns anew, so no command ever makes a step. A fall ends it
    too, and nobody engages while the robot counts as fallen.

    Args:
        config: Its parts.
        info: The robot.
    """

    def __init__(self, config: TeleoperationConfig, info: RobotInfo) -> None:
        self.info, self.morphology = info, info.morphology
        self.dt = 1 / info.fps
        self.device = make_device(config.device)
        model = build_model(self.morphology, "planning", scene=info.scene)
        policy = make_policy(info.low_level, info.low_level_path)
        obstacles: tuple[Obstacle, ...] | None = None
        if self.morphology.hull_points:  # the planning model holds the floor alone
            scene = build_model(self.morphology, "full", scene=info.scene)
            obstacles = make_obstacles(scene)
        self.retargeter = make_retargeter(
            config.retargeter, self.morphology, policy, model, obstacles
        )
        self.alignment = Alignment(config.alignment)
        self._velocity = GoalVelocity()
        self._pinch = DoublePinchDetector()
        self._kinematics = SiteKinematics(model, tuple(self.morphology.frames.values()))
        self._arm_ik = ArmIk(self.morphology)
        self._arm_bias = ArmBias(self._arm_ik.joint_range)
        self._was_engaged = False
        self._background = BackgroundPlanner(self.retargeter) if info.realtime else None
        self._start_over()

    def _start_over(self) -> None:
        self.alignment.disengage()
        self._velocity.reset()
        self._pinch.reset()
        self._mode = self.device.start_mode
        self._started = self._was_refused = False
        self._forget_arms()
        self._plan: Plan | None = None
        self._plan_time = self._asked_time = -np.inf
        self._last_time: float | None = None

    def _forget_arms(self) -> None:
        """Start the arms anew from the targets that the robot executes."""
        self._wanted_arms = self._sent_arms = np.zeros(0)

    def connect(self) -> None:
        """Open the device; a recording is read and checked here."""
        self.device.connect()

    def disconnect(self) -> None:
        """Close the device and stop the threads; may be called twice."""
        self.device.disconnect()
        if self._background is not None:
            self._background.close()
        self.retargeter.close()

    def reset(self) -> None:
        """Start over, as after a reset of the robot: nobody is engaged, no plan is known."""
        self._start_over()

    def step(self, state: RobotState) -> tuple[RobotAction, TickRecord]:
        """Decide what the robot does next.

        Args:
            state: The robot now.

        Returns:
            The action, limited as the robot will limit it, and the record of the tick.

        Raises:
            EngageRefused: If a device that engages by itself cannot, the first time: the floor
                of its recording is wrong, and no robot has moved yet. Later on the robot holds.
        """
        dt = self.dt if self._last_time is None else max(state.time - self._last_time, 0.0)
        self._last_time = state.time
        poses = self._compute_frames(state)
        frame = self.device.read(state.time)
        frame = self._follow_engagement(state, frame, poses)
        goal = self._make_goal(state, frame) if frame is not None else None
        if goal is None:
            wanted = self._hold(state)
        else:
            wanted = self._drive(state, goal, poses["head"], dt)
        previous = RobotAction(state.command, state.mode, state.arms)
        action = limit_action(self.morphology, wanted, previous, self.dt)
        self._sent_arms = action.arms[: self._arm_ik.num_joints]
        return action, self._make_record(state, frame, goal, wanted)

    def _compute_frames(self, state: RobotState) -> dict[str, np.ndarray]:
        """Pose of each tracked frame of the robot, as measured. Shapes (7,)."""
        poses = self._kinematics.compute_poses(state.qpos)
        return {name: poses[site] for name, site in self.morphology.frames.items()}

    def _follow_engagement(
        self, state: RobotState, frame: OperatorFrame | None, poses: Mapping[str, np.ndarray]
    ) -> OperatorFrame | None:
        """Engage or disengage where it is time to; return the frame to use."""
        if self.alignment.is_engaged:
            if frame is None or is_lost(frame) or state.fallen:
                self.disengage()
            return frame
        if not self.device.self_engaging or not state.settled or state.fallen:
            return frame
        if not self._started:
            self.device.start(state.time)
            self._started = True
            frame = self.device.read(state.time)
        if frame is not None and not is_lost(frame):
            self._engage_itself(state, frame, poses)
        return frame

    def _engage_itself(
        self, state: RobotState, frame: OperatorFrame, poses: Mapping[str, np.ndarray]
    ) -> None:
        """Engage; a refusal is a fault of the set-up at first, and waited out later on."""
        try:
            self.engage(state, frame, poses)
        except EngageRefused as refusal:
            if not self._was_engaged:
                raise
            if not self._was_refused:
                logger.warning("%s The robot holds.", refusal)
            self._was_refused = True

    def engage(
        self, state: RobotState, frame: OperatorFrame, poses: Mapping[str, np.ndarray]
    ) -> None:
        """Lay the operator on the robot and begin to drive it.

        Raises:
            EngageRefused: If the head is not tracked, or is too low to be over the floor.
        """
        self.alignment.engage(frame, poses, float(poses["head"][2]))
        self._was_engaged, self._was_refused = True, False
        self._forget_arms()
        self._velocity.reset()
        (self._background or self.retargeter).reset(state)
        self._plan = None

    def disengage(self) -> None:
        """Stop driving; the robot holds."""
        self.alignment.disengage()
        self._plan = None

    def _make_goal(self, state: RobotState, frame: OperatorFrame) -> Goal | None:
        if self._pinch.update(frame):
            self._mode = Mode(1 - self._mode)
        if frame.mode is not None:
            self._mode = frame.mode
        if not self.alignment.is_engaged:
            return None
        goals = self.alignment.goal_poses(frame)
        velocities = self._velocity.update(state.time, goals)
        return Goal(goals, velocities, self._mode, grip_from_pinch(frame.pinch))

    def _hold(self, state: RobotState) -> RobotAction:
        """Stand where and as the robot stands: velocities stop, the posture stays."""
        space = self.morphology.command_space
        command = np.where(space.mobile_only, space.neutral, state.command)
        return RobotAction(command, Mode.STATIONARY, state.arms)

    def _drive(self, state: RobotState, goal: Goal, head: np.ndarray, dt: float) -> RobotAction:
        self._update_plan(state, goal)
        arms = state.arms.copy()
        wrists = compute_wrist_goals(goal.poses, head)
        num_joints = self._arm_ik.num_joints
        arms[:num_joints] = self._drive_arms(state, wrists, dt)
        arms[num_joints:] = self._compute_grippers(goal)
        if self._plan is None:  # the background planner is still at its first one
            return RobotAction(self._hold(state).command, goal.mode, arms)
        return RobotAction(self._pick_command(self._plan, state.time), goal.mode, arms)

    def _drive_arms(
        self, state: RobotState, wrists: Mapping[str, np.ndarray], dt: float
    ) -> np.ndarray:
        """Arm targets [rad] that bring the wrists to their goals. Shape (num_joints,)."""
        ik, bias = self._arm_ik, self._arm_bias
        executed = state.arms[: ik.num_joints]
        if not np.array_equal(executed, self._sent_arms):  # new, or somebody else drove the arms
            self._wanted_arms = executed
            bias.reset()
        last, self._wanted_arms = (
            self._wanted_arms,
            ik.solve(state.qpos, self._wanted_arms, wrists, dt),
        )
        offset = state.qpos[ik.qpos_address] - executed
        bias.update(offset, self._wanted_arms - last, dt)
        return bias.compute_targets(self._wanted_arms)

    def _update_plan(self, state: RobotState, goal: Goal) -> None:
        """Plan where it is due; on the wall clock, ask for it and take the newest there is."""
        late = self._plan is None or self._plan.mode is not goal.mode
        period = self.retargeter.control_period(goal.mode)
        # Half a tick early is closer than half a tick late.
        if self._background is None:
            if late or state.time - self._plan_time >= period - self.dt / 2:
                self._plan, self._plan_time = self.retargeter.plan(state, goal), state.time
            return
        if late or state.time - self._asked_time >= period - self.dt / 2:
            self._background.submit(state, goal)
            self._asked_time = state.time
        if (latest := self._background.latest) is not None:
            self._plan, self._plan_time = latest

    def _pick_command(self, plan: Plan, time: float) -> np.ndarray:
        """The plan's command for `time`; past its end the last one. Shape (k,)."""
        step = max(0, round((time - self._plan_time) / POLICY_DT))
        return plan.commands[min(step, len(plan.commands) - 1)]

    def _compute_grippers(self, goal: Goal) -> np.ndarray:
        """Openings of the grippers [m], in the order of `arms`."""
        grips: dict[str, float] = dict(zip(FRAMES[1:], goal.grips, strict=True))
        openings = []
        for arm in self.morphology.arms:
            if arm.gripper:
                closed, opened = arm.gripper_range
                openings.append(opened + grips.get(arm.frame, 0.0) * (closed - opened))
        return np.array(openings)

    def _make_record(
        self,
        state: RobotState,
        frame: OperatorFrame | None,
        goal: Goal | None,
        wanted: RobotAction,
    ) -> TickRecord:
        plan = self._plan if goal is not None else None
        cost = dict(plan.cost) if plan else {}
        health = {}
        if plan is not None:
            health = {
                "solve_time": plan.timings.get("solve", 0.0),
                "plan_age": state.time - self._plan_time,
                "effective_samples": plan.effective_samples,
            }
        return TickRecord(
            state=state,
            frame=frame,
            goal=goal,
            engaged=goal is not None,
            command=wanted.command,
            cost={**cost, "total": sum(cost.values())},
            health=health,
            finished=self.device.is_finished(state.time),
        )
