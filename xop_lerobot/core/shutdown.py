"""Signal handling: SIGTERM stops cleanly like Ctrl-C, and neither interrupts saving an episode."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

logger = logging.getLogger(__name__)


class TermAsInterrupt:
    """While installed, the first SIGTERM raises KeyboardInterrupt and later ones are ignored.

    LeRobot closes its files on KeyboardInterrupt, but is killed by SIGTERM, which containers,
    service managers and time-outs send.
    """

    def __init__(self) -> None:
        self._installed = False

    def install(self) -> None:
        """Handle SIGTERM, unless the program does already. Main thread only."""
        if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
            signal.signal(signal.SIGTERM, self._interrupt)
            self._installed = True

    def remove(self) -> None:
        """Restore the default of SIGTERM; may be called twice, and from any thread."""
        in_main = threading.current_thread() is threading.main_thread()
        if self._installed and in_main:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            self._installed = False

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        del frame
        signal.signal(number, _ignore)
        logger.warning("SIGTERM: stopping; the episodes that are saved stay.")
        raise KeyboardInterrupt


def _ignore(number: int, frame: FrameType | None) -> None:
    del frame
    logger.warning("signal %d: already stopping", number)


@contextmanager
def stop_on_sigterm() -> Iterator[None]:
    """In the block, treat SIGTERM as Ctrl-C; see `TermAsInterrupt`."""
    terminator = TermAsInterrupt()
    terminator.install()
    try:
        yield
    finally:
        terminator.remove()


@contextmanager
def hold_signals() -> Iterator[None]:
    """Defer SIGINT and SIGTERM until the end of the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous: dict[int, Any] = {
        number: signal.signal(number, lambda got, _frame: held.append(got)) for number in numbers
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        for number in dict.fromkeys(held):
            signal.raise_signal(number)
