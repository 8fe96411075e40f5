"""Whether the ports are free that we listen at, and open that we call."""

from __future__ import annotations

import socket

from xop_lerobot.doctor.finding import Finding, Level, Setup

TIMEOUT_S = 3.0


def check_ports(setup: Setup) -> Finding:
    """Listen at the port of the page, or knock at that of a Vision Pro."""
    # Where the protocols are not installed, this check fails alone.
    from xop_lerobot.operator.devices import avp_protocol  # noqa: PLC0415
    from xop_lerobot.operator.webxr import protocol as webxr_protocol  # noqa: PLC0415

    if setup.device == "avp":
        return _knock(setup.host, setup.port or avp_protocol.PORT)
    host = setup.host or "127.0.0.1"
    return _listen(host, setup.port or webxr_protocol.PORT)


def _listen(host: str, port: int) -> Finding:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            probe.listen(1)
    except OSError as error:
        return Finding(
            Level.FAIL,
            f"port {port} at {host} cannot be listened at: {error.strerror or error}",
            "end the other program (another session of ours?), or choose another port with "
            "--teleop.device.port; the address must be one of this machine's",
        )
    return Finding(Level.OK, f"port {port} at {host} is free for the page of a headset")


def _knock(host: str, port: int) -> Finding:
    if not host:
        return Finding(Level.FAIL, "no address of a Vision Pro", "give it: --host ADDRESS")
    try:
        with socket.create_connection((host, port), timeout=TIMEOUT_S):
            return Finding(Level.OK, f"{host} answers at port {port}")
    except OSError as error:
        return Finding(
            Level.FAIL,
            f"{host} does not answer at port {port}: {error.strerror or error}",
            "open Tracking Streamer in the headset and press Start; both must be in one network, "
            "without a firewall or client isolation of the access point between them",
        )
