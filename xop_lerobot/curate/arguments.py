"""Flags that several verbs share, so that they read and mean the same everywhere."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from tqdm import tqdm

from xop_lerobot.core.command_line import CommandParser
from xop_lerobot.core.errors import BadValue
from xop_lerobot.curate.destination import Destination


def add_source(parser: CommandParser) -> None:
    """Add `--root`, the dataset that is read."""
    parser.add_argument(
        "--root", type=Path, required=True, metavar="DIR", help="directory of the dataset"
    )
    add_quiet(parser)


def add_sources(parser: CommandParser) -> None:
    """Add `--root` for several datasets, as `arguments.root`, a list of lists: see `get_roots`."""
    parser.add_argument(
        "--root",
        type=Path,
        required=True,
        nargs="+",
        action="append",
        metavar="DIR",
        help="directories of the datasets; may be given several times",
    )
    add_quiet(parser)


def get_roots(arguments: argparse.Namespace) -> list[Path]:
    """Return the directories of `add_sources` in their order."""
    return [root for roots in arguments.root for root in roots]


def add_quiet(parser: CommandParser) -> None:
    """Add `--quiet`."""
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def add_destination(parser: CommandParser, *, in_place: bool = True) -> None:
    """Add `--out`, `--dry-run` and, where a verb can change a dataset in place, `--in-place`."""
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="directory of the new dataset, which must not exist; the source stays as it is",
    )
    if in_place:
        parser.add_argument(
            "--in-place",
            action="store_true",
            help="put the new dataset in the place of the source, which is deleted",
        )
    parser.add_argument(
        "--dry-run", action="store_true", help="say what would be done, and do nothing"
    )


def make_destination(
    arguments: argparse.Namespace, source: Path, *others: Path
) -> Destination | None:
    """Make the place that `add_destination`'s flags ask for; None for a dry run.

    Call it before any work is done: it refuses what could not be written in the end. A dry run
    refuses the same, if a place is given.

    Raises:
        BadValue: Unless exactly one of `--out` and `--in-place` is given.
        FolderTaken: If the place is not free.
    """
    out: Path | None = arguments.out
    in_place = bool(getattr(arguments, "in_place", False))
    if out is not None and in_place:
        raise BadValue("--out and --in-place exclude each other")
    if out is None and not in_place:
        if arguments.dry_run:
            return None
        choices = "--out=DIR, --in-place" if hasattr(arguments, "in_place") else "--out=DIR"
        raise BadValue(f"say where the new dataset goes: {choices}, or --dry-run")
    destination = Destination(out, source, *others)
    return None if arguments.dry_run else destination


_SPAN = re.compile(r"(\d+)(?:(-|:)(\d+))?")


def parse_episodes(text: str) -> list[int]:
    """Read a choice of episodes: `0,3,8-11` with 11, or `0,3,8:12` without 12, as in Python.

    Returns:
        Their indices, in ascending order and without repetition.

    Raises:
        BadValue: If it is none.
    """
    chosen: set[int] = set()
    for part in text.split(","):
        span = _SPAN.fullmatch(part.strip())
        if span is None:
            raise BadValue(f"--episodes must be such as 0,3,8-11 or 0,3,8:12, got '{text}'")
        first, sign, last = span.groups()
        named = range(int(first), int(last or first) + (sign != ":"))
        if not named:
            raise BadValue(f"--episodes has '{part.strip()}', which names none, in '{text}'")
        chosen.update(named)
    return sorted(chosen)


def show_progress[T](
    things: Iterable[T], total: int | None, unit: str, *, quiet: bool = False
) -> Iterator[T]:
    """Yield `things` under a progress bar on standard error, if that is a terminal."""
    disable = True if quiet else None  # None: none where standard error is no terminal
    yield from tqdm(things, total=total, unit=unit, disable=disable, file=sys.stderr, leave=False)
