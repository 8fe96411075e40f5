"""A connected page: its clock offset, and the messages sent to it."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from aiohttp import web

from xop_lerobot.operator.webxr.pairing import RateLimit
from xop_lerobot.operator.webxr.pictures import Picture
from xop_lerobot.operator.webxr.protocol import FrameMessage, Pong, write_ping

WINDOW_S = 10.0
"""Time after which answers are discarded, since the clocks drift apart [s]."""
MAX_OPEN = 32
"""Largest number of unanswered pings."""
SLEPT_S = 0.05
"""Contradiction between two answers above which the page's clock must have jumped [s]."""


class Answer(NamedTuple):
    """Result of one ping.

    Attributes:
        time: Arrival of the answer [s].
        offset: Page clock minus ours, assuming equal delays both ways [s].
        error: Uncertainty of the offset: half of the round-trip time [s].
    """

    time: float
    offset: float
    error: float


class ClockOffset:
    r"""Offset of a page's clock, by the fastest ping of the last 10 s.

    A ping sent at :math:`s`, answered at :math:`c` of the page's clock and received at :math:`r`
    gives the offset :math:`c - (s + r)/2 \pm (r - s)/2`.
    """

    def __init__(self) -> None:
        self._open: dict[int, float] = {}
        self._answers: deque[Answer] = deque()
        self._number = 0

    def ping(self, time: float) -> int:
        """Register a ping sent at `time` [s]; return its number."""
        self._number += 1
        self._open[self._number] = time
        while len(self._open) > MAX_OPEN:
            del self._open[next(iter(self._open))]
        return self._number

    def pong(self, number: int, page_time: float, time: float) -> bool:
        """Process an answer.

        Args:
            number: Number of the ping.
            page_time: Time of the answer on the page's clock [s].
            time: Arrival of the answer [s].

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
        """Most exact answer, None before the first."""
        return min(self._answers, key=lambda answer: answer.error, default=None)


logger = logging.getLogger(__name__)

SEND_S = 0.05
"""Period of sending the display [s]."""
PING_S = 0.5
"""Period of pings [s]."""
MAX_ON_THE_WAY = 2
"""Largest number of image sets in flight; each is followed by a ping whose answer confirms it."""
UNSENT = 16 * 1024
"""Size of the system's send buffer above which a client counts as slow [bytes]."""


class Client:
    """A connected page.

    Args:
        ws: Its WebSocket.
        request: Request that opened it.
        role: `operator` or `monitor`.
        clock: Clock of the server [s].
    """

    def __init__(
        self,
        ws: web.WebSocketResponse,
        request: web.Request,
        role: str,
        clock: Callable[[], float],
    ) -> None:
        self.ws, self.role, self._clock = ws, role, clock
        self.rate = RateLimit()
        self.active_at = clock()
        """Time of connecting, or of its last frame [s]."""
        self._offset = ClockOffset()
        self._transport = request.transport
        self._shown: list[str] = []
        self._picture: Picture | None = None
        self._on_the_way: list[int] = []  # pings that follow image sets in flight
        _limit_buffer(self._transport)

    def abort(self) -> None:
        """Close the connection without a message."""
        if self._transport is not None:
            self._transport.abort()

    def take_pong(self, pong: Pong) -> None:
        """Process the answer to a ping; unknown ones are ignored."""
        self._offset.pong(pong.number, pong.sent, self._clock())
        self._on_the_way = [number for number in self._on_the_way if number > pong.number]

    def measure_delay(self, message: FrameMessage, time: float) -> tuple[float, float] | None:
        """Measure the delay of a frame that arrives at `time` [s].

        Returns:
            Delay, negative for frames from the future, and its uncertainty [s]; None before the
            first answered ping.
        """
        best = self._offset.best
        return None if best is None else (time - (message.sent - best.offset), best.error)

    async def send_on(
        self,
        write_shown: Callable[[str], list[str]],
        take_picture: Callable[[], Picture | None],
    ) -> None:
        """Send the display, the latest images and pings until the connection ends."""
        next_ping = 0.0
        loop = asyncio.get_running_loop()
        while not self.ws.closed:
            try:
                if loop.time() >= next_ping:
                    next_ping = loop.time() + PING_S
                    await self._ping()
                await self._send_new(write_shown(self.role), take_picture())
            except ConnectionError:
                return
            except Exception:
                logger.exception("what is shown cannot be sent; the page will reconnect")
                self.abort()
                return
            await asyncio.sleep(SEND_S)

    async def _ping(self) -> int:
        time = self._clock()
        number = self._offset.ping(time)
        await self.ws.send_str(write_ping(number, time))
        return number

    async def _send_new(self, shown: list[str], picture: Picture | None) -> None:
        for text in shown:
            if text not in self._shown:
                await self.ws.send_str(text)
        self._shown = shown
        # A client with data still in flight gets no images: they would be old on arrival.
        if picture is None or picture is self._picture or not self._is_idle():
            return
        self._picture = picture
        for data in picture.messages:
            await self.ws.send_bytes(data)
        self._on_the_way.append(await self._ping())

    def _is_idle(self) -> bool:
        transport = self._transport
        if transport is None or len(self._on_the_way) >= MAX_ON_THE_WAY:
            return False
        return transport.get_write_buffer_size() == 0


def _limit_buffer(transport: asyncio.Transport | None) -> None:
    """Limit the system's send buffer, so that unsent data is visible here."""
    connection = None if transport is None else transport.get_extra_info("socket")
    option = getattr(socket, "TCP_NOTSENT_LOWAT", None)
    if connection is not None and option is not None:
        connection.setsockopt(socket.IPPROTO_TCP, option, UNSENT)
