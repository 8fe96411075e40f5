"""Control socket: lets other programs of the same user change settings at runtime."""

from __future__ import annotations

import logging
import os
import socket
import stat
import threading
import time
from pathlib import Path

from xop_lerobot.control.protocol import (
    MAX_LINE,
    Changeable,
    NotJson,
    answer,
    write_object,
)
from xop_lerobot.core.errors import XopError
from xop_lerobot.core.paced_log import PacedLog

logger = logging.getLogger(__name__)

_MAX_CLIENTS = 8
"""Largest number of clients; each has a thread."""
_MAX_RATE = 100.0
"""Accepted requests and connections per second, over all clients [Hz]."""
_BURST = 50
"""Number of requests accepted at once without a wait."""
_IDLE_S = 300.0  # a client silent for longer is disconnected [s]


class ControlFault(XopError):
    """The control socket cannot be opened."""


class ControlServer:
    """Serves a Unix domain socket that only its user may open.

    Only JSON is accepted, lines of at most `MAX_LINE` bytes; a client that sends anything else is
    disconnected. Each client has its own thread. Requests of all clients together are limited to
    `_MAX_RATE`, so that the robot's control loop keeps its share of the processor; faster clients
    wait for their answers.

    Args:
        path: Path of the socket.
        target: Receiver of the requests.

    Raises:
        ControlFault: If another session listens there, or the path cannot be used.
    """

    def __init__(self, path: Path, target: Changeable) -> None:
        self.path, self._target = path, target
        self._clients: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._running = True
        self._due = 0.0  # when the next request is due at an even rate [s]
        self._log = PacedLog(logger)
        self._socket = open_socket(path)
        self._inode = path.stat().st_ino
        self._thread = threading.Thread(target=self._accept, name="xop-control", daemon=True)
        self._thread.start()
        logger.info("Settings can be changed at %s (xop-control).", path)

    def close(self) -> None:
        """Disconnect all clients and remove the socket; may be called twice."""
        with self._lock:
            if not self._running:
                return
            self._running = False
            clients = list(self._clients)
        _shut(self._socket)
        for client in clients:
            _shut(client)
        self._thread.join(timeout=5)
        try:
            if self.path.stat().st_ino == self._inode:  # not the socket of a later session
                self.path.unlink()
        except FileNotFoundError:
            pass

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:
                return  # closed
            self._wait_turn()
            with self._lock:
                welcome = self._running and len(self._clients) < _MAX_CLIENTS
                if welcome:
                    self._clients.add(client)
            if not welcome:
                _send(client, {"ok": False, "error": f"more than {_MAX_CLIENTS} clients"})
                _shut(client)
                continue
            thread = threading.Thread(
                target=self._serve, args=(client,), name="xop-control-client", daemon=True
            )
            thread.start()

    def _serve(self, client: socket.socket) -> None:
        try:
            client.settimeout(_IDLE_S)
            with client.makefile("rb") as lines:
                while line := lines.readline(MAX_LINE + 1):
                    self._wait_turn()
                    if not self._reply(client, line):
                        return
        except OSError:
            pass  # disconnected, or silent for too long
        finally:
            with self._lock:
                self._clients.discard(client)
            _shut(client)

    def _wait_turn(self) -> None:
        """Wait until the rate limit admits one more request."""
        with self._lock:
            now = time.monotonic()
            self._due = max(self._due, now - _BURST / _MAX_RATE) + 1 / _MAX_RATE
            wait = self._due - now
        if wait > 0:
            time.sleep(wait)

    def _reply(self, client: socket.socket, line: bytes) -> bool:
        """Answer one line; return whether the client stays connected."""
        if len(line) > MAX_LINE:
            fault = f"a request may have {MAX_LINE} bytes"
            _send(client, {"ok": False, "error": fault})
            return False
        try:
            reply = answer(line, self._target)
        except NotJson as fault:
            _send(client, {"ok": False, "error": str(fault)})
            return False
        except Exception:  # a robot must not lose its socket to one bad request
            self._log.exception("a request of the control socket has failed")
            reply = {"ok": False, "error": "the request has failed; see the log of the session"}
        _send(client, reply)
        return True


def open_socket(path: Path) -> socket.socket:
    """Listen at `path`, accessible to this user only.

    Raises:
        ControlFault: If another process listens there, or it cannot be used.
    """
    try:
        _make_private(path.parent)
        _remove_stale(path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listener.bind(os.fspath(path))
            path.chmod(stat.S_IRUSR | stat.S_IWUSR)  # before anybody can connect
            listener.listen(_MAX_CLIENTS)
        except OSError:
            listener.close()
            raise
    except OSError as fault:
        raise ControlFault(f"control socket '{path}': {fault.strerror or fault}") from fault
    return listener


def _make_private(folder: Path) -> None:
    """Create the sockets' folder if missing, accessible to its user only."""
    try:
        folder.mkdir(parents=True, mode=0o700)
    except FileExistsError:
        found = folder.stat()
        shared = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not found.st_mode & stat.S_ISVTX
        if found.st_uid not in (os.getuid(), 0) or shared:
            raise ControlFault(
                f"control socket: others may change the directory '{folder}'. Choose another "
                "--teleop.control"
            ) from None


def _remove_stale(path: Path) -> None:
    """Remove the socket that a crashed session has left."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise ControlFault(f"control socket '{path}': there is a file of that name")
    except FileNotFoundError:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(os.fspath(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
    raise ControlFault(
        f"control socket '{path}': another session listens there. Give each its own "
        "--teleop.session or --teleop.control"
    )


def _send(client: socket.socket, reply: dict) -> None:
    try:
        client.sendall(write_object(reply))
    except OSError:
        pass  # disconnected


def _shut(connection: socket.socket) -> None:
    try:
        connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        pass
    connection.close()
