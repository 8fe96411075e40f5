"""Settings and status codes of the state synchronisation; imports no physics."""

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
    """The measurement disagreed with the memory, which was restarted from it."""
    MEASUREMENT = 3
    """Not solved: the measurement is used, or the last good state if it is not finite."""


@dataclass(frozen=True)
class SyncConfig:
    """Standard deviations of sensors and contacts, and parameters of the estimator.

    The sensors' defaults are those of a good lidar odometry and clean encoders (noise preset
    `mild`); only ratios matter.

    Attributes:
        position: Measured position of the base [m].
        heading: Measured heading of the base [rad].
        tilt: Measured roll and pitch of the base [rad].
        joint: Measured joint angle [rad]; a tenth of it in metres for sliding joints.
        velocity: Measured linear velocity of the base [m/s].
        gyro: Measured angular velocity of the base [rad/s].
        joint_rate: Measured joint velocity [rad/s]; a tenth of it in m/s for sliding joints.
        prediction: Base velocity that the planner predicts from one tick to the next, in addition
            to the error of the state that it started from [m/s].
        contact_height: Height of a contact point over its equilibrium [m].
        contact_tilt: Tilt of a foot or an axle relative to the ground [rad].
        stance_position: Remembered position of a stance foot, at best [m].
        stance_heading: Remembered heading of a stance foot, at best [rad].
        contact_velocity: Velocity of a point in contact [m/s].
        contact_rate: Angular velocity of a stance foot; roll and pitch rate on wheels [rad/s].
        touchdown_s: Time constant with which a foot comes to rest after touch-down [s].
        touchdown_height: Height of a foot at touch-down over its equilibrium [m].
        touchdown_tilt: Tilt of a foot at touch-down [rad].
        touchdown_velocity: Velocity of a foot at touch-down [m/s].
        touchdown_rate: Angular velocity of a foot at touch-down [rad/s].
        lift_height: Height over the lowest foot from which a foot is off the ground [m].
        lost_height: Measured distance from the ground from which a contact is inactive [m].
        lost_tilt: Tilt of a foot or an axle from which its contact is inactive [rad].
        memory_s: Time over which the position of a stance foot is averaged, while the velocities
            are as good as configured [s].
        bias_s: Time constant of the bias observer of the measured velocity [s].
        gate: Disagreement of measurement and memory at which the memory restarts, in standard
            deviations [1].
        max_gap_s: Longest gap between measurements that the memory survives [s].
        iterations: Largest number of SQP steps.
        tolerance: Largest entry of a step that ends the SQP [m, rad]; it converges quadratically,
            so the remaining error is about its square, 0.02 mm.
        recursive: Whether to keep a memory from tick to tick; without it each solve uses only its
            own measurement (Eq. 4 as in the paper, except for the stance location).
        project_velocity: Whether to project the velocity on the stance constraint.
        equilibrium: Whether contacts rest at the depth to which the robot's weight presses them
            into the ground; otherwise at z = 0.
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
