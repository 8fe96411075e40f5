"""Settings of the simulated plant: scene, clock, sensor noise, images. Imports no physics."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.low_level.policy import POLICY_DT


@dataclass(frozen=True)
class NoiseConfig:
    """Noise of the simulated sensors; a field that is None takes the preset's value.

    Three sensors and one estimator, each with white noise per sample, a rate, a delay and, as in
    reality, a random-walk bias and dropouts:

    - `slam`: position and heading of the base (a lidar odometry).
    - `imu`: roll and pitch of the base, and its angular velocity.
    - `velocity`: linear velocity of the base.
    - `encoder`: position and velocity of every joint.

    A rate of 0 means a sample at every physics step. Between samples the last one is held. A
    random walk of w per √s has the standard deviation w √t after t seconds.
    """

    slam_position: float | None = None  # white noise per axis [m]
    slam_heading: float | None = None  # white noise [rad]
    slam_position_walk: float | None = None  # drift per axis [m/sqrt(s)]
    slam_heading_walk: float | None = None  # drift [rad/sqrt(s)]
    slam_rate: float | None = None  # samples per second, 0: every physics step [Hz]
    slam_delay: float | None = None  # age of a sample when it arrives [s]
    slam_dropout: float | None = None  # fraction of samples that are lost, 0 to 1
    imu_tilt: float | None = None  # white noise of roll and pitch [rad]
    imu_gyro: float | None = None  # white noise per axis [rad/s]
    imu_gyro_walk: float | None = None  # bias walk per axis [rad/s/sqrt(s)]
    imu_rate: float | None = None  # samples per second, 0: every physics step [Hz]
    imu_delay: float | None = None  # age of a sample when it arrives [s]
    velocity: float | None = None  # white noise per axis [m/s]
    velocity_walk: float | None = None  # bias walk per axis [m/s/sqrt(s)]
    velocity_rate: float | None = None  # samples per second, 0: every physics step [Hz]
    velocity_delay: float | None = None  # age of a sample when it arrives [s]
    velocity_dropout: float | None = None  # fraction of samples that are lost, 0 to 1
    encoder_position: float | None = None  # white noise [rad], a tenth of it in m if sliding
    encoder_velocity: float | None = None  # white noise [rad/s], a tenth of it in m/s if sliding
    encoder_offset: float | None = None  # std of a constant error per joint, drawn at reset [rad]
    encoder_rate: float | None = None  # samples per second, 0: every physics step [Hz]
    encoder_delay: float | None = None  # age of a sample when it arrives [s]

    def check(self) -> None:
        """Check the range of every number that is given.

        Not done at construction: LeRobot's command line parser builds this from flags and would
        replace the error of a nested configuration by "Couldn't instantiate".

        Raises:
            BadValue: Naming the setting and its range.
        """
        for setting in fields(self):
            value = getattr(self, setting.name)
            if value is None:
                continue
            if not (math.isfinite(value) and value >= 0):
                raise BadValue(f"noise setting '{setting.name}' must be 0 or more, got {value}")
            if setting.name.endswith("_dropout") and value >= 1:
                raise BadValue(
                    f"noise setting '{setting.name}' must be under 1 (1 loses every sample), "
                    f"got {value}"
                )

    def over(self, base: NoiseConfig) -> NoiseConfig:
        """Return `base`, overridden by the numbers that are given here."""
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(base, **{name: value for name, value in given.items() if value is not None})

    def get(self, name: str) -> float:
        """Return the setting `name`; 0 if it is not given."""
        return float(getattr(self, name) or 0.0)

    @property
    def is_off(self) -> bool:
        """Whether the sensors are exact, without delay, at every step."""
        return not any(self.get(setting.name) for setting in fields(self))


NOISE_PRESETS: dict[str, NoiseConfig] = {
    "off": NoiseConfig(),
    # 1 cm, 0.5°, 5 mrad, 3 cm/s: a good lidar odometry and clean encoders.
    "mild": NoiseConfig(
        slam_position=0.01,
        slam_heading=math.radians(0.5),
        imu_tilt=math.radians(0.5),
        imu_gyro=0.02,
        velocity=0.03,
        encoder_position=0.005,
        encoder_velocity=0.1,
    ),
    # Three times mild, with the rate, delay, drift and dropouts of a real lidar odometry.
    "harsh": NoiseConfig(
        slam_position=0.03,
        slam_heading=math.radians(1.5),
        slam_position_walk=0.01,
        slam_heading_walk=0.005,
        slam_rate=10.0,
        slam_delay=0.06,
        slam_dropout=0.05,
        imu_tilt=math.radians(1.5),
        imu_gyro=0.06,
        imu_gyro_walk=0.005,
        imu_delay=0.005,
        velocity=0.10,
        velocity_walk=0.02,
        velocity_rate=50.0,
        velocity_delay=0.02,
        velocity_dropout=0.05,
        encoder_position=0.015,
        encoder_velocity=0.3,
        encoder_offset=0.01,
        encoder_delay=0.005,
    ),
}
"""Noise presets by name."""


@dataclass(frozen=True)
class SimulationConfig:
    """Settings of a simulated plant."""

    scene: str = "empty"  # name of the robot's scene
    noise: str = "off"  # sensor noise: off, mild or harsh
    sensors: NoiseConfig = field(default_factory=NoiseConfig)  # overrides of the preset
    seed: int = 0  # seed of the sensors' noise
    time_step: float = 0.005  # physics step, must divide the policy's 20 ms [s]
    width: int = 320  # width of images [pixel]
    height: int = 240  # height of images [pixel]
    viewer: bool = False  # show the running simulation in a window or in the browser
    viewer_port: int = 8012  # port of the browser view on 127.0.0.1

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            UnknownName: If there is no such noise preset; lists the known ones.
            BadValue: If a number is out of its range.
        """
        if self.noise not in NOISE_PRESETS:
            raise UnknownName("noise preset", self.noise, NOISE_PRESETS)
        if self.seed < 0:
            raise BadValue(f"seed must be 0 or more, got {self.seed}")
        if self.width < 1 or self.height < 1:
            raise BadValue(
                f"an image must be at least 1 x 1 pixels, got {self.width} x {self.height}"
            )
        check_time_step(self.time_step)
        self.sensors.check()

    @property
    def resolved_noise(self) -> NoiseConfig:
        """The preset, overridden by the numbers of `sensors`."""
        return self.sensors.over(NOISE_PRESETS[self.noise])


def check_time_step(time_step: float) -> None:
    """Check that the policy's period is a whole number of physics steps.

    Raises:
        BadValue: If it isn't; names both values.
    """
    if not (math.isfinite(time_step) and time_step > 0):
        raise BadValue(f"the physics step must be a positive number of seconds, got {time_step}")
    compute_num_steps(POLICY_DT, time_step, "the policy's period")


def compute_num_steps(duration: float, time_step: float, what: str = "a step") -> int:
    """Compute the number of physics steps in `duration`.

    Args:
        duration: Duration [s].
        time_step: Physics step [s].
        what: Name of the duration in the error.

    Raises:
        BadValue: If it is not a whole number of steps; names both values.
    """
    ratio = duration / time_step
    num_steps = round(ratio) if math.isfinite(ratio) else -1
    # The tolerance of 1e-6 of a step absorbs floating-point error in 0.02 / 0.005, and no more.
    if num_steps < 0 or abs(ratio - num_steps) > 1e-6:
        raise BadValue(
            f"{what} of {duration} s is not a whole multiple of the physics step of {time_step} s"
        )
    return num_steps
