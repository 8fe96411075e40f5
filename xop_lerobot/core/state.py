"""What a robot publishes each tick, and what the operator wants of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from xop_lerobot.core.command import Mode

FRAMES = ("head", "left_wrist", "right_wrist")
"""Names of the frames an operator drives, in the order of every `tracked` flag."""


def freeze(array: np.ndarray) -> np.ndarray:
    """Return a read-only copy, so that a published value can never change under a reader."""
    copy = np.array(array, dtype=float)
    copy.setflags(write=False)
    return copy


@dataclass(frozen=True)
class RobotState:
    """A robot at one instant; every array is a read-only copy.

    Generalised position and velocity are in MuJoCo's order and conventions (base quaternion
    wxyz, base linear velocity in the world, base angular velocity in the body) and cover the
    robot alone, not the objects of a scene.

    Attributes:
        time: Clock of the robot [s]; simulated time in simulation.
        qpos: Measured or estimated position. Shape (nq,).
        qvel: Measured or estimated velocity. Shape (nv,).
        memory: The low-level policy's memory h. Shape (nm,).
        command: Command executed last. Shape (k,).
        arms: Arm targets [rad] and gripper openings [m] executed last. Shape (m,).
        mode: Mode executed last.
        effort: Actuator forces [N m or N]. Shape (nu,).
        true_qpos: The simulator's own position; equals `qpos` on hardware. Shape (nq,).
        true_qvel: The simulator's own velocity; equals `qvel` on hardware. Shape (nv,).
        wall_time: Host clock when it was taken [s since the epoch].
        fallen: Whether the robot has fallen.
        collision: Whether the robot touches anything but the ground under its feet or wheels.
        settled: Whether the robot stands still enough to engage.
        trouble: What the robot does that it was not told to (`plant.watch`), in words; empty
            while it does what it is told.
    """

    time: float
    qpos: np.ndarray
    qvel: np.ndarray
    memory: np.ndarray
    command: np.ndarray
    arms: np.ndarray
    mode: Mode
    effort: np.ndarray
    true_qpos: np.ndarray
    true_qvel: np.ndarray
    wall_time: float
    fallen: bool = False
    collision: bool = False
    settled: bool = True
    trouble: str = ""


@dataclass(frozen=True)
class Goal:
    """G(t): where the operator wants the tracked frames, in the robot's world.

    Attributes:
        poses: Desired pose of each bound frame, x y z qw qx qy qz. Shapes (7,).
        velocities: Velocity of each goal, linear [m/s] then angular [rad/s], world axes, for
            the preview over the horizon; zero where it is not known. Shapes (6,).
        mode: The mode the operator is in.
        grips: Closing of the left and right hand, 0 open to 1 closed. Shape (2,).
    """

    poses: Mapping[str, np.ndarray]
    velocities: Mapping[str, np.ndarray] = field(default_factory=dict)
    mode: Mode = Mode.STATIONARY
    grips: np.ndarray = field(default_factory=lambda: np.zeros(2))
