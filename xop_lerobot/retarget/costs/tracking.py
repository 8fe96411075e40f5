"""Goal tracking cost."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.transforms import compute_heading_squares, sum_squares
from xop_lerobot.morphology.tuning import CostWeights
from xop_lerobot.retarget.costs.cost import Cost, Evaluation


class TrackingCost(Cost):
    r"""Mean over steps of :math:`\sum_f w_p\|p - p^d\|^2 + w_\theta\,d(\theta, \theta^d)^2`.

    p, θ are the predicted position and orientation of a tracked frame, d the angle between two
    orientations. The paper writes it for the base pose; a frame anywhere on the body includes it.
    """

    name = "tracking"

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        total = np.zeros(len(evaluation.qpos))
        for name, goals in evaluation.goals.items():
            poses = evaluation.poses[name][:, 1:]
            total += compute_tracking(poses, goals[1:], evaluation.weights).mean(axis=1)
        return total


def compute_tracking(poses: np.ndarray, goals: np.ndarray, weights: CostWeights) -> np.ndarray:
    r"""Weighted squared error of poses. Shapes (..., 7) and (..., 7) -> (...).

    .. math:: w_p\|p - p^d\|^2 + w_\theta(e_\psi^2 + \kappa(e_x^2 + e_y^2))

    with the errors of heading and tilt of `heading_error`, and κ the share of a tilt: at κ = 1
    and for small errors, the paper's :math:`d(\theta, \theta^d)^2`.
    """
    position = sum_squares(poses[..., :3] - goals[..., :3])
    turn, tilt = compute_heading_squares(goals[..., 3:], poses[..., 3:])
    return weights.position * position + weights.orientation * (turn + weights.tilt_share * tilt)
