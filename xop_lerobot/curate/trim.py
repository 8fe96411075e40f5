"""Trim idle time at the start and end of every episode, up to a margin.

A frame is idle if nobody is engaged, or if neither operator nor robot moves around it
(`xop_lerobot.curate.quality.find_idle`). Datasets of other projects have no operator; there the
action counts. Rows, images, time stamps, statistics and metadata are cut to fit; no image is
re-encoded. The end is never cut before the last change of `next.success`.

    xop-curate trim --root outputs/boxes --out outputs/boxes_trimmed --margin 0.5
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.command_line import CommandParser, say_count
from xop_lerobot.core.errors import BadDataset, BadValue
from xop_lerobot.curate import quality
from xop_lerobot.curate.arguments import (
    add_destination,
    add_source,
    make_destination,
    show_progress,
)
from xop_lerobot.curate.measures import IDLE, Episode, find_idle
from xop_lerobot.curate.source import EpisodeEntry, Source

if TYPE_CHECKING:
    from xop_lerobot.curate.clip import Clip

SUMMARY = "trim idle starts and ends"

_ENDS = ("start", "end", "both")
_OUTCOME = ("next.success", "next.done")


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_source(parser)
    add_destination(parser)
    parser.add_argument(
        "--margin",
        type=float,
        default=0.5,
        metavar="S",
        help="idle time kept at each end [s] (default: 0.5)",
    )
    parser.add_argument(
        "--limit",
        type=float,
        default=quality.STILL_LIMIT_M,
        metavar="M",
        help="largest motion within half a second that counts as stationary [m] "
        f"(default: {quality.STILL_LIMIT_M:g})",
    )
    parser.add_argument(
        "--ends", choices=_ENDS, default="both", help="ends to trim: start, end or both (default)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Trim a dataset; returns the exit code."""
    for name in ("margin", "limit"):
        value = getattr(arguments, name)
        if not (math.isfinite(value) and value >= 0):
            raise BadValue(f"--{name} must be finite and at least 0, got {value}")
    with Source(arguments.root) as source:
        destination = make_destination(arguments, source.root)
        trimmer = Trimmer(source, arguments.margin, arguments.limit, arguments.ends)
        clips = trimmer.make_clips(quiet=arguments.quiet)
        if destination is None:
            for _ in clips:
                pass
        else:
            from xop_lerobot.curate.transfer import Step, transfer  # noqa: PLC0415 torch

            step = Step.now(
                "trim", margin=arguments.margin, limit=arguments.limit, ends=arguments.ends
            )
            with destination as draft:
                transfer(clips, draft, step)
    trimmer.report()
    if destination is not None:
        print(f"written to {destination.root}")
    return 0


class Trimmer:
    """Determines what is trimmed off each episode.

    Args:
        source: The dataset.
        margin: Idle time kept at each end [s].
        limit: Largest motion of a stationary pose's points [m].
        ends: `start`, `end` or `both`.
    """

    def __init__(
        self,
        source: Source,
        margin: float,
        limit: float = quality.STILL_LIMIT_M,
        ends: str = "both",
    ) -> None:
        self._source, self._margin, self._limit, self._ends = source, margin, limit, ends
        self._lines: list[str] = []
        self._frames = self._kept = 0

    def make_clips(self, *, quiet: bool = True) -> Iterator[Clip]:
        """Yield the kept part of each episode."""
        from xop_lerobot.curate.clip import Clip  # noqa: PLC0415

        source = self._source
        for entry in show_progress(source.episodes, source.total_episodes, "episode", quiet=quiet):
            span = self.find_span(entry)
            self._note(entry, span)
            if span == (0, entry.length):
                yield Clip(source, entry)
            else:
                yield Clip(source, entry, span, columns=self._end_outcome(entry, span))

    def find_span(self, entry: EpisodeEntry) -> tuple[int, int]:
        """Return the first kept frame and the one after the last; all if everything is idle."""
        idle = self._find_idle(entry)
        start, stop = quality.find_active_span(idle)
        if start == stop:
            return 0, entry.length
        margin = round(self._margin * self._source.fps)
        start = max(0, start - margin) if self._ends != "end" else 0
        stop = min(entry.length, stop + margin) if self._ends != "start" else entry.length
        if _OUTCOME[0] in self._source.features:
            success = self._source.read(entry, _OUTCOME[:1])[_OUTCOME[0]][:, 0]
            changes = np.flatnonzero(np.diff(success.astype(int)))
            if changes.size:
                stop = max(stop, int(changes[-1]) + 2)
        return start, stop

    def _find_idle(self, entry: EpisodeEntry) -> np.ndarray:
        source = self._source
        columns = IDLE.find_columns(source.features, entry)
        if columns is None:
            raise BadDataset(
                source.root,
                "it has neither operator poses nor an action, so idle time is unknown. "
                f" Its columns: {', '.join(sorted(source.features))}",
            )
        rows = source.read(entry, columns)
        episode = Episode(entry, source.features, rows, 1 / source.fps, source.robot)
        return find_idle(episode, self._limit)

    def _end_outcome(self, entry: EpisodeEntry, span: tuple[int, int]) -> dict[str, np.ndarray]:
        """Copy the outcome of the episode's last row to the last kept row."""
        keys = [key for key in _OUTCOME if key in self._source.features]
        columns = {}
        for key, values in self._source.read(entry, keys).items() if keys else ():
            columns[key] = values[slice(*span)].copy()
            columns[key][-1] = values[-1]
        return columns

    def _note(self, entry: EpisodeEntry, span: tuple[int, int]) -> None:
        start, stop = span
        self._frames += entry.length
        self._kept += stop - start
        if stop - start < entry.length:
            fps = self._source.fps
            self._lines.append(
                f"episode {entry.index}: {entry.length / fps:.2f} s, {start / fps:.2f} s cut off "
                f"the start, {(entry.length - stop) / fps:.2f} s off the end"
            )

    def report(self) -> None:
        """Print what was trimmed."""
        for line in self._lines:
            print(line)
        cut, whole = ((n / self._source.fps) for n in (self._frames - self._kept, self._frames))
        print(f"{say_count(len(self._lines), 'episode')} cut, {cut:.2f} s of {whole:.2f} s")
