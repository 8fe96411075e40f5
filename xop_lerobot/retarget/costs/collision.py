"""Cost term of collision avoidance, and detection of predicted contacts with obstacles."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.retarget.obstacles import Obstacle, ObstacleSet, make_obstacles

_DEEPER = 0.001  # deeper penetration than at the start that counts as a touch [m]

__all__ = ["CollisionCost", "Obstacle", "make_obstacles"]


class CollisionCost(Cost):
    r"""Mean of :math:`\sum_j w_c e^{-\alpha d_j} + w_v\|v\|^2 e^{-\beta d_j}` over steps.

    The same barrier counts once more at the end of the extrapolation: the horizon alone is too
    short to brake before a wall.

    :math:`d_j` is the smallest distance of the robot's hull to obstacle j, v the velocity of the
    base. Both terms are reduced by their value at `collision_range` and are zero beyond, so that
    distant walls do not push; with an infinite range it is the paper's formula.

    Args:
        obstacles: Obstacles to avoid.
        points: Sites on the hull of the robot and the radius around each [m].
        hands: Hull sites of the hands, which need not avoid `handled` obstacles.
        base: Hull sites of the base. While nothing drives the base they cost nothing: it cannot
            avoid anything, and its tremor beside an obstacle would outweigh any goal.
    """

    name = "collision"

    def __init__(
        self,
        obstacles: Iterable[Obstacle],
        points: Mapping[str, float],
        hands: Collection[str] = (),
        base: Collection[str] = (),
    ) -> None:
        self.points = dict(points)
        self._hands = np.array([point in hands for point in self.points], dtype=bool)
        self._base = np.array([point in base for point in self.points], dtype=bool)
        self._radii = np.array(list(self.points.values()))
        self.set_obstacles(obstacles)

    def set_obstacles(self, obstacles: Iterable[Obstacle]) -> None:
        """Replace the obstacles, from the next solve on."""
        self.obstacles = ObstacleSet(obstacles)

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        num = len(evaluation.qpos)
        if not len(self.obstacles) or not self.points:
            return np.zeros(num)
        # Without step 0, the start, which no command changes; the extrapolation comes last.
        hull = np.concatenate(
            [
                self._stack(evaluation.points)[:, 1:],
                self._stack(evaluation.terminal_points)[:, None],
            ],
            axis=1,
        )  # (K, H + 1, P, 3)
        weights = evaluation.weights
        near = self.obstacles.find_near(hull, weights.collision_range + self._radii.max())
        if not len(near):
            return np.zeros(num)
        left_out = None if evaluation.drives else self._base
        distances = self._compute_distances(hull, near, left_out)  # (K, H + 1, n)
        speed = np.square(evaluation.qvel[:, 1:, :2]).sum(-1)
        speed = np.concatenate([speed, speed[:, -1:]], axis=1)
        barrier = weights.collision * _compute_barrier(
            distances, weights.collision_decay, weights.collision_range
        ) + weights.collision_velocity * speed * _compute_barrier(
            distances, weights.collision_velocity_decay, weights.collision_range
        )
        return barrier[:, :-1].mean(axis=1) + evaluation.extrapolates * barrier[:, -1]

    def find_touches(self, evaluation: Evaluation) -> np.ndarray:
        """Mask of the samples that touch an obstacle more deeply than the start. (K,), bool."""
        num = len(evaluation.qpos)
        if not len(self.obstacles) or not self.points:
            return np.zeros(num, dtype=bool)
        hull = self._stack(evaluation.points)  # (K, H + 1, P, 3)
        near = self.obstacles.find_near(hull, self._radii.max())
        if not len(near):
            return np.zeros(num, dtype=bool)
        distances = self._compute_distances(hull, near).min(axis=-1)  # (K, H + 1)
        return distances[:, 1:].min(axis=1) < np.minimum(distances[:, 0], 0) - _DEEPER

    def compute_clearance(
        self, points: Mapping[str, np.ndarray], which: np.ndarray | None = None
    ) -> np.ndarray:
        """Smallest distance of the hull to any obstacle along each sample [m]; inf without any.

        Args:
            points: Positions of sites, as in `Evaluation.points`; only the hull's are used.
                Shapes (K, ..., 3).
            which: Indices of the obstacles; all by default. Shape (n,), int.

        Returns:
            Distance of every sample, negative inside. Shape (K,).
        """
        num = len(next(iter(points.values())))
        if not len(self.obstacles) or not self.points or (which is not None and not len(which)):
            return np.full(num, np.inf)
        return self._compute_distances(self._stack(points), which).reshape(num, -1).min(axis=1)

    def _stack(self, points: Mapping[str, np.ndarray]) -> np.ndarray:
        """Stack the positions of the hull's sites. Shape (..., P, 3)."""
        return np.stack([points[site] for site in self.points], axis=-2)

    def _compute_distances(
        self, hull: np.ndarray, which: np.ndarray | None, left_out: np.ndarray | None = None
    ) -> np.ndarray:
        """Distance of the hull, without the sites `left_out`, to each obstacle [m].

        Shapes (..., P, 3) and (P,) -> (..., n).
        """
        distances = self.obstacles.compute_distances(hull, which)  # (..., P, n)
        distances -= self._radii[:, None]
        handled = self.obstacles.handled if which is None else self.obstacles.handled[which]
        if handled.any() and self._hands.any():
            distances[..., np.outer(self._hands, handled)] = np.inf
        if left_out is not None:
            distances[..., left_out, :] = np.inf
        return distances.min(axis=-2)


def _compute_barrier(distances: np.ndarray, decay: float, cut_off: float) -> np.ndarray:
    """Sum over obstacles of the barrier, zero from `cut_off` [m] on. (..., n) -> (...)."""
    offset = math.exp(-decay * cut_off) if math.isfinite(cut_off) else 0.0
    return np.maximum(np.exp(-decay * distances) - offset, 0).sum(axis=-1)
