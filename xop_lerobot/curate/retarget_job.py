"""The operators of a recorded dataset, one after another, as jobs for the workers."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from xop_lerobot.core.errors import BadDataset, BadRecording, BadValue
from xop_lerobot.curate.clip import PROVENANCE, Clip, Step, make_facts
from xop_lerobot.curate.source import EpisodeEntry, Source
from xop_lerobot.curate.task_words import TASK, read_tasks
from xop_lerobot.operator.dataset_recording import choose_columns, make_dataset_recording
from xop_lerobot.operator.recording import Recording


@dataclass(frozen=True)
class RetargetJob:
    """One recorded operator.

    Attributes:
        index: Index of the episode in the source.
        recording: What the operator did; None if it cannot be replayed.
        fault: Why not.
        tasks: The task in words, and the time on the recording's clock from which it is that [s].
        facts: Facts on the new episode that its recorder does not know.
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
        step: What is being done to it, for the `provenance` of the new episodes.

    Raises:
        BadRecording: If it lacks columns of an operator, listing those that it has.
    """

    def __init__(self, source: Source, step: Step) -> None:
        self._source, self._step = source, step
        self._columns = choose_columns(source.root, source.features)
        self._names: dict[int, str] | None = None

    def read(self, indices: Collection[int]) -> Iterator[RetargetJob]:
        """Read those of the episodes `indices`, in order.

        What cannot be replayed comes all the same, with the fault.
        """
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
        """Find the tasks in words, and from when on they are those [s]."""
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


def parse_episodes(text: str) -> list[int]:
    """Read a choice of episodes such as `0,3,8-11`.

    Raises:
        BadValue: If it is none.
    """
    chosen: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise BadValue(f"--episodes must be such as 0,3,8-11, got '{text}'")
        chosen.extend(range(int(first), int(last or first) + 1))
    return sorted(set(chosen))
