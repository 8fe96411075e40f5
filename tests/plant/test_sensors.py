"""Behaviour of the simulated sensors: statistics, rate, delay, seeds."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import (
    quat_conjugate,
    quat_from_rpy,
    quat_log,
    quat_multiply,
    quat_yaw,
)
from xop_lerobot.plant.config import (
    NOISE_PRESETS,
    NoiseConfig,
    SimulationConfig,
    compute_num_steps,
)
from xop_lerobot.plant.sensors import Sensors

TIME_STEP = 0.005
ROBOT = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <geom size=".1"/>
      <body name="arm">
        <joint name="shoulder" axis="0 1 0"/>
        <geom size=".05"/>
        <body name="finger">
          <joint name="finger" type="slide" axis="1 0 0"/>
          <geom size=".02"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
NQ, NV = 9, 8
QPOS = np.array([0.3, -0.2, 0.9, *quat_from_rpy(0.1, -0.2, 2.5), 0.4, 0.03])
QVEL = np.array([0.1, 0.2, 0.3, -0.4, 0.5, -0.6, 0.7, 0.08])
MILD = NOISE_PRESETS["mild"]


def make_sensors(noise: NoiseConfig, seed: int = 0) -> Sensors:
    model = mujoco.MjModel.from_xml_string(ROBOT)
    sensors = Sensors(model, NQ, NV, noise, TIME_STEP)
    sensors.reset(np.random.SeedSequence(seed), QPOS, QVEL)
    return sensors


def read_many(sensors: Sensors, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings at `count` physics steps of a robot that stays where it is."""
    qpos, qvel = np.empty((count, NQ)), np.empty((count, NV))
    for step in range(1, count + 1):
        sensors.observe(step, QPOS, QVEL)
        qpos[step - 1], qvel[step - 1] = sensors.read(QPOS, QVEL)
    return qpos, qvel


def moving_state(step: int) -> tuple[np.ndarray, np.ndarray]:
    """A state that tells the step it belongs to."""
    qpos, qvel = QPOS.copy(), QVEL.copy()
    qpos[0], qpos[7], qvel[0], qvel[3] = step, step, step, step
    return qpos, qvel


def track_ages(noise: NoiseConfig, steps: int) -> dict[str, list[int]]:
    """Age in physics steps of each sensor's reading after each step."""
    sensors = make_sensors(noise)
    sensors.hold(*moving_state(0))
    ages: dict[str, list[int]] = {"slam": [], "velocity": [], "imu": [], "encoder": []}
    for step in range(1, steps + 1):
        state = moving_state(step)
        sensors.observe(step, *state)
        qpos, qvel = sensors.read(*state)
        for name, value in (
            ("slam", qpos[0]),
            ("velocity", qvel[0]),
            ("imu", qvel[3]),
            ("encoder", qpos[7]),
        ):
            ages[name].append(step - round(value))
    return ages


def test_off_is_exactly_the_truth() -> None:
    sensors = make_sensors(NOISE_PRESETS["off"])
    qpos, qvel = sensors.read(QPOS, QVEL)
    assert sensors.is_exact
    assert np.array_equal(qpos, QPOS)
    assert np.array_equal(qvel, QVEL)
    assert qpos is not QPOS


def test_mild_noise_has_the_configured_deviations() -> None:
    qpos, qvel = read_many(make_sensors(MILD), 4000)
    error = qpos - QPOS
    rotation = quat_log(quat_multiply(quat_conjugate(QPOS[3:7]), qpos[:, 3:7]))
    rates = qvel - QVEL
    # The deviation of 4000 samples is within 4 % of the true one at over three sigma.
    np.testing.assert_allclose(error[:, :3].std(axis=0), 0.01, rtol=0.04)
    np.testing.assert_allclose(error[:, 7].std(), 0.005, rtol=0.04)
    np.testing.assert_allclose(error[:, 8].std(), 0.0005, rtol=0.04)  # a sliding joint [m]
    np.testing.assert_allclose(rates[:, :3].std(axis=0), 0.03, rtol=0.04)
    np.testing.assert_allclose(rates[:, 3:6].std(axis=0), 0.02, rtol=0.04)
    np.testing.assert_allclose(rates[:, 6].std(), 0.1, rtol=0.04)
    heading = quat_yaw(qpos[:, 3:7]) - quat_yaw(QPOS[3:7])
    np.testing.assert_allclose(heading.std(), math.radians(0.5), rtol=0.04)
    # Roll and pitch err by half a degree, and the whole rotation by no more than three such axes.
    tilt = np.arccos(np.clip(world_z(qpos[:, 3:7]) @ world_z(QPOS[None, 3:7])[0], -1, 1))
    np.testing.assert_allclose(np.sqrt((tilt**2).mean() / 2), math.radians(0.5), rtol=0.04)
    assert np.abs(rotation).max() < math.radians(0.5) * 6
    for mean in (error[:, :3].mean(axis=0), rates.mean(axis=0)):
        np.testing.assert_allclose(mean, 0, atol=0.005)


def world_z(quat: np.ndarray) -> np.ndarray:
    """The world's Z axis in the body. Shape (n, 4) -> (n, 3)."""
    w, x, y, z = quat.T
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)


@pytest.mark.parametrize("preset", ["mild", "harsh"])
def test_measured_quaternion_stays_unit(preset: str) -> None:
    qpos, _ = read_many(make_sensors(NOISE_PRESETS[preset]), 500)
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, atol=1e-12)


def test_noise_is_white_where_no_bias_walks() -> None:
    qpos, _ = read_many(make_sensors(MILD), 4000)
    error = qpos[:, 0] - QPOS[0]
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.06


def test_bias_walks_with_the_root_of_time() -> None:
    noise = NoiseConfig(velocity_walk=0.02)
    ends = []
    for seed in range(200):
        sensors = make_sensors(noise, seed)
        for step in range(1, 101):  # 0.5 s
            sensors.observe(step, QPOS, QVEL)
        ends.append(sensors.read(QPOS, QVEL)[1][:3] - QVEL[:3])
    np.testing.assert_allclose(np.std(ends), 0.02 * math.sqrt(0.5), rtol=0.1)


def test_encoder_offset_is_fixed_until_reset() -> None:
    noise = NoiseConfig(encoder_offset=0.01)
    sensors = make_sensors(noise, seed=1)
    qpos, _ = read_many(sensors, 20)
    assert np.ptp(qpos[:, 7]) == 0
    assert qpos[0, 7] != QPOS[7]
    sensors.reset(np.random.SeedSequence(2), QPOS, QVEL)
    assert sensors.read(QPOS, QVEL)[0][7] != qpos[0, 7]


def test_delay_is_exact() -> None:
    ages = track_ages(NoiseConfig(slam_delay=0.06, imu_delay=0.005), 40)
    assert ages["slam"] == [*range(1, 13), *[12] * 28]  # at rest before, then 12 steps old
    assert ages["imu"] == [1] * 40
    assert ages["velocity"] == ages["encoder"] == [0] * 40


def test_rate_holds_the_last_sample() -> None:
    ages = track_ages(NoiseConfig(slam_rate=10.0, velocity_rate=50.0), 60)
    assert ages["slam"] == [step % 20 for step in range(1, 61)]
    assert ages["velocity"] == [step % 4 for step in range(1, 61)]


def test_rate_and_delay_together() -> None:
    ages = track_ages(NoiseConfig(slam_rate=10.0, slam_delay=0.06), 100)
    # Sampled every 20 steps, there 12 steps later: the age runs from 12 to 31.
    assert ages["slam"][31:] == [12 + (step - 32) % 20 for step in range(32, 101)]


def test_share_of_lost_samples() -> None:
    ages = np.array(track_ages(NoiseConfig(slam_dropout=0.25), 4000)["slam"])
    np.testing.assert_allclose((ages > 0).mean(), 0.25, atol=0.03)


def test_same_seed_same_readings() -> None:
    first, second = (read_many(make_sensors(NOISE_PRESETS["harsh"], 5), 50) for _ in range(2))
    assert np.array_equal(first[0], second[0])
    assert np.array_equal(first[1], second[1])


def test_another_seed_gives_other_readings() -> None:
    first, second = (read_many(make_sensors(MILD, seed), 1)[0] for seed in (5, 6))
    assert not np.isclose(first, second, rtol=0, atol=1e-9).any()


def test_one_sensor_does_not_shift_the_noise_of_another() -> None:
    plain = read_many(make_sensors(MILD), 20)
    changed = read_many(make_sensors(NoiseConfig(slam_rate=10.0, slam_dropout=0.5).over(MILD)), 20)
    assert np.array_equal(plain[0][:, 7:], changed[0][:, 7:])
    assert np.array_equal(plain[1], changed[1])
    assert not np.array_equal(plain[0][:, :3], changed[0][:, :3])


def test_a_fixed_base_has_encoders_alone() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    sensors = Sensors(model, 1, 1, MILD, TIME_STEP)
    sensors.reset(np.random.SeedSequence(0), np.zeros(1), np.zeros(1))
    qpos, qvel = sensors.read(np.zeros(1), np.zeros(1))
    assert 0 < abs(qpos[0]) < 0.05
    assert 0 < abs(qvel[0]) < 1


def test_single_numbers_go_over_the_preset() -> None:
    config = SimulationConfig(noise="mild", sensors=NoiseConfig(slam_position=0.5, velocity=0.0))
    noise = config.resolved_noise
    assert (noise.slam_position, noise.velocity, noise.imu_gyro) == (0.5, 0.0, 0.02)
    assert NoiseConfig(slam_delay=0.06).is_off is False
    assert SimulationConfig().resolved_noise.is_off


def test_harsh_is_at_least_three_times_mild() -> None:
    harsh = NOISE_PRESETS["harsh"]
    for name in ("slam_position", "imu_tilt", "imu_gyro", "velocity", "encoder_position"):
        assert harsh.get(name) >= 3 * MILD.get(name) - 1e-12, name


def test_unknown_preset_lists_the_known_ones() -> None:
    with pytest.raises(UnknownName) as error:
        SimulationConfig(noise="wild")
    assert str(error.value) == "unknown noise preset 'wild'. Known: harsh, mild, off"


@pytest.mark.parametrize(
    ("noise", "text"),
    [
        ({"slam_position": -1}, "noise setting 'slam_position' must be 0 or more, got -1"),
        ({"imu_gyro": math.nan}, "noise setting 'imu_gyro' must be 0 or more, got nan"),
        (
            {"slam_dropout": 1.0},
            "noise setting 'slam_dropout' must be under 1 (1 loses every sample), got 1.0",
        ),
    ],
)
def test_noise_out_of_range(noise: dict[str, float], text: str) -> None:
    with pytest.raises(BadValue) as error:
        SimulationConfig(sensors=NoiseConfig(**noise))
    assert str(error.value) == text


@pytest.mark.parametrize(
    ("noise", "text"),
    [
        (
            NoiseConfig(slam_rate=80.0),
            "a period of 'slam' of 0.0125 s is not a whole multiple of the physics step of 0.005 s",
        ),
        (
            NoiseConfig(imu_delay=0.001),
            "'imu_delay' of 0.001 s is not a whole multiple of the physics step of 0.005 s",
        ),
    ],
)
def test_rates_and_delays_are_whole_steps(noise: NoiseConfig, text: str) -> None:
    with pytest.raises(BadValue) as error:
        make_sensors(noise)
    assert str(error.value) == text


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        (
            {"time_step": 0.006},
            "the policy's period of 0.02 s is not a whole multiple of the physics step of 0.006 s",
        ),
        ({"time_step": 0}, "the physics step must be a positive number of seconds, got 0"),
        ({"width": 0}, "an image must be at least 1 x 1 pixels, got 0 x 240"),
        ({"seed": -1}, "seed must be 0 or more, got -1"),
    ],
)
def test_simulation_setting_out_of_range(setting: dict[str, Any], text: str) -> None:
    with pytest.raises(BadValue) as error:
        SimulationConfig(**setting)
    assert str(error.value) == text


@pytest.mark.parametrize("count", [0, 1, 4, 200, 12000])
def test_num_steps_are_exact_despite_rounding(count: int) -> None:
    assert compute_num_steps(count * 0.005, 0.005) == count
    assert compute_num_steps(sum([0.005] * count), 0.005) == count
