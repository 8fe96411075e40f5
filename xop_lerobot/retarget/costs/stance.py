"""Contact point cost."""

from __future__ import annotations

import numpy as np

from xop_lerobot.command import Mode
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
        speeds, heights = [], []
        for group in self.groups:
            velocities = np.stack([evaluation.velocities[site] for site in group])
            speeds.append(np.square(velocities[:, :, 1:]).sum(-1).mean(0))  # (K, H)
            points = np.stack([evaluation.points[site] for site in group])
            heights.append(points[:, :, 1:, 2].mean(0))
        speed = np.stack(speeds)  # (groups, K, H)
        if evaluation.mode is Mode.STATIONARY:
            active = speed.sum(axis=0)
        else:
            lowest = np.stack(heights).argmin(axis=0)[None]
            active = np.take_along_axis(speed, lowest, axis=0)[0]
        return evaluation.weights.stance * active.mean(axis=1)
