"""Rows of an episode as arrays, read from its parquet file a row group at a time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.column_check import find_faults
from xop_lerobot.curate.entries import UNREADABLE, EpisodeEntry

INDEX = "episode_index"


class RowReader:
    """Reads episodes' rows; the file and the row group that were read last stay open.

    LeRobot writes a row group for each episode. Where another tool put several into one, they are
    decoded once for all that are read one after another.

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
        """Close the file that is open; may be called at any time."""
        if self._file is not None:
            self._file.close()
        self._file, self._path, self._cached = None, Path(), None

    def read(self, entry: EpisodeEntry, columns: Iterable[str]) -> dict[str, np.ndarray]:
        """Read columns of an episode.

        Returns:
            An array for each column, a row for each frame. Shape (n, size), of strings (n, 1).

        Raises:
            BadDataset: If the file is not readable, has not these columns or has them in another
                shape, or if it does not hold the whole episode.
        """
        names = tuple(dict.fromkeys(columns))
        table = self.read_table(entry, names)
        return {name: self._convert(entry, name, table[name]) for name in names}

    def check(self, entry: EpisodeEntry) -> None:
        """Check that all columns of an episode's file are as announced, without reading them.

        Raises:
            BadDataset: If the file is not readable, or one is not.
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
        """Read columns of an episode as its file has them; all of its features without `names`.

        Raises:
            BadDataset: If the file is not readable, has not these columns, or does not hold the
                whole episode.
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
                self._root, f"{entry.file} has no column {', '.join(missing)}, which it should have"
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
            self._cached = None  # so that two groups are never in memory
            wanted = list(dict.fromkeys((INDEX, *names)))
            self._cached = (key, file.read_row_group(group, columns=wanted, use_threads=False))
        return self._cached[1]

    def _convert(self, entry: EpisodeEntry, name: str, column: pa.ChunkedArray) -> np.ndarray:
        feature = self._features[name]
        size = int(np.prod(feature["shape"]))
        where = f"column '{name}' of episode {entry.index}"
        if _holds_pictures(column.type):
            raise BadDataset(self._root, f"{where} holds pictures and no numbers")
        values, rows = column.combine_chunks(), len(column)
        if isinstance(values, pa.ChunkedArray):  # as some versions of pyarrow have it
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
            raise BadDataset(self._root, f"{where} has {values.null_count} empty values")
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
    """Find the lowest and the highest episode of each row group; None where it is not stated."""
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
