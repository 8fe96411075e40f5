"""The interface of an XR device and the registry of devices."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from xop_lerobot.core.command import Mode
from xop_lerobot.operator.display import Display, View, Wish
from xop_lerobot.operator.frame import OperatorFrame


class Device(ABC):
    """A source of operator frames. Nothing behind it knows which device it was.

    Attributes:
        self_engaging: Whether the device engages by itself once the robot has settled
            (recordings and scripts do; people use a gesture).
        start_mode: The mode in which the operator starts, as long as no frame states one.
    """

    self_engaging: bool = False
    start_mode: Mode = Mode.STATIONARY

    @property
    def trouble(self) -> str:
        """What is wrong with the device now, in words; empty if nothing is."""
        return ""

    def connect(self) -> None:
        """Open the device; a file is read and checked here, before any robot moves."""

    def disconnect(self) -> None:
        """Close the device; may be called twice."""

    def begin_episode(self, index: int) -> None:
        """Be told that episode `index` of a session begins, so that it is the same every time."""
        del index

    def start(self, time: float) -> None:
        """Start the device's own clock at `time` [s] of the robot's clock (at engage)."""

    @abstractmethod
    def read(self, time: float) -> OperatorFrame | None:
        """Return the newest frame at `time` [s] of the robot's clock, None before the first."""

    def is_finished(self, time: float) -> bool:
        """Whether a recording or script has played out at `time`; people never finish."""
        del time
        return False

    def is_paused(self, time: float) -> bool:
        """Whether the person, though seen, lets go of the robot for now; the robot holds."""
        del time
        return False

    def see(self, view: View) -> None:
        """Look at the robot and what is about it; only a simulated person needs to."""
        del view

    def introduce(self, robot: str, gestures: Mapping[str, str]) -> None:
        """Be told the name of the robot and, by name, how to ask for what; headsets tell it."""
        del robot, gestures

    def show(self, display: Display) -> None:
        """Show the wearer the robot and the recording, once a tick; only headsets can."""
        del display

    def take_wishes(self) -> tuple[Wish, ...]:
        """What was asked for of the recording, by buttons, since the last call."""
        return ()
