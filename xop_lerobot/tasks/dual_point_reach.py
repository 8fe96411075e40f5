"""Dual-point reach: both palms at points of their own, within reach of where the robot stands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.transforms import quat_from_yaw
from xop_lerobot.tasks.dual_point_touch import DualPointTouch
from xop_lerobot.tasks.furniture import place
from xop_lerobot.tasks.heights import HeightRange
from xop_lerobot.tasks.layout import make_direction
from xop_lerobot.tasks.task import Hold

if TYPE_CHECKING:
    from collections.abc import Mapping

    from xop_lerobot.morphology.morphology import Morphology

HOLD_S = 1.0
"""For how long both palms must be near without a break [s]."""
BEYOND = (0.13, 0.20)
"""By so much the middle of the points is farther than the palms at rest, over the arm's length."""
BEARING_SPREAD = 0.25
"""By how much the middle is aside, seen from the robot, at most [rad]."""
HEIGHT_SPREAD = (-0.03, 0.18)
"""Height of the middle over that of the palms at rest [m]."""
APART = (0.24, 0.42)
"""Between the points, seen from above [m]."""
LEVEL_SPREAD = 0.07
"""Largest difference of each point's height from the middle's [m]."""


class DualPointReach(DualPointTouch):
    """Both palms within 5 cm of their own point, for 1 s without a break, standing.

    The small sister of dual-point touch, made for policies that are trained in minutes: the
    points are before the robot and in its head camera's picture, nobody has to walk, and an
    episode takes some seconds. How far away a point is varies little, as one small picture hardly
    shows it.
    """

    name = "dual_point_reach"
    instruction = "Reach for the red point with the left palm and for the blue one with the right."
    time_limit = 20.0
    room = "empty"

    def __init__(self, morphology: Morphology) -> None:
        super().__init__(morphology)
        self._hold = Hold(HOLD_S)

    @property
    def height_limits(self) -> Mapping[str, HeightRange]:
        """None: the points are near where the palms are at rest."""
        return {}

    def reset(self, rng: np.random.Generator) -> None:
        """Place both points."""
        bearing = rng.uniform(-BEARING_SPREAD, BEARING_SPREAD)
        ahead = self.reach.forward + rng.uniform(*BEYOND) * self.reach.arm
        middle = ahead * make_direction(bearing)
        middle[2] = self.reach.height + rng.uniform(*HEIGHT_SPREAD)
        left = make_direction(bearing + math.pi / 2)
        offset = rng.uniform(*APART) / 2 * left
        offset[2] = rng.uniform(-LEVEL_SPREAD, LEVEL_SPREAD)
        for name, sign in (("left_point", 1), ("right_point", -1)):
            place(self.plant, name, middle + sign * offset, quat_from_yaw(bearing))
        self.facing = bearing
        self._hold.reset()
        self._success = False
