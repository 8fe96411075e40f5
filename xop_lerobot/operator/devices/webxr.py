"""Device for any headset whose browser supports WebXR; it opens a page served from here."""

from __future__ import annotations

import asyncio
import dataclasses
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np

from xop_lerobot.core.command_line import can_print_anything
from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.devices.live import SILENT_S, LiveDevice, StreamStatus
from xop_lerobot.operator.display import Display, RecordingRequest
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.webxr.addresses import is_loopback, list_hosts, make_url, write_invitation
from xop_lerobot.operator.webxr.certificate import Certificate, get_certificate
from xop_lerobot.operator.webxr.client import Client
from xop_lerobot.operator.webxr.delay_meter import DelayMeter
from xop_lerobot.operator.webxr.pairing import check_code, make_code
from xop_lerobot.operator.webxr.pictures import Picture, PictureEncoder
from xop_lerobot.operator.webxr.protocol import PORT, FrameMessage, write_display, write_pose
from xop_lerobot.operator.webxr.server import HeadsetServer

LOOPBACK = "127.0.0.1"
BACKLOG = 16
FUTURE_S = 0.05
"""Largest clock drift between two pings [s]."""


class PortTaken(XopError):
    """The port cannot be opened; the message gives the reason and the flag to change it."""


class WebXrDevice(LiveDevice):
    """A headset, or a stand-in, that opens the page and streams head and hands.

    Args:
        config: Device settings.

    Raises:
        BadValue: If the code is too short, or TLS is off while other machines can connect.
    """

    def __init__(self, config: DeviceConfig, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(config, clock=clock)
        self.host, self.port = config.host or LOOPBACK, config.port or PORT
        self.code = config.code or make_code()
        check_code(self.code)
        local = is_loopback(self.host)
        self.tls = not local if config.tls is None else config.tls
        if not self.tls and not local:
            raise BadValue(
                f"device.tls=false needs a host that only this machine reaches, got {self.host!r}; "
                "headsets ask for TLS anyway"
            )
        self.certificate: Certificate | None = None
        self.introduction: tuple[str, dict[str, str]] = ("", {})
        self._pictures = PictureEncoder()
        self._display: Display | None = None
        self._read: OperatorFrame | None = None
        self._requests: deque[RecordingRequest] = deque(maxlen=8)
        self._delay = DelayMeter(config.max_delay_s)
        self._was_late = False
        self._listener: socket.socket | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._loop_stop: asyncio.Event | None = None
        self._loop_lock = threading.Lock()

    @property
    def address(self) -> str:
        """Description of the page, for messages."""
        return f"WebXR page at {self.url}"

    @property
    def url(self) -> str:
        """Address of the page, without the code."""
        return make_url("https" if self.tls else "http", list_hosts(self.host)[0], self.port)

    def connect(self) -> None:
        """Start listening, and return at once: the person may put the headset on later.

        Raises:
            PortTaken: If the port cannot be opened.
            CertificateFault: If there is no certificate, and none can be created.
        """
        if self._thread is not None:
            return
        self.certificate = get_certificate() if self.tls else None
        self._listener = listen(self.host, self.port)
        self._pictures.start()
        self._invite()
        super().connect()

    def _invite(self) -> None:
        fingerprint = self.certificate.fingerprint if self.certificate is not None else ""
        qr = sys.stdout.isatty() and can_print_anything()
        print(write_invitation(self.host, self.port, self.tls, self.code, fingerprint, qr))

    def disconnect(self) -> None:
        """Close all connections and the port; may be called twice."""
        super().disconnect()
        self._pictures.stop()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def introduce(self, robot: str, gestures: Mapping[str, str]) -> None:
        """Set what the page shows to a new client.

        Args:
            robot: Name of the robot.
            gestures: Explanation of each gesture, by its effect.
        """
        self.introduction = (robot, dict(gestures))

    # Called by the control loop.

    def read(self, time: float) -> OperatorFrame | None:
        """Return the latest frame, or one with nothing tracked if it is too old."""
        self._read = super().read(time)
        return self._read

    def show(self, display: Display) -> None:
        """Update the display of every page; returns at once."""
        self._display = display
        if display.pictures:
            self._pictures.give(display.pictures)

    def take_requests(self) -> tuple[RecordingRequest, ...]:
        """Return the requests made on the page since the last call."""
        return tuple(self._requests.popleft() for _ in range(len(self._requests)))

    @property
    def status(self) -> StreamStatus:
        """Present status of the stream."""
        status = super().status
        with self._lock:
            now = self.clock()
            delay, trouble = self._delay.measure(now), self._delay.describe(now)
        return dataclasses.replace(status, delay=delay, trouble=status.trouble or trouble)

    # Called on the server's thread.

    def stream(self) -> None:
        """Serve until interrupted."""
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        stop = asyncio.Event()
        with self._loop_lock:
            self._loop, self._loop_stop = asyncio.get_running_loop(), stop
            listener, self._listener = self._listener, None
        if self._stop.is_set():
            stop.set()
        try:
            listener = listener or listen(self.host, self.port)
            await HeadsetServer(self, self.code, self.certificate).run(listener, stop)
        finally:
            with self._loop_lock:
                self._loop = self._loop_stop = None

    def interrupt(self) -> None:
        """Stop serving."""
        with self._loop_lock:
            if self._loop is not None and self._loop_stop is not None:
                self._loop.call_soon_threadsafe(self._loop_stop.set)

    def end_silence(self) -> None:
        """Report the silence; the page stays connected and may resume."""
        self._say(f"{self.address}: nothing has come for {SILENT_S:g} s")

    def take(self, message: FrameMessage, client: Client) -> None:
        """Process a frame of the operator, unless it is late."""
        now = self.clock()
        measured = client.measure_delay(message, now)
        if measured is None:
            self.refuse("clock_unknown")
            return
        delay, error = measured
        if delay < -error - FUTURE_S:  # accepting it would make later frames look old
            self.refuse("from_the_future")
            return
        if not self._connected:
            with self._lock:
                self._delay.reset()
        self.hear()
        with self._lock:
            late = self._delay.take(now, max(delay, 0.0), error)
            trouble = self._delay.describe(now) if late and not self._was_late else ""
        if trouble:
            self._log.warning(trouble)
        self._was_late = late
        if late:
            self.refuse("late")
        else:
            self.receive(message.frame, message.sent)

    def request(self, request: RecordingRequest) -> None:
        """Receive a request of the operator to the recorder."""
        self._requests.append(request)

    def write_shown(self, role: str) -> list[str]:
        """Return the messages with the present display."""
        display, frame = self._display, self._read
        if display is None:
            return []
        status = self.status
        tracked = np.zeros(3, dtype=bool) if frame is None else frame.tracked
        shown = [write_display(display, display.warnings, tracked, status.rate, status.delay)]
        if role == "monitor" and frame is not None:
            shown.append(write_pose(frame))
        return shown

    def take_picture(self) -> Picture | None:
        """Return the latest images."""
        return self._pictures.newest


def listen(host: str, port: int) -> socket.socket:
    """Open a listening socket at `host` and `port`.

    Raises:
        PortTaken: If that fails.
    """
    try:
        return socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET, backlog=BACKLOG
        )
    except OSError as fault:
        raise PortTaken(
            f"cannot listen at {host} port {port}: {fault.strerror or fault}. Choose another "
            "--teleop.device.port, or end the session that uses it"
        ) from fault
