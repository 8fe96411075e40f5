"""Rate-limited logging, for events that a remote peer can cause at will."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

MAX_LINES = 10
"""Largest number of lines per period."""
PERIOD_S = 1.0
"""Period [s]."""


class PacedLog:
    """Passes on at most `MAX_LINES` lines in any second; thread-safe.

    Further lines are counted, and their number is logged before the next line that passes.

    Args:
        logger: Destination of the lines.
        clock: Time [s]; tests pass their own.
    """

    def __init__(self, logger: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._logger, self._clock = logger, clock
        self._times: deque[float] = deque(maxlen=MAX_LINES)
        self._left_out = 0
        self._lock = threading.Lock()

    def info(self, message: str, *args: object) -> None:
        """Log at level INFO."""
        self._log(logging.INFO, message, args)

    def warning(self, message: str, *args: object) -> None:
        """Log at level WARNING."""
        self._log(logging.WARNING, message, args)

    def exception(self, message: str, *args: object) -> None:
        """Log an error with the traceback of the exception that is being handled."""
        self._log(logging.ERROR, message, args, exc_info=True)

    def _log(
        self, level: int, message: str, args: tuple[object, ...], *, exc_info: bool = False
    ) -> None:
        with self._lock:
            now = self._clock()
            if len(self._times) == MAX_LINES and now - self._times[0] < PERIOD_S:
                self._left_out += 1
                return
            self._times.append(now)
            left_out, self._left_out = self._left_out, 0
        if left_out:
            self._logger.log(level, "%d lines were left out: too many in a second.", left_out)
        self._logger.log(level, message, *args, exc_info=exc_info, stacklevel=3)
