"""Play a recorded person: an `.npz` recording, or the operator's columns of a dataset."""

from __future__ import annotations

from pathlib import Path

from xop_lerobot.core.errors import BadValue, NotConnected
from xop_lerobot.operator.dataset_recording import is_dataset, load_dataset_recording
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.devices.player import Player
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.recording import Recording, load_recording


class ReplayDevice(Player):
    """Plays a recording from the moment of engaging, then holds its last frame.

    Args:
        config: Its settings; `path` is required.

    Raises:
        BadValue: If there is no path.
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
        """Read and check the whole recording.

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
        """What is played.

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
        """Whether the person of the recording had let go of their robot."""
        return not self.recording.is_engaged_at(self.elapsed(time))
