"""Write selected episodes, complete or trimmed, as a new LeRobot dataset.

LeRobot's own `delete_episodes` and `split_dataset` re-encode a video when one of its episodes
is removed, hold the whole dataset in memory, and drop this project's metadata. Here rows and
images stream from file to file, one episode at a time, and LeRobot's metadata class writes
everything in `meta` that is LeRobot's own.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.utils import DEFAULT_CHUNK_SIZE, DEFAULT_DATA_PATH, DEFAULT_VIDEO_PATH

from xop_lerobot.core.errors import BadDataset, XopError
from xop_lerobot.curate.clip import PROVENANCE, Clip, Step, make_facts, make_refusal
from xop_lerobot.curate.row_files import RowFiles
from xop_lerobot.curate.stats import (
    Stats,
    StatsReader,
    compute_picture_stats,
    compute_stats,
    pick_pictures,
    read_pictures,
)
from xop_lerobot.curate.subtasks import SUBTASK, read_subtasks, write_subtasks
from xop_lerobot.curate.task_words import TASK, TASKS_FILE, read_tasks
from xop_lerobot.curate.video import Cut, decode
from xop_lerobot.curate.video_files import VideoFiles
from xop_lerobot.recording.facts import (
    CONFIG_FILE,
    CONFIGS_DIR,
    EPISODES_FILE,
    FACTS_DIR,
    FACTS_PREFIX,
    EpisodeFacts,
    compute_config_hash,
)

__all__ = ["Clip", "NothingLeft", "Step", "Transferred", "transfer"]

_COUNTED = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_SIZES = ("chunks_size", "data_files_size_in_mb", "video_files_size_in_mb")


class NothingLeft(XopError):
    """Raised when no episode is to be written."""

    def __init__(self) -> None:
        super().__init__("no episode is left, so no dataset is made")


@dataclass(frozen=True)
class Transferred:
    """Size of the written dataset.

    Attributes:
        episodes: Number of episodes.
        frames: Number of frames.
    """

    episodes: int
    frames: int


def transfer(
    clips: Iterable[Clip],
    draft: Path,
    step: Step,
    features: Mapping[str, Mapping[str, Any]] | None = None,
) -> Transferred:
    """Write clips in order as a new dataset.

    Every column, image and metadata entry is kept. Frames, episodes and time stamps are renumbered;
    statistics are recomputed where values have changed. Memory holds one episode.

    Args:
        clips: Clips to write; their datasets must have the same features.
        draft: Directory of the new dataset, which must not exist.
        step: The present step, for the `provenance` of the episodes.
        features: Features of new columns.

    Raises:
        NothingLeft: If there are no clips; nothing is written.
        BadDataset: If a source is malformed.
    """
    writer: _Writer | None = None
    try:
        for clip in clips:
            if writer is None:
                writer = _Writer(draft, clip, step, features or {})
            writer.write(clip)
    finally:
        if writer is not None:
            writer.close()
    if writer is None:
        raise NothingLeft
    return Transferred(writer.meta.total_episodes, writer.meta.total_frames)


class _Writer:
    """Writes one dataset.

    Args:
        root: Directory of the dataset.
        first: The first clip; its source defines features and settings.
        step: The present step.
        features: Features of new columns.
    """

    def __init__(
        self, root: Path, first: Clip, step: Step, features: Mapping[str, Mapping[str, Any]]
    ) -> None:
        source, info = first.source, first.source.info
        self._root, self._step, self._fps = root, step, source.fps
        wanted = copy.deepcopy({**source.features, **features})
        for feature in wanted.values():
            feature["shape"] = tuple(feature["shape"])
        self.meta = meta = LeRobotDatasetMetadata.create(
            f"local/{root.name}",
            source.fps,
            wanted,
            robot_type=source.robot,
            root=root,
            use_videos=any(feature["dtype"] == "video" for feature in wanted.values()),
            **{name: info[name] for name in _SIZES if info.get(name)},
        )
        meta.info.tools = info.get("tools")
        size = meta.chunks_size or DEFAULT_CHUNK_SIZE
        self._rows = RowFiles(root, meta.data_path or DEFAULT_DATA_PATH, size, meta.features)
        template = meta.video_path or DEFAULT_VIDEO_PATH
        self._videos = {
            key: VideoFiles(root, template, size, key, source.fps) for key in meta.video_keys
        }
        self._sources: dict[Path, _SourceParts] = {}
        self._subtasks: list[str] = []
        self._has_facts = bool(first.entry.facts)
        (root / FACTS_DIR).mkdir(parents=True)
        self._facts = (root / EPISODES_FILE).open("w", encoding="utf-8")

    def close(self) -> None:
        """Close all files."""
        if self._subtasks:
            write_subtasks(self._root, self._subtasks)
        for part in (self._rows, *self._videos.values(), self._facts):
            part.close()
        self.meta.finalize()

    def write(self, clip: Clip) -> None:
        """Write one clip as the next episode."""
        if clip.entry.faults:
            raise make_refusal(clip)
        parts = self._open(clip)
        start, stop = clip.span
        table = clip.source.read_table(clip.entry).slice(start, stop - start)
        tasks = parts.name_tasks(table, clip)
        self.meta.save_episode_tasks(list(dict.fromkeys(tasks)))
        columns = {**clip.columns, **self._count(tasks, len(clip))}
        if parts.subtasks and SUBTASK not in clip.columns and SUBTASK in table.column_names:
            columns[SUBTASK] = self._number_subtasks(table, parts.subtasks)
        cuts = _cut_videos(clip, self._videos)
        origin = clip.source.root / clip.entry.file
        chunk, file = self._rows.write(table, columns, origin)
        metadata: dict[str, Any] = {"data/chunk_index": chunk, "data/file_index": file}
        for key, files in self._videos.items():
            metadata |= files.write(cuts[key])
        facts = make_facts(clip, self._step)
        index = self.meta.total_episodes
        self.meta.save_episode(
            index,
            len(clip),
            list(dict.fromkeys(tasks)),
            _plain(self._find_stats(clip, parts.stats, table, columns, cuts)),
            metadata | to_metadata(facts, complete=self._has_facts),
        )
        line = {**facts, "episode_index": index, "length": len(clip)}
        order = ("episode_index", "length", *facts)
        self._facts.write(json.dumps({key: line[key] for key in order}) + "\n")

    def _open(self, clip: Clip) -> _SourceParts:
        root = clip.source.root
        if root not in self._sources:
            self._sources[root] = _SourceParts(root)
            self._keep_config(root)
        return self._sources[root]

    def _keep_config(self, root: Path) -> None:
        """Copy the configurations of a source; the first one also to the usual path."""
        target = self._root / CONFIG_FILE
        for path in (root / CONFIG_FILE, *sorted((root / CONFIGS_DIR).glob("*.json"))):
            try:
                config = json.loads(path.read_text(encoding="utf-8"))
            except (OSError, ValueError):
                continue
            if not target.exists():
                shutil.copyfile(path, target)
            named = self._root / CONFIGS_DIR / f"{compute_config_hash(config)}.json"
            named.parent.mkdir(exist_ok=True)
            shutil.copyfile(path, named)

    def _count(self, tasks: Sequence[str], length: int) -> dict[str, np.ndarray]:
        frames = np.arange(length)
        numbers = {task: self.meta.get_task_index(task) for task in dict.fromkeys(tasks)}
        return {
            "timestamp": (frames / self._fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(length, self.meta.total_episodes),
            "index": frames + self.meta.total_frames,
            "task_index": np.array([numbers[task] for task in tasks]),
        }

    def _number_subtasks(self, table: pa.Table, names: Mapping[int, str]) -> np.ndarray:
        """Renumber the sub-tasks of the rows consistently over the new dataset."""
        numbers = table[SUBTASK].to_pylist()
        self._subtasks += [name for name in names.values() if name not in self._subtasks]
        # An index without a name is kept; LeRobot uses -1 for none.
        return np.array(
            [self._subtasks.index(names[n]) if n in names else n for n in numbers], np.int64
        )

    def _find_stats(
        self,
        clip: Clip,
        reader: StatsReader,
        table: pa.Table,
        columns: Mapping[str, np.ndarray],
        cuts: Mapping[str, Cut],
    ) -> Stats:
        """Reuse the statistics of unchanged features and compute the others."""
        features = self.meta.features
        known = {} if clip.is_cut else reader.read(clip.entry.index)
        stats = {
            key: value
            for key, value in known.items()
            if key in features and all(map(_is_finite, value.values()))
        }
        numbers = dict(columns)
        for key, feature in features.items():
            if key in stats and key not in columns:
                continue
            if key in self.meta.depth_keys:
                # Depth is stored quantised, so statistics cannot be recomputed: keep the episode's.
                stats |= {each: value for each, value in reader.read(clip.entry.index).items()
                          if each == key}  # fmt: skip
            elif feature["dtype"] == "video":
                wanted = pick_pictures(len(clip))
                pictures = [picture for _, picture in decode(cuts[key], self._fps, set(wanted))]
                stats[key] = compute_picture_stats(iter(pictures))
            elif feature["dtype"] == "image":
                wanted = pick_pictures(len(clip))
                stats[key] = compute_picture_stats(read_pictures(table[key], wanted))
            elif key not in columns and feature["dtype"] not in ("string", "language"):
                numbers[key] = _to_numpy(table[key], feature)
        return stats | compute_stats(numbers, features)


class _SourceParts:
    """What is read of a source besides its rows."""

    def __init__(self, root: Path) -> None:
        self.stats = StatsReader(root)
        self._names = read_tasks(root)
        self._root = root
        self.subtasks = read_subtasks(root)

    def name_tasks(self, table: pa.Table, clip: Clip) -> list[str]:
        """Return the task description of each row."""
        if clip.task is not None:
            return [clip.task] * table.num_rows
        numbers = table[TASK].to_pylist()
        unknown = sorted(set(numbers) - set(self._names), key=str)
        if unknown:
            raise BadDataset(
                self._root,
                f"episode {clip.entry.index} has the task_index {unknown[0]}, which "
                f"{TASKS_FILE} does not list. It lists {', '.join(map(str, self._names))}",
            )
        return [self._names[number] for number in numbers]


def _cut_videos(clip: Clip, keys: Iterable[str]) -> dict[str, Cut]:
    """Locate the images of a clip in the videos."""
    (start, stop), fps, cuts = clip.span, clip.source.fps, {}
    dropped = clip.entry.facts.get("dropped_frames")
    spare = dropped if isinstance(dropped, int) else 0
    for key in keys:
        span = clip.entry.videos[key]
        pictures = (span.stop - span.start) * fps
        if not -0.5 - spare < pictures - clip.entry.length < 0.5:  # half an image for rounding
            raise BadDataset(
                clip.source.root,
                f"episode {clip.entry.index} has {clip.entry.length} frames, but {pictures:g} "
                f"images of '{key}'",
            )
        # The metadata states the end: with dropped images it cannot be counted from the start.
        end = span.stop if stop == clip.entry.length else span.start + stop / fps
        begin = span.start + start / fps
        cuts[key] = Cut(clip.source.root, span.file, begin, end, stop - start, spare)
    return cuts


def _to_numpy(column: pa.ChunkedArray, feature: Mapping[str, Any]) -> np.ndarray:
    shape = (len(column), *feature["shape"])
    return np.array(column.to_pylist(), feature["dtype"]).reshape(shape)


def _is_finite(values: np.ndarray) -> bool:
    return values.dtype.kind in "biuf" and bool(np.isfinite(values).all())


def _plain(stats: Stats) -> Stats:
    """Convert statistics to one dtype, so that those of all episodes fit into one column."""
    return {
        key: {
            kind: np.atleast_1d(value).astype(np.int64 if kind == "count" else np.float64)
            for kind, value in parts.items()
        }
        for key, parts in stats.items()
    }


def to_metadata(facts: Mapping[str, Any], *, complete: bool) -> dict[str, Any]:
    """Convert metadata entries into columns of LeRobot's episode metadata.

    Args:
        facts: Metadata of an episode.
        complete: Whether to make all columns of `EpisodeFacts`, with defaults for missing entries.
    """
    columns: dict[str, Any] = {}
    defaults = {"bool": False, "int": 0, "float": 0.0, "str": ""}
    for each in dataclasses.fields(EpisodeFacts) if complete else ():
        kind = type(defaults[str(each.type)])
        value = facts.get(each.name, kind())
        columns[FACTS_PREFIX + each.name] = (
            json.dumps(value) if kind is str and not isinstance(value, str) else kind(value)
        )
    columns[FACTS_PREFIX + PROVENANCE] = json.dumps(facts[PROVENANCE])
    return columns
