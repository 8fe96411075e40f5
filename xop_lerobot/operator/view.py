"""What a person in the headset could see: the robot's body and the things about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from xop_lerobot.core.command import Mode


@dataclass(frozen=True)
class SeenObject:
    """A thing in the robot's world.

    Attributes:
        pose: Pose of its middle, robot's world, x y z qw qx qy qz. Shape (7,).
        size: Half its extents along its own axes; zero for a point [m]. Shape (3,).
    """

    pose: np.ndarray
    size: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class View:
    """The truth that a headset could show at one instant; a simulated person blurs it.

    Attributes:
        time: Clock of the robot [s].
        task: Name of the task that runs; empty where none does.
        frames: Pose of the robot's `head`, `left_wrist`, `right_wrist`, `left_palm` and
            `right_palm`, robot's world. Shapes (7,).
        objects: What the task put into the scene, by name.
        mode: Mode that the robot is in, as the headset's display shows it.
        engaged: Whether the operator drives, as the display shows it.
        fallen: Whether the robot has fallen.
        success: Whether the task is accomplished.
        hints: What a person who has practised the task knows, by name (docs/tasks.md) [m].
    """

    time: float
    task: str
    frames: Mapping[str, np.ndarray]
    objects: Mapping[str, SeenObject] = field(default_factory=dict)
    mode: Mode = Mode.STATIONARY
    engaged: bool = False
    fallen: bool = False
    success: bool = False
    hints: Mapping[str, float] = field(default_factory=dict)
