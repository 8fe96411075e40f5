r"""Write the episodes for which an expression holds to a new dataset.

    xop-curate filter --root outputs/week --out outputs/good \
        --where "success and tracking_p95 < 0.1 and not fall"
    xop-curate filter --root outputs/week --where "duration > 5 and idle_time < 2" --dry-run

In the expression: and or not, < <= > >= == !=, in, is None, + - * / %, abs min max, numbers,
'texts', (lists), True False. A metric is missing where the dataset lacks its columns. Episodes for
which the expression, evaluated from left to right, reaches a missing metric are left out and
counted, unless --keep-unknown is given; `x is None` tests whether x is missing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from xop_lerobot.core.command_line import CommandParser
from xop_lerobot.core.errors import BadDataset, XopError
from xop_lerobot.curate.arguments import (
    add_destination,
    add_source,
    make_destination,
    show_progress,
)
from xop_lerobot.curate.expression import Expression
from xop_lerobot.curate.measures import KINDS, describe_figures
from xop_lerobot.curate.source import EpisodeEntry, Source

if TYPE_CHECKING:
    from xop_lerobot.curate.clip import Clip
    from xop_lerobot.curate.survey import Finding

SUMMARY = "keep the episodes for which an expression over their metrics holds"

_LISTED = 20
"""Number of episodes listed in the report."""


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_source(parser)
    parser.add_argument(
        "--where",
        required=True,
        metavar="EXPRESSION",
        help="condition for keeping an episode, 'success and tracking_p95 < 0.1 and not fall'",
    )
    parser.add_argument(
        "--keep-unknown",
        action="store_true",
        help="also keep episodes for which it reaches a missing metric",
    )
    add_destination(parser)
    parser.epilog = f"metrics:\n{describe_figures()}"


def run(arguments: argparse.Namespace) -> int:
    """Filter a dataset; returns the exit code."""
    expression = Expression(arguments.where, KINDS)
    with Source(arguments.root) as source:
        destination = make_destination(arguments, source.root)
        choice = Filter(source, expression, keep_unknown=arguments.keep_unknown)
        entries = choice.choose(quiet=arguments.quiet)
        if destination is None:
            for _ in entries:
                pass
        else:
            from xop_lerobot.curate.transfer import Step, transfer  # noqa: PLC0415 torch

            step = Step.now("filter", where=expression.text, keep_unknown=arguments.keep_unknown)
            try:
                with destination as draft:
                    transfer(_make_clips(choice, entries), draft, step)
            except BadDataset as error:
                if choice.failed:  # the metadata is damaged, so no expression avoids it
                    raise
                hint = f'--where "({expression.text}) and readable" leaves such episodes out'
                raise BadDataset(error.root, f"{error.fault}. {hint}") from error
    choice.report()
    if destination is not None:
        print(f"written to {destination.root}")
    return 0


def _make_clips(choice: Filter, entries: Iterator[EpisodeEntry]) -> Iterator[Clip]:
    from xop_lerobot.curate.clip import Clip  # noqa: PLC0415 only where something is written

    for entry in entries:
        yield Clip(choice.source, entry)
    choice.check()


class Filter:
    """Chooses episodes of a dataset.

    Args:
        source: The dataset.
        expression: Condition for keeping an episode.
        keep_unknown: Whether to keep episodes for which it has no result.

    Attributes:
        source: The dataset.
        failed: Whether an error came from reading the source here, and not from the consumer of the
            episodes.
    """

    def __init__(
        self, source: Source, expression: Expression, *, keep_unknown: bool = False
    ) -> None:
        self.source, self._expression, self._keep_unknown = source, expression, keep_unknown
        self.failed = False
        self._kept = self._dropped = self._unknown = 0
        self._seconds = self._kept_seconds = 0.0
        self._listed: list[int] = []
        self._missing: dict[str, int] = {}

    def choose(self, *, quiet: bool = True) -> Iterator[EpisodeEntry]:
        """Yield the episodes to keep."""
        from xop_lerobot.curate.survey import survey  # noqa: PLC0415 SciPy, MuJoCo

        findings = self._guard(survey(self.source, self._expression.names))
        total = self.source.total_episodes
        for finding in show_progress(findings, total, "episode", quiet=quiet):
            for problem in finding.problems:
                tqdm.write(f"problem: {problem}", file=sys.stderr)
            result = self._expression.evaluate(finding.figures)
            if self._note(finding.entry, result, finding.figures):
                yield finding.entry

    def _guard(self, findings: Iterator[Finding]) -> Iterator[Finding]:
        try:
            yield from findings
        except BadDataset:
            self.failed = True
            raise

    def _note(self, entry: EpisodeEntry, result: bool | None, figures: Mapping[str, Any]) -> bool:
        seconds = entry.length / self.source.fps
        self._seconds += seconds
        if result is None:
            self._unknown += 1
            for name, value in figures.items():
                if value is None:
                    self._missing[name] = self._missing.get(name, 0) + 1
        is_kept = self._keep_unknown if result is None else result
        if is_kept:
            self._kept += 1
            self._kept_seconds += seconds
        else:
            self._dropped += 1
            if len(self._listed) < _LISTED:
                self._listed.append(entry.index)
        return is_kept

    def check(self) -> None:
        """Check that an episode was kept.

        Raises:
            XopError: If none was; the message says why.
        """
        if self._kept:
            return
        why = f": for {self._unknown} it is not known ({self._describe()})" if self._unknown else ""
        raise XopError(
            f"'{self._expression.text}' holds for none of the {self._dropped} episodes{why}. "
            "No dataset is made"
        )

    def _describe(self) -> str:
        missing = ", ".join(f"{name} in {count}" for name, count in self._missing.items())
        return missing or "a division by 0"

    def report(self) -> None:
        """Print how many episodes were kept and which were left out."""
        total = self._kept + self._dropped
        print(
            f"{self._kept} of {total} episodes kept, {self._kept_seconds:.1f} s of "
            f"{self._seconds:.1f} s"
        )
        if self._dropped:
            more = ", …" if self._dropped > len(self._listed) else ""
            print(f"left out: {', '.join(map(str, self._listed))}{more}")
        if self._unknown:
            fate = "kept" if self._keep_unknown else "left out"
            print(f"not known for {self._unknown}, {fate}: {self._describe()}")
