"""State of a robot and goal of the operator, as exchanged once per control tick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from xop_lerobot.core.command import Mode

FRAMES = ("head", "left_wrist", "right_wrist")
"""Names of the operator's tracked frames, in the order of all `tracked` flags."""
HEAD = FRAMES[0]


def freeze(array: np.ndarray) -> np.ndarray:
    """Return a read-only float copy, so that a published value never changes."""
    copy = np.array(array, dtype=float)
    copy.setflags(write=False)
    return copy


@dataclass(frozen=True)
class RobotState:
    """State of a robot at one instant; all arrays are read-only copies.

    Generalised position and velocity are in MuJoCo's order and conventions (base quaternion
    wxyz, base linear velocity in the world, base angular velocity in the body), for the robot only,
    without the objects of a scene.

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
        wall_time: Host clock at the measurement [s since the epoch].
        fallen: Whether the robot has fallen.
        collision: Whether the robot touches anything but the ground under its feet or wheels.
        settled: Whether the robot is stationary enough to engage.
        trouble: Unintended motion as detected by `plant.watch`, as a text; empty for none.
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
    """Goal G(t): desired poses of the tracked frames in the robot's world frame.

    Attributes:
        poses: Desired pose of each tracked frame, x y z qw qx qy qz. Shapes (7,).
        velocities: Velocity of each goal, linear [m/s] then angular [rad/s], world axes, for
            the preview over the horizon; zero if unknown. Shapes (6,).
        mode: Requested mode.
        grips: Closing of the left and right hand, 0 open to 1 closed. Shape (2,).
    """

    poses: Mapping[str, np.ndarray]
    velocities: Mapping[str, np.ndarray] = field(default_factory=dict)
    mode: Mode = Mode.STATIONARY
    grips: np.ndarray = field(default_factory=lambda: np.zeros(2))
