"""A LeRobot v3 dataset, read as a stream; nothing is ever written into its directory."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.entries import (
    EpisodeEntry,
    VideoSpan,
    VideoUse,
    find_video_use,
    read_entries,
)
from xop_lerobot.curate.rows import RowReader
from xop_lerobot.recording.facts import CONFIG_FILE

__all__ = ["EpisodeEntry", "Source", "VideoSpan"]

INFO_FILE = Path("meta") / "info.json"
VERSION = "v3."
_CONVERT = "python -m lerobot.scripts.convert_dataset_v21_to_v30"
_NUMBERS = (int, float)


class Source:
    """A dataset that is read: its features, its episodes, and their rows.

    Memory does not grow with the dataset: of the metadata a few episodes are held at a time, of
    the rows one row group, which in LeRobot's files is one episode.

    Args:
        root: Directory of the dataset.

    Attributes:
        root: The same.
        info: Content of `meta/info.json`.
        features: Features by key: dtype, shape and names.
        fps: Frames a second [Hz].
        robot: LeRobot's robot type; None if it is not stated.

    Raises:
        BadDataset: If there is no LeRobot v3 dataset, or its `meta/info.json` is malformed.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self.info = _read_info(self.root)
        self.features: dict[str, dict[str, Any]] = self.info["features"]
        self.fps = self.info["fps"]
        self.robot: str | None = self.info.get("robot_type")
        self._rows = RowReader(self.root, self.features)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file that was read last."""
        self._rows.close()

    @property
    def total_episodes(self) -> int:
        """How many episodes the dataset says that it has."""
        return int(self.info.get("total_episodes") or 0)

    @property
    def episodes(self) -> Iterator[EpisodeEntry]:
        """The episodes in order.

        Raises:
            BadDataset: If the metadata is missing or malformed.
        """
        return self.iterate()

    def iterate(self, note: Callable[[str], None] | None = None) -> Iterator[EpisodeEntry]:
        """The episodes in order; `note` is told of files that cannot be read, instead of an error.

        Raises:
            BadDataset: If the metadata is missing or malformed.
        """
        return read_entries(self.root, self.info, note, self.video_use)

    @cached_property
    def video_use(self) -> VideoUse:
        """Which videos belong to episodes, and which pictures to more than one.

        Raises:
            BadDataset: If the pattern of the paths is malformed.
        """
        return find_video_use(self.root, self.info)

    def read(self, entry: EpisodeEntry, columns: Iterable[str]) -> dict[str, np.ndarray]:
        """Read columns of an episode, and nothing else.

        Args:
            entry: The episode.
            columns: Keys of features; pictures cannot be read so.

        Returns:
            An array for each column, with a row for each frame, of the file's dtype and always
            of two dimensions; it may be read-only. Shape (n, size).

        Raises:
            BadDataset: If the dataset has not these columns, or the file is malformed.
        """
        wanted = tuple(columns)
        self.check(wanted)
        return self._rows.read(entry, wanted)

    def read_table(self, entry: EpisodeEntry, columns: Sequence[str] = ()) -> pa.Table:
        """Read columns of an episode as they are in its file, all without `columns`.

        Pictures can be read so.

        Raises:
            BadDataset: If the file is malformed, or does not hold the whole episode.
        """
        return self._rows.read_table(entry, columns)

    def check_rows(self, entry: EpisodeEntry) -> None:
        """Check that the columns of an episode's file are as announced, without reading them.

        Raises:
            BadDataset: If the file is not readable, or one is not.
        """
        self._rows.check(entry)

    def check(self, columns: Iterable[str]) -> None:
        """Check that the dataset has these columns.

        Raises:
            BadDataset: If not, listing those that it has.
        """
        missing = [name for name in columns if name not in self.features]
        if missing:
            raise BadDataset(
                self.root,
                f"it has no column {', '.join(missing)}. Its columns: "
                f"{', '.join(sorted(self.features))}",
            )

    def read_config(self) -> dict[str, Any]:
        """Read `meta/xop/config.json`; empty where there is none or it is no JSON object."""
        try:
            config = json.loads((self.root / CONFIG_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return config if isinstance(config, dict) else {}


def _read_info(root: Path) -> dict[str, Any]:
    if not root.is_dir():
        raise BadDataset(root, "there is no such directory")
    path = root / INFO_FILE
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadDataset(root, f"it has no {INFO_FILE}, so it is no LeRobot dataset") from None
    except (OSError, ValueError) as error:
        raise BadDataset(root, f"{INFO_FILE} is not readable ({error})") from error
    if not isinstance(info, dict):
        raise BadDataset(root, f"{INFO_FILE} must hold a JSON object")
    version = str(info.get("codebase_version"))
    if not version.startswith(VERSION):
        raise BadDataset(
            root,
            f"it must be of LeRobot's version v3.0, it is of {version}. "
            f"`{_CONVERT}` converts from v2.1",
        )
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, _NUMBERS) or not 0 < fps < math.inf:
        raise BadDataset(root, f"{INFO_FILE} must give fps as a number above 0, got {fps!r}")
    for name in ("total_episodes", "total_frames"):
        count = info.get(name, 0)
        if isinstance(count, bool) or not isinstance(count, int) or count < 0:
            raise BadDataset(
                root, f"{INFO_FILE} must give {name} as a number of 0 or more, got {count!r}"
            )
    if not isinstance(info.get("data_path"), str):
        raise BadDataset(root, f"{INFO_FILE} must give data_path, the pattern of the data files")
    if not isinstance(info.get("robot_type", ""), str | None):
        raise BadDataset(root, f"{INFO_FILE} must give robot_type as text")
    _check_features(root, info.get("features"))
    return info


def _check_features(root: Path, features: object) -> None:
    if not isinstance(features, Mapping) or not features:
        raise BadDataset(root, f"{INFO_FILE} must give the features of each row")
    for key, feature in features.items():
        is_valid = isinstance(feature, Mapping) and isinstance(feature.get("dtype"), str)
        shape = feature.get("shape") if is_valid else None
        if not isinstance(shape, list) or not all(
            isinstance(size, int) and not isinstance(size, bool) and size > 0 for size in shape
        ):
            raise BadDataset(
                root, f"{INFO_FILE} must give dtype and shape of the feature '{key}', got {feature}"
            )
