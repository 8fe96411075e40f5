"""Raised hands and double pinches: what asks something of the recording, and what must not."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from benchmarks.person_comparison import simulate_frames
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import (
    make_pose,
    quat_exp,
    quat_from_rpy,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.operator.display import RecordingRequest
from xop_lerobot.operator.engagement import Clutch, ClutchRequest
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import GestureConfig, Hands, explain_gestures
from xop_lerobot.operator.raised_hands import RaisedHands, RaisedHandsConfig
from xop_lerobot.operator.recording import load_recording

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[3] / "shared"))
RATE = 50
LEVEL = np.array([1.0, 0, 0, 0])
HALT = quat_from_rpy(0, -np.pi / 2, 0)
"""Fingers up, palm forward: from fingers forward and palm down, the hand is bent back."""
ORIENTATIONS = {
    "palm down": LEVEL,
    "palm up": quat_from_rpy(np.pi, 0, 0),
    "palm inwards": quat_from_rpy(-np.pi / 2, 0, 0),
    "palm to the face": quat_from_rpy(0, -np.pi / 2, np.pi),
    "fingers down": quat_from_rpy(0, np.pi / 2, 0),
}
Span = tuple[float, float]


def test_what_a_raised_hand_is():
    np.testing.assert_allclose(quat_rotate(HALT, np.array([1.0, 0, 0])), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(quat_rotate(HALT, np.array([0.0, 0, -1])), [1, 0, 0], atol=1e-12)


def make_frames(
    raised: Sequence[Sequence[Span]],
    pinched: Sequence[Sequence[Span]],
    *,
    turn: np.ndarray = HALT,
    height: float = 1.35,
    speed: float = 0.0,
    heading: float = 0.0,
    lost: tuple[int, Span] = (1, (99.0, 99.0)),
    rate: float = RATE,
    end: float = 7.0,
) -> list[OperatorFrame]:
    """Frames of somebody whose hands (left, right) are raised and pinched in these spans."""

    def during(spans: Iterable[Span], t: float) -> bool:
        return any(a <= t < b for a, b in spans)

    facing = quat_from_rpy(0, 0, heading)
    frames = []
    for t in map(float, np.arange(0, end, 1 / rate)):
        wrists, pinch = [], []
        for side, ups, closed in zip((1, -1), raised, pinched, strict=True):
            up = during(ups, t)
            place = np.array([0.35 + speed * t, 0.25 * side, height if up else 1.1])
            quat = quat_multiply(facing, turn if up else LEVEL)
            wrists.append(make_pose(quat_rotate(facing, place), quat))
            pinch.append(0.008 if during(closed, t) else 0.07)
        limb, span = lost
        tracked = np.ones(3, dtype=bool)
        tracked[limb] = not span[0] <= t < span[1]
        head = make_pose(np.array([0, 0, 1.6]), facing)
        frames.append(OperatorFrame(t, head, *wrists, pinch=np.array(pinch), tracked=tracked))
    return frames


def find_requests(
    frames: Iterable[OperatorFrame], reader=None
) -> list[tuple[float, RecordingRequest]]:
    reader = reader or RaisedHands()
    requests = []
    for frame in frames:
        request = reader.update(frame)
        if request is not None:
            requests.append((round(frame.time, 2), request))
    return requests


UP, HELD = [(1.0, 6.0)], [(2.0, 5.0)]
GESTURES = {
    RecordingRequest.END: (([], UP), ([], HELD), 1.0),
    RecordingRequest.REDO: ((UP, []), (HELD, []), 2.0),
    RecordingRequest.STOP: ((UP, UP), (HELD, HELD), 2.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("rate", [25, 30, 50, 90, 120])
@pytest.mark.parametrize("wanted", list(GESTURES))
def test_a_raised_hand_that_pinches_asks_once(wanted, rate):
    raised, pinched, length = GESTURES[wanted]
    ((stamp, asked),) = find_requests(make_frames(raised, pinched, rate=rate))
    assert asked is wanted
    assert 2 + length - 0.01 <= stamp <= 2 + length + 2 / rate + 0.01


@pytest.mark.parametrize("heading", [-2.5, -1.0, 1.5, 3.1])
def test_wherever_the_person_faces(heading):
    raised, pinched, _ = GESTURES[RecordingRequest.END]
    assert len(find_requests(make_frames(raised, pinched, heading=heading))) == 1


@pytest.mark.parametrize(
    "tilt", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.6, 0), (0, -0.6, 0), (0, 0, 0.6)]
)
def test_a_hand_need_not_be_straight(tilt):
    raised, pinched, _ = GESTURES[RecordingRequest.REDO]
    turn = quat_multiply(HALT, quat_exp(np.array(tilt)))
    assert len(find_requests(make_frames(raised, pinched, turn=turn))) == 1


NOTHING: dict[str, Callable[[], list[OperatorFrame]]] = {
    "raised, and open": lambda: make_frames((UP, UP), ([], [])),
    "too short": lambda: make_frames(([], UP), ([], [(2, 2.9), (3.2, 4.1)])),
    "too short for redo": lambda: make_frames((UP, []), ([(2, 3.9)], [])),
    "pinched before it is raised": lambda: make_frames(([], [(2, 6)]), ([], [(1, 6)])),
    "carried through it": lambda: make_frames((UP, UP), ([(0, 7)], [(0, 7)])),
    "moving": lambda: make_frames(([], UP), ([], HELD), speed=0.1),
    "low": lambda: make_frames(([], UP), ([], HELD), height=0.9),
    "the other hand only is raised": lambda: make_frames((UP, []), ([], HELD)),
    "one of both pinches": lambda: make_frames((UP, UP), ([], HELD)),
    "one of both is open again": lambda: make_frames((UP, UP), ([(2, 3.5)], HELD)),
    "head not seen": lambda: make_frames(([], UP), ([], HELD), lost=(0, (2.9, 2.92))),
    "other hand not seen": lambda: make_frames(([], UP), ([], HELD), lost=(1, (0, 7))),
    "too few frames": lambda: make_frames(([], UP), ([], HELD), rate=4),
}


@pytest.mark.parametrize("what", list(NOTHING))
def test_what_asks_nothing(what):
    assert find_requests(NOTHING[what]()) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", list(ORIENTATIONS))
def test_other_hands_ask_nothing(name):
    for raised, pinched, _ in GESTURES.values():
        assert find_requests(make_frames(raised, pinched, turn=ORIENTATIONS[name])) == []


def test_one_long_hold_asks_once_and_the_next_begins_with_an_open_hand():
    frames = make_frames(([], [(1, 9)]), ([], [(2, 6), (6.3, 8)]), end=9)
    assert [request for _, request in find_requests(frames)] == [RecordingRequest.END] * 2


def test_frames_that_come_again_change_nothing_and_a_clock_that_goes_back_starts_anew():
    raised, pinched, _ = GESTURES[RecordingRequest.STOP]
    frames = make_frames(raised, pinched)
    assert find_requests([f for f in frames for _ in range(3)]) == find_requests(frames)
    reader = RaisedHands()
    assert len(find_requests(frames, reader)) == len(find_requests(frames, reader)) == 1


def test_progress_is_shown_while_it_is_held():
    reader = RaisedHands()
    raised, pinched, _ = GESTURES[RecordingRequest.REDO]
    shown = []
    for frame in make_frames(raised, pinched):
        reader.update(frame)
        shown.append((reader.request, reader.progress))
    held = [progress for request, progress in shown if request is RecordingRequest.REDO]
    assert len(held) == pytest.approx(2 * RATE, abs=2)
    assert (np.diff(held) > 0).all()
    assert shown[-1] == (None, 0.0)


def test_the_clutch_and_raised_hands_keep_apart():
    for raised, pinched, _ in GESTURES.values():
        clutch = Clutch()
        frames = make_frames(raised, pinched)
        assert all(clutch.update(frame, True) is ClutchRequest.NOTHING for frame in frames)


def test_hands_are_chosen_by_the_configuration():
    config = RaisedHandsConfig(end="left", redo="right", stop="none")
    found = find_requests(make_frames((UP, []), (HELD, [])), RaisedHands(config))
    assert [request for _, request in found] == [RecordingRequest.END]
    assert find_requests(make_frames((UP, UP), (HELD, HELD)), RaisedHands(config)) == []
    with pytest.raises(UnknownName, match="unknown gestures.raised.end 'foot'. Known: both, "):
        RaisedHandsConfig(end="foot")
    with pytest.raises(BadValue, match=r"end and redo must not have the same hand \(left\)"):
        RaisedHandsConfig(end="left")
    with pytest.raises(BadValue, match=r"gestures\.raised\.hold must be finite and above 0, got 0"):
        RaisedHandsConfig(hold=0)
    with pytest.raises(BadValue, match=r"on must be below off, got 0.05 and 0.035"):
        RaisedHandsConfig(on=0.05)


# -- double pinches ------------------------------------------------------------------------

DOUBLE = [(1.0, 1.15), (1.35, 1.5)]


def read(frames: Iterable[OperatorFrame], config: GestureConfig | None = None, person=True):
    hands = Hands(config or GestureConfig(), has_person=person)
    asked = [hands.read(frame) for frame in frames]
    return (
        sum(each.mode for each in asked),
        [each.toggle for each in asked if each.toggle],
        [request for each in asked for request in each.requests],
    )


def test_each_hand_has_its_double_pinch():
    none = ([], [])
    assert read(make_frames(none, (DOUBLE, []), end=3)) == (1, [], [])
    assert read(make_frames(none, ([], DOUBLE), end=3)) == (0, [], [RecordingRequest.SUCCESS])
    assert read(make_frames(none, (DOUBLE, DOUBLE), end=3)) == (0, ["upright"], [])
    late = [(a + 0.3, b + 0.3) for a, b in DOUBLE]
    assert read(make_frames(none, (DOUBLE, late), end=3)) == (0, ["upright"], [])
    assert read(make_frames(none, (late, DOUBLE), end=3)) == (0, ["upright"], [])
    later = [(a + 2, b + 2) for a, b in DOUBLE]
    assert read(make_frames(none, (later, DOUBLE), end=5)) == (1, [], [RecordingRequest.SUCCESS])
    config = GestureConfig(other_double_pinch="none", both_double_pinch="none")
    assert read(make_frames(none, ([], DOUBLE), end=3), config) == (0, [], [])
    assert read(make_frames(none, (DOUBLE, DOUBLE), end=3), config) == (0, [], [])
    with pytest.raises(UnknownName, match="unknown gestures.other_double_pinch 'x'. Known: none, "):
        GestureConfig(other_double_pinch="x")


def test_recordings_ask_nothing_of_the_recording_that_is_made_now():
    raised, pinched, _ = GESTURES[RecordingRequest.END]
    frames = make_frames(raised, pinched) + make_frames(([], []), ([], DOUBLE))
    assert read(frames)[2] == [RecordingRequest.END, RecordingRequest.SUCCESS]
    assert read(frames, person=False)[2] == []


def test_every_gesture_is_explained():
    assert explain_gestures(GestureConfig()) == {
        "engage": "Turn both palms up, pinch with both hands, and hold still for 1 s; the same "
        "gesture disengages",
        "mode": "Pinch twice with the left hand",
        "end": "Raise the right hand, palm away from you, pinch there, and hold still for 1 s",
        "redo": "Raise the left hand, palm away from you, pinch there, and hold still for 2 s",
        "stop": "Raise both hands, palms away from you, pinch there, and hold still for 2 s",
        "success": "Pinch twice with the right hand",
        "upright": "Pinch twice with both hands at once",
    }
    config = GestureConfig(
        raised=RaisedHandsConfig(end="none"), other_double_pinch="none", both_double_pinch="none"
    )
    assert set(explain_gestures(config)) == {"engage", "mode", "redo", "stop"}


# -- false triggers ------------------------------------------------------------------------


def work(frames: Iterable[OperatorFrame], rng: np.random.Generator) -> Iterable[OperatorFrame]:
    """Let the hands of `frames` close and open as in work: for 0.3 to 15 s, and not in pairs."""
    closed, until = np.zeros(2, dtype=bool), np.zeros(2)
    for frame in frames:
        for hand in range(2):
            if frame.time >= until[hand]:
                closed[hand] = not closed[hand]
                shortest, longest = (0.3, 15) if closed[hand] else (0.5, 5)
                until[hand] = frame.time + np.exp(rng.uniform(np.log(shortest), np.log(longest)))
        yield dataclasses.replace(frame, pinch=np.where(closed, 0.008, 0.07))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_person_who_works_asks_nothing(seed):
    """Who stands, walks, turns, reaches and grasps for 5 minutes, palms inwards."""
    rng = np.random.default_rng(seed)
    frames = work(simulate_frames(seed, 150.0, rate=RATE), rng)
    assert read(frames)[1:] == ([], [])


@pytest.mark.slow
def test_real_motion_asks_nothing_whatever_the_pinches_do():
    files = sorted((SHARED / "operator").glob("*.npz"))
    if not files:
        pytest.skip("the real recordings are not here")
    rng = np.random.default_rng(0)
    for file in files:
        recording = load_recording(file)
        stamps = np.arange(0, recording.duration, 1 / RATE)
        frames = [recording.frame_at(float(t)) for t in stamps]
        assert read(frames) == (0, [], []), file.name
        for _ in range(5):
            assert read(work(frames, rng))[1:] == ([], []), file.name
