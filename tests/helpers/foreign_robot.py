"""A robot and a teleoperator of others; LeRobot finds them in the module of their configs."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator


@RobotConfig.register_subclass("foreign")
@dataclass(kw_only=True)
class ForeignRobotConfig(RobotConfig):
    pass


class ForeignDevice:
    """What LeRobot asks of robots and teleoperators alike."""

    connected, count = False, 0.0

    @property
    def action_features(self) -> dict[str, type]:
        return {"joint.pos": float}

    @property
    def is_calibrated(self) -> bool:
        return True

    @property
    def is_connected(self) -> bool:
        return self.connected

    def connect(self, calibrate: bool = True) -> None:
        self.connected, self.count = True, 0.0

    def disconnect(self) -> None:
        self.connected = False

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass


class ForeignRobot(ForeignDevice, Robot):
    config_class, name = ForeignRobotConfig, "foreign"
    cameras: dict = {}

    @property
    def observation_features(self) -> dict[str, type]:
        return {"joint.pos": float}

    def get_observation(self):
        self.count += 1
        return {"joint.pos": self.count}

    def send_action(self, action):
        return action


@TeleoperatorConfig.register_subclass("foreign")
@dataclass(kw_only=True)
class ForeignTeleopConfig(TeleoperatorConfig):
    pass


class ForeignTeleop(ForeignDevice, Teleoperator):
    config_class, name = ForeignTeleopConfig, "foreign"

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    def get_action(self):
        return {"joint.pos": 0.5}

    def send_feedback(self, feedback):
        pass
