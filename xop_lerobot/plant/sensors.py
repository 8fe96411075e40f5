"""Simulated sensors: white noise, random-walk bias, sampling rate, delay and dropouts."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import quat_exp, quat_from_yaw, quat_multiply, quat_yaw
from xop_lerobot.plant.config import NoiseConfig, compute_num_steps

SLIDE_SCALE = 0.1
"""Encoder noise of a sliding joint over that of a hinge [m/rad]."""


class Sample(NamedTuple):
    """True state at the time of a sample, and the error of the sensor."""

    qpos: np.ndarray
    """True position. Shape (nq,)."""
    qvel: np.ndarray
    """True velocity. Shape (nv,)."""
    error: np.ndarray
    """Noise plus bias. Shape (size,)."""


@dataclass(frozen=True)
class SensorModel:
    """Error model of one sensor.

    Attributes:
        white: Standard deviation of the white noise per sample. Shape (size,).
        walk: Standard deviation of the bias after one second. Shape (size,).
        offset: Standard deviation of the bias at reset. Shape (size,).
        period: Sampling period [physics steps].
        delay: Delay of a sample [physics steps].
        dropout: Probability that a sample is lost.
        time_step: Physics step [s].
    """

    white: np.ndarray
    walk: np.ndarray
    offset: np.ndarray
    period: int
    delay: int
    dropout: float
    time_step: float


class Sensor:
    r"""A sensor with the error :math:`e_k = b_k + w_k`, delayed and held until the next sample.

    White noise :math:`w_k \sim N(0, \sigma^2)` is drawn for every sample; the bias is a random
    walk, :math:`b_{k+1} = b_k + N(0, \sigma_b^2 \Delta t)`, from its offset at reset. Random
    numbers are drawn per physics step, so readings do not depend on how often one reads.
    """

    def __init__(self, model: SensorModel) -> None:
        self.model = model
        self._walks = bool(model.walk.any())
        self._arriving: deque[tuple[int, Sample]] = deque()
        self._rng = np.random.default_rng(0)
        self._bias = np.zeros_like(model.white)
        self.sample = Sample(np.zeros(0), np.zeros(0), self._bias)
        """The newest sample that has arrived."""

    def reset(self, rng: np.random.Generator, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Restart; the present state is the reading until the first sample arrives."""
        self._rng = rng
        self._arriving.clear()
        self._bias = self.model.offset * rng.standard_normal(self.model.offset.size)
        self.sample = self._draw(qpos, qvel)

    def hold(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Sample a state that was set directly, without delay; bias and noise continue."""
        self._arriving.clear()
        self.sample = self._draw(qpos, qvel)

    def observe(self, step: int, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Process physics step `step`, at whose end the state is (qpos, qvel)."""
        model = self.model
        if step % model.period == 0:
            if self._walks:
                walk = model.walk * math.sqrt(model.period * model.time_step)
                self._bias = self._bias + walk * self._rng.standard_normal(walk.size)
            # Drawn even if the sample is lost, so that dropouts do not shift the noise sequence.
            sample = self._draw(qpos, qvel)
            if not model.dropout or self._rng.random() >= model.dropout:
                self._arriving.append((step + model.delay, sample))
        while self._arriving and self._arriving[0][0] <= step:
            self.sample = self._arriving.popleft()[1]

    def _draw(self, qpos: np.ndarray, qvel: np.ndarray) -> Sample:
        noise = self.model.white * self._rng.standard_normal(self.model.white.size)
        return Sample(qpos, qvel, self._bias + noise)


class Sensors:
    """All sensors of a robot: measured from true state.

    The measured attitude takes its heading from `slam` and roll and pitch from `imu`, as on a
    robot with both, so that a delayed lidar pose never tilts the balance controller's horizon.

    Args:
        model: Model with the robot first, with a free base or a fixed one.
        nq: Size of the robot's position.
        nv: Size of the robot's velocity.
        noise: Noise of the sensors.
        time_step: Physics step [s].

    Raises:
        BadValue: If a number is out of its range, or a rate or delay is not a whole number of
            physics steps.
    """

    def __init__(
        self, model: mujoco.MjModel, nq: int, nv: int, noise: NoiseConfig, time_step: float
    ) -> None:
        noise.check()
        self.is_exact = noise.is_off
        self._has_base = model.njnt > 0 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
        self._base_q, self._base_v = (7, 6) if self._has_base else (0, 0)
        if nq - self._base_q != nv - self._base_v:
            raise BadValue("sensors need a robot of hinge and slide joints on a free base or none")
        slides = model.jnt_type[model.dof_jntid[self._base_v : nv]] == mujoco.mjtJoint.mjJNT_SLIDE
        scale = np.where(slides, SLIDE_SCALE, 1.0)
        self._sensors = {
            name: Sensor(sensor_model)
            for name, sensor_model in _make_sensor_models(noise, scale, time_step).items()
            if self._has_base or name == "encoder"
        }

    def reset(self, seed: np.random.SeedSequence, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Restart from a robot at rest; each sensor gets its own random stream of `seed`."""
        truth = (qpos.copy(), qvel.copy())
        for sensor, child in zip(self._sensors.values(), seed.spawn(4), strict=False):
            sensor.reset(np.random.default_rng(child), *truth)

    def hold(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Sample a state that was set directly, without delay."""
        truth = (qpos.copy(), qvel.copy())
        for sensor in self._sensors.values():
            sensor.hold(*truth)

    def observe(self, step: int, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Process physics step `step`, at whose end the state is (qpos, qvel)."""
        truth = (qpos.copy(), qvel.copy())
        for sensor in self._sensors.values():
            sensor.observe(step, *truth)

    def read(self, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Measured state while the true one is (qpos, qvel), as new arrays.

        Returns:
            Measured position and velocity. Shapes (nq,), (nv,).
        """
        if self.is_exact:
            return qpos.copy(), qvel.copy()
        encoder = self._sensors["encoder"].sample
        num_joints = encoder.error.size // 2
        joints = encoder.qpos[self._base_q :] + encoder.error[:num_joints]
        rates = encoder.qvel[self._base_v :] + encoder.error[num_joints:]
        if not self._has_base:
            return joints, rates
        slam, imu = self._sensors["slam"].sample, self._sensors["imu"].sample
        velocity = self._sensors["velocity"].sample
        heading = quat_yaw(slam.qpos[3:7]) + slam.error[3]
        # IMU errors are about the body's X and Y axes; its heading is replaced by that of `slam`.
        tilted = quat_multiply(imu.qpos[3:7], quat_exp(np.array([*imu.error[:2], 0.0])))
        quat = quat_multiply(quat_from_yaw(heading - quat_yaw(tilted)), tilted)
        quat /= np.linalg.norm(quat)
        measured_qpos = np.concatenate([slam.qpos[:3] + slam.error[:3], quat, joints])
        measured_qvel = np.concatenate(
            [velocity.qvel[:3] + velocity.error, imu.qvel[3:6] + imu.error[2:], rates]
        )
        return measured_qpos, measured_qvel


def _make_sensor_models(
    noise: NoiseConfig, joint_scale: np.ndarray, time_step: float
) -> dict[str, SensorModel]:
    """Make the error model of every sensor; `joint_scale` (n,) is 1 for a hinge."""

    def make(name: str, white: np.ndarray, walk: np.ndarray, offset: np.ndarray) -> SensorModel:
        rate = noise.get(f"{name}_rate")
        period = compute_num_steps(1 / rate, time_step, f"a period of '{name}'") if rate else 1
        return SensorModel(
            white=white,
            walk=walk,
            offset=offset,
            period=max(period, 1),
            delay=compute_num_steps(noise.get(f"{name}_delay"), time_step, f"'{name}_delay'"),
            dropout=noise.get(f"{name}_dropout") if name in ("slam", "velocity") else 0.0,
            time_step=time_step,
        )

    def column(*parts: tuple[str, int]) -> np.ndarray:
        return np.concatenate([np.full(size, noise.get(setting)) for setting, size in parts])

    ones, zeros = joint_scale, np.zeros_like(joint_scale)
    return {
        "slam": make(
            "slam",
            column(("slam_position", 3), ("slam_heading", 1)),
            column(("slam_position_walk", 3), ("slam_heading_walk", 1)),
            np.zeros(4),
        ),
        "imu": make(
            "imu",
            column(("imu_tilt", 2), ("imu_gyro", 3)),
            np.concatenate([np.zeros(2), column(("imu_gyro_walk", 3))]),
            np.zeros(5),
        ),
        "velocity": make(
            "velocity", column(("velocity", 3)), column(("velocity_walk", 3)), np.zeros(3)
        ),
        "encoder": make(
            "encoder",
            np.concatenate(
                [noise.get("encoder_position") * ones, noise.get("encoder_velocity") * ones]
            ),
            np.concatenate([zeros, zeros]),
            np.concatenate([noise.get("encoder_offset") * ones, zeros]),
        ),
    }
