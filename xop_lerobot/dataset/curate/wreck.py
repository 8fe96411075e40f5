"""What is left of a recording that was cut off, laid out so that it can be read as a dataset.

LeRobot's recorder keeps the files of its rows and of its metadata open until a session ends. When
it is killed before, the rows lack their end, which can be made anew (`salvage`), and the metadata
of the last episodes is lost, which the rows and the pictures tell too. What of an episode was
still in memory is gone.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import write_tasks

from xop_lerobot.dataset.curate.entries import (
    EPISODES_DIR,
    EpisodeEntry,
    FactsFile,
    VideoSpan,
    read_entries,
)
from xop_lerobot.dataset.curate.pictures import VideoIndex, index_video
from xop_lerobot.dataset.curate.row_files import make_rows, make_schema
from xop_lerobot.dataset.curate.salvage import CannotSalvage, salvage
from xop_lerobot.dataset.curate.source import Source
from xop_lerobot.dataset.curate.task_words import TASKS_FILE, has_index_of_words, read_tasks
from xop_lerobot.dataset.facts import FACTS_DIR
from xop_lerobot.errors import BadDataset
from xop_lerobot.wording import say_count

_COUNTERS = ("episode_index", "frame_index", "task_index")
# What reading a parquet file raises that is not what it should be; names may be no text.
_UNREADABLE = (pa.ArrowException, OSError, UnicodeDecodeError)


@dataclass
class Wreck:
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


def lay_out(root: Path, folder: Path) -> Wreck:
    """Lay out in `folder` what is readable of the dataset `root`, which is not changed.

    Raises:
        BadDataset: If `meta/info.json` is not readable.
    """
    with Source(root) as source:
        info, features = source.info, source.features
    wreck = Wreck(root, source)
    (folder / "meta").mkdir(parents=True)
    for name in (Path("meta") / "info.json", TASKS_FILE):
        if (root / name).is_file():
            shutil.copyfile(root / name, folder / name)
    if (root / FACTS_DIR).is_dir():
        shutil.copytree(root / FACTS_DIR, folder / FACTS_DIR)
    if (root / "videos").is_dir():
        (folder / "videos").symlink_to((root / "videos").resolve())
    rows = dict(_lay_out_rows(wreck, features, folder))
    known = _read_known(wreck, info, folder)
    wreck.source = Source(folder)
    _find_whole(wreck, rows, known, _find_tasks(wreck, rows, known, folder))
    _note_strays(wreck, info)
    return wreck


def _lay_out_rows(
    wreck: Wreck, features: dict[str, Any], folder: Path
) -> Iterator[tuple[int, tuple[Path, pa.Table]]]:
    """Make every data file readable, and yield file and counters of each episode by its index."""
    schema = make_schema(features)
    for path in sorted((wreck.root / "data").glob("*/*.parquet")):
        name = path.relative_to(wreck.root)
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            table = _read_counters(path)
            target.symlink_to(path.resolve())
        except _UNREADABLE:
            try:
                count = salvage(path, schema, target)
                table = _read_counters(target)
            except (CannotSalvage, *_UNREADABLE) as fault:
                wreck.notes.append(f"{name} is not readable ({_first_line(fault)}): left out")
                target.unlink(missing_ok=True)
                continue
            wreck.notes.append(f"{name} was cut off: {count} episodes' rows in it are whole")
        except CannotSalvage as fault:
            wreck.notes.append(f"{name} is not usable ({fault}): left out")
            continue
        counters = table["episode_index"].to_numpy()
        for index in table["episode_index"].unique().to_pylist():
            yield index, (name, table.filter(pa.array(counters == index)))


def _read_counters(path: Path) -> pa.Table:
    with pq.ParquetFile(path) as file:
        names = file.schema_arrow.names
        missing = [name for name in _COUNTERS if name not in names]
        if missing:
            raise CannotSalvage(f"it has no column {', '.join(missing)}")
        table = file.read(columns=list(_COUNTERS), use_threads=False)
    return table.cast(pa.schema([(name, pa.int64()) for name in table.column_names]))


def _read_known(wreck: Wreck, info: dict[str, Any], folder: Path) -> dict[int, EpisodeEntry]:
    """Read the metadata that is readable, and lay it out for the statistics."""
    known: dict[int, EpisodeEntry] = {}
    known_files = 0
    for path in sorted((wreck.root / EPISODES_DIR).glob("*/*.parquet")):
        name = path.relative_to(wreck.root)
        try:
            with pq.ParquetFile(path) as file:
                file.read(use_threads=False)
        except _UNREADABLE as error:
            wreck.notes.append(f"{name} is not readable ({_first_line(error)}): made anew")
            continue
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(path.resolve())
        known_files += 1
    if not known_files:
        wreck.notes.append(f"{EPISODES_DIR} has nothing readable: made anew of rows and pictures")
        return known
    try:
        for entry in read_entries(folder, info, wreck.notes.append):
            known[entry.index] = entry
    except BadDataset as error:
        wreck.notes.append(f"{EPISODES_DIR}: {error.fault}")
    return known


def _find_tasks(
    wreck: Wreck,
    rows: dict[int, tuple[Path, pa.Table]],
    known: dict[int, EpisodeEntry],
    folder: Path,
) -> dict[int, str]:
    """Read the tasks by their numbers, or find them by the episodes that have a single one."""
    try:
        tasks = read_tasks(folder)
        if not has_index_of_words(folder):
            wreck.notes.append(f"{TASKS_FILE} has its words where LeRobot does not look: mended")
        return tasks
    except BadDataset:
        wreck.notes.append(f"{TASKS_FILE} is not readable: made anew of what the episodes say")
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
    wreck: Wreck,
    rows: dict[int, tuple[Path, pa.Table]],
    known: dict[int, EpisodeEntry],
    tasks: dict[int, str],
) -> None:
    source, facts = wreck.source, FactsFile(wreck.root)
    videos, schema = Videos(wreck, known), make_schema(source.features)
    for index in sorted(rows.keys() | known.keys()):
        entry = known.get(index)
        if index not in rows:
            wreck.lost[index] = "its rows are gone"
            continue
        file, table = rows[index]
        length = table.num_rows
        frames = table["frame_index"].to_numpy()
        if not np.array_equal(frames, np.arange(length)) or (entry and entry.length != length):
            expected = entry.length if entry else int(frames.max()) + 1
            wreck.lost[index] = f"it has {length} of {expected} rows"
            if entry is None:
                videos.skip(length)
            continue
        if entry is None:
            if known:
                wreck.notes.append(f"episode {index} is not in {EPISODES_DIR}: made anew")
            spans = videos.claim(length)
            line = facts.read(index)
            if line.pop("length", length) != length:
                line = {}
            line.pop("episode_index", None)
            numbers = dict.fromkeys(table["task_index"].to_pylist())
            names = tuple(tasks.get(number, "") for number in numbers)
            entry = EpisodeEntry(index, length, names, line, file, spans or {})
            if spans is None:
                wreck.lost[index] = "its pictures are gone"
                continue
        else:
            entry = EpisodeEntry(index, length, entry.tasks, entry.facts, file, entry.videos)
        fault = videos.check(entry) or _check_rows(source, entry, schema)
        if fault:
            wreck.lost[index] = fault
        else:
            wreck.entries.append(entry)


def _check_rows(source: Source, entry: EpisodeEntry, schema: pa.Schema) -> str:
    try:
        make_rows(source.read_table(entry), {}, schema, entry.file)
    except BadDataset as error:
        return error.fault
    return ""


class Videos:
    """Finds the pictures of episodes.

    Args:
        wreck: The dataset.
        known: Episodes whose metadata says where their pictures are.
    """

    def __init__(self, wreck: Wreck, known: dict[int, EpisodeEntry]) -> None:
        self._root, self._fps = wreck.root, wreck.source.fps
        self._notes = wreck.notes
        self._cache: dict[Path, VideoIndex | None] = {}
        self._keys = [
            key for key, each in wreck.source.features.items() if each["dtype"] == "video"
        ]
        taken = {span.file for entry in known.values() for span in entry.videos.values()}
        self._free = {
            key: [file for file in self._list(key) if file not in taken] for key in self._keys
        }
        self._used = dict.fromkeys(self._keys, 0)

    def _list(self, key: str) -> list[Path]:
        files = (self._root / "videos" / key).glob("*/*.mp4")
        return sorted(file.relative_to(self._root) for file in files)

    def claim(self, length: int) -> dict[str, VideoSpan] | None:
        """Find the pictures of the next episode, of `length` frames; None if they are not there.

        A recorder puts one episode's after the other's into a file, until it begins another one.
        """
        spans: dict[str, VideoSpan] = {}
        for key in self._keys:
            files = self._free[key]
            while files:
                frames, used = self._count(files[0]), self._used[key]
                if used + length <= frames:
                    break
                if used < frames:
                    self._notes.append(
                        f"{files[0]}: {frames - used} pictures at its end belong to no episode"
                    )
                files.pop(0)
                self._used[key] = 0
            if not files:
                return None
            start = self._used[key] / self._fps
            spans[key] = VideoSpan(files[0], start, start + length / self._fps)
        self.skip(length)
        return spans

    def skip(self, length: int) -> None:
        """Pass over the pictures of an episode that is lost."""
        for key in self._keys:
            self._used[key] += length

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

    def check(self, entry: EpisodeEntry) -> str:
        """Check that the pictures of an episode are there; return what is wrong, or nothing."""
        for key, span in entry.videos.items():
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


def _note_strays(wreck: Wreck, info: dict[str, Any]) -> None:
    """Note what an episode that was under way has left behind."""
    root = wreck.root
    for folder in sorted(root.glob("tmp*")):
        if folder.is_dir():
            wreck.notes.append(f"{folder.name}/ holds pictures of an unfinished episode: left out")
    for folder in sorted(itertools.chain(root.glob("images/*/episode*"))):
        count = sum(1 for _ in folder.iterdir())
        wreck.notes.append(
            f"{folder.relative_to(root)} holds {count} pictures of an unfinished episode: left out"
        )
    counted = info.get("total_episodes", 0)
    there = len(wreck.entries)
    if counted != there:
        wreck.notes.append(
            f"meta/info.json counts {say_count(counted, 'episode')}, {there} are whole"
        )


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
