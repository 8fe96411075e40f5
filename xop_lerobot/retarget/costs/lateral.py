"""Lateral cost: wheels cannot go sideways, so the base shall face where it has to go."""

from __future__ import annotations

import numpy as np

from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.transforms import quat_yaw


def compute_lateral(base: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Part of a wanted velocity across the heading of the base [m/s]. (..., 7), (2,) -> (...)."""
    yaw = quat_yaw(base[..., 3:])
    return np.cos(yaw) * wanted[1] - np.sin(yaw) * wanted[0]


class LateralCost(Cost):
    r""":math:`w_l (u \cdot n(\psi))^2`, the part of the wanted velocity that wheels cannot give.

    u is the velocity at which the first tracked frame would reach its goal in time, n the normal
    of the base's heading ψ at the end of the extrapolation. A head that sits behind the axle
    can be moved sideways by turning the base, which is right for a few centimetres at rest. Done
    at speed it turns the base away from where it drives, ever further (the zero dynamics of an
    offset point are unstable ahead; Siciliano et al., Robotics, 2009, section 11.5). Facing
    forwards or backwards costs the same. Only mobile robots on wheels have the term.

    Args:
        nonholonomic: Whether the robot drives but cannot go sideways.
    """

    name = "lateral"

    def __init__(self, nonholonomic: bool) -> None:
        self.nonholonomic = nonholonomic

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        if not self.nonholonomic:
            return np.zeros(len(evaluation.qpos))
        lateral = compute_lateral(evaluation.terminal_qpos[:, :7], evaluation.wanted_velocity)
        return evaluation.weights.lateral * np.square(lateral)
