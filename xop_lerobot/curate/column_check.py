"""Whether the columns of a parquet file are what the features say, by its footer alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

PICTURES = ("video", "image")
"""Types of features whose values are no numbers in the rows."""
_KINDS = {"bool": "b", "float": "f", "int": "i", "uint": "u"}


def find_faults(file: pq.ParquetFile, features: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Find the columns that are missing, or have another size, other values, or empty ones.

    No row is read: the footer tells the type of each column, and how many values it holds.

    Args:
        file: The file.
        features: Features of the dataset.

    Yields:
        What is wrong with a column, in words that follow on the file's name.
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
            yield f"has {empty} empty entries in the column '{key}'"


def _find_leaf(kind: pa.DataType) -> pa.DataType | None:
    """Find what a nested list holds in the end; None for pictures."""
    while pa.types.is_nested(kind):
        if pa.types.is_struct(kind):
            return None
        kind = kind.value_type
    return kind


def _count_values(metadata: pq.FileMetaData) -> dict[str, tuple[int, int]]:
    """Count the values of each column and, where that is stated, the empty ones among them."""
    counts: dict[str, tuple[int, int]] = {}
    for group in range(metadata.num_row_groups):
        row_group = metadata.row_group(group)
        for index in range(row_group.num_columns):
            column = row_group.column(index)
            # The path of a list goes on with `.list.element`; keys may have points too.
            key = column.path_in_schema.split(".list.")[0]
            statistics = column.statistics
            empty = statistics.null_count if statistics and statistics.has_null_count else 0
            values, nulls = counts.get(key, (0, 0))
            counts[key] = values + column.num_values, nulls + (empty or 0)
    return counts
