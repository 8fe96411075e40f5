"""Helpers for lock-step recording: episode length in frames, no warnings of slow steps."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from xop_lerobot.recording.lerobot_patches import SLOW_TICK_LOGGERS, SLOW_TICK_TEXT


@contextmanager
def without_slow_step_warnings() -> Iterator[None]:
    """Suppress LeRobot's warnings of slow steps: in lock-step they do not affect the data."""

    def is_other(record: logging.LogRecord) -> bool:
        return SLOW_TICK_TEXT not in str(record.msg)

    warners = [logging.getLogger(name) for name in SLOW_TICK_LOGGERS]
    for warner in warners:
        warner.addFilter(is_other)
    try:
        yield
    finally:
        for warner in warners:
            warner.removeFilter(is_other)


def count_ticks(duration: float, fps: int) -> int:
    """Number of frames of an episode of `duration` [s] at `fps` [Hz], at least one."""
    return max(1, round(duration * fps))
