"""Checks of `xop-doctor` on the headset: certificate, ports, and stream quality."""

from __future__ import annotations

import datetime
import socket
import time

from xop_lerobot.doctor.finding import Finding, Level, Setup


def check_certificate(setup: Setup) -> Finding:
    """Check the TLS certificate without changing it."""
    if setup.device == "avp":
        return Finding(Level.SKIP, "a Vision Pro with Tracking Streamer needs none")
    if setup.host in ("", "127.0.0.1", "localhost", "::1"):
        return Finding(Level.SKIP, "on loopback the page needs none")
    from xop_lerobot.operator.webxr.certificate import (  # noqa: PLC0415  brings cryptography
        find_folder,
        inspect_certificate,
        list_own_names,
    )

    folder, now = find_folder(), datetime.datetime.now(datetime.UTC)
    found, fault = inspect_certificate(folder, list_own_names(), now)
    if found is not None:
        days = (found.end - now).days
        return Finding(
            Level.OK,
            f"the certificate in {folder} is valid for {days} days and all addresses of this "
            "machine; only its user can read the key",
            "",
            {"days": days, "fingerprint": found.fingerprint},
        )
    exists = (folder / "webxr.crt").exists()
    return Finding(
        Level.WARN if exists else Level.OK,
        f"the certificate in {folder}: {fault}; the next session makes one",
        "headsets will ask again whether to trust it" if exists else "",
    )


TIMEOUT_S = 3.0
"""Time to wait for a connection to the headset [s]."""


def check_ports(setup: Setup) -> Finding:
    """Open the page's port on this machine, or connect to that of a Vision Pro."""
    # Imported here: if the protocols' packages are missing, only this check fails.
    from xop_lerobot.operator.devices import avp as avp_protocol  # noqa: PLC0415
    from xop_lerobot.operator.webxr import protocol as webxr_protocol  # noqa: PLC0415

    if setup.device == "avp":
        return _check_connection(setup.host, setup.port or avp_protocol.PORT)
    host = setup.host or "127.0.0.1"
    return _check_free_port(host, setup.port or webxr_protocol.PORT)


def _check_free_port(host: str, port: int) -> Finding:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            probe.listen(1)
    except OSError as error:
        return Finding(
            Level.FAIL,
            f"port {port} at {host} cannot be opened: {error.strerror or error}",
            "end the other program (another session?), or choose another port with "
            "--teleop.device.port; the address must be one of this machine's",
        )
    return Finding(Level.OK, f"port {port} at {host} is free for the page of a headset")


def _check_connection(host: str, port: int) -> Finding:
    if not host:
        return Finding(Level.FAIL, "no address of a Vision Pro", "pass --host ADDRESS")
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


GOOD_HZ, LEAST_HZ = 50.0, 25.0
"""Stream rates below which the check warns, and fails [Hz]."""
SLOW_S = 0.1
"""Delay above which an operator notices it [s]."""


def check_headset(setup: Setup) -> Finding:
    """Connect and measure the stream; for a page, wait until it is opened."""
    if not setup.device:
        return Finding(
            Level.SKIP, "no headset was named", "pass --device avp --host ADDRESS, or webxr"
        )
    from xop_lerobot.operator.devices import DeviceConfig, make_device  # noqa: PLC0415
    from xop_lerobot.operator.devices.live import LiveDevice  # noqa: PLC0415

    config = DeviceConfig(type=setup.device, host=setup.host or None, port=setup.port)
    device = make_device(config)
    assert isinstance(device, LiveDevice)
    device.connect()
    try:
        end = time.monotonic() + setup.wait
        while device.read(0.0) is None and time.monotonic() < end:
            time.sleep(0.05)
        if device.read(0.0) is None:
            return Finding(
                Level.FAIL,
                f"{device.address}: no pose has come within {setup.wait:g} s"
                + (f" ({device.trouble})" if device.trouble else ""),
                "update xop-lerobot, or use a version of the app that this one speaks to"
                if "empty" in device.status.counts
                else "put the headset on, and open its app or the page's address",
                {"counts": device.status.counts},
            )
        return _measure(device, setup.seconds)
    finally:
        device.disconnect()


def _measure(device, seconds: float) -> Finding:  # noqa: ANN001  a LiveDevice, which is not loaded
    before = device.status.counts
    seen, ticks, ages = [0, 0, 0], 0, []
    begin = time.monotonic()
    while time.monotonic() < begin + seconds:
        frame = device.read(0.0)
        seen = [n + int(flag) for n, flag in zip(seen, frame.tracked, strict=True)]
        ages.append(device.status.age)
        ticks += 1
        time.sleep(0.02)
    status = device.status
    counts = {name: n - before.get(name, 0) for name, n in status.counts.items()}
    rate = counts.get("taken", 0) / (time.monotonic() - begin)
    shares = [round(n / ticks, 3) for n in seen]
    delay = None if status.delay is None else round(status.delay * 1e3, 1)
    gap = max(ages)
    figures = {
        "rate_hz": round(rate, 1),
        "delay_ms": delay,
        "longest_gap_ms": round(gap * 1e3, 1),
        "seen": dict(zip(("head", "left", "right"), shares, strict=True)),
        "hand_rates_hz": dict(zip(("left", "right"), status.hand_rates, strict=True)),
        "counts": {name: n for name, n in counts.items() if n},
    }
    late = "unknown" if delay is None else f"{delay:.0f} ms"
    text = (
        f"{device.address}: {rate:.0f} poses a second, delay {late}, longest gap "
        f"{gap * 1e3:.0f} ms; head, left and right hand seen for "
        f"{', '.join(f'{share:.0%}' for share in shares)} of the time"
    )
    if rate < LEAST_HZ or gap > device.config.stale_s:
        return Finding(
            Level.FAIL,
            text,
            "the robot would be disengaged repeatedly: come nearer to the access point, use "
            "5 GHz or a cable, and close other programs",
            figures,
        )
    if status.slow_hands:
        return Finding(
            Level.FAIL,
            f"{text}. {status.trouble}",
            "hold both hands in front of you, in good light, and close other apps of the headset: "
            "hands with so few poses cannot engage",
            figures,
        )
    if rate < GOOD_HZ or (status.delay or 0) > SLOW_S or min(shares) < 0.9:
        return Finding(
            Level.WARN,
            text,
            "hold both hands in front of you, in good light; a better network shortens the delay",
            figures,
        )
    return Finding(Level.OK, text, "", figures)
