"""Collision avoidance cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from xop_lerobot.retarget.config import CostWeights
from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.transforms import quat_conjugate, quat_rotate

_RANGE = 1.0  # distance from which an obstacle costs nothing [m]


@dataclass(frozen=True)
class Obstacle:
    """A box that stands still.

    Attributes:
        name: Its name.
        position: Centre in the world [m]. Shape (3,).
        quat: Orientation wxyz. Shape (4,).
        half_size: Half its edges [m]. Shape (3,).
    """

    name: str
    position: np.ndarray
    quat: np.ndarray
    half_size: np.ndarray

    def compute_distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points to the box, negative inside [m]. (..., 3) -> (...)."""
        local = quat_rotate(quat_conjugate(self.quat), points - self.position)
        outside = np.abs(local) - self.half_size
        outer = np.linalg.norm(np.maximum(outside, 0), axis=-1)
        return outer + np.minimum(outside.max(-1), 0)


def make_obstacles(model: mujoco.MjModel) -> tuple[Obstacle, ...]:
    """Boxes of the colliding geoms that are fixed to the world, planes apart.

    Round geoms count by their bounding box in their own frame.
    """
    obstacles = []
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for i in range(model.ngeom):
        fixed = model.body_weldid[model.geom_bodyid[i]] == 0
        collides = model.geom_contype[i] or model.geom_conaffinity[i]
        if not fixed or not collides or model.geom_type[i] == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, data.geom_xmat[i])
        centre, half = model.geom_aabb[i, :3], model.geom_aabb[i, 3:]
        position = data.geom_xpos[i] + quat_rotate(quat, centre)
        obstacles.append(Obstacle(model.geom(i).name, position, quat, half.copy()))
    return tuple(obstacles)


class CollisionCost(Cost):
    r"""Mean of :math:`\sum_j w_c e^{-\alpha d_j} + w_v\|v\|^2 e^{-\beta d_j}` over steps.

    The same barrier counts once more at the end of the extrapolation: the horizon alone is too
    short to brake before a wall.

    :math:`d_j` is the least distance of the robot's body points to obstacle j, v the velocity
    of the base. Obstacles beyond one metre cost nothing: the term is cut off there smoothly, so
    that far walls do not push.

    Args:
        obstacles: What to keep clear of.
        points: Sites on the hull of the robot and the radius around each [m].
        alpha: Decay of the proximity term [1/m].
        beta: Decay of the velocity term [1/m].
    """

    name = "collision"

    def __init__(
        self,
        obstacles: tuple[Obstacle, ...],
        points: dict[str, float],
        alpha: float = 10.0,
        beta: float = 10.0,
    ) -> None:
        self.obstacles, self.points, self.alpha, self.beta = obstacles, points, alpha, beta

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        if not self.obstacles or not self.points:
            return np.zeros(len(evaluation.qpos))
        speed = np.square(evaluation.qvel[:, 1:, :2]).sum(-1)
        moving = self._compute_barrier(evaluation.points, speed, evaluation.weights)
        resting = self._compute_barrier(
            evaluation.terminal_points, speed[:, -1], evaluation.weights
        )
        return moving.mean(axis=1) + resting

    def _compute_barrier(
        self, points: Mapping[str, np.ndarray], speed: np.ndarray, weights: CostWeights
    ) -> np.ndarray:
        """Barriers of all obstacles, at the steps that `speed` is for. Shape of `speed`."""
        radii = np.array(list(self.points.values()))
        positions = [points[site] for site in self.points]
        if speed.ndim > 1:  # the first step is the start, which no command changes
            positions = [position[:, 1:] for position in positions]
        hull = np.stack(positions, axis=-2)
        total = np.zeros(speed.shape)
        for obstacle in self.obstacles:
            distance = (obstacle.compute_distance(hull) - radii).min(axis=-1)
            for weight, decay in (
                (weights.collision, self.alpha),
                (weights.collision_velocity * speed, self.beta),
            ):
                barrier = np.exp(-decay * distance) - np.exp(-decay * _RANGE)
                total += weight * np.maximum(barrier, 0)
        return total
