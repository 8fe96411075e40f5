"""Task descriptions of a dataset by task index."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.entries import UNREADABLE

TASK = "task_index"
TASKS_FILE = Path("meta") / "tasks.parquet"
_WORDS = ("task", "__index_level_0__")
"""Columns that hold the description: LeRobot's, and the one pandas writes for an unnamed index."""


def read_tasks(root: Path) -> dict[int, str]:
    """Read the description of each task by its index.

    LeRobot stores descriptions in the index of a pandas table, other writers in an ordinary column.
    Both are text columns of the file. It is read without pandas, which would take the row number
    for the description in the second case.

    Raises:
        BadDataset: If the file is malformed, or it is unclear which column holds the descriptions.
    """
    try:
        table = pq.read_table(root / TASKS_FILE)
        numbers = table[TASK].cast(pa.int64()).to_pylist()
    except (*UNREADABLE, KeyError) as error:
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise BadDataset(root, f"{TASKS_FILE} is not readable ({text})") from error
    name = find_words(table.schema)
    if name is None:
        raise BadDataset(
            root,
            f"{TASKS_FILE} must have one text column, the task descriptions, beside {TASK}. "
            f"Its columns: {', '.join(table.column_names)}",
        )
    tasks: dict[int, str] = {}
    for number, words in zip(numbers, table[name].to_pylist(), strict=True):
        if number is None or words is None:
            raise BadDataset(
                root, f"{TASKS_FILE} must give number and words of each task, got {number}: {words}"
            )
        if tasks.setdefault(number, words) != words:
            raise BadDataset(
                root, f"{TASKS_FILE} gives task {number} twice: '{tasks[number]}' and '{words}'"
            )
    return tasks


def find_words(schema: pa.Schema) -> str | None:
    """Return the column of descriptions; None if there is none or several candidates."""
    texts = [field.name for field in schema if _is_text(field.type)]
    named = [name for name in _WORDS if name in texts]
    if named:
        return named[0]
    return texts[0] if len(texts) == 1 else None


def has_index_of_words(root: Path) -> bool:
    """Whether the descriptions are the index of the pandas table, where LeRobot looks."""
    schema = pq.read_schema(root / TASKS_FILE)
    return find_words(schema) in (schema.pandas_metadata or {}).get("index_columns", ())


def _is_text(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return pa.types.is_string(kind) or pa.types.is_large_string(kind) or kind == pa.string_view()
