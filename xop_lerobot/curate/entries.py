"""Episode entries of a dataset's metadata, read one after another."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from xop_lerobot.core.command_line import say_count
from xop_lerobot.core.errors import BadDataset
from xop_lerobot.recording.facts import EPISODES_FILE, FACTS_PREFIX

UNREADABLE = (pa.ArrowException, OSError, UnicodeDecodeError, OverflowError)
"""Errors that reading a malformed Parquet file may raise."""
EPISODES_DIR = Path("meta") / "episodes"
_REQUIRED = ("length", "data/chunk_index", "data/file_index")
_PLACES = ("chunk_index", "file_index")
_TIMES = ("from_timestamp", "to_timestamp")
_COUNTS = ("dropped_frames", "seed")
"""Integers of the episode metadata."""
_JSON_FACTS = ("versions", "settings", "changes", "provenance")
_BATCH = 64
"""Number of episodes whose metadata is in memory at a time."""


@dataclass(frozen=True)
class VideoSpan:
    """Location of an episode's images.

    Attributes:
        file: The video, relative to the dataset's directory.
        start: Time of its first image [s].
        stop: End time of its last image [s].
    """

    file: Path
    start: float
    stop: float


@dataclass(frozen=True)
class EpisodeEntry:
    """Metadata of an episode.

    Attributes:
        index: Its `episode_index`.
        length: Number of frames.
        tasks: Its task descriptions.
        facts: This project's metadata of it (`meta/xop`); empty if unknown.
        file: Parquet file of its rows, relative to the dataset's directory.
        videos: Its videos by feature key; none for images stored in the rows.
        place: Its first row in the dataset and the row after its last, as stated; None if not
            stated.
        faults: Faults of the metadata because of which the episode cannot be transferred. An
            unknown length is 0, an unknown file is the empty path, and unknown videos are not in
            `videos`.
    """

    index: int
    length: int
    tasks: tuple[str, ...]
    facts: Mapping[str, Any]
    file: Path
    videos: Mapping[str, VideoSpan] = field(default_factory=dict)
    place: tuple[int, int] | None = None
    faults: tuple[str, ...] = ()

    @property
    def has_rows(self) -> bool:
        """Whether the metadata states where its rows are, and that there are any."""
        return self.length > 0 and self.file != Path()


class FactsFile:
    """Random access to the lines of `meta/xop/episodes.jsonl`.

    Only the offset of each line is kept in memory. Lines that are not JSON objects, as a crash
    leaves them, are skipped; of two lines for one episode the last counts.

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
        """Read the line of episode `index`; empty if there is none."""
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
    root: Path,
    info: Mapping[str, Any],
    note: Callable[[str], None] | None = None,
    use: VideoUse | None = None,
) -> Iterator[EpisodeEntry]:
    """Read the episodes in order.

    A fault of one episode is listed in its `faults` and does not affect the others.

    Args:
        root: Directory of the dataset.
        info: Content of `meta/info.json`.
        note: Receives each unreadable file, and each episode without an index of its own; both are
            then skipped. None makes them errors.
        use: Result of `find_video_use`; computed if None.

    Raises:
        BadDataset: If the metadata is missing or malformed.
    """
    files = sorted((root / EPISODES_DIR).glob("*/*.parquet"))
    if not files and info.get("total_episodes"):
        _fault(root, note, f"it has no files in {EPISODES_DIR}, but {_count(info)}. {_REPAIR}")
    use = find_video_use(root, info) if use is None else use
    facts, seen = FactsFile(root), set[int]()
    for file in files:
        name = file.relative_to(root)
        try:
            for number, row in enumerate(_read_rows(file)):
                index = to_count(row.get("episode_index"))
                if index is None:
                    text = f"{name} must give 'episode_index' as a number of 0 or more in each row"
                    _fault(root, note, f"{text}, row {number} gives {row.get('episode_index')!r}")
                elif index in seen:
                    _fault(root, note, f"episode {index} is listed twice, in {name} too")
                else:
                    seen.add(index)
                    yield _make_entry(root, info, index, row, facts, use)
        except UNREADABLE as error:
            text = str(error).splitlines()[0]
            _fault(root, note, f"{name} is not readable ({text}). {_REPAIR}")


_REPAIR = "`xop-curate repair` restores an interrupted recording"


def _count(info: Mapping[str, Any]) -> str:
    return f"meta/info.json counts {say_count(info['total_episodes'], 'episode')}"


def _fault(root: Path, note: Callable[[str], None] | None, text: str) -> None:
    if note is None:
        raise BadDataset(root, text)
    note(text)


def _read_rows(path: Path, keys: Sequence[str] | None = None) -> Iterator[dict[str, Any]]:
    """Read the rows of a metadata file; without `keys` all columns but the statistics."""
    with pq.ParquetFile(path) as file:
        names = [
            name
            for name in file.schema_arrow.names
            if (name in keys if keys is not None else not name.startswith("stats/"))
        ]
        for batch in file.iter_batches(_BATCH, columns=names, use_threads=False):
            yield from batch.to_pylist()


def to_count(value: object) -> int | None:
    """Return `value` as an integer of at least 0, None if it is not one.

    Integral floats are accepted: pandas turns an integer column with a missing value into floats.
    """
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None


def _make_entry(
    root: Path,
    info: Mapping[str, Any],
    index: int,
    row: Mapping[str, Any],
    lines: FactsFile,
    use: VideoUse,
) -> EpisodeEntry:
    counts = {name: to_count(row.get(name)) for name in _REQUIRED}
    faults = [
        f"{EPISODES_DIR} must give '{name}' of episode {index} as a number of 0 or more, "
        f"got {row.get(name)!r}"
        for name, count in counts.items()
        if count is None
    ]
    length = counts["length"] or 0
    if counts["length"] == 0:
        faults.append(f"episode {index} has no frames")
    places = {each: counts[f"data/{each}"] for each in _PLACES}
    is_known = None not in places.values()
    file = _find_file(root, info["data_path"], **places) if is_known else Path()
    videos = dict(_find_videos(root, info, index, row, faults))
    faults += use.shared.get(index, ())
    tasks = row.get("tasks")
    ends = tuple(to_count(row.get(f"dataset_{end}_index")) for end in ("from", "to"))
    return EpisodeEntry(
        index=index,
        length=length,
        tasks=(tasks,) if isinstance(tasks, str) else tuple(map(str, _to_list(tasks))),
        facts=_read_facts(index, counts["length"], row, lines),
        file=file,
        videos=videos,
        place=None if ends[0] is None or ends[1] is None else (ends[0], ends[1]),
        faults=tuple(faults),
    )


def _to_list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def _is_nothing(value: object) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def _read_facts(
    index: int, length: int | None, row: Mapping[str, Any], lines: FactsFile
) -> dict[str, Any]:
    facts = {
        key.removeprefix(FACTS_PREFIX): value
        for key, value in row.items()
        if key.startswith(FACTS_PREFIX) and not _is_nothing(value)
    }
    for name in _COUNTS:
        count = to_count(facts.get(name))
        if count is not None:
            facts[name] = count
    for name in _JSON_FACTS:
        if isinstance(facts.get(name), str):
            try:
                facts[name] = json.loads(facts[name])
            except ValueError:
                del facts[name]
    line = lines.read(index)
    # A line with another length is stale: another tool has changed the episode since.
    if line.pop("length", length) == length or length is None:
        facts |= line
    facts.pop("episode_index", None)
    return facts


def _find_videos(
    root: Path, info: Mapping[str, Any], index: int, row: Mapping[str, Any], faults: list[str]
) -> Iterator[tuple[str, VideoSpan]]:
    """Yield the videos of an episode; append missing or malformed ones to `faults`."""
    for key in _list_video_keys(info):
        prefix = f"videos/{key}/"
        if any(row.get(prefix + name) is None for name in (*_PLACES, *_TIMES)):
            faults.append(f"episode {index} does not say where its video '{key}' is")
            continue
        bad = [name for name in _PLACES if to_count(row[prefix + name]) is None]
        bad += [name for name in _TIMES if _to_seconds(row[prefix + name]) is None]
        faults += [
            f"{EPISODES_DIR} must give '{prefix}{name}' of episode {index} as a "
            f"{'time [s]' if name in _TIMES else 'number'} of 0 or more, got {row[prefix + name]!r}"
            for name in bad
        ]
        span = _find_span(root, info, key, row)
        if span is not None:
            yield key, span


def _list_video_keys(info: Mapping[str, Any]) -> list[str]:
    return [key for key, feature in info["features"].items() if feature["dtype"] == "video"]


def _find_span(
    root: Path, info: Mapping[str, Any], key: str, row: Mapping[str, Any]
) -> VideoSpan | None:
    """Find the images of a camera; None if their location is missing or malformed."""
    file = _find_video(root, info, key, row)
    start, stop = (_to_seconds(row.get(f"videos/{key}/{name}")) for name in _TIMES)
    return None if file is None or start is None or stop is None else VideoSpan(file, start, stop)


def _find_video(
    root: Path, info: Mapping[str, Any], key: str, row: Mapping[str, Any]
) -> Path | None:
    places = {name: to_count(row.get(f"videos/{key}/{name}")) for name in _PLACES}
    if None in places.values():
        return None
    return _find_file(root, info.get("video_path"), video_key=key, **places)


def _to_seconds(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value) if value >= 0 else None


@dataclass(frozen=True)
class VideoUse:
    """Assignment of videos to episodes, over the whole dataset.

    Attributes:
        files: Videos that episodes use, relative to the dataset's directory.
        shared: Messages on images claimed by several episodes, by episode index.
    """

    files: frozenset[Path]
    shared: Mapping[int, tuple[str, ...]]


def find_video_use(root: Path, info: Mapping[str, Any]) -> VideoUse:
    """Find the videos that episodes use, and images claimed by two episodes.

    An image belongs to one episode. Where two claim it, one of them is wrong, and the metadata does
    not tell which.

    Raises:
        BadDataset: If the path pattern is malformed.
    """
    keys = _list_video_keys(info)
    if not keys:
        return VideoUse(frozenset(), {})
    names = ["episode_index"]
    names += [f"videos/{key}/{name}" for key in keys for name in (*_PLACES, *_TIMES)]
    files: set[Path] = set()
    spans: dict[Path, list[tuple[float, float, int, str]]] = {}
    for path in sorted((root / EPISODES_DIR).glob("*/*.parquet")):
        try:
            for row in _read_rows(path, names):
                index = to_count(row.get("episode_index"))
                for key in keys:
                    file, span = _find_video(root, info, key, row), _find_span(root, info, key, row)
                    if file is not None:
                        files.add(file)
                    if span is not None and index is not None:
                        spans.setdefault(span.file, []).append((span.start, span.stop, index, key))
        except UNREADABLE:  # reported where the episodes are read
            continue
    shared: dict[int, tuple[str, ...]] = {}
    half = 0.5 / info["fps"]  # tolerance for rounded times
    for file, claims in spans.items():
        claims.sort()
        last = claims[0]
        for claim in claims[1:]:
            start, stop, index, key = claim
            if start < last[1] - half and index != last[2]:
                text = (
                    f"the episodes {last[2]} and {index} have the same images of '{key}', "
                    f"{file} from {start:.2f} s to {min(stop, last[1]):.2f} s"
                )
                for each in (last[2], index):
                    shared[each] = (*shared.get(each, ()), text)
            if stop > last[1]:
                last = claim
    return VideoUse(frozenset(files), shared)


def _find_file(root: Path, template: object, **places: Any) -> Path:
    try:
        path = Path(str(template).format(**places))
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise BadDataset(root, f"meta/info.json has a malformed path '{template}'") from error
    if path.is_absolute() or ".." in path.parts:
        raise BadDataset(root, f"meta/info.json has a path outside the dataset, '{template}'")
    return path
