"""Statistics of episodes: reused where values are unchanged, else computed as LeRobot does."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import (
    DEFAULT_QUANTILES,
    auto_downsample_height_width,
    compute_episode_stats,
    get_feature_stats,
    sample_indices,
)
from PIL import Image

from xop_lerobot.curate.entries import EPISODES_DIR

_PREFIX = "stats/"
_BATCH = 32
"""Number of episodes whose statistics are in memory at a time."""
type Stats = dict[str, dict[str, np.ndarray]]


class StatsReader:
    """Reads episode statistics from a dataset's metadata, fastest in ascending order.

    Only a few episodes are in memory at a time. Reading an earlier episode restarts from the first
    file.

    Args:
        root: Directory of the dataset.
    """

    def __init__(self, root: Path) -> None:
        self._files = sorted((root / EPISODES_DIR).glob("*/*.parquet"))
        self._rows = self._iterate()
        self._ahead: dict[int, dict[str, Any]] = {}

    def read(self, episode: int) -> Stats:
        """Read the statistics of `episode`; empty if there are none."""
        for _ in range(2):
            for row in self._take(episode):
                return _parse(row)
            self._rows = self._iterate()  # the episode may precede the reading position
        return {}

    def _take(self, episode: int) -> Iterator[dict[str, Any]]:
        for index, row in self._rows:
            if index == episode:
                yield row
                return

    def _iterate(self) -> Iterator[tuple[int, dict[str, Any]]]:
        for path in self._files:
            try:
                with pq.ParquetFile(path) as file:
                    names = file.schema_arrow.names
                    wanted = [name for name in names if name.startswith(_PREFIX)]
                    wanted.append("episode_index")
                    for batch in file.iter_batches(_BATCH, columns=wanted, use_threads=False):
                        places = batch.column("episode_index").to_pylist()
                        for place, index in enumerate(places):
                            yield index, batch.slice(place, 1)
            except (pa.ArrowException, OSError, KeyError):
                continue


def _parse(row: Any) -> Stats:
    stats: Stats = {}
    for name in row.schema.names:
        value = row.column(name)[0].as_py()
        if not name.startswith(_PREFIX) or value is None:
            continue
        key, _, kind = name.removeprefix(_PREFIX).rpartition("/")
        stats.setdefault(key, {})[kind] = np.array(value)
    return stats


def compute_stats(columns: Mapping[str, np.ndarray], features: Mapping[str, Any]) -> Stats:
    """Compute the statistics of numeric columns, as LeRobot does when it records.

    Args:
        columns: Values by key. Shapes (n, size); size 1 may be (n,).
        features: Features of the dataset.
    """
    numbers: dict[str, Any] = {
        key: values.reshape(len(values)) if tuple(features[key]["shape"]) == (1,) else values
        for key, values in columns.items()
        if features[key]["dtype"] not in ("string", "language", "image", "video")
    }
    return compute_episode_stats(numbers, dict(features))


def compute_picture_stats(pictures: Iterator[np.ndarray]) -> dict[str, np.ndarray]:
    """Compute per-channel statistics of images, scaled to 0 to 1, as LeRobot does.

    Args:
        pictures: The images that `pick_pictures` chose. Shapes (height, width, 3), uint8.
    """
    stack = np.stack(
        [auto_downsample_height_width(picture.transpose(2, 0, 1)) for picture in pictures]
    )
    stats = get_feature_stats(stack, axis=(0, 2, 3), keepdims=True, quantile_list=DEFAULT_QUANTILES)
    return {
        kind: value if kind == "count" else np.squeeze(value / 255.0, axis=0)
        for kind, value in stats.items()
    }


def pick_pictures(length: int) -> list[int]:
    """Choose the frames of an episode of `length` that its image statistics use."""
    return sorted(set(sample_indices(length)))


def read_pictures(column: pa.ChunkedArray, numbers: list[int]) -> Iterator[np.ndarray]:
    """Decode images stored in the rows. Shapes (height, width, 3), uint8."""
    for number in numbers:
        data = column[number].as_py()["bytes"]
        yield np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
