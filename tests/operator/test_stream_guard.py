"""What of a live stream is believed, frame by frame."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import (
    compute_minimum_jerk,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_from_yaw,
    quat_multiply,
)
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.stream import GuardConfig, StreamGuard

DT = 1 / 100


def person(t: float, **changes) -> OperatorFrame:
    """Somebody who sways, as every tracked person does."""
    sway = 0.01 * np.array([np.sin(3 * t), np.cos(2 * t), np.sin(5 * t)])
    quat = quat_exp(sway)
    head = make_pose(sway + [0, 0, 1.6], quat)
    wrists = [make_pose(sway + [0.3, y, 1.1], quat) for y in (0.2, -0.2)]
    frame = OperatorFrame(t, head, *wrists, pinch=np.array([0.07, 0.06]))
    return dataclasses.replace(frame, **changes)


def shift(pose: np.ndarray, x: float) -> np.ndarray:
    return pose + np.array([x, 0, 0, 0, 0, 0, 0])


def run(guard: StreamGuard, start: float, end: float, change=lambda frame: frame) -> list[Any]:
    times = np.arange(round(start / DT), round(end / DT)) * DT
    return [guard.take(change(person(float(t)))) for t in times]


def test_a_good_stream_comes_through_to_the_bit():
    guard = StreamGuard()
    for taken, t in zip(run(guard, 0, 1), np.arange(100) * DT, strict=True):
        assert taken is not None
        for name in ("head", "left_wrist", "right_wrist", "pinch", "tracked"):
            np.testing.assert_array_equal(getattr(taken, name), getattr(person(t), name))
    assert guard.counts == {"taken": 100}


def test_repeats_are_dropped_and_do_not_keep_a_dead_stream_alive():
    guard = StreamGuard()
    run(guard, 0, 0.5)
    dead = person(0.49)
    assert all(guard.take(dataclasses.replace(dead, time=t)) is None for t in np.arange(0.5, 2, DT))
    assert guard.counts == {"taken": 50, "repeated": 150}


@pytest.mark.parametrize(
    ("head", "reason"),
    [
        (np.full(7, np.nan), "head_not_finite"),
        (np.array([0, 0, np.inf, 1, 0, 0, 0]), "head_not_finite"),
        (np.zeros(7), "head_no_rotation"),
        (np.array([1e6, 0, 1.6, 1, 0, 0, 0]), "head_out_of_space"),
        (np.array([1.0, 0, 1.6, 1, 0, 0, 0]), "head_jump"),
        (np.array([0, 0, 1.6, 0, 0, 0, 1.0]), "head_jump"),
    ],
)
def test_a_frame_without_a_good_head_is_dropped(head, reason):
    guard = StreamGuard()
    run(guard, 0, 0.5)
    assert guard.take(person(0.5, head=head)) is None
    assert guard.counts == {"taken": 50, reason: 1}
    assert guard.take(person(0.51)) is not None


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"left_wrist": np.full(7, np.nan)}, "left_not_finite"),
        ({"left_wrist": np.array([0.3, 0.2, 1.1, 0, 0, 0, 0])}, "left_no_rotation"),
        ({"left_wrist": np.array([1.1, 0.2, 1.1, 1, 0, 0, 0])}, "left_jump"),
        ({"left_wrist": np.array([2.0, 0.2, 1.1, 1, 0, 0, 0])}, "left_out_of_reach"),
        ({"tracked": np.array([True, False, True])}, "left_lost"),
        ({"pinch": np.array([np.nan, 0.06])}, "left_bad_pinch"),
        ({"pinch": np.array([-0.01, 0.06])}, "left_bad_pinch"),
        ({"pinch": np.array([0.9, 0.06])}, "left_bad_pinch"),
    ],
)
def test_a_bad_hand_is_lost_alone_and_stays_where_it_was(changes, reason):
    guard = StreamGuard()
    last = run(guard, 0, 0.5)[-1]
    taken: Any = guard.take(person(0.5, **changes))
    np.testing.assert_array_equal(taken.tracked, [True, False, True])
    np.testing.assert_array_equal(taken.left_wrist, last.left_wrist)
    assert taken.pinch[0] == last.pinch[0]
    np.testing.assert_array_equal(taken.right_wrist, person(0.5).right_wrist)
    assert guard.counts == {"taken": 51, reason: 1}
    after: Any = guard.take(person(0.51))
    assert after.tracked.all()


def test_a_hand_that_freezes_while_the_head_moves_is_lost_after_a_moment():
    guard = StreamGuard()
    run(guard, 0, 0.5)
    frozen = person(0.49).left_wrist
    taken = run(guard, 0.5, 1.0, lambda f: dataclasses.replace(f, left_wrist=frozen))
    tracked = [frame.tracked[1] for frame in taken]
    assert all(tracked[:7])  # devices repeat a pose now and then
    assert not any(tracked[9:])
    assert all(frame.tracked[[0, 2]].all() for frame in taken)
    assert run(guard, 1.0, 1.1)[0].tracked.all()


def test_a_head_that_freezes_while_the_hands_move_is_dropped_after_a_quarter_second():
    guard = StreamGuard()
    run(guard, 0, 0.5)
    frozen = person(0.49).head
    taken = run(guard, 0.5, 1.0, lambda f: dataclasses.replace(f, head=frozen))
    assert all(frame is not None for frame in taken[:24])
    assert all(frame is None for frame in taken[26:])


def test_a_jump_that_lasts_is_where_the_limb_is_now():
    guard = StreamGuard()
    run(guard, 0, 0.5)
    taken = run(
        guard, 0.5, 1.0, lambda f: dataclasses.replace(f, left_wrist=shift(f.left_wrist, 0.6))
    )
    tracked = [frame.tracked[1] for frame in taken]
    assert not any(tracked[:14])
    assert all(tracked[16:])
    everything = {
        name: (lambda f, n=name: shift(getattr(f, n), 3.0))
        for name in ("head", "left_wrist", "right_wrist")
    }
    moved = run(
        guard,
        1.0,
        2.0,
        lambda f: dataclasses.replace(f, **{n: move(f) for n, move in everything.items()}),
    )
    # Longer than a stream is stale, so that nobody is engaged when the head is believed again.
    assert all(frame is None for frame in moved[:39])
    assert moved[-1] is not None
    assert guard.relocations == 1


def turn_space(frame: OperatorFrame, yaw: float, place=(0.0, 0.0, 0.0)) -> OperatorFrame:
    """The same person in a space that was turned about a place, or who has turned as a whole."""
    middle = make_pose(np.array(place), np.array([1.0, 0, 0, 0]))
    turn = pose_multiply(middle, make_pose(np.zeros(3), quat_from_yaw(yaw)))
    turn = pose_multiply(turn, pose_inverse(middle))
    poses = {name: pose_multiply(turn, frame.pose(name)) for name in FRAMES}
    return dataclasses.replace(frame, **poses)


@pytest.mark.slow
@pytest.mark.parametrize("lost", [(), (1,), (1, 2)])
@pytest.mark.parametrize("degrees", [-150, -40, -25, 20, 90])
@pytest.mark.parametrize("rate", [50, 72, 90])
def test_a_space_that_is_recentred_is_no_motion(rate, degrees, lost):
    tracked = np.array([i not in lost for i in range(3)])
    guard = StreamGuard()
    for i in range(rate):
        assert guard.take(person(i / rate, tracked=tracked)) is not None
    times = 1 + np.arange(rate) / rate
    taken = [
        guard.take(turn_space(person(t, tracked=tracked), np.radians(degrees), (0.5, 0.5, 0)))
        for t in times
    ]
    first = next(i for i, frame in enumerate(taken) if frame is not None)
    assert times[first] - 1 >= 0.39  # longer than a stream is stale
    assert guard.relocations == 1
    assert all(frame is not None for frame in taken[first:])


@pytest.mark.parametrize("rate, degrees", [(90, 7), (72, 8), (50, 10), (30, 13)])
def test_hands_that_go_along_tell_a_small_recentring(rate, degrees):
    guard = StreamGuard()
    for i in range(rate):
        assert guard.take(person(i / rate)) is not None
    for t in (1 + np.arange(0, 0.35, 1 / rate)).tolist():
        assert guard.take(turn_space(person(t), np.radians(degrees))) is None
    # The space is as it was before: nothing was believed in between.
    assert guard.take(person(1.4)) is not None
    assert guard.relocations == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "stream", "seconds"),
    [
        *((rate, "good", 1.0) for rate in (30, 50, 72, 90)),
        *((rate, "a fifth is lost", 1.5) for rate in (30, 50, 72, 90)),
        *((rate, "in bursts", 1.5) for rate in (50, 72, 90)),
        *((rate, "120 ms are missing", 1.5) for rate in (50, 72, 90)),
    ],
)
def test_who_turns_round_is_followed(rate, stream, seconds):
    """By 180° as a whole, hands held before the body: 5.9 or 3.9 rad/s at the peak."""
    rng = np.random.default_rng(rate)
    guard = StreamGuard()
    for t in np.arange(0, 2.2, 1 / rate).tolist():
        frame = turn_space(person(t), np.pi * compute_minimum_jerk((t - 0.3) / seconds))
        if stream == "a fifth is lost" and rng.random() < 0.2:
            continue
        if stream == "120 ms are missing" and 0.9 < t < 1.02:
            continue
        if stream == "in bursts":  # every 60 ms some come right behind each other
            frame = dataclasses.replace(frame, time=0.06 * (t // 0.06) + 0.001 * (t % 0.06))
        assert guard.take(frame) is not None, t
    assert set(guard.counts) == {"taken"}


def test_a_jump_does_not_become_a_motion_by_waiting():
    """What could have been reached meanwhile was still jumped to."""
    guard = StreamGuard()
    run(guard, 0, 0.5)
    taken = run(
        guard, 0.5, 0.75, lambda f: dataclasses.replace(f, left_wrist=shift(f.left_wrist, 0.2))
    )
    tracked = [frame.tracked[1] for frame in taken]
    assert not any(tracked[:15])
    assert all(tracked[16:])


def test_jumps_to_and_fro_are_never_believed():
    guard = StreamGuard()
    run(guard, 0, 0.5)
    for i, t in enumerate(np.arange(50, 200) * DT):
        taken = guard.take(person(t, head=shift(person(t).head, (i % 2 + 1) * 1.0)))
        assert taken is None
    assert guard.counts["head_jump"] == 150


def test_old_frames_are_dropped():
    guard = StreamGuard()
    assert guard.take(person(1.0), source_time=1.0) is not None
    assert guard.take(person(1.1), source_time=0.9) is None
    assert guard.take(person(1.2), source_time=1.0) is None
    assert guard.take(person(1.3), source_time=np.nan) is None
    assert guard.take(person(1.4), source_time=1.4) is not None
    assert guard.take(person(1.4), source_time=1.5) is None
    assert guard.counts == {"taken": 2, "out_of_order": 3, "repeated": 1}


numbers = st.floats(width=32)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.lists(numbers, min_size=23, max_size=23), max_size=6))
def test_no_bad_number_ever_gets_through(rows):
    guard = StreamGuard()
    run(guard, 0, 0.05)
    for i, row in enumerate(rows):
        values = np.array(row)
        taken = guard.take(
            OperatorFrame(1.0 + i, values[:7], values[7:14], values[14:21], values[21:])
        )
        if taken is not None:
            for pose in (taken.head, taken.left_wrist, taken.right_wrist):
                assert np.isfinite(pose).all()
                assert np.linalg.norm(pose[3:]) == pytest.approx(1, abs=0.01)
            assert ((taken.pinch >= 0) & (taken.pinch <= 0.4)).all()


def test_people_are_not_refused():
    """Brisk but possible: a hand that is thrown out at 6 m/s, a turn of the head of 9 rad/s."""
    guard = StreamGuard()
    for i in range(40):
        t = i * DT
        frame = person(t)
        out = shift(frame.left_wrist, 0.3 * np.sin(20 * t))
        turned = make_pose(
            frame.head[:3], quat_multiply(frame.head[3:], quat_exp(np.array([0, 0, 9 * t])))
        )
        taken: Any = guard.take(dataclasses.replace(frame, left_wrist=out, head=turned))
        assert taken.tracked.all()


def test_config_errors():
    with pytest.raises(BadValue, match=r"guard\.stale must be finite and above 0, got 0"):
        GuardConfig(stale=0)
