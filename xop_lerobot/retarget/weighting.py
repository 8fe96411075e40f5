"""How the costs of samples become their weights."""

from __future__ import annotations

import math

import numpy as np

from xop_lerobot.morphology.tuning import MpcConfig

_TOLERANCE = 1e-6  # of the logarithm of the effective sample size
_LEAST_SPAN = 1e-290  # costs nearer to each other than that are the same
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
    if math.isfinite(costs.dot(costs)):  # so they all are, in one look
        return _weigh_finite(costs, config)
    weights, finite = np.zeros(len(costs)), np.isfinite(costs)
    if finite.any():
        weights[finite] = _weigh_finite(costs[finite], config)
    else:
        weights[0] = 1.0
    return weights


def _weigh_finite(costs: np.ndarray, config: MpcConfig) -> np.ndarray:
    excess = costs - costs[costs.argmin()]
    temperature = config.temperature
    if config.weighting == "ess":
        return _compute_ess_weights(excess, config.effective_samples)
    if config.weighting == "minmax":
        span = float(excess.max())
        if span < _LEAST_SPAN:
            return np.full(len(costs), 1 / len(costs))
        temperature *= span
    weights = np.exp(excess * (-1 / temperature))
    weights *= 1 / weights.sum()
    return weights


def _compute_ess_weights(excess: np.ndarray, wanted: float) -> np.ndarray:
    r"""Weights of the wanted effective sample size; those alike that tie, if more tie for best.

    Newton's method for :math:`f(s) = \log n(e^s) - \log n^*` with the sample size
    :math:`n(\lambda) = (\sum e_i)^2 / \sum e_i^2`, :math:`e_i = \exp(-x_i/\lambda)`, whose
    derivative :math:`f' = \frac{2}{\lambda}(\frac{\sum x_i e_i}{\sum e_i} -
    \frac{\sum x_i e_i^2}{\sum e_i^2})` is never negative; a step out of the bracket halves
    it instead. The bracket is in units of the n-th best, so that no bad sample widens it.
    """
    count = len(excess)
    wanted = min(wanted, 0.99 * count)
    rank = min(math.ceil(wanted), count) - 1
    nth_best = float(np.partition(excess, rank)[rank])
    if nth_best < _LEAST_SPAN:
        tied = excess < _LEAST_SPAN
        return tied / tied.sum()
    position = math.log(0.65 * nth_best)  # the answer for most spreads of costs
    low, high = position - 60.0, position + 60.0
    target = math.log(wanted)
    powers, basis = np.empty((2, count)), np.empty((2, count))  # e and e²; 1 and x
    basis[0], basis[1] = 1.0, excess
    weights, squared = powers
    total = 1.0
    for _ in range(_MAX_ITERATIONS):
        temperature = math.exp(position)
        np.multiply(excess, -1 / temperature, out=weights)
        np.exp(weights, out=weights)
        np.multiply(weights, weights, out=squared)
        (total, first), (squares, second) = powers.dot(basis.T).tolist()
        miss = 2 * math.log(total) - math.log(squares) - target
        if abs(miss) < _TOLERANCE or high - low < _TOLERANCE:
            break
        if miss < 0:
            low = position
        else:
            high = position
        slope = 2 * (first / total - second / squares) / temperature
        position = position - miss / slope if slope > 0 else high
        if not low < position < high:
            position = 0.5 * (low + high)
    return weights * (1 / total)


def compute_effective_samples(weights: np.ndarray) -> float:
    r"""Effective sample size :math:`1/\sum_i w_i^2`, between 1 and K."""
    return float(1 / np.square(weights).sum())
