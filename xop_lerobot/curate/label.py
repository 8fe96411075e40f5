r"""Label episodes with success and sub-tasks, by rule, by hand or from a file.

    xop-curate label --root outputs/week --out outputs/labelled \
        --success "not fall and duration > 3"
    xop-curate label --root outputs/week --out outputs/labelled \
        --subtask "down=robot_head_z < 1.0" --subtask "up=time > 1"
    xop-curate label --root outputs/week --out outputs/labelled \
        --by-hand labels.json --names reach,lift

--success is an expression over the metrics of an episode, as in `filter`; where it reaches a
missing one, the label is unchanged. --subtask is an expression over the entries of a frame's
columns, by name with `_` for dots (robot_head_z, action_mode_pos), and over time, left and frame;
the first that holds counts. --by-hand writes a strip of images per episode and reads keys in the
terminal; every answer is saved at once, and the next run resumes there.

Success is written to `next.success`, sub-tasks to `subtask_index` with their names in
`meta/subtasks.parquet`; both also to the episode metadata in `meta/xop`.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from xop_lerobot.core.command_line import CommandParser, say_count, split_pair
from xop_lerobot.core.errors import BadValue
from xop_lerobot.curate.arguments import (
    add_destination,
    add_source,
    make_destination,
    show_progress,
)
from xop_lerobot.curate.expression import Expression, Kind
from xop_lerobot.curate.labels import (
    Label,
    list_runs,
    number_frames,
    read_labels,
    set_success,
)
from xop_lerobot.curate.measures import KINDS
from xop_lerobot.curate.source import EpisodeEntry, Source
from xop_lerobot.curate.subtasks import SUBTASK, write_subtasks

if TYPE_CHECKING:
    from xop_lerobot.curate.clip import Clip

OTHER = "other"
"""Sub-task of the frames in which no rule holds."""
_CLOCK = ("time", "left", "frame")
_COUNTED = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_FORM = "NAME=EXPRESSION, such as 'reach=robot_left_wrist_x > 0.3'"


class Entry(NamedTuple):
    """Named entry of a column.

    Attributes:
        column: Key of the column.
        place: Position of the entry in the column.
        kind: Its type.
    """

    column: str
    place: int
    kind: Kind


class FrameRules:
    """Assigns each frame its sub-task by rules.

    Args:
        source: The dataset.
        texts: Rules, `NAME=EXPRESSION`; the first that holds in a frame counts.

    Attributes:
        names: Names of the sub-tasks by index; `other` is the last unless a rule names it.

    Raises:
        BadValue: If a rule is malformed.
        UnknownName: If a rule contains a name that is no entry of a column.
    """

    def __init__(self, source: Source, texts: Sequence[str]) -> None:
        self._source = source
        self._entries = list_entries(source.features)
        kinds = {name: entry.kind for name, entry in self._entries.items()}
        kinds |= dict.fromkeys(_CLOCK, Kind.NUMBER)
        self._rules: list[Expression] = []
        self.names: list[str] = []
        for text in texts:
            name, expression = split_pair(text, f"--subtask takes {_FORM}")
            self._rules.append(Expression(expression, kinds))
            if name not in self.names:
                self.names.append(name)
        self._numbers = [self.names.index(text.partition("=")[0].strip()) for text in texts]
        if OTHER not in self.names:
            self.names.append(OTHER)

    def find(self, entry: EpisodeEntry) -> np.ndarray:
        """Find the index of each frame's sub-task. Shape (n,).

        Raises:
            BadDataset: If the episode cannot be read.
        """
        names = sorted(set().union(*(rule.names for rule in self._rules)))
        used = {name: self._entries[name] for name in names if name not in _CLOCK}
        columns = sorted({each.column for each in used.values()})
        rows = self._source.read(entry, columns) if columns else {}
        values = {name: rows[each.column][:, each.place] for name, each in used.items()}
        fps, length = self._source.fps, entry.length
        frames = np.arange(length)
        values |= {"time": frames / fps, "left": (length - 1 - frames) / fps, "frame": frames}
        numbers = np.full(length, self.names.index(OTHER))
        for frame in range(length):
            here = {name: values[name][frame].item() for name in names}
            for rule, number in zip(self._rules, self._numbers, strict=True):
                if rule.evaluate(here):
                    numbers[frame] = number
                    break
        return numbers


def list_entries(features: Mapping[str, Mapping[str, Any]]) -> dict[str, Entry]:
    """List the entries of numeric and boolean columns by their names in rules."""
    entries: dict[str, Entry] = {}
    for column, feature in features.items():
        kind = Kind.FLAG if feature["dtype"] == "bool" else Kind.NUMBER
        is_number = re.match(r"(bool|u?int|float)", feature["dtype"])
        if column in _COUNTED or not is_number or len(feature["shape"]) != 1:
            continue
        names = feature.get("names")
        size = feature["shape"][0]
        known = isinstance(names, list) and len(names) == size
        for place in range(size):
            end = str(names[place]) if known and isinstance(names, list) else str(place)
            name = column if size == 1 else f"{column}_{end}"
            entries[re.sub(r"\W", "_", name)] = Entry(column, place, kind)
    return entries


SUMMARY = "label success and sub-tasks, by rule, by hand or from a file"

SUCCESS = "next.success"
FEATURES: Mapping[str, Mapping[str, Any]] = {
    SUCCESS: {"dtype": "bool", "shape": [1], "names": ["success"]},
    SUBTASK: {"dtype": "int64", "shape": [1], "names": None},
}


def add_arguments(parser: CommandParser) -> None:
    """Add the verb's flags."""
    add_source(parser)
    add_destination(parser)
    parser.add_argument(
        "--success", metavar="EXPRESSION", help="condition for success, over the metrics"
    )
    parser.add_argument(
        "--subtask",
        action="append",
        default=[],
        metavar="NAME=EXPRESSION",
        help="condition for the frames of a sub-task; may be given several times",
    )
    parser.add_argument("--labels", type=Path, metavar="FILE", help="JSON file of labels")
    parser.add_argument(
        "--by-hand", type=Path, metavar="FILE", help="ask for labels and save them in this file"
    )
    parser.add_argument(
        "--names", default="", metavar="A,B", help="with --by-hand: sub-tasks, numbered from 1"
    )


def run(arguments: argparse.Namespace) -> int:
    """Label a dataset; returns the exit code."""
    ways = [arguments.success or arguments.subtask, arguments.labels, arguments.by_hand]
    if sum(map(bool, ways)) != 1:
        raise BadValue("pass exactly one of: rules (--success, --subtask), --labels, --by-hand")
    with Source(arguments.root) as source:
        destination = make_destination(arguments, source.root)
        labeller = _make_labeller(arguments, source)
        clips = labeller.make_clips(quiet=arguments.quiet)
        if destination is None:
            for _ in clips:
                pass
        else:
            from xop_lerobot.curate.transfer import Step, transfer  # noqa: PLC0415 torch

            file = arguments.labels or arguments.by_hand
            step = Step.now(
                "label",
                success=arguments.success,
                subtask=arguments.subtask or None,
                labels=file and file.name,
            )
            with destination as draft, closing(clips):
                transfer(clips, draft, step, labeller.features)
                if labeller.names:
                    write_subtasks(draft, labeller.names)
    labeller.report()
    if destination is not None:
        print(f"written to {destination.root}")
    return 0


def _make_labeller(arguments: argparse.Namespace, source: Source) -> Labeller:
    if arguments.labels is not None:
        if not arguments.labels.is_file():
            raise BadValue(f"--labels: no such file '{arguments.labels}'")
        return Labeller(source, labels=read_labels(arguments.labels))
    if arguments.by_hand is not None:
        from xop_lerobot.curate.label_by_hand import ask  # noqa: PLC0415 video

        names = [name.strip() for name in arguments.names.split(",") if name.strip()]
        labels = ask(source, arguments.by_hand, names)
        return Labeller(source, labels=labels)
    success = Expression(arguments.success, KINDS) if arguments.success else None
    rules = FrameRules(source, arguments.subtask) if arguments.subtask else None
    return Labeller(source, success, rules)


class Labeller:
    """Adds success and sub-task labels to a dataset's episodes.

    Args:
        source: The dataset.
        success: Rule for success.
        rules: Rules for sub-tasks.
        labels: Labels by episode.

    Attributes:
        names: Names of the sub-tasks; empty if none are labelled.
        features: Features of the new columns.

    Raises:
        BadValue: If there are labels of missing episodes.
    """

    def __init__(
        self,
        source: Source,
        success: Expression | None = None,
        rules: FrameRules | None = None,
        labels: Mapping[int, Label] | None = None,
    ) -> None:
        self._source, self._success, self._rules = source, success, rules
        self._labels = labels or {}
        there = {entry.index for entry in source.episodes} if self._labels else set[int]()
        strange = self._labels.keys() - there
        if strange:
            raise BadValue(
                f"there are labels of episode {min(strange)}, but '{source.root}' has "
                f"{say_count(len(there), 'episode')}"
            )
        self.names = list(rules.names) if rules else []
        marked = [name for each in self._labels.values() for name, _ in each.subtasks]
        if marked:
            self.names = [*dict.fromkeys(marked)]
            self.names += [] if OTHER in self.names else [OTHER]
        self._labels_success = success is not None or any(
            each.success is not None for each in self._labels.values()
        )
        self.features = {
            key: FEATURES[key]
            for key, is_labelled in ((SUCCESS, self._labels_success), (SUBTASK, self.names))
            if is_labelled and key not in source.features
        }
        self._counts = {True: 0, False: 0, None: 0}
        self._changed: list[int] = []
        self._frames: dict[str, int] = dict.fromkeys(self.names, 0)

    def make_clips(self, *, quiet: bool = True) -> Generator[Clip]:
        """Yield every episode with its labels."""
        from xop_lerobot.curate.clip import Clip  # noqa: PLC0415

        source = self._source
        pairs = self._judge()
        for entry, success in show_progress(pairs, source.total_episodes, "episode", quiet=quiet):
            columns: dict[str, np.ndarray] = {}
            facts: dict[str, Any] = {}
            if self._labels_success:
                self._label_success(entry, success, columns, facts)
            if self.names:
                numbers = self._number(entry)
                columns[SUBTASK] = numbers[:, None]
                facts["subtasks"] = list_runs(numbers, self.names)
                for number, count in zip(*np.unique(numbers, return_counts=True), strict=True):
                    self._frames[self.names[number]] += int(count)
            yield Clip(source, entry, facts=facts, columns=columns)

    def _judge(self) -> Generator[tuple[EpisodeEntry, bool | None]]:
        if self._success is None:
            for entry in self._source.episodes:
                yield entry, self._labels.get(entry.index, Label()).success
            return
        from xop_lerobot.curate.survey import survey  # noqa: PLC0415 SciPy, MuJoCo

        for finding in survey(self._source, self._success.names):
            yield finding.entry, self._success.evaluate(finding.figures)

    def _label_success(
        self,
        entry: EpisodeEntry,
        success: bool | None,
        columns: dict[str, np.ndarray],
        facts: dict[str, Any],
    ) -> None:
        self._counts[success] += 1
        has_column = SUCCESS in self._source.features
        column = self._source.read(entry, [SUCCESS])[SUCCESS] if has_column else None
        before = entry.facts.get("success", None if column is None else bool(column[-1, 0]))
        if success is None:
            if column is None:
                columns[SUCCESS] = np.zeros((entry.length, 1), bool)
            return
        columns[SUCCESS] = set_success(column, entry.length, success)
        facts["success"] = success
        if before != success:
            self._changed.append(entry.index)

    def _number(self, entry: EpisodeEntry) -> np.ndarray:
        if self._rules is not None:
            return self._rules.find(entry)
        label = self._labels.get(entry.index, Label())
        rest = self.names.index(OTHER)
        return number_frames(label, self.names, entry.length, self._source.fps, rest)

    def report(self) -> None:
        """Print the counts of labels."""
        if self._labels_success:
            counts = self._counts
            print(
                f"success: {counts[True]} yes, {counts[False]} no, {counts[None]} as before; "
                f"changed: {', '.join(map(str, self._changed)) or 'none'}"
            )
        if self.names:
            fps = self._source.fps
            times = (f"{name} {count / fps:.2f} s" for name, count in self._frames.items())
            print(f"sub-tasks: {', '.join(times)}")
