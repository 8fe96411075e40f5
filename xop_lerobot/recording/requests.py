"""What the operator asks of the episode that is recorded, done as keys do it."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Any

import numpy as np

from xop_lerobot.core.state import RobotState
from xop_lerobot.operator.display import Cue, RecordingRequest
from xop_lerobot.session import Tick


class Tally:
    """Counts, times and flags of the episode that is being recorded.

    Attributes:
        frames: Frames so far.
        start_time: Host clock at the first frame [s since the epoch].
        first: Performance counter at the first frame [s].
        last: The same at the last frame [s].
        success: Whether the task is accomplished.
        marked: The same as the operator has marked it, None where nobody has.
        driven: Whether somebody has driven the robot.
        fallen: Whether the robot fell.
        collision: Whether it touched anything but the ground.
        finished: Whether the operator's recording has played out.
        task: The task in words.
        settings: What was in force at the first frame.
        changes: What came into force, or went wrong with the robot, and with which frame.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.start_time = 0.0
        self.last = self.first = 0.0
        self.success = self.fallen = self.collision = self.finished = False
        self.marked: bool | None = None
        self.driven = False
        self.task = ""
        self.settings: dict[str, Any] = {}
        self.changes: list[dict[str, Any]] = []
        self._trouble = ""

    def note_changes(self, tick: Tick) -> None:
        """Take down what came into force with the frame that is being added."""
        if self.frames == 0:
            self.settings = dict(tick.settings)
        for change in tick.changes:
            self.changes.append({"frame": self.frames, "time": tick.state.time, **change.to_dict()})

    def note_state(self, state: RobotState) -> None:
        """Take down what has become of the robot by the frame that is being added."""
        self.fallen |= state.fallen
        self.collision |= state.collision
        if state.trouble and state.trouble != self._trouble:
            self._note(self.frames, state.time, "robot", {"trouble": state.trouble})
        self._trouble = state.trouble

    def mark(self, success: bool, time: float) -> None:
        """Take down what the operator says of the episode, at `time` [s] of the robot's clock."""
        self.marked = self.success = success
        self._note(max(self.frames - 1, 0), time, "operator", {"success": success})

    def write_mark(self, buffer: Mapping[str, Any]) -> None:
        """Bring `next.success` in line with the operator's mark, as `xop-curate label` does.

        Args:
            buffer: The rows of the episode that are not saved yet, by column.
        """
        rows = buffer.get("next.success")
        if self.marked is None or not rows:
            return
        rows[:] = [row if self.marked else np.zeros_like(row) for row in rows]
        rows[-1] = np.full_like(rows[-1], self.marked)

    def _note(self, frame: int, time: float, source: str, change: dict[str, Any]) -> None:
        self.changes.append({"frame": frame, "time": time, "source": source, "change": change})

    @property
    def fps(self) -> float:
        """Frames per second of the host clock, 0 for a single frame."""
        span = self.last - self.first
        return (self.frames - 1) / span if span > 0 else 0.0


def grant(
    request: RecordingRequest,
    events: MutableMapping[str, bool],
    tally: Tally,
    *,
    paused: bool,
    time: float,
) -> tuple[Cue, str]:
    """Do what is asked for, or say why not.

    While an episode is recorded, it ends with this tick. In the pause after it, it is not saved
    yet: it can still be marked or discarded. What nobody has driven is no episode: it does not
    end, and a session that stops does not keep it.

    Args:
        request: What is asked for.
        events: The events of the recording loop; they are set here.
        tally: Of the episode.
        paused: Whether this is the pause after the episode.
        time: The robot's clock [s].

    Returns:
        What the operator is told: that it is done, or `Cue.REFUSED` and why not.
    """
    match request:
        case RecordingRequest.SUCCESS:
            return _mark(events, tally, paused, time)
        case RecordingRequest.END:
            return _end(events, tally, paused)
        case RecordingRequest.REDO:
            if paused and events["rerecord_episode"]:
                return Cue.REFUSED, "The episode has been discarded already."
            events["rerecord_episode"] = events["exit_early"] = True
            return Cue.REDO, "Redo: the episode is discarded, and recorded again."
        case RecordingRequest.STOP:
            return _stop(events, tally, paused)


def _mark(
    events: MutableMapping[str, bool], tally: Tally, paused: bool, time: float
) -> tuple[Cue, str]:
    if paused and events["rerecord_episode"]:
        return Cue.REFUSED, "Not marked: the episode has been discarded."
    if not tally.driven:
        return Cue.REFUSED, "Not marked: nothing has been driven in this episode yet."
    tally.mark(not tally.success, time)
    if tally.success:
        return Cue.SUCCESS, "The episode is marked as a success."
    return Cue.SUCCESS, "The episode is not marked as a success any more."


def _end(events: MutableMapping[str, bool], tally: Tally, paused: bool) -> tuple[Cue, str]:
    if paused:
        events["exit_early"] = True
        return Cue.END, "The pause is over: the next episode begins."
    if not tally.driven:
        return Cue.REFUSED, "Not ended: nothing has been driven in this episode yet."
    events["exit_early"] = True
    return Cue.END, "End: the episode is saved."


def _stop(events: MutableMapping[str, bool], tally: Tally, paused: bool) -> tuple[Cue, str]:
    events["stop_recording"] = events["exit_early"] = True
    if paused and events["rerecord_episode"]:
        return Cue.STOP, "Stop: the session ends."
    if tally.driven:
        return Cue.STOP, "Stop: the episode is saved, and the session ends."
    events["rerecord_episode"] = True  # that is how the loops leave an episode out
    return Cue.STOP, "Stop: the session ends. Nothing was driven in this episode: it is not kept."
