"""A recording as hardware gives it, made from one of the simulation."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FRAMES = ("head", "left_wrist", "right_wrist")


def make_hardware_like(source: Path, root: Path, seed: int = 0) -> Path:
    """Copy a dataset and spoil it: no truth, clocks that jitter, tracking that drops out.

    In each episode, after each quarter of it: the left hand is lost for 0.6 s, the head for 0.4 s
    (which ends the engagement), and the operator lets go for 0.4 s. The clock jitters by 6 ms
    (standard deviation) and stands still once. An episode must be longer than 2.4 s.
    """
    shutil.copytree(source, root)
    rng = np.random.default_rng(seed)
    for path in sorted(root.glob("data/*/*.parquet")):
        table = pq.read_table(path)
        arrays = {name: read(table, name) for name in table.column_names}
        for episode in np.unique(arrays["episode_index"]):
            spoil(arrays, np.flatnonzero(arrays["episode_index"][:, 0] == episode), rng)
        for name, values in arrays.items():
            place = table.column_names.index(name)
            kind = table.schema.field(name).type
            plain = values.tolist() if pa.types.is_nested(kind) else values[:, 0].tolist()
            table = table.set_column(place, table.schema.field(name), pa.array(plain, kind))
        pq.write_table(table, path)
    return root


def read(table: pa.Table, name: str) -> np.ndarray:
    values = np.array(table[name].to_pylist())
    return values.reshape(len(values), -1)


def spoil(arrays: dict[str, np.ndarray], rows: np.ndarray, rng: np.random.Generator) -> None:
    fps, quarter = 25, len(rows) // 4
    for name in ("base_pose", *FRAMES):
        arrays[f"robot.{name}"][rows] = 0
    jitter = np.clip(rng.normal(0, 0.006, len(rows)), -0.018, 0.018)
    arrays["time.sim"][rows, 0] += jitter
    arrays["time.sim"][rows[5]] = arrays["time.sim"][rows[4]]
    hand = rows[quarter : quarter + round(0.6 * fps)]
    arrays["operator.tracked"][hand, 1] = False
    arrays["operator.left_wrist"][hand] = 0
    head = rows[2 * quarter : 2 * quarter + round(0.4 * fps)]
    arrays["operator.tracked"][head, 0] = False
    arrays["operator.head"][head] = 0
    free = rows[3 * quarter : 3 * quarter + round(0.4 * fps)]
    for gone in (head, free):
        arrays["operator.engaged"][gone] = False
        for name in FRAMES:
            arrays[f"goal.{name}"][gone] = 0
