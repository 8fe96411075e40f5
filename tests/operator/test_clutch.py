"""The clutch: what engages and lets go, and what must not."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import make_pose, quat_exp, quat_multiply
from xop_lerobot.operator.engagement import Clutch, ClutchConfig, ClutchRequest
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.goal import HandBlend
from xop_lerobot.operator.recording import load_recording

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[3] / "shared"))
UP = quat_exp(np.array([np.pi, 0, 0]))
DOWN = np.array([1.0, 0, 0, 0])
CLOSED, OPEN = np.full(2, 0.008), np.full(2, 0.07)


def make_frame(
    t: float, *, closed: bool, palms_up: bool = True, speed: float = 0.0, tracked=(1, 1, 1)
) -> OperatorFrame:
    quat = UP if palms_up else DOWN
    wrists = [make_pose(np.array([0.3 + speed * t, y, 1.1]), quat) for y in (0.15, -0.15)]
    head = make_pose(np.array([0, 0, 1.6]), DOWN)
    pinch = CLOSED if closed else OPEN
    return OperatorFrame(t, head, *wrists, pinch=pinch, tracked=np.array(tracked, dtype=bool))


def drive(frames, clutch: Clutch | None = None, engaged: bool = False, grants: bool = True):
    """What becomes of it when every request is granted: stamps of engaging and letting go."""
    clutch = clutch or Clutch()
    events = []
    for frame in frames:
        request = clutch.update(frame, engaged)
        if request is not ClutchRequest.NOTHING:
            events.append((round(frame.time, 2), request))
            if grants:
                engaged = request is ClutchRequest.ENGAGE
    return events


def hold(*spans: tuple[float, float], rate: float = 50, end: float = 6.0, **fields):
    """Frames of somebody who makes the gesture in the `spans`."""
    return [
        make_frame(float(t), closed=any(a <= t < b for a, b in spans), **fields)
        for t in np.arange(0, end, 1 / rate)
    ]


@pytest.mark.parametrize("rate", [25, 30, 50, 90, 120])
def test_a_held_gesture_engages_and_the_next_one_lets_go(rate):
    events = drive(hold((1, 2.3), (4, 5.5), rate=rate))
    assert [request for _, request in events] == [ClutchRequest.ENGAGE, ClutchRequest.LET_GO]
    for (stamp, _), start in zip(events, (1, 4), strict=True):
        assert start + 0.95 <= stamp <= start + 1.0 + 2 / rate + 0.01


def test_one_long_hold_does_one_thing():
    assert [request for _, request in drive(hold((1, 6)))] == [ClutchRequest.ENGAGE]


@pytest.mark.parametrize(
    "frames",
    [
        hold(),
        hold((1, 1.9), (2.1, 3.0), (3.2, 4.1)),
        hold((1, 3), palms_up=False),
        hold((1, 3), speed=0.4),
        hold((1, 3), tracked=(1, 0, 1)),
        hold((1, 3), tracked=(0, 1, 1)),
        hold((0, 3)),  # closed from the beginning
        hold((1, 3), rate=4),  # too few frames to know
    ],
    ids=["open", "short", "palms down", "moving", "one hand", "no head", "at start", "gaps"],
)
def test_what_does_not_engage(frames):
    assert drive(frames) == []


def test_both_pinch_needs_no_palms():
    clutch = Clutch(ClutchConfig(gesture="both_pinch"))
    assert len(drive(hold((1, 3), palms_up=False), clutch)) == 1


def test_it_asks_until_it_is_granted():
    events = drive(hold((1, 3)), grants=False)
    assert {request for _, request in events} == {ClutchRequest.ENGAGE}
    assert events[0][0] == pytest.approx(2, abs=0.05)
    assert events[-1][0] == pytest.approx(3, abs=0.05)


def test_a_lost_head_or_no_frame_lets_go_at_once():
    lost = make_frame(0.1, closed=False, tracked=(0, 1, 1))
    assert Clutch().update(lost, engaged=True) is ClutchRequest.LET_GO
    assert Clutch().update(lost, engaged=False) is ClutchRequest.NOTHING
    assert Clutch().update(None, engaged=True) is ClutchRequest.LET_GO


def test_who_was_lost_must_open_the_hands_first():
    clutch = Clutch()
    frames = hold((1, 6))
    frames[120] = dataclasses.replace(frames[120], tracked=np.zeros(3, dtype=bool))
    events = drive(frames, clutch)
    assert [request for _, request in events] == [ClutchRequest.ENGAGE, ClutchRequest.LET_GO]


def test_frames_that_come_again_change_nothing():
    frames = hold((1, 2.3), (4, 5.5))
    assert drive([frame for frame in frames for _ in range(3)]) == drive(frames)


def test_a_clock_that_goes_back_starts_anew():
    clutch = Clutch()
    assert len(drive(hold((1, 2.3), end=3), clutch)) == 1
    assert len(drive(hold((1, 2.3), end=3), clutch, engaged=True)) == 1


@pytest.mark.parametrize("gesture", ["palms_up", "both_pinch"])
@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_real_motion_neither_engages_nor_lets_go(gesture, turn):
    """Nor with the hands turned over, so that only the pinch keeps them apart."""
    files = sorted((SHARED / "operator").glob("*.npz"))
    if not files:
        pytest.skip("the real recordings are not here")
    for file in files:
        recording = load_recording(file)
        over = quat_exp(np.array([turn, 0, 0]))
        frames = []
        for t in np.arange(0, recording.duration, 1 / 50):
            frame = recording.frame_at(float(t))
            wrists = {
                name: make_pose(frame.pose(name)[:3], quat_multiply(frame.pose(name)[3:], over))
                for name in ("left_wrist", "right_wrist")
            }
            frames.append(dataclasses.replace(frame, **wrists))
        assert drive(frames, Clutch(ClutchConfig(gesture=gesture))) == [], file.name


def test_config_errors():
    with pytest.raises(UnknownName, match=r"unknown clutch.gesture 'wave'. Known: both_pinch, pa"):
        ClutchConfig(gesture="wave")
    with pytest.raises(BadValue, match=r"clutch\.hold must be finite and above 0, got -1"):
        ClutchConfig(hold=-1)
    with pytest.raises(BadValue, match=r"clutch\.on must be below off, got 0.05 and 0.035"):
        ClutchConfig(on=0.05)


# -- a hand that comes back ----------------------------------------------------------------


def blend_path(seen, goal_of):
    """Path of a left hand whose goal is `goal_of(t)`, seen as `seen(t)`."""
    blend, path = HandBlend(), []
    for t in np.arange(0, 6, 1 / 50):
        goals = {
            "head": make_pose(np.array([0, 0, 1.6]), DOWN),
            "left_wrist": make_pose(np.array([goal_of(t), 0.2, 1.1]), DOWN),
        }
        tracked = np.array([True, seen(t), True])
        path.append(blend.apply(float(t), goals, tracked)["left_wrist"][0])
    return np.array(path)


def test_a_lost_hand_stands_and_comes_back_smoothly():
    path = blend_path(lambda t: not 1 <= t < 3, lambda t: 0.3 if t < 1 else 0.7)
    np.testing.assert_allclose(path[:150], 0.3)
    np.testing.assert_allclose(path[-90:], 0.7)
    assert np.abs(np.diff(path)).max() < 0.4 * 1.9 / 50


def test_a_hand_lost_again_in_the_blend_stays_where_it_is():
    path = blend_path(lambda t: t < 1 or 2 <= t < 2.5 or t >= 4, lambda t: 0.3 if t < 1 else 0.7)
    assert 0.4 < path[130] < 0.6
    np.testing.assert_allclose(path[126:200], path[126])
    assert np.abs(np.diff(path)).max() < 0.4 * 1.9 / 50


@pytest.mark.parametrize(
    "period, lost", [(0.25, 0.045), (0.5, 0.045), (0.1, 0.016), (1.0, 0.16), (0.4, 0.1), (2.5, 0.4)]
)
def test_a_hand_that_comes_and_goes_is_followed(period, lost):
    """Seen for three quarters of the time or more, it makes all of its way, and no leap."""
    times = np.arange(0, 6, 1 / 50)
    hand = 0.5 - 0.2 * np.cos(np.pi * times)  # up to 0.63 m/s
    path = blend_path(lambda t: t % period >= lost, lambda t: 0.5 - 0.2 * np.cos(np.pi * t))
    assert np.ptp(path[50:]) > 0.99 * np.ptp(hand)
    # It was a little behind whenever it was lost, by no more than what it did meanwhile.
    assert np.sqrt(np.mean(np.square(path - hand)[50:])) < 0.02 + 0.3 * lost
    assert np.abs(np.diff(path)).max() < 3.5 * 0.63 / 50


def test_a_hand_that_comes_and_goes_by_chance_is_followed():
    seen = np.random.default_rng(0).random(300) > 0.16
    path = blend_path(lambda t: seen[round(t * 50)], lambda t: float(np.clip(t, 1, 2)))
    np.testing.assert_allclose(path[150:], 2)
    assert np.abs(np.diff(path)).max() < 4 / 50


def test_a_hand_that_is_found_far_away_soon_is_not_leapt_to():
    """As one that is mistaken for another: it comes about as slowly as one lost for longer."""
    path = blend_path(lambda t: not 1 <= t < 1.15, lambda t: 0.3 if t < 1 else 0.9)
    np.testing.assert_allclose(path[110:], 0.9)
    assert np.abs(np.diff(path)).max() < 2.0 / 50


def test_at_engagement_the_hands_begin_where_the_robot_has_them():
    blend = HandBlend()
    head = make_pose(np.array([1.0, 2, 1.3]), DOWN)
    robot = {"left_wrist": make_pose(np.array([1.2, 2.2, 0.9]), DOWN)}
    goals = {"head": head, "left_wrist": make_pose(np.array([1.5, 2.2, 1.2]), UP)}
    blend.engage(head, robot)
    first = blend.apply(0.0, goals, np.ones(3, dtype=bool))["left_wrist"]
    np.testing.assert_allclose(first, robot["left_wrist"], atol=1e-12)
    last = blend.apply(1.0, goals, np.ones(3, dtype=bool))["left_wrist"]
    np.testing.assert_allclose(np.abs(last), np.abs(goals["left_wrist"]), atol=1e-12)
