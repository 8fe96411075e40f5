"""KMPPI: model predictive path integral control with kernel-interpolated support points.

`Kmppi` is the optimizer; `compute_weights` turns costs into weights, and `DRAWS` are the kinds of
sampling noise. With the default of one support point it is MPPI over a single held command.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from xop_lerobot.core.errors import BadShape
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.optimizer import Samples, SamplingOptimizer

_TOLERANCE = 1e-6  # error of the logarithm of the effective sample size
_LEAST_SPAN = 1e-290  # differences of costs below this count as ties (log and division stay finite)
_MAX_ITERATIONS = 100


def compute_weights(costs: np.ndarray, config: MpcConfig) -> np.ndarray:
    r"""Weights :math:`w_i \propto \exp(-(J_i - \min J)/\lambda)` that sum to one.

    `raw` takes λ from `config`, in units of the cost; `ess` finds the λ that gives the desired
    effective sample size :math:`1/\sum w_i^2`, which makes the update independent of the scale of
    the cost. Samples with a non-finite cost get zero weight.

    Args:
        costs: Total cost of each sample. Shape (K,).
        config: Weighting and its parameters.

    Returns:
        Weights. Shape (K,). All on the first sample (the shifted plan) if no cost is finite.
    """
    if math.isfinite(costs.dot(costs)):  # then all are finite; one product is the fastest check
        return _weigh_finite(costs, config)
    weights, finite = np.zeros(len(costs)), np.isfinite(costs)
    if finite.any():
        weights[finite] = _weigh_finite(costs[finite], config)
    else:
        weights[0] = 1.0
    return weights


def _weigh_finite(costs: np.ndarray, config: MpcConfig) -> np.ndarray:
    excess = costs - costs[costs.argmin()]
    if config.weighting == "ess":
        return _compute_ess_weights(excess, config.effective_samples)
    weights = np.exp(excess * (-1 / config.temperature))
    weights *= 1 / weights.sum()
    return weights


def _compute_ess_weights(excess: np.ndarray, wanted: float) -> np.ndarray:
    r"""Weights of the desired effective sample size; equal if at least as many tie for the best.

    Newton's method for :math:`f(s) = \log n(e^s) - \log n^*` with the sample size
    :math:`n(\lambda) = (\sum e_i)^2 / \sum e_i^2`, :math:`e_i = \exp(-x_i/\lambda)`, whose
    derivative :math:`f' = \frac{2}{\lambda}(\frac{\sum x_i e_i}{\sum e_i} -
    \frac{\sum x_i e_i^2}{\sum e_i^2})` is never negative; a step out of the bracket is replaced
    by bisection. The bracket scales with the n*-th best cost, so that outliers do not widen it.
    """
    count = len(excess)
    wanted = min(wanted, 0.99 * count)
    rank = min(math.ceil(wanted), count) - 1
    nth_best = float(np.partition(excess, rank)[rank])
    if nth_best < _LEAST_SPAN:
        tied = excess < _LEAST_SPAN
        return tied / tied.sum()
    position = math.log(0.65 * nth_best)  # initial guess: near the solution for most cost spreads
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


Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
"""(rng, shape) -> standard normal values; the first axis indexes the samples."""


def draw_gaussian(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw independent samples."""
    return rng.standard_normal(shape)


def draw_antithetic(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw antithetic pairs ±ε, so that the mean of an even number of samples is zero."""
    first = rng.standard_normal(((shape[0] + 1) // 2, *shape[1:]))
    return np.concatenate([first, -first])[: shape[0]]


DRAWS: dict[str, Draw] = {"gaussian": draw_gaussian, "antithetic": draw_antithetic}


__all__ = ["Kmppi", "Samples", "compute_effective_samples", "compute_weights"]

_MAX_SHIFTS = 64  # shift matrices that are cached


class Kmppi(SamplingOptimizer):
    r"""Sampling optimizer of a command sequence :math:`A = W\,\theta`.

    The sequence of T commands is interpolated from S support values θ by a Gaussian process
    with kernel :math:`k(a,b)=\exp(-(a-b)^2/2\sigma^2)` whose mean is the last support value,

    .. math:: A(t) = \theta_S + k(t, t_k)\,k(t_k, t_k)^{-1}(\theta - \theta_S).

    A constant command is thus represented exactly and survives the shift from plan to plan; with
    the original's zero mean (`kernel_mean="zero"`) it decays towards zero within a few plans.
    Samples :math:`\theta + \epsilon` are clipped to the bounds before and after the interpolation;
    the plan becomes their weighted mean.

    With `kernel_mean="zero", shift="one", sampling="gaussian", sample_plan=False,
    weighting="raw", importance_cost=True` and no candidates it equals KMPPI of pytorch_mppi 0.9.1
    up to rounding.

    Args:
        horizon: Number of control steps T.
        low: Lower bounds. Shape (k,).
        high: Upper bounds. Shape (k,).
        config: Numbers of samples and knots, kernel, sampling, weighting.
    """

    def __init__(self, horizon: int, low: np.ndarray, high: np.ndarray, config: MpcConfig) -> None:
        super().__init__(horizon, low, high, config)
        num_knots = min(config.num_knots, horizon)
        self.knot_times = np.linspace(0, horizon - 1, num_knots) if num_knots > 1 else np.zeros(1)
        self.knots = np.zeros((num_knots, len(self.low)))
        self._interpolation = self._compute_interpolation(np.arange(horizon))
        self._shifts: dict[float, np.ndarray] = {}
        self._moved: np.ndarray | None = None
        # One value held over the horizon, or one value per step, needs no interpolation.
        self._constant = num_knots == 1 and config.kernel_mean == "hold"
        self._direct = self._constant or num_knots == horizon
        self._low, self._high = self.low[:, None], self.high[:, None]
        self._draw = DRAWS[config.sampling]

    def _compute_interpolation(self, times: np.ndarray) -> np.ndarray:
        """Matrix W of the interpolation at `times` [control steps]. Shape (T, S)."""

        def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            return np.exp(-((a[:, None] - b) ** 2) / (1e-8 + 2 * self.config.kernel_width**2))

        gain = np.linalg.solve(
            kernel(self.knot_times, self.knot_times), kernel(times, self.knot_times).T
        ).T
        if self.config.kernel_mean == "hold":
            gain[:, -1] += 1 - gain.sum(axis=1)  # the mean θ_S: rows must sum to one
        return gain

    def reset(self, command: np.ndarray) -> None:
        """Plan to hold `command`. Shape (k,)."""
        if np.shape(command) != self.low.shape:
            raise BadShape("command", self.low.shape, np.shape(command))
        self.knots = np.tile(command, (len(self.knot_times), 1)).astype(float)
        self._moved = None

    @property
    def nominal(self) -> np.ndarray:
        """The planned sequence before clipping. Shape (T, k)."""
        if self._moved is not None:
            return self._moved.copy()
        return self._interpolation.dot(self.knots)  # faster than @ for small arrays

    @property
    def commands(self) -> np.ndarray:
        """The planned sequence. Shape (T, k)."""
        return np.minimum(np.maximum(self.nominal, self.low), self.high)

    def shift(self, steps: float) -> None:
        """Advance the plan by `steps` control steps.

        Beyond its end the last value is held or, with a zero-mean kernel, decays. As in the
        original, the zero-mean plan until the next update is the old sequence shifted by whole
        steps and padded with zeros.
        """
        if self._constant:
            return
        if self.config.shift == "one":
            steps = 1
        if self.config.kernel_mean == "zero":
            whole = min(round(steps), self.horizon)
            moved = np.zeros((self.horizon, len(self.low)))
            moved[: self.horizon - whole] = self.nominal[whole:]
            self._moved = moved
        self.knots = self._get_shift(steps).dot(self.knots)

    def _get_shift(self, steps: float) -> np.ndarray:
        """Matrix that advances the support values by `steps`. Shape (S, S)."""
        key = round(min(steps, 1e6), 6)
        matrix = self._shifts.get(key)
        if matrix is None:
            times = self.knot_times + key
            if self.config.kernel_mean == "hold":
                times = np.minimum(times, self.horizon - 1)
            if len(self._shifts) >= _MAX_SHIFTS:  # measured times never repeat: bound the cache
                self._shifts.clear()
            matrix = self._shifts[key] = self._compute_interpolation(times)
        return matrix

    def sample(
        self, rng: np.random.Generator, noise_std: np.ndarray, candidates: np.ndarray
    ) -> Samples:
        """Draw samples around the plan; the plan itself and `candidates` come first.

        Args:
            rng: Source of randomness.
            noise_std: Standard deviation of every entry. Shape (k,), or (S, k).
            candidates: Fixed commands, each held over the horizon. Shape (c, k).

        Returns:
            K samples within the bounds.

        Raises:
            BadShape: If `noise_std` or `candidates` does not fit.
        """
        total, (num_knots, entries) = self.config.num_samples, self.knots.shape
        if noise_std.shape not in ((entries,), (num_knots, entries)):
            raise BadShape("noise_std", (entries,), noise_std.shape)
        if candidates.ndim != 2 or candidates.shape[1] != entries:
            raise BadShape("candidates", f"(c, {entries})", candidates.shape)
        knots = np.empty((num_knots, entries, total))  # samples last: the longest axis inside
        fixed = int(self.config.sample_plan)
        if fixed:
            knots[..., 0] = self.knots
        if len(candidates):
            candidates = candidates[: total - fixed]
            knots[..., fixed : fixed + len(candidates)] = candidates.T
            fixed += len(candidates)
        if fixed < total:
            noise = self._draw(rng, (total - fixed, num_knots, entries))
            free = knots[..., fixed:]
            np.multiply(noise.transpose(1, 2, 0), noise_std[..., None], out=free)
            np.add(free, self.knots[..., None], out=free)
        np.maximum(knots, self._low, out=knots)
        np.minimum(knots, self._high, out=knots)
        commands = self._interpolate(knots)
        penalty = None
        if self.config.importance_cost:
            penalty = self._compute_importance(commands, noise_std)
        return Samples(knots.transpose(2, 0, 1), commands.transpose(2, 0, 1), penalty)

    def _interpolate(self, knots: np.ndarray) -> np.ndarray:
        """Command sequences of support values, (S, k, K) -> (T, k, K), as one product."""
        num_knots, entries, total = knots.shape
        if self._direct:
            commands = np.empty((self.horizon, entries, total))
            commands[:] = knots
            return commands
        free = self._interpolation.dot(knots.reshape(num_knots, -1))
        commands = free.reshape(self.horizon, entries, total)
        np.maximum(commands, self._low, out=commands)
        np.minimum(commands, self._high, out=commands)
        return commands

    def _compute_importance(self, commands: np.ndarray, noise_std: np.ndarray) -> np.ndarray:
        r"""MPPI's importance sampling: :math:`\lambda\sum_t U_t^\top\Sigma^{-1}(A_t-U_t)`. (K,)."""
        nominal = self.nominal
        variance = np.square(noise_std if noise_std.ndim == 1 else noise_std[0])
        # An entry without noise has no density and contributes nothing.
        precision = np.divide(1.0, variance, where=variance > 0, out=np.zeros_like(variance))
        gain = self.config.temperature * nominal * precision
        deviation = commands - nominal[..., None]
        return gain.ravel().dot(deviation.reshape(gain.size, -1))

    def update(self, samples: Samples, costs: np.ndarray) -> np.ndarray:
        """Set the plan to the weighted mean of the samples. Returns the weights, shape (K,).

        Raises:
            BadShape: If there is not one cost per sample.
        """
        if costs.shape != (len(samples.knots),):
            raise BadShape("costs", (len(samples.knots),), costs.shape)
        weights = self._weigh(costs if samples.penalty is None else costs + samples.penalty)
        rows = samples.knots.transpose(1, 2, 0).reshape(-1, len(weights))
        mean = rows.dot(weights)
        if not math.isfinite(mean.dot(mean)):  # a non-finite sample of weight 0: 0 · inf is NaN
            used = weights > 0
            mean = rows[:, used].dot(weights[used])
        self.knots, self._moved = mean.reshape(self.knots.shape), None
        return weights

    def _weigh(self, costs: np.ndarray) -> np.ndarray:
        """Weights of samples with total `costs`. Shapes (K,)."""
        return compute_weights(costs, self.config)
