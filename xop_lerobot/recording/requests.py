"""Requests of the operator about the episode being recorded, mapped to LeRobot's key events."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Any

import numpy as np

from xop_lerobot.core.state import RobotState
from xop_lerobot.operator.display import Cue, RecordingRequest
from xop_lerobot.session import Tick


class EpisodeCounts:
    """Counts, times and flags of the episode being recorded.

    Attributes:
        frames: Number of frames so far.
        start_time: Host clock at the first frame [s since the epoch].
        first: Performance counter at the first frame [s].
        last: Performance counter at the latest frame [s].
        success: Whether the task is accomplished, or marked so.
        marked: Success as marked by the operator, None if unmarked.
        driven: Whether an operator was ever engaged.
        fallen: Whether the robot fell.
        collision: Whether it touched itself, or anything but the ground.
        finished: Whether the operator's recording has played out.
        task: Task description.
        settings: Settings at the first frame.
        changes: Changes of settings and troubles of the robot, with frame and time.
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
        """Record the changes of settings that take effect with the frame being added."""
        if self.frames == 0:
            self.settings = dict(tick.settings)
        for change in tick.changes:
            self.changes.append({"frame": self.frames, "time": tick.state.time, **change.to_dict()})

    def note_state(self, state: RobotState) -> None:
        """Record falls, collisions and troubles of the robot in the frame being added."""
        self.fallen |= state.fallen
        self.collision |= state.collision
        if state.trouble and state.trouble != self._trouble:
            self._note(self.frames, state.time, "robot", {"trouble": state.trouble})
        self._trouble = state.trouble

    def mark(self, success: bool, time: float) -> None:
        """Record the operator's mark of success at `time` [s] of the robot's clock."""
        self.marked = self.success = success
        self._note(max(self.frames - 1, 0), time, "operator", {"success": success})

    def write_mark(self, buffer: Mapping[str, Any]) -> None:
        """Set `next.success` to the operator's mark, as `xop-curate label` does.

        Args:
            buffer: Unsaved rows of the episode, by column.
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
    counts: EpisodeCounts,
    *,
    paused: bool,
    time: float,
) -> tuple[Cue, str]:
    """Fulfil a request of the operator, or refuse it with a reason.

    A request to end takes effect with this control step. During the pause after an episode, the
    episode is not saved yet, so it can still be marked or discarded. An episode in which nobody was
    engaged is empty: it does not end on request, and is not kept if the session stops.

    Args:
        request: The request.
        events: Events of the recording loop; set here.
        counts: Counts of the episode.
        paused: Whether this is the pause after an episode.
        time: The robot's clock [s].

    Returns:
        Notice for the operator: what was done, or `Cue.REFUSED` and the reason.
    """
    match request:
        case RecordingRequest.SUCCESS:
            return _mark(events, counts, paused, time)
        case RecordingRequest.END:
            return _end(events, counts, paused)
        case RecordingRequest.REDO:
            if paused and events["rerecord_episode"]:
                return Cue.REFUSED, "The episode has been discarded already."
            events["rerecord_episode"] = events["exit_early"] = True
            return Cue.REDO, "Redo: the episode is discarded, and recorded again."
        case RecordingRequest.STOP:
            return _stop(events, counts, paused)


def _mark(
    events: MutableMapping[str, bool], counts: EpisodeCounts, paused: bool, time: float
) -> tuple[Cue, str]:
    if paused and events["rerecord_episode"]:
        return Cue.REFUSED, "Not marked: the episode has been discarded."
    if not counts.driven:
        return Cue.REFUSED, "Not marked: nothing has been driven in this episode yet."
    counts.mark(not counts.success, time)
    if counts.success:
        return Cue.SUCCESS, "The episode is marked as a success."
    return Cue.SUCCESS, "The episode is not marked as a success any more."


def _end(events: MutableMapping[str, bool], counts: EpisodeCounts, paused: bool) -> tuple[Cue, str]:
    if paused:
        events["exit_early"] = True
        return Cue.END, "The pause is over: the next episode begins."
    if not counts.driven:
        return Cue.REFUSED, "Not ended: nothing has been driven in this episode yet."
    events["exit_early"] = True
    return Cue.END, "End: the episode is saved."


def _stop(
    events: MutableMapping[str, bool], counts: EpisodeCounts, paused: bool
) -> tuple[Cue, str]:
    events["stop_recording"] = events["exit_early"] = True
    if paused and events["rerecord_episode"]:
        return Cue.STOP, "Stop: the session ends."
    if counts.driven:
        return Cue.STOP, "Stop: the episode is saved, and the session ends."
    events["rerecord_episode"] = True  # makes LeRobot's loops discard the episode
    return Cue.STOP, "Stop: the session ends. Nothing was driven in this episode: it is not kept."
