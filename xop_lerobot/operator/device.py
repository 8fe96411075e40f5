"""Interface of an XR device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from xop_lerobot.core.command import Mode
from xop_lerobot.operator.display import Display, RecordingRequest, View
from xop_lerobot.operator.frame import OperatorFrame


class Device(ABC):
    """A source of operator frames; all later stages are independent of the device.

    Attributes:
        self_engaging: Whether the device engages by itself once the robot has settled (as
            recordings and scripts do; people use a gesture).
        start_mode: Initial mode, until a frame states one.
    """

    self_engaging: bool = False
    start_mode: Mode = Mode.STATIONARY

    @property
    def trouble(self) -> str:
        """Present fault of the device in words; empty if none."""
        return ""

    def connect(self) -> None:
        """Open the device; a file is read and checked here, before any robot moves."""

    def disconnect(self) -> None:
        """Close the device; may be called twice."""

    def begin_episode(self, index: int) -> None:
        """Prepare episode `index` of a session, reproducibly."""
        del index

    def start(self, time: float) -> None:
        """Start the device's own clock at `time` [s] of the robot's clock (at engage)."""

    @abstractmethod
    def read(self, time: float) -> OperatorFrame | None:
        """Return the newest frame at `time` [s] of the robot's clock, None before the first."""

    def is_finished(self, time: float) -> bool:
        """Whether a recording or script has ended at `time` [s]; people never finish."""
        del time
        return False

    def is_paused(self, time: float) -> bool:
        """Whether the recorded person is disengaged at `time` [s]; the robot holds."""
        del time
        return False

    def see(self, view: View) -> None:
        """Show the robot and its surroundings to a simulated person."""
        del view

    def introduce(self, robot: str, gestures: Mapping[str, str]) -> None:
        """Receive the robot's name and the explanations of the gestures, for display."""
        del robot, gestures

    def show(self, display: Display) -> None:
        """Display robot and recording to the operator, once a tick; headsets only."""
        del display

    def take_requests(self) -> tuple[RecordingRequest, ...]:
        """Return requests to the recorder made by buttons since the last call."""
        return ()
