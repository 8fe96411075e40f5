"""Free ports for servers of tests, several of which run at once."""

from __future__ import annotations

import os
import random
import socket

PORTS = range(20_000, 32_000)
"""Below those that systems give to outgoing connections, of which tests open thousands."""
WORKERS = 16

_given: set[int] = set()


def find_port() -> int:
    """Return a port that nobody listens at, and that no other worker of pytest will choose."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    mine = [port for port in PORTS[int(worker) % WORKERS :: WORKERS] if port not in _given]
    for port in random.SystemRandom().sample(mine, len(mine)):
        if _is_free(port):
            _given.add(port)
            return port
    raise OSError(f"no port is free in {PORTS}")


def _is_free(port: int) -> bool:
    try:
        with socket.create_server(("127.0.0.1", port)):
            return True
    except OSError:
        return False
