"""What the operator is told: changes as they come into force, and what is wrong."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import pytest

from tests.test_teleoperation import Person, Rig, make_frame
from xop_lerobot.core.command import Mode
from xop_lerobot.core.paced_log import PacedLog
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices import DEVICES, DeviceConfig
from xop_lerobot.operator.devices.live import LiveDevice
from xop_lerobot.operator.display import Cue, NoticeBoard
from xop_lerobot.operator.feedback import describe_settings, list_warnings, tell_changes
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.retarget.changes import Change
from xop_lerobot.retarget.online import AppliedChange


class Fake(Device):
    def __init__(self, trouble: str = "") -> None:
        self._trouble = trouble

    @property
    def trouble(self) -> str:
        return self._trouble

    def read(self, time: float) -> OperatorFrame | None:
        return None


def warn(*, tracked=(1, 1, 1), engaged=True, plan_age=None, trouble="", device=None):
    device = device or Fake(trouble)
    frame = dataclasses.replace(make_frame(0.0, (0, 0, 1.6)), tracked=np.array(tracked, dtype=bool))
    return list_warnings(device, frame, engaged=engaged, plan_age=plan_age)


def test_nothing_is_wrong():
    assert warn() == ()
    assert warn(plan_age=0.2) == ()
    assert list_warnings(Fake(), None, engaged=False, plan_age=None) == ()


def test_hands_and_head_that_are_not_seen():
    assert warn(tracked=(1, 0, 1)) == ("Your left hand is not seen: its arm stands still.",)
    assert warn(tracked=(1, 1, 0), engaged=False) == ("Your right hand is not seen.",)
    assert warn(tracked=(1, 0, 0)) == ("Your hands are not seen: the arms stand still.",)
    assert warn(tracked=(0, 0, 0)) == ("The headset has lost its position, or sends nothing.",)
    # Where the device knows better, that is told.
    assert warn(tracked=(0, 0, 0), trouble="it was taken off") == ("it was taken off",)


def test_a_late_plan():
    (late,) = warn(plan_age=0.52)
    assert late == "The plan is 0.5 s old: this computer is too slow for the planner."


class Headset(LiveDevice):
    @property
    def address(self) -> str:
        return "nowhere"

    def stream(self) -> None: ...
    def interrupt(self) -> None: ...


def test_a_slow_stream():
    device = Headset(DeviceConfig(), clock=lambda: now)
    for i in range(12):
        now = 1 + i / 12
        device.receive(make_frame(now, (0.001 * i, 0, 1.6)))
    assert warn(device=device) == ("Only 12 poses per second arrive: gestures need 25.",)


def watch_hands(left_hz: float, right_hz: float, seconds: float = 2.0) -> list[tuple[str, ...]]:
    """What is told in the last second while the head moves 90 times a second.

    A hand stands between its changes, as a Vision Pro shows it; the left one is gone at 1 s if
    it has none.
    """
    device = Headset(DeviceConfig(), clock=lambda: now)
    told = []
    for i in range(round(90 * seconds)):
        now = 1 + i / 90
        frame = make_frame(now, (0, 0, 1.6))
        hands = (frame.left_wrist, left_hz), (frame.right_wrist, right_hz)
        wrists = [
            pose + [1e-3 * np.floor(i * hz / 90 if hz else min(i, 90)), 0, 0, 0, 0, 0, 0]
            for pose, hz in hands
        ]
        head = frame.head + [0.001 * np.sin(0.1 * i), 0, 0, 0, 0, 0, 0]
        device.receive(
            dataclasses.replace(frame, head=head, left_wrist=wrists[0], right_wrist=wrists[1])
        )
        if i >= 90:
            shown = device.read(0.0)
            assert shown is not None
            told.append(warn(device=device, tracked=shown.tracked))
    return told


@pytest.mark.parametrize(
    ("left_hz", "right_hz", "hands", "hz"),
    [(9, 9, "hands", 9), (9, 90, "left hand", 9), (90, 11, "right hand", 11)],
)
def test_hands_that_are_shown_too_seldom(left_hz, right_hz, hands, hz):
    assert set(watch_hands(left_hz, right_hz)) == {
        (
            f"The headset updates your {hands} only {hz} times a second; at least 13 are needed. "
            "Hold them in view, in good light, and close other apps.",
        )
    }


@pytest.mark.parametrize("hz", [14, 30, 90])
def test_hands_that_are_shown_often_enough(hz):
    assert set(watch_hands(hz, hz)) == {()}


def test_a_hand_that_goes_out_of_view_is_lost_and_not_slow():
    told = watch_hands(0, 90)
    assert set(told) == {(), ("Your left hand is not seen: its arm stands still.",)}
    assert told[-1] != ()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (Change(mode=Mode.MOBILE), ""),
        (Change(constraints={"upright": True}), "Constraint upright on"),
        (Change(preset="conservative"), "Preset conservative"),
        (
            Change(weights={"position": 2.5}, preset="default"),
            "Preset default; weight position 2.5",
        ),
        (Change(targets=("head",), body=()), "Targets head; body whole"),
    ],
)
def test_changes_in_words(change, text):
    assert describe_settings(change) == text


def test_each_change_has_its_cue(caplog):
    board = NoticeBoard()
    both = Change(mode=Mode.MOBILE, constraints={"upright": False})
    with caplog.at_level(logging.INFO):
        tell_changes(board, [AppliedChange("gesture", both)])
    assert [(n.cue, n.text) for n in board.notices] == [
        (Cue.MODE, "Mode: mobile."),
        (Cue.SETTING, "Constraint upright off."),
    ]
    assert "Mode: mobile." in caplog.text


def test_a_tick_tells_of_all_its_settings_at_once():
    board = NoticeBoard()
    changes = [
        AppliedChange("key", Change(preset="conservative", mode=Mode.MOBILE)),
        AppliedChange("control", Change(constraints={"upright": True})),
    ]
    tell_changes(board, changes)
    assert [(n.cue, n.text) for n in board.notices] == [
        (Cue.MODE, "Mode: mobile."),
        (Cue.SETTING, "Preset conservative. Constraint upright on."),
    ]


def test_what_happens_all_the_time_drives_nothing_else_from_the_board():
    board = NoticeBoard()
    board.post(Cue.REDO, "Discarded.")
    for i in range(100):
        board.post(Cue.SETTING, f"Weight position {i}.")
        board.post(Cue.MODE, f"Mode {i}.")
    assert [n.text for n in board.notices] == [
        "Discarded.",
        *("Weight position 98.", "Mode 98.", "Weight position 99.", "Mode 99."),
    ]
    assert [n.number for n in board.notices] == [1, 198, 199, 200, 201]


def test_a_log_that_others_cannot_fill(caplog):
    now = 0.0
    log = PacedLog(logging.getLogger("xop_lerobot.test"), clock=lambda: now)
    with caplog.at_level(logging.INFO):
        for i in range(1000):
            log.info("line %d", i)
        assert caplog.messages == [f"line {i}" for i in range(10)]
        now = 1.5
        log.warning("at last")
        log.info("and on")
    assert caplog.messages[10:] == [
        "990 lines were left out: too many in a second.",
        "at last",
        "and on",
    ]
    assert caplog.records[-1].funcName == "test_a_log_that_others_cannot_fill"


def test_the_log_of_the_board_is_paced(caplog):
    board = NoticeBoard()
    with caplog.at_level(logging.INFO):
        for i in range(500):
            board.tell(Cue.SETTING, f"Weight position {i}.")
    # A second may end meanwhile on a slow machine, not twenty of them.
    assert 10 <= len(caplog.messages) < 200
    assert board.notices[-1].text == "Weight position 499."


def test_a_toggle_is_told_when_it_holds():
    """Through a teleoperation: what is asked for is told once it is in force."""
    DEVICES.add("person", Person)
    rig = Rig("rby1")
    try:
        rig.run(0.2)
        rig.teleop.toggle("mode", "call")
        assert rig.teleop.notice == ""
        rig.run(0.1)
        assert rig.teleop.notice == "Mode: mobile."
        rig.teleop.change({"preset": "conservative"})
        rig.run(0.1)
        assert rig.teleop.notice == "Preset conservative."
        rig.teleop.answer(Cue.REFUSED, "Nothing is recorded.")
        assert rig.teleop.notice == "Nothing is recorded."
    finally:
        rig.close()
        DEVICES.remove("person")
