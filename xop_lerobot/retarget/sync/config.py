"""Settings and statuses of the state synchronisation; loads no physics."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import IntEnum

from xop_lerobot.core.errors import BadValue


class SyncStatus(IntEnum):
    """How one synchronisation ended."""

    OK = 0
    """The optimum lies within the joint limits."""
    BOUNDED = 1
    """The optimum lies on at least one joint limit."""
    RESTARTED = 2
    """The measurement had left what was remembered, which was begun anew from it."""
    MEASUREMENT = 3
    """Not solved: the measurement, or the last good state if it is not finite."""


@dataclass(frozen=True)
class SyncConfig:
    """How much each sensor and each contact is trusted, as standard deviations.

    The sensors' defaults are those of a good lidar odometry and clean encoders (noise preset
    `mild`); only ratios matter.

    Attributes:
        position: Measured position of the base [m].
        heading: Measured heading of the base [rad].
        tilt: Measured roll and pitch of the base [rad].
        joint: Measured joint angle [rad], a tenth of it in metres on sliding joints.
        velocity: Measured linear velocity of the base [m/s].
        gyro: Measured angular velocity of the base [rad/s].
        joint_rate: Measured joint velocity [rad/s], a tenth in m/s on sliding joints.
        prediction: Velocity of the base that the planner predicts from one tick to the next,
            beyond what was wrong with the state that it started from [m/s].
        contact_height: Height of a contact point over its equilibrium [m].
        contact_tilt: Tilt of a foot over the ground, or of an axle [rad].
        stance_position: Remembered place of a standing foot, at best [m].
        stance_heading: Remembered heading of a standing foot, at best [rad].
        contact_velocity: Velocity of a point in contact [m/s].
        contact_rate: Angular velocity of a standing foot, roll and pitch rate on wheels [rad/s].
        touchdown_s: Time in which a foot that has just touched down comes to rest [s].
        touchdown_height: Height of a foot that touches down, over its equilibrium [m].
        touchdown_tilt: Its tilt [rad].
        touchdown_velocity: Its velocity [m/s].
        touchdown_rate: Its angular velocity [rad/s].
        lift_height: Height over the lowest foot at which a foot is off the ground [m].
        lost_height: Height over or under the ground, as measured, at which no contact counts [m].
        lost_tilt: Tilt of a foot, or of an axle, at which its contact does not count [rad].
        memory_s: Time over which the place of a standing foot is averaged, while the velocities
            are as good as configured [s].
        bias_s: Time in which a bias of the measured velocity is found [s].
        gate: Disagreement of measurement and memory at which the memory is begun anew, in
            standard deviations [1].
        max_gap_s: Time without a measurement after which memory is worthless [s].
        iterations: Most steps of the SQP.
        tolerance: Largest entry of a step that is the last one [m, rad]; the SQP converges
            quadratically, so what is left after it is about its square, 0.02 mm.
        recursive: Whether anything is remembered from tick to tick; without, each solve sees
            its own measurement alone (Eq. 4 as the paper has it, but for the stance location).
        project_velocity: Whether the velocity is projected on the stance constraint.
        equilibrium: Whether contacts are as deep in the ground as the robot's weight presses
            them; without, points touch it at z = 0.
    """

    position: float = 0.01
    heading: float = math.radians(0.5)
    tilt: float = math.radians(0.5)
    joint: float = 0.005
    velocity: float = 0.03
    gyro: float = 0.02
    joint_rate: float = 0.1
    prediction: float = 0.02
    contact_height: float = 0.0005
    contact_tilt: float = 0.005
    stance_position: float = 0.0015
    stance_heading: float = 0.003
    contact_velocity: float = 0.01
    contact_rate: float = 0.02
    touchdown_s: float = 0.02
    touchdown_height: float = 0.01
    touchdown_tilt: float = 0.06
    touchdown_velocity: float = 0.5
    touchdown_rate: float = 4.0
    lift_height: float = 0.025
    lost_height: float = 0.1
    lost_tilt: float = 0.35
    memory_s: float = 1.5
    bias_s: float = 3.0
    gate: float = 4.0
    max_gap_s: float = 0.3
    iterations: int = 4
    tolerance: float = 5e-3
    recursive: bool = True
    project_velocity: bool = True
    equilibrium: bool = True

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            BadValue: Naming the setting and what it must be.
        """
        for setting in fields(self):
            value = getattr(self, setting.name)
            if not isinstance(value, bool) and not (math.isfinite(value) and value > 0):
                raise BadValue(f"sync setting '{setting.name}' must be over 0, got {value}")
