"""Rules that hold in some frames of an episode and not in others: what sub-tasks are told by.

A rule is an expression as in `xop-curate filter`, over what a frame has: every entry of every
column by the name `<column>_<entry>` with `_` for each dot (`robot_head_z`, `action_mode_pos`,
`operator_pinch_left`), and

    time     since the episode's first frame [s]
    left     until its last [s]
    frame    number of the frame
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.curate.expression import Expression, Kind
from xop_lerobot.curate.source import EpisodeEntry, Source

OTHER = "other"
"""Sub-task of the frames in which no rule holds."""
_CLOCK = ("time", "left", "frame")
_COUNTED = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_FORM = "NAME=EXPRESSION, such as 'reach=robot_left_wrist_x > 0.3'"


class Entry(NamedTuple):
    """An entry of a column.

    Attributes:
        column: Key of the column.
        place: Which of its entries.
        kind: What it is.
    """

    column: str
    place: int
    kind: Kind


class FrameRules:
    """Names the sub-task of each frame.

    Args:
        source: The dataset.
        texts: Rules, `NAME=EXPRESSION`; the first that holds in a frame counts.

    Attributes:
        names: Names of the sub-tasks, in the order of their numbers; `other` is the last.

    Raises:
        BadValue: If a rule is malformed.
        UnknownName: If one has a name that is no entry of a column.
    """

    def __init__(self, source: Source, texts: Sequence[str]) -> None:
        self._source = source
        self._entries = list_entries(source.features)
        kinds = {name: entry.kind for name, entry in self._entries.items()}
        kinds |= dict.fromkeys(_CLOCK, Kind.NUMBER)
        self._rules: list[Expression] = []
        self.names: list[str] = []
        for text in texts:
            name, equals, expression = text.partition("=")
            name = name.strip()
            if not equals or not name or not expression.strip():
                raise BadValue(f"--subtask takes {_FORM}, got '{text}'")
            self._rules.append(Expression(expression, kinds))
            if name not in self.names:
                self.names.append(name)
        self._numbers = [self.names.index(text.partition("=")[0].strip()) for text in texts]
        if OTHER not in self.names:
            self.names.append(OTHER)

    def find(self, entry: EpisodeEntry) -> np.ndarray:
        """Find the number of each frame's sub-task. Shape (n,).

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
    """List the entries of a dataset's columns of numbers and flags by their names in rules."""
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
