"""Teleoperation: from the operator's device to the robot's action, in one object."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from xop_lerobot.core.command import RobotAction
from xop_lerobot.core.errors import XopError
from xop_lerobot.core.state import RobotState
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.reach import compute_forward_reach
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.operator.alignment import Alignment, AlignmentConfig
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.operator.display import Cue, Progress, RecordingRequest
from xop_lerobot.operator.engagement import Clutch, Engagement
from xop_lerobot.operator.feedback import Feedback, tell_changes
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import GestureConfig, Hands, explain_gestures
from xop_lerobot.operator.goal import GoalMaker
from xop_lerobot.plant.watch import MOVES
from xop_lerobot.retarget.changes import Change, Settings, make_toggle, parse_change
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.costs.collision import Obstacle
from xop_lerobot.retarget.factory import (
    apply_settings,
    find_obstacles,
    gather_obstacles,
    make_retargeter,
    warn_of_scene,
)
from xop_lerobot.retarget.model.kinematics import SiteKinematics
from xop_lerobot.retarget.online import AppliedChange, ModeSwitch, OnlineSettings
from xop_lerobot.retarget.plan_follower import PlanFollower
from xop_lerobot.retarget.sync.prior import VelocityPrior
from xop_lerobot.retarget.sync.state_sync import StateSync, Synced
from xop_lerobot.retarget.whole_body import WholeBodyController
from xop_lerobot.session import RobotInfo, Tick


@dataclass
class TeleoperationConfig:
    """Configuration of a teleoperation.

    Attributes:
        device: Source of the operator's motion.
        alignment: Mapping from the operator to the robot.
        retargeter: Mapping from goals to commands.
        gestures: Meaning of the operator's pinches.
    """

    device: DeviceConfig = field(default_factory=DeviceConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    retargeter: RetargeterConfig = field(default_factory=RetargeterConfig)
    gestures: GestureConfig = field(default_factory=GestureConfig)


class Teleoperation:
    """One operator driving one robot: `step` turns a robot state into an action.

    While no operator is engaged (`Engagement`), the robot holds its posture; the next engagement
    aligns again, so no command ever jumps. `change` changes settings at runtime. Requests of the
    operator to the recorder are returned by `take_requests` and answered by `answer`.

    Args:
        config: Configuration.
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
        obstacles = find_obstacles(self.morphology, info.scene)
        warn_of_scene(config.retargeter.type, self.morphology, info.scene)
        self.retargeter = make_retargeter(
            config.retargeter, self.morphology, policy, model, obstacles
        )
        self._follower = PlanFollower(
            self.retargeter, self.morphology, self.dt, realtime=info.realtime
        )
        has_person = not device.self_engaging
        self._hands = Hands(config.gestures, has_person=has_person)
        self._goals = GoalMaker(has_person=has_person)
        self._feedback = Feedback()
        self._board = self._feedback.board
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
        self._prior = None
        if self._sync is not None and not self.morphology.contact_kind.tells_speed:
            self._prior = VelocityPrior(self.morphology, policy, model, self.dt)
        self._kinematics = SiteKinematics(model, tuple(self.morphology.frames.values()))
        self._driver = WholeBodyController(self.morphology, policy, self._follower, self.dt)
        self._arms = self._driver.arms
        self._start_over()

    def _start_over(self) -> None:
        self._engagement.reset()
        self._goals.reset()
        self._hands.reset()
        self._requests: deque[RecordingRequest] = deque(maxlen=8)
        self._driver.reset()
        if self._sync is not None:
            self._sync.reset()
        if self._prior is not None:
            self._prior.forget()
        self._mode = ModeSwitch(self.device.start_mode)
        self._follower.forget()
        self._last_time: float | None = None
        self._feedback.reset()

    def connect(self) -> None:
        """Open the device; a recording is read and checked here."""
        self.device.connect()

    def disconnect(self) -> None:
        """Close the device and stop all threads; may be called twice."""
        self.device.disconnect()
        self._follower.close()
        if self._prior is not None:
            self._prior.close()

    def reset(
        self, obstacles: tuple[Obstacle, ...] | None = None, episode: int | None = None
    ) -> None:
        """Start over after a reset of the robot: disengaged, without a plan.

        Args:
            obstacles: Obstacles around the robot, besides those of the retargeter's own file; None
                if unchanged.
            episode: Index of the episode that starts; None outside of episodes.
        """
        if obstacles is not None:
            config, scene = self.config.retargeter, self.info.scene
            known = gather_obstacles(config, self.morphology, scene, obstacles)
            if known is not None:
                self._follower.set_obstacles(known)
        if episode is not None:
            self.device.begin_episode(episode)
        self._start_over()

    def change(self, change: Change | Mapping[str, Any], source: str = "call") -> dict[str, Any]:
        """Request other settings, from any thread; they apply from the next `step` on.

        A change takes effect completely or not at all: an invalid one raises here. Commands
        continue from their present values, within their limits.

        Args:
            change: The change, or its JSON form (`parse_change`).
            source: Who requests it, for the record.

        Returns:
            The settings after the change, as plain values for JSON.

        Raises:
            UnknownName: If it names something unknown; lists the known names.
            BadValue: If a value has the wrong type or is out of range.
        """
        if not isinstance(change, Change):
            change = parse_change(change)
        return self._settings.request(change, source).to_dict()

    def toggle(self, name: str, source: str = "call") -> dict[str, Any]:
        """Toggle the mode (`mode`), a constraint, or a preset against `default`; see `change`.

        Raises:
            UnknownName: If `name` is none of these, or the robot lacks it.
            BadValue: If the result would be invalid.
        """

        def make(settings: Settings) -> Change:
            return Change(mode=self._mode.other) if name == "mode" else make_toggle(name, settings)

        return self._settings.request_from(make, source).to_dict()

    @property
    def settings(self) -> dict[str, Any]:
        """Current settings and mode, as plain values for JSON."""
        return {**self._settings.current.to_dict(), "mode": self._mode.mode.name.lower()}

    def show(self, progress: Progress | None) -> None:
        """Show the operator the result of `step`.

        Args:
            progress: Progress of the recording, None without one.
        """
        self._feedback.show(self.device, progress)

    def take_requests(self) -> tuple[RecordingRequest, ...]:
        """Return the operator's requests to the recorder since the last call."""
        requests = tuple(self._requests)
        self._requests.clear()
        return (*requests, *self.device.take_requests())

    def answer(self, cue: Cue, text: str) -> None:
        """Show the operator the answer to a request."""
        self._board.tell(cue, text)

    @property
    def alignment(self) -> Alignment:
        """Mapping from the operator to the robot."""
        return self._engagement.alignment

    @alignment.setter
    def alignment(self, alignment: Alignment) -> None:
        self._engagement.alignment = alignment

    @property
    def device(self) -> Device:
        """Source of the operator's motion."""
        return self._engagement.device

    @device.setter
    def device(self, device: Device) -> None:
        self._engagement.device = device

    def step(self, tick: Tick) -> tuple[RobotAction, Tick]:
        """Compute the robot's next action.

        Args:
            tick: The observed robot; its view, if any, is shown to the operator.

        Returns:
            The action after the robot's limits, and the tick with the decision.

        Raises:
            EngageRefused: If a self-engaging device cannot engage the first time: the floor of its
                recording is wrong, and no robot has moved yet. Later refusals make the robot hold.
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
        engaged, retreats = self.alignment.is_engaged, state.trouble == MOVES
        self._feedback.tell_trouble(state.trouble, engaged=engaged, retreats=retreats)
        frame = self._engagement.follow(state, frame, poses)
        changes = (*changes, *self._follow_mode(frame))
        tell_changes(self._board, changes)
        freed = poses if any(each.change.constraints for each in changes) else None
        goal = self._goals.make(time, frame, self.alignment, self._mode.mode, freed)
        if goal is None:
            wanted = self._driver.hold(state, retreats=retreats)
        else:
            wanted = self._driver.drive(state, goal, poses["head"], dt)
        action = self._driver.limit(state, wanted)
        if self._prior is not None:
            self._prior.note(state, action)
        plan = None if goal is None else self._follower.current
        cost = {} if plan is None else plan.plan.cost
        health = {} if synced is None else synced.health
        tick = dataclasses.replace(
            tick,
            frame=frame,
            goal=goal,
            command=wanted.command,
            cost={**cost, "total": sum(cost.values())},
            health={**health, **({} if plan is None else plan.compute_health(time))},
            finished=self.device.is_finished(time),
            estimate=None if synced is None else synced.qpos,
            settings=self.settings,
            changes=changes,
        )
        self._feedback.note(
            state,
            frame,
            self._engagement,
            self._hands.raised,
            mode=self._mode.mode,
            plan_age=None if plan is None else time - plan.measured,
            pictures=tick.pictures,
        )
        return action, tick

    def _apply_changes(self) -> tuple[AppliedChange, ...]:
        """Apply the requested changes since the last tick."""
        changes = self._settings.take()
        for each in changes:
            if each.change.mode is not None:
                self._mode.set(each.change.mode)
        if any(each.change.to_dict().keys() - {"mode"} for each in changes):
            settings = self._settings.current
            apply_settings(self._follower, self.morphology, self.config.retargeter, settings)
        return changes

    def _synchronise(self, state: RobotState) -> tuple[RobotState, Synced | None]:
        """Make the measured state consistent with the ground contacts; the true state is kept."""
        if self._sync is None:
            return state, None
        expected = None
        if self._prior is not None:
            expected = self._prior.predict(state.time, self._sync.time)
        synced = self._sync.synchronise(state.time, state.qpos, state.qvel, state.mode, expected)
        return dataclasses.replace(state, qpos=synced.qpos, qvel=synced.qvel), synced

    def _compute_frames(self, state: RobotState) -> dict[str, np.ndarray]:
        """Compute the measured pose of each tracked frame of the robot. Shapes (7,)."""
        poses = self._kinematics.compute_poses(state.qpos)
        return {name: poses[site] for name, site in self.morphology.frames.items()}

    @property
    def notice(self) -> str:
        """Latest notice for the operator; empty if there was none."""
        return self._feedback.notice

    def _begin_engagement(self, state: RobotState, poses: Mapping[str, np.ndarray]) -> None:
        self._arms.forget()
        self._goals.engage(poses)
        self._follower.reset(state)

    def _end_engagement(self) -> None:
        self._follower.forget()

    def _follow_mode(self, frame: OperatorFrame | None) -> tuple[AppliedChange, ...]:
        """Apply mode changes by gestures and device; return the change, if any."""
        before = self._mode.mode
        self._read_gestures(frame)
        if frame is not None:
            self._mode.follow(frame.mode)
        if self._mode.mode is before:
            return ()
        source = "gesture" if frame is None or frame.mode is None else "device"
        return (AppliedChange(source, Change(mode=self._mode.mode)),)

    def _read_gestures(self, frame: OperatorFrame | None) -> None:
        """Apply the gestures of the operator's hands, engaged or not."""
        asked = self._hands.read(frame)
        self._requests += asked.requests
        if asked.mode:
            self._mode.toggle()
        if asked.toggle:
            try:
                self.toggle(asked.toggle, "gesture")
            except XopError as refusal:
                self._board.tell(Cue.REFUSED, f"Not toggled: {refusal}")
