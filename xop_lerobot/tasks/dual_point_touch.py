"""Dual-point touch: touch two points with both palms, out of reach of the starting robot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.transforms import quat_from_yaw
from xop_lerobot.operator.display import SeenObject
from xop_lerobot.session import TaskStatus
from xop_lerobot.tasks.furniture import add_furniture_body, add_look, get_body_pose, place
from xop_lerobot.tasks.heights import HeightRange
from xop_lerobot.tasks.layout import find_palms, find_room, make_direction, measure_reach
from xop_lerobot.tasks.task import Hold, Task

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.morphology.morphology import Morphology
    from xop_lerobot.plant.simulation import Simulation

TOLERANCE = 0.05
"""Distance within which a palm touches its point [m]."""
HOLD_S = 3.0
"""Time for which both palms must touch without interruption [s]."""
BEYOND, FARTHEST = 0.5, 1.6
"""Least distance of the points' middle beyond the resting palms, and its largest distance from the
start [m]."""
APART = (0.30, 0.45)
"""Horizontal distance between the points [m]."""
HEIGHT_SPREAD = 0.27
"""Largest height of the middle above or below the resting palms [m]; low ones need a squat."""
LEVEL_SPREAD, DEPTH_SPREAD = 0.08, 0.04
"""Largest difference in height and depth between a point and the middle [m]."""
FACING_SPREAD = 0.6
"""Largest angle between the points' facing direction and their bearing from the start [rad]."""
NEAR_WALL = (0.25, 0.40)
"""Distance from the wall, for points near a wall [m]."""
WALL_SHARE = 0.5
"""Share of trials with points near a wall, in a room [1]."""
ALONG_WALL = 0.9
"""Largest distance of the middle from the centre of the wall, along it [m]."""
CLEAR_OF_WALL = 1.0
"""Least distance from any wall of the standing place for points in the open [m]."""

COLOURS = {"left_point": (0.85, 0.16, 0.14, 1), "right_point": (0.13, 0.33, 0.85, 1)}
GREY = (0.45, 0.46, 0.48, 1)
RADIUS, ROD = 0.03, 1.5
"""Radius of the balls, and length of the rods that carry them [m]."""


class DualPointTouch(Task):
    """Both palms within 5 cm of their points, for 3 s without interruption.

    The points are placed so that a robot that faces them has both where its palms rest, but at
    another height. In a room a share of `WALL_SHARE` is near a wall.
    """

    name = "dual_point_touch"
    instruction = "Touch the red point with the left palm and the blue one with the right."
    time_limit = 90.0
    room = "small_room"

    def __init__(self, morphology: Morphology) -> None:
        super().__init__(morphology)
        self.reach = measure_reach(morphology)
        self._hold = Hold(HOLD_S)
        self._success = False

    @property
    def height_limits(self) -> Mapping[str, HeightRange]:
        """Allowed heights of the points."""
        spread = HEIGHT_SPREAD + LEVEL_SPREAD
        usual = (self.reach.height - spread, self.reach.height + spread)
        return {"points": self.morphology.point_heights or usual}

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add two visual balls on thin rods, without collision."""
        for index, (name, colour) in enumerate(COLOURS.items()):
            body = add_furniture_body(spec, name, index)
            add_look(body, name, "sphere", (RADIUS,), (0, 0, 0), colour)
            # The part of the rod below the floor is hidden.
            add_look(body, f"{name}_rod", "cylinder", (0.004, ROD / 2), (0, 0, -ROD / 2), GREY)

    def bind(self, plant: Simulation) -> None:
        """Find palms and walls."""
        self.plant = plant
        self._palms = find_palms(self.morphology, plant.model)
        self._room = find_room(plant.model)

    def reset(self, rng: np.random.Generator) -> None:
        """Place both points at random."""
        near_wall = self._room is not None and rng.random() < WALL_SHARE
        middle, facing = self._draw_near_wall(rng) if near_wall else self._draw_in_open(rng)
        spread, about = self._compute_level_spread(), self.reach.height
        usual = (-HEIGHT_SPREAD, HEIGHT_SPREAD)
        middle[2] = self.draw_height(rng, "points", about, usual, margin=spread)
        ahead, left = make_direction(facing), make_direction(facing + math.pi / 2)
        half = rng.uniform(*APART) / 2
        depth = 0.0 if near_wall else rng.uniform(-DEPTH_SPREAD, DEPTH_SPREAD)
        level = rng.uniform(-spread, spread)
        offset = half * left + depth * ahead + np.array([0, 0, level])
        for name, sign in (("left_point", 1), ("right_point", -1)):
            place(self.plant, name, middle + sign * offset, quat_from_yaw(facing))
        self.facing = facing
        self._hold.reset()
        self._success = False

    def _compute_level_spread(self) -> float:
        """Largest height difference between a point and the middle [m]."""
        low, high = self.heights.get("points", (-math.inf, math.inf))
        return min(LEVEL_SPREAD, (high - low) / 2)

    def _draw_in_open(self, rng: np.random.Generator) -> tuple[np.ndarray, float]:
        """Draw middle and heading so that a robot has room to stand in front of them."""
        while True:
            bearing = rng.uniform(-math.pi, math.pi)
            middle = rng.uniform(self.reach.forward + BEYOND, FARTHEST) * make_direction(bearing)
            facing = bearing + rng.uniform(-FACING_SPREAD, FACING_SPREAD)
            stance = middle - self.reach.forward * make_direction(facing)
            if self._room is None:
                return middle, facing
            low, high = self._room[0] + NEAR_WALL[1], self._room[1] - NEAR_WALL[1]
            inside = ((middle[:2] > low) & (middle[:2] < high)).all()
            clear = np.minimum(stance[:2] - self._room[0], self._room[1] - stance[:2]).min()
            if inside and clear > CLEAR_OF_WALL:
                return middle, facing

    def _draw_near_wall(self, rng: np.random.Generator) -> tuple[np.ndarray, float]:
        """Draw middle and heading, facing one of the four walls."""
        assert self._room is not None
        side = int(rng.integers(4))
        facing = side * math.pi / 2
        ahead = make_direction(facing)
        wall = self._room[1] if side < 2 else self._room[0]  # front, left
        depth = abs(float(wall @ ahead[:2])) - rng.uniform(*NEAR_WALL)
        along = rng.uniform(-ALONG_WALL, ALONG_WALL)
        return depth * ahead + along * make_direction(facing + math.pi / 2), facing

    def compute_distances(self) -> dict[str, float]:
        """Distance of each palm from its point [m]."""
        distances = {}
        for palm, site in self._palms.items():
            point = palm.replace("_palm", "_point")
            gap = self.plant.get_site_pose(site)[:3] - get_body_pose(self.plant, point)[:3]
            distances[palm] = float(np.linalg.norm(gap))
        return distances

    def update(self) -> TaskStatus:
        """Update the status: success when both palms have touched long enough."""
        distances = self.compute_distances()
        near = max(distances.values()) <= TOLERANCE
        self._success |= self._hold.update(self.plant.time, near)
        figures = {f"{palm}_distance": distance for palm, distance in distances.items()}
        figures["held_s"] = self._hold.duration
        return TaskStatus(self._success, self._success, figures=figures)

    @property
    def objects(self) -> Mapping[str, SeenObject]:
        """Both points; their X axis is the heading that faces them."""
        return {name: SeenObject(get_body_pose(self.plant, name)) for name in COLOURS}
