"""How the costs of samples become their weights."""

from __future__ import annotations

import math

import numpy as np

from xop_lerobot.retarget.config import MpcConfig

_TOLERANCE = 1e-9  # of the logarithm of the effective sample size
_MAX_ITERATIONS = 100


def compute_weights(costs: np.ndarray, config: MpcConfig) -> np.ndarray:
    r"""Weights :math:`w_i \propto \exp(-(J_i - \min J)/\lambda)` that sum to one.

    `raw` takes λ in units of the cost; `minmax` divides by the costs' range first; `ess` finds
    the λ at which the effective sample size :math:`1/\sum w_i^2` is the wanted one, which makes
    the update independent of the scale of the cost. Samples whose cost is not finite get none.

    Args:
        costs: Total cost of each sample. Shape (K,).
        config: Weighting and its parameters.

    Returns:
        Weights. Shape (K,). All on the first sample (the standing plan) if no cost is finite.
    """
    finite = np.isfinite(costs)
    if not finite.all():
        weights = np.zeros(len(costs))
        if finite.any():
            weights[finite] = compute_weights(costs[finite], config)
        else:
            weights[0] = 1.0
        return weights
    excess = costs - costs.min()
    span = float(excess.max())
    if span <= np.finfo(float).tiny:
        return np.full(len(costs), 1 / len(costs))
    if config.weighting == "ess":
        return _compute_ess_weights(excess, span, config.effective_samples)
    temperature = config.temperature * (span if config.weighting == "minmax" else 1.0)
    weights = np.exp(excess * (-1 / temperature))
    weights *= 1 / weights.sum()
    return weights


def _compute_ess_weights(excess: np.ndarray, span: float, wanted: float) -> np.ndarray:
    r"""Weights of the wanted effective sample size, or the nearest to it that there is.

    Newton's method for :math:`f(s) = \log n(e^s) - \log n^*` with the sample size
    :math:`n(\lambda) = (\sum e_i)^2 / \sum e_i^2`, :math:`e_i = \exp(-x_i/\lambda)`, whose
    derivative :math:`f' = \frac{2}{\lambda}(\frac{\sum x_i e_i}{\sum e_i} -
    \frac{\sum x_i e_i^2}{\sum e_i^2})` is never negative; a step out of the bracket
    :math:`\lambda \in [10^{-6}, 10^3]\,\max x` halves it instead.
    """
    count = len(excess)
    wanted = min(wanted, 0.99 * count)
    rank = min(math.ceil(wanted), count) - 1
    low, high = math.log(1e-6 * span), math.log(1e3 * span)
    # With costs spread evenly, half the excess of the n-th best is the answer.
    guess = 0.5 * float(np.partition(excess, rank)[rank])
    position = math.log(guess) if guess > 1e-6 * span else 0.5 * (low + math.log(span))
    target = math.log(wanted)
    for _ in range(_MAX_ITERATIONS):
        temperature = math.exp(position)
        weights = np.exp(excess * (-1 / temperature))
        weighted = excess * weights
        total, squares = float(weights.sum()), float(weights @ weights)
        miss = 2 * math.log(total) - math.log(squares) - target
        if abs(miss) < _TOLERANCE or high - low < _TOLERANCE:
            break
        if miss < 0:
            low = position
        else:
            high = position
        slope = 2 * (float(weighted.sum()) / total - float(weighted @ weights) / squares)
        step = -miss * temperature / slope if slope > 0 else math.inf
        position += step
        if not low < position < high:
            position = 0.5 * (low + high)
    weights *= 1 / total
    return weights


def compute_effective_samples(weights: np.ndarray) -> float:
    r"""Effective sample size :math:`1/\sum_i w_i^2`, between 1 and K."""
    return float(1 / np.square(weights).sum())
