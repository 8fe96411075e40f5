"""Configuration of the teleoperator. Loads neither MuJoCo nor a device."""

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
    """What `lerobot-record` and `lerobot-rollout` write of a session."""

    columns: bool = True  # record operator, goal, retargeter, robot and time columns

    def __post_init__(self) -> None:
        """Take the words back that YAML took for something else."""
        fill_nulls(self)


@TeleoperatorConfig.register_subclass("xop")
@dataclass(kw_only=True)
class XopConfig(TeleoperatorConfig):
    """Drives an xop robot by what a person's head and hands do."""

    session: str = "default"  # pairs this teleoperator with the robot of the same session
    device: DeviceConfig = field(default_factory=DeviceConfig)  # where the motion comes from
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)  # person to robot
    retargeter: RetargeterConfig = field(default_factory=RetargeterConfig)  # goals to commands
    gestures: GestureConfig = field(default_factory=GestureConfig)  # what pinches do
    control: str = ""  # socket for changes: empty for none, true for the default path, or a path
    keys: bool = False  # let keys of this terminal change settings
    record: RecordingConfig = field(default_factory=RecordingConfig)  # what is written

    def __post_init__(self) -> None:
        """Take the words back that YAML took for something else."""
        fill_nulls(self)
        recover_typed(self, "teleop", "session", "control")
        recover_typed(self.device, "teleop.device", "path", "host", "code")
        recover_typed(self.retargeter, "teleop.retargeter", "variant", "obstacles")
