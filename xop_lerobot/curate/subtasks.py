"""Sub-tasks: a column of indices and a table of their names, as in LeRobot up to 0.5."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from xop_lerobot.core.errors import BadDataset

SUBTASK = "subtask_index"
SUBTASKS_FILE = Path("meta") / "subtasks.parquet"
_NAME = "subtask"


def read_subtasks(root: Path) -> dict[int, str]:
    """Read the names of sub-tasks by index; empty if the dataset has none.

    Raises:
        BadDataset: If the file is malformed.
    """
    path = root / SUBTASKS_FILE
    if not path.is_file():
        return {}
    try:
        table = pq.read_table(path).to_pydict()
        return dict(zip(table[SUBTASK], map(str, table[_NAME]), strict=True))
    except (pa.ArrowException, OSError, KeyError) as error:
        raise BadDataset(root, f"{SUBTASKS_FILE} is not readable ({error})") from error


def write_subtasks(root: Path, names: Sequence[str]) -> None:
    """Write the names of sub-tasks, indexed from 0."""
    import pandas as pd  # noqa: PLC0415 slow

    table = pd.DataFrame({SUBTASK: range(len(names))}, index=pd.Index(names, name=_NAME))
    table.to_parquet(root / SUBTASKS_FILE)
