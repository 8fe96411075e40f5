"""What is done when the prediction falls or touches something: slow down, or veto the plan."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

_SLOW, _VETO = 0.1, 0.5  # share of the weight on failing samples


class Intervention(IntEnum):
    """Why a plan is not what the samples' weighted mean says."""

    NONE = 0
    SLOWED_FALL = 1
    """Velocities are reduced: some of the likely futures fall."""
    SLOWED_COLLISION = 2
    """Velocities are reduced: some of the likely futures touch an obstacle."""
    VETOED_FALL = 3
    """The plan is replaced by the best safe sample: most of the likely futures fall."""
    VETOED_COLLISION = 4
    """The plan is replaced by the best safe sample: most of them touch an obstacle."""
    DIVERGED = 5
    """No prediction is a number: velocities go to zero, the posture holds."""


class Verdict(NamedTuple):
    """The judgement on a plan.

    Attributes:
        intervention: What is to be done.
        risk: Weight on samples that fail, 0 to 1.
        sample: The sample to execute instead, None for the plan itself.
        scale: Factor on the base's velocities, 1 for the plan itself.
    """

    intervention: Intervention
    risk: float
    sample: int | None = None
    scale: float = 1.0


def judge(
    weights: np.ndarray, costs: np.ndarray, falls: np.ndarray, touches: np.ndarray, stop: int | None
) -> Verdict:
    r"""Judge a plan by the samples it is the mean of.

    The risk is :math:`r = \sum_i w_i [\text{sample } i \text{ fails}]`. Up to 0.1 the plan stays.
    Above, the base's velocities are scaled by 1 − r. From 0.5 on, the cheapest sample
    that does not fail takes its place. If all fail, it is the sample `stop`, or without one the
    executed posture at no velocity.

    Args:
        weights: Weights of the samples. Shape (K,).
        costs: Their costs, NaN for those that diverged. Shape (K,).
        falls: Which of them fall, or diverge. Shape (K,), bool.
        touches: Which of them touch an obstacle. Shape (K,), bool.
        stop: Index of the sample that stops, None if there is none.
    """
    finite = np.isfinite(costs)
    if not finite.any():
        return Verdict(Intervention.DIVERGED, 1.0, scale=0.0)
    failing = falls | touches
    risk = float(weights[failing].sum())
    if risk <= _SLOW:
        return Verdict(Intervention.NONE, risk)
    is_fall = weights[falls].sum() >= weights[touches].sum()
    if risk < _VETO:
        reason = Intervention.SLOWED_FALL if is_fall else Intervention.SLOWED_COLLISION
        return Verdict(reason, risk, scale=1 - risk)
    reason = Intervention.VETOED_FALL if is_fall else Intervention.VETOED_COLLISION
    safe = np.flatnonzero(~failing & finite)
    if not len(safe) and stop is None:
        return Verdict(reason, risk, scale=0.0)
    best = int(safe[np.argmin(costs[safe])]) if len(safe) else stop
    return Verdict(reason, risk, sample=best)
