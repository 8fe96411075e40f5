"""What a recorded operator is replayed with: robot, policy, retargeter and their settings."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from xop_lerobot.collect.config import CollectConfig, import_plugins
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.yaml_words import load_yaml

if TYPE_CHECKING:
    from lerobot_teleoperator_xop import XopConfig
    from xop_lerobot.collect.folder import Attempt

DEVICE = "retarget"
"""Name of the device that plays the recorded operators."""
DEFAULT_FPS = 25
"""Rate of a dataset whose source has one that the robots cannot run at [Hz]."""
POLICY_HZ = 50


@dataclass(frozen=True)
class RetargetConfig(CollectConfig):
    """What decides the content of a retargeted dataset; equal ones give equal episodes.

    Attributes:
        task: Task whose furniture and success there shall be; empty for none.
        fps: Rate of the control loop and of the dataset [Hz].
        device: Always `DEVICE`.
        source: Directory of the dataset that is replayed.
        name: Its name, for the configuration that the new dataset keeps.
        hold_s: How long the operator's last posture is held, for the robot to arrive [s].
        weights: Cost weights by name, over those of the preset.
        retargeter: Other settings of `RetargeterConfig` by name.
        alignment: Settings of `AlignmentConfig` by name.
    """

    task: str = ""
    device: str = DEVICE
    source: str = ""
    name: str = ""
    hold_s: float = 1.0
    weights: Mapping[str, float] = field(default_factory=dict)
    retargeter: Mapping[str, Any] = field(default_factory=dict)
    alignment: Mapping[str, Any] = field(default_factory=dict)

    maker: ClassVar[str] = "xop_lerobot.curate.retarget_worker:Retargeter"

    def check(self) -> None:
        """Check all that can be checked before a robot is made; imports the plugins.

        Raises:
            UnknownName: If there is no such robot, task, policy, noise, method or variant.
            BadValue: If a number is out of its range, or a plugin cannot be imported.
        """
        from xop_lerobot.retarget.changes import make_settings  # noqa: PLC0415 MuJoCo

        import_plugins(self.plugins)
        if self.task:
            self.make_task()
        self.make_robot_config()
        retargeter = self.make_teleop_config().retargeter
        make_settings(self.morphology, retargeter)
        if self.weights and retargeter.type != "mpc":
            raise BadValue(
                f"weights are those of the planner, and a retargeter '{retargeter.type}' has none. "
                "Use --method=mpc, or leave --weights out"
            )

    def make_teleop_config(self) -> XopConfig:
        """Make the configuration of the teleoperator; see `CollectConfig.make_teleop_config`."""
        from xop_lerobot.operator.alignment import AlignmentConfig  # noqa: PLC0415
        from xop_lerobot.operator.devices.config import DeviceConfig  # noqa: PLC0415

        config = super().make_teleop_config()
        return dataclasses.replace(
            config,
            device=DeviceConfig(type=self.device, path=self.name, hold_s=self.hold_s),
            retargeter=dataclasses.replace(config.retargeter, **self.retargeter),
            alignment=AlignmentConfig(**self.alignment),
        )

    def describe(self, attempt: Attempt) -> str:
        """Say in a few words what came of an episode."""
        if not attempt.kept:
            return f"left out ({attempt.failure})"
        return super().describe(attempt) if self.task else "retargeted"


def choose_fps(wanted: int, source: float) -> int:
    """Choose the rate of the new dataset [Hz]: the wanted one, else the source's if robots can."""
    if wanted:
        return wanted
    can = float(source).is_integer() and source >= 1 and POLICY_HZ % int(source) == 0
    return int(source) if can else DEFAULT_FPS


def read_settings(kind: type, what: str, pairs: Sequence[str]) -> dict[str, Any]:
    """Read `KEY=VALUE` pairs as fields of a dataclass.

    Args:
        kind: The dataclass.
        what: What they are, for messages.
        pairs: The pairs; values as in YAML.

    Raises:
        UnknownName: If there is no such field, listing those that there are.
        BadValue: If a pair or a value is malformed.
    """
    import typing  # noqa: PLC0415

    from draccus.parsers.decoding import decode  # noqa: PLC0415
    from draccus.utils import DecodingError  # noqa: PLC0415

    hints = typing.get_type_hints(kind)
    values = {}
    for name, text in split_pairs(what, pairs):
        if name not in hints:
            raise UnknownName(what, name, hints)
        try:
            values[name] = decode(hints[name], text)
        except DecodingError as error:
            raise BadValue(f"{what} '{name}': {error}") from error
    kind(**values)  # checks ranges
    return values


def read_weights(pairs: Sequence[str]) -> dict[str, float]:
    """Read `NAME=VALUE` pairs as cost weights.

    Raises:
        UnknownName: If there is no such weight, listing those that there are.
        BadValue: If a pair is malformed or a value out of its range.
    """
    from xop_lerobot.retarget.changes import check_weight  # noqa: PLC0415 MuJoCo

    weights = {}
    for name, value in split_pairs("weight", pairs):
        number = math.inf if value == "inf" else value
        check_weight(name, number)
        weights[name] = float(number)
    return weights


def split_pairs(what: str, pairs: Sequence[str]) -> list[tuple[str, Any]]:
    """Split `KEY=VALUE` texts.

    Raises:
        BadValue: If one is no such pair.
    """
    import yaml  # noqa: PLC0415

    found = []
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals:
            raise BadValue(f"{what} must be given as KEY=VALUE, got '{pair}'")
        try:
            found.append((name.strip(), load_yaml(text, switches=True)))
        except yaml.YAMLError as error:
            raise BadValue(f"{what} '{name}': '{text}' cannot be read") from error
    return found
