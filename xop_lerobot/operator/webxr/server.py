"""Server for WebXR headsets: page, certificate and WebSocket on one port."""

from __future__ import annotations

import asyncio
import logging
import socket
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

from aiohttp import WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from xop_lerobot.core.paced_log import PacedLog
from xop_lerobot.operator.display import RecordingRequest
from xop_lerobot.operator.webxr.certificate import Certificate
from xop_lerobot.operator.webxr.client import Client
from xop_lerobot.operator.webxr.pairing import CodeCheck, Connections, Handler
from xop_lerobot.operator.webxr.pictures import Picture
from xop_lerobot.operator.webxr.protocol import (
    MAX_MESSAGE,
    Bye,
    FrameMessage,
    Pong,
    parse_message,
    write_refused,
    write_welcome,
)

logger = logging.getLogger(__name__)

PAGE = Path(__file__).parent / "page"
MAX_MONITORS = 4
IDLE_S = 5.0
"""Time without a frame after which an operator may be replaced by another [s]."""
HEARTBEAT_S = 3.0
"""Time without an answer after which clients are disconnected [s]."""
CLOSE_S = 2.0
"""Longest time to close a connection [s]."""
HANDSHAKE_S = 3.0
"""Longest time of a TLS handshake [s]."""
ARRIVAL_S = 0.5
"""Longest time of a connection without TLS to become usable [s]."""
DRIVES = "somebody drives already; wait until they have left, or open the page as a monitor"
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "xr-spatial-tracking=(self)",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_KINDS = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".png": "image/png",
}


class ServedDevice(Protocol):
    """Interface of the served device, a `WebXrDevice`; called on the server's thread."""

    def clock(self) -> float:
        """Time [s]."""
        ...

    @property
    def introduction(self) -> tuple[str, dict[str, str]]:
        """The robot's name, and the explanation of each gesture by its effect."""
        ...

    def take(self, message: FrameMessage, client: Client) -> None:
        """Process a frame of the operator."""
        ...

    def refuse(self, reason: str) -> None:
        """Count a message without a usable frame."""
        ...

    def request(self, request: RecordingRequest) -> None:
        """Receive a request of the operator to the recorder."""
        ...

    def leave(self, reason: str) -> None:
        """Note that the operator has left."""
        ...

    def write_shown(self, role: str) -> list[str]:
        """Return the messages with the present display."""
        ...

    def take_picture(self) -> Picture | None:
        """Return the latest images."""
        ...


class HeadsetServer:
    """Serves one operator and a few monitors.

    Args:
        device: The served device.
        code: The pairing code.
        certificate: Certificate of this machine, None without TLS.
    """

    def __init__(
        self,
        device: ServedDevice,
        code: str,
        certificate: Certificate | None = None,
    ) -> None:
        self._device, self._codes = device, CodeCheck(code)
        self._certificate = certificate
        self._operator: Client | None = None
        self._clients: set[Client] = set()
        self._farewells: set[asyncio.Task[None]] = set()
        self._connections = Connections(HANDSHAKE_S if certificate else ARRIVAL_S)
        self._port: asyncio.Server | None = None
        self._log = PacedLog(logger)

    async def run(self, listener: socket.socket, stop: asyncio.Event) -> None:
        """Serve at `listener` until `stop` is set, then close it."""
        app = web.Application(
            client_max_size=1, middlewares=[self._connections.note_request, _add_headers]
        )
        app.router.add_get("/", self._send_page)
        app.router.add_get("/cert", self._send_certificate)
        app.router.add_get("/ws", self._serve_socket)
        app.router.add_get("/{name}", self._send_page)
        runner = web.AppRunner(
            app,
            access_log=None,
            logger=_make_logger(),
            handle_signals=False,
            keepalive_timeout=10.0,
            shutdown_timeout=CLOSE_S,
        )
        await runner.setup()
        watch: asyncio.Task[None] | None = None
        try:
            tls = None if self._certificate is None else self._certificate.make_context()
            self._port = await asyncio.get_running_loop().create_server(
                lambda: self._connections.let_in(runner.server),
                sock=listener,
                ssl=tls,
                ssl_handshake_timeout=HANDSHAKE_S if tls else None,
            )
            if runner.server is not None:
                watch = asyncio.create_task(self._connections.watch(runner.server))
            await stop.wait()
        finally:
            if self._port is not None:
                self._port.close()
            if watch is not None:
                watch.cancel()
            farewells = [self._dismiss(each, "the session has ended") for each in self._clients]
            await asyncio.gather(*farewells)
            await runner.cleanup()

    async def _send_page(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info.get("name", "index.html")
        path = PAGE / name
        # Only files directly in the folder: no path can lead out of it.
        if path.parent != PAGE or path.suffix not in _KINDS or not path.is_file():
            raise web.HTTPNotFound
        return web.Response(body=path.read_bytes(), content_type=_KINDS[path.suffix])

    async def _send_certificate(self, request: web.Request) -> web.StreamResponse:
        del request
        if self._certificate is None:
            raise web.HTTPNotFound(text="There is no certificate: this page is served without TLS.")
        return web.Response(
            body=self._certificate.path.read_bytes(),
            content_type="application/x-x509-ca-cert",
            headers={"Content-Disposition": 'attachment; filename="xop-lerobot.crt"'},
        )

    async def _serve_socket(self, request: web.Request) -> web.StreamResponse:
        if not _is_own_page(request):
            raise web.HTTPForbidden(text="Only this server's own page may come in.")
        role = request.query.get("role", "operator")
        address = request.remote or "?"
        ws = web.WebSocketResponse(
            max_msg_size=2 * MAX_MESSAGE, compress=False, heartbeat=HEARTBEAT_S, timeout=CLOSE_S
        )
        try:
            await ws.prepare(request)
        except ValueError:  # malformed headers
            raise web.HTTPBadRequest from None
        client = Client(ws, request, role, self._device.clock)
        reason = self._codes.refuse(address, request.query.get("code", ""), self._device.clock())
        if reason is not None:
            self._log.warning("WebXR: %s was refused: %s.", address, reason)
        else:
            reason = await self._find_no_room(client)
        if reason is not None:
            await self._dismiss(client, reason)
            return ws
        self._clients.add(client)
        self._log.info(
            "WebXR: %s has come in from %s.",
            "the operator" if role == "operator" else "a monitor",
            address,
        )
        sender = asyncio.create_task(
            client.send_on(self._device.write_shown, self._device.take_picture)
        )
        try:
            await ws.send_str(write_welcome(role, *self._device.introduction))
            await self._listen(client)
        except (ConnectionError, asyncio.CancelledError):
            pass
        finally:
            sender.cancel()
            self._clients.discard(client)
            self._forget(client, "the page has closed the connection")
        return ws

    async def _find_no_room(self, client: Client) -> str | None:
        """Return why `client` is refused, None if it is admitted."""
        if client.role == "monitor":
            monitors = sum(other.role == "monitor" for other in self._clients)
            return (
                f"too many monitors; {MAX_MONITORS} may watch" if monitors >= MAX_MONITORS else None
            )
        if client.role != "operator":
            return "role must be operator or monitor"
        other = self._operator
        if other is not None and self._device.clock() - other.active_at <= IDLE_S:
            return DRIVES
        if other is not None:
            self._forget(other, "somebody has taken over")
            farewell = asyncio.create_task(self._dismiss(other, "somebody has taken over"))
            self._farewells.add(farewell)
            farewell.add_done_callback(self._farewells.discard)
        self._operator = client
        return None

    async def _listen(self, client: Client) -> None:
        """Process the messages of `client` until it leaves or breaks a rule."""
        async for message in client.ws:
            if message.type is not WSMsgType.TEXT:
                reason: str | None = "only text messages are accepted"
            else:
                reason = self._take(client, message.data)
            if reason is not None:
                self._forget(client, f"the page was disconnected: {reason}")
                await self._dismiss(client, reason)
                return

    def _take(self, client: Client, text: str) -> str | None:
        """Process one message; return the reason to disconnect, None to continue."""
        if client.rate.is_broken(asyncio.get_running_loop().time()):
            return "too many messages"
        if len(text.encode()) > MAX_MESSAGE:
            self._device.refuse("too_long")
            return f"a message may have {MAX_MESSAGE} bytes"
        message = parse_message(text)
        if isinstance(message, Pong):
            client.take_pong(message)
            return None
        if isinstance(message, RecordingRequest):  # monitors may also make requests
            self._device.request(message)
        elif client is not self._operator:
            return "monitors look on"
        elif isinstance(message, str):
            self._device.refuse(message)
        elif isinstance(message, FrameMessage):
            client.active_at = self._device.clock()
            self._device.take(message, client)
        elif isinstance(message, Bye):
            self._device.leave(message.reason or "the session in the headset has ended")
        return None

    async def _dismiss(self, client: Client, reason: str) -> None:
        """Tell a client the reason, and close its connection."""
        self._forget(client, reason)
        try:
            async with asyncio.timeout(CLOSE_S):
                await client.ws.send_str(write_refused(reason))
                await client.ws.close(code=1008, message=reason.encode()[:120])
        except (TimeoutError, ConnectionError):
            client.abort()

    def _forget(self, client: Client, reason: str) -> None:
        if client is self._operator:
            self._operator = None
            self._device.leave(reason)


def _make_logger() -> logging.Logger:
    """Return a logger that ignores malformed HTTP requests."""
    own = logging.getLogger(f"{__name__}.http")
    own.addFilter(_is_our_fault)
    return own


def _is_our_fault(record: logging.LogRecord) -> bool:
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))


def _is_own_page(request: web.Request) -> bool:
    """Whether the connection was not opened by a page of another origin."""
    origin = request.headers.get("Origin")
    return origin is None or urlsplit(origin).netloc == request.host


@web.middleware
async def _add_headers(request: web.Request, handler: Handler) -> web.StreamResponse:
    try:
        response = await handler(request)
    except web.HTTPException as error:
        error.headers.update(HEADERS)
        raise
    if not response.prepared:
        response.headers.update(HEADERS)
    return response
