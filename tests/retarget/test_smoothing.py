"""Limits of the change of rate: kept, without overshoot, and without getting in the way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xop_lerobot.core.command import CommandDim, CommandSpace, Mode, RobotAction
from xop_lerobot.core.errors import BadShape, BadValue
from xop_lerobot.morphology.limits import limit_action
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.retarget.smoothing import CommandSmoother, compute_braking_step

SPACE = CommandSpace(
    (
        CommandDim("lift", "lift.pos", "m", -0.2, 0.3, 0.0, 0.5, max_accel=4.0),
        CommandDim("v", "x.vel", "m/s", -1.0, 1.0, 0.0, 3.0, mobile_only=True, max_accel=40.0),
        CommandDim("free", "free.pos", "rad", -1.0, 1.0, 0.0, 2.0),
    )
)
SINGLE = 4e-7  # what single precision leaves open
wanted = st.lists(
    st.tuples(
        *(st.floats(-2, 2, width=32) for _ in range(3)),
        st.sampled_from(list(Mode)),
        st.integers(1, 6),
    ),
    min_size=1,
    max_size=12,
)


def drive(space: CommandSpace, dt: float, targets, smoother=None) -> np.ndarray:
    """Commands that are executed on the way through `targets` (command, mode, ticks)."""
    smoother = smoother or CommandSmoother(space, dt)
    executed, told = space.neutral.copy(), Mode.STATIONARY
    commands = [executed]
    for command, mode, ticks in targets:
        for _ in range(ticks):
            sent, told = smoother.smooth(np.array(command), mode, executed, told)
            limited = space.limit(sent, executed, dt, told).astype(np.float32).astype(float)
            np.testing.assert_allclose(limited, sent, atol=SINGLE)  # limiting is limiting once
            smoother.note(executed, limited)
            executed = limited
            commands.append(executed)
    return np.array(commands)


def assert_limits(space: CommandSpace, dt: float, commands: np.ndarray) -> None:
    assert (commands >= space.low - SINGLE).all()
    assert (commands <= space.high + SINGLE).all()
    steps = np.diff(commands, axis=0)
    assert (np.abs(steps) <= space.max_rate * dt + SINGLE).all()
    steps = np.concatenate([np.zeros((1, len(space))), steps])
    assert (np.abs(np.diff(steps, axis=0)) <= space.max_accel * dt**2 + 4 * SINGLE).all()


@settings(max_examples=150, deadline=None, derandomize=True)
@given(wanted, st.sampled_from([0.02, 0.04, 0.1]))
def test_whatever_is_wanted_the_limits_hold(targets, dt):
    plan = [(target[:3], target[3], target[4]) for target in targets]
    assert_limits(SPACE, dt, drive(SPACE, dt, plan))


@pytest.mark.parametrize("robot", ["g1", "rby1"])
def test_limits_of_the_robots(robot):
    space, rng = make_morphology(robot).command_space, np.random.default_rng(0)
    assert np.isfinite(space.max_accel).all()
    plan = [
        (rng.uniform(1.5 * space.low, 1.5 * space.high), Mode(int(rng.integers(2))), 5)
        for _ in range(200)
    ]
    for dt in (0.02, 0.04):
        assert_limits(space, dt, drive(space, dt, plan))


@pytest.mark.parametrize("dt", [0.02, 0.04, 0.1])
@pytest.mark.parametrize("target", [0.001, 0.01, 0.07, 0.25, 0.3])
def test_a_standing_target_is_reached_without_overshoot(dt, target):
    commands = drive(SPACE, dt, [((target, 0, 0), Mode.MOBILE, round(3 / dt))])[:, 0]
    assert (np.diff(commands) >= -SINGLE).all()
    assert commands[-1] == pytest.approx(target, abs=SINGLE)
    # Not slower than needed: full rate but for a ramp of 1/8 s at both ends.
    arrived = np.argmax(commands >= target - 1e-6) * dt
    assert arrived <= target / 0.5 + 0.5 / 4.0 + 3 * dt


def test_braking_step_is_the_largest_one_that_can_stop():
    rng = np.random.default_rng(0)
    for distance, gain in zip(rng.exponential(1, 300), rng.exponential(0.2, 300), strict=True):
        step = float(compute_braking_step(np.array([distance]), np.array([gain]))[0])
        assert 0 <= step <= distance + 1e-12
        assert slide(step, gain) <= distance * (1 + 1e-9)
        assert slide(step + 1e-3 * gain, gain) > distance
    assert compute_braking_step(np.array([0.3]), np.array([np.inf])) == [0.3]
    assert compute_braking_step(np.zeros(1), np.ones(1)) == [0]


def slide(step: float, gain: float) -> float:
    """How far one gets if every step is `gain` shorter than the one before."""
    length = 0.0
    while step > 0:
        length, step = length + step, step - gain
    return length


def test_without_a_limit_the_rate_alone_counts():
    commands = drive(SPACE, 0.04, [((0, 0, 1.0), Mode.MOBILE, 20)])[:, 2]
    np.testing.assert_allclose(np.diff(commands)[:12], 0.08, atol=1e-6)


def test_velocities_stop_smoothly_before_the_robot_is_told_to_stand():
    smoother = CommandSmoother(SPACE, 0.04)
    drive(SPACE, 0.04, [((0, 0.8, 0), Mode.MOBILE, 20)], smoother)
    executed, modes = np.array([0, np.float32(0.8), 0]), []
    while len(modes) < 20 and Mode.STATIONARY not in modes:
        wanted = np.array([0, 0.8, 0])
        sent, mode = smoother.smooth(wanted, Mode.STATIONARY, executed, Mode.MOBILE)
        modes.append(mode)
        sent = sent.astype(np.float32).astype(float)
        smoother.note(executed, sent)
        executed = sent
    assert executed[1] == 0
    assert 7 <= len(modes) <= 11  # 0.8 m/s at 3 m/s² are 6.7 ticks, and the two ramps


def test_a_walk_ends_at_its_own_rate():
    """Slower than a velocity may change while the robot walks."""
    slow = replace(SPACE, dims=tuple(replace(dim, stop_rate=1.0) for dim in SPACE.dims))
    smoother, executed, commands = CommandSmoother(slow, 0.04), np.array([0, 0.8, 0]), []
    mode = Mode.MOBILE
    while mode is Mode.MOBILE and len(commands) < 50:
        sent, mode = smoother.smooth(np.array([0, 0.8, 0]), Mode.STATIONARY, executed, mode)
        smoother.note(executed, sent)
        commands.append(executed[1])
        executed = sent
    assert executed[1] == 0
    assert np.abs(np.diff(commands)).max() == pytest.approx(0.04)


def test_after_somebody_else_drove_it_starts_from_rest():
    smoother = CommandSmoother(SPACE, 0.04)
    commands = drive(SPACE, 0.04, [((0.3, 0, 0), Mode.MOBILE, 5)], smoother)
    assert commands[-1, 0] - commands[-2, 0] == pytest.approx(0.02, abs=1e-6)
    executed = np.array([-0.1, 0, 0])
    sent, _ = smoother.smooth(np.array([0.3, 0, 0]), Mode.MOBILE, executed, Mode.MOBILE)
    assert sent[0] == pytest.approx(-0.1 + 4.0 * 0.04**2)


def test_single_precision_of_the_action_does_not_upset_it():
    """`limit_action` rounds; the smoother takes what was sent for what it sent."""
    morphology = make_morphology("rby1")
    space, rest = morphology.command_space, morphology.rest_action()
    smoother = CommandSmoother(space, 0.04)
    action = RobotAction(rest.command.astype(np.float32).astype(float), rest.mode, rest.arms)
    befores, steps = [], []
    for _ in range(6):
        sent, _ = smoother.smooth(space.high, Mode.MOBILE, action.command, action.mode)
        wanted = RobotAction(sent, Mode.MOBILE, action.arms)
        after = limit_action(morphology, wanted, action, 0.04)
        smoother.note(action.command, after.command)
        befores.append(action.command)
        steps.append(after.command - action.command)
        action = after
    gain = space.max_accel * 0.04**2
    for before, step, limit in ((befores[0], steps[0], gain), (befores[-1], steps[-1], np.inf)):
        missing = space.high - before
        rate = np.minimum(space.max_rate * 0.04, compute_braking_step(missing, gain))
        expected = np.minimum(space.straighten(rate, missing), limit)
        np.testing.assert_allclose(step, expected, rtol=1e-5)
    # Velocities change at their own rates, the posture as fast as its slowest joint allows.
    velocities, share = space.mobile_only, steps[-1] / (space.max_rate * 0.04)
    np.testing.assert_allclose(share[velocities], 1.0, rtol=1e-4)
    assert share[~velocities].max() == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize("name", ["g1", "rby1"])
def test_a_posture_changes_along_a_straight_line(name):
    """Quick joints do not run ahead of slow ones, and no joint is faster than its rate."""
    space = make_morphology(name).command_space
    smoother, executed = CommandSmoother(space, 0.04), space.neutral
    posture = ~space.mobile_only & [not dim.alone for dim in space.dims]
    wanted = np.where(posture, 0.7 * space.high + 0.3 * space.low, 0.0)
    path = [executed]
    for _ in range(200):
        sent, _ = smoother.smooth(wanted, Mode.STATIONARY, executed, Mode.STATIONARY)
        smoother.note(executed, sent)
        executed = sent
        path.append(executed)
    start, way = space.neutral[posture], (wanted - space.neutral)[posture]
    rows = np.array(path)[:, posture] - start
    shares = rows @ way / (way @ way)
    assert shares[-1] == pytest.approx(1.0)
    assert (np.diff(shares) >= -1e-9).all()
    off = np.abs(rows - shares[:, None] * way)
    assert off.max() < 0.03 * np.abs(way).max()  # as it sets off, by the limits of acceleration
    steps = np.abs(np.diff(rows, axis=0)) / (space.max_rate[posture] * 0.04)
    assert steps.max() == pytest.approx(1.0, rel=1e-6)


def test_mistakes():
    with pytest.raises(BadShape, match=r"command must have shape \(3,\), got \(2,\)"):
        smoother = CommandSmoother(SPACE, 0.04)
        smoother.smooth(np.zeros(2), Mode.MOBILE, np.zeros(3), Mode.MOBILE)
    with pytest.raises(BadValue, match="^max_accel of command 'x' must be positive, got 0$"):
        CommandDim("x", "x.pos", "m", 0, 1, 0.5, 1, max_accel=0)
    with pytest.raises(BadValue, match="command 'x' must have low <= neutral <= high, got 0, 2, 1"):
        CommandDim("x", "x.pos", "m", 0, 1, 2, 1)


def test_who_squats_stands_up_before_it_walks():
    """The mode is sent once the command is one that a walking robot can do; and back again."""
    space = SPACE.fit(
        {Mode.STATIONARY: {"lift": (-0.2, 0.1)}, Mode.MOBILE: {"lift": (0.05, 0.3)}}, {}
    )
    smoother = CommandSmoother(space, 0.02)
    executed, told, seen = np.array([-0.2, 0.0, 0.0]), Mode.STATIONARY, []
    for mode, lift, v in ((Mode.MOBILE, -0.2, 0.5), (Mode.MOBILE, 0.3, 0.5)):
        for _ in range(80):
            sent, told = smoother.smooth(np.array([lift, v, 0.0]), mode, executed, told)
            limited = space.limit(sent, executed, 0.02, told)
            np.testing.assert_allclose(limited, sent, atol=SINGLE)
            smoother.note(executed, limited)
            executed = limited
            seen.append((told, *executed[:2]))
    low = [lift for told, lift, _ in seen if told is Mode.STATIONARY]
    assert low
    assert max(low) <= 0.05 + SINGLE
    assert all(v == 0 for told, _, v in seen if told is Mode.STATIONARY)
    assert min(lift for told, lift, _ in seen if told is Mode.MOBILE) >= 0.05 - 1e-5
    assert executed[0] == pytest.approx(0.3, abs=1e-3)
    for _ in range(120):
        sent, told = smoother.smooth(np.array([0.3, 0, 0.0]), Mode.STATIONARY, executed, told)
        limited = space.limit(sent, executed, 0.02, told)
        smoother.note(executed, limited)
        executed = limited
        assert told is Mode.MOBILE or executed[0] <= 0.1 + SINGLE
    assert told is Mode.STATIONARY
