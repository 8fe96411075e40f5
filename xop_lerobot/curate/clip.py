"""A clip: an episode or a part of one on its way into a new dataset, with its changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from xop_lerobot.core.errors import BadDataset, BadShape, BadValue

if TYPE_CHECKING:
    from pathlib import Path

    from xop_lerobot.curate.source import EpisodeEntry, Source

PROVENANCE = "provenance"
"""Metadata key of the list of steps that made an episode."""


@dataclass(frozen=True)
class Clip:
    """An episode to write, with its changes.

    Attributes:
        source: Dataset that contains it.
        entry: The episode.
        rows: First row, and the row after the last; None for all.
        facts: New or changed episode metadata.
        columns: New or changed columns, with one row for each of `rows`. Shapes (n, size).
        task: New task description, None to keep the present one.
    """

    source: Source
    entry: EpisodeEntry
    rows: tuple[int, int] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)
    task: str | None = None

    def __post_init__(self) -> None:
        """Validate rows and columns.

        Raises:
            BadDataset: If the episode has no rows.
            BadValue: If it lacks some of these rows.
            BadShape: If a column does not have one row for each of them.
        """
        if not self.entry.has_rows:
            raise make_refusal(self)
        start, stop = self.span
        if not 0 <= start < stop <= self.entry.length:
            raise BadValue(
                f"episode {self.entry.index} has the rows 0 to {self.entry.length}; "
                f"got {start} to {stop}"
            )
        for key, column in self.columns.items():
            if column.ndim != 2 or len(column) != len(self):
                raise BadShape(key, (len(self), "size"), column.shape)

    def __len__(self) -> int:
        start, stop = self.span
        return stop - start

    @property
    def span(self) -> tuple[int, int]:
        """First row, and the row after the last."""
        return self.rows or (0, self.entry.length)

    @property
    def is_cut(self) -> bool:
        """Whether rows are left out."""
        return self.span != (0, self.entry.length)


def make_refusal(clip: Clip) -> BadDataset:
    """Make the error for an episode that cannot be transferred, from its `faults`."""
    return BadDataset(
        clip.source.root, f"{clip.entry.faults[0]}. `xop-curate repair` keeps what is complete"
    )


@dataclass(frozen=True)
class Step:
    """One curation step; each new episode lists it in its provenance.

    Attributes:
        verb: Verb of `xop-curate`.
        arguments: Flags that decide the content.
        versions: Versions of the packages used.
        root: Source directory to name in the provenance, if not the clip's.
    """

    verb: str
    arguments: Mapping[str, Any]
    versions: Mapping[str, str]
    root: Path | None = None

    @classmethod
    def now(cls, verb: str, **arguments: Any) -> Step:
        """Make the present step; arguments that are None or False are left out."""
        import json  # noqa: PLC0415

        from xop_lerobot.core.versions import read_versions  # noqa: PLC0415
        from xop_lerobot.recording.facts import to_plain  # noqa: PLC0415

        given = {key: value for key, value in arguments.items() if value not in (None, False)}
        return cls(verb, to_plain(given), json.loads(read_versions()))


def make_facts(clip: Clip, step: Step) -> dict[str, Any]:
    """Make the metadata of a new episode, including `provenance`."""
    facts = {**clip.entry.facts, **clip.facts}
    start, stop = clip.span
    if clip.is_cut and isinstance(facts.get("changes"), list):
        facts["changes"] = cut_changes(facts["changes"], start, stop)
    if clip.task is not None and "task" in facts:
        facts["task"] = clip.task
    record = {
        "verb": step.verb,
        "arguments": dict(step.arguments),
        "source": name_source(step.root or clip.source.root),
        "source_episode": clip.entry.index,
        "source_rows": [start, stop],
        "versions": dict(step.versions),
    }
    before = facts.get(PROVENANCE)
    facts[PROVENANCE] = [*(before if isinstance(before, list) else ()), record]
    return facts


def name_source(root: Path) -> str:
    """Name a dataset by the last two parts of its directory, like a repository: `me/boxes`."""
    parts = root.resolve().parts[-2:]
    return "/".join(part for part in parts if part != root.anchor)


def cut_changes(changes: list[Any], start: int, stop: int) -> list[Any]:
    """Restrict the list of changes in an episode to the rows from `start` to `stop`.

    Changes before `start` are still in force there, so they move to its first row.
    """
    kept = []
    for change in changes:
        frame = change.get("frame") if isinstance(change, dict) else None
        if not isinstance(frame, int):
            kept.append(change)
        elif frame < stop:
            kept.append({**change, "frame": max(0, frame - start)})
    return kept
