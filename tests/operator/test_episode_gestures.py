"""Gestures through LeRobot's own recording and `xop-record`: what becomes of the episodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import toy_robot  # noqa: F401  registers the toy
from lerobot.datasets import LeRobotDataset

from tests.recording.test_lerobot_cli import ROBOT, record_flags, run
from xop_lerobot.core.transforms import make_pose, quat_from_rpy
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices import DEVICES, DeviceConfig
from xop_lerobot.operator.display import Cue, Display, RecordingRequest
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.recording.facts import read_facts
from xop_lerobot.recording.requests import EpisodeCounts, grant

POSTURES = {
    "rest": (quat_from_rpy(0, 0, 0), 1.1),
    "palms up": (quat_from_rpy(np.pi, 0, 0), 1.1),
    "halt": (quat_from_rpy(0, -np.pi / 2, 0), 1.35),
}
# What the hands do from which time of an attempt on [s]: posture, and whether each is closed.
ENGAGE = [(0.0, "palms up", 0, 0), (0.2, "palms up", 1, 1), (1.0, "rest", 0, 0)]
END = [(1.2, "right halt", 0, 0), (1.4, "right halt", 0, 1), (1.8, "rest", 0, 0)]
REDO = [(1.2, "left halt", 0, 0), (1.4, "left halt", 1, 0), (2.0, "rest", 0, 0)]
STOP = [(1.2, "both halt", 0, 0), (1.4, "both halt", 1, 1), (2.0, "rest", 0, 0)]
MARK = [(1.6, "rest", 0, 1), (1.72, "rest", 0, 0), (1.88, "rest", 0, 1), (2.0, "rest", 0, 0)]


def later(steps: list, by: float) -> list:
    return [(t + by, *rest) for t, *rest in steps]


ON = later(END, 2.2)


class Puppet(Device):
    """A person who does in each attempt what the next of `plans` says."""

    plans: list[list] = []
    shown: list[Display] = []

    def __init__(self, config: DeviceConfig) -> None:
        self._attempt, self._start, self._last = -1, 0.0, np.inf

    def read(self, time: float) -> OperatorFrame:
        if time < self._last:
            self._attempt, self._start = self._attempt + 1, time
        self._last, time = time, time - self._start
        plan = self.plans[min(self._attempt, len(self.plans) - 1)]
        _, what, *closed = [step for step in plan if step[0] <= time + 1e-6][-1]
        wrists = []
        for side, y in (("left", 0.25), ("right", -0.25)):
            posture = what if what in POSTURES else "rest"
            if what in (f"{side} halt", "both halt"):
                posture = "halt"
            quat, height = POSTURES[posture]
            wrists.append(make_pose(np.array([0.35, y, height]), quat))
        head = make_pose(np.array([0, 0, 1.6]), POSTURES["rest"][0])
        return OperatorFrame(self._last, head, *wrists, pinch=np.where(closed, 0.008, 0.07))

    def show(self, display: Display) -> None:
        self.shown.append(display)


@pytest.fixture(autouse=True)
def puppet() -> Iterator[None]:
    DEVICES.add("puppet", Puppet)
    Puppet.plans, Puppet.shown = [], []
    yield
    DEVICES.remove("puppet")


TELEOP = (
    "--teleop.type=xop", "--teleop.device.type=puppet", "--teleop.retargeter.type=direct",
    "--teleop.gestures.clutch.hold=0.2", "--teleop.gestures.raised.hold=0.2",
    "--teleop.gestures.raised.long_hold=0.4",
)  # fmt: skip
COMMANDS = pytest.mark.parametrize("command", ["lerobot-record", "xop-record"])


def record(monkeypatch, command: str, root: Path, *plans: list, **dataset) -> list[dict]:
    """Record as the puppet's `plans` have it; return the facts of the episodes."""
    Puppet.plans = [ENGAGE + plan for plan in plans]
    settings = {"num_episodes": 9, "episode_time_s": 9, "reset_time_s": 120} | dataset
    flags = [*ROBOT, *TELEOP, *record_flags(root, **settings), "--play_sounds=false"]
    if command == "lerobot-record":  # lock-step needs no real time, though its loop takes it
        monkeypatch.setattr("lerobot.scripts.lerobot_record.precise_sleep", lambda _: None)
    run(monkeypatch, command, *flags)
    return read_facts(root)


def told() -> list[str]:
    """What the puppet was told, each once, without engaging and letting go."""
    notices = {notice.number: notice for display in Puppet.shown for notice in display.notices}
    return [n.text for n in notices.values() if n.cue not in (Cue.ENGAGED, Cue.DISENGAGED)]


@pytest.mark.slow
@COMMANDS
def test_end_redo_mark_and_stop(tmp_path, monkeypatch, command):
    """Saved, discarded and recorded again, saved as a success, saved and the session ended."""
    root = tmp_path / "data"
    plans = (END + ON, REDO + ON, MARK + later(END, 1.6) + later(ON, 0.6), STOP)
    more = ["--stop_on_success=false"] if command == "xop-record" else []
    monkeypatch.setattr(f"{__name__}.TELEOP", (*TELEOP, *more))
    facts = record(monkeypatch, command, root, *plans)
    assert [row["success"] for row in facts] == [False, True, False]
    # The clock of a tick is that of its beginning; the robot settles within 1 s of its own.
    assert [row["length"] for row in facts] == pytest.approx([41, 81, 46], abs=3)
    (change,) = [each for each in facts[1]["changes"] if each["source"] == "operator"]
    assert change["change"] == {"success": True}
    assert 0 < change["frame"] < facts[1]["length"]
    dataset = LeRobotDataset("local/toy", root=root)
    success = np.ravel(dataset.hf_dataset["next.success"])
    ends = np.cumsum([row["length"] for row in facts])
    assert list(np.flatnonzero(success)) == [ends[1] - 1]
    pauses = ["The pause is over: the next episode begins."] * (command == "lerobot-record")
    assert told() == [
        "End: the episode is saved.", *pauses,
        "Redo: the episode is discarded, and recorded again.", *pauses,
        "The episode is marked as a success.", "End: the episode is saved.", *pauses,
        "Stop: the episode is saved, and the session ends.",
    ]  # fmt: skip
    assert {display.holding for display in Puppet.shown} == {
        "", "Keep holding to engage", "Keep holding to end the episode",
        "Keep holding to discard the episode", "Keep holding to stop the session",
    }  # fmt: skip


@pytest.mark.slow
def test_in_the_pause_an_episode_can_still_be_marked_and_discarded(tmp_path, monkeypatch):
    pause = later(MARK, 1.6) + later(END, 3.5)
    plans = (END + pause, END + later(REDO, 2.0), END + later(STOP, 2.0))
    facts = record(monkeypatch, "lerobot-record", tmp_path / "data", *plans)
    assert [row["success"] for row in facts] == [True, False]
    dataset = LeRobotDataset("local/toy", root=tmp_path / "data")
    success = np.ravel(dataset.hf_dataset["next.success"])
    assert list(np.flatnonzero(success)) == [facts[0]["length"] - 1]
    assert any(d.progress is not None and d.progress.paused for d in Puppet.shown)


@pytest.mark.slow
def test_a_mark_ends_the_episode_where_a_success_does(tmp_path, monkeypatch):
    facts = record(monkeypatch, "xop-record", tmp_path / "data", MARK, num_episodes=1)
    assert [row["success"] for row in facts] == [True]
    assert facts[0]["length"] < 70


@pytest.mark.slow
@COMMANDS
def test_what_nobody_has_driven_is_no_episode(tmp_path, monkeypatch, command):
    Puppet.plans = []
    rest = [(0.0, "rest", 0, 0)]
    monkeypatch.setattr(f"{__name__}.ENGAGE", rest)
    facts = record(monkeypatch, command, tmp_path / "data", END + later(STOP, 1.5))
    assert facts == []
    assert told() == [
        "Not ended: nothing has been driven in this episode yet.",
        "Stop: the session ends. Nothing was driven in this episode: it is not kept.",
    ]


# -- what is granted -----------------------------------------------------------------------


def make_tally(**fields) -> EpisodeCounts:
    counts = EpisodeCounts()
    counts.frames = 10
    for name, value in ({"driven": True} | fields).items():
        setattr(counts, name, value)
    return counts


def ask(
    request: RecordingRequest, counts: EpisodeCounts | None = None, *, paused=False, discarded=False
):
    events = {"exit_early": False, "rerecord_episode": discarded, "stop_recording": False}
    cue, text = grant(request, events, counts or make_tally(), paused=paused, time=0.4)
    return cue, text, {name for name, value in events.items() if value}


def test_requests_are_granted_as_keys_are():
    assert ask(RecordingRequest.END)[2] == {"exit_early"}
    assert ask(RecordingRequest.REDO)[2] == {"exit_early", "rerecord_episode"}
    assert ask(RecordingRequest.STOP)[2] == {"exit_early", "stop_recording"}
    assert ask(RecordingRequest.SUCCESS)[2] == set()


def test_a_second_mark_takes_the_first_one_off():
    counts = make_tally()
    for success, text in (
        (True, "The episode is marked as a success."),
        (False, "The episode is not marked as a success any more."),
    ):
        assert ask(RecordingRequest.SUCCESS, counts)[:2] == (Cue.SUCCESS, text)
        assert (counts.success, counts.marked) == (success, success)
    # Also where the task itself has found a success that is none.
    counts = make_tally(success=True)
    ask(RecordingRequest.SUCCESS, counts)
    assert counts.success is False
    assert [each["change"] for each in counts.changes] == [{"success": False}]


def test_what_is_refused_says_why():
    idle = make_tally(driven=False)
    assert ask(RecordingRequest.END, idle) == (
        Cue.REFUSED, "Not ended: nothing has been driven in this episode yet.", set()
    )  # fmt: skip
    assert ask(RecordingRequest.SUCCESS, idle)[0] is Cue.REFUSED
    assert ask(RecordingRequest.REDO, idle)[0] is Cue.REDO  # the robot may have fallen by itself
    for request, text in (
        (RecordingRequest.SUCCESS, "Not marked: the episode has been discarded."),
        (RecordingRequest.REDO, "The episode has been discarded already."),
    ):
        told = ask(request, paused=True, discarded=True)
        assert told == (Cue.REFUSED, text, {"rerecord_episode"})
    assert ask(RecordingRequest.STOP, paused=True, discarded=True)[1] == "Stop: the session ends."
