"""What the terminal tells who wants to come in with a headset."""

from __future__ import annotations

import io

import segno

from xop_lerobot.operator.webxr.addresses import ANY, is_loopback, list_addresses, make_url

MARGIN = "  "


def list_hosts(host: str) -> list[str]:
    """Names and addresses under which a server that listens at `host` is reached, best first."""
    if is_loopback(host):
        return ["localhost"]
    if host not in ANY:
        return [host]
    wanted = list_addresses()
    return [a for a in wanted if host == "::" or ":" not in a] or ["localhost"]


def draw_qr(text: str) -> str:
    """Draw a QR code in half blocks, as terminals show them."""
    drawing = io.StringIO()
    segno.make(text, error="l", micro=False).terminal(out=drawing, compact=True, border=2)
    return drawing.getvalue()


def write_invitation(
    host: str, port: int, tls: bool, code: str, fingerprint: str = "", qr: bool = True
) -> str:
    """Write what to open where.

    Args:
        host: Where the server listens.
        port: Its port.
        tls: Whether it speaks TLS.
        code: The pairing code.
        fingerprint: That of the certificate.
        qr: Whether to draw the first address as a QR code.
    """
    scheme = "https" if tls else "http"
    urls = [make_url(scheme, each, port, code) for each in list_hosts(host)]
    local = is_loopback(host)
    lines = ["Open this in a browser of this machine:" if local else "Open this in the headset:"]
    lines += [f"{MARGIN}{url}" for url in urls]
    text = "\n".join(lines) + "\n"
    if qr and not local:
        text += draw_qr(urls[0])
    if tls:
        text += (
            "The browser warns once, as this machine has made its certificate itself. It is the\n"
            f"right one if its SHA-256 fingerprint is\n{MARGIN}{fingerprint}\n"
        )
    if local:
        text += (
            "A Quest or Pico on a cable opens the same address after\n"
            f"{MARGIN}adb reverse tcp:{port} tcp:{port}\n"
            "For headsets in the network, let it listen there: --teleop.device.host=0.0.0.0\n"
        )
    return text
