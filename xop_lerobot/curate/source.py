"""Streaming reader of a LeRobot v3 dataset; it never writes into the dataset's directory."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.column_check import find_faults
from xop_lerobot.curate.entries import (
    UNREADABLE,
    EpisodeEntry,
    VideoSpan,
    VideoUse,
    find_video_use,
    read_entries,
)
from xop_lerobot.recording.facts import CONFIG_FILE

INDEX = "episode_index"


class RowReader:
    """Reads rows of episodes; the file and row group read last stay open.

    LeRobot writes one row group per episode. Where another tool put several episodes into one, it
    is decoded once for consecutive reads.

    Args:
        root: Directory of the dataset.
        features: Its features.
    """

    def __init__(self, root: Path, features: Mapping[str, Mapping[str, Any]]) -> None:
        self._root, self._features = root, features
        self._path = Path()
        self._file: pq.ParquetFile | None = None
        self._groups: list[tuple[int, int] | None] = []
        self._faults: tuple[str, ...] = ()
        self._cached: tuple[object, pa.Table] | None = None

    def close(self) -> None:
        """Close the open file; may be called at any time."""
        if self._file is not None:
            self._file.close()
        self._file, self._path, self._cached = None, Path(), None

    def read(self, entry: EpisodeEntry, columns: Iterable[str]) -> dict[str, np.ndarray]:
        """Read columns of an episode.

        Returns:
            An array per column, one row per frame. Shape (n, size), of strings (n, 1).

        Raises:
            BadDataset: If the file is not readable, lacks a column or has it in another shape, or
                does not hold the whole episode.
        """
        names = tuple(dict.fromkeys(columns))
        table = self.read_table(entry, names)
        return {name: self._convert(entry, name, table[name]) for name in names}

    def check(self, entry: EpisodeEntry) -> None:
        """Check that the columns of an episode's file match the features, without reading rows.

        Raises:
            BadDataset: If the file is not readable, or a column does not match.
        """
        if not entry.has_rows:
            raise BadDataset(self._root, entry.faults[0])
        try:
            self._open(entry.file)
        except UNREADABLE as error:
            raise self._make_unreadable(entry, error) from error
        if self._faults:
            raise BadDataset(self._root, f"{entry.file} {'; it '.join(self._faults)}")

    def read_table(self, entry: EpisodeEntry, names: Sequence[str] = ()) -> pa.Table:
        """Read columns of an episode as stored; all columns of features without `names`.

        Raises:
            BadDataset: If the file is not readable, lacks a column, or does not hold the whole
                episode.
        """
        if not entry.has_rows:
            raise BadDataset(self._root, entry.faults[0])
        if not names:
            self.check(entry)
            names = [key for key, each in self._features.items() if each["dtype"] != "video"]
        try:
            table = self._read_table(entry, tuple(names))
        except UNREADABLE as error:
            raise self._make_unreadable(entry, error) from error
        if table.num_rows != entry.length:
            raise BadDataset(
                self._root,
                f"episode {entry.index} must have {entry.length} rows in {entry.file}, "
                f"it has {table.num_rows}",
            )
        return table

    def _make_unreadable(self, entry: EpisodeEntry, error: Exception) -> BadDataset:
        self.close()
        text = (str(error) or type(error).__name__).splitlines()[0]
        return BadDataset(self._root, f"{entry.file} is not readable ({text})")

    def _read_table(self, entry: EpisodeEntry, names: Sequence[str]) -> pa.Table:
        file = self._open(entry.file)
        present = set(file.schema_arrow.names)
        missing = [name for name in (INDEX, *names) if name not in present]
        if missing:
            raise BadDataset(
                self._root, f"{entry.file} lacks the column {', '.join(missing)} of the features"
            )
        parts = []
        for group, span in enumerate(self._groups):
            if span is None or span[0] <= entry.index <= span[1]:
                table = self._read_group(file, group, names)
                parts.append(table.filter(pa.array(table[INDEX].to_numpy() == entry.index)))
        return pa.concat_tables(parts) if parts else pa.table({name: [] for name in names})

    def _open(self, path: Path) -> pq.ParquetFile:
        if self._file is None or path != self._path:
            self.close()
            self._file, self._path = pq.ParquetFile(self._root / path), path
            self._groups = _find_groups(self._file)
            self._faults = tuple(find_faults(self._file, self._features))
        return self._file

    def _read_group(self, file: pq.ParquetFile, group: int, names: Sequence[str]) -> pa.Table:
        key = (group, names)
        if self._cached is None or self._cached[0] != key:
            self._cached = None  # free the last group first: two may not fit into memory
            wanted = list(dict.fromkeys((INDEX, *names)))
            self._cached = (key, file.read_row_group(group, columns=wanted, use_threads=False))
        return self._cached[1]

    def _convert(self, entry: EpisodeEntry, name: str, column: pa.ChunkedArray) -> np.ndarray:
        feature = self._features[name]
        size = int(np.prod(feature["shape"]))
        where = f"column '{name}' of episode {entry.index}"
        if _holds_pictures(column.type):
            raise BadDataset(self._root, f"{where} holds images, not numbers")
        values, rows = column.combine_chunks(), len(column)
        if isinstance(values, pa.ChunkedArray):  # some versions of pyarrow return chunks
            values = pa.concat_arrays(values.chunks) if values.num_chunks else pa.array([])
        while pa.types.is_nested(values.type) and not values.null_count:
            sizes = values.value_lengths().unique().to_pylist()
            if len(sizes) > 1:
                raise BadDataset(
                    self._root,
                    f"{where} must have {size} entries in each row, it has {min(sizes)} to "
                    f"{max(sizes)}",
                )
            values = values.flatten()
        if values.null_count:
            raise BadDataset(self._root, f"{where} has {values.null_count} null values")
        if len(values) != rows * size:
            actual = f"{len(values) / rows:g}" if rows else "no"
            raise BadDataset(self._root, f"{where} must have {size} entries a row, it has {actual}")
        array = values.to_numpy(zero_copy_only=False)
        is_text = feature["dtype"] in ("string", "language")
        if not is_text and array.dtype.kind not in "fiub":
            raise BadDataset(
                self._root, f"{where} must hold {feature['dtype']}, it holds {values.type}"
            )
        return array.reshape(rows, size)


def _holds_pictures(kind: pa.DataType) -> bool:
    while pa.types.is_nested(kind):
        if pa.types.is_struct(kind):
            return True
        kind = kind.value_type
    return False


def _find_groups(file: pq.ParquetFile) -> list[tuple[int, int] | None]:
    """Find the lowest and highest episode index of each row group; None if not stated."""
    metadata = file.metadata
    spans: list[tuple[int, int] | None] = []
    names = file.schema_arrow.names
    for group in range(metadata.num_row_groups):
        column = metadata.row_group(group)
        places = {column.column(i).path_in_schema: i for i in range(column.num_columns)}
        place = places.get(INDEX) if INDEX in names else None
        statistics = None if place is None else column.column(place).statistics
        if statistics is None or not statistics.has_min_max:
            spans.append(None)
        else:
            spans.append((int(statistics.min), int(statistics.max)))
    return spans


__all__ = ["EpisodeEntry", "Source", "VideoSpan"]

INFO_FILE = Path("meta") / "info.json"
VERSION = "v3."
_CONVERT = "python -m lerobot.scripts.convert_dataset_v21_to_v30"
_NUMBERS = (int, float)


class Source:
    """A dataset opened for reading: features, episodes and rows.

    Memory does not grow with the dataset: only the metadata of a few episodes and one row group,
    which in LeRobot's files is one episode, are held at a time.

    Args:
        root: Directory of the dataset.

    Attributes:
        root: The same.
        info: Content of `meta/info.json`.
        features: Features by key: dtype, shape and names.
        fps: Frame rate [Hz].
        robot: LeRobot's robot type; None if not stated.

    Raises:
        BadDataset: If there is no LeRobot v3 dataset, or its `meta/info.json` is malformed.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self.info = _read_info(self.root)
        self.features: dict[str, dict[str, Any]] = self.info["features"]
        self.fps = self.info["fps"]
        self.robot: str | None = self.info.get("robot_type")
        self._rows = RowReader(self.root, self.features)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the open file."""
        self._rows.close()

    @property
    def total_episodes(self) -> int:
        """Number of episodes that `meta/info.json` states."""
        return int(self.info.get("total_episodes") or 0)

    @property
    def episodes(self) -> Iterator[EpisodeEntry]:
        """Iterate over the episodes in order.

        Raises:
            BadDataset: If the metadata is missing or malformed.
        """
        return self.iterate()

    def iterate(self, note: Callable[[str], None] | None = None) -> Iterator[EpisodeEntry]:
        """Iterate over the episodes in order.

        Args:
            note: Receives unreadable files and invalid rows of metadata; None makes them errors.

        Raises:
            BadDataset: If the metadata is missing or malformed.
        """
        return read_entries(self.root, self.info, note, self.video_use)

    @cached_property
    def video_use(self) -> VideoUse:
        """Videos that episodes use, and images that several episodes claim.

        Raises:
            BadDataset: If the path pattern is malformed.
        """
        return find_video_use(self.root, self.info)

    def read(self, entry: EpisodeEntry, columns: Iterable[str]) -> dict[str, np.ndarray]:
        """Read only these columns of an episode.

        Args:
            entry: The episode.
            columns: Keys of features other than images.

        Returns:
            An array per column, one row per frame, of the file's dtype, possibly read-only. Shape
            (n, size).

        Raises:
            BadDataset: If the dataset lacks a column, or the file is malformed.
        """
        wanted = tuple(columns)
        self.check(wanted)
        return self._rows.read(entry, wanted)

    def read_table(self, entry: EpisodeEntry, columns: Sequence[str] = ()) -> pa.Table:
        """Read columns of an episode as stored, images included; all without `columns`.

        Images can be read so.

        Raises:
            BadDataset: If the file is malformed, or does not hold the whole episode.
        """
        return self._rows.read_table(entry, columns)

    def check_rows(self, entry: EpisodeEntry) -> None:
        """Check that an episode's file matches the features, without reading rows.

        Raises:
            BadDataset: If the file is not readable, or a column does not match.
        """
        self._rows.check(entry)

    def check(self, columns: Iterable[str]) -> None:
        """Check that the dataset has these columns.

        Raises:
            BadDataset: If it lacks one, listing those that it has.
        """
        missing = [name for name in columns if name not in self.features]
        if missing:
            raise BadDataset(
                self.root,
                f"it has no column {', '.join(missing)}. Its columns: "
                f"{', '.join(sorted(self.features))}",
            )

    def read_config(self) -> dict[str, Any]:
        """Read `meta/xop/config.json`; empty if missing or no JSON object."""
        try:
            config = json.loads((self.root / CONFIG_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return config if isinstance(config, dict) else {}


def _read_info(root: Path) -> dict[str, Any]:
    if not root.is_dir():
        raise BadDataset(root, "there is no such directory")
    path = root / INFO_FILE
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadDataset(root, f"it has no {INFO_FILE}, so it is not a LeRobot dataset") from None
    except (OSError, ValueError) as error:
        raise BadDataset(root, f"{INFO_FILE} is not readable ({error})") from error
    if not isinstance(info, dict):
        raise BadDataset(root, f"{INFO_FILE} must hold a JSON object")
    version = str(info.get("codebase_version"))
    if not version.startswith(VERSION):
        raise BadDataset(
            root,
            f"its format must be LeRobot's v3.0, it is {version}. `{_CONVERT}` converts from v2.1",
        )
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, _NUMBERS) or not 0 < fps < math.inf:
        raise BadDataset(root, f"{INFO_FILE} must give fps as a number above 0, got {fps!r}")
    for name in ("total_episodes", "total_frames"):
        count = info.get(name, 0)
        if isinstance(count, bool) or not isinstance(count, int) or count < 0:
            raise BadDataset(
                root, f"{INFO_FILE} must give {name} as a number of 0 or more, got {count!r}"
            )
    if not isinstance(info.get("data_path"), str):
        raise BadDataset(root, f"{INFO_FILE} must give data_path, the pattern of the data files")
    if not isinstance(info.get("robot_type", ""), str | None):
        raise BadDataset(root, f"{INFO_FILE} must give robot_type as text")
    _check_features(root, info.get("features"))
    return info


def _check_features(root: Path, features: object) -> None:
    if not isinstance(features, Mapping) or not features:
        raise BadDataset(root, f"{INFO_FILE} must give the features of each row")
    for key, feature in features.items():
        is_valid = isinstance(feature, Mapping) and isinstance(feature.get("dtype"), str)
        shape = feature.get("shape") if is_valid else None
        if not isinstance(shape, list) or not all(
            isinstance(size, int) and not isinstance(size, bool) and size > 0 for size in shape
        ):
            raise BadDataset(
                root, f"{INFO_FILE} must give dtype and shape of the feature '{key}', got {feature}"
            )
