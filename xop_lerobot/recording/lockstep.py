"""An episode in lock-step has a number of frames, and no tick of it is late."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

_SLOWNESS = "loop is running slower"
"""Of LeRobot's warning of a slow tick: of the "Record loop", later of the "Control loop"."""
_WARNERS = (None, "lerobot.rollout.strategies.episodic", "lerobot.utils.cycle_timer")
"""Loggers that may give it, by LeRobot's version and command; None is the root."""


@contextmanager
def without_slowness() -> Iterator[None]:
    """Leave out LeRobot's warning of every slow tick: in lock-step none is wrong, only later."""

    def is_other(record: logging.LogRecord) -> bool:
        return _SLOWNESS not in str(record.msg)

    warners = [logging.getLogger(name) for name in _WARNERS]
    for warner in warners:
        warner.addFilter(is_other)
    try:
        yield
    finally:
        for warner in warners:
            warner.removeFilter(is_other)


def count_ticks(duration: float, fps: int) -> int:
    """Count the frames of an episode of `duration` [s] at `fps` [Hz], at least one."""
    return max(1, round(duration * fps))
