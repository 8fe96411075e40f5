"""The robots as LeRobot devices: whole-body commands to a low-level policy and a plant."""

from __future__ import annotations

import dataclasses
import weakref
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot.robots.robot import Robot

from lerobot_robot_xop.config_xop import (
    XopG1Config,
    XopRby1Config,
    XopRby1MConfig,
    XopRobotConfig,
)
from xop_lerobot.core.command_line import report_mistakes
from xop_lerobot.core.errors import NotConnected, UnknownName
from xop_lerobot.low_level.factory import make_policy, resolve_policy
from xop_lerobot.morphology.body import Body
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_scene_spec
from xop_lerobot.session import RobotInfo, Tick, get_session
from xop_lerobot.tasks.layout import add_task_camera
from xop_lerobot.tasks.task import make_task

if TYPE_CHECKING:
    from xop_lerobot.morphology.morphology import Morphology
    from xop_lerobot.plant.policy_loop import PolicyLoop
    from xop_lerobot.plant.realtime_loop import RealtimeLoop
    from xop_lerobot.plant.simulation import Simulation
    from xop_lerobot.tasks.stage import Stage


class XopRobot(Robot):
    """A robot driven by whole-body commands; subclasses differ only in their morphology.

    In lock-step only `send_action` advances time, by exactly 1/fps. At the start of each recorded
    episode, the next `get_observation` resets the robot, with a seed made of `config.seed` and the
    episode's index.

    Args:
        config: The robot's configuration.

    Raises:
        UnknownName: If there is no such policy for this robot, task, height, scene or camera.
        BadValue: If the task's heights are out of the robot's reach.
        PolicyFileError: If the policy's file is missing or malformed.
    """

    config_class = XopRobotConfig
    name = "xop_robot"

    def __init__(self, config: XopRobotConfig) -> None:
        super().__init__(config)
        report_mistakes()
        self.config = config
        self.morphology = make_morphology(config.morphology)
        _check_cameras(self.morphology, config)
        if config.task_heights:
            make_task(config.task, self.morphology, config.task_heights)
        policy_name = resolve_policy(self.morphology, config.low_level.name)
        self._policy = make_policy(policy_name, config.low_level.path)
        self.morphology = self.morphology.fit(self._policy)
        self._body = Body(self.morphology)
        self._session = get_session(config.session)
        self._plant: Simulation | None = None
        self._stage: Stage | None = None
        self._loop: PolicyLoop | RealtimeLoop | None = None
        self._info = RobotInfo(
            name=self.name,
            morphology=self.morphology,
            low_level=policy_name,
            low_level_path=config.low_level.path,
            scene=config.scene,
            fps=config.fps,
            seed=config.seed,
            realtime=config.clock == "realtime",
            cameras=dict.fromkeys(config.cameras, (config.height, config.width, 3)),
        )
        self.cameras = dict.fromkeys(config.cameras)
        # The teleoperator needs the robot's description before either is connected.
        self._announce()
        weakref.finalize(self, self._session.withdraw, self._info)

    def _announce(self) -> None:
        self._session.announce(self._info)
        self._session.configs["robot"] = {
            "type": self.name,
            **dataclasses.asdict(self.config),
        }

    @property
    def observation_features(self) -> dict[str, type | tuple[int, int, int]]:
        """Proprioception as floats, then an image per camera (height, width, 3)."""
        return {**dict.fromkeys(self._body.state_keys, float), **self._info.cameras}

    @property
    def action_features(self) -> dict[str, type]:
        """Whole-body command, mode, arm joints and grippers, all floats."""
        return dict.fromkeys(self.morphology.layout.keys, float)

    @property
    def is_connected(self) -> bool:
        """Whether the robot is ready for actions."""
        return self._loop is not None

    @property
    def is_calibrated(self) -> bool:
        """True: no calibration is needed."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Start the robot standing, and let its policy settle for a second."""
        del calibrate
        if self.is_connected:
            return
        from xop_lerobot.plant.policy_loop import PolicyLoop  # noqa: PLC0415
        from xop_lerobot.plant.realtime_loop import RealtimeLoop  # noqa: PLC0415

        self._plant = self._make_plant()
        try:
            loop_class = RealtimeLoop if self._info.realtime else PolicyLoop
            self._loop = loop_class(self.morphology, self._plant, self._policy)
            self._announce()
            self._session.take_reset()
            self._start_episode()
        except BaseException:
            self.disconnect()
            raise

    def _make_plant(self) -> Simulation:
        """Make the simulated robot, in the task's scene if there is one."""
        from xop_lerobot.plant.simulation import Simulation  # noqa: PLC0415
        from xop_lerobot.tasks.stage import Stage  # noqa: PLC0415

        config = self.config.make_simulation_config()
        if not self.config.task:
            return Simulation(self.morphology, config)
        self._stage = Stage(self.morphology, self.config.task, config, self.config.task_heights)
        return self._stage.plant

    def _start_episode(self) -> None:
        loop, stage = self._connected_loop, self._stage
        entropy = np.random.SeedSequence([self.config.seed, self._session.episode])
        seed = int(entropy.generate_state(1)[0])
        start = self.morphology.rest_action() if stage is None else stage.start
        loop.reset(seed, start=start)
        self._last_action = start
        self._session.confirm_reset()
        if stage is not None:
            stage.reset(seed)
            self._session.obstacles = stage.obstacles

    @property
    def _connected_loop(self) -> PolicyLoop | RealtimeLoop:
        if self._loop is None:
            raise NotConnected(type(self).__name__)
        return self._loop

    def get_observation(self) -> dict[str, Any]:
        """Measure the robot, render the cameras, and start a tick of the session with both.

        Raises:
            NotConnected: Before `connect()`.
        """
        loop = self._connected_loop
        if self._session.take_reset():
            self._start_episode()
        assert self._plant is not None
        state, stage = loop.state, self._stage
        tick = Tick(
            state,
            view=None if stage is None else stage.view(state),
            pictures={camera: self._plant.render(camera) for camera in self.cameras},
            proprioception=self._body.compute_proprioception(state),
            outcome=None if stage is None else stage.status,
        )
        self._session.begin_tick(tick)
        return {**tick.proprioception, **tick.pictures}

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Execute `action` for one control period.

        Positions missing from `action` keep their last value; missing velocities are set to zero,
        so that moving only joints never keeps the robot walking. Keys of `observation.state` that
        are not actions are ignored: LeRobot sends them when it returns a robot to its start.

        Returns:
            The executed action after limits, for every action key.

        Raises:
            NotConnected: Before `connect()`.
            UnknownName: If a key is neither an action nor an observation.
            BadValue: If a value is not finite.
        """
        loop = self._connected_loop
        layout, last = self.morphology.layout, self._last_action
        resting = self.morphology.command_space.compute_rest(last.command, last.mode)
        sensed = set(self._body.state_keys) - set(layout.keys)
        known = {key: value for key, value in action.items() if key not in sensed}
        wanted = layout.from_dict(known, dataclasses.replace(last, command=resting))
        self._last_action = loop.execute(wanted, 1 / self.config.fps)
        outcome = None if self._stage is None else self._stage.update()
        executed = layout.to_dict(self._last_action)
        # LeRobot also returns an unobserved robot to its start: there is no tick then.
        if (tick := self._session.tick) is not None:
            self._session.put(dataclasses.replace(tick, executed=executed, outcome=outcome))
        return dict(executed)

    def disconnect(self) -> None:
        """Stop the robot and leave the session; may be called twice."""
        loop, plant = self._loop, self._plant
        self._loop = self._plant = self._stage = None
        if loop is not None:
            loop.close()
        if plant is not None:
            plant.close()
        self._session.withdraw(self._info)


def _check_cameras(morphology: Morphology, config: XopRobotConfig) -> None:
    """Check that scene and cameras exist, before anything is simulated.

    Raises:
        UnknownName: If there is no such scene or camera, listing the known ones.
    """
    spec = build_scene_spec(morphology, "full", config.scene)
    if config.task:
        add_task_camera(spec)
    known = [camera.name for camera in spec.cameras]
    for camera in config.cameras:
        if camera not in known:
            raise UnknownName(f"camera of {morphology.name}", camera, known)


class XopG1(XopRobot):
    """Unitree G1."""

    config_class = XopG1Config
    name = "xop_g1"


class XopRby1(XopRobot):
    """Rainbow Robotics RB-Y1."""

    config_class = XopRby1Config
    name = "xop_rby1"


class XopRby1M(XopRobot):
    """Rainbow Robotics RB-Y1 M."""

    config_class = XopRby1MConfig
    name = "xop_rby1m"
