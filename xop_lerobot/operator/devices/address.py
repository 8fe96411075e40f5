"""Our own address on the way to somebody else."""

from __future__ import annotations

import socket


def find_own_address(target: str) -> str:
    """Our own IPv4 address on the way to `target` (host:port); nothing is sent."""
    host, _, port = target.rpartition(":")
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, int(port)))
            return str(probe.getsockname()[0])
    except OSError:
        return "0.0.0.0"  # the connection will fail too, and say why
