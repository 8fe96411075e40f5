"""Data files of a new dataset: rows as LeRobot writes them, one row group per episode."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.utils import update_chunk_file_indices

from xop_lerobot.core.errors import BadDataset


class RowFiles:
    """Writes rows of episodes.

    Consecutive episodes from one source file share a file.

    Args:
        root: Directory of the new dataset.
        template: `data_path` of its `meta/info.json`.
        chunks_size: Number of files per directory.
        features: Features of the dataset.
    """

    def __init__(
        self, root: Path, template: str, chunks_size: int, features: Mapping[str, Any]
    ) -> None:
        self._root, self._template, self._chunks_size = root, template, chunks_size
        self._schema = make_schema(features)
        self._writer: pq.ParquetWriter | None = None
        self._origin: object = None
        self.place = (0, -1)

    def write(
        self, table: pa.Table, columns: Mapping[str, np.ndarray], origin: object
    ) -> tuple[int, int]:
        """Write the rows of an episode.

        Args:
            table: Source rows.
            columns: New or changed columns. Shapes (n, size) or (n,).
            origin: Source file.

        Returns:
            Chunk index and file index.

        Raises:
            BadDataset: If a column is missing or does not match the features.
        """
        rows = make_rows(table, columns, self._schema, origin)
        if self._writer is None or origin != self._origin:
            self._open(origin)
        assert self._writer is not None
        self._writer.write_table(rows)
        return self.place

    def _open(self, origin: object) -> None:
        self.close()
        self.place = next_place(self.place, self._chunks_size)
        chunk, file = self.place
        path = self._root / self._template.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = pq.ParquetWriter(
            path, schema=self._schema, compression="snappy", use_dictionary=True
        )
        self._origin = origin

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def make_schema(features: Mapping[str, Any]) -> pa.Schema:
    """Make the schema of data files, as LeRobot writes them."""
    wanted = copy.deepcopy(dict(features))
    for feature in wanted.values():
        feature["shape"] = tuple(feature["shape"])
    return get_hf_features_from_features(wanted).arrow_schema


def make_rows(
    table: pa.Table, columns: Mapping[str, np.ndarray], schema: pa.Schema, origin: object
) -> pa.Table:
    """Convert rows to the schema that LeRobot writes; arguments as in `RowFiles.write`.

    Raises:
        BadDataset: If a column is missing, does not match the features, or has nulls.
    """
    arrays = []
    for field in schema:
        try:
            if field.name in columns:
                array = to_arrow(columns[field.name], field.type)
            else:
                array = cast_column(table[field.name], field.type)
        except (pa.ArrowException, KeyError) as error:
            text = str(error).splitlines()[0]
            raise BadDataset(
                origin, f"its column '{field.name}' is not {field.type} ({text})"
            ) from error
        if count_empty(array):
            raise BadDataset(
                origin, f"its column '{field.name}' has {count_empty(array)} null values"
            )
        arrays.append(array)
    return pa.Table.from_arrays(arrays, schema=schema)


def count_empty(array: pa.Array) -> int:
    """Count the nulls of a column, including those inside its lists."""
    inner = 0
    if pa.types.is_fixed_size_list(array.type) and not array.null_count:
        inner = array.flatten().null_count
    return array.null_count + inner


def next_place(place: tuple[int, int], chunks_size: int) -> tuple[int, int]:
    """Return the chunk and file index after `place`; the first after (0, -1)."""
    chunk, file = place
    return (chunk, 0) if file < 0 else update_chunk_file_indices(chunk, file, chunks_size)


def to_arrow(values: np.ndarray, kind: pa.DataType) -> pa.Array:
    """Convert an array to a column of type `kind`, a list per row for list types."""
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    if pa.types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(flat.cast(kind.value_type), type=kind)
    return flat.cast(kind)


def cast_column(column: pa.ChunkedArray, kind: pa.DataType) -> pa.Array:
    """Cast a column to type `kind`, in which other tools may not have written it."""
    values = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    if isinstance(values, pa.ExtensionArray):
        values = values.storage
    if isinstance(kind, pa.ExtensionType):
        return pa.ExtensionArray.from_storage(kind, values.cast(kind.storage_type))
    return values if values.type == kind else values.cast(kind)
