"""Durable episodes, no silently dropped video frames, and fast saves, on top of LeRobot's writers.

LeRobot keeps its two parquet writers (frames, and episode metadata) open for a whole session and
writes their footers only in `finalize`, so SIGKILL loses every episode of the session. Here both
are closed after each save, and the dataset is put into the state of a newly resumed one: the next
episode opens new files. This uses private attributes of LeRobot (the patch `ROTATION`); without
them `XopDataset` finalizes and resumes instead, which uses public methods only and is slower.

LeRobot's streaming encoder drops a frame when its queue stays full for 0.1 s. The row remains, so
every later image of the episode is shifted. In lock-step, recording therefore waits for the
encoder; in real time, dropped frames are counted. Image files are written through an unbounded
queue, so a slow disk would fill the memory: above `MAX_IMAGES` recording waits with either clock,
and a real-time episode then counts as late.

LeRobot embeds image files into the table row by row, even if a dataset has videos but no image
columns. That pass is skipped then: it takes 5 to 10 ms per frame with our columns, several seconds
for an episode of half a minute.
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
    """Close the Parquet files of `dataset`; the next episode opens new ones, and new videos."""
    writer, meta = dataset.writer, dataset.meta
    if writer is None or meta.latest_episode is None:
        return
    last = {key: value[0] for key, value in meta.latest_episode.items()}
    writer.close_writer()
    meta._close_writer()
    # The state of a resumed dataset: the last episode defines the next free file indices.
    writer._latest_episode = None
    meta.latest_episode = None
    meta.episodes = [last]  # pyright: ignore[reportAttributeAccessIssue]


def forget_rotation(dataset: LeRobotDataset) -> None:
    """Let a finalized dataset read its episodes from disk again."""
    dataset.meta.episodes = None


@contextmanager
def skip_embedding(dataset: LeRobotDataset) -> Iterator[None]:
    """Within the block, skip embedding images if `dataset` has no image columns."""
    if dataset.meta.image_keys:
        yield
        return

    def keep(table: Any) -> Any:
        """Return `table`: there is nothing to embed."""
        return table

    with replaced(EMBEDDING, keep):
        yield


MAX_IMAGES = 256
"""Largest number of images waiting for the disk."""
_POLL_S = 0.001
"""Interval of checking a full queue [s]."""


class VideoQueue:
    """Queues of the video encoder or of the image writer.

    Args:
        encoder: LeRobot's `StreamingVideoEncoder`, None if frames go to image files.
        writer: LeRobot's `DatasetWriter`, whose `image_writer` may be None.
    """

    def __init__(self, encoder: Any, writer: Any = None) -> None:  # private types
        self._encoder, self._writer = encoder, writer
        self._bounds_images = fits(IMAGES)

    def wait(self) -> None:
        """Wait until every queue has space; a dead encoder is left for LeRobot to report."""
        if self._encoder is None:
            return
        for key, queue in self._encoder._frame_queues.items():
            while queue.full() and self._encoder._threads[key].is_alive():
                time.sleep(_POLL_S)

    def wait_for_images(self) -> None:
        """Wait until fewer than `MAX_IMAGES` are queued; dead workers are left to LeRobot."""
        images = getattr(self._writer, "image_writer", None)
        if images is None or not self._bounds_images:
            return
        workers = (*images.threads, *images.processes)
        while _count(images.queue) >= MAX_IMAGES and any(worker.is_alive() for worker in workers):
            time.sleep(_POLL_S)

    @property
    def dropped(self) -> int:
        """Number of dropped frames in this episode, over all cameras."""
        if self._encoder is None:
            return 0
        return sum(self._encoder._dropped_frames.values())


def _count(queue: Any) -> int:  # of threads or of processes
    try:
        return queue.qsize()
    except NotImplementedError:  # multiprocessing queues have no size on macOS
        return 0


@contextmanager
def keep_schedule() -> Iterator[None]:
    """Restore the calling thread's scheduling policy afterwards.

    SVT-AV1 requests the highest real-time priority for the thread that opens it. For root, as in a
    container, this is granted, persists, and is inherited by every process started afterwards: two
    busy-waiting ones can then monopolise a small machine.
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
