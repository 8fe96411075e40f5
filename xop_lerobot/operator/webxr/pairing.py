"""Access control: pairing code, and limits on guesses, messages and connections."""

from __future__ import annotations

import asyncio
import functools
import hmac
import math
import secrets
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable

from aiohttp import web

from xop_lerobot.core.errors import BadValue

ALPHABET = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"
"""Letters and digits that cannot be confused."""
LENGTH = 8
MIN_LENGTH = 6
"""Shortest code that a user may choose [characters]."""
MAX_WRONG = 5
"""Number of wrong codes from one address before it is blocked."""
BLOCK_S = 60.0
"""Duration of the block [s]."""
MAX_ADDRESSES = 256
"""Number of remembered addresses; the oldest are forgotten."""
MAX_RATE = 400
"""Largest number of messages per second from one client."""


@functools.cache
def make_code() -> str:
    """Return this process's code of 40 random bits; every process has another."""
    return "".join(secrets.choice(ALPHABET) for _ in range(LENGTH))


def check_code(code: str) -> None:
    """Validate a code chosen by the user.

    Raises:
        BadValue: If it is too short, or cannot be part of a URL.
    """
    if len(code) < MIN_LENGTH or not (code.isascii() and code.isalnum()):
        raise BadValue(
            f"device.code must have at least {MIN_LENGTH} letters or digits, got {code!r}"
        )


class CodeCheck:
    """Checks codes, and blocks addresses that send too many wrong ones.

    Args:
        code: The right code.
    """

    def __init__(self, code: str) -> None:
        self._code = code.encode()
        self._wrong: OrderedDict[str, tuple[int, float]] = OrderedDict()  # count, time of the last

    def refuse(self, address: str, code: str, time: float) -> str | None:
        """Return why a client from `address` is refused at `time` [s], None if it is admitted."""
        count, last = self._wrong.get(address, (0, time))
        wait = last + BLOCK_S - time
        if wait <= 0:
            count = 0
        elif count >= MAX_WRONG:
            return f"blocked after too many wrong codes; try again in {math.ceil(wait)} s"
        if hmac.compare_digest(code.encode(errors="replace"), self._code):
            self._wrong.pop(address, None)
            return None
        self._wrong[address] = (count + 1, time)
        self._wrong.move_to_end(address)
        while len(self._wrong) > MAX_ADDRESSES:
            self._wrong.popitem(last=False)
        return "wrong code; open the address that the terminal shows now"


class RateLimit:
    """Detects clients that send more than `MAX_RATE` messages per second."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()

    def is_broken(self, time: float) -> bool:
        """Count a message at `time` [s]; return whether the limit is exceeded."""
        self._times.append(time)
        while self._times[0] <= time - 1.0:
            self._times.popleft()
        return len(self._times) > MAX_RATE


MAX_CONNECTIONS = 64
"""Largest number of open connections, and of those being set up."""
FIRST_REQUEST_S = 10.0
"""Time without a request after which a connection is closed [s]."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Connections:
    """Limits the number of connections, and closes idle ones.

    Only open connections, and those that may still complete, are remembered: never more than
    `MAX_CONNECTIONS` of each, however many come and go.

    Args:
        arrival_s: Time a connection may take until it is usable, as for TLS [s].
    """

    def __init__(self, arrival_s: float) -> None:
        self._arrival_s = arrival_s
        self._arrivals: deque[tuple[float, asyncio.Protocol]] = deque()
        self._silent: dict[asyncio.BaseProtocol, float] = {}
        self._asked: set[asyncio.BaseProtocol] = set()

    def let_in(self, server: web.Server | None) -> asyncio.Protocol:
        """Make the protocol of a new connection."""
        now = asyncio.get_running_loop().time()
        self._forget(now)
        if server is None:
            return _Refusal()
        there = set(server.connections)
        arriving = sum(handler not in there for _, handler in self._arrivals)
        if len(there) + arriving >= MAX_CONNECTIONS or len(self._arrivals) >= MAX_CONNECTIONS:
            return _Refusal()
        handler = server()
        self._arrivals.append((now, handler))
        return handler

    def _forget(self, now: float) -> None:
        while self._arrivals and self._arrivals[0][0] <= now - self._arrival_s:
            self._arrivals.popleft()

    async def watch(self, server: web.Server) -> None:
        """Close connections without a request, until cancelled."""
        while True:
            await asyncio.sleep(min(1.0, FIRST_REQUEST_S))
            now = asyncio.get_running_loop().time()
            self._forget(now)
            there = server.connections
            self._asked.intersection_update(there)
            silent = [handler for handler in there if handler not in self._asked]
            self._silent = {handler: self._silent.get(handler, now) for handler in silent}
            for handler in silent:
                late = now - self._silent[handler] >= FIRST_REQUEST_S
                if late and handler.transport is not None:
                    handler.transport.abort()

    @web.middleware
    async def note_request(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Middleware that marks a connection as used."""
        self._asked.add(request.protocol)
        return await handler(request)


class _Refusal(asyncio.Protocol):
    """Protocol that closes a connection beyond the limit."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()
