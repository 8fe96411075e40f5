"""The drift observer: what a base does beyond its command, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import quat_from_yaw
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.retarget.model.command_model import CommandModel, Start
from xop_lerobot.retarget.model.observers import DriftObserver

DT = 0.04
DRIFT = np.array([-0.08, 0.03, 0.07])


def make_model(name: str) -> CommandModel:
    morphology = make_morphology(name)
    model = morphology.build_spec("planning").compile()
    return CommandModel(model, morphology.command_space, morphology.effects, morphology.pivot)


@pytest.fixture(scope="module")
def g1() -> CommandModel:
    return make_model("g1")


def walk(
    observer: DriftObserver,
    model: CommandModel,
    command: np.ndarray,
    drift: np.ndarray,
    seconds: float,
    noise: float = 0.0,
    yaw: float = 0.0,
) -> np.ndarray:
    """Let an ideal base walk, and return its last configuration."""
    rng = np.random.default_rng(0)
    qpos = np.zeros(40)
    qpos[3:7] = quat_from_yaw(yaw)
    for tick in range(round(seconds / DT)):
        seen = qpos.copy()
        seen[:2] += noise * rng.normal(size=2)
        observer.update(tick * DT, seen, command, moving=True)
        qpos = model.extrapolate(Start(qpos, drift=drift), command, DT, Mode.MOBILE)
    return qpos


def command_of(model: CommandModel, **entries: float) -> np.ndarray:
    command = model.space.neutral.copy()
    for name, value in entries.items():
        command[model.space.index(name)] = value
    return command


@pytest.mark.parametrize("yaw", [0.0, 1.0, 3.0])
def test_a_steady_drift_is_found_whatever_the_heading(g1, yaw):
    observer = DriftObserver(g1)
    walk(observer, g1, command_of(g1, vx=0.4, vy=-0.1, yaw_rate=0.2), DRIFT, 20, yaw=yaw)
    np.testing.assert_allclose(observer.drift, DRIFT, atol=0.005)


def test_it_is_found_slowly(g1):
    """After one time constant about 63 % are known: strides are averaged, not followed."""
    observer = DriftObserver(g1)
    walk(observer, g1, command_of(g1), DRIFT, 3.0)
    np.testing.assert_allclose(observer.drift, 0.63 * DRIFT, rtol=0.05)


def test_noise_of_the_position_averages_out(g1):
    observer = DriftObserver(g1)
    walk(observer, g1, command_of(g1), DRIFT, 20, noise=0.005)
    np.testing.assert_allclose(observer.drift, DRIFT, atol=0.02)


def test_a_base_that_obeys_with_a_lag_does_not_drift(g1):
    """A start counts with the lag of the policy."""
    observer = DriftObserver(g1)
    command = command_of(g1, vx=0.5)
    x = 0.0
    for tick in range(50):
        time = tick * DT
        qpos = np.zeros(40)
        qpos[:4] = x, 0, 0, 1
        observer.update(time, qpos, command, moving=True)
        x += DT * 0.5 * -np.expm1(-(time + DT) / 0.3)
        assert abs(observer.drift[0]) < 0.01


def test_a_stumble_is_not_a_drift(g1):
    observer = DriftObserver(g1, time_constant=0.1)
    walk(observer, g1, command_of(g1), np.array([2.0, -2.0, 2.0]), 5)
    np.testing.assert_allclose(observer.drift, [0.3, -0.3, 0.4])


def test_turning_past_half_a_turn_is_no_jump(g1):
    observer = DriftObserver(g1)
    walk(observer, g1, command_of(g1, yaw_rate=1.0), np.zeros(3), 10, yaw=3.0)
    np.testing.assert_allclose(observer.drift, 0, atol=0.03)


def test_a_standing_base_has_no_drift(g1):
    observer = DriftObserver(g1)
    qpos = walk(observer, g1, command_of(g1), DRIFT, 5)
    assert np.abs(observer.drift).max() > 0.05
    observer.update(5.0, qpos, command_of(g1), moving=False)
    np.testing.assert_array_equal(observer.drift, 0)


def test_reset_forgets_and_a_jump_across_it_is_not_seen(g1):
    observer = DriftObserver(g1)
    walk(observer, g1, command_of(g1), DRIFT, 5)
    observer.reset()
    far = np.zeros(40)
    far[:4] = 50, 50, 0, 1
    observer.update(9.0, far, command_of(g1), moving=True)
    np.testing.assert_array_equal(observer.drift, 0)


@pytest.mark.parametrize("time", [0.0, -1.0])
def test_time_that_stands_or_goes_back_changes_nothing(g1, time):
    observer = DriftObserver(g1)
    qpos = np.zeros(40)
    qpos[3] = 1
    observer.update(0.0, qpos, command_of(g1), moving=True)
    observer.update(time, qpos + 1, command_of(g1), moving=True)
    np.testing.assert_array_equal(observer.drift, 0)


def test_driving_straight_with_wheels_is_no_drift():
    model = make_model("rby1")
    observer = DriftObserver(model)
    walk(observer, model, command_of(model, v=0.5), np.zeros(3), 10)
    np.testing.assert_allclose(observer.drift, 0, atol=0.02)


def test_turning_about_a_pivot_ahead_of_the_base_is_no_drift():
    model = make_model("rby1")
    assert model.pivot > 0.2
    observer = DriftObserver(model)
    walk(observer, model, command_of(model, yaw_rate=1.0), np.zeros(3), 20)
    np.testing.assert_allclose(observer.drift, 0, atol=0.02)


def test_wheels_take_a_velocity_up_at_once(g1):
    """Without a lag a start is no drift either, where the base obeys at once."""
    observer = DriftObserver(g1, lag_s=0.0)
    command = command_of(g1, vx=0.5)
    for tick in range(50):
        qpos = np.zeros(40)
        qpos[:4] = tick * DT * 0.5, 0, 0, 1
        observer.update(tick * DT, qpos, command, moving=True)
        assert abs(observer.drift[0]) < 1e-9
