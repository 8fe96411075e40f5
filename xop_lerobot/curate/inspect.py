"""Show what is in a dataset, episode by episode, and change nothing.

    xop-curate inspect --root outputs/walk
    xop-curate inspect --root outputs/walk --json walk.json --quiet
    xop-curate inspect --root outputs/walk --show episode,success,tracking_head_p95,task

What a dataset has no columns for is not known: `-` in the table, null in JSON. Files that cannot be
read are named; the exit code is 1 then, and everything else is shown all the same.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from tqdm import tqdm

from xop_lerobot.core.command_line import CommandParser, can_print_anything
from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.wording import say_count
from xop_lerobot.curate.arguments import add_source, show_progress
from xop_lerobot.curate.expression import UnknownFigure
from xop_lerobot.curate.figures import FIGURES, KINDS, describe_figures
from xop_lerobot.curate.source import Source

SUMMARY = "show what is in a dataset: tracking, smoothness, falls, gaps, idle time, …"

SHOWN = (
    "episode", "duration", "success", "fall", "collision", "tracking_mean", "tracking_p95",
    "tracking_angle_mean", "tracking_angle_p95", "command_roughness", "gap_time", "late",
    "dropped_frames", "plan_age_p95", "idle_time", "robot", "task",
)  # fmt: skip
"""Columns of the table, unless others are asked for."""
SUMMARISED = (
    "duration", "tracking_mean", "tracking_p95", "tracking_angle_mean", "command_roughness",
    "command_ldlj", "hand_jerk", "plan_age_p95",
)  # fmt: skip
"""Numbers whose mean and range are told in the end."""
_STANDARD_OUTPUT = "-"


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_source(parser)
    parser.add_argument(
        "--json",
        metavar="FILE",
        help="write all figures as a list of objects, one an episode; - for standard output, "
        "without a table then (default: none)",
    )
    parser.add_argument(
        "--show",
        default=",".join(SHOWN),
        metavar="A,B,…",
        help=f"figures that are the columns of the table (default: {', '.join(SHOWN)})",
    )
    parser.epilog = f"figures:\n{describe_figures()}"


def run(arguments: argparse.Namespace) -> int:
    """Inspect a dataset; returns the exit code."""
    from xop_lerobot.curate.order_check import check_whole  # noqa: PLC0415
    from xop_lerobot.curate.survey import survey  # noqa: PLC0415 SciPy, MuJoCo
    from xop_lerobot.curate.tables import Table, Totals  # noqa: PLC0415

    shown = parse_names(arguments.show)
    to_output = arguments.json == _STANDARD_OUTPUT
    table, totals, faults = Table(shown), Totals(SUMMARISED), list[str]()
    with Source(arguments.root) as source, _open_list(arguments.json) as write:
        if not to_output:
            print(table.head)
        findings = survey(source, note=faults.append)
        total = source.total_episodes
        # On a terminal the table itself shows how far it is.
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
    """Read names of figures with commas between.

    Raises:
        UnknownFigure: If one is unknown, listing the known ones.
        BadValue: If there is none.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in FIGURES:
            raise UnknownFigure(name, KINDS)
    if not names:
        raise BadValue(f"--show must name figures, got '{text}'. Known: {', '.join(FIGURES)}")
    return names


@contextmanager
def _open_list(file: str | None) -> Iterator[Any]:
    """Open a JSON list that is written an object at a time; a file is there whole or not at all."""
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
    """Writes a JSON list to a stream, an object a line."""

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
