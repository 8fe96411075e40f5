"""Episodes that survive a killed process.

LeRobot keeps its two parquet writers (frames, and episode metadata) open for a whole session and
writes their footers only in `finalize`, so SIGKILL loses every episode of the session. Here both
are closed after each save, and the dataset is put in the state of one that was just resumed: the
next episode opens new files. This takes private attributes of LeRobot (the patch `ROTATION`);
without them `XopDataset` finalizes and resumes instead, which uses public methods only and is
slower.

No video frame is lost: recording waits for the encoder in lock-step, and counts what it drops in
real time. LeRobot's streaming encoder drops a frame when its queue stays full for 0.1 s. The row
stays, so every later picture of the episode belongs to another moment. A simulation can wait.
Pictures that are written to files wait in a queue without an end, so a slow disk fills the memory:
beyond `MAX_IMAGES` of them either clock waits, and a real-time episode counts as late.

An episode is saved without LeRobot's pass over every row, where that pass has nothing to do: it
embeds image files into the table row by row, also when a dataset has no image column but
videos: 5 to 10 ms a frame with our columns, several seconds for an episode of half a minute.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from xop_lerobot.recording.lerobot_patches import EMBEDDING, IMAGES, fits, replaced

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset


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


@contextmanager
def skip_embedding(dataset: LeRobotDataset) -> Iterator[None]:
    """In the block, leave the table as it is if `dataset` has no image columns."""
    if dataset.meta.image_keys:
        yield
        return

    def keep(table: Any) -> Any:
        """Return `table`: there is nothing to embed."""
        return table

    with replaced(EMBEDDING, keep):
        yield


MAX_IMAGES = 256
"""Pictures that may wait for the disk."""
_POLL_S = 0.001


class VideoQueue:
    """The queues of a streaming encoder, None where frames go to image files.

    Args:
        encoder: LeRobot's `StreamingVideoEncoder`, or None.
        writer: LeRobot's `DatasetWriter`, whose `image_writer` there may be none of.
    """

    def __init__(self, encoder: Any, writer: Any = None) -> None:  # private types
        self._encoder, self._writer = encoder, writer
        self._bounds_images = fits(IMAGES)

    def wait(self) -> None:
        """Wait until every queue takes a frame; a dead encoder is left for LeRobot to report."""
        if self._encoder is None:
            return
        for key, queue in self._encoder._frame_queues.items():
            while queue.full() and self._encoder._threads[key].is_alive():
                time.sleep(_POLL_S)

    def wait_for_images(self) -> None:
        """Wait until the image files have caught up; workers that have died are left alone."""
        images = getattr(self._writer, "image_writer", None)
        if images is None or not self._bounds_images:
            return
        workers = (*images.threads, *images.processes)
        while _count(images.queue) >= MAX_IMAGES and any(worker.is_alive() for worker in workers):
            time.sleep(_POLL_S)

    @property
    def dropped(self) -> int:
        """Frames dropped in this episode, over all cameras."""
        if self._encoder is None:
            return 0
        return sum(self._encoder._dropped_frames.values())


def _count(queue: Any) -> int:  # of threads or of processes
    try:
        return queue.qsize()
    except NotImplementedError:  # macOS does not count what waits for another process
        return 0


@contextmanager
def keep_schedule() -> Iterator[None]:
    """Give the calling thread its scheduling policy back afterwards.

    SVT-AV1 asks for the highest real-time priority for the thread that opens it. For root, as in
    a container, that is granted, stays, and is inherited by every process that is started from
    then on: two that wait actively can take a small machine for themselves.
    """
    if not hasattr(os, "sched_getscheduler"):  # not Linux
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if (os.sched_getscheduler(0), os.sched_getparam(0)) != before:
            os.sched_setscheduler(0, *before)
