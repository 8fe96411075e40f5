"""How many connections there may be, and how long one may say nothing."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from aiohttp import web

MAX_CONNECTIONS = 64
FIRST_REQUEST_S = 10.0
"""A connection over which nothing is asked for so long is ended [s]."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Connections:
    """Lets connections in, and ends those that hold a place for nothing.

    Args:
        arrival_s: How long a connection may take until it can be used, as for TLS [s].
    """

    def __init__(self, arrival_s: float) -> None:
        self._arrival_s = arrival_s
        self._silent: dict[asyncio.Protocol, asyncio.TimerHandle] = {}

    def let_in(self, server: web.Server | None) -> asyncio.Protocol:
        """Make the protocol of a new connection."""
        if server is None or self._count(server) >= MAX_CONNECTIONS:
            return _Refusal()
        handler = server()
        loop = asyncio.get_running_loop()
        self._silent[handler] = loop.call_later(FIRST_REQUEST_S, self._end, handler)
        return handler

    def _count(self, server: web.Server) -> int:
        """Connections that are there, and those that arrive."""
        there = set(server.connections)
        begun = asyncio.get_running_loop().time() + FIRST_REQUEST_S - self._arrival_s
        arriving = (
            timer.when() >= begun for each, timer in self._silent.items() if each not in there
        )
        return len(there) + sum(arriving)

    def _end(self, handler: web.RequestHandler) -> None:
        del self._silent[handler]
        if handler.transport is not None:
            handler.transport.abort()

    @web.middleware
    async def note_request(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Take note that something is asked over a connection."""
        timer = self._silent.pop(request.protocol, None)
        if timer is not None:
            timer.cancel()
        return await handler(request)


class _Refusal(asyncio.Protocol):
    """Closes a connection for which there is no room."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()
