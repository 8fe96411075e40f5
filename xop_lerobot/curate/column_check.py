"""Check the columns of a Parquet file against the dataset's features, by its footer alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

PICTURES = ("video", "image")
"""Feature types whose values are not numbers in the rows."""
_KINDS = {"bool": "b", "float": "f", "int": "i", "uint": "u"}


def find_faults(file: pq.ParquetFile, features: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield the columns that are missing or have a wrong size, type or null values.

    No row is read: the footer states the type of each column and its number of values.

    Args:
        file: The file.
        features: Features of the dataset.

    Yields:
        What is wrong with a column, phrased to follow the file's name.
    """
    counts = _count_values(file.metadata)
    rows, schema = file.metadata.num_rows, file.schema_arrow
    for key, feature in features.items():
        if feature["dtype"] == "video":
            continue
        place = schema.get_field_index(key)
        if place < 0:
            yield f"has no column '{key}'"
            continue
        leaf = _find_leaf(schema.field(place).type)
        if feature["dtype"] in PICTURES or leaf is None:
            continue
        kind = np.dtype(leaf.to_pandas_dtype()).kind
        wanted = feature["dtype"].rstrip("0123456789")
        if wanted in _KINDS and kind not in "fiub":
            yield f"has {leaf} in the column '{key}', which should hold {feature['dtype']}"
            continue
        size = int(np.prod(feature["shape"]))
        values, empty = counts[key]
        if values != rows * size:
            each = f"{values / rows:g}" if rows else "no"
            yield f"has {each} entries a row in the column '{key}', which should have {size}"
        elif empty and pa.types.is_nested(schema.field(place).type):
            yield f"has {empty} null entries in the column '{key}'"


def _find_leaf(kind: pa.DataType) -> pa.DataType | None:
    """Return the element type of a nested list; None for images."""
    while pa.types.is_nested(kind):
        if pa.types.is_struct(kind):
            return None
        kind = kind.value_type
    return kind


def _count_values(metadata: pq.FileMetaData) -> dict[str, tuple[int, int]]:
    """Count the values of each column and, where stated, its nulls."""
    counts: dict[str, tuple[int, int]] = {}
    for group in range(metadata.num_row_groups):
        row_group = metadata.row_group(group)
        for index in range(row_group.num_columns):
            column = row_group.column(index)
            # A list's path ends in `.list.element`; keys may contain dots, too.
            key = column.path_in_schema.split(".list.")[0]
            statistics = column.statistics
            empty = statistics.null_count if statistics and statistics.has_null_count else 0
            values, nulls = counts.get(key, (0, 0))
            counts[key] = values + column.num_values, nulls + (empty or 0)
    return counts
