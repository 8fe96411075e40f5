"""The filter of live headsets: it calms what rests, and is hardly late in what moves."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import make_pose, quat_exp, quat_log, quat_multiply
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.one_euro import (
    OneEuro,
    OneEuroConfig,
    OneEuroPose,
    compute_share,
    make_one_euro,
)
from xop_lerobot.operator.recording import load_recording

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[3] / "shared"))
RATE = 72
UNIT = np.array([1.0, 0, 0, 0])


def smooth(times, poses, config: OneEuroConfig | None = None) -> np.ndarray:
    limb = OneEuroPose(config or OneEuroConfig())
    return np.array([limb.update(float(t), pose) for t, pose in zip(times, poses, strict=True)])


def test_as_published_along_a_line():
    """Slow reference: the scalar filter of [1], on a motion along x alone."""
    c = OneEuroConfig()
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.005, 0.03, 200))
    xs = np.cumsum(rng.normal(0, 0.01, 200))
    hat, dx, wanted = xs[0], 0.0, [xs[0]]
    for i in range(1, 200):
        dt = times[i] - times[i - 1]
        tau = 1 / (2 * np.pi * c.speed_cutoff)
        share = 1 / (1 + tau / dt)
        dx = share * (xs[i] - xs[i - 1]) / dt + (1 - share) * dx
        tau = 1 / (2 * np.pi * (c.min_cutoff + c.position_beta * abs(dx)))
        share = 1 / (1 + tau / dt)
        hat = share * xs[i] + (1 - share) * hat
        wanted.append(hat)
    out = smooth(times, [make_pose(np.array([x, 0, 0]), UNIT) for x in xs])
    np.testing.assert_allclose(out[:, 0], wanted, atol=1e-12)


def test_what_rests_is_calm():
    rng = np.random.default_rng(0)
    times = np.arange(0, 20, 1 / RATE)
    places = rng.normal(0, 0.001, (len(times), 3))
    turns = rng.normal(0, 0.005, (len(times), 3))
    poses = [make_pose(p, quat_exp(r)) for p, r in zip(places, turns, strict=True)]
    out = smooth(times, poses)[RATE:]
    assert out[:, :3].std() < 0.35 * places.std()
    angles = np.array([quat_log(pose[3:]) for pose in out])
    assert angles.std() < 0.35 * turns.std()


def test_what_rests_is_not_moved():
    pose = make_pose(np.array([0.3, 0.2, 1.1]), quat_exp(np.array([0.3, -2.0, 0.1])))
    out = smooth(np.arange(0, 1, 1 / RATE), [pose] * RATE)
    np.testing.assert_allclose(np.abs(out), np.abs(np.tile(pose, (RATE, 1))), atol=1e-12)


@pytest.mark.parametrize(("speed", "late"), [(0.05, 0.06), (0.3, 0.014), (1.0, 0.005)])
def test_what_moves_is_hardly_late(speed, late):
    times = np.arange(0, 3, 1 / RATE)
    poses = [make_pose(np.array([speed * t, 0, 0]), UNIT) for t in times]
    lag = (poses[-1][0] - smooth(times, poses)[-1, 0]) / speed
    assert 0 < lag < late


@pytest.mark.parametrize(("rate", "late"), [(0.2, 0.065), (1.0, 0.02), (3.0, 0.008)])
def test_what_turns_is_hardly_late(rate, late):
    times = np.arange(0, 1, 1 / RATE)
    poses = [make_pose(np.zeros(3), quat_exp(np.array([0, 0, rate * t]))) for t in times]
    lag = times[-1] - quat_log(smooth(times, poses)[-1, 3:])[2] / rate
    assert 0 < lag < late


def test_real_hands_and_heads_are_late_by_milliseconds():
    """The shift in time that fits best between a recording and what is made of it."""
    files = sorted((SHARED / "operator").glob("*.npz"))
    if not files:
        pytest.skip("the real recordings are not here")
    shifts = np.arange(-0.005, 0.05, 0.0005)
    for file in files:
        recording = load_recording(file)
        times = np.arange(0, recording.duration, 1 / RATE)
        frames = [recording.frame_at(float(t)) for t in times]
        for name in ("head", "left_wrist", "right_wrist"):
            poses = np.array([frame.pose(name) for frame in frames])
            axis = int(np.argmax(np.ptp(poses[:, :3], axis=0)))
            raw, out = poses[:, axis], smooth(times, poses)[:, axis]
            errors = [np.mean((np.interp(times - s, times, raw) - out)[20:] ** 2) for s in shifts]
            assert shifts[np.argmin(errors)] < 0.012, (file.name, name)


@settings(max_examples=25, deadline=None)
@given(
    sign=st.sampled_from([1, -1]),
    angle=st.floats(-3, 3),
    dt=st.floats(0.001, 0.2),
    step=st.floats(-1, 1),
)
def test_between_the_last_and_the_new_pose(sign, angle, dt, step):
    """Whatever the sign of the quaternion, it goes the shorter way and never too far."""
    limb = OneEuroPose(OneEuroConfig())
    limb.update(0.0, make_pose(np.zeros(3), UNIT))
    turned = quat_exp(np.array([0, 0, angle]))
    out = limb.update(dt, make_pose(np.array([step, 0, 0]), sign * turned))
    assert min(0, step) <= out[0] <= max(0, step)
    got = quat_log(out[3:] * np.sign(out[3]))[2]
    assert min(0, angle) - 1e-9 <= got <= max(0, angle) + 1e-9
    assert np.linalg.norm(out[3:]) == pytest.approx(1)


def test_a_limb_that_is_lost_begins_anew():
    def make(t: float, x: float, seen: bool) -> OperatorFrame:
        wrist = make_pose(np.array([x, 0, 1]), quat_multiply(UNIT, UNIT))
        head = make_pose(np.array([0, 0, 1.6]), UNIT)
        frame = OperatorFrame(t, head, wrist, wrist, pinch=np.array([0.07, 0.02]))
        return dataclasses.replace(frame, tracked=np.array([True, seen, True]))

    stream = OneEuro()
    stream.smooth(make(0.0, 0.0, True))
    lost = stream.smooth(make(0.02, 0.5, False))
    assert lost.left_wrist[0] == 0.5  # as it came: nobody looks at it
    found = stream.smooth(make(0.04, 0.6, True))
    assert found.left_wrist[0] == 0.6
    assert found.right_wrist[0] < 0.6
    np.testing.assert_array_equal(found.pinch, [0.07, 0.02])


def test_settings():
    assert make_one_euro(0) is None
    assert compute_share(1e9, 0.01) == pytest.approx(1)
    with pytest.raises(BadValue, match=r"one_euro\.min_cutoff must be finite and above 0, got 0"):
        OneEuroConfig(min_cutoff=0)
