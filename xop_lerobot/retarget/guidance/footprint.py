"""The part of the hull that goes with the base: how far it keeps from obstacles on a way."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.obstacles import Obstacle, ObstacleSet


class Footprint:
    """The hull's spheres that sit on the base itself, and the obstacles about them.

    Args:
        morphology: The robot.
        model: Its planning model.
        obstacles: What stands around it.
    """

    def __init__(
        self, morphology: Morphology, model: mujoco.MjModel, obstacles: Iterable[Obstacle] = ()
    ) -> None:
        base = model.body(morphology.base_body).id
        sites = [
            (model.site(name), radius)
            for name, radius in morphology.hull_points.items()
            if model.site(name).bodyid[0] == base
        ]
        self._points = np.array([site.pos for site, _ in sites]).reshape(-1, 3)
        self._points[:, 0] -= morphology.pivot
        self._radii = np.array([radius for _, radius in sites])
        self._height = float(morphology.standing_qpos()[2])
        self.set_obstacles(obstacles)

    def set_obstacles(self, obstacles: Iterable[Obstacle]) -> None:
        """Take other obstacles."""
        self._obstacles = ObstacleSet(obstacles)

    def compute_clearance(self, axle: np.ndarray, headings: np.ndarray) -> np.ndarray:
        """Distance of the base to the nearest obstacle, negative inside; infinite without any [m].

        Args:
            axle: Places of the middle of the axle [m]. Shape (n, 2).
            headings: Headings there [rad]. Shape (n,).

        Returns:
            Shape (n,).
        """
        if not len(self._obstacles) or not len(self._points):
            return np.full(len(axle), np.inf)
        cosine, sine = np.cos(headings)[:, None], np.sin(headings)[:, None]
        points = np.empty((len(axle), len(self._points), 3))
        points[..., 0] = axle[:, None, 0] + cosine * self._points[:, 0] - sine * self._points[:, 1]
        points[..., 1] = axle[:, None, 1] + sine * self._points[:, 0] + cosine * self._points[:, 1]
        points[..., 2] = self._height + self._points[:, 2]
        distances = self._obstacles.compute_distances(points) - self._radii[:, None]
        return distances.min(axis=(1, 2))
