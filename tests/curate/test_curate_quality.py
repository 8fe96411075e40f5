"""Quality measures: known answers, slow references, and what they must not depend on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xop_lerobot.core.errors import BadShape
from xop_lerobot.core.transforms import pose_multiply, quat_exp
from xop_lerobot.curate import quality
from xop_lerobot.evaluation.metrics import compute_pose_errors, summarise_errors

DT = 0.04


def make_poses(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.hstack([rng.normal(size=(n, 3)), quat_exp(rng.normal(size=(n, 3)))])


def move(duration: float, dt: float, length: float = 1.0) -> np.ndarray:
    """A movement of minimum jerk along X. Shape (n, 1)."""
    s = np.arange(0, duration + dt / 2, dt) / duration
    return (length * (10 * s**3 - 15 * s**4 + 6 * s**5))[:, None]


def stand(n: int) -> np.ndarray:
    return np.tile([0.0, 0, 1.5, 1, 0, 0, 0], (n, 1))


# Tracking.


def test_errors_are_the_offset_that_was_put_in():
    goal = make_poses(50)
    offset = np.array([0.03, 0, 0.04, *quat_exp(np.array([0, 0.2, 0]))])
    distance, angle = compute_pose_errors(pose_multiply(goal, offset), goal)
    assert distance == pytest.approx(0.05)
    assert angle == pytest.approx(0.2)


def test_errors_of_equal_poses_are_zero_whatever_the_sign_of_the_quaternion():
    pose = make_poses(20)
    distance, angle = compute_pose_errors(pose, pose * [1, 1, 1, -1, -1, -1, -1])
    assert distance == pytest.approx(0)
    assert angle == pytest.approx(0, abs=1e-7)


def test_tracking_pools_the_frames_of_the_robot():
    near, far = (np.full(100, 0.1), np.full(100, 0.2)), (np.full(100, 0.5), np.full(100, 0.4))
    chosen = np.zeros(100, bool)
    chosen[50:] = True
    near[0][:50] = far[1][:50] = 9  # not chosen
    figures = summarise_errors([near, far], chosen)
    assert figures == pytest.approx((0.3, 0.5, 0.3, 0.4))
    assert summarise_errors([near], chosen) == pytest.approx((0.1, 0.1, 0.2, 0.2))


def test_tracking_of_nothing_is_nan():
    assert all(map(math.isnan, summarise_errors([], np.ones(3, bool))))
    errors = [(np.ones(3), np.ones(3))]
    assert all(map(math.isnan, summarise_errors(errors, np.zeros(3, bool))))


def test_wrong_shapes_are_named():
    with pytest.raises(BadShape, match=r"goal must have shape \(3, 7\), got \(4, 7\)"):
        compute_pose_errors(stand(3), stand(4))
    with pytest.raises(BadShape, match=r"pose must have shape \(3, 7\), got \(4, 7\)"):
        quality.find_idle([stand(4)], np.ones(3, bool), DT)
    with pytest.raises(BadShape, match=r"path must have shape \('n', 'k'\), got \(4,\)"):
        quality.compute_ldlj(np.zeros(4), DT)


def test_spread():
    assert quality.summarise_spread(np.arange(101.0)) == (50, 95, 100)
    assert all(map(math.isnan, quality.summarise_spread(np.zeros(0))))


# Smoothness.


def test_minimum_jerk_has_the_value_of_the_formula():
    # Integral of the squared jerk is 720 A²/T⁵, the peak speed 1.875 A/T.
    expected = -math.log(720 / 1.875**2)
    assert quality.compute_ldlj(move(2.0, 0.001), 0.001) == pytest.approx(expected, abs=0.01)
    assert quality.compute_ldlj(move(2.0, DT), DT) == pytest.approx(expected, abs=0.2)


@given(scale=st.floats(1e-3, 1e3), shift=st.floats(-10, 10))
@settings(max_examples=25, deadline=None)
def test_smoothness_does_not_depend_on_size_or_place(scale, shift):
    path = move(2.0, DT) + 0.01 * np.random.default_rng(0).normal(size=(51, 1))
    value = quality.compute_ldlj(path, DT)
    assert quality.compute_ldlj(scale * path + shift, DT) == pytest.approx(value, rel=1e-3)


def test_noise_is_less_smooth_and_more_of_it_still_less():
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(51, 1))
    values = [quality.compute_ldlj(move(2, DT) + k * noise, DT) for k in (0, 1e-3, 1e-2, 1e-1)]
    assert values == sorted(values, reverse=True)
    assert values[0] - values[-1] > 3


def test_smoothness_does_not_depend_on_how_long_the_episode_is():
    there, back = move(2, DT), move(2, DT)[::-1]
    once = quality.compute_ldlj(there, DT)
    often = np.concatenate([there, *[back[1:], there[1:]] * 5])
    assert quality.compute_ldlj(often, DT) == pytest.approx(once)


def test_smoothness_stays_in_runs_of_chosen_frames():
    path = np.concatenate([move(2, DT), 100 + move(2, DT)])  # a leap between two movements
    first = np.arange(len(path)) < 51
    assert quality.compute_ldlj(path, DT, first) == quality.compute_ldlj(path[:51], DT)
    both = np.ones(len(path) + 1, bool)
    both[51] = False
    apart = quality.compute_ldlj(np.insert(path, 51, 0, axis=0), DT, both)
    assert apart == pytest.approx(quality.compute_ldlj(path[:51], DT))
    assert math.isnan(quality.compute_ldlj(path[:40], DT))
    assert math.isnan(quality.compute_ldlj(np.zeros((100, 3)), DT))
    assert math.isnan(quality.compute_ldlj(path, 1.0))


# Gaps and clocks.


def test_gaps_begin_after_engaging():
    tracked = np.ones((100, 3), bool)
    tracked[:20] = False  # before anybody was there
    tracked[40:50, 1] = False
    tracked[50:52, 2] = False
    tracked[90:, 0] = False
    engaged = np.arange(100) >= 20
    engaged[90:] = False  # losing the head ends the engagement, and is a gap all the same
    gaps = quality.find_gaps(tracked, engaged)
    assert quality.summarise_gaps(gaps, DT) == (2, pytest.approx(22 * DT), pytest.approx(12 * DT))


def test_no_gaps_without_an_operator():
    gaps = quality.find_gaps(np.zeros((10, 3), bool), np.zeros(10, bool))
    assert quality.summarise_gaps(gaps, DT) == (0, 0, 0)


def test_late_and_missing_frames():
    stamps = np.array([0, 1, 2, 3.6, 4, 7, 8]) * DT
    assert quality.count_late(stamps, DT) == 2
    assert quality.count_missing(stamps, DT) == 3  # one of 1.6 periods is rounded to two
    assert quality.count_late(stamps[:1], DT) == quality.count_missing(stamps[:1], DT) == 0


# Idle time.


def test_still_is_what_a_plain_loop_finds():
    rng = np.random.default_rng(2)
    points = np.cumsum(rng.normal(size=(200, 4)) * rng.integers(0, 2, (200, 1)), axis=0)
    size = 13  # 0.5 s at 25 Hz, centred
    expected = [
        np.ptp(points[max(i - size // 2, 0) : i + size // 2 + 1], axis=0).max() <= 2.5
        for i in range(200)
    ]
    assert quality.find_still(points, DT, 2.5).tolist() == expected
    assert 0 < sum(expected) < 200


def test_a_turning_hand_is_not_still():
    pose = stand(100)
    angle = np.clip(np.arange(100) - 50, 0, None)[:, None] * 0.01 * np.array([0, 0, 1])
    pose[:, 3:] = quat_exp(angle)
    still = quality.find_still(quality.make_points(pose), DT, 0.02)
    assert still[:44].all()
    assert not still[60:94].any()  # half the window is missing at the end


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_turning_about_any_axis_moves_a_point(axis):
    pose = stand(2)
    pose[1, 3:] = quat_exp(0.1 * np.eye(3)[axis])
    assert np.ptp(quality.make_points(pose), axis=0).max() > 0.02


def test_idle_is_nobody_driving_or_nobody_moving():
    person, robot = stand(200), stand(200)
    person[100:150, 0] = 1.0 + np.arange(50) * 0.02
    person[150:, 0] = person[149, 0]
    robot[110:160, 0] = 1.0 + np.arange(50) * 0.02  # it comes after
    robot[160:, 0] = robot[159, 0]
    engaged = np.arange(200) >= 50
    idle = quality.find_idle([person, robot], engaged, DT)
    first, last = quality.find_active_span(idle)
    assert 94 <= first <= 100
    assert 160 <= last <= 166
    assert idle[:90].all()
    assert idle[170:].all()
    assert quality.find_active_span(np.ones(5, bool)) == (5, 5)
    assert quality.find_active_span(np.zeros(5, bool)) == (0, 5)


def test_swaying_person_is_idle():
    t = np.arange(500) * DT
    person = stand(500)
    person[:, 0] += 0.004 * math.sqrt(2) * np.sin(2 * math.pi * 0.5 * t)  # quiet standing
    assert quality.find_idle([person], np.ones(500, bool), DT).all()
