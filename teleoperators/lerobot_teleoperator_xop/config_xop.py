"""Configuration of the teleoperator. Imports neither MuJoCo nor a device."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.teleoperators.config import TeleoperatorConfig

from xop_lerobot.core.yaml_words import fill_nulls, recover_typed
from xop_lerobot.operator.alignment import AlignmentConfig
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.gestures import GestureConfig
from xop_lerobot.retarget.config import RetargeterConfig


@dataclass
class RecordingConfig:
    """What `lerobot-record` and `lerobot-rollout` record of a session."""

    columns: bool = True  # record operator, goal, retargeter, robot and time columns

    def __post_init__(self) -> None:
        """Restore words that YAML parsed as other types."""
        fill_nulls(self)


@TeleoperatorConfig.register_subclass("xop")
@dataclass(kw_only=True)
class XopConfig(TeleoperatorConfig):
    """Drives an xop robot by the motion of a person's head and hands."""

    session: str = "default"  # pairs this teleoperator with the robot of the same session
    device: DeviceConfig = field(default_factory=DeviceConfig)  # source of the operator's motion
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)  # operator to robot
    retargeter: RetargeterConfig = field(default_factory=RetargeterConfig)  # goals to commands
    gestures: GestureConfig = field(default_factory=GestureConfig)  # meaning of pinches
    control: str = ""  # control socket: empty for none, true for the default path, or a path
    keys: bool = False  # change settings by keys of this terminal
    record: RecordingConfig = field(default_factory=RecordingConfig)  # recorded data

    def __post_init__(self) -> None:
        """Restore words that YAML parsed as other types."""
        fill_nulls(self)
        recover_typed(self, "teleop", "session", "control")
        recover_typed(self.device, "teleop.device", "path", "host", "code")
        recover_typed(self.retargeter, "teleop.retargeter", "variant", "obstacles")
