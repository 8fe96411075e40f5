"""Write a page that shows a dataset: one file with images, timelines, metrics and plots.

    xop-curate report --root outputs/week --out week.html
    xop-curate report --root outputs/week --out week.html --episodes 0,3,8-11 --overwrite
    xop-curate report --root outputs/week --dry-run

The page needs no other file and no network. It shows of each episode a strip of images and, once
opened, its timelines: goal and robot, command, cost by term, planner, operator, gaps in tracking;
a table of all episodes, which sorts by any metric; and plots of the metrics over them. What a
dataset has no columns for is left out, and the page says so; so it does of what cannot be read, and
the exit code is 1 then.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterable
from pathlib import Path

from xop_lerobot.core.command_line import CommandParser, say_count
from xop_lerobot.core.errors import BadDataset, BadValue
from xop_lerobot.curate.arguments import add_source, parse_episodes, show_progress
from xop_lerobot.curate.source import Source

SUMMARY = "write one HTML page: images, timelines, metrics and plots of the episodes"

PAGE = "index.html"
_SUFFIXES = (".html", ".htm")
_DETAILED, _PICTURES, _WIDTH, _POINTS = 200, 8, 160, 300
_LEAST = {"detailed": 0, "pictures": 0, "width": 16, "points": 2}


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_source(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="the page, .html; or a directory, in which it is index.html. It must not exist",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a page that is there")
    parser.add_argument(
        "--dry-run", action="store_true", help="say what would be shown, and write nothing"
    )
    parser.add_argument("--episodes", metavar="A,B-C", help="such as 0,3,8-11 (default: all)")
    for name, default, text in (
        ("--detailed", _DETAILED, "episodes with pictures and timelines, evenly chosen; the "
         "others are in table and plots alone"),
        ("--pictures", _PICTURES, "pictures of each camera and episode"),
        ("--width", _WIDTH, "width of a picture [pixel]"),
        ("--points", _POINTS, "points of a curve, 2 or more; its peaks are kept"),
    ):  # fmt: skip
        parser.add_argument(
            name, type=int, default=default, metavar="N", help=f"{text} (default: {default})"
        )


def run(arguments: argparse.Namespace) -> int:
    """Write the report of a dataset; returns the exit code."""
    from xop_lerobot.curate.order_check import check_whole  # noqa: PLC0415
    from xop_lerobot.curate.report_page import Limits, Report  # noqa: PLC0415
    from xop_lerobot.curate.survey import survey  # noqa: PLC0415
    from xop_lerobot.curate.timeline import list_missing  # noqa: PLC0415

    limits = Limits(arguments.pictures, arguments.width, arguments.points)
    given = {"detailed": arguments.detailed, **dataclasses.asdict(limits)}
    for name, least in _LEAST.items():
        value = given[name]
        if value < least:
            raise BadValue(f"--{name} must be {least} or more, got {value}")
    chosen = arguments.episodes
    wanted = None if chosen is None else set(parse_episodes(chosen))
    page = find_page(arguments)
    with Source(arguments.root) as source:
        count = count_episodes(source, wanted)
        detailed = min(count, arguments.detailed)
        missing = list_missing(source.features)
        print(f"{say_count(count, 'episode')}, {detailed} of them with pictures and timelines")
        if missing:
            print(f"left out, for want of columns: {'; '.join(missing)}")
        if page is None:
            return 0
        faults: list[str] = []
        with Report(page, source, limits, count, detailed, chosen=wanted is not None) as report:
            findings = survey(source, note=faults.append, episodes=wanted)
            for finding in show_progress(findings, count, "episode", quiet=arguments.quiet):
                report.add(finding)
            total = source.total_episodes
            if wanted is None and not faults and report.episodes != total:
                faults.append(
                    f"meta/info.json counts {say_count(total, 'episode')}, "
                    f"there are {report.episodes}"
                )
            if wanted is None and not faults:
                faults += check_whole(source, report.frames)
            report.finish(faults, missing)
    for fault in faults:
        print(f"problem: {fault}", file=sys.stderr)
    if report.faulty:
        print(
            f"problem: {report.faulty} of {report.episodes} episodes cannot be read as a whole; "
            "the page says why",
            file=sys.stderr,
        )
    print(f"written to {page}, {page.stat().st_size / 1e6:.1f} MB")
    return 1 if faults or report.faulty else 0


def find_page(arguments: argparse.Namespace) -> Path | None:
    """Find the file that the flags ask for; None for a dry run without one.

    Raises:
        BadValue: If there is none, it exists already, or it lies in the dataset.
    """
    out: Path | None = arguments.out
    if out is None:
        if arguments.dry_run:
            return None
        raise BadValue("say where the page goes: --out=FILE.html, or --dry-run")
    page = out if out.suffix.lower() in _SUFFIXES and not out.is_dir() else out / PAGE
    if page.resolve().is_relative_to(arguments.root.resolve()):
        raise BadValue(
            f"'{page}' is inside of the dataset '{arguments.root}'. Choose another --out"
        )
    if page.is_dir():
        raise BadValue(f"'{page}' is a directory. Choose another --out")
    if page.exists() and not arguments.overwrite:
        raise BadValue(f"'{page}' exists already. Choose another --out, or add --overwrite")
    return None if arguments.dry_run else page


def count_episodes(source: Source, wanted: Iterable[int] | None) -> int:
    """Count the episodes that are there and wanted.

    Raises:
        BadDataset: If a wanted one is not there, or nothing of the metadata is readable.
    """
    faults: list[str] = []
    left = None if wanted is None else set(wanted)
    there = count = 0
    for entry in source.iterate(faults.append):
        there += 1
        count += left is None or entry.index in left
        if left is not None:
            left.discard(entry.index)
    if faults and not there:
        raise BadDataset(source.root, faults[0])
    if left:
        raise BadDataset(
            source.root,
            f"it has no episode {', '.join(map(str, sorted(left)))} (it has {there})",
        )
    return count
