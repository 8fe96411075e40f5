"""Flags that several verbs share, with the same meaning everywhere."""

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
    """Add `--root`, the dataset to read."""
    parser.add_argument(
        "--root", type=Path, required=True, metavar="DIR", help="directory of the dataset"
    )
    add_quiet(parser)


def add_sources(parser: CommandParser) -> None:
    """Add `--root` for several datasets; `get_roots` returns them."""
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
    """Return the directories of `add_sources` in the order given."""
    return [root for roots in arguments.root for root in roots]


def add_quiet(parser: CommandParser) -> None:
    """Add `--quiet`."""
    parser.add_argument("--quiet", action="store_true", help="hide the progress bar")


def add_destination(parser: CommandParser, *, in_place: bool = True) -> None:
    """Add `--out`, `--dry-run` and, where a verb can change a dataset in place, `--in-place`."""
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="directory of the new dataset, which must not exist; the source is not changed",
    )
    if in_place:
        parser.add_argument(
            "--in-place",
            action="store_true",
            help="replace the source by the new dataset; the source is deleted",
        )
    parser.add_argument(
        "--dry-run", action="store_true", help="report what would be done, without writing"
    )


def make_destination(
    arguments: argparse.Namespace, source: Path, *others: Path
) -> Destination | None:
    """Make the destination that the flags of `add_destination` ask for; None for a dry run.

    Call it before any work is done: it raises where the result could not be written. A dry run
    checks the same, if a place is given.

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
        raise BadValue(f"missing output: pass {choices}, or --dry-run")
    destination = Destination(out, source, *others)
    return None if arguments.dry_run else destination


_SPAN = re.compile(r"(\d+)(?:(-|:)(\d+))?")


def parse_episodes(text: str) -> list[int]:
    """Parse a list of episodes: `0,3,8-11` includes 11, `0,3,8:12` excludes 12, as in Python.

    Returns:
        Indices in ascending order, without duplicates.

    Raises:
        BadValue: If it is malformed or a range is empty.
    """
    chosen: set[int] = set()
    for part in text.split(","):
        span = _SPAN.fullmatch(part.strip())
        if span is None:
            raise BadValue(f"--episodes must be such as 0,3,8-11 or 0,3,8:12, got '{text}'")
        first, sign, last = span.groups()
        named = range(int(first), int(last or first) + (sign != ":"))
        if not named:
            raise BadValue(f"--episodes has '{part.strip()}', an empty range, in '{text}'")
        chosen.update(named)
    return sorted(chosen)


def show_progress[T](
    things: Iterable[T], total: int | None, unit: str, *, quiet: bool = False
) -> Iterator[T]:
    """Yield `things` with a progress bar on stderr, if that is a terminal."""
    disable = True if quiet else None  # None: hide the bar if stderr is not a terminal
    yield from tqdm(things, total=total, unit=unit, disable=disable, file=sys.stderr, leave=False)
