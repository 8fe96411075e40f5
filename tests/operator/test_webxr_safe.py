"""Who may come in, how much they may send, and the certificate."""

from __future__ import annotations

import contextlib
import datetime
import http.client
import shutil
import socket
import ssl
import stat
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import headset
import numpy as np
import pytest
from avp_server import wait_for
from browser import launch
from cryptography import x509
from ports import find_port
from swaying import make_person
from websockets.exceptions import ConnectionClosed, InvalidStatus
from webxr_client import CODE, Page, encode

from tests.operator.test_webxr import send
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.operator.devices.webxr import WebXrDevice
from xop_lerobot.operator.webxr import addresses, pairing, server
from xop_lerobot.operator.webxr.addresses import draw_qr, write_invitation
from xop_lerobot.operator.webxr.certificate import (
    RENEW,
    VALID,
    CertificateFault,
    get_certificate,
    list_own_names,
)
from xop_lerobot.operator.webxr.pairing import ALPHABET, CodeCheck, RateLimit, make_code

NOW = datetime.datetime(2026, 5, 1, tzinfo=datetime.UTC)
NAMES = frozenset({"desk", "desk.local", "localhost", "127.0.0.1", "::1", "192.168.1.5"})


@pytest.fixture
def device() -> Iterator[WebXrDevice]:
    made = make_device(DeviceConfig(type="webxr", port=find_port(), code=CODE))
    assert isinstance(made, WebXrDevice)
    made.connect()
    yield made
    made.disconnect()


def find_refusal(page: Page) -> str:
    reason = page.wait_for("refused")["reason"]
    code, _ = page.wait_until_closed()
    assert code == 1008
    return reason


# -- who may come in -----------------------------------------------------------------------


def test_codes():
    code = make_code()
    assert len(code) == 8 and set(code) <= set(ALPHABET)
    assert code == make_code()  # the same for the whole process
    door = CodeCheck("RIGHT234")
    for i in range(5):
        assert str(door.refuse("a", "WRONG", float(i))).startswith("wrong code;")
    assert door.refuse("a", "RIGHT234", 5.0) == (
        "blocked after too many wrong codes; try again in 59 s"
    )
    assert door.refuse("b", "RIGHT234", 5.0) is None
    assert str(door.refuse("a", "RIGHT234", 63.0)).endswith("in 1 s")
    assert door.refuse("a", "RIGHT234", 64.0) is None
    for i in range(4):
        assert door.refuse("a", "", 70.0 + i) is not None
    assert door.refuse("a", "RIGHT234", 74.0) is None  # which forgives the others
    for i in range(1000):
        door.refuse(f"address {i}", "Ü\ud800", 80.0)
    assert len(door._wrong) == pairing.MAX_ADDRESSES


def test_wrong_codes_block_the_address(device):
    for _ in range(5):
        reason = find_refusal(Page(device, code="WRONG234"))
        assert reason == "wrong code; open the address that the terminal shows now"
    assert find_refusal(Page(device)).startswith("blocked after too many wrong codes; try again")
    assert device.status.counts == {}


def test_a_second_operator_is_refused_and_the_first_goes_on(device, monkeypatch):
    first = Page(device)
    first.wait_for("ping")
    send(first, device, make_person(0.0), 1)
    assert find_refusal(Page(device)) == server.DRIVES
    send(first, device, make_person(0.01), 2)
    assert device.status.counts == {"taken": 2}

    monkeypatch.setattr(server, "IDLE_S", 0.0)  # the first has long done nothing
    device.read(0.0)
    second = Page(device)
    second.wait_for("ping")
    assert find_refusal(first) == "somebody has taken over"
    send(second, device, make_person(0.02), 3)
    assert not device.read(0.0).tracked.any()  # it may be somebody else
    assert device.read(0.0).tracked.all()
    second.close()


def test_monitors_look_on(device):
    monitors = [Page(device, "monitor") for _ in range(4)]
    for monitor in monitors:
        monitor.wait_for("welcome")
    assert find_refusal(Page(device, "monitor")) == "too many monitors; 4 may watch"
    assert find_refusal(Page(device, "pilot")) == "role must be operator or monitor"
    monitors[0].send(encode(make_person(0.0), 1, monitors[0].clock()))
    assert find_refusal(monitors[0]) == "monitors look on"
    assert device.read(0.0) is None
    again = Page(device, "monitor")  # there is room for one again
    again.wait_for("welcome")
    for page in [*monitors[1:], again]:
        page.close()


def test_pages_of_others_are_kept_out(device):
    with pytest.raises(InvalidStatus, match="403"):
        Page(device, origin="https://elsewhere.example")
    own = Page(device, origin=f"http://localhost:{device.port}")
    own.wait_for("welcome")
    own.close()


# -- how much they may send ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ("x" * 8193, "a message may have 8192 bytes"),
        ("ü" * 5000, "a message may have 8192 bytes"),
        (b"\x00\x01", "only text messages are accepted"),
    ],
)
def test_what_may_not_be_sent_ends_the_connection(device, message, reason):
    page = Page(device)
    page.wait_for("ping")
    send(page, device, make_person(0.0), 1)
    page.send(message)
    assert find_refusal(page) == reason
    wait_for(lambda: not device.status.connected)
    assert device.status.trouble == f"the page was disconnected: {reason}"
    assert not device.read(0.0).tracked.any()


@pytest.mark.parametrize("size", [20_000, 5_000_000])
def test_huge_messages_are_not_even_read(device, size):
    page = Page(device)
    page.wait_for("ping")
    with contextlib.suppress(ConnectionClosed):  # the server need not wait for the end of it
        page.send("x" * size)
    assert page.wait_until_closed()[0] in {1009, 1006}


def test_too_many_messages(device, monkeypatch):
    limit = RateLimit()
    assert not any(limit.is_broken(0.5) for _ in range(400))
    assert limit.is_broken(1.0)
    assert not limit.is_broken(1.6)
    count = RateLimit.is_broken
    # All within one second, however slow the machine is.
    monkeypatch.setattr(RateLimit, "is_broken", lambda limit, time: count(limit, 0.0))
    page = Page(device)
    page.wait_for("ping")
    with contextlib.suppress(ConnectionClosed):  # as soon as it is shut out
        for _ in range(1000):
            page.send("{}")
    assert find_refusal(page) == "too many messages"
    assert 300 <= device.status.counts["no_message"] <= 400


# -- what is served ------------------------------------------------------------------------


def ask(device: WebXrDevice, path: str, method: str = "GET") -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("localhost", device.port, timeout=120)
    connection.request(method, path)
    return connection.getresponse()


def test_pages(device):
    reply = ask(device, "/")
    assert reply.status == 200 and reply.headers["Content-Type"].startswith("text/html")
    assert "frame-ancestors 'none'" in reply.headers["Content-Security-Policy"]
    assert CODE.encode() not in reply.read()  # who does not know the code learns it nowhere
    assert ask(device, "/", "HEAD").status == 200
    assert ask(device, "/", "POST").status == 405
    assert ask(device, "/main.js").headers["Content-Type"].startswith("text/javascript")
    for path in (
        "/..%2fserver.py",
        "/%2e%2e/server.py",
        "/server.py",
        "/.",
        "/x/y",
        "/%00",
        "/a%0db",
    ):
        assert ask(device, path).status in {400, 404}, path
    reply = ask(device, "/cert")
    assert reply.status == 404 and b"served without TLS" in reply.read()


def test_connections_that_ask_nothing_are_ended(device, monkeypatch):
    monkeypatch.setattr(pairing, "FIRST_REQUEST_S", 0.05)
    with socket.create_connection(("localhost", device.port), timeout=120) as idle:
        idle.sendall(b"GET / HT")
        with pytest.raises((ConnectionResetError, AssertionError)):
            assert idle.recv(100) != b""
    monkeypatch.setattr(pairing, "FIRST_REQUEST_S", 60.0)
    crowd = [socket.create_connection(("localhost", device.port)) for _ in range(200)]
    crowd[-1].settimeout(120)
    assert crowd[-1].recv(100) == b""  # there was no room for it
    for each in crowd:
        each.close()

    def try_page() -> bool:
        try:
            return ask(device, "/").status == 200
        except (OSError, http.client.HTTPException):
            return False

    wait_for(try_page)


# -- certificate ---------------------------------------------------------------------------


def test_certificate(tmp_path):
    folder = tmp_path / "xop"
    made = get_certificate(folder, NAMES, NOW)
    assert made.names == NAMES
    assert stat.S_IMODE(made.key_path.stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert b"PRIVATE" not in made.path.read_bytes()
    parsed = x509.load_pem_x509_certificate(made.path.read_bytes())
    assert parsed.not_valid_after_utc - parsed.not_valid_before_utc == VALID
    limits = parsed.extensions.get_extension_for_class(x509.NameConstraints)
    assert limits.critical and len(limits.value.permitted_subtrees or ()) == len(NAMES)
    assert len(made.fingerprint.split(":")) == 32

    assert get_certificate(folder, NAMES, NOW) == made  # and is kept
    assert get_certificate(folder, NAMES - {"192.168.1.5"}, NOW) == made
    assert get_certificate(folder, NAMES, made.end - RENEW - datetime.timedelta(1)) == made


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda folder: None, "the old one does not hold 10.0.0.9"),
        (lambda folder: (folder / "webxr.key").chmod(0o640), "others could read its key"),
        (lambda folder: (folder / "webxr.crt").write_text("no"), "it cannot be read"),
        (lambda folder: (folder / "webxr.key").unlink(), "there is none yet"),
        (
            lambda folder: get_certificate(folder.parent / "other", NAMES, NOW).key_path.replace(
                folder / "webxr.key"
            ),
            "it does not belong to its key",
        ),
    ],
)
def test_certificate_is_renewed(tmp_path, caplog, spoil, reason):
    caplog.set_level("INFO")
    folder = tmp_path / "xop"
    old = get_certificate(folder, NAMES, NOW)
    spoil(folder)
    caplog.clear()
    new = get_certificate(folder, NAMES | ({"10.0.0.9"} if "hold" in reason else set()), NOW)
    assert new.fingerprint != old.fingerprint
    assert f"A new certificate is made in {folder}: {reason}." in caplog.text
    assert stat.S_IMODE(new.key_path.stat().st_mode) == 0o600
    new.make_context()


def test_certificate_is_renewed_before_it_ends(tmp_path, caplog):
    caplog.set_level("INFO")
    old = get_certificate(tmp_path, NAMES, NOW)
    caplog.clear()
    new = get_certificate(tmp_path, NAMES, old.end - RENEW)
    assert new.end > old.end
    assert f"the old one ends on {old.end:%Y-%m-%d}" in caplog.text


def test_certificate_in_a_folder_that_is_none(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CertificateFault, match=r"certificate in '.*file/xop': Not a directory"):
        get_certificate(tmp_path / "file" / "xop", NAMES, NOW)


def test_tls(tmp_path, monkeypatch):
    """A page over TLS: who has the certificate trusts it by each name, others do not."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    config = DeviceConfig(type="webxr", port=find_port(), code=CODE, tls=True)
    device = make_device(config)
    assert isinstance(device, WebXrDevice)
    device.connect()
    try:
        assert device.certificate is not None
        assert device.certificate.path == tmp_path / "xop-lerobot" / "webxr.crt"
        trusting = ssl.create_default_context(cafile=str(device.certificate.path))
        for host in ("localhost", "127.0.0.1"):
            url = f"https://{host}:{device.port}/cert"
            with urllib.request.urlopen(url, context=trusting, timeout=120) as reply:
                assert reply.read() == device.certificate.path.read_bytes()
        with pytest.raises(urllib.error.URLError, match="self-signed certificate"):
            urllib.request.urlopen(device.url, context=ssl.create_default_context(), timeout=120)
        page = Page(device)
        page.wait_for("ping")
        send(page, device, make_person(0.0), 1)
        frame = device.read(0.0)
        assert frame is not None and frame.tracked.all()
        page.close()
    finally:
        device.disconnect()


@pytest.mark.slow
def test_a_browser_trusts_it_once_it_is_installed(tmp_path, monkeypatch):
    """As a headset's: refused at first; after /cert was installed the page is secure and drives."""
    certutil = shutil.which("certutil")
    if certutil is None:
        pytest.skip("needs certutil to install a certificate: apt-get install libnss3-tools")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    store = f"sql:{tmp_path}/.pki/nssdb"
    (tmp_path / ".pki/nssdb").mkdir(parents=True)
    subprocess.run([certutil, "-N", "-d", store, "--empty-password"], check=True)
    device = make_device(DeviceConfig(type="webxr", port=find_port(), code=CODE, tls=True))
    assert isinstance(device, WebXrDevice)
    device.connect()
    address = f"https://localhost:{device.port}/?code={CODE}"
    monkeypatch.setenv("HOME", str(tmp_path))  # where Chromium looks for what its user trusts
    try:
        assert device.certificate is not None
        with launch() as browser:
            page = browser.new_page()
            with pytest.raises(Exception, match="ERR_CERT_AUTHORITY_INVALID"):
                page.goto(address)
        subprocess.run(
            [certutil, "-A", "-d", store, "-n", "xop", "-t", "CP,,", "-i", device.certificate.path],
            check=True,
        )
        with launch() as browser:
            page = browser.new_page()
            headset.install(page)
            page.goto(address)
            assert page.evaluate("isSecureContext && location.protocol") == "https:"
            page.evaluate("wearer.embody()")
            page.wait_for_function("() => wearer.pose !== null")
            page.click("#headset")
            wait_for(lambda: (frame := device.read(0.0)) and frame.tracked.all())
    finally:
        device.disconnect()


def test_names():
    names = list_own_names()
    assert {"localhost", "127.0.0.1", "::1"} <= names
    assert set(addresses.list_addresses()) <= names
    assert addresses.make_url("https", "fd00::2", 8012, "AB") == "https://[fd00::2]:8012/?code=AB"


# -- invitation ----------------------------------------------------------------------------


def test_invitation(monkeypatch):
    assert write_invitation("127.0.0.1", 8012, False, CODE) == (
        "Open this in a browser of this machine:\n"
        f"  http://localhost:8012/?code={CODE}\n"
        "A Quest or Pico on a cable opens the same address after\n"
        "  adb reverse tcp:8012 tcp:8012\n"
        "For headsets in the network, let it listen there: --teleop.device.host=0.0.0.0\n"
    )
    monkeypatch.setattr(
        "xop_lerobot.operator.webxr.addresses.list_addresses",
        lambda: ["192.168.1.5", "fd00::2", "10.0.0.9"],
    )
    text = write_invitation("0.0.0.0", 8012, True, CODE, "AA:BB")
    assert text.startswith(
        "Open this in the headset:\n"
        f"  https://192.168.1.5:8012/?code={CODE}\n"
        f"  https://10.0.0.9:8012/?code={CODE}\n"
    )
    assert "right one if its SHA-256 fingerprint is\n  AA:BB\n" in text


def test_qr_code():
    cv2 = pytest.importorskip("cv2", reason="needs OpenCV to read the code")
    url = f"https://192.168.1.5:8012/?code={CODE}"
    upper = {"█": (1, 1), "▀": (1, 0), "▄": (0, 1), " ": (0, 0)}
    rows = [line for line in draw_qr(url).splitlines() if line]
    pixels = np.array([[upper[c][half] for c in row] for row in rows for half in (0, 1)])
    image = np.kron(np.pad(pixels, 4, constant_values=1), np.ones((8, 8))).astype(np.uint8) * 255
    assert cv2.QRCodeDetector().detectAndDecode(image)[0] == url


def test_the_key_never_ships():
    package = Path(server.__file__).parent
    assert not [path for path in package.rglob("*") if path.suffix in {".key", ".pem", ".crt"}]
