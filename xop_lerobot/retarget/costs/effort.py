"""Cost terms of effort: control (paper) and change of the command (ours)."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.transforms import sum_squares
from xop_lerobot.retarget.costs.cost import Cost, Evaluation


class ControlCost(Cost):
    r"""Mean over steps of :math:`w_a\|(a_k - a_{ref})/s\|^2`, s half the range of each entry, or 1.

    With the paper's absolute command (a reference of zero, s = 1) the term would pull a standing
    height towards zero; with the kinematic proposal as reference only deviations from it cost.

    Args:
        scale: Half the range of each command entry. Shape (k,).
    """

    name = "control"

    def __init__(self, scale: np.ndarray) -> None:
        self.scale = scale

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        effort = evaluation.commands - evaluation.reference
        if evaluation.scale_control:
            effort = effort / self.scale
        return evaluation.weights.control * sum_squares(effort).mean(-1)


class ChangeCost(Cost):
    r"""Mean over steps of :math:`w_\Delta\|(a_k - a_{exec})/s\|^2`, s half the range of each entry.

    :math:`a_{exec}` is the command being executed. It serves the purpose of the paper's control
    energy, smooth and slow motion, without pulling a steady command towards zero.

    Args:
        scale: Half the range of each command entry. Shape (k,).
    """

    name = "change"

    def __init__(self, scale: np.ndarray) -> None:
        self.scale = scale

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        if not evaluation.weights.change:
            return np.zeros(len(evaluation.commands))
        change = (evaluation.commands - evaluation.executed) / self.scale
        return evaluation.weights.change * sum_squares(change).mean(-1)
