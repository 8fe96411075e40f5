"""Episodes that survive a killed process.

LeRobot keeps its two parquet writers (frames, and episode metadata) open for a whole session and
writes their footers only in `finalize`, so SIGKILL loses every episode of the session. Here both
are closed after each save, and the dataset is put in the state of one that was just resumed: the
next episode opens new files. This reaches into four private attributes of LeRobot 0.6, so
`can_rotate` looks for them first; without them `XopDataset` finalizes and resumes instead, which
uses public methods only and is slower.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

_WRITER_NAMES = ("_pq_writer", "_latest_episode", "close_writer")
_META_NAMES = ("_pq_writer", "_close_writer", "latest_episode", "episodes")


def can_rotate(dataset: LeRobotDataset) -> bool:
    """Whether LeRobot still has the attributes that `rotate_writers` needs."""
    return all(hasattr(dataset.writer, name) for name in _WRITER_NAMES) and all(
        hasattr(dataset.meta, name) for name in _META_NAMES
    )


def rotate_writers(dataset: LeRobotDataset) -> None:
    """Close the parquet files of `dataset`; the next episode begins new ones, videos too."""
    writer, meta = dataset.writer, dataset.meta
    if writer is None or meta.latest_episode is None:
        return
    last = {key: value[0] for key, value in meta.latest_episode.items()}
    writer.close_writer()
    meta._close_writer()
    # What a resumed dataset knows: the last episode alone tells which file numbers are taken.
    writer._latest_episode = None
    meta.latest_episode = None
    meta.episodes = [last]  # pyright: ignore[reportAttributeAccessIssue]


def forget_rotation(dataset: LeRobotDataset) -> None:
    """Let a finalized dataset read its episodes from disk again."""
    dataset.meta.episodes = None
