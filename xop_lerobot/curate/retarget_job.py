"""Jobs of `xop-curate retarget`: the recorded operators of a dataset, and the configuration."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from xop_lerobot.collect.config import CollectConfig, import_plugins
from xop_lerobot.core.command_line import split_pair
from xop_lerobot.core.errors import BadDataset, BadRecording, BadValue, UnknownName
from xop_lerobot.core.yaml_words import load_yaml
from xop_lerobot.curate.clip import PROVENANCE, Clip, Step, make_facts
from xop_lerobot.curate.source import EpisodeEntry, Source
from xop_lerobot.curate.task_words import TASK, read_tasks
from xop_lerobot.operator.dataset_recording import choose_columns, make_dataset_recording
from xop_lerobot.operator.recording import Recording

if TYPE_CHECKING:
    from lerobot_teleoperator_xop import XopConfig
    from xop_lerobot.collect.folder import Attempt


@dataclass(frozen=True)
class RetargetJob:
    """Replay of one recorded operator.

    Attributes:
        index: Episode index in the source.
        recording: The operator's motion; None if it cannot be replayed.
        fault: Why it cannot be replayed.
        tasks: Task descriptions with the recording time from which each applies [s].
        facts: Metadata of the new episode that its recorder does not know.
    """

    index: int
    recording: Recording | None
    fault: str = ""
    tasks: tuple[tuple[float, str], ...] = ((0.0, ""),)
    facts: Mapping[str, Any] = field(default_factory=dict)


class Operators:
    """Reads the recorded operators of a dataset; memory holds one episode.

    Args:
        source: The dataset.
        step: The present step, for the `provenance` of the new episodes.

    Raises:
        BadRecording: If the dataset lacks operator columns, listing those that it has.
    """

    def __init__(self, source: Source, step: Step) -> None:
        self._source, self._step = source, step
        self._columns = choose_columns(source.root, source.features)
        self._names: dict[int, str] | None = None

    def read(self, indices: Collection[int]) -> Iterator[RetargetJob]:
        """Yield jobs for the episodes `indices`, in order, with a fault if not replayable."""
        wanted = set(indices)
        for entry in self._source.episodes:
            if entry.index in wanted:
                yield self._read(entry)

    def _read(self, entry: EpisodeEntry) -> RetargetJob:
        source = self._source
        try:
            columns = source.read(entry, self._columns)
            recording, rows = make_dataset_recording(
                columns, source.features, f"{source.root} (episode {entry.index})", source.fps
            )
            tasks = self._find_tasks(entry, rows, recording.t)
        except (BadRecording, BadDataset) as error:
            return RetargetJob(entry.index, None, str(error))
        clip = Clip(source, entry, (int(rows[0]), int(rows[-1]) + 1))
        facts = {PROVENANCE: make_facts(clip, self._step)[PROVENANCE]}
        return RetargetJob(entry.index, recording, tasks=tasks, facts=facts)

    def _find_tasks(
        self, entry: EpisodeEntry, rows: np.ndarray, stamps: np.ndarray
    ) -> tuple[tuple[float, str], ...]:
        """Return task descriptions with the time from which each applies [s]."""
        if len(entry.tasks) == 1 or TASK not in self._source.features:
            return ((0.0, " | ".join(entry.tasks)),)
        numbers = self._source.read(entry, [TASK])[TASK][rows, 0]
        begins = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
        names = self._read_names()
        return tuple((float(stamps[i]), names.get(int(numbers[i]), "")) for i in begins)

    def _read_names(self) -> dict[int, str]:
        if self._names is None:
            self._names = read_tasks(self._source.root)
        return self._names


DEVICE = "retarget"
"""Name of the device that replays the operators."""
DEFAULT_FPS = 25
"""Rate of the new dataset if the robots cannot run at that of the source [Hz]."""
POLICY_HZ = 50
"""Rate of every low-level policy [Hz]; the control rate must divide it."""


@dataclass(frozen=True)
class RetargetConfig(CollectConfig):
    """Configuration of a retargeted dataset; equal configurations give equal episodes.

    Attributes:
        task: Task whose scene is set up and whose success is judged; empty for none.
        fps: Rate of control loop and dataset [Hz].
        device: Always `DEVICE`.
        source: Directory of the source dataset.
        name: Name of the source dataset, kept in the new dataset's configuration.
        hold_s: Time the operator's last posture is held for the robot to arrive [s].
        weights: Cost weights by name, overriding the preset's.
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

    maker: ClassVar[str] = "xop_lerobot.curate.retarget_worker:Replayer"

    def check(self) -> None:
        """Check everything that does not need a robot; imports the plugins.

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
                f"--weights needs the planner, but the retargeter is '{retargeter.type}'. "
                "Use --method=mpc, or omit --weights"
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
        """Describe the outcome of an episode in a few words."""
        if not attempt.kept:
            return f"left out ({attempt.failure})"
        return super().describe(attempt) if self.task else "retargeted"


def choose_fps(wanted: int, source: float) -> int:
    """Choose the rate of the new dataset [Hz]: the wanted one, else the source's if supported."""
    if wanted:
        return wanted
    can = float(source).is_integer() and source >= 1 and POLICY_HZ % int(source) == 0
    return int(source) if can else DEFAULT_FPS


def read_settings(kind: type, what: str, pairs: Sequence[str]) -> dict[str, Any]:
    """Parse `KEY=VALUE` pairs as fields of a dataclass.

    Args:
        kind: The dataclass.
        what: Description of the settings for messages.
        pairs: The pairs; values in YAML syntax.

    Raises:
        UnknownName: If there is no such field, listing the known ones.
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
    """Parse `NAME=VALUE` pairs as cost weights.

    Raises:
        UnknownName: If there is no such weight, listing the known ones.
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
        name, text = split_pair(pair, f"{what} must be given as KEY=VALUE")
        try:
            found.append((name, load_yaml(text, switches=True)))
        except yaml.YAMLError as error:
            raise BadValue(f"{what} '{name}': '{text}' cannot be read") from error
    return found
