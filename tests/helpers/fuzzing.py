"""Garbage for every port that is open: it goes in, and nothing else changes.

What is attacked runs in a process of its own (`Subject`), whose memory, threads and files are
counted; a stream or client that behaves well goes on beside. `benchmarks/run_fuzz_ports.py` is the
long run, `test_fuzz_ports.py` a short one.
"""

from __future__ import annotations

import contextlib
import gc
import io
import json
import logging
import multiprocessing
import random
import socket
import ssl
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from avp_server import AvpServer
from avp_server import encode as encode_avp
from headset_rig import make_person
from ports import find_port
from websockets.exceptions import InvalidMessage, WebSocketException
from webxr_client import CODE, Page, encode

MAX_CHUNK = 65_536
"""Most bytes that go over one connection at once."""
ELSEWHERE = "127.0.0.2"
"""Who guesses codes is blocked; the stream that goes on has another address."""
WAIT_S = 60.0


@dataclass
class Result:
    """What a run has done.

    Attributes:
        port: What was attacked.
        sent: Bytes of garbage that went in.
        connections: Over how many connections.
        seconds: For how long.
        memory: Resident memory of the process in each kind of attack: after a tenth and after
            half of its bytes, and at its end [MB]. The system's allocator keeps what it has once
            given, and what is used for the first time in a later kind is taken then.
        objects: Python's own objects after a tenth of the bytes, and at the end.
        left: Threads and open files more than before.
        good: Messages of the stream that goes on beside: sent, and taken.
        counts: What became of all frames meanwhile.
        longest_gap: Longest time between two that were taken, and the same without garbage [s].
        errors: What was logged as an error.
    """

    port: str
    sent: int = 0
    connections: int = 0
    seconds: float = 0.0
    memory: list[tuple[float, float, float]] = field(default_factory=list)
    objects: tuple[int, int] = (0, 0)
    left: tuple[int, int] = (0, 0)
    good: tuple[int, int] = (0, 0)
    counts: dict[str, int] = field(default_factory=dict)
    longest_gap: tuple[float, float] = (0.0, 0.0)
    errors: list[str] = field(default_factory=list)

    def find_faults(self, growth_mb: float = 4.0, whole_mb: float = 25.0) -> list[str]:
        """What was disturbed; empty if nothing was.

        Args:
            growth_mb: Memory may grow by so much in the second half of each kind of attack [MB].
            whole_mb: And by so much from the first tenth to the very end [MB].
        """
        faults = [f"logged: {error}" for error in self.errors[:3]]
        for _, middle, end in self.memory:
            if end - middle > growth_mb:
                faults.append(f"memory grew from {middle:.1f} to {end:.1f} MB")
        if self.memory and self.memory[-1][2] - self.memory[0][0] > whole_mb:
            faults.append(
                f"memory grew from {self.memory[0][0]:.1f} to {self.memory[-1][2]:.1f} MB in all"
            )
        if self.objects[1] > self.objects[0] + 5_000:
            faults.append(f"objects grew from {self.objects[0]} to {self.objects[1]}")
        if self.left[0] > 2 or self.left[1] > 4:
            faults.append(f"{self.left[0]} threads and {self.left[1]} files are left")
        if self.good[1] < self.good[0]:
            faults.append(
                f"only {self.good[1]} of {self.good[0]} good messages were taken: {self.counts}"
            )
        return faults


# -- what is attacked, in a process of its own -----------------------------------------------


class _Errors(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.seen: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        self.seen.append(f"{record.name}: {record.getMessage()[:200]} {error!r:.200}")


class _Driver:
    """A control loop that reads a device, and shows something on it."""

    def __init__(self, config: dict[str, Any]) -> None:
        from xop_lerobot.operator.devices import DeviceConfig, live, make_device

        live.RETRY_S = 0.02
        self._device: Any = make_device(DeviceConfig(**config))
        self._device.connect()
        self._picture = np.zeros((240, 320, 3), dtype=np.uint8)
        self._last, self._heard, self._gap = None, 0.0, 0.0

    def step(self) -> None:
        from xop_lerobot.operator.display import Display

        frame = self._device.read(0.0)
        if frame is not None and frame.tracked[0]:
            poses = np.concatenate([frame.head, frame.left_wrist, frame.pinch])
            assert np.isfinite(poses).all()
            if frame.time != self._last:
                now = time.monotonic()
                if self._last is not None:
                    self._gap = max(self._gap, now - self._heard)
                self._last, self._heard = frame.time, now
        self._device.take_requests()
        self._device.show(Display(time.monotonic(), pictures={"head": self._picture}))

    def report(self) -> dict[str, Any]:
        """How many frames were taken, and the longest gap between two since the last report."""
        gap, self._gap = self._gap, 0.0
        counts = self._device.status.counts
        return {"taken": counts.get("taken", 0), "gap": gap, "counts": counts}

    def close(self) -> None:
        self._device.disconnect()


class _Control:
    def __init__(self, config: dict[str, Any]) -> None:
        from tests.control.test_control import Session
        from xop_lerobot.control.server import ControlServer

        self._server = ControlServer(Path(config["path"]), Session())
        self.close = self._server.close

    def step(self) -> None:
        pass

    def report(self) -> dict[str, Any]:
        return {}


def _attend(pipe: Any, kind: str, config: dict[str, Any]) -> None:
    errors = _Errors()
    logging.getLogger().addHandler(errors)
    process = psutil.Process()
    sys.stdout = io.StringIO()  # the invitation
    subject = _Control(config) if kind == "control" else _Driver(config)
    pipe.send("ready")
    while True:
        pipe.poll(0.02)
        subject.step()
        while pipe.poll():
            if pipe.recv() == "stop":
                subject.close()
                pipe.send("stopped")
                return
            gc.collect()
            counts = {
                "objects": len(gc.get_objects()),
                "memory": process.memory_info().rss / 1e6,
                "threads": process.num_threads(),
                "files": process.num_fds(),
                "errors": errors.seen[:20],
            }
            pipe.send(subject.report() | counts)


class Subject:
    """A device or a control socket in a process of its own."""

    def __init__(self, kind: str, config: dict[str, Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self.process = context.Process(target=_attend, args=(theirs, kind, config), daemon=True)
        self.process.start()
        theirs.close()
        self._receive(120.0)

    def _receive(self, timeout: float = 60.0) -> Any:
        assert self._pipe.poll(timeout), "it hangs"
        try:
            return self._pipe.recv()
        except (EOFError, ConnectionError):
            raise AssertionError("it has crashed") from None

    def ask(self) -> dict[str, Any]:
        self._pipe.send("status")
        return self._receive()

    def stop(self) -> None:
        self._pipe.send("stop")
        assert self._receive() == "stopped"
        self.process.join(20)
        assert self.process.exitcode == 0, f"it ended with {self.process.exitcode}"


# -- garbage -------------------------------------------------------------------------------


def make_size(rng: random.Random) -> int:
    return min(int(2 ** rng.uniform(0, 16.5)), MAX_CHUNK)


def mutate(rng: random.Random, data: bytes) -> bytes:
    """Flip, cut, repeat and put in a few bytes."""
    made = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(len(made) + 1)
        match rng.randrange(4):
            case 0:
                made[at : at + 1] = rng.randbytes(1)
            case 1:
                del made[at : at + rng.randint(1, 40)]
            case 2:
                made[at:at] = made[at : at + rng.randint(1, 200)] * rng.randint(1, 8)
            case _:
                made[at:at] = rng.choice(TOKENS)
    return bytes(made)


TOKENS = (
    b"null", b"1e999", b"-1", b"NaN", b"[[[[[[", b'"', b"{", b"\x00", b"\xff\xfe", b"true", b",",
    b'"type":"frame"', b"99999999999999999999999999", b"\\ud800", b"\r\n", b": ",
)  # fmt: skip
LINES = (
    b'{"preset": "conservative", "weights": {"position": 2.0}}',
    b'{"get": "settings"}',
    b'{"toggle": "upright"}',
    b'{"constraints": {"upright": true}, "mode": "mobile", "targets": ["head"]}',
)


def make_messages(now: float) -> list[bytes]:
    """Good messages of a page, to be spoilt."""
    frame = encode(make_person(now, gesture=False), 1, now)
    return [
        json.dumps(message).encode()
        for message in (
            frame,
            frame | {"source": "controllers", "left": {"grip": [0] * 7, "trigger": 1}},
            {"type": "pong", "id": 1, "t": 1.0},
            {"type": "wish", "wish": "success"},
            {"type": "bye", "reason": "away"},
        )
    ]


def make_request(port: int, role: str, code: str) -> bytes:
    return (
        f"GET /ws?code={code}&role={role} HTTP/1.1\r\nHost: localhost:{port}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    ).encode()


@contextlib.contextmanager
def connect(
    port: int, tls: ssl.SSLContext | None, source: str = ELSEWHERE
) -> Iterator[socket.socket]:
    raw = socket.create_connection(("127.0.0.1", port), WAIT_S, (source, 0))
    with raw if tls is None else tls.wrap_socket(raw, server_hostname="localhost") as connection:
        yield connection


logging.getLogger("websockets.client").setLevel(logging.CRITICAL)

# -- the runs ------------------------------------------------------------------------------


class Attack:
    """Sends `total` bytes through `attacks` in turn, and counts."""

    def __init__(self, result: Result, total: int, subject: Subject, settles: bool = True) -> None:
        self.result, self._total, self._subject = result, total, subject
        self._settles = settles

    def run(self, attacks: list[Callable[[], int]]) -> None:
        result, subject = self.result, self._subject
        start = subject.ask()
        warm: dict[str, Any] | None = None
        middle: dict[str, Any] | None = None
        begun, sent_before = time.monotonic(), result.sent
        share = self._total - sent_before
        while result.sent < self._total:
            attack = attacks[result.connections % len(attacks)]
            with contextlib.suppress(OSError, WebSocketException):  # it has hung up
                result.sent += attack()
            result.connections += 1
            if warm is None and result.sent - sent_before >= share / 10:
                warm = subject.ask()
            if middle is None and result.sent - sent_before >= share / 2:
                middle = subject.ask()
        result.seconds += time.monotonic() - begun
        end = self._settle(start)
        warm = warm or start
        result.memory.append((warm["memory"], (middle or warm)["memory"], end["memory"]))
        result.objects = warm["objects"], end["objects"]
        result.longest_gap = max(each.get("gap", 0.0) for each in (warm, middle or warm, end)), 0.0
        result.left = end["threads"] - start["threads"], end["files"] - start["files"]
        result.errors = end["errors"]

    def _settle(self, start: dict[str, Any]) -> dict[str, Any]:
        """Wait until the last connections are gone, and forgotten."""
        time.sleep(4.5)
        deadline = time.monotonic() + 30
        while True:
            end = self._subject.ask()
            gone = end["files"] <= start["files"] + 2 or not self._settles
            if gone or time.monotonic() > deadline:
                return end
            time.sleep(0.2)


class GoodStream:
    """An operator, at 50 Hz, on a thread of its own."""

    def __init__(self, send: Callable[[int], None], rate: float = 50.0) -> None:
        self.sent, self._send, self._rate = 0, send, rate
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(1 / self._rate):
            self._send(self.sent)
            self.sent += 1

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(WAIT_S)


def _come_in(device: _Address, context: ssl.SSLContext | None) -> Page:
    """Connect a page; on a busy machine a handshake may outlast the patience of the server."""
    for _ in range(9):
        try:
            return Page(device, tls=context)  # type: ignore[arg-type]
        except InvalidMessage:
            continue
    return Page(device, tls=context)  # type: ignore[arg-type]


def fuzz_webxr(total: int, seed: int = 0, tls: bool = False) -> Result:
    """TCP, TLS, HTTP, WebSocket frames and JSON, three quarters beside an operator."""
    rng = random.Random(seed)
    port = find_port()
    result = Result("webxr, TLS" if tls else "webxr")
    config = {"type": "webxr", "port": port, "code": CODE, "tls": tls, "max_delay_s": 60.0}
    subject = Subject("device", config | {"smoothing": 0.0})
    context = None
    if tls:
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE

    def send_raw() -> int:
        with connect(port, None) as connection:  # not even a handshake
            connection.sendall(data := rng.randbytes(make_size(rng)))
        return len(data)

    def send_http() -> int:
        with connect(port, context) as connection:
            data = mutate(rng, make_request(port, "operator", "GUESSES2"))
            if rng.random() < 0.3:
                data = b"GET /" + rng.randbytes(make_size(rng)) + b" HTTP/1.1\r\n\r\n"
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
            connection.recv(1000)
        return len(data)

    def send_frames() -> int:
        """Past the door, but no more WebSocket."""
        with connect(port, context, "127.0.0.1") as connection:
            connection.sendall(make_request(port, "monitor", CODE))
            connection.recv(1000)
            connection.sendall(data := rng.randbytes(make_size(rng)))
        return len(data)

    def send_json() -> int:
        """Past the door, as one who looks on and as the operator."""
        role, sent = rng.choice(("monitor", "operator")), 0
        page = RawPage(port, context, role)
        try:
            for _ in range(rng.randint(1, 60)):
                data = mutate(rng, rng.choice(make_messages(time.monotonic())))
                page.send(data)
                sent += len(data)
        finally:
            page.close()
        return sent

    device = _Address(port, tls)
    page = _come_in(device, context)
    page.wait_for("ping")
    time.sleep(0.2)
    good = GoodStream(
        lambda i: page.send(encode(make_person(time.monotonic(), False), i, page.clock()))
    )
    time.sleep(0.5)
    subject.ask()
    time.sleep(min(total / 1e6, 10))
    quiet = subject.ask()["gap"]
    Attack(result, total * 3 // 4, subject).run([send_raw, send_http, send_frames, send_json])
    good.stop()
    time.sleep(0.5)
    status = subject.ask()
    result.good, result.counts = (good.sent, status["taken"]), status["counts"]
    result.longest_gap = max(result.longest_gap[0], status["gap"]), quiet
    page.close()
    gaps = result.longest_gap
    Attack(result, total, subject).run([send_json, send_frames])  # now there is room to drive
    result.longest_gap = gaps
    subject.stop()
    return result


@dataclass
class _Address:
    """What `Page` must know of a device that runs elsewhere."""

    port: int
    tls: bool
    certificate: None = None

    @property
    def url(self) -> str:
        return f"{'https' if self.tls else 'http'}://localhost:{self.port}/"


class RawPage:
    """A WebSocket that sends text of any bytes."""

    def __init__(self, port: int, tls: ssl.SSLContext | None, role: str) -> None:
        from websockets.sync.client import connect as connect_page

        scheme = "ws" if tls is None else "wss"
        url = f"{scheme}://localhost:{port}/ws?code={CODE}&role={role}"
        self._ws = connect_page(url, ssl=tls, proxy=None, open_timeout=WAIT_S, close_timeout=0.2)

    def send(self, data: bytes) -> None:
        self._ws.send(data, text=True)

    def close(self) -> None:
        self._ws.close()


def fuzz_control(total: int, seed: int = 0) -> Result:
    """Bytes and spoilt requests, beside a client that asks for the settings."""
    rng = random.Random(seed)
    result = Result("xop-control")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run" / "xop.sock"
        subject = Subject("control", {"path": str(path)})

        def send() -> int:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
                connection.settimeout(WAIT_S)
                connection.connect(str(path))
                if rng.random() < 0.5:
                    data = rng.randbytes(make_size(rng))
                else:
                    lines = (mutate(rng, rng.choice(LINES)) for _ in range(rng.randint(1, 40)))
                    data = b"\n".join(lines) + b"\n"
                connection.sendall(data)
                connection.shutdown(socket.SHUT_WR)
                while connection.recv(65_536):
                    pass
            return len(data)

        answered: list[float] = []
        asker = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        asker.settimeout(60)
        asker.connect(str(path))
        lines = asker.makefile("rb")

        def ask(_: int) -> None:
            begun = time.monotonic()
            asker.sendall(b'{"get": "settings"}\n')
            if json.loads(lines.readline())["ok"]:
                answered.append(time.monotonic() - begun)

        good = GoodStream(ask)
        time.sleep(min(total / 1e6, 10) + 0.2)
        quiet = max(answered)
        answered_before = len(answered)
        Attack(result, total, subject).run([send])
        good.stop()
        result.good = good.sent, len(answered)
        result.longest_gap = max(answered[answered_before:], default=0.0), quiet
        lines.close()
        asker.close()
        subject.stop()
    return result


def fuzz_avp(total: int, seed: int = 0) -> Result:
    """Our client of the Vision Pro: garbage as messages, between good ones, then as HTTP/2."""
    rng = random.Random(seed)
    result = Result("avp (client)")
    server = AvpServer()
    port = server.port
    config = {"type": "avp", "host": "127.0.0.1", "port": port, "smoothing": 0.0}
    subject = Subject("device", config)
    server.wait_for_clients(timeout=60)

    def send_messages() -> int:
        sent = 0
        for _ in range(10):
            now = time.monotonic()
            spoilt = mutate(rng, encode_avp(make_person(now, False)))
            data = spoilt if rng.random() < 0.5 else rng.randbytes(make_size(rng))
            server.send(data)
            sent += len(data)
        server.send(make_person(time.monotonic(), False))
        time.sleep(0.03)  # as many as are taken, 400 in a second
        return sent

    start = subject.ask()
    Attack(result, total * 9 // 10, subject).run([send_messages])
    gaps = result.longest_gap
    server.close()

    with socket.create_server(("127.0.0.1", port)) as listener:
        listener.settimeout(60)

        def send_raw() -> int:
            connection, _ = listener.accept()
            with connection:
                data = rng.randbytes(make_size(rng))
                if rng.random() < 0.5:  # an empty SETTINGS frame first, as HTTP/2 begins
                    data = b"\x00\x00\x00\x04\x00\x00\x00\x00\x00" + data
                connection.sendall(data)
            return len(data)

        Attack(result, total, subject, settles=False).run([send_raw])
    again = AvpServer(port)
    again.wait_for_clients(timeout=60)
    before = subject.ask()["taken"]
    deadline = time.monotonic() + 60
    while (status := subject.ask())["taken"] < before + 5 and time.monotonic() < deadline:
        again.send(make_person(time.monotonic(), False))
        time.sleep(0.02)
    result.good = 5, min(status["taken"] - before, 5)
    result.longest_gap = gaps
    result.left = status["threads"] - start["threads"], status["files"] - start["files"]
    subject.stop()
    again.close()
    return result
