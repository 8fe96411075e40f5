"""Show the contents of a dataset, episode by episode, without changing it.

    xop-curate inspect --root outputs/walk
    xop-curate inspect --root outputs/walk --json walk.json --quiet
    xop-curate inspect --root outputs/walk --show episode,success,tracking_head_p95,task

A metric whose columns are missing is `-` in the table and null in JSON. Unreadable files are named
and set the exit code to 1; everything else is still shown.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from tqdm import tqdm

from xop_lerobot.core.command_line import (
    CommandParser,
    align_cells,
    can_print_anything,
    say_count,
)
from xop_lerobot.core.errors import BadValue
from xop_lerobot.curate.arguments import add_source, show_progress
from xop_lerobot.curate.expression import Kind, UnknownFigure
from xop_lerobot.curate.measures import FIGURES, KINDS, describe_figures
from xop_lerobot.curate.source import Source

SUMMARY = "show the contents of a dataset: tracking, smoothness, falls, gaps, idle time, …"

SHOWN = (
    "episode", "duration", "success", "fall", "collision", "tracking_mean", "tracking_p95",
    "tracking_angle_mean", "tracking_angle_p95", "command_roughness", "gap_time", "late",
    "dropped_frames", "plan_age_p95", "idle_time", "robot", "task",
)  # fmt: skip
"""Default columns of the table."""
SUMMARISED = (
    "duration", "tracking_mean", "tracking_p95", "tracking_angle_mean", "command_roughness",
    "command_ldlj", "hand_jerk", "plan_age_p95",
)  # fmt: skip
"""Metrics whose mean and range are printed in the summary."""
_STANDARD_OUTPUT = "-"


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_source(parser)
    parser.add_argument(
        "--json",
        metavar="FILE",
        help="write all metrics as a JSON list, one object per episode; - for standard output "
        "instead of the table (default: none)",
    )
    parser.add_argument(
        "--show",
        default=",".join(SHOWN),
        metavar="A,B,…",
        help=f"metrics in the table (default: {', '.join(SHOWN)})",
    )
    parser.epilog = f"metrics:\n{describe_figures()}"


def run(arguments: argparse.Namespace) -> int:
    """Inspect a dataset; returns the exit code."""
    from xop_lerobot.curate.order_check import check_whole  # noqa: PLC0415
    from xop_lerobot.curate.survey import survey  # noqa: PLC0415 SciPy, MuJoCo

    shown = parse_names(arguments.show)
    to_output = arguments.json == _STANDARD_OUTPUT
    table, totals, faults = Table(shown), Totals(SUMMARISED), list[str]()
    with Source(arguments.root) as source, _open_list(arguments.json) as write:
        if not to_output:
            print(table.head)
        findings = survey(source, note=faults.append)
        total = source.total_episodes
        # On a terminal the growing table shows the progress.
        quiet = arguments.quiet or (sys.stdout.isatty() and not to_output)
        for finding in show_progress(findings, total, "episode", quiet=quiet):
            write(finding.to_json())
            totals.add(finding.figures, bool(finding.problems))
            if not to_output:
                print(table.format(finding.figures))
            for problem in finding.problems:
                tqdm.write(f"problem: {problem}", file=sys.stderr)
        if not faults and totals.episodes != total:
            counted = say_count(total, "episode")
            faults.append(f"meta/info.json counts {counted}, there are {totals.episodes}")
        if not faults:
            faults += check_whole(source, totals.frames)
    for fault in faults:
        print(f"problem: {fault}", file=sys.stderr)
    if not to_output:
        print(f"\n{totals.format()}")
    if totals.faulty:
        print(f"{totals.faulty} of {totals.episodes} episodes have problems", file=sys.stderr)
    return 1 if faults or totals.faulty else 0


def parse_names(text: str) -> tuple[str, ...]:
    """Parse comma-separated names of metrics.

    Raises:
        UnknownFigure: If one is unknown, listing the known ones.
        BadValue: If there are none.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in FIGURES:
            raise UnknownFigure(name, KINDS)
    if not names:
        raise BadValue(f"--show must name metrics, got '{text}'. Known: {', '.join(FIGURES)}")
    return names


@contextmanager
def _open_list(file: str | None) -> Iterator[Any]:
    """Yield a function that appends an object to a JSON list; a file is written atomically."""
    if file is None:
        yield lambda row: None
        return
    if file == _STANDARD_OUTPUT:
        writer = _ListWriter(sys.stdout, as_ascii=not can_print_anything())
        yield writer.write
        writer.close()
        return
    path = Path(file)
    draft = path.with_name(f".{path.name}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = draft.open("w", encoding="utf-8")
    except OSError as error:
        raise BadValue(f"--json={file} cannot be written: {error}") from error
    try:
        with stream:
            writer = _ListWriter(stream)
            yield writer.write
            writer.close()
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


class _ListWriter:
    """Writes a JSON list to a stream, one object per line."""

    def __init__(self, stream: IO[str], *, as_ascii: bool = False) -> None:
        self._stream, self._separator = stream, "[\n"
        self._as_ascii = as_ascii

    def write(self, row: Mapping[str, Any]) -> None:
        """Write one object."""
        text = json.dumps(row, allow_nan=False, ensure_ascii=self._as_ascii)
        self._stream.write(f"{self._separator}{text}")
        self._separator = ",\n"

    def close(self) -> None:
        """End the list."""
        self._stream.write("[]\n" if self._separator == "[\n" else "\n]\n")


UNKNOWN = "-"
_HEADS = {
    "episode": "ep",
    "duration": "time",
    "collision": "coll.",
    "tracking_mean": "track",
    "tracking_p95": "p95",
    "tracking_angle_mean": "angle",
    "tracking_angle_p95": "p95",
    "command_roughness": "rough",
    "gap_time": "gaps",
    "dropped_frames": "drop",
    "plan_age_p95": "age p95",
    "idle_time": "idle",
}
"""Column heads that are shorter than the metric's name."""
_WIDTHS = {"robot": 8, "task": 40, "scene": 10, "low_level": 10, "clock": 8, "preset": 12}
"""Widths of text columns [characters]; longer texts are cut off."""
_MINIMUM = 5
"""Width of number columns [characters]."""


class Table:
    """Table of episodes; widths are fixed before the first row, so rows can be streamed.

    Args:
        names: Metrics in the columns.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        heads = [_HEADS.get(name, name) for name in names]
        units = [FIGURES[name].unit for name in names]
        least = [_WIDTHS.get(name, _MINIMUM) for name in names]
        self._widths = [
            max(len(head), len(unit), low)
            for head, unit, low in zip(heads, units, least, strict=True)
        ]
        self._right = [FIGURES[name].kind is not Kind.TEXT for name in names]
        self.head = f"{self._join(heads)}\n{self._join(units)}"

    def format(self, figures: Mapping[str, Any]) -> str:
        """Format the row of one episode."""
        return self._join([format_value(name, figures[name]) for name in self._names])

    def _join(self, cells: Sequence[str]) -> str:
        return align_cells(cells, self._widths, self._right)


def format_value(name: str, value: Any) -> str:
    """Format a metric for display: few digits, `-` for a missing value."""
    if value is None:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        digits = {"m": 3, "rad": 2, "s": 1}.get(FIGURES[name].unit, 1)
        return f"{value:.{3 if name.startswith(('plan', 'solve')) else digits}f}"
    return " ".join(str(value).split())


class Totals:
    """Running totals over the episodes, of constant memory.

    Args:
        names: Metrics whose mean and range are collected.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self.episodes = self.frames = self.faulty = 0
        self._seconds = self._idle = 0.0
        self._flags: dict[str, list[int]] = {}
        self._spreads: dict[str, tuple[int, float, float, float]] = {}
        self._robots: dict[str, int] = {}
        self._tasks: dict[str, int] = {}

    def add(self, figures: Mapping[str, Any], has_problems: bool) -> None:
        """Add an episode."""
        self.episodes += 1
        self.frames += figures["length"]
        self.faulty += has_problems
        self._seconds += figures["duration"]
        self._idle += figures["idle_time"] or 0.0
        for name in _COUNTED:
            value = figures[name]
            if value is not None:
                counts = self._flags.setdefault(name, [0, 0])
                counts[0] += bool(value)
                counts[1] += 1
        for name in self._names:
            value = figures[name]
            if value is not None:
                count, total, low, high = self._spreads.get(name, (0, 0.0, value, value))
                self._spreads[name] = count + 1, total + value, min(low, value), max(high, value)
        _count(self._robots, figures["robot"])
        _count(self._tasks, figures["task"])

    def format(self) -> str:
        """Format the totals as several lines."""
        hours = self._seconds / 3600
        time = f"{hours:.2f} h" if hours >= 1 else f"{self._seconds:.1f} s"
        size = f"{say_count(self.episodes, 'episode')}, {say_count(self.frames, 'frame')}"
        lines = [f"{size}, {time}, {self._idle:.1f} s idle"]
        if not self.episodes:
            return "0 episodes"
        lines.append(f"robots: {_list(self._robots)}")
        lines.append(f"tasks: {_list(self._tasks)}")
        counts = []
        for name, text in _COUNTED.items():
            number, known = self._flags.get(name, (0, 0))
            of = "" if known == self.episodes else f" of {known} known"
            counts.append(f"{text} {number}{of}" if known else f"{text} {UNKNOWN}")
        lines.append("episodes with " + ", ".join(counts))
        for name, (count, total, low, high) in self._spreads.items():
            unit = FIGURES[name].unit
            mean, low_text, high_text = (
                format_value(name, float(each)) for each in (total / count, low, high)
            )
            spread = f", {low_text} to {high_text}" if count > 1 else ""
            lines.append(f"{name}: {mean} {unit}".rstrip() + spread)
        return "\n".join(lines)


_COUNTED = {
    "success": "success",
    "fall": "a fall",
    "collision": "a collision",
    "trouble": "trouble",
    "gaps": "gaps in tracking",
    "late": "a late clock",
    "dropped_frames": "dropped images",
    "missing_frames": "missing frames",
}
"""Metrics counted by the number of episodes in which they are true or above 0."""
_LISTED = 8
"""Number of robots or tasks listed by name in the totals."""


def _count(counts: dict[str, int], value: str | None) -> None:
    """Count a value; after a hundred distinct values the rest share one count."""
    name = UNKNOWN if value is None else value
    if name not in counts and len(counts) >= 100:
        name = "…"
    counts[name] = counts.get(name, 0) + 1


def _list(counts: Mapping[str, int]) -> str:
    ranked = sorted(counts.items(), key=lambda pair: -pair[1])
    shown = [f"{' '.join(name.split())} ({number})" for name, number in ranked[:_LISTED]]
    rest = len(ranked) - _LISTED
    return ", ".join([*shown, *([f"and {rest} more"] if rest > 0 else [])])
