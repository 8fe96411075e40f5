"""No video frame is lost: wait for the encoder in lock-step, count what it drops in real time.

LeRobot's streaming encoder drops a frame when its queue stays full for 0.1 s. The row stays, so
every later picture of the episode belongs to another moment. A simulation can wait instead.
Pictures that are written to files wait in a queue without an end, so a slow disk fills the memory:
beyond `MAX_IMAGES` of them either clock waits, and a real-time episode counts as late.
"""

from __future__ import annotations

import logging
import time
from typing import Any

logger = logging.getLogger(__name__)

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
        names = ("_frame_queues", "_threads", "_dropped_frames")
        self._readable = encoder is None or all(hasattr(encoder, name) for name in names)
        if not self._readable:
            logger.warning(
                "LeRobot's video encoder has changed: frames that it drops can be neither "
                "prevented nor counted. Use --dataset.streaming_encoding=false."
            )

    def wait(self) -> None:
        """Wait until every queue takes a frame; a dead encoder is left for LeRobot to report."""
        if self._encoder is None or not self._readable:
            return
        for key, queue in self._encoder._frame_queues.items():
            while queue.full() and self._encoder._threads[key].is_alive():
                time.sleep(_POLL_S)

    def wait_for_images(self) -> None:
        """Wait until the image files have caught up; workers that have died are left alone."""
        images = getattr(self._writer, "image_writer", None)
        queue = getattr(images, "queue", None)
        if images is None or queue is None:
            return
        workers = (*images.threads, *images.processes)
        while _count(queue) >= MAX_IMAGES and any(worker.is_alive() for worker in workers):
            time.sleep(_POLL_S)

    @property
    def dropped(self) -> int:
        """Frames dropped in this episode, over all cameras."""
        if self._encoder is None or not self._readable:
            return 0
        return sum(self._encoder._dropped_frames.values())


def _count(queue: Any) -> int:  # of threads or of processes
    try:
        return queue.qsize()
    except NotImplementedError:  # macOS does not count what waits for another process
        return 0
