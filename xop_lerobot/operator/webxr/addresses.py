"""Names and addresses of this machine, and the instructions to open the page."""

from __future__ import annotations

import io
import ipaddress
import socket

import psutil
import segno

LOOPBACKS = ("127.0.0.1", "::1")
ANY = ("0.0.0.0", "::")
"""Wildcard addresses: listening there is listening at every address."""
OUTSIDE = "192.0.2.1:9"
"""Address reserved for documentation, used only to look up the default route."""


def list_addresses() -> list[str]:
    """List this machine's network addresses, that of the default route first.

    Link-local and loopback addresses are left out.
    """
    found = set()
    for entries in psutil.net_if_addrs().values():
        for entry in entries:
            if entry.family in (socket.AF_INET, socket.AF_INET6):
                address = ipaddress.ip_address(entry.address.partition("%")[0])
                if not (address.is_loopback or address.is_link_local):
                    found.add(address)
    usual = find_own_address(OUTSIDE)
    ordered = sorted(found, key=lambda a: (str(a) != usual, a.version, int(a)))
    return [str(address) for address in ordered]


def list_names() -> list[str]:
    """Return names of this machine: its host name, its mDNS name, and localhost."""
    name = socket.gethostname().lower().partition(".")[0]
    own = [name, f"{name}.local"] if _is_name(name) else []
    return [*own, "localhost"]


def _is_name(name: str) -> bool:
    return name.isascii() and 0 < len(name) < 64 and name.replace("-", "").isalnum()


def is_loopback(host: str) -> bool:
    """Whether `host` is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def make_url(scheme: str, host: str, port: int, code: str = "") -> str:
    """Return the URL of a page."""
    shown = f"[{host}]" if ":" in host else host
    return f"{scheme}://{shown}:{port}/{f'?code={code}' if code else ''}"


def find_own_address(target: str) -> str:
    """Return the own IPv4 address on the route to `target` (host:port); nothing is sent."""
    host, _, port = target.rpartition(":")
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, int(port)))
            return str(probe.getsockname()[0])
    except OSError:
        return "0.0.0.0"  # the connection itself will fail with a better message


MARGIN = "  "


def list_hosts(host: str) -> list[str]:
    """List names and addresses at which a server listening at `host` is reached, best first."""
    if is_loopback(host):
        return ["localhost"]
    if host not in ANY:
        return [host]
    wanted = list_addresses()
    return [a for a in wanted if host == "::" or ":" not in a] or ["localhost"]


def draw_qr(text: str) -> str:
    """Draw a QR code in half-block characters for a terminal."""
    drawing = io.StringIO()
    segno.make(text, error="l", micro=False).terminal(out=drawing, compact=True, border=2)
    return drawing.getvalue()


def write_invitation(
    host: str, port: int, tls: bool, code: str, fingerprint: str = "", qr: bool = True
) -> str:
    """Write the instructions to open the page.

    Args:
        host: Address the server listens at.
        port: Its port.
        tls: Whether it uses TLS.
        code: The pairing code.
        fingerprint: Fingerprint of the certificate.
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
            "The browser warns once, since the certificate is self-signed. It is the\n"
            f"right one if its SHA-256 fingerprint is\n{MARGIN}{fingerprint}\n"
        )
    if local:
        text += (
            "A Quest or Pico on a cable opens the same address after\n"
            f"{MARGIN}adb reverse tcp:{port} tcp:{port}\n"
            "For headsets in the network, let it listen there: --teleop.device.host=0.0.0.0\n"
        )
    return text
