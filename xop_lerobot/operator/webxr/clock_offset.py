"""By how much the clock of a page is ahead of ours, from pings."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

WINDOW_S = 10.0
"""Older answers are forgotten: two clocks drift apart [s]."""
MAX_OPEN = 32
"""Pings that may wait for an answer."""
SLEPT_S = 0.05
"""A contradiction of two answers that is larger means that the page's clock has jumped [s]."""


class Answer(NamedTuple):
    """What one ping has told.

    Attributes:
        time: When its answer came [s].
        offset: The page's clock minus ours, if both ways took as long [s].
        error: How far that may be off: half of the time for there and back [s].
    """

    time: float
    offset: float
    error: float


class ClockOffset:
    r"""Offset of a page's clock: that of the fastest ping of the last 10 s.

    A ping sent at :math:`s` and answered at :math:`c` of the page's clock, whose answer comes at
    :math:`r`, says :math:`c - (s + r)/2 \pm (r - s)/2`.
    """

    def __init__(self) -> None:
        self._open: dict[int, float] = {}
        self._answers: deque[Answer] = deque()
        self._number = 0

    def ping(self, time: float) -> int:
        """Note a ping that is sent at `time` [s]; return its number."""
        self._number += 1
        self._open[self._number] = time
        while len(self._open) > MAX_OPEN:
            del self._open[next(iter(self._open))]
        return self._number

    def pong(self, number: int, page_time: float, time: float) -> bool:
        """Take an answer.

        Args:
            number: That of the ping.
            page_time: When it was answered, on the page's clock [s].
            time: When the answer came [s].

        Returns:
            Whether there was such a ping.
        """
        sent = self._open.pop(number, None)
        if sent is None:
            return False
        new = Answer(time, page_time - (sent + time) / 2, (time - sent) / 2)
        best = self.best
        if best is not None and abs(new.offset - best.offset) > new.error + best.error + SLEPT_S:
            self._answers.clear()
        self._answers.append(new)
        while self._answers[0].time < time - WINDOW_S:
            self._answers.popleft()
        return True

    @property
    def best(self) -> Answer | None:
        """The most exact answer, None before the first."""
        return min(self._answers, key=lambda answer: answer.error, default=None)
