"""A robot driven through a WebXR page, while everything goes wrong with the headset.

In lock-step as `test_headset_faults.py`. `pytest -rP` prints what each fault has done: the largest
step of a command as a part of its rate limit, and of an arm's joint.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from avp_server import wait_for
from headset_rig import RATE, Rig, make_person
from ports import find_port
from webxr_client import AHEAD_S, CODE, Page, encode

from tests.operator.test_headset_faults import move, turn
from xop_lerobot.operator.devices import DeviceConfig
from xop_lerobot.operator.devices.webxr import WebXrDevice
from xop_lerobot.operator.engagement import UNSEEN
from xop_lerobot.operator.frame import OperatorFrame

pytestmark = pytest.mark.slow

Fault = Callable[[float, OperatorFrame], list[OperatorFrame | str]]
HEAD_LOST = np.array([False, True, True])
LATE = (
    "the headset's stream is 500 ms late and is not followed beyond 300 ms: free the network, or "
    "raise device.max_delay_s"
)


class WebXrRig(Rig):
    """The rig behind a page; frames are sent with their own stamps."""

    def __init__(self, name: str, **settings) -> None:
        self._number = 0
        config = DeviceConfig(type="webxr", port=find_port(), code=CODE, **settings)
        super().__init__(name, config, self._put)
        self.page = self.open()

    def open(self) -> Page:
        device = self.device
        assert isinstance(device, WebXrDevice)
        page = Page(device, clock=lambda: self.now + AHEAD_S)
        page.wait_for("ping")
        handled = device.handled
        page.send("hello")  # when this is counted, the ping is answered
        wait_for(lambda: device.handled > handled)
        self.page, self.sent = page, device.handled
        return page

    def _put(self, message: OperatorFrame | str) -> None:
        self._number += 1
        if isinstance(message, OperatorFrame):
            self.page.send(encode(message, self._number, message.time + AHEAD_S))
        else:
            self.page.send(message)

    def close(self) -> None:
        self.page.close()
        super().close()

    def report(self, what: str, since: int) -> None:
        command, arms = self.compute_largest_steps(max(since - 1, 0))
        told = self.device.trouble or self.teleop.notice
        state = "fallen" if self.loop.state.fallen else "stands"
        print(
            f"{self.morphology.name} | {what} | {'follows' if self.is_engaged else 'holds'}, "
            f"{state} | {command:.2f} | {arms:.3f} rad | {told}"
        )


@pytest.fixture
def make_rig() -> Iterator[Callable[..., WebXrRig]]:
    made = []

    def make(name: str, **settings) -> WebXrRig:
        made.append(WebXrRig(name, **settings))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


def late(frame: OperatorFrame, delay: float) -> OperatorFrame:
    """What the same person sent so long before."""
    return make_person(frame.time - delay, gesture=False)


def make_passing() -> dict[str, Fault]:
    """Faults over which the robot goes on following: they are filtered out."""
    rng = np.random.default_rng(0)
    held: list[OperatorFrame] = []
    kept: list[OperatorFrame] = []

    def shuffle(t: float, frame: OperatorFrame) -> list[OperatorFrame | str]:
        del t
        held.append(frame)
        if len(held) < 4:
            return []
        out = [held[i] for i in rng.permutation(4)] + [held[3]] * 2
        held.clear()
        return list(out)

    def stall(t: float, frame: OperatorFrame) -> list[OperatorFrame | str]:
        kept.append(frame)
        if t < 0.16:
            return []
        out = list(kept)
        kept.clear()
        return list(out)

    def add_nonsense(t: float, frame: OperatorFrame) -> list[OperatorFrame | str]:
        del t
        begin = '{"type":"frame","seq":1,"source":"hands","head":[NaN,1e999,null],"t":'
        now = (frame.time + AHEAD_S) * 1e3
        return [
            "nonsense",
            '{"type":"frame"}',
            f"{begin}{now + 3.6e6}}}",
            f"{begin}{now - 1}}}",
            frame,
            "[1]",
        ]

    return {
        "20 % loss": lambda t, f: [f] if rng.random() > 0.2 else [],
        "reordered and duplicated": shuffle,
        "a burst after 160 ms of nothing": stall,
        "120 ms of delay": lambda t, f: [late(f, 0.12)] if t > 0.12 else [],
        "single jumps of 1 m": lambda t, f: [move(f, 1.0) if int(t * RATE) % 10 == 0 else f],
        "NaN and garbage": add_nonsense,
    }


def make_stopping() -> dict[str, tuple[Fault, str]]:
    """Faults that end the engagement, and what is told."""
    last: list[OperatorFrame] = []

    def freeze(t: float, frame: OperatorFrame) -> list[OperatorFrame | str]:
        if t < 0.2:
            last[:] = [frame]
        # The page goes on sending, but nothing moves.
        return [dataclasses.replace(last[0], time=frame.time)]

    return {
        "lost head": (
            lambda t, f: [dataclasses.replace(f, tracked=HEAD_LOST)],
            UNSEEN,
        ),
        "frozen stream": (freeze, UNSEEN),
        "silent stream": (lambda t, f: [], UNSEEN),
        "moved by 1 m for good": (lambda t, f: [move(f, 1.0)], UNSEEN),
        "delay that grows to 700 ms": (
            lambda t, f: [late(f, 0.8 * t)] if round(t * RATE) % 4 == 0 else [],
            "the headset's stream is",
        ),
    }


@pytest.mark.parametrize("name", ["rby1", "g1"])
def test_faults_that_pass(make_rig, name):
    rig = make_rig(name)
    rig.engage()
    for what, fault in make_passing().items():
        before = len(rig.ticks)
        rig.run(0.6, fault)
        assert rig.is_engaged, what
        rig.report(what, before)
        rig.run(0.2)
    rig.check()
    counts = rig.device.status.counts
    assert counts["out_of_order"] >= 7 and counts["repeated"] >= 14
    assert counts["no_message"] == 61 and counts["bad_frame"] == 30
    assert counts["from_the_future"] == 30 and counts["head_not_finite"] == 30


@pytest.mark.parametrize("name", ["rby1", "g1"])
def test_faults_that_stop(make_rig, name):
    rig = make_rig(name)
    faults = make_stopping()
    if name == "g1":  # it takes longer, and holds as the other does
        faults = {what: faults[what] for what in ("lost head", "delay that grows to 700 ms")}
    for what, (fault, told) in faults.items():
        rig.engage()
        before = len(rig.ticks)
        rig.run(0.9, fault)
        assert not rig.is_engaged, what
        assert rig.teleop.notice.startswith(f"Disengaged: {told}"), what
        assert rig.teleop.notice.endswith("The robot holds; engage again by the gesture.")
        held = rig.ticks[-1][0].arms
        rig.run(0.2)  # the stream is good again, but nobody has asked for anything
        assert not rig.is_engaged, what
        np.testing.assert_allclose(rig.ticks[-1][0].arms, held, atol=1e-6)
        rig.report(what, before)
    rig.check()


@pytest.mark.parametrize("name", ["rby1", "g1"])
def test_a_lost_hand_freezes_its_arm_alone(make_rig, name):
    rig = make_rig(name)
    rig.engage()
    before = len(rig.ticks)
    unseen = np.array([True, False, True])
    rig.run(
        2.5,
        lambda t, f: [dataclasses.replace(f, tracked=unseen) if 0.2 <= t < 2.2 else f],
    )
    assert rig.is_engaged
    frames = [record.frame for _, record in rig.ticks[before + 10 : before + 50]]
    assert not any(frame.tracked[1] for frame in frames)
    rig.assert_left_arm_stood(slice(before + 10, before + 50))
    rig.run(1.0)
    assert rig.ticks[-1][1].frame.tracked.all()
    rig.report("left hand lost for 2 s", before)
    rig.check()


def test_a_hand_that_comes_and_goes_is_followed(make_rig):
    """At the edge of the view: 45 ms in each quarter of a second it is not seen."""
    rig = make_rig("rby1")
    rig.engage()
    rig.run(0.8)  # until its arms have come to the hands
    before = len(rig.ticks)
    unseen = np.array([True, False, True])
    rig.run(
        4.0,
        lambda t, f: [dataclasses.replace(f, tracked=unseen) if t % 0.25 < 0.045 else f],
    )
    goals = [record.goal.poses for _, record in rig.ticks[before:]]
    left, right = (
        np.array([goal[name][0] - goal["head"][0] for goal in goals])
        for name in ("left_wrist", "right_wrist")
    )
    assert np.ptp(left) > 0.95 * np.ptp(right) > 0.05
    np.testing.assert_allclose(left, right, atol=0.01)
    rig.report("left hand lost for 45 ms, four times a second", before)
    rig.check()


def test_a_constant_delay(make_rig):
    """500 ms: nobody engages, and it is told why; who allows it drives, and is warned."""
    delayed = lambda t, f: [dataclasses.replace(f, time=f.time - 0.5)]  # noqa: E731
    rig = make_rig("rby1")
    rig.run(0.8, delayed)
    rig.run(1.6, delayed, gesture=True)
    assert not rig.is_engaged and rig.device.read(0.0) is None
    assert rig.device.trouble == LATE
    assert rig.device.status.counts == {"late": 120, "no_message": 1}

    rig = make_rig("rby1", max_delay_s=1.0)
    rig.run(0.8, delayed)
    rig.run(1.6, delayed, gesture=True)
    assert rig.is_engaged
    before = len(rig.ticks)
    rig.run(0.6, delayed)
    assert rig.is_engaged
    assert rig.device.trouble == "the headset's stream is 500 ms late: move slowly"
    assert rig.device.status.delay == pytest.approx(0.5, abs=0.03)
    rig.report("500 ms of delay, allowed", before)
    rig.check()


def test_connections_that_end(make_rig):
    """The headset is taken off, the page is loaded anew, a message is too long, the net is cut."""
    rig = make_rig("rby1")

    def take_off() -> None:
        rig.page.send({"type": "bye", "reason": "the headset was taken off"})

    def load_anew() -> None:
        rig.page.close()

    def send_too_much() -> None:
        rig.page.send("x" * 9000)
        rig.sent += 1

    def cut() -> None:
        rig.page.ws.socket.close()

    ends = {
        take_off: "the headset was taken off",
        load_anew: "the page has closed the connection",
        send_too_much: "the page was disconnected: a message may have 8192 bytes",
        cut: "the page has closed the connection",
    }
    for end, told in ends.items():
        rig.engage()
        before = len(rig.ticks)
        rig.run(0.2)
        end()
        wait_for(lambda: not rig.device.status.connected)
        rig.run(0.04, lambda t, f: [])  # one tick: it is let go at once
        assert not rig.is_engaged
        assert rig.teleop.notice == (
            f"Disengaged: {told}. The robot holds; engage again by the gesture."
        )
        rig.run(0.2, lambda t, f: [])
        if end is not take_off:
            rig.open()
        rig.run(0.3)
        assert not rig.is_engaged  # a page that is back moves nothing by itself
        rig.report(end.__name__, before)
    rig.check()


@pytest.mark.parametrize("degrees", [4, 25, 120])
def test_a_headset_that_is_recentred_lets_go_and_turns_no_robot(make_rig, degrees):
    rig = make_rig("rby1")
    rig.engage()
    head = rig.compute_head()
    rig.page.send({"type": "bye", "reason": "the headset was recentred"})
    rig.run(0.6, lambda t, f: [turn(f, degrees)])
    assert not rig.is_engaged
    assert rig.teleop.notice == (
        "Disengaged: the headset was recentred. The robot holds; engage again by the gesture."
    )
    assert rig.device.trouble == ""  # it is over
    np.testing.assert_allclose(rig.compute_head(), head, atol=0.02)
    rig.check()


def test_a_second_client_changes_nothing(make_rig):
    rig = make_rig("rby1")
    rig.engage()
    before = len(rig.ticks)
    device = rig.device
    second = Page(device)
    assert second.wait_for("refused")["reason"].startswith("somebody drives already")
    for _ in range(6):
        assert Page(device, code="WRONG").wait_for("refused")
    rig.run(0.4)
    assert rig.is_engaged
    rig.report("a second client, and one that guesses codes", before)
    rig.check()
