"""The paper's figures on trajectories made by hand, whose figures follow from a formula."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xop_lerobot.core.errors import BadShape, BadValue
from xop_lerobot.core.transforms import make_pose, quat_exp, quat_from_yaw, quat_multiply
from xop_lerobot.evaluation.metrics import (
    compute_balance_power,
    compute_jerk,
    compute_longest_hold,
    compute_roughness,
    compute_slip,
    compute_tilt,
    compute_tracking_error,
    find_runs,
)
from xop_lerobot.evaluation.summary import compute_mean_interval, compute_rate_interval

DT = 0.04


def test_power_of_known_torques():
    effort = np.array([[2.0, -3.0], [4.0, 1.0], [100.0, 100.0]])
    velocity = np.array([[1.0, 1.0], [-1.0, 0.0], [9.0, 9.0]])
    power = compute_balance_power(effort, velocity, np.array([True, True, False]))
    # |2|, |-3|, |-4|, |0| over two joints and two standing ticks; the walking tick is left out.
    assert power.absolute == pytest.approx(9 / 4)
    assert power.signed == pytest.approx(-5 / 4)


def test_power_of_a_robot_that_never_stands_is_nan():
    power = compute_balance_power(np.ones((3, 2)), np.ones((3, 2)), np.zeros(3, bool))
    assert math.isnan(power.absolute) and math.isnan(power.signed)


def test_signed_power_of_a_whole_period_cancels_and_its_magnitude_does_not():
    time = np.arange(0, 1, 0.001)
    velocity = np.cos(2 * np.pi * time)[:, None]
    effort = np.sin(2 * np.pi * time)[:, None]
    power = compute_balance_power(effort, velocity, np.ones(len(time), bool))
    assert power.signed == pytest.approx(0, abs=1e-9)
    assert power.absolute == pytest.approx(1 / np.pi, rel=1e-4)  # mean of |sin 2x| / 2


def test_power_wants_one_velocity_for_each_torque():
    with pytest.raises(BadShape, match=r"velocity must have shape \(3, 2\), got \(3, 1\)"):
        compute_balance_power(np.ones((3, 2)), np.ones((3, 1)), np.ones(3, bool))
    with pytest.raises(BadShape, match=r"standing must have shape \(3,\), got \(2,\)"):
        compute_balance_power(np.ones((3, 2)), np.ones((3, 2)), np.ones(2, bool))


@pytest.mark.parametrize("dt", [0.04, 0.02])
def test_jerk_of_a_cubic_is_exact(dt):
    time = np.arange(0, 3, dt)
    position = np.stack([2 * time**3, -(time**3), time**2], axis=1)
    assert compute_jerk(position, dt) == pytest.approx(6 * math.sqrt(5), rel=1e-6)


@pytest.mark.parametrize("dt", [0.04, 0.02])
@pytest.mark.parametrize("hertz", [0.3, 0.7, 1.0])
def test_jerk_of_a_sinusoid(dt, hertz):
    time = np.arange(0, 10 / hertz, dt)
    omega = 2 * np.pi * hertz
    position = np.zeros((len(time), 3))
    position[:, 1] = 0.1 * np.sin(omega * time)
    # The mean of |cos| is 2/π; the filter takes the less, the slower the motion.
    assert compute_jerk(position, dt) == pytest.approx(0.1 * omega**3 * 2 / np.pi, rel=0.12)


def test_jerk_grows_with_a_tremor_and_is_none_for_a_straight_line():
    time = np.arange(0, 5, DT)
    line = np.stack([time, 0.5 * time, 0 * time], axis=1)
    assert compute_jerk(line, DT) == pytest.approx(0, abs=1e-8)
    shaken = line + 0.002 * np.sin(2 * np.pi * 3 * time)[:, None]
    assert compute_jerk(shaken, DT) > 5


def test_jerk_never_reaches_over_a_gap():
    time = np.arange(0, 4, DT)
    position = np.stack([time, 0 * time, 0 * time], axis=1)
    position[50:] += 10.0  # a jump, at the ticks that do not count
    chosen = np.ones(len(time), bool)
    chosen[49:51] = False
    assert compute_jerk(position, DT, chosen) == pytest.approx(0, abs=1e-6)
    assert compute_jerk(position, DT) > 1000
    assert math.isnan(compute_jerk(position, DT, np.zeros(len(time), bool)))


def test_jerk_wants_a_filter_that_holds_a_cubic():
    with pytest.raises(BadValue, match=r"a filter of 0.24 s has 3 points at 5 Hz, it needs 4"):
        compute_jerk(np.zeros((10, 3)), 0.2)


@given(st.floats(0, 1.5), st.floats(-3, 3))
def test_tilt_of_a_hand_at_constant_tilt(tilt, yaw):
    down = quat_multiply(quat_from_yaw(yaw), quat_exp(np.array([tilt, 0, 0])))
    assert compute_tilt(np.tile(down, (5, 1))) == pytest.approx(tilt, abs=1e-6)
    up = quat_multiply(down, quat_exp(np.array([0, np.pi, 0])))
    assert compute_tilt(np.tile(up, (5, 1))) == pytest.approx(tilt, abs=1e-6)


def test_tilt_of_a_hand_that_turns_over_is_half_a_turn():
    quats = np.array([quat_exp(np.array([angle, 0, 0])) for angle in (0, np.pi)])
    assert compute_tilt(quats) == pytest.approx(np.pi / 2)
    assert compute_tilt(quats, np.array([True, False])) == pytest.approx(0)
    assert math.isnan(compute_tilt(quats, np.zeros(2, bool)))


def test_tracking_error_leaves_out_what_has_no_goal():
    pose = make_pose(np.zeros((4, 3)), np.tile([1.0, 0, 0, 0], (4, 1)))
    goal = pose.copy()
    goal[:, 0] = [0.1, 0.3, 5.0, 0.0]
    goal[0, 3:] = quat_from_yaw(0.5)
    goal[2] = np.nan
    error = compute_tracking_error(pose, goal)
    assert error.mean == pytest.approx(0.4 / 3)
    assert error.angle_mean == pytest.approx(0.5 / 3)
    assert error.p95 == pytest.approx(0.28)
    assert math.isnan(compute_tracking_error(pose, np.full((4, 7), np.nan)).mean)


def test_roughness_of_a_parabola_and_of_a_ramp():
    time = np.arange(10) * DT
    command = np.stack([0.5 * time**2, 3 * time], axis=1)
    assert compute_roughness(command, np.array([0.5, 1.0]), DT) == pytest.approx(math.sqrt(2))
    assert compute_roughness(command[:, 1:], np.ones(1), DT) == pytest.approx(0, abs=1e-9)
    assert math.isnan(compute_roughness(command[:2], np.ones(2), DT))


def test_slip_counts_only_feet_that_bear():
    time = np.arange(50) * DT
    feet = np.zeros((50, 2, 3))
    feet[:, 0, 0] = 0.1 * time  # slides at 0.1 m/s
    feet[1:, 1, 2] = 0.05  # in the air, after it has stood once
    feet[:, 1, 0] = 3 * time
    assert compute_slip(feet, DT) == pytest.approx(0.1)
    assert math.isnan(compute_slip(np.zeros((50, 0, 3)), DT))


def test_longest_hold():
    within = np.array([0, 1, 1, 1, 0, 1, 1], bool)
    assert compute_longest_hold(within, 0.5) == pytest.approx(1.0)
    assert compute_longest_hold(np.zeros(4, bool), 0.5) == 0
    assert find_runs(within) == [(1, 4), (5, 7)]
    assert find_runs(np.zeros(0, bool)) == []


def test_wilson_interval_of_known_rates():
    # Values of the closed formula with z = 1.959964.
    z = 1.959964
    for count, trials in ((20, 20), (0, 20), (7, 10)):
        rate = count / trials
        middle = (rate + z * z / 2 / trials) / (1 + z * z / trials)
        half = z * math.sqrt(rate * (1 - rate) / trials + z * z / 4 / trials**2)
        half /= 1 + z * z / trials
        assert compute_rate_interval(count, trials) == pytest.approx(
            (middle - half, middle + half), abs=1e-6
        )
    with pytest.raises(BadValue, match="got 3 of 2"):
        compute_rate_interval(3, 2)


def test_bootstrap_interval_holds_the_mean_and_narrows():
    rng = np.random.default_rng(1)
    few, many = rng.normal(5, 2, 10), rng.normal(5, 2, 1000)
    low, high = compute_mean_interval(list(few))
    assert low < few.mean() < high
    width = np.diff(compute_mean_interval(list(many)))[0]
    assert width == pytest.approx(2 * 1.96 * 2 / math.sqrt(1000), rel=0.15)
    assert compute_mean_interval(list(few)) == (low, high)  # the same draws each time
    assert compute_mean_interval([3.0, math.nan]) == (3.0, 3.0)
    assert math.isnan(compute_mean_interval([]).low)
