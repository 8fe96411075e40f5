"""Contact point cost."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import sum_squares
from xop_lerobot.retarget.costs.cost import Cost, Evaluation


class StanceCost(Cost):
    r"""Mean over steps of :math:`w_s \sum_{i \in C_k} \|\dot p^c_{i,k}\|^2`.

    Points come in groups that touch the ground together (the four of a foot); each group counts
    by the mean of its points. C holds every group in stationary mode, and in mobile mode the
    lowest group of each step, the standing foot. On wheels, which must roll, only stationary
    mode counts.

    Args:
        groups: Sites of each group of contact points.
        wheeled: Whether the robot stands on wheels.
    """

    name = "stance"

    def __init__(self, groups: tuple[tuple[str, ...], ...], wheeled: bool) -> None:
        self.groups, self.wheeled = groups, wheeled

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        if self.wheeled and evaluation.mode is Mode.MOBILE:
            return np.zeros(len(evaluation.qpos))
        speeds = []
        for group in self.groups:
            velocities = np.array([evaluation.velocities[site] for site in group])
            speeds.append(sum_squares(velocities[:, :, 1:]).mean(0))  # (K, H)
        speed = np.array(speeds)  # (groups, K, H)
        if evaluation.mode is Mode.STATIONARY:
            active = speed.sum(axis=0)
        else:
            active = np.take_along_axis(speed, self._find_lowest(evaluation)[None], axis=0)[0]
        return evaluation.weights.stance * active.mean(axis=1)

    def _find_lowest(self, evaluation: Evaluation) -> np.ndarray:
        """The lowest group of each step. Shape (K, H), int."""
        heights = []
        for group in self.groups:
            points = np.array([evaluation.points[site][:, 1:, 2] for site in group])
            heights.append(points.mean(0))
        return np.array(heights).argmin(axis=0)
