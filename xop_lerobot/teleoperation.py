"""From the operator to the robot: device, alignment, retargeter and arm kinematics in one."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.errors import XopError
from xop_lerobot.core.state import FRAMES, Goal, RobotState
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.limits import limit_action
from xop_lerobot.morphology.reach import compute_forward_reach
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.operator.alignment import Alignment, AlignmentConfig
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.operator.display import Cue, Display, NoticeBoard, Progress, RecordingRequest
from xop_lerobot.operator.engagement import Clutch, Engagement
from xop_lerobot.operator.feedback import list_warnings, tell_changes
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import GestureConfig, Hands, explain_gestures, grip_from_pinch
from xop_lerobot.operator.goal import GoalVelocity, HandBlend
from xop_lerobot.operator.raised_hands import HOLDING
from xop_lerobot.plant.watch import MOVES
from xop_lerobot.retarget.arms.driver import ArmDriver
from xop_lerobot.retarget.changes import Change, Settings, make_toggle, parse_change
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.costs.collision import Obstacle, make_obstacles
from xop_lerobot.retarget.factory import make_retargeter, warn_of_obstacles, warn_of_scene
from xop_lerobot.retarget.model.kinematics import SiteKinematics
from xop_lerobot.retarget.obstacles import load_obstacles
from xop_lerobot.retarget.online import AppliedChange, OnlineSettings
from xop_lerobot.retarget.plan_follower import PlanFollower
from xop_lerobot.retarget.presets import build_configs
from xop_lerobot.retarget.smoothing import CommandSmoother
from xop_lerobot.retarget.sync.state_sync import StateSync, Synced
from xop_lerobot.session import RobotInfo, Tick

RETREAT_RATE = 1.0
"""Speed at which arms in trouble go back to rest [rad/s]."""


@dataclass
class TeleoperationConfig:
    """What a teleoperation is made of.

    Attributes:
        device: Where the operator's motion comes from.
        alignment: How it is laid on the robot.
        retargeter: How goals become commands.
        gestures: What the operator's pinches do.
    """

    device: DeviceConfig = field(default_factory=DeviceConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    retargeter: RetargeterConfig = field(default_factory=RetargeterConfig)
    gestures: GestureConfig = field(default_factory=GestureConfig)


class Teleoperation:
    """One operator drives one robot: `step` turns a robot state into an action.

    While nobody is engaged (`Engagement`), the robot is asked to hold the posture it is in; the
    next engagement aligns anew, so no command ever makes a step. `change` changes settings
    meanwhile. What the operator asks of the recording is there in `take_requests`, and the answer
    is given with `answer`.

    Args:
        config: Its parts.
        info: The robot.
    """

    def __init__(self, config: TeleoperationConfig, info: RobotInfo) -> None:
        policy = make_policy(info.low_level, info.low_level_path)
        self.config, self.info, self.morphology = config, info, info.morphology.fit(policy)
        self.dt = 1 / info.fps
        device = make_device(config.device)
        device.introduce(info.name, explain_gestures(config.gestures))
        self._settings = OnlineSettings(self.morphology, config.retargeter)
        model = build_model(self.morphology, "planning", scene=info.scene)
        obstacles: tuple[Obstacle, ...] | None = None
        if self.morphology.hull_points:  # the planning model holds the floor alone
            scene = build_model(self.morphology, "full", scene=info.scene)
            obstacles = make_obstacles(scene)
        warn_of_scene(config.retargeter.type, self.morphology, info.scene)
        self.retargeter = make_retargeter(
            config.retargeter, self.morphology, policy, model, obstacles
        )
        self._follower = PlanFollower(
            self.retargeter, self.morphology, self.dt, realtime=info.realtime
        )
        self._velocity = GoalVelocity()
        has_person = not device.self_engaging
        self._hands = Hands(config.gestures, has_person=has_person)
        self._has_person = has_person
        self._blend = HandBlend()
        self._board = NoticeBoard()
        reach = None
        if config.alignment.arm_reach is not None:
            reach = compute_forward_reach(self.morphology, model)
        self._engagement = Engagement(
            device,
            Alignment(config.alignment),
            Clutch(config.gestures.clutch) if has_person else None,
            self._board,
            robot_reach=reach,
            begin=self._begin_engagement,
            end=self._end_engagement,
        )
        self._sync = StateSync(self.morphology, model) if config.retargeter.sync else None
        self._kinematics = SiteKinematics(model, tuple(self.morphology.frames.values()))
        self._arm_limits = policy.arm_limits
        self._arms = ArmDriver(
            self.morphology,
            holds_place=self.retargeter.holds_place,
            arm_limits=policy.arm_limits,
        )
        self._smoother = CommandSmoother(self.morphology.command_space, self.dt)
        self._start_over()

    def _start_over(self) -> None:
        self._engagement.reset()
        self._velocity.reset()
        self._hands.reset()
        self._requests: deque[RecordingRequest] = deque(maxlen=8)
        self._smoother.reset()
        if self._sync is not None:
            self._sync.reset()
        self._mode = self.device.start_mode
        self._device_mode = self._overruled_mode = None
        self._arms.forget()
        self._follower.forget()
        self._last_time: float | None = None
        self._trouble = ""
        self._shown: Display | None = None

    def connect(self) -> None:
        """Open the device; a recording is read and checked here."""
        self.device.connect()

    def disconnect(self) -> None:
        """Close the device and stop the threads; may be called twice."""
        self.device.disconnect()
        self._follower.close()

    def reset(
        self, obstacles: tuple[Obstacle, ...] | None = None, episode: int | None = None
    ) -> None:
        """Start over, as after a reset of the robot: nobody is engaged, no plan is known.

        Args:
            obstacles: What stands around the robot now; None where that has not changed.
            episode: Which episode of a session begins; None where there are none.
        """
        self.set_obstacles(obstacles)
        if episode is not None:
            self.device.begin_episode(episode)
        self._start_over()

    def set_obstacles(self, obstacles: tuple[Obstacle, ...] | None) -> None:
        """Take other walls and furniture, from the next solve on; None changes nothing.

        Those of the retargeter's own file of obstacles stay.
        """
        if obstacles is None:
            return
        kind, scene = self.config.retargeter.type, self.info.scene
        warn_of_obstacles(kind, self.morphology, scene, len(obstacles))
        if not self.morphology.hull_points:
            return
        path = self.config.retargeter.obstacles
        self._follower.set_obstacles(obstacles + (load_obstacles(path) if path else ()))

    def change(self, change: Change | Mapping[str, Any], source: str = "call") -> dict[str, Any]:
        """Ask for other settings, from any thread; they hold from the next `step` on.

        All of the change comes into force at once, or none: what is wrong with it is raised
        here. Commands go on from where they are, within their limits.

        Args:
            change: The change, or its JSON form (`parse_change`).
            source: Who asks, for the record.

        Returns:
            The settings that will be in force, as JSON knows them.

        Raises:
            UnknownName: If it names something that is not there; lists what is.
            BadValue: If a value is of the wrong kind or out of its range.
        """
        if not isinstance(change, Change):
            change = parse_change(change)
        return self._settings.request(change, source).to_dict()

    def toggle(self, name: str, source: str = "call") -> dict[str, Any]:
        """Toggle the mode (`mode`), a constraint, or a preset against `default`, as `change`.

        Raises:
            UnknownName: If `name` is none of these, or the robot lacks it.
            BadValue: If the result would not be valid.
        """
        return self._settings.request_from(self._make_toggle(name), source).to_dict()

    def _make_toggle(self, name: str) -> Callable[[Settings], Change]:
        if name == "mode":
            return lambda _: Change(mode=Mode(1 - self._mode))
        return lambda settings: make_toggle(name, settings)

    @property
    def settings(self) -> dict[str, Any]:
        """What is in force, and the mode, as JSON knows them."""
        return {**self._settings.current.to_dict(), "mode": self._mode.name.lower()}

    def show(self, progress: Progress | None) -> None:
        """Show the operator what `step` has made of the tick.

        Args:
            progress: How far the recording is, None where nothing is recorded.
        """
        if self._shown is None:
            return
        shown, notices = self._shown, self._board.notices
        self.device.show(dataclasses.replace(shown, notices=notices, progress=progress))

    def take_requests(self) -> tuple[RecordingRequest, ...]:
        """What the operator asks of the recording since the last call, by gestures or buttons."""
        requests = tuple(self._requests)
        self._requests.clear()
        return (*requests, *self.device.take_requests())

    def answer(self, cue: Cue, text: str) -> None:
        """Tell the operator what has become of a request."""
        self._board.tell(cue, text)

    @property
    def alignment(self) -> Alignment:
        """How the operator is laid on the robot."""
        return self._engagement.alignment

    @alignment.setter
    def alignment(self, alignment: Alignment) -> None:
        self._engagement.alignment = alignment

    @property
    def device(self) -> Device:
        """Where the operator's motion comes from."""
        return self._engagement.device

    @device.setter
    def device(self, device: Device) -> None:
        self._engagement.device = device

    def step(self, tick: Tick) -> tuple[RobotAction, Tick]:
        """Decide what the robot does next.

        Args:
            tick: The robot now, as observed; its view, if there is one, is shown to the operator.

        Returns:
            The action, limited as the robot will limit it, and the tick with what was decided.

        Raises:
            EngageRefused: If a device that engages by itself cannot, the first time: the floor
                of its recording is wrong, and no robot has moved yet. Later on the robot holds.
        """
        time = tick.state.time
        dt = self.dt if self._last_time is None else max(time - self._last_time, 0.0)
        self._last_time = time
        if tick.view is not None:
            self.device.see(dataclasses.replace(tick.view, engaged=self.alignment.is_engaged))
        changes = self._apply_changes()
        state, synced = self._synchronise(tick.state)
        poses = self._compute_frames(state)
        frame = self.device.read(state.time)
        self._tell_trouble(state)
        frame = self._engagement.follow(state, frame, poses)
        mode = self._mode
        self._read_gestures(frame)
        if frame is not None:
            self._follow_mode(frame)
        if self._mode is not mode:
            source = "gesture" if frame is None or frame.mode is None else "device"
            changes = (*changes, AppliedChange(source, Change(mode=self._mode)))
        tell_changes(self._board, changes)
        freed = poses if any(each.change.constraints for each in changes) else None
        goal = None if frame is None else self._make_goal(state, frame, freed)
        if goal is None:
            wanted = self._hold(state)
        else:
            wanted = self._drive(state, goal, poses["head"], dt)
        action = self._limit(state, wanted)
        tick = dataclasses.replace(
            tick,
            frame=frame,
            goal=goal,
            command=wanted.command,
            finished=self.device.is_finished(time),
            estimate=None if synced is None else synced.qpos,
            settings=self.settings,
            changes=changes,
            **self._describe_plan(time, synced, engaged=goal is not None),
        )
        self._shown = self._make_display(state, tick)
        return action, tick

    def _make_display(self, state: RobotState, tick: Tick) -> Display:
        engaged = tick.engaged
        holding, progress = self._describe_hold(engaged)
        current = self._follower.current if engaged else None
        age = None if current is None else state.time - current.measured
        return Display(
            time=state.time,
            engaged=engaged,
            mode=self._mode,
            clutch=progress,
            holding=holding,
            warnings=list_warnings(
                self.device, tick.frame, engaged=engaged, plan_age=age, trouble=state.trouble
            ),
            fallen=state.fallen,
            pictures=tick.pictures,
        )

    def _apply_changes(self) -> tuple[AppliedChange, ...]:
        """Put into force what was asked for since the last tick."""
        changes = self._settings.take()
        for each in changes:
            if each.change.mode is not None:
                self._mode, self._overruled_mode = each.change.mode, self._device_mode
        if any(each.change.to_dict().keys() - {"mode"} for each in changes):
            settings = self._settings.current
            self._follower.configure(
                configs=build_configs(self.morphology, self.config.retargeter, settings),
                targets=settings.targets,
                body=settings.body,
                constraints=settings.constraints,
            )
        return changes

    def _synchronise(self, state: RobotState) -> tuple[RobotState, Synced | None]:
        """Put the measured state in accordance with the ground; the truth stays beside it."""
        if self._sync is None:
            return state, None
        expected = self._follower.predict_velocity(state.time, self._sync.time)
        synced = self._sync.synchronise(state.time, state.qpos, state.qvel, state.mode, expected)
        return dataclasses.replace(state, qpos=synced.qpos, qvel=synced.qvel), synced

    def _compute_frames(self, state: RobotState) -> dict[str, np.ndarray]:
        """Pose of each tracked frame of the robot, as measured. Shapes (7,)."""
        poses = self._kinematics.compute_poses(state.qpos)
        return {name: poses[site] for name, site in self.morphology.frames.items()}

    @property
    def notice(self) -> str:
        """What the operator was told last; empty if nothing was."""
        notices = self._board.notices
        return notices[-1].text if notices else ""

    def _begin_engagement(self, state: RobotState, poses: Mapping[str, np.ndarray]) -> None:
        self._arms.forget()
        self._velocity.reset()
        self._blend.reset()
        if self._has_person:
            self._blend.engage(poses["head"], poses)
        self._follower.reset(state)

    def _end_engagement(self) -> None:
        self._follower.forget()

    def _tell_trouble(self, state: RobotState) -> None:
        """Tell what the robot has begun to do that it was not told to."""
        if state.trouble and state.trouble != self._trouble:
            text = state.trouble[:1].upper() + state.trouble[1:]
            ends = "Disengaged: it" if self.alignment.is_engaged else "It"
            does = "stands, its arms go back to rest" if state.trouble == MOVES else "holds"
            self._board.tell(Cue.DISENGAGED, f"{text}. {ends} {does}.")
        self._trouble = state.trouble

    def _describe_hold(self, engaged: bool) -> tuple[str, float]:
        """What the gesture that is held will do, in words, and how much of it has passed."""
        raised = self._hands.raised
        if raised.request is not None:
            return HOLDING[raised.request], raised.progress
        progress = self._engagement.progress
        if progress <= 0:
            return "", 0.0
        return f"Hold on to {'let go' if engaged else 'engage'}", progress

    def _read_gestures(self, frame: OperatorFrame | None) -> None:
        """Do what the operator's hands say, whether the operator drives or not."""
        asked = self._hands.read(frame)
        self._requests += asked.requests
        if asked.mode:
            self._mode = Mode(1 - self._mode)
        if asked.toggle:
            try:
                self.toggle(asked.toggle, "gesture")
            except XopError as refusal:
                self._board.tell(Cue.REFUSED, f"Not toggled: {refusal}")

    def _make_goal(
        self,
        state: RobotState,
        frame: OperatorFrame,
        freed: Mapping[str, np.ndarray] | None = None,
    ) -> Goal | None:
        """The goal of the tick; hands go to it slowly from the poses `freed`, if there are any."""
        if not self.alignment.is_engaged:
            return None
        goals = self.alignment.goal_poses(frame)
        if freed is not None:  # what a constraint has kept from its goal shall not jump there
            self._blend.engage(goals["head"], freed)
        # A lost hand of a recording stays as the recording shows it.
        seen = frame.tracked if self._has_person else np.ones(len(FRAMES), dtype=bool)
        goals = self._blend.apply(state.time, goals, seen)
        velocities = self._velocity.update(state.time, goals)
        return Goal(goals, velocities, self._mode, grip_from_pinch(frame.pinch))

    def _follow_mode(self, frame: OperatorFrame) -> None:
        """Take the mode that the device itself states, if it states one."""
        if frame.mode is not None and frame.mode is not self._overruled_mode:
            self._mode, self._overruled_mode = frame.mode, None
        self._device_mode = frame.mode

    def _hold(self, state: RobotState) -> RobotAction:
        """Stand where and as the robot stands: velocities stop, the posture stays.

        If it moves all the same, the arms are the cause: there are postures in which a low-level
        policy walks off. They go back to rest then, slowly.
        """
        command = self.morphology.command_space.compute_rest(state.command, state.mode)
        arms = state.arms
        if state.trouble == MOVES:
            reach = RETREAT_RATE * self.dt
            arms = arms + np.clip(self.morphology.rest_action().arms - arms, -reach, reach)
        return RobotAction(command, Mode.STATIONARY, arms)

    def _drive(self, state: RobotState, goal: Goal, head: np.ndarray, dt: float) -> RobotAction:
        self._follower.update(state, goal)
        current = self._follower.current
        decided = current.get_arms(state.time) if current is not None else {}
        arms = self._arms.compute(state, goal, head, decided, dt)
        if current is None:  # the background planner is still at its first one
            return RobotAction(self._hold(state).command, goal.mode, arms)
        command = current.get_command(state.time, self.morphology.command_space)
        return RobotAction(command, goal.mode, arms)

    def _limit(self, state: RobotState, wanted: RobotAction) -> RobotAction:
        """What the robot will execute: bounds, rates and changes of rate, as it limits too."""
        command, mode = self._smoother.smooth(
            wanted.command, wanted.mode, state.command, state.mode
        )
        previous = RobotAction(state.command, state.mode, state.arms)
        smooth = RobotAction(command, mode, wanted.arms)
        action = limit_action(self.morphology, smooth, previous, self.dt, self._arm_limits)
        self._smoother.note(state.command, action.command)
        self._arms.note(action.arms)
        return action

    def _describe_plan(
        self, time: float, synced: Synced | None, *, engaged: bool
    ) -> dict[str, dict[str, float]]:
        """Cost and health of the plan that is followed."""
        current = self._follower.current if engaged else None
        cost: dict[str, float] = {}
        health: dict[str, float] = {}
        if synced is not None:
            health = {"sync_residual": synced.residual, "sync_status": float(synced.status)}
        if current is not None:
            plan = current.plan
            cost = dict(plan.cost)
            health |= {
                "solve_time": plan.timings.get("solve", 0.0),
                "plan_age": time - current.measured,
                "effective_samples": plan.effective_samples,
                "status": float(plan.status),
                **plan.health,
            }
        return {"cost": {**cost, "total": sum(cost.values())}, "health": health}
