"""KMPPI: model predictive path integral control over kernel-interpolated support points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from xop_lerobot.retarget.config import MpcConfig


class Samples(NamedTuple):
    """Sampled command sequences.

    Attributes:
        knots: Support values. Shape (K, S, k).
        commands: Interpolated commands. Shape (K, T, k).
    """

    knots: np.ndarray
    commands: np.ndarray


class Kmppi:
    r"""Sampling optimizer of a command sequence :math:`A = W\,\theta`.

    The sequence of T commands is interpolated from S support values θ by a Gaussian process
    with kernel :math:`k(a,b)=\exp(-(a-b)^2/2\sigma^2)` whose mean is the last support value,

    .. math:: A(t) = \theta_S + k(t, t_k)\,k(t_k, t_k)^{-1}(\theta - \theta_S).

    A steady command is thus represented exactly, and survives the shift from plan to plan;
    with the zero mean of the original it would leak towards zero within a few plans.

    Args:
        horizon: Number of control steps T.
        low: Lower bounds. Shape (k,).
        high: Upper bounds. Shape (k,).
        config: Numbers of samples and knots, kernel, weighting.
    """

    def __init__(self, horizon: int, low: np.ndarray, high: np.ndarray, config: MpcConfig) -> None:
        self.horizon, self.low, self.high, self.config = horizon, low, high, config
        num_knots = min(config.num_knots, horizon)
        self.knot_times = np.linspace(0, horizon - 1, num_knots) if num_knots > 1 else np.zeros(1)
        self.knots = np.zeros((num_knots, len(low)))
        self._interpolation = self._compute_interpolation(np.arange(horizon))

    def _compute_interpolation(self, times: np.ndarray) -> np.ndarray:
        """Matrix W of the interpolation at `times` [control steps]. Shape (T, S)."""

        def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            return np.exp(-((a[:, None] - b) ** 2) / (2 * self.config.kernel_width**2))

        gain = np.linalg.solve(
            kernel(self.knot_times, self.knot_times), kernel(times, self.knot_times).T
        ).T
        gain[:, -1] += 1 - gain.sum(axis=1)  # the mean: what is left of the last value
        return gain

    def reset(self, command: np.ndarray) -> None:
        """Plan to hold `command`. Shape (k,)."""
        self.knots = np.tile(command, (len(self.knot_times), 1))

    @property
    def commands(self) -> np.ndarray:
        """The planned sequence. Shape (T, k)."""
        return np.clip(self._interpolation @ self.knots, self.low, self.high)

    def shift(self, steps: float) -> None:
        """Move the plan on by `steps` control steps; past its end the last value is held."""
        times = np.minimum(self.knot_times + steps, self.horizon - 1)
        self.knots = self._compute_interpolation(times) @ self.knots

    def sample(
        self, rng: np.random.Generator, noise_std: np.ndarray, candidates: np.ndarray
    ) -> Samples:
        """Draw antithetic samples around the plan; the plan itself and `candidates` come first.

        Args:
            rng: Source of randomness.
            noise_std: Standard deviation of every entry. Shape (k,).
            candidates: Commands to try held over the horizon. Shape (c, k).

        Returns:
            K samples within the bounds.
        """
        fixed = np.concatenate(
            [self.knots[None], np.repeat(candidates[:, None], len(self.knots), axis=1)]
        )[: self.config.num_samples]
        count = self.config.num_samples - len(fixed)
        half = rng.standard_normal(((count + 1) // 2, *self.knots.shape)) * noise_std
        noise = np.concatenate([half, -half])[:count]
        knots = np.clip(np.concatenate([fixed, self.knots + noise]), self.low, self.high)
        commands = np.clip(self._interpolation @ knots, self.low, self.high)
        return Samples(knots, commands)

    def update(self, samples: Samples, costs: np.ndarray) -> np.ndarray:
        """Move the plan to the weighted mean of the samples. Returns the weights, shape (K,)."""
        weights = compute_weights(costs, self.config)
        used = weights > 0  # a sample that is not finite must not get in with weight 0
        self.knots = np.tensordot(weights[used], samples.knots[used], axes=1)
        return weights


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
    if not finite.any():
        weights = np.zeros(len(costs))
        weights[0] = 1.0
        return weights
    excess = np.where(finite, costs - costs[finite].min(), np.inf)
    span = excess[finite].max()
    if span <= np.finfo(float).tiny:
        return finite / finite.sum()
    if config.weighting == "raw":
        return _softmin(excess, config.temperature)
    if config.weighting == "minmax":
        return _softmin(excess, config.temperature * span)
    wanted = min(config.effective_samples, 0.99 * finite.sum())
    low, high = 1e-6 * span, 1e3 * span
    for _ in range(40):  # bisection on log λ; the effective size grows with λ
        middle = np.sqrt(low * high)
        if compute_effective_samples(_softmin(excess, middle)) < wanted:
            low = middle
        else:
            high = middle
    return _softmin(excess, np.sqrt(low * high))


def _softmin(excess: np.ndarray, temperature: float) -> np.ndarray:
    weights = np.exp(-excess / temperature)
    return weights / weights.sum()


def compute_effective_samples(weights: np.ndarray) -> float:
    r"""Effective sample size :math:`1/\sum_i w_i^2`, between 1 and K."""
    return float(1 / np.square(weights).sum())
