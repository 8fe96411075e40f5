"""Restore an interrupted recording, up to its last complete episode.

A killed recorder, a full disk or an interrupted copy leaves metadata that is missing or
inconsistent. Every episode with all rows and images is kept; lost episodes are listed with the
reason. Nothing is guessed: rows that were not written are lost.

    xop-curate repair --root outputs/killed --out outputs/restored

Recordings of `xop-record`, and of `lerobot-record` with this project's robots, load after a kill
without repair; this only removes leftover files. LeRobot's own recorder leaves Parquet files
without a footer, whose rows cannot be read.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from xop_lerobot.core.command_line import CommandParser, say_count
from xop_lerobot.curate.arguments import (
    add_destination,
    add_source,
    make_destination,
    show_progress,
)

if TYPE_CHECKING:
    from xop_lerobot.curate.clip import Clip
    from xop_lerobot.curate.damaged import DamagedDataset

SUMMARY = "restore an interrupted recording"


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_source(parser)
    add_destination(parser)


def run(arguments: argparse.Namespace) -> int:
    """Repair a dataset; returns the exit code."""
    from xop_lerobot.curate.damaged import reconstruct  # noqa: PLC0415 torch
    from xop_lerobot.curate.transfer import Step, transfer  # noqa: PLC0415 torch

    root: Path = arguments.root
    destination = make_destination(arguments, root)
    if destination is None:
        with tempfile.TemporaryDirectory() as folder:
            report(reconstruct(root, Path(folder) / "damaged"))
        return 0
    with destination as draft:
        damaged = reconstruct(root, draft.with_name("damaged"))
        report(damaged)
        step = dataclasses.replace(Step.now("repair"), root=root)
        transfer(_make_clips(damaged, quiet=arguments.quiet), draft, step)
    print(f"written to {destination.root}")
    return 0


def _make_clips(damaged: DamagedDataset, *, quiet: bool) -> Iterator[Clip]:
    from xop_lerobot.curate.clip import Clip  # noqa: PLC0415

    total = len(damaged.entries)
    for entry in show_progress(damaged.entries, total, "episode", quiet=quiet):
        yield Clip(damaged.source, entry)


def report(damaged: DamagedDataset) -> None:
    """Print findings, complete episodes and lost ones."""
    for note in damaged.notes:
        print(note)
    for index, reason in sorted(damaged.lost.items()):
        print(f"episode {index} is lost: {reason}")
    if not damaged.notes and not damaged.lost:
        print("no damage found")
    frames = sum(entry.length for entry in damaged.entries)
    whole = f"{say_count(len(damaged.entries), 'episode')}, {say_count(frames, 'frame')}"
    print(f"complete: {whole}. Lost: {len(damaged.lost)}")
