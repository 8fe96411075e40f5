"""Small datasets for the tests of curation: synthetic ones, and foreign ones."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

# LeRobot makes folders under its home at import.
os.environ.setdefault("HF_LEROBOT_HOME", tempfile.mkdtemp(prefix="lerobot-"))

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset

from benchmarks.curate_synthetic import make_dataset
from xop_lerobot.recording.writer import keep_schedule

SIZE = 32


def make_synthetic(root: Path, episodes: int = 4, frames: int = 100, **options: Any) -> Path:
    """A synthetic dataset of this project's columns, without pictures."""
    make_dataset(root, episodes, frames, **options)
    return root


def make_foreign(root: Path, episodes: int = 2, frames: int = 30, *, video: bool = True) -> Path:
    """A dataset as stock LeRobot records it with somebody else's robot."""
    features: dict[str, dict] = {
        "action": {"dtype": "float32", "shape": (3,), "names": ["a.pos", "b.pos", "c.pos"]},
        "observation.state": {"dtype": "float32", "shape": (2,), "names": None},
    }
    if video:
        features["observation.images.cam"] = {
            "dtype": "video", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"],
        }  # fmt: skip
    dataset = LeRobotDataset.create(
        "somebody/else", 10, features, root=root, robot_type="so101", use_videos=video
    )
    rng = np.random.default_rng(0)
    for episode in range(episodes):
        for frame in range(frames):
            t = frame / 10
            row: dict[str, Any] = {
                "action": np.array([np.sin(t), 0.5, np.cos(2 * t)], np.float32),
                "observation.state": rng.normal(size=2).astype(np.float32),
                "task": f"task {episode}",
            }
            if video:
                row["observation.images.cam"] = rng.integers(0, 255, (SIZE, SIZE, 3), np.uint8)
            dataset.add_frame(row)
        with keep_schedule():
            dataset.save_episode()
    dataset.finalize()
    return root


def compute_digests(root: Path) -> dict[str, str]:
    """SHA-256 of every file under `root`, by its path in it."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def rewrite(path: Path, columns: Mapping[str, Any], drop: tuple[str, ...] = ()) -> None:
    """Write a parquet file anew with other columns; values are arrays of pyarrow or lists."""
    table = pq.read_table(path).drop_columns(list(drop))
    for name, values in columns.items():
        array = values if isinstance(values, pa.Array) else pa.array(values)
        if name in table.column_names:
            table = table.set_column(table.column_names.index(name), name, array)
        else:
            table = table.append_column(name, array)
    pq.write_table(table.replace_schema_metadata(None), path)


CAMERA = "observation.images.cam"
EVERY = 3
"""Of how many rows one is looked at."""


def make_numbered(root: Path, lengths: tuple[int, ...], *, one_file: bool = False) -> Path:
    """A dataset whose pictures say their number, by their grey; up to 60 of them."""
    features = {
        "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
        CAMERA: {
            "dtype": "video", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"],
        },
    }  # fmt: skip
    dataset = LeRobotDataset.create(
        "somebody/numbered", 10, features, root=root, robot_type="so101",
        rgb_encoder=RGBEncoderConfig(vcodec="h264", preset="ultrafast"),
    )  # fmt: skip
    if not one_file:
        tiny: Any = 1e-6  # each episode has files of its own then
        dataset.meta.update_chunk_settings(None, tiny, tiny)
    number = 0
    for episode, length in enumerate(lengths):
        for _ in range(length):
            picture = np.full((SIZE, SIZE, 3), 4 * number, np.uint8)
            action = np.array([number, 0], np.float32)
            dataset.add_frame({"action": action, CAMERA: picture, "task": f"task {episode % 2}"})
            number += 1
        with keep_schedule():
            dataset.save_episode()
    dataset.finalize()
    return root


def read_numbers(root: Path) -> list[tuple[int, int]]:
    """The numbers of rows, and of their pictures as LeRobot shows them, of `make_numbered`."""
    dataset = LeRobotDataset("local/numbered", root=root)
    rows: list[Any] = [dataset[index] for index in range(0, len(dataset), EVERY)]
    return [(int(row["action"][0]), round(float(row[CAMERA].mean()) * 255 / 4)) for row in rows]
