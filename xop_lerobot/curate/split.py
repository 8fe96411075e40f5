"""Split a dataset into several, by fractions or by naming episodes.

    xop-curate split --root outputs/boxes --out outputs/parts --parts train=0.8 val=0.2
    xop-curate split --root outputs/boxes --out outputs/parts --parts a=0:10 b=12,15,20:30

Each part is a dataset in its own directory, `OUT/NAME`. Fractions are taken in the order of the
episodes, as by LeRobot's own split, or at random with `--shuffle SEED`. The metadata of every
episode is kept, and no image is re-encoded.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.command_line import CommandParser, say_count
from xop_lerobot.core.errors import BadValue
from xop_lerobot.curate.arguments import (
    add_destination,
    add_source,
    make_destination,
    parse_episodes,
    show_progress,
)
from xop_lerobot.curate.source import Source

if TYPE_CHECKING:
    from xop_lerobot.curate.clip import Clip

SUMMARY = "split a dataset into several"

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_FORM = "NAME=FRACTION or NAME=EPISODES, such as train=0.8, val=0,3,8-11 or val=0,3,8:12"


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_source(parser)
    add_destination(parser, in_place=False)
    parser.add_argument(
        "--parts", required=True, nargs="+", metavar="NAME=SHARE", help=f"the parts: {_FORM}"
    )
    parser.add_argument(
        "--shuffle",
        type=int,
        metavar="SEED",
        help="draw the episodes of fractions at random (default: in order)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Split a dataset; returns the exit code."""
    shares = parse_parts(arguments.parts)
    with Source(arguments.root) as source:
        indices = [entry.index for entry in source.episodes]
        parts = assign(shares, indices, arguments.shuffle)
        destination = make_destination(arguments, source.root)
        if destination is not None:
            from xop_lerobot.curate.transfer import (  # noqa: PLC0415 torch
                Step,
                transfer,
            )

            with destination as draft:
                draft.mkdir()
                for name, chosen in parts.items():
                    step = Step.now("split", part=name, shuffle=arguments.shuffle)
                    clips = _make_clips(source, chosen, quiet=arguments.quiet)
                    transfer(clips, draft / name, step)
    for name, chosen in parts.items():
        print(f"{name}: {say_count(len(chosen), 'episode')} ({format_indices(chosen)})")
    left = sorted(set(indices) - {index for chosen in parts.values() for index in chosen})
    if left:
        print(f"in no part: {say_count(len(left), 'episode')} ({format_indices(left)})")
    if destination is not None:
        print(f"written to {destination.root}")
    return 0


def _make_clips(source: Source, chosen: Sequence[int], *, quiet: bool) -> Iterator[Clip]:
    from xop_lerobot.curate.clip import Clip  # noqa: PLC0415

    wanted = set(chosen)
    entries = (entry for entry in source.episodes if entry.index in wanted)
    for entry in show_progress(entries, len(wanted), "episode", quiet=quiet):
        yield Clip(source, entry)


def parse_parts(texts: Sequence[str]) -> dict[str, float | list[int]]:
    """Parse `--parts`: a fraction or a list of episodes by part name.

    Raises:
        BadValue: If it is malformed, mixes fractions and lists, or the fractions exceed 1.
    """
    parts: dict[str, float | list[int]] = {}
    for text in texts:
        name, _, share = text.partition("=")
        if not _NAME.fullmatch(name) or not share:
            raise BadValue(f"--parts takes {_FORM}, got '{text}'")
        if name in parts:
            raise BadValue(f"--parts has '{name}' twice")
        parts[name] = _parse_share(text, share)
    fractions = [share for share in parts.values() if isinstance(share, float)]
    if fractions and len(fractions) < len(parts):
        raise BadValue("--parts must be all fractions or all lists of episodes")
    if sum(fractions) > 1 + 1e-9:
        raise BadValue(f"the fractions of --parts must add up to 1 at most, got {sum(fractions):g}")
    return parts


def _parse_share(text: str, share: str) -> float | list[int]:
    if "." not in share:
        try:
            return parse_episodes(share)
        except BadValue:
            raise BadValue(f"--parts takes {_FORM}, got '{text}'") from None
    try:
        fraction = float(share)
    except ValueError:
        raise BadValue(f"--parts takes {_FORM}, got '{text}'") from None
    if not 0 < fraction <= 1:
        raise BadValue(f"a fraction must be above 0 and at most 1, got '{text}'")
    return fraction


def format_indices(indices: Sequence[int]) -> str:
    """Format ascending indices as `0, 3, 10:20`."""
    pieces: list[list[int]] = []
    for index in sorted(indices):
        if pieces and index == pieces[-1][1]:
            pieces[-1][1] = index + 1
        else:
            pieces.append([index, index + 1])
    return ", ".join(
        f"{start}" if stop == start + 1 else f"{start}:{stop}" for start, stop in pieces
    )


def assign(
    shares: Mapping[str, float | list[int]], indices: Sequence[int], seed: int | None = None
) -> dict[str, list[int]]:
    """Assign episodes to parts.

    Args:
        shares: Result of `parse_parts`.
        indices: Indices of the existing episodes.
        seed: Seed of the random draw, None to keep the order.

    Raises:
        BadValue: If an episode does not exist or is in two parts, or a part is empty.
    """
    order = list(indices)
    if seed is not None:
        order = np.random.default_rng(seed).permutation(order).tolist()
    parts: dict[str, list[int]] = {}
    taken: dict[int, str] = {}
    total = 0.0
    for name, share in shares.items():
        if not isinstance(share, list):
            start = round(total * len(order))
            total += share
            chosen = sorted(order[start : round(total * len(order))])
        else:
            chosen = sorted(share)
        for index in chosen:
            if index not in set(indices):
                raise BadValue(
                    f"part '{name}' asks for episode {index}. There are {format_indices(indices)}"
                )
            if index in taken:
                raise BadValue(f"episode {index} is in the parts '{taken[index]}' and '{name}'")
            taken[index] = name
        if not chosen:
            raise BadValue(f"part '{name}' would have no episode; there are {len(indices)} in all")
        parts[name] = chosen
    return parts
