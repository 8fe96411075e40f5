"""Common part of live headsets: a thread of their own, the newest frame, and its age."""

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
"""A connection over which nothing came for so long is made anew [s]."""
RATE_WINDOW_S = 1.0
"""Time over which the rate of the stream is counted [s]."""
HAND_HZ = 1 / GuardConfig.frozen
"""Rate of a hand's poses under which it counts as lost between one and the next [Hz]."""


class StreamLost(XopError):
    """The stream has ended; the message says how."""


@dataclass(frozen=True)
class StreamStatus:
    """Status of a stream.

    Attributes:
        connected: Whether the device answers.
        age: Time since the last frame that was believed [s]; infinite before the first.
        rate: Believable frames in the last second [Hz].
        counts: Frames and limbs by what became of them: `taken`, `repeated`, and every reason
            for a refusal.
        connections: How often a connection was made.
        trouble: What is wrong, in words; empty if nothing is.
        delay: How old a frame is when it arrives, half of the frames of the last second are
            older [s]; None where the device cannot tell.
        hand_rates: How often the poses of left and right hand change, which may be less often
            than frames come [Hz]; None where a hand stands or is not seen.
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

    Its stream is read on a thread of its own, as fast as it comes, and each frame is stamped at
    its receipt, judged and smoothed at once; only the newest is kept. So `read` never waits, and
    nothing queues up: however slow the readers are, what they get is never older than the stream.
    When no believable frame came for `stale` seconds, `read` says that nothing is tracked. The
    connection is made anew by itself whenever it ends.

    A subclass implements `stream` and `interrupt`, and calls `receive` with each frame.

    Args:
        config: Its settings.
        guard: What counts as a fault of the stream.
        clock: The clock of the stamps [s].
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
        """Messages that were dealt with, of whatever kind."""
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
        self._log = PacedLog(logger)  # what comes and goes is the other side's doing

    @property
    @abstractmethod
    def address(self) -> str:
        """Description of the peer, for messages."""

    @abstractmethod
    def stream(self) -> None:
        """Connect, and call `hear` and `receive` until the stream ends or is interrupted.

        Raises:
            StreamLost: If it ends, or cannot be connected to.
        """

    @abstractmethod
    def interrupt(self) -> None:
        """Make `stream` return soon; called from other threads."""

    def connect(self) -> None:
        """Begin to connect, and return at once: the person may put the headset on later."""
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
            except Exception as error:  # the robot holds, whatever it was
                self._log.exception("%s: its stream cannot be read", self.address)
                lost = StreamLost(f"{type(error).__name__}: {error}")
            with self._lock:
                self._connected = False
            if not self._stop.is_set():
                self._say(f"{self.address}: {lost}. Trying again every {RETRY_S:g} s.")
            self._stop.wait(RETRY_S)

    def _say(self, trouble: str) -> None:
        """Warn once of each trouble."""
        if trouble and trouble != self._trouble:
            self._log.warning(trouble)
        self._trouble = trouble

    def hear(self) -> None:
        """Note that the device has sent a message of any kind."""
        with self._lock:
            self._heard_at = self.clock()
            if self._connected:
                return
            # After a pause somebody else's head may be in it, anywhere.
            self.guard.reset()
            if self._filter is not None:
                self._filter.reset()
            self._relocations += self._connections > 0
            self._connected = True
            self._connections += 1
            self._trouble = ""
        self._log.info("%s is connected.", self.address)

    def refuse(self, reason: str) -> None:
        """Count a message that holds no frame."""
        with self._lock:
            self.guard.counts[reason] += 1
            self.handled += 1

    def receive(self, frame: OperatorFrame, source_time: float | None = None) -> None:
        """Take a frame of the device; its stamp is set here.

        Args:
            frame: Head, wrists and pinches in the convention of `OperatorFrame`; what cannot
                be decoded is NaN.
            source_time: The device's own stamp or number, where it has one.
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
        """Return the newest frame, or one in which nothing is tracked if it is too old.

        Its time is the host's, on the device's clock, whatever the robot's `time` is.
        """
        del time
        with self._lock:
            now, newest = self.clock(), self._newest
            silent = self._connected and now - self._heard_at > SILENT_S
            moved = self._relocations != self._read_relocations
            self._read_relocations = self._relocations
            left = self._left
            if not (moved or left):
                self._farewell = ""  # whoever was gone is back
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
        """Note that the operator is gone: nothing is tracked from now on.

        Frames that come after it begin anew. The reason is `trouble` until they are read, however
        soon that is, so that the operator learns why the robot was let go.
        """
        with self._lock:
            self._connected, self._left, self._farewell = False, True, reason
        self._say(reason)

    @property
    def trouble(self) -> str:
        """Present fault of the stream in words; empty if none."""
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
