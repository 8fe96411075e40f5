"""Replay of a recorded person: an `.npz` recording, or the operator columns of a dataset."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path

from xop_lerobot.core.errors import BadValue, NotConnected
from xop_lerobot.operator.dataset_recording import is_dataset, load_dataset_recording
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.recording import Recording, load_recording


class Player(Device):
    """A device that plays content of known duration.

    Its clock stands at 0 until `start`, then runs at `speed`. Frames are stamped by it, so that
    gestures are the same at any playback speed.

    Args:
        config: Device settings.
    """

    self_engaging = True

    def __init__(self, config: DeviceConfig) -> None:
        self.config = config
        self.start_mode = config.start_mode
        self._started_at: float | None = None

    @property
    @abstractmethod
    def duration(self) -> float:
        """Duration of the content [s on its own clock]."""

    @abstractmethod
    def frame_at(self, stamp: float) -> OperatorFrame:
        """Frame at `stamp` [s] of the device's own clock; the outermost ones are held."""

    def start(self, time: float) -> None:
        """Start playing, at `time` [s] of the robot's clock."""
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
        """Whether it has ended and the last frame was held for `hold_s`."""
        if self._started_at is None:
            return False
        played = time - self._started_at - self.duration / self.config.speed
        # Sums of lock-step periods round; a nanosecond of tolerance saves a tick.
        return played >= self.config.hold_s - 1e-9


class ReplayDevice(Player):
    """Plays a recording from engagement on, then holds its last frame.

    Args:
        config: Device settings; `path` is required.

    Raises:
        BadValue: If `path` is missing.
    """

    def __init__(self, config: DeviceConfig) -> None:
        super().__init__(config)
        if not config.path:
            raise BadValue(
                "device 'replay' needs a recording: --teleop.device.path=FILE (an .npz operator "
                "recording or the directory of a recorded dataset)"
            )
        self._recording: Recording | None = None

    def connect(self) -> None:
        """Read and validate the whole recording.

        Raises:
            BadRecording: If it is missing or malformed; names the file and the fault.
        """
        path = Path(self.config.path or "").expanduser()
        if is_dataset(path):
            self._recording = load_dataset_recording(path, self.config.episode)
        else:
            self._recording = load_recording(path)

    @property
    def recording(self) -> Recording:
        """The recording.

        Raises:
            NotConnected: Before `connect()`.
        """
        if self._recording is None:
            raise NotConnected("device 'replay'")
        return self._recording

    @property
    def duration(self) -> float:
        """Length of the recording [s]."""
        return self.recording.duration

    def frame_at(self, stamp: float) -> OperatorFrame:
        """Frame at `stamp` [s] of the recording's clock."""
        return self.recording.frame_at(stamp)

    def is_paused(self, time: float) -> bool:
        """Whether the recorded person was disengaged."""
        return not self.recording.is_engaged_at(self.elapsed(time))
