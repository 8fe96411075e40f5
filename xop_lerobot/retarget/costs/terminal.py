"""Terminal cost."""

from __future__ import annotations

import numpy as np

from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.retarget.costs.tracking import compute_tracking


class TerminalCost(Cost):
    r""":math:`V_f = w_f\,l_{track}(\phi_\tau(x_H, a_{H-1}), G(t + H\,dt + \tau))`.

    φ extrapolates the last predicted state by the `CommandModel`, as if its last command were
    held for τ; with τ = 0 it is the paper's terminal cost. A horizon of 0.1 s alone cannot see
    what a walking command is good for.
    """

    name = "terminal"

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        total = np.zeros(len(evaluation.qpos))
        for name, goal in evaluation.terminal_goals.items():
            total += compute_tracking(evaluation.terminal_poses[name], goal, evaluation.weights)
        return evaluation.weights.terminal * total
