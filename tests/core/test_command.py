"""Command spaces and actions: bounds, rates, modes, and LeRobot's flat dictionaries."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xop_lerobot.core.command import (
    MODE_KEY,
    ActionLayout,
    CommandDim,
    CommandSpace,
    Mode,
    RobotAction,
    check_vector,
)
from xop_lerobot.core.errors import BadShape, BadValue, UnknownName

SPACE = CommandSpace(
    (
        CommandDim("height", "height.pos", "m", 0.5, 0.8, 0.75, 0.5),
        CommandDim("vx", "x.vel", "m/s", -1.0, 1.0, 0.0, 2.0, mobile_only=True),
    )
)
LAYOUT = ActionLayout(SPACE, ("elbow", "gripper"))
REST = RobotAction(SPACE.neutral, Mode.STATIONARY, np.array([0.2, 0.05]))

wild = st.tuples(*[st.floats(-3, 3)] * 2).map(np.array)
inside = st.tuples(st.floats(0.5, 0.8), st.floats(-1, 1)).map(np.array)
modes = st.sampled_from(list(Mode))
periods = st.sampled_from([0.02, 0.04, 0.1])


# -- limits --------------------------------------------------------------------------------


@given(wild, inside, periods, modes)
def test_limiting_twice_is_limiting_once(command, previous, dt, mode):
    once = SPACE.limit(command, previous, dt, mode)
    np.testing.assert_array_equal(SPACE.limit(once, previous, dt, mode), once)


@given(wild, inside, periods, modes)
def test_limits_hold(command, previous, dt, mode):
    limited = SPACE.limit(command, previous, dt, mode)
    assert (limited >= SPACE.low).all()
    assert (limited <= SPACE.high).all()
    assert (np.abs(limited - previous) <= SPACE.max_rate * dt + 1e-12).all()


@given(inside, periods)
def test_what_is_allowed_is_left_alone(command, dt):
    np.testing.assert_array_equal(SPACE.limit(command, command, dt, Mode.MOBILE), command)
    np.testing.assert_array_equal(SPACE.limit(command, None, dt, Mode.MOBILE), command)


def test_mobile_entries_go_to_neutral_at_their_rate_in_stationary_mode():
    walking = np.array([0.7, 1.0])
    first = SPACE.limit(walking, walking, 0.1, Mode.STATIONARY)
    np.testing.assert_allclose(first, [0.7, 0.8])
    command = walking
    for _ in range(5):
        command = SPACE.limit(walking, command, 0.1, Mode.STATIONARY)
    np.testing.assert_allclose(command, [0.7, 0.0], atol=1e-12)
    np.testing.assert_array_equal(SPACE.limit(walking, None, 0.1, Mode.STATIONARY), [0.7, 0.0])


SQUATTING = SPACE.fit(
    {Mode.STATIONARY: {"height": (0.4, 0.78)}, Mode.MOBILE: {"height": (0.7, 0.78)}}, {"vx": 0.2}
)
"""What is left of the space with a policy that squats standing, and has a dead zone walking."""


def test_a_policy_narrows_the_bounds_by_mode():
    assert SQUATTING.low.tolist() == [0.5, -1.0]  # the robot's own bound is narrower
    assert SQUATTING.high.tolist() == [0.78, 1.0]
    assert SQUATTING.dims[0].neutral == 0.75
    low = np.array([0.3, 0.0])
    np.testing.assert_array_equal(SQUATTING.restrict(low, Mode.STATIONARY), [0.5, 0.0])
    np.testing.assert_array_equal(SQUATTING.restrict(low, Mode.MOBILE), [0.7, 0.0])
    np.testing.assert_array_equal(SPACE.restrict(low, Mode.MOBILE), [0.5, 0.0])
    rising = SQUATTING.limit(low, np.array([0.5, 0.0]), 0.1, Mode.MOBILE)
    np.testing.assert_allclose(rising, [0.55, 0.0])  # at the rate, from wherever it is
    assert SQUATTING.fit(SQUATTING.ranges, SQUATTING.dead_zones).dims == SQUATTING.dims
    longer = SQUATTING.extend((CommandDim("elbow", "elbow.pos", "rad", -1, 1, 0, 1),))
    np.testing.assert_array_equal(longer.bounds(Mode.MOBILE)[0], [0.7, -1.0, -1.0])


def test_a_policy_sets_the_rate_at_which_a_walk_ends():
    fitted = SPACE.fit({}, {}, {"vx": 0.5})
    walking = np.array([0.7, 1.0])
    np.testing.assert_array_equal(
        fitted.compute_max_rate(Mode.MOBILE, walking), SPACE.compute_max_rate(Mode.MOBILE, walking)
    )
    assert fitted.compute_max_rate(Mode.STATIONARY, walking)[1] == 0.5
    with pytest.raises(BadValue) as error:
        SPACE.fit({}, {}, {"height": 0.5})
    assert str(error.value) == "the policy's stop rate must be of a velocity, got 'height'"
    with pytest.raises(BadValue) as error:
        SPACE.fit({}, {}, {"vx": 0.0})
    assert str(error.value) == "stop_rate of command 'vx' must be positive, got 0.0"
    with pytest.raises(UnknownName):
        SPACE.fit({}, {}, {"high": 1.0})


def test_ranges_that_do_not_fit_the_robot_are_named():
    with pytest.raises(BadValue) as error:
        SPACE.fit({Mode.MOBILE: {"height": (0.2, 0.4)}}, {})
    assert str(error.value) == (
        "command 'height' is 0.5 to 0.8 m for this robot, and the policy's range in mobile mode is "
        "0.2 to 0.4"
    )
    with pytest.raises(UnknownName):
        SPACE.fit({Mode.MOBILE: {"high": (0.2, 0.4)}}, {})


def test_planned_velocities_leave_a_dead_zone_by_its_nearer_end():
    for planned, acts in ((0.05, 0.0), (-0.05, 0.0), (0.15, 0.2), (-0.15, -0.2), (0.3, 0.3)):
        got = SQUATTING.leave_dead_zones(np.array([0.75, planned]), Mode.MOBILE)
        np.testing.assert_array_equal(got, [0.75, acts])
    slow = np.array([0.75, 0.15])
    np.testing.assert_array_equal(SQUATTING.leave_dead_zones(slow, Mode.STATIONARY), slow)
    np.testing.assert_array_equal(SQUATTING.restrict(slow, Mode.MOBILE), slow)


SWAYING = CommandSpace(
    (
        CommandDim("height", "height.pos", "m", 0.5, 0.8, 0.75, 0.5),
        CommandDim(
            "vx", "x.vel", "m/s", -1.0, 1.0, 0.0, 2.0, mobile_only=True, sway=0.15, sway_rate=0.1
        ),
        CommandDim("yaw_rate", "theta.vel", "rad/s", -1.0, 1.0, 0.0, 3.0, mobile_only=True),
    )
)
"""A space whose first velocity may sway a standing robot, and whose second may not."""

three = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
executable = st.tuples(st.floats(0.5, 0.8), st.floats(-1, 1), st.floats(-1, 1)).map(np.array)


def test_stationary_leaves_a_sway_and_nothing_else_of_a_velocity():
    walking = np.array([0.7, 0.6, -0.4])
    got = SWAYING.restrict(walking, Mode.STATIONARY)
    np.testing.assert_array_equal(got, [0.7, 0.15, 0.0])
    small = np.array([0.9, -0.1, 0.0])
    np.testing.assert_array_equal(SWAYING.restrict(small, Mode.STATIONARY), [0.8, -0.1, 0.0])
    np.testing.assert_array_equal(SWAYING.restrict(walking, Mode.MOBILE), walking)
    batch = np.tile(walking, (2, 5, 1))
    np.testing.assert_array_equal(SWAYING.restrict(batch, Mode.STATIONARY), np.tile(got, (2, 5, 1)))


def test_at_rest_a_walking_robot_stops_and_a_standing_one_keeps_its_sway():
    command = np.array([0.6, 0.1, 0.3])
    np.testing.assert_array_equal(SWAYING.compute_rest(command, Mode.MOBILE), [0.6, 0.0, 0.0])
    np.testing.assert_array_equal(SWAYING.compute_rest(command, Mode.STATIONARY), [0.6, 0.1, 0.0])
    most = np.array([0.6, np.float32(0.15), 0.0])  # as the robot executes it
    np.testing.assert_array_equal(SWAYING.compute_rest(most, Mode.STATIONARY), most)


def test_a_standing_robot_that_is_being_stopped_has_no_sway_to_keep():
    """Faster than any sway: it walked until just now."""
    for velocity in (0.16, -0.6):
        command = np.array([0.6, velocity, 0.0])
        rest = SWAYING.compute_rest(command, Mode.STATIONARY)
        np.testing.assert_array_equal(rest, [0.6, 0.0, 0.0])


@pytest.mark.parametrize(
    "mode, velocity, rate",
    [
        (Mode.MOBILE, 0.0, 2.0),
        (Mode.STATIONARY, 0.0, 0.1),
        (Mode.STATIONARY, 0.15, 0.1),
        (Mode.STATIONARY, np.float32(0.15), 0.1),  # as the robot executes it
        (Mode.STATIONARY, 0.2, 2.0),  # faster than any sway: it is being stopped
        (Mode.STATIONARY, -0.9, 2.0),
    ],
)
def test_a_sway_is_slow_and_a_stop_is_not(mode, velocity, rate):
    got = SWAYING.compute_max_rate(mode, np.array([0.75, velocity, 0.0]))
    np.testing.assert_array_equal(got, [0.5, rate, 3.0])


def test_without_a_sway_the_rates_are_always_the_same():
    for mode in Mode:
        np.testing.assert_array_equal(SPACE.compute_max_rate(mode, SPACE.neutral), SPACE.max_rate)


def test_a_robot_that_walked_stops_fast_and_then_sways_slowly():
    """From 1 m/s at 2 m/s² to the largest sway, and on to the other one at 0.1 m/s²."""
    command, seen = np.array([0.75, 1.0, 0.0]), []
    for _ in range(100):
        command = SWAYING.limit(np.array([0.75, -0.15, 0.0]), command, 0.04, Mode.STATIONARY)
        seen.append(command[1])
    steps = -np.diff([1.0, *seen])
    assert steps[:10] == pytest.approx(0.08)
    slow = np.flatnonzero(np.array(seen) <= 0.15 + 1e-6)[0] + 1
    assert (steps[slow:] <= 0.004 + 1e-12).all()
    assert seen[-1] == pytest.approx(-0.15)


@given(three, executable, periods, modes)
def test_limiting_in_single_precision_twice_is_limiting_once(command, previous, dt, mode):
    """What is recorded, as a float32, is what the robot executes when it limits again."""
    previous = previous.astype(np.float32).astype(float)
    once = SWAYING.limit(command, previous, dt, mode).astype(np.float32).astype(float)
    twice = SWAYING.limit(once, previous, dt, mode).astype(np.float32).astype(float)
    np.testing.assert_array_equal(twice, once)


@given(three, executable, periods)
def test_a_sway_never_gets_out_of_hand(command, previous, dt):
    """Whatever it starts with, a standing robot's velocity comes to its bounds and stays there."""
    executed = previous
    for _ in range(60):
        executed = SWAYING.limit(command, executed, dt, Mode.STATIONARY)
    assert abs(executed[1]) <= 0.15 + 1e-12
    assert executed[2] == 0


def test_a_previous_command_out_of_bounds_is_left_at_its_rate():
    np.testing.assert_allclose(
        SPACE.limit(np.array([0.75, 0]), np.array([1.0, 0]), 0.1, Mode.MOBILE), [0.95, 0.0]
    )


@pytest.mark.parametrize(
    "command, error, text",
    [
        (np.zeros(3), BadShape, "command must have shape (2,), got (3,)"),
        (np.zeros((1, 2)), BadShape, "command must have shape (2,), got (1, 2)"),
        ([0.7, np.nan], BadValue, "command must be finite, got [0.7 nan]"),
        ([0.7, np.inf], BadValue, "command must be finite, got [0.7 inf]"),
    ],
)
def test_bad_commands_are_refused(command, error, text):
    with pytest.raises(error) as caught:
        SPACE.limit(command, None, 0.02, Mode.MOBILE)
    assert str(caught.value) == text


def test_check_vector_makes_floats():
    assert check_vector("ints", np.array([1, 2]), 2).dtype == float


def test_columns_follow_the_order_and_are_read_only():
    assert SPACE.names == ("height", "vx")
    assert SPACE.keys == ("height.pos", "x.vel")
    assert SPACE.index("vx") == 1
    np.testing.assert_array_equal(SPACE.mobile_only, [False, True])
    for column in (SPACE.low, SPACE.high, SPACE.neutral, SPACE.max_rate, SPACE.mobile_only):
        with pytest.raises(ValueError, match="read-only"):
            column[0] = 0


def test_an_unknown_entry_lists_the_known_ones():
    with pytest.raises(UnknownName) as caught:
        SPACE.index("vy")
    assert str(caught.value) == "unknown command 'vy'. Known: height, vx"


# -- the flat dictionary -------------------------------------------------------------------


@given(inside, modes, st.tuples(*[st.floats(-2, 2)] * 2).map(np.array))
def test_round_trip(command, mode, arms):
    action = RobotAction(command, mode, arms)
    flat = LAYOUT.to_dict(action)
    assert tuple(flat) == LAYOUT.keys
    assert all(type(value) is float for value in flat.values())
    back = LAYOUT.from_dict(flat, REST)
    np.testing.assert_array_equal(back.command, command)
    np.testing.assert_array_equal(back.arms, arms)
    assert back.mode is mode


def test_keys_are_commands_then_mode_then_arms():
    assert LAYOUT.keys == ("height.pos", "x.vel", "mode.pos", "elbow.pos", "gripper.pos")


def test_what_is_absent_stays_as_it_was():
    previous = RobotAction(np.array([0.6, 0.3]), Mode.MOBILE, np.array([1.0, 0.01]))
    action = LAYOUT.from_dict({"elbow.pos": -0.5}, previous)
    np.testing.assert_array_equal(action.command, [0.6, 0.3])
    np.testing.assert_array_equal(action.arms, [-0.5, 0.01])
    assert action.mode is Mode.MOBILE


@pytest.mark.parametrize(
    "value, mode",
    [(0, Mode.STATIONARY), (0.49, Mode.STATIONARY), (0.5, Mode.MOBILE), (1.3, Mode.MOBILE)],
)
def test_the_mode_is_the_nearer_of_the_two(value, mode):
    """A learned policy predicts any number between."""
    assert LAYOUT.from_dict({MODE_KEY: value}, REST).mode is mode


def test_an_unknown_key_lists_the_known_ones():
    with pytest.raises(UnknownName) as caught:
        LAYOUT.from_dict({"heigth.pos": 0.7}, REST)
    assert str(caught.value) == (
        "unknown action key 'heigth.pos'. "
        "Known: elbow.pos, gripper.pos, height.pos, mode.pos, x.vel"
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", ["x.vel", "mode.pos", "elbow.pos"])
def test_a_value_that_is_not_finite_is_refused(key, value):
    with pytest.raises(BadValue) as caught:
        LAYOUT.from_dict({key: value}, REST)
    assert str(caught.value) == f"action '{key}' must be finite, got {value}"
