"""The clock that recordings and scripts share: start, speed, hold at the end, finish."""

from __future__ import annotations

from abc import abstractmethod

from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.frame import OperatorFrame


class Player(Device):
    """A device that plays something of known length.

    Its clock stands at 0 until `start`, then runs at `speed`. Frames are stamped with it, so
    that gestures come out the same at any playback speed.

    Args:
        config: Its settings.
    """

    self_engaging = True

    def __init__(self, config: DeviceConfig) -> None:
        self.config = config
        self.start_mode = config.start_mode
        self._started_at: float | None = None

    @property
    @abstractmethod
    def duration(self) -> float:
        """Length of what is played [s on its own clock]."""

    @abstractmethod
    def frame_at(self, stamp: float) -> OperatorFrame:
        """Frame at `stamp` [s] of the device's own clock; beyond the ends the outermost one."""

    def start(self, time: float) -> None:
        """Play from the beginning, at `time` [s] of the robot's clock."""
        self._started_at = time

    def elapsed(self, time: float) -> float:
        """The device's own clock [s] at `time` [s] of the robot's."""
        if self._started_at is None:
            return 0.0
        return (time - self._started_at) * self.config.speed

    def read(self, time: float) -> OperatorFrame:
        """Return the frame at `time` [s] of the robot's clock."""
        return self.frame_at(self.elapsed(time))

    def is_finished(self, time: float) -> bool:
        """Whether it has played out and the last frame was held for `hold_s`."""
        if self._started_at is None:
            return False
        played = time - self._started_at - self.duration / self.config.speed
        # Lock-step clocks add up rounding; a nanosecond must not cost a tick.
        return played >= self.config.hold_s - 1e-9
