"""Base class of live headsets: receiver thread, latest frame, and reconnection."""

from __future__ import annotations

import dataclasses
import logging
import math
import threading
import time as clocks
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.errors import XopError
from xop_lerobot.core.paced_log import PacedLog
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.one_euro import OneEuro, make_one_euro
from xop_lerobot.operator.stream import GuardConfig, StreamGuard
from xop_lerobot.operator.webxr.pairing import MAX_RATE

logger = logging.getLogger(__name__)

HANDS = ("left", "right")
RETRY_S = 1.0
"""Time between two attempts to connect [s]."""
SILENT_S = 2.0
"""Time without a message after which a connection is renewed [s]."""
RATE_WINDOW_S = 1.0
"""Time window over which the stream's rate is counted [s]."""
HAND_HZ = 1 / GuardConfig.frozen
"""Rate of a hand's poses below which it counts as lost between two of them [Hz]."""


class StreamLost(XopError):
    """The stream has ended; the message gives the reason."""


@dataclass(frozen=True)
class StreamStatus:
    """Status of a stream.

    Attributes:
        connected: Whether the device is connected.
        age: Time since the last accepted frame [s]; infinite before the first.
        rate: Accepted frames in the last second [Hz].
        counts: Number of frames and limbs by outcome: `taken`, `repeated`, and every reason for a
            rejection.
        connections: Number of connections so far.
        trouble: Present fault, as text; empty if none.
        delay: Median delay of the frames of the last second on arrival [s]; None if unknown.
        hand_rates: Rates at which left and right hand poses change, which may be below the frame
            rate [Hz]; None if a hand is constant or not tracked.
    """

    connected: bool
    age: float
    rate: float
    counts: dict[str, int]
    connections: int
    trouble: str
    delay: float | None = None
    hand_rates: tuple[float | None, float | None] = (None, None)

    @property
    def slow_hands(self) -> tuple[str, ...]:
        """Hands whose poses change too rarely, so that they count as lost."""
        slow = min(HAND_HZ, 0.8 * self.rate)
        rates = zip(HANDS, self.hand_rates, strict=True)
        return tuple(side for side, rate in rates if rate is not None and rate < slow)


class LiveDevice(Device):
    """A live headset.

    The stream is read by a separate thread at its own rate. Each frame is stamped at receipt,
    checked and smoothed at once; only the latest is kept. So `read` never blocks and nothing queues
    up: a slow reader still gets the latest frame. Without an accepted frame for `stale` seconds,
    `read` returns a frame with nothing tracked. A lost connection is renewed automatically.

    A subclass implements `stream` and `interrupt`, and calls `receive` with each frame.

    Args:
        config: Device settings.
        guard: Limits of the plausibility checks.
        clock: Clock of the stamps [s].
    """

    def __init__(
        self,
        config: DeviceConfig,
        guard: GuardConfig | None = None,
        clock: Callable[[], float] = clocks.monotonic,
    ) -> None:
        self.config = config
        self.start_mode = config.start_mode
        self.guard = StreamGuard(guard or GuardConfig(stale=config.stale_s))
        self._filter: OneEuro | None = make_one_euro(config.smoothing)
        self.clock = clock
        self.handled = 0
        """Number of processed messages of any kind."""
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._newest: OperatorFrame | None = None
        self._relocations = self._read_relocations = 0
        self._stamps: deque[float] = deque(maxlen=round(MAX_RATE * RATE_WINDOW_S))
        self._heard_at = 0.0
        self._connections = 0
        self._connected = self._left = False
        self._trouble = self._farewell = ""
        self._log = PacedLog(logger)  # the peer could flood the log

    @property
    @abstractmethod
    def address(self) -> str:
        """Description of the peer, for messages."""

    @abstractmethod
    def stream(self) -> None:
        """Connect, and call `hear` and `receive` until the stream ends or is interrupted.

        Raises:
            StreamLost: If it ends, or the connection fails.
        """

    @abstractmethod
    def interrupt(self) -> None:
        """Make `stream` return soon; called from other threads."""

    def connect(self) -> None:
        """Start connecting, and return at once: the person may put the headset on later."""
        if self._thread is not None:
            return
        self._stop.clear()
        self._heard_at = self.clock()
        self._thread = threading.Thread(target=self._run, name="xop-headset", daemon=True)
        self._thread.start()
        logger.info("Waiting for %s.", self.address)

    def disconnect(self) -> None:
        """Close the connection; may be called twice."""
        self._stop.set()
        self.interrupt()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
            self._thread = None

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self.stream()
                lost = StreamLost("the stream has ended")
            except StreamLost as error:
                lost = error
            except Exception as error:  # any error must leave the robot holding
                self._log.exception("%s: its stream cannot be read", self.address)
                lost = StreamLost(f"{type(error).__name__}: {error}")
            with self._lock:
                self._connected = False
            if not self._stop.is_set():
                self._say(f"{self.address}: {lost}. Trying again every {RETRY_S:g} s.")
            self._stop.wait(RETRY_S)

    def _say(self, trouble: str) -> None:
        """Set the present trouble; log each new one once."""
        if trouble and trouble != self._trouble:
            self._log.warning(trouble)
        self._trouble = trouble

    def hear(self) -> None:
        """Note that the device has sent a message of any kind."""
        with self._lock:
            self._heard_at = self.clock()
            if self._connected:
                return
            # After a pause another person may wear it, elsewhere.
            self.guard.reset()
            if self._filter is not None:
                self._filter.reset()
            self._relocations += self._connections > 0
            self._connected = True
            self._connections += 1
            self._trouble = ""
        self._log.info("%s is connected.", self.address)

    def refuse(self, reason: str) -> None:
        """Count a message without a usable frame."""
        with self._lock:
            self.guard.counts[reason] += 1
            self.handled += 1

    def receive(self, frame: OperatorFrame, source_time: float | None = None) -> None:
        """Process a frame of the device; it is stamped here.

        Args:
            frame: Head, wrists and pinches in the convention of `OperatorFrame`; undecodable values
                are NaN.
            source_time: The device's own stamp or number, if any.
        """
        with self._lock:
            relocations = self.guard.relocations
            stamped = dataclasses.replace(frame, time=self.clock())
            taken = self.guard.take(stamped, source_time)
            self._relocations += self.guard.relocations - relocations
            if self._filter is not None and self.guard.relocations != relocations:
                self._filter.reset()
            if taken is not None and self._filter is not None:
                taken = self._filter.smooth(taken)
            if taken is not None:
                self._newest, self._left = taken, False
                self._stamps.append(taken.time)
                while self._stamps[0] < taken.time - RATE_WINDOW_S:
                    self._stamps.popleft()
            self.handled += 1

    def read(self, time: float) -> OperatorFrame | None:
        """Return the latest frame, or one with nothing tracked if it is too old.

        Its time is on the device's clock, independent of the robot's `time`.
        """
        del time
        with self._lock:
            now, newest = self.clock(), self._newest
            silent = self._connected and now - self._heard_at > SILENT_S
            moved = self._relocations != self._read_relocations
            self._read_relocations = self._relocations
            left = self._left
            if not (moved or left):
                self._farewell = ""  # the operator is back
            if silent:
                self._connected = False
        if silent:
            self.end_silence()
        if newest is None:
            return None
        if moved or left or now - newest.time > self.guard.config.stale:
            return dataclasses.replace(newest, time=now, tracked=np.zeros(3, dtype=bool))
        return newest

    def end_silence(self) -> None:
        """Handle a silent connection: reconnect."""
        self._say(f"{self.address}: nothing has come for {SILENT_S:g} s. Reconnecting.")
        self.interrupt()

    def leave(self, reason: str) -> None:
        """Note that the operator has left: nothing is tracked from now on.

        Later frames start over. The reason stays in `trouble` until it has been read once, even if
        frames arrive before, so that the operator learns why the robot disengaged.
        """
        with self._lock:
            self._connected, self._left, self._farewell = False, True, reason
        self._say(reason)

    @property
    def trouble(self) -> str:
        """Present fault of the stream, as text; empty if none."""
        return self.status.trouble

    @property
    def status(self) -> StreamStatus:
        """Present status of the stream."""
        with self._lock:
            now = self.clock()
            age = float("inf") if self._newest is None else now - self._newest.time
            status = StreamStatus(
                connected=self._connected,
                age=age,
                rate=sum(t > now - RATE_WINDOW_S for t in self._stamps) / RATE_WINDOW_S,
                counts=dict(self.guard.counts),
                connections=self._connections,
                trouble=self._trouble or self._farewell,
                hand_rates=self.guard.compute_hand_rates(now),
            )
        if status.trouble or not status.slow_hands or age > self.guard.config.stale:
            return status
        return dataclasses.replace(status, trouble=_describe_slow_hands(status))


def _describe_slow_hands(status: StreamStatus) -> str:
    slow = status.slow_hands
    rate = min(rate for rate in status.hand_rates if rate is not None)
    hands = f"{slow[0]} hand" if len(slow) == 1 else "hands"
    return (
        f"The headset updates your {hands} only {rate:.0f} times a second; at least "
        f"{math.ceil(HAND_HZ)} are needed. Hold them in view, in good light, and close other apps."
    )
