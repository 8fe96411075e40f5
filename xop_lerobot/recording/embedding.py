"""Save an episode without LeRobot's pass over every row, where that pass has nothing to do.

LeRobot embeds image files into the table row by row, also when a dataset has no image column but
videos: 5 to 10 ms a frame with our columns, several seconds for an episode of half a minute.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from lerobot.datasets import LeRobotDataset, dataset_writer


@contextmanager
def skip_embedding(dataset: LeRobotDataset) -> Iterator[None]:
    """In the block, leave the table as it is if `dataset` has no image columns."""
    stock = getattr(dataset_writer, "embed_images", None)
    if stock is None or dataset.meta.image_keys:
        yield
        return

    def keep(table: Any) -> Any:
        """Return `table`: there is nothing to embed."""
        return table

    dataset_writer.embed_images = keep  # pyright: ignore[reportPrivateImportUsage]
    try:
        yield
    finally:
        dataset_writer.embed_images = stock  # pyright: ignore[reportPrivateImportUsage]
