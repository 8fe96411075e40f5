"""Fall cost."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.retarget.costs.cost import Cost, Evaluation


class FallCost(Cost):
    r"""Mean over steps of :math:`w_{fall}(\max(0, \alpha - \alpha_s)^2 + \max(0, z_s - z)^2)`.

    α is the tilt of the base and z its height. The safe tilt is halfway between the one at which
    the robot rests under the executed command and a fall; the safe height is the one at which
    three quarters of the margin to a fall are used up, or halfway between a fall and the lowest
    height that can be commanded. So the cost is zero in ordinary motion, also of a robot that
    squats. The paper has no such term; its predicted falls show up in the tracking cost alone.

    Args:
        tilt: Tilt at which the robot counts as fallen [rad].
        height: Base height under which it counts as fallen [m].
        standing_height: Base height at rest [m].
        lowest: Lowest base height that can be commanded [m].
        compute_rest_tilt: Tilt at which a base rests under a command in a mode [rad]; 0 by default.
    """

    name = "fall"

    def __init__(
        self,
        tilt: float,
        height: float,
        standing_height: float,
        lowest: float = math.inf,
        compute_rest_tilt: Callable[[np.ndarray, Mode], float] = lambda _command, _mode: 0.0,
    ) -> None:
        self.tilt, self.height = tilt, height
        self._compute_rest_tilt = compute_rest_tilt
        self.safe_height = min(height + (standing_height - height) / 4, (height + lowest) / 2)

    def find_falls(self, evaluation: Evaluation) -> np.ndarray:
        """Which samples count as fallen at some predicted step. Shape (K,), bool."""
        base = evaluation.qpos[:, 1:, :7]
        fallen = (_compute_upright(base) < math.cos(self.tilt)) | (base[..., 2] < self.height)
        return np.any(fallen, axis=1)

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        base = evaluation.qpos[:, 1:, :7]
        tilt = np.arccos(np.clip(_compute_upright(base), -1, 1))
        rest_tilt = self._compute_rest_tilt(evaluation.executed, evaluation.mode)
        safe_tilt = (self.tilt + rest_tilt) / 2
        excess = np.square(np.maximum(0, tilt - safe_tilt))
        excess += np.square(np.maximum(0, self.safe_height - base[..., 2]))
        return evaluation.weights.fall * excess.mean(axis=1)


def _compute_upright(base: np.ndarray) -> np.ndarray:
    """Cosine of the angle of the base's Z to the vertical. Shape (..., 7) -> (...)."""
    return 1 - 2 * (base[..., 4] ** 2 + base[..., 5] ** 2)
