"""Episodes of a dataset, as its metadata lists them, one after another."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from xop_lerobot.dataset.facts import EPISODES_FILE, FACTS_PREFIX
from xop_lerobot.errors import BadDataset
from xop_lerobot.wording import say_count

UNREADABLE = (pa.ArrowException, OSError, UnicodeDecodeError, OverflowError)
"""What reading a malformed parquet file may raise."""
EPISODES_DIR = Path("meta") / "episodes"
_REQUIRED = ("episode_index", "length", "data/chunk_index", "data/file_index")
_TIMES = ("from_timestamp", "to_timestamp")
_JSON_FACTS = ("versions", "settings", "changes", "provenance")
_BATCH = 64
"""Episodes whose metadata is in memory at a time."""


@dataclass(frozen=True)
class VideoSpan:
    """Where the pictures of an episode lie.

    Attributes:
        file: The video, relative to the dataset's directory.
        start: Time of the first picture in it [s].
        stop: Time of the end of the last [s].
    """

    file: Path
    start: float
    stop: float


@dataclass(frozen=True)
class EpisodeEntry:
    """What the metadata says of an episode.

    Attributes:
        index: Its `episode_index`.
        length: Its frames.
        tasks: Its tasks in words.
        facts: This project's facts on it; empty where they are not known.
        file: Its rows' parquet file, relative to the dataset's directory.
        videos: Its pictures by feature key; none for pictures that are in the rows.
    """

    index: int
    length: int
    tasks: tuple[str, ...]
    facts: Mapping[str, Any]
    file: Path
    videos: Mapping[str, VideoSpan] = field(default_factory=dict)


class FactsFile:
    """`meta/xop/episodes.jsonl`, read a line at a time.

    Only where each line begins is kept in memory. Lines that are no JSON objects, as a crash
    leaves them, are passed over; of two lines on one episode the last counts.

    Args:
        root: Directory of the dataset.
    """

    def __init__(self, root: Path) -> None:
        self._path = root / EPISODES_FILE
        self._places: dict[int, int] = {}
        if not self._path.is_file():
            return
        with self._path.open("rb") as file:
            place = 0
            for line in file:
                index = _parse(line).get("episode_index")
                if isinstance(index, int):
                    self._places[index] = place
                place += len(line)

    def read(self, index: int) -> dict[str, Any]:
        """Read the facts on episode `index`; empty if there are none."""
        if index not in self._places:
            return {}
        with self._path.open("rb") as file:
            file.seek(self._places[index])
            return _parse(file.readline())


def _parse(line: bytes) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except ValueError:
        return {}
    return row if isinstance(row, dict) else {}


def read_entries(
    root: Path, info: Mapping[str, Any], note: Callable[[str], None] | None = None
) -> Iterator[EpisodeEntry]:
    """Read the episodes in order.

    Args:
        root: Directory of the dataset.
        info: Content of `meta/info.json`.
        note: Told of each file that is not readable, which is then passed over; if None, such a
            file is an error.

    Raises:
        BadDataset: If the metadata is missing or malformed.
    """
    files = sorted((root / EPISODES_DIR).glob("*/*.parquet"))
    if not files and info.get("total_episodes"):
        _fault(root, note, f"it has no files in {EPISODES_DIR}, but {_count(info)}. {_REPAIR}")
    facts, seen = FactsFile(root), set[int]()
    for file in files:
        name = file.relative_to(root)
        try:
            for row in _read_rows(file):
                entry = _make_entry(root, info, row, facts)
                if entry.index in seen:
                    raise BadDataset(root, f"episode {entry.index} is listed twice, in {name} too")
                seen.add(entry.index)
                yield entry
        except UNREADABLE as error:
            text = str(error).splitlines()[0]
            _fault(root, note, f"{name} is not readable ({text}). {_REPAIR}")


_REPAIR = "`xop-curate repair` restores a recording that was cut off"


def _count(info: Mapping[str, Any]) -> str:
    return f"meta/info.json counts {say_count(info['total_episodes'], 'episode')}"


def _fault(root: Path, note: Callable[[str], None] | None, text: str) -> None:
    if note is None:
        raise BadDataset(root, text)
    note(text)


def _read_rows(path: Path) -> Iterator[dict[str, Any]]:
    """Read the rows of a file of metadata, without the statistics."""
    with pq.ParquetFile(path) as file:
        names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
        for batch in file.iter_batches(_BATCH, columns=names, use_threads=False):
            yield from batch.to_pylist()


def _make_entry(
    root: Path, info: Mapping[str, Any], row: Mapping[str, Any], lines: FactsFile
) -> EpisodeEntry:
    for name in _REQUIRED:
        if not isinstance(row.get(name), int) or row[name] < 0:
            raise BadDataset(
                root,
                f"{EPISODES_DIR} must give '{name}' as a number of 0 or more for each episode, "
                f"got {row.get(name)!r}",
            )
    facts = {
        key.removeprefix(FACTS_PREFIX): value
        for key, value in row.items()
        if key.startswith(FACTS_PREFIX) and value is not None
    }
    for name in _JSON_FACTS:
        if isinstance(facts.get(name), str):
            try:
                facts[name] = json.loads(facts[name])
            except ValueError:
                del facts[name]
    line = lines.read(row["episode_index"])
    # A line about an episode of another length is what another tool left behind.
    if line.pop("length", row["length"]) == row["length"]:
        facts |= line
    facts.pop("episode_index", None)
    tasks = row.get("tasks") or ()
    return EpisodeEntry(
        index=row["episode_index"],
        length=row["length"],
        tasks=(tasks,) if isinstance(tasks, str) else tuple(map(str, tasks)),
        facts=facts,
        file=_find_file(
            root,
            info["data_path"],
            chunk_index=row["data/chunk_index"],
            file_index=row["data/file_index"],
        ),
        videos=dict(_find_videos(root, info, row)),
    )


def _find_videos(
    root: Path, info: Mapping[str, Any], row: Mapping[str, Any]
) -> Iterator[tuple[str, VideoSpan]]:
    for key, feature in info["features"].items():
        if feature["dtype"] != "video":
            continue
        prefix = f"videos/{key}/"
        places = {name: row.get(prefix + name) for name in ("chunk_index", "file_index", *_TIMES)}
        if any(place is None for place in places.values()):
            raise BadDataset(
                root, f"episode {row['episode_index']} does not say where its video '{key}' is"
            )
        start, stop = (_to_seconds(root, row, prefix + name) for name in _TIMES)
        chunk, number = places["chunk_index"], places["file_index"]
        file = _find_file(
            root, info.get("video_path"), video_key=key, chunk_index=chunk, file_index=number
        )
        yield key, VideoSpan(file, start, stop)


def _to_seconds(root: Path, row: Mapping[str, Any], name: str) -> float:
    value = row[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise BadDataset(root, f"{EPISODES_DIR} must give '{name}' as a time [s], got {value!r}")
    return float(value)


def _find_file(root: Path, template: object, **places: Any) -> Path:
    try:
        path = Path(str(template).format(**places))
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise BadDataset(root, f"meta/info.json has a malformed path '{template}'") from error
    if path.is_absolute() or ".." in path.parts:
        raise BadDataset(root, f"meta/info.json has a path that leads out of it, '{template}'")
    return path
