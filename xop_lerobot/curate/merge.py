"""Merge several datasets into one, in the order given.

They must have the same robot, rate and columns. The metadata of every episode, which LeRobot's own
merge drops in part, is kept, and its `provenance` names the source dataset. Images are copied, not
re-encoded.

    xop-curate merge --root outputs/monday outputs/tuesday --out outputs/week
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from xop_lerobot.core.command_line import CommandParser, say_count
from xop_lerobot.core.errors import BadDataset, BadValue
from xop_lerobot.curate.arguments import (
    add_destination,
    add_sources,
    get_roots,
    make_destination,
    show_progress,
)
from xop_lerobot.curate.source import Source

if TYPE_CHECKING:
    from xop_lerobot.curate.clip import Clip

SUMMARY = "merge datasets into one"

_COMPARED = ("dtype", "shape", "names")


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_sources(parser)
    add_destination(parser, in_place=False)


def run(arguments: argparse.Namespace) -> int:
    """Merge datasets; returns the exit code."""
    roots = get_roots(arguments)
    if len({root.resolve() for root in roots}) < len(roots):
        raise BadValue("--root names a dataset twice, so its episodes would be duplicated")
    with ExitStack() as stack:
        sources = [stack.enter_context(Source(root)) for root in roots]
        check_alike(sources)
        destination = make_destination(arguments, *roots)
        if destination is None:
            for source in sources:
                print(f"{source.root}: {say_count(sum(1 for _ in source.episodes), 'episode')}")
            return 0
        from xop_lerobot.curate.transfer import Step, transfer  # noqa: PLC0415 torch

        features = merge_video_features(sources)
        with destination as draft:
            clips = _make_clips(sources, quiet=arguments.quiet)
            done = transfer(clips, draft, Step.now("merge"), features)
    print(
        f"{say_count(done.episodes, 'episode')}, {say_count(done.frames, 'frame')} of "
        f"{say_count(len(roots), 'dataset')}, "
        f"written to {destination.root}"
    )
    return 0


def _make_clips(sources: Sequence[Source], *, quiet: bool) -> Iterator[Clip]:
    from xop_lerobot.curate.clip import Clip  # noqa: PLC0415

    total = sum(source.total_episodes for source in sources)
    pairs = ((source, entry) for source in sources for entry in source.episodes)
    for source, entry in show_progress(pairs, total, "episode", quiet=quiet):
        yield Clip(source, entry)


def check_alike(sources: Sequence[Source]) -> None:
    """Check that datasets have the same rate, robot and columns.

    Raises:
        BadDataset: If one differs from the first, naming the difference.
    """
    first = sources[0]
    for source in sources[1:]:
        for name, value, expected in (
            ("fps", source.fps, first.fps),
            ("robot_type", source.robot, first.robot),
        ):
            if value != expected:
                raise BadDataset(
                    source.root, f"its {name} is {value}, that of '{first.root}' is {expected}"
                )
        for words, keys in (
            ("missing column", first.features.keys() - source.features.keys()),
            ("extra column", source.features.keys() - first.features.keys()),
        ):
            if keys:
                raise BadDataset(
                    source.root, f"{words} {', '.join(sorted(keys))}, compared with '{first.root}'"
                )
        for key, feature in source.features.items():
            for name in _COMPARED:
                value, expected = feature.get(name), first.features[key].get(name)
                if value != expected:
                    raise BadDataset(
                        source.root,
                        f"{name} of its column '{key}' is {value}, "
                        f"that of '{first.root}' is {expected}",
                    )


def merge_video_features(sources: Sequence[Source]) -> Mapping[str, Any]:
    """Return the video features that hold for all datasets, as LeRobot's merge computes them."""
    from lerobot.datasets.aggregate import (  # noqa: PLC0415 torch
        merge_video_feature_info_for_aggregate,
    )

    all_features: list[Any] = [SimpleNamespace(features=source.features) for source in sources]
    merged = merge_video_feature_info_for_aggregate(all_features)
    return {key: feature for key, feature in merged.items() if feature["dtype"] == "video"}
