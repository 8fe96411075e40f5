"""How many connections there may be, and how long one may say nothing."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

from aiohttp import web

MAX_CONNECTIONS = 64
FIRST_REQUEST_S = 10.0
"""A connection over which nothing is asked for so long is ended [s]."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Connections:
    """Lets connections in, and ends those that hold a place for nothing.

    Only those that are there, or may still arrive, are remembered: however many come and go, it
    is never more than `MAX_CONNECTIONS` of each.

    Args:
        arrival_s: How long a connection may take until it can be used, as for TLS [s].
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
        """End connections over which nothing is asked, until this is cancelled."""
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
        """Take note that something is asked over a connection."""
        self._asked.add(request.protocol)
        return await handler(request)


class _Refusal(asyncio.Protocol):
    """Closes a connection for which there is no room."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()
