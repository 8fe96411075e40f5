"""Measures the delay of a headset's frames, and warns of it."""

from __future__ import annotations

import statistics
from collections import deque

WINDOW_S = 1.0
"""Time window of the delay [s]."""
MAX_FRAMES = 400
"""Largest number of frames kept in the window."""
SLOW_S = 0.15
"""Delay above which an operator notices it [s]."""
GROWN_S = 0.08
"""Increase over the connection's smallest delay that is reported [s]."""


class DelayMeter:
    """Measures the delay over the last second.

    Args:
        limit: Delay above which frames are dropped on arrival [s].
    """

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._frames: deque[tuple[float, float, bool]] = deque(maxlen=MAX_FRAMES)
        self._smallest = float("inf")

    def reset(self) -> None:
        """Forget everything, as after a new connection."""
        self._frames.clear()
        self._smallest = float("inf")

    def take(self, time: float, delay: float, error: float) -> bool:
        """Record a frame.

        Args:
            time: Time of arrival [s].
            delay: Its age on arrival [s].
            error: Uncertainty of the age [s].

        Returns:
            Whether it is, or may be, too late to be used.
        """
        late = delay + error > self._limit
        self._frames.append((time, delay, late))
        self._forget(time)
        self._smallest = min(self._smallest, statistics.median(d for _, d, _ in self._frames))
        return late

    def _forget(self, time: float) -> None:
        while self._frames and self._frames[0][0] < time - WINDOW_S:
            self._frames.popleft()

    def measure(self, time: float) -> float | None:
        """Median delay in the second before `time` [s]; None without frames."""
        self._forget(time)
        return statistics.median(d for _, d, _ in self._frames) if self._frames else None

    def describe(self, time: float) -> str:
        """Warning about the delay; empty if none."""
        delay = self.measure(time)
        if delay is None:
            return ""
        if self._frames[-1][2]:
            delay = statistics.median(d for _, d, late in self._frames if late)
            return (
                f"the headset's stream is {delay * 1e3:.0f} ms late and is not followed beyond "
                f"{self._limit * 1e3:.0f} ms: free the network, or raise device.max_delay_s"
            )
        if delay > SLOW_S:
            return f"the headset's stream is {delay * 1e3:.0f} ms late: move slowly"
        if delay > self._smallest + GROWN_S:
            return (
                f"the delay of the headset's stream has grown from {self._smallest * 1e3:.0f} to "
                f"{delay * 1e3:.0f} ms"
            )
        return ""
