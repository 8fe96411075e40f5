"""Content of a headset's display, notices, and the operator's requests to the recorder."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.paced_log import PacedLog

logger = logging.getLogger(__name__)

MAX_ALIKE = 2
"""Largest number of kept notices of one cue."""


class Cue(Enum):
    """Kind of a notice; headsets play a sound for each."""

    ENGAGED = "engaged"
    DISENGAGED = "disengaged"
    REFUSED = "refused"
    MODE = "mode"
    SETTING = "setting"
    END = "end"
    REDO = "redo"
    STOP = "stop"
    SUCCESS = "success"


class RecordingRequest(Enum):
    """Request of the operator concerning the episode being recorded."""

    END = "end"
    """Save it, and continue with the next."""
    REDO = "redo"
    """Discard it and record it again."""
    STOP = "stop"
    """Save it and end the session."""
    SUCCESS = "success"
    """Mark it as a success, or remove the mark."""


@dataclass(frozen=True)
class Notice:
    """One notice to the operator.

    Attributes:
        number: Running number, so that each notice is shown and sounded once.
        cue: Kind of the event.
        text: Description of the event.
    """

    number: int
    cue: Cue
    text: str


class NoticeBoard:
    """The last notices, numbered consecutively.

    At most `MAX_ALIKE` notices of one cue are kept, so that frequent events, such as settings
    changed by a program, do not displace all others; the log is rate-limited for the same reason.
    """

    def __init__(self, length: int = 5) -> None:
        self._notices: deque[Notice] = deque(maxlen=length)
        self._count = 0
        self._log = PacedLog(logger)

    def post(self, cue: Cue, text: str) -> None:
        """Add a notice."""
        self._count += 1
        alike = [notice for notice in self._notices if notice.cue is cue]
        if len(alike) >= MAX_ALIKE:
            self._notices.remove(alike[0])
        self._notices.append(Notice(self._count, cue, text))

    def tell(self, cue: Cue, text: str) -> None:
        """Add a notice, and log it to the terminal."""
        self._log.info(text)
        self.post(cue, text)

    @property
    def notices(self) -> tuple[Notice, ...]:
        """The latest notices, newest last."""
        return tuple(self._notices)


@dataclass(frozen=True)
class Progress:
    """Progress of a recording.

    Attributes:
        episode: Index of the episode that is recorded.
        frames: Number of its frames so far.
        seconds: Its duration so far [s].
        success: Whether it counts as a success so far.
        paused: Whether this is the pause after the episode, which is not saved yet.
    """

    episode: int
    frames: int
    seconds: float
    success: bool
    paused: bool = False


@dataclass(frozen=True)
class Display:
    """Content of a headset's display for one tick.

    Attributes:
        time: Clock of the robot [s].
        engaged: Whether the operator is engaged.
        mode: Mode of the robot.
        clutch: Completed share of the current gesture's hold, from 0 to 1.
        holding: Effect of the current gesture, as text; empty without one.
        notices: Latest notices, newest last.
        warnings: Present warnings, as text.
        fallen: Whether the robot has fallen.
        progress: Progress of the recording, None without one.
        pictures: Camera images by name. Shapes (height, width, 3), uint8.
    """

    time: float
    engaged: bool = False
    mode: Mode = Mode.STATIONARY
    clutch: float = 0.0
    holding: str = ""
    notices: tuple[Notice, ...] = ()
    warnings: tuple[str, ...] = ()
    fallen: bool = False
    progress: Progress | None = None
    pictures: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class SeenObject:
    """An object in the robot's world.

    Attributes:
        pose: Pose of its centre in the robot's world, x y z qw qx qy qz. Shape (7,).
        size: Half extents along its own axes; zero for a point [m]. Shape (3,).
    """

    pose: np.ndarray
    size: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class View:
    """True content that a headset could show; the simulated person adds perception errors.

    Attributes:
        time: Clock of the robot [s].
        task: Name of the running task; empty without one.
        frames: Pose of the robot's `head`, `left_wrist`, `right_wrist`, `left_palm` and
            `right_palm`, robot's world. Shapes (7,).
        objects: Objects of the task, by name.
        mode: Mode of the robot, as displayed.
        engaged: Whether the operator is engaged, as displayed.
        fallen: Whether the robot has fallen.
        success: Whether the task is accomplished.
        hints: Knowledge of a practised person, by name (docs/use/tasks.md) [m].
    """

    time: float
    task: str
    frames: Mapping[str, np.ndarray]
    objects: Mapping[str, SeenObject] = field(default_factory=dict)
    mode: Mode = Mode.STATIONARY
    engaged: bool = False
    fallen: bool = False
    success: bool = False
    hints: Mapping[str, float] = field(default_factory=dict)
