"""Cost terms of tracking: goals over the horizon and at its end, level hands (all in the paper)."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.transforms import (
    compute_heading_squares,
    make_pose,
    quat_exp,
    quat_multiply,
    quat_rotate,
    sum_squares,
)
from xop_lerobot.morphology.tuning import CostWeights
from xop_lerobot.retarget.costs.cost import Cost, Evaluation


class TrackingCost(Cost):
    r"""Mean over steps of :math:`\sum_f w_p\|p - p^d\|^2 + w_\theta\,d(\theta, \theta^d)^2`.

    p, θ are the predicted position and orientation of a tracked frame, d the angle between two
    orientations. The paper has the base pose here; a tracked frame may be anywhere on the body.
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

    with the heading and tilt errors of `heading_error`, and κ the relative weight of a tilt
    (`tilt_share`). For κ = 1 and small errors it is the paper's :math:`d(\theta, \theta^d)^2`.
    """
    position = sum_squares(poses[..., :3] - goals[..., :3])
    turn, tilt = compute_heading_squares(goals[..., 3:], poses[..., 3:])
    return weights.position * position + weights.orientation * (turn + weights.tilt_share * tilt)


class TerminalCost(Cost):
    r""":math:`V_f = w_f\,l_{track}(\phi_\tau(x_H, a_{H-1}), G(t + H\,dt + \tau))`.

    φ extrapolates the last predicted state by the `CommandModel`, with the last command held for
    τ; with τ = 0 it is the paper's terminal cost. A horizon of some tenths of a second alone does
    not show the benefit of a walking command.
    """

    name = "terminal"

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        total = np.zeros(len(evaluation.qpos))
        for name, goal in evaluation.terminal_goals.items():
            total += compute_tracking(evaluation.terminal_poses[name], goal, evaluation.weights)
        return evaluation.weights.terminal * total


_UP = np.array([0.0, 0.0, 1.0])


class UprightCost(Cost):
    r"""Mean over steps, and at the end of the extrapolation, of :math:`w_u\sum_f\|h_f\|^2`.

    .. math:: h = R(\theta)\,R_{ee}(q)\,e_z - s\,e_z

    of each hand that is kept level: the paper's constraint of Version 2, as a penalty. The Z of a
    wrist points out of the back of the hand; s is 1 if the operator's palm faces down and -1 if it
    faces up, as under a tray. For a small tilt α, :math:`\|h\|^2 = 2(1 - \cos\alpha) \approx
    \alpha^2`. The heading of the hand stays free.
    """

    name = "upright"

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        total = np.zeros(len(evaluation.qpos))
        for name in evaluation.upright:
            sign = compute_side(evaluation.terminal_goals[name])
            total += compute_upright(evaluation.poses[name][:, 1:], sign).mean(axis=1)
            if evaluation.extrapolates:
                total += compute_upright(evaluation.terminal_poses[name], sign)
        return evaluation.weights.upright * total


def compute_side(pose: np.ndarray) -> np.ndarray:
    """Upper side of a hand: 1 for its back, -1 for its palm. Shape (..., 7) -> (...)."""
    return np.where(quat_rotate(pose[..., 3:], _UP)[..., 2] < 0, -1.0, 1.0)


def compute_upright(poses: np.ndarray, side: np.ndarray | float = 1.0) -> np.ndarray:
    r""":math:`\|R e_z - s e_z\|^2` of poses. Shape (..., 7) -> (...)."""
    return sum_squares(compute_upright_error(poses, side))


def compute_upright_error(poses: np.ndarray, side: np.ndarray | float = 1.0) -> np.ndarray:
    r""":math:`h = R e_z - s e_z` of poses. Shape (..., 7) -> (..., 3)."""
    return quat_rotate(poses[..., 3:], _UP) - np.asarray(side)[..., None] * _UP


def make_level(pose: np.ndarray) -> np.ndarray:
    """Rotate a pose by the smallest angle that makes its Z vertical. Shape (..., 7) -> (..., 7).

    Used for goals of hands that are kept level, whose tilt would compete with the constraint. The
    upper side of the hand stays up.
    """
    up = compute_side(pose)[..., None] * quat_rotate(pose[..., 3:], _UP)
    x, y, z = np.moveaxis(up, -1, 0)
    sine = np.hypot(x, y)
    scale = np.arctan2(sine, z) / np.maximum(sine, 1e-12)
    turn = np.stack([y * scale, -x * scale, np.zeros_like(x)], axis=-1)
    return make_pose(pose[..., :3], quat_multiply(quat_exp(turn), pose[..., 3:]))
