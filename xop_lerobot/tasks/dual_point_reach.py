"""Dual-point reach: touch two points with both palms, within reach of the standing robot."""

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
"""Time for which both palms must be near without interruption [s]."""
BEYOND = (0.13, 0.20)
"""Distance of the points' middle beyond the resting palms, relative to the arm length [1]."""
BEARING_SPREAD = 0.25
"""Largest bearing of the middle from the robot [rad]."""
HEIGHT_SPREAD = (-0.03, 0.18)
"""Height of the middle above the resting palms [m]."""
APART = (0.24, 0.42)
"""Horizontal distance between the points [m]."""
LEVEL_SPREAD = 0.07
"""Largest height difference between a point and the middle [m]."""


class DualPointReach(DualPointTouch):
    """Both palms within 5 cm of their points, for 1 s without interruption, while standing.

    A reduced version of dual-point touch for policies that train in minutes: the points are in
    front of the robot and in its head camera's image, no walking is needed, and an episode takes a
    few seconds. The distance of a point varies little, as one small image hardly shows it.
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
        """Empty: the points are near the resting palms."""
        return {}

    def reset(self, rng: np.random.Generator) -> None:
        """Place both points at random."""
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
