"""What is left of a recording that was cut off, laid out so that it can be read as a dataset.

A killed recorder, a full disk or a copy that broke off leaves metadata that is missing or does not
fit, which rows and images tell too. Rows come from Parquet files with a footer: what a file without
one holds cannot be read.
"""

from __future__ import annotations

import dataclasses
import itertools
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import write_tasks

from xop_lerobot.core.command_line import say_count
from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.entries import (
    EPISODES_DIR,
    EpisodeEntry,
    FactsFile,
    VideoSpan,
    read_entries,
)
from xop_lerobot.curate.order_check import OrderCheck
from xop_lerobot.curate.row_files import make_rows, make_schema
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.task_words import TASKS_FILE, has_index_of_words, read_tasks
from xop_lerobot.curate.video import VideoIndex, index_video
from xop_lerobot.recording.facts import FACTS_DIR

_COUNTERS = ("episode_index", "frame_index", "task_index")
# What reading a parquet file raises that is not what it should be; names may be no text.
_UNREADABLE = (pa.ArrowException, OSError, UnicodeDecodeError)


@dataclass
class DamagedDataset:
    """What is left of a dataset.

    Attributes:
        root: Its directory.
        source: The readable part, laid out elsewhere.
        entries: The episodes that are whole, in order.
        lost: Why each other episode is not, by its index.
        notes: What else was found and done.
    """

    root: Path
    source: Source
    entries: list[EpisodeEntry] = field(default_factory=list)
    lost: dict[int, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def reconstruct(root: Path, folder: Path) -> DamagedDataset:
    """Lay out in `folder` what is readable of the dataset `root`, which is not changed.

    Raises:
        BadDataset: If `meta/info.json` is not readable, or a file of rows is not while no metadata
            says which episodes are lost with it.
    """
    with Source(root) as source:
        info = source.info
    damaged = DamagedDataset(root, source)
    (folder / "meta").mkdir(parents=True)
    for name in (Path("meta") / "info.json", TASKS_FILE):
        if (root / name).is_file():
            shutil.copyfile(root / name, folder / name)
    if (root / FACTS_DIR).is_dir():
        shutil.copytree(root / FACTS_DIR, folder / FACTS_DIR)
    if (root / "videos").is_dir():
        (folder / "videos").symlink_to((root / "videos").resolve())
    unreadable: list[str] = []
    rows = dict(_lay_out_rows(damaged, unreadable, folder))
    known = _read_known(damaged, info, folder)
    if unreadable and not known:
        raise BadDataset(
            root,
            f"{'; '.join(unreadable)}, and {EPISODES_DIR} does not say which episodes are in it. "
            "LeRobot's own recorder leaves Parquet files without a footer when it is killed, an "
            "unfinished copy too: copy the file again, or move it out of the dataset and repair "
            "the rest",
        )
    damaged.source = Source(folder)
    _find_whole(damaged, rows, known, _find_tasks(damaged, rows, known, folder))
    _note_strays(damaged, info)
    damaged.notes[:] = dict.fromkeys(damaged.notes)  # a fault may be that of two episodes
    return damaged


def _lay_out_rows(
    damaged: DamagedDataset, unreadable: list[str], folder: Path
) -> Iterator[tuple[int, tuple[Path, pa.Table]]]:
    """Yield file and counters of each episode by its index; list the files that cannot be."""
    for path in sorted((damaged.root / "data").glob("*/*.parquet")):
        name = path.relative_to(damaged.root)
        try:
            table = _read_counters(damaged.root, name)
        except _UNREADABLE as error:
            unreadable.append(f"{name} is not readable ({_first_line(error)})")
            damaged.notes.append(f"{unreadable[-1]}: left out")
            continue
        except BadDataset as error:
            damaged.notes.append(f"{error.fault}: left out")
            continue
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(path.resolve())
        counters = table["episode_index"].to_numpy()
        for index in table["episode_index"].unique().to_pylist():
            yield index, (name, table.filter(pa.array(counters == index)))


def _read_counters(root: Path, name: Path) -> pa.Table:
    with pq.ParquetFile(root / name) as file:
        names = file.schema_arrow.names
        missing = [column for column in _COUNTERS if column not in names]
        if missing:
            raise BadDataset(root, f"{name} has no column {', '.join(missing)}")
        table = file.read(columns=list(_COUNTERS), use_threads=False)
    return table.cast(pa.schema([(column, pa.int64()) for column in _COUNTERS]))


def _read_known(
    damaged: DamagedDataset, info: dict[str, Any], folder: Path
) -> dict[int, EpisodeEntry]:
    """Read the metadata that is readable, and lay it out for the statistics."""
    known: dict[int, EpisodeEntry] = {}
    known_files = 0
    for path in sorted((damaged.root / EPISODES_DIR).glob("*/*.parquet")):
        name = path.relative_to(damaged.root)
        try:
            with pq.ParquetFile(path) as file:
                file.read(use_threads=False)
        except _UNREADABLE as error:
            damaged.notes.append(f"{name} is not readable ({_first_line(error)}): made anew")
            continue
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(path.resolve())
        known_files += 1
    if not known_files:
        damaged.notes.append(f"{EPISODES_DIR} has nothing readable: made anew of rows and pictures")
        return known
    try:
        for entry in read_entries(folder, info, damaged.notes.append):
            known[entry.index] = entry
    except BadDataset as error:
        damaged.notes.append(f"{EPISODES_DIR}: {error.fault}")
    return known


def _find_tasks(
    damaged: DamagedDataset,
    rows: dict[int, tuple[Path, pa.Table]],
    known: dict[int, EpisodeEntry],
    folder: Path,
) -> dict[int, str]:
    """Read the tasks by their numbers, or find them by the episodes that have a single one."""
    try:
        tasks = read_tasks(folder)
        if not has_index_of_words(folder):
            damaged.notes.append(f"{TASKS_FILE} has its words where LeRobot does not look: mended")
        return tasks
    except BadDataset:
        damaged.notes.append(f"{TASKS_FILE} is not readable: made anew of what the episodes say")
    tasks: dict[int, str] = {}
    for index, (_, table) in rows.items():
        numbers = table["task_index"].unique().to_pylist()
        if index in known and len(numbers) == len(known[index].tasks) == 1:
            tasks[numbers[0]] = known[index].tasks[0]
    numbers = sorted({n for _, table in rows.values() for n in table["task_index"].to_pylist()})
    for number in numbers:
        tasks.setdefault(number, f"task {number}")
    (folder / TASKS_FILE).unlink(missing_ok=True)
    write_tasks(
        pd.DataFrame({"task_index": list(tasks)}, index=pd.Index(tasks.values(), name="task")),
        folder,
    )
    return tasks


def _find_whole(
    damaged: DamagedDataset,
    rows: dict[int, tuple[Path, pa.Table]],
    known: dict[int, EpisodeEntry],
    tasks: dict[int, str],
) -> None:
    source = damaged.source
    found: list[EpisodeEntry] = []
    for index in sorted(rows.keys() | known.keys()):
        entry = known.get(index)
        if index not in rows:
            is_empty = entry is not None and _count_expected(entry) == 0
            damaged.lost[index] = "it has no rows" if is_empty else "its rows are gone"
            continue
        file, table = rows[index]
        frames = table["frame_index"].to_numpy()
        expected = (_count_expected(entry) if entry else 0) or int(frames.max()) + 1
        whole = _describe(damaged, index, entry, file, table, tasks)
        if not np.array_equal(frames, np.arange(expected)):
            damaged.lost[index] = f"it has {len(frames)} of {expected} rows"
            whole = dataclasses.replace(whole, length=expected)  # so many pictures it has
        elif entry is None and known:
            damaged.notes.append(f"episode {index} is not in {EPISODES_DIR}: made anew")
        elif entry is not None and entry.has_rows and entry.file != file:
            damaged.notes.append(
                f"episode {index} is in {file}, and not in {entry.file}, as {EPISODES_DIR} says: "
                "mended"
            )
        found.append(whole)
    _note_faults(damaged, known, found)
    videos, schema = Videos(damaged, known, found), make_schema(source.features)
    for entry in found:
        if entry.index in damaged.lost:
            continue
        spans = videos.find(entry)
        if isinstance(spans, str):
            damaged.lost[entry.index] = spans
            continue
        whole = dataclasses.replace(entry, videos=spans, faults=())
        fault = _check_rows(source, whole, schema)
        if fault:
            damaged.lost[entry.index] = fault
        else:
            damaged.entries.append(whole)


def _count_expected(entry: EpisodeEntry) -> int:
    """Count the rows that an episode should have by its metadata; 0 where it does not say."""
    start, stop = entry.place or (0, 0)
    return entry.length or max(0, stop - start)


def _describe(
    damaged: DamagedDataset,
    index: int,
    entry: EpisodeEntry | None,
    file: Path,
    table: pa.Table,
    tasks: dict[int, str],
) -> EpisodeEntry:
    """Describe an episode by its rows, and by its metadata as far as that is there."""
    length = table.num_rows
    if entry is not None:
        return dataclasses.replace(entry, length=length, file=file)
    facts = FactsFile(damaged.root).read(index)
    if facts.pop("length", length) != length:
        facts = {}
    facts.pop("episode_index", None)
    numbers = dict.fromkeys(table["task_index"].to_pylist())
    names = tuple(tasks.get(number, "") for number in numbers)
    return EpisodeEntry(index, length, names, facts, file)


def _list_cameras(source: Source) -> list[str]:
    return [key for key, each in source.features.items() if each["dtype"] == "video"]


def _note_faults(
    damaged: DamagedDataset, known: Mapping[int, EpisodeEntry], found: Sequence[EpisodeEntry]
) -> None:
    """Note what the metadata says wrongly, and what is not numbered as LeRobot takes for granted.

    All of it is made and counted anew.
    """
    check, held = OrderCheck(damaged.source), {entry.index: entry for entry in found}
    for index, entry in known.items():
        rows = None
        if index in held and held[index].length == entry.length and index not in damaged.lost:
            with suppress(BadDataset):  # which is told when the rows are checked
                rows = damaged.source.read(held[index], check.columns)
        damaged.notes += (*entry.faults, *check.check(entry, rows))


def _check_rows(source: Source, entry: EpisodeEntry, schema: pa.Schema) -> str:
    try:
        make_rows(source.read_table(entry), {}, schema, entry.file)
    except BadDataset as error:
        return error.fault
    return ""


@dataclass
class _Gap:
    """Pictures of a video, one after another, that the metadata gives to no episode.

    Attributes:
        file: The video, relative to the dataset's directory.
        start: The first of them.
        size: How many they are.
        is_tail: Whether they are the last of the video, where an unfinished episode's may be.
        low: They are of episodes after this one.
        high: They are of episodes before this one.
        used: How many of them are claimed.
    """

    file: Path
    start: int
    size: int
    is_tail: bool
    low: float = -1
    high: float = np.inf
    used: int = 0


class Videos:
    """Finds the pictures of episodes.

    Where the metadata says where they are, and they are there and nobody else's, it is believed.
    All others are found by counting: a recorder puts one episode's pictures after the other's
    into a file, until it begins another one. So what no episode has between the pictures of
    episodes 3 and 5 is episode 4's, if it is as many as that has rows.

    Args:
        damaged: The dataset.
        known: Episodes whose metadata is there.
        found: Episodes of which there are rows, in order; those that are lost have pictures too.
    """

    def __init__(
        self,
        damaged: DamagedDataset,
        known: Mapping[int, EpisodeEntry],
        found: Sequence[EpisodeEntry],
    ) -> None:
        self._root, self._fps = damaged.root, damaged.source.fps
        self._notes = damaged.notes
        self._cache: dict[Path, VideoIndex | None] = {}
        self._keys = _list_cameras(damaged.source)
        shared = damaged.source.video_use.shared
        self._faults: dict[int, str] = {}
        """Why the pictures are not where the metadata says, by the episode's index."""
        for entry in found if self._keys else ():
            if entry.index in shared:
                self._faults[entry.index] = shared[entry.index][0]
            elif entry.videos.keys() != set(self._keys):
                self._faults[entry.index] = "its pictures are gone"
            elif entry.index not in damaged.lost:
                fault = self._check(entry.videos, entry)
                if fault:
                    self._faults[entry.index] = fault
        taken = {
            index: entry
            for index, entry in known.items()
            if index not in self._faults and index not in shared
        }
        sought = [entry for entry in found if entry.index in self._faults]
        # Pictures of an episode of which nothing else is left may lie between those of others.
        there = taken.keys() | self._faults.keys()
        self._is_strict = there != set(range(len(there)))
        self._spans: dict[int, dict[str, VideoSpan]] = {entry.index: {} for entry in sought}
        for key in self._keys if sought else ():
            self._claim(key, self._list_gaps(key, taken), sought)

    def find(self, entry: EpisodeEntry) -> Mapping[str, VideoSpan] | str:
        """Find the pictures of an episode; say what is wrong where they are not to be had."""
        fault = self._faults.get(entry.index)
        if fault is None:
            return entry.videos
        spans = self._spans[entry.index]
        if spans.keys() != set(self._keys) or self._check(spans, entry):
            return fault
        if entry.videos or entry.faults:
            places = ", ".join(f"{span.file} from {span.start:.2f} s on" for span in spans.values())
            self._notes.append(f"the pictures of episode {entry.index} are found: {places}")
        return spans

    def _list_gaps(self, key: str, taken: Mapping[int, EpisodeEntry]) -> list[_Gap]:
        """List the pictures of a camera that are nobody's, file by file."""
        spans: dict[Path, list[tuple[int, int, int]]] = {}
        for index, entry in taken.items():
            span = entry.videos.get(key)
            if span is not None:
                start, stop = (round(each * self._fps) for each in (span.start, span.stop))
                spans.setdefault(span.file, []).append((start, stop, index))
        gaps: list[_Gap] = []
        held: list[tuple[int | None, _Gap | None]] = []  # what lies there, one after another
        for file in self._list(key):
            place, size = 0, self._count(file)
            for start, stop, index in sorted(spans.get(file, ())):
                if start > place:
                    gaps.append(_Gap(file, place, start - place, is_tail=False))
                    held.append((None, gaps[-1]))
                held.append((index, None))
                place = max(place, stop)
            if size > place:
                gaps.append(_Gap(file, place, size - place, is_tail=True))
                held.append((None, gaps[-1]))
        low, high = -1, np.inf
        for index, gap in held:
            low = low if index is None else max(low, index)
            if gap is not None:
                gap.low = low
        for index, gap in reversed(held):
            high = high if index is None else min(high, index)
            if gap is not None:
                gap.high = high
        return gaps

    def _claim(self, key: str, gaps: list[_Gap], sought: Sequence[EpisodeEntry]) -> None:
        """Give what is nobody's to the episodes whose pictures are sought, all in their order."""
        claims: list[tuple[EpisodeEntry, _Gap, int]] = []
        number = 0
        for entry in sought:
            while number < len(gaps) and entry.index > gaps[number].low:
                gap = gaps[number]
                if entry.index < gap.high and gap.used + entry.length <= gap.size:
                    claims.append((entry, gap, gap.start + gap.used))
                    gap.used += entry.length
                    break
                number += 1
        for gap in gaps[:number]:
            if 0 < gap.used < gap.size and gap.is_tail:
                self._notes.append(
                    f"{gap.file}: {gap.size - gap.used} pictures at its end belong to no episode"
                )
        for entry, gap, start in claims:
            if gap.used == gap.size or (gap.is_tail and not self._is_strict):
                begin, end = (each / self._fps for each in (start, start + entry.length))
                self._spans[entry.index][key] = VideoSpan(gap.file, begin, end)

    def _list(self, key: str) -> list[Path]:
        files = (self._root / "videos" / key).glob("*/*.mp4")
        return sorted(file.relative_to(self._root) for file in files)

    def _count(self, file: Path) -> int:
        index = self._index(file)
        return 0 if index is None else len(index.pts)

    def _index(self, file: Path) -> VideoIndex | None:
        if file not in self._cache:
            try:
                self._cache[file] = index_video(self._root, file)
            except BadDataset as error:
                self._notes.append(error.fault)
                self._cache[file] = None
        return self._cache[file]

    def _check(self, spans: Mapping[str, VideoSpan], entry: EpisodeEntry) -> str:
        """Check that the pictures of an episode are there; return what is wrong, or nothing."""
        for key, span in spans.items():
            index = self._index(span.file)
            if index is None:
                return f"its pictures of '{key}' are not readable"
            dropped = entry.facts.get("dropped_frames")
            missing = index.count_missing(span.start, entry.length, self._fps)
            if missing > (dropped if isinstance(dropped, int) else 0):
                return f"{missing} of its {entry.length} pictures of '{key}' are gone"
            damaged = index.count_damaged(span.start, span.stop, self._fps)
            if damaged:
                return f"{damaged} of its {entry.length} pictures of '{key}' are damaged"
        return ""


def _note_strays(damaged: DamagedDataset, info: dict[str, Any]) -> None:
    """Note what an episode that was under way has left behind."""
    root = damaged.root
    for folder in sorted(root.glob("tmp*")):
        if folder.is_dir():
            damaged.notes.append(
                f"{folder.name}/ holds pictures of an unfinished episode: left out"
            )
    for folder in sorted(itertools.chain(root.glob("images/*/episode*"))):
        count = sum(1 for _ in folder.iterdir())
        damaged.notes.append(
            f"{folder.relative_to(root)} holds {count} pictures of an unfinished episode: left out"
        )
    spans = [span for entry in damaged.entries for span in entry.videos.values()]
    used = damaged.source.video_use.files | {span.file for span in spans}
    for path in sorted(root.glob("videos/*/*/*.mp4")):
        if path.relative_to(root) not in used:
            damaged.notes.append(f"{path.relative_to(root)} belongs to no episode: left out")
    counted = info.get("total_episodes", 0)
    there = len(damaged.entries)
    if counted != there:
        damaged.notes.append(
            f"meta/info.json counts {say_count(counted, 'episode')}, {there} are whole"
        )


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
