"""The teleoperator as a LeRobot device: XR device, alignment and retargeter of one robot."""

from __future__ import annotations

import dataclasses
import logging
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.teleoperators.teleoperator import Teleoperator

from lerobot_teleoperator_xop.config_xop import XopConfig
from xop_lerobot.control.protocol import find_socket
from xop_lerobot.core.command_line import report_mistakes
from xop_lerobot.core.errors import LinkError, NotConnected, XopError
from xop_lerobot.operator.alignment import AlignmentConfig
from xop_lerobot.operator.calibration import (
    Calibration,
    calibrate,
    load_calibration,
    save_calibration,
)
from xop_lerobot.operator.devices import make_device
from xop_lerobot.recording.host import Host
from xop_lerobot.session import RobotInfo, get_session

if TYPE_CHECKING:
    from lerobot.utils.keyboard_input import TerminalKeyListener

    from xop_lerobot.control.server import ControlServer
    from xop_lerobot.teleoperation import Teleoperation

logger = logging.getLogger(__name__)


class Xop(Teleoperator):
    """Drives the robot of its session by an XR device, alignment and retargeter.

    While it exists, LeRobot's record and rollout loops write `XopDataset`s of its robot.

    Args:
        config: The teleoperator's configuration.

    Raises:
        UnknownName: If there is no such device.
        BadValue: If a device setting is missing or out of range, the operator's calibration cannot
            be read, or obstacles are given that this robot would ignore.
    """

    config_class = XopConfig
    name = "xop"

    def __init__(self, config: XopConfig) -> None:
        self.person: Calibration | None = None
        super().__init__(config)
        report_mistakes()
        self.config = config
        self._session = get_session(config.session)
        self._teleoperation: Teleoperation | None = None
        self._is_connected = False
        self._resets_seen = 0
        self._control_path = find_socket(config.control, config.session)
        self._control: ControlServer | None = None
        self._keys: TerminalKeyListener | None = None
        # Raises for an invalid device here, before a robot or a dataset exists.
        device = make_device(config.device)
        self._has_person = not device.self_engaging
        self._check_obstacles()
        self._note_config()
        self.host = Host(
            config.session,
            extra_columns=config.record.columns,
            has_person=self._has_person,
        )
        self.host.install()
        weakref.finalize(self, self.host.remove)

    def _check_obstacles(self) -> None:
        """Refuse obstacles that would be ignored, if the robot already exists."""
        if not (self.config.retargeter.obstacles and self.action_features):
            return
        from xop_lerobot.retarget.factory import check_obstacles  # noqa: PLC0415  imports MuJoCo

        check_obstacles(self.config.retargeter, self._session.robot.morphology)

    @property
    def action_features(self) -> dict[str, type]:
        """Action keys of the session's robot; empty until a robot is created."""
        try:
            info = self._session.robot
        except LinkError:
            return {}
        return dict.fromkeys(info.morphology.layout.keys, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """Empty: the robot's state arrives through the session."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether the device is open."""
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        """Whether the operator's height and reach are known, if the device has a person."""
        return self.person is not None or not self._has_person

    def calibrate(self) -> None:
        """Measure the operator's height and reach, and save them in LeRobot's folder.

        Raises:
            NotConnected: Before `connect()`.
            XopError: If a robot is already driven, or the operator could not be measured.
        """
        if not self._is_connected:
            raise NotConnected(type(self).__name__)
        if not self._has_person:
            logger.info("Device '%s' needs no calibration.", self.config.device.type)
            return
        if self._teleoperation is not None:
            raise XopError("a robot is driven already; calibrate with lerobot-calibrate")
        device = make_device(self.config.device)
        device.connect()
        try:
            self.person = calibrate(device, say=logger.info, clock=time.monotonic, sleep=time.sleep)
        finally:
            device.disconnect()
        self._save_calibration()
        self._note_config()
        logger.info("Saved for '--teleop.id=%s' in '%s'.", self.id, self.calibration_fpath)

    def _load_calibration(self, fpath: Path | None = None) -> None:
        self.person = load_calibration(fpath or self.calibration_fpath)

    def _save_calibration(self, fpath: Path | None = None) -> None:
        assert self.person is not None
        save_calibration(self.person, fpath or self.calibration_fpath)

    def _make_alignment(self) -> AlignmentConfig:
        """The alignment of the flags, completed by the operator's calibration."""
        flags = self.config.alignment
        if self.person is None or not self._has_person:
            return flags
        return dataclasses.replace(
            flags,
            eye_height=flags.eye_height or self.person.eye_height,
            arm_reach=flags.arm_reach or self.person.arm_reach,
        )

    def _note_config(self) -> None:
        """Publish the configuration, which is stored with a dataset."""
        alignment = dataclasses.asdict(self._make_alignment())
        config = dataclasses.asdict(self.config) | {"alignment": alignment}
        self._session.configs["teleop"] = {"type": self.name, **config}

    def configure(self) -> None:
        """Do nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Open the device; a recording is read and checked here.

        An existing robot is used at once, otherwise the first `get_action` looks for it.

        Raises:
            LinkError: If the session has two robots.
            BadRecording: If a recording is missing or malformed.
        """
        if self._is_connected:
            return
        if calibrate and not self.is_calibrated:
            who = f"of '--teleop.id={self.id}'" if self.id else "without --teleop.id"
            logger.info(
                "No calibration %s: your height is measured when you engage, and your arms count "
                "as long as your height says. lerobot-calibrate measures both.",
                who,
            )
        if self.action_features:
            self._teleoperation = self._make_teleoperation(self._session.robot)
        elif not self._has_person:
            device = make_device(self.config.device)
            device.connect()
            device.disconnect()
        try:
            self._open_control()
        except BaseException:
            self.disconnect()
            raise
        self._is_connected = True

    def _open_control(self) -> None:
        """Open the control socket and the terminal keys, if the flags ask for them."""
        if self._control_path is not None:
            from xop_lerobot.control.server import ControlServer  # noqa: PLC0415

            self._control = ControlServer(self._control_path, self)
        if self.config.keys:
            from lerobot_teleoperator_xop.terminal import listen_to_terminal  # noqa: PLC0415

            self._keys = listen_to_terminal(self)

    @property
    def has_keys(self) -> bool:
        """Whether this teleoperator reads the keys of the terminal itself."""
        return self._keys is not None

    @property
    def settings(self) -> dict[str, Any]:
        """Current settings: preset, weights, targets, constraints, mode.

        Raises:
            XopError: If no robot is driven yet.
        """
        return self._driving.settings

    def change(self, change: Mapping[str, Any], source: str = "call") -> dict[str, Any]:
        """Request other settings, from any thread; see `Teleoperation.change`.

        Raises:
            XopError: If the change is invalid, or no robot is driven yet.
        """
        return self._driving.change(change, source)

    def toggle(self, name: str, source: str = "call") -> dict[str, Any]:
        """Toggle the mode, a constraint or a preset; see `Teleoperation.toggle`.

        Raises:
            XopError: If there is no such name, or no robot is driven yet.
        """
        return self._driving.toggle(name, source)

    @property
    def _driving(self) -> Teleoperation:
        if self._teleoperation is None:
            raise XopError("no robot is driven yet; try again when it stands")
        return self._teleoperation

    def _make_teleoperation(self, info: RobotInfo) -> Teleoperation:
        from xop_lerobot.teleoperation import Teleoperation, TeleoperationConfig  # noqa: PLC0415

        config = TeleoperationConfig(
            device=self.config.device,
            alignment=self._make_alignment(),
            retargeter=self.config.retargeter,
            gestures=self.config.gestures,
        )
        teleoperation = Teleoperation(config, info)
        teleoperation.connect()
        self._resets_seen = self._session.reset_count
        teleoperation.reset(self._session.obstacles, self._session.episode)
        return teleoperation

    def get_action(self) -> dict[str, float]:
        """Compute an action from the robot's latest state and the operator's latest frame.

        Raises:
            NotConnected: Before `connect()`.
            LinkError: If the session has no robot or two, or its robot was never observed.
        """
        if not self._is_connected:
            raise NotConnected(type(self).__name__)
        info, tick = self._session.robot, self._session.tick
        if tick is None:
            raise LinkError(
                f"{info.name} in session '{self._session.name}' has published no state yet. "
                "Call its get_observation() before get_action()."
            )
        if self._teleoperation is None:
            self._teleoperation = self._make_teleoperation(info)
        if self._session.reset_count != self._resets_seen:
            self._resets_seen = self._session.reset_count
            self._teleoperation.reset(self._session.obstacles, self._session.episode)
        action, tick = self._teleoperation.step(tick)
        self._session.put(tick)
        for request in self._teleoperation.take_requests():
            self._teleoperation.answer(*self._session.ask(request))
        self._teleoperation.show(self._session.progress)
        return info.morphology.layout.to_dict(action)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing: the robot's state arrives through the session."""

    def disconnect(self) -> None:
        """Close the device and remove the patches of LeRobot; may be called twice."""
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._keys is not None:
            self._keys.stop()
            self._keys = None
        if self._teleoperation is not None:
            self._teleoperation.disconnect()
            self._teleoperation = None
        self._is_connected = False
        self.host.remove()
