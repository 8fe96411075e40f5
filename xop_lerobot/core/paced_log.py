"""A log that others cannot fill: so many lines in a second, and then how many were left out."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

MAX_LINES = 10
"""Lines that pass in a second."""
PERIOD_S = 1.0


class PacedLog:
    """Passes on at most `MAX_LINES` lines in any second, for what somebody else can cause at will.

    What is too much is counted, and the next line that passes says how many there were. May be
    called from any thread.

    Args:
        logger: Where the lines go.
        clock: Time [s]; tests bring their own.
    """

    def __init__(self, logger: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._logger, self._clock = logger, clock
        self._times: deque[float] = deque(maxlen=MAX_LINES)
        self._left_out = 0
        self._lock = threading.Lock()

    def info(self, message: str, *args: object) -> None:
        """Log a line that tells."""
        self._log(logging.INFO, message, args)

    def warning(self, message: str, *args: object) -> None:
        """Log a line that warns."""
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
