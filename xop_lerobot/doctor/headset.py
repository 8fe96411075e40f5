"""How well the stream of a headset comes in."""

from __future__ import annotations

import time

from xop_lerobot.doctor.finding import Finding, Level, Setup

GOOD_HZ, LEAST_HZ = 50.0, 25.0
SLOW_S = 0.1
"""Who drives with a delay of more than this feels it [s]."""


def check_headset(setup: Setup) -> Finding:
    """Connect, and count what comes; for a page, wait until somebody has opened it."""
    if not setup.device:
        return Finding(
            Level.SKIP, "no headset was named", "name it: --device avp --host ADDRESS, or webxr"
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
            "the robot would be let go again and again: come nearer to the access point, use "
            "5 GHz or a cable, and end other programs",
            figures,
        )
    if status.slow_hands:
        return Finding(
            Level.FAIL,
            f"{text}. {status.trouble}",
            "hold both hands before you, in good light, and end other apps of the headset: hands "
            "of which so few poses come engage nothing",
            figures,
        )
    if rate < GOOD_HZ or (status.delay or 0) > SLOW_S or min(shares) < 0.9:
        return Finding(
            Level.WARN,
            text,
            "hold both hands before you, in good light; a better network makes the delay shorter",
            figures,
        )
    return Finding(Level.OK, text, "", figures)
