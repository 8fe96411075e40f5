"""Reconstruct an interrupted recording as a readable dataset in another folder.

A killed recorder, a full disk or an interrupted copy leaves metadata that is missing or
inconsistent, which rows and images can replace. Rows come from Parquet files with a footer; a file
without one cannot be read.
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
    read_entries,
)
from xop_lerobot.curate.order_check import OrderCheck
from xop_lerobot.curate.row_files import make_rows, make_schema
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.task_words import TASKS_FILE, has_index_of_words, read_tasks
from xop_lerobot.curate.video_search import VideoSearch
from xop_lerobot.recording.facts import FACTS_DIR

_COUNTERS = ("episode_index", "frame_index", "task_index")
# Errors of reading a malformed Parquet file; column names may not decode as text.
_UNREADABLE = (pa.ArrowException, OSError, UnicodeDecodeError)


@dataclass
class DamagedDataset:
    """Reconstruction of a damaged dataset.

    Attributes:
        root: Its directory.
        source: The readable part, reconstructed elsewhere.
        entries: Complete episodes, in order.
        lost: Reason for each lost episode, by index.
        notes: Other findings and repairs.
    """

    root: Path
    source: Source
    entries: list[EpisodeEntry] = field(default_factory=list)
    lost: dict[int, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def reconstruct(root: Path, folder: Path) -> DamagedDataset:
    """Reconstruct in `folder` the readable part of the dataset `root`, which is not changed.

    Raises:
        BadDataset: If `meta/info.json` is not readable, or if a file of rows is not and no metadata
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
    damaged.notes[:] = dict.fromkeys(damaged.notes)  # two episodes may share a fault
    return damaged


def _lay_out_rows(
    damaged: DamagedDataset, unreadable: list[str], folder: Path
) -> Iterator[tuple[int, tuple[Path, pa.Table]]]:
    """Link readable files of rows; yield file and counters of each episode by index.

    Unreadable files are appended to `unreadable`.
    """
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
    """Read the readable metadata, and link its files for the statistics."""
    known: dict[int, EpisodeEntry] = {}
    known_files = 0
    for path in sorted((damaged.root / EPISODES_DIR).glob("*/*.parquet")):
        name = path.relative_to(damaged.root)
        try:
            with pq.ParquetFile(path) as file:
                file.read(use_threads=False)
        except _UNREADABLE as error:
            damaged.notes.append(f"{name} is not readable ({_first_line(error)}): rebuilt")
            continue
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(path.resolve())
        known_files += 1
    if not known_files:
        damaged.notes.append(f"{EPISODES_DIR} has nothing readable: rebuilt from rows and images")
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
    """Read the task descriptions by index, or infer them from episodes with a single task."""
    try:
        tasks = read_tasks(folder)
        if not has_index_of_words(folder):
            damaged.notes.append(
                f"{TASKS_FILE} has its descriptions where LeRobot does not look: repaired"
            )
        return tasks
    except BadDataset:
        damaged.notes.append(f"{TASKS_FILE} is not readable: rebuilt from what the episodes say")
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
            whole = dataclasses.replace(whole, length=expected)  # so many images belong to it
        elif entry is None and known:
            damaged.notes.append(f"episode {index} is not in {EPISODES_DIR}: rebuilt")
        elif entry is not None and entry.has_rows and entry.file != file:
            damaged.notes.append(
                f"episode {index} is in {file}, and not in {entry.file}, as {EPISODES_DIR} says: "
                "repaired"
            )
        found.append(whole)
    _note_faults(damaged, known, found)
    videos = VideoSearch(source, known, found, damaged.lost, damaged.notes.append)
    schema = make_schema(source.features)
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
    """Number of rows of an episode by its metadata; 0 if it is not stated."""
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
    """Describe an episode by its rows, and by its metadata where available."""
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


def _note_faults(
    damaged: DamagedDataset, known: Mapping[int, EpisodeEntry], found: Sequence[EpisodeEntry]
) -> None:
    """Note wrong metadata and numbering that LeRobot would misread.

    All of it is rewritten and renumbered.
    """
    check, held = OrderCheck(damaged.source), {entry.index: entry for entry in found}
    for index, entry in known.items():
        rows = None
        if index in held and held[index].length == entry.length and index not in damaged.lost:
            with suppress(BadDataset):  # reported when the rows are checked
                rows = damaged.source.read(held[index], check.columns)
        damaged.notes += (*entry.faults, *check.check(entry, rows))


def _check_rows(source: Source, entry: EpisodeEntry, schema: pa.Schema) -> str:
    try:
        make_rows(source.read_table(entry), {}, schema, entry.file)
    except BadDataset as error:
        return error.fault
    return ""


def _note_strays(damaged: DamagedDataset, info: dict[str, Any]) -> None:
    """Note the leftovers of an unfinished episode."""
    root = damaged.root
    for folder in sorted(root.glob("tmp*")):
        if folder.is_dir():
            damaged.notes.append(f"{folder.name}/ holds images of an unfinished episode: left out")
    for folder in sorted(itertools.chain(root.glob("images/*/episode*"))):
        count = sum(1 for _ in folder.iterdir())
        damaged.notes.append(
            f"{folder.relative_to(root)} holds {count} images of an unfinished episode: left out"
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
