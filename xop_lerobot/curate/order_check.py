"""Check that episodes, rows and times are numbered as LeRobot assumes.

No fault here makes rows or images unreadable: every verb that writes a dataset renumbers it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from xop_lerobot.core.command_line import say_count
from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.entries import UNREADABLE, EpisodeEntry
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.task_words import (
    TASK,
    TASKS_FILE,
    has_index_of_words,
    read_tasks,
)
from xop_lerobot.operator.dataset_recording import CLOCKS
from xop_lerobot.operator.recording import FARTHEST_M
from xop_lerobot.operator.row_clock import LONGEST_HOLD_S, read_row_clock

_FIX = "`xop-curate filter` renumbers it"
_TOLERANCE_S = 1e-4
"""LeRobot's tolerance between the time stamps of a row and of its image [s]."""
_POSES = ("operator.", "goal.", "robot.")
_POSE_SIZE = 7


class OrderCheck:
    """Checks all episodes, one after another in the order of the metadata.

    Args:
        source: The dataset.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        features = source.features
        counters = ("timestamp", "frame_index", "index", TASK)
        clocks = [name for name in CLOCKS if name not in counters]
        poses = [key for key in features if key.startswith(_POSES)]
        sizes = dict.fromkeys((*counters, *clocks), 1) | dict.fromkeys(poses, _POSE_SIZE)
        self.columns = tuple(
            name
            for name, size in sizes.items()
            if name in features
            and list(features[name]["shape"]) == [size]
            and features[name]["dtype"].startswith(("float", "int"))
        )
        """Columns that are checked."""
        self._number = self._row = 0
        try:
            self._words = read_tasks(source.root)
        except BadDataset:  # reported by `check_whole`
            self._words = {}

    def check(self, entry: EpisodeEntry, rows: Mapping[str, np.ndarray] | None) -> list[str]:
        """List the faults of the next episode.

        Args:
            entry: The episode.
            rows: Its `columns`, None if unknown. Shapes (n, size).
        """
        length = entry.length
        if not length and entry.place is not None:  # the length is not stated, but the rows are
            length = max(0, entry.place[1] - entry.place[0])
        place = (self._row, self._row + length)
        number, self._number, self._row = self._number, entry.index + 1, place[1]
        problems = []
        if entry.index != number:
            before = f"comes after {number - 1}" if number else "is the first"
            problems.append(
                f"episode {entry.index} {before}, but LeRobot assumes episodes numbered from 0 "
                f"without gaps. {_FIX}"
            )
        if entry.place is not None and entry.place != place:
            problems.append(
                f"the metadata puts episode {entry.index} at the rows {_say(entry.place)}, "
                f"it is the rows {_say(place)}. {_FIX}"
            )
        if rows is not None and entry.length:
            problems += self._check_counters(entry, rows, place)
            problems += self._check_words(entry, rows)
            problems += _check_clocks(entry, rows)
            problems += _check_distances(entry, rows, self._source.features)
        return problems

    def _check_counters(
        self, entry: EpisodeEntry, rows: Mapping[str, np.ndarray], place: tuple[int, int]
    ) -> Iterator[str]:
        frames, fps = np.arange(entry.length), self._source.fps
        stamps = frames / fps
        # LeRobot stores time stamps as float32.
        slack = _TOLERANCE_S + np.spacing(stamps.astype(np.float32)).astype(float)
        for name, expected, slacks in (
            ("frame_index", frames, 0.5),
            ("index", frames + place[0], 0.5),
            ("timestamp", stamps, slack),
        ):
            if name not in rows:
                continue
            values = np.asarray(rows[name][:, 0], float)
            wrong = ~(np.abs(values - expected) <= slacks)
            if wrong.any():
                row = int(np.argmax(wrong))
                yield (
                    f"'{name}' of episode {entry.index} must be {expected[row]:g} in row {row}, it "
                    f"is {values[row]:.10g}. {_FIX}"
                )

    def _check_words(self, entry: EpisodeEntry, rows: Mapping[str, np.ndarray]) -> Iterator[str]:
        if TASK not in rows or not entry.tasks or not self._words:
            return
        numbers = dict.fromkeys(rows[TASK][:, 0].tolist())
        found = [self._words.get(number) for number in numbers]
        if None in found:
            yield (
                f"episode {entry.index} has the task_index {list(numbers)[found.index(None)]}, "
                f"which {TASKS_FILE} does not list"
            )
        elif set(found) != set(entry.tasks):
            yield (
                f"the task of episode {entry.index} is '{' | '.join(entry.tasks)}' in "
                f"meta/episodes, '{' | '.join(map(str, found))}' in its rows"
            )


def _say(place: tuple[int, int]) -> str:
    return f"{place[0]} to {place[1]}"


def _check_clocks(entry: EpisodeEntry, rows: Mapping[str, np.ndarray]) -> Iterator[str]:
    for name, unit in CLOCKS.items():
        if name not in rows or name == "timestamp":
            continue
        # A shorter step may be a pause of the recorder, which other metrics show.
        jumps = [
            jump
            for jump in read_row_clock(rows[name][:, 0], unit).jumps
            if not 0 < jump[1] < LONGEST_HOLD_S
        ]
        if jumps:
            more = f", and {say_count(len(jumps) - 1, 'more time')}" if len(jumps) > 1 else ""
            row, seconds = jumps[0]
            yield (
                f"the clock '{name}' jumps by {seconds:+.6g} s at row {row} of episode "
                f"{entry.index}{more}; it is replayed without"
            )


def _check_distances(
    entry: EpisodeEntry, rows: Mapping[str, np.ndarray], features: Mapping[str, Any]
) -> Iterator[str]:
    for name, values in rows.items():
        if not name.startswith(_POSES) or features[name]["dtype"] != "float32":
            continue
        farthest = float(np.abs(values[:, :3]).max())
        if FARTHEST_M < farthest < np.inf:
            step = float(np.spacing(np.float32(farthest)))
            yield (
                f"'{name}' of episode {entry.index} is up to {farthest:.0f} m from the origin, "
                f"where float32 has steps of {step:.2g} m"
            )


def check_whole(source: Source, frames: int) -> list[str]:
    """List the faults of a dataset as a whole.

    Args:
        source: The dataset.
        frames: Number of frames of its episodes.
    """
    problems = []
    try:
        read_tasks(source.root)
        if not has_index_of_words(source.root):
            problems.append(
                f"{TASKS_FILE} has the task descriptions in a column, LeRobot reads them from the "
                "index and shows numbers instead. `xop-curate filter` rewrites it"
            )
    except BadDataset as error:
        if frames:
            problems.append(error.fault)
    counted = source.info.get("total_frames", frames)
    if counted != frames:
        problems.append(
            f"meta/info.json counts {say_count(counted, 'frame')}, its episodes have {frames}"
        )
    held = _count_rows(source)
    if held != frames:
        problems.append(f"the data files hold {say_count(held, 'row')}, its episodes have {frames}")
    used = source.video_use.files
    for path in sorted(source.root.glob("videos/*/*/*.mp4")):
        file = path.relative_to(source.root)
        if file not in used:
            problems.append(f"{file} belongs to no episode")
    return problems


def _count_rows(source: Source) -> int:
    """Count the rows of all readable data files by their footers."""
    rows = 0
    for path in source.root.glob("data/*/*.parquet"):
        try:
            rows += pq.read_metadata(path).num_rows
        except UNREADABLE:  # reported for its episodes
            continue
    return rows
