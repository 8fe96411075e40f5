"""What the operator asks of the episode that is recorded, done as keys do it."""

from __future__ import annotations

from collections.abc import MutableMapping

from xop_lerobot.operator.display import Cue, Wish
from xop_lerobot.recording.tally import Tally


def grant(
    wish: Wish, events: MutableMapping[str, bool], tally: Tally, *, paused: bool, time: float
) -> tuple[Cue, str]:
    """Do what is asked for, or say why not.

    While an episode is recorded, it ends with this tick. In the pause after it, it is not saved
    yet: it can still be marked or discarded. What nobody has driven is no episode: it does not
    end, and a session that stops does not keep it.

    Args:
        wish: What is asked for.
        events: The events of the recording loop; they are set here.
        tally: Of the episode.
        paused: Whether this is the pause after the episode.
        time: The robot's clock [s].

    Returns:
        What the operator is told: that it is done, or `Cue.REFUSED` and why not.
    """
    match wish:
        case Wish.SUCCESS:
            return _mark(events, tally, paused, time)
        case Wish.END:
            return _end(events, tally, paused)
        case Wish.REDO:
            if paused and events["rerecord_episode"]:
                return Cue.REFUSED, "The episode has been discarded already."
            events["rerecord_episode"] = events["exit_early"] = True
            return Cue.REDO, "Redo: the episode is discarded, and recorded again."
        case Wish.STOP:
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
