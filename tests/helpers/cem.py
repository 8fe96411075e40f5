"""The cross-entropy method over kernel-interpolated support points: an optimizer of one's own."""

from __future__ import annotations

import numpy as np

from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.kmppi import Kmppi
from xop_lerobot.retarget.optimizer import OPTIMIZERS, Samples

_LEAST = 0.3  # share of the noise that is always left


@OPTIMIZERS.register("cem")
class Cem(Kmppi):
    """The plan becomes the mean of the best samples, and the noise adapts to their spread.

    The `effective_samples` best samples count alike, the others not at all. Their spread is
    taken about the old plan: the noise shrinks where the best agree with it, and comes back
    where they lie aside of it.

    Args:
        horizon: Number of control steps T.
        low: Lower bounds. Shape (k,).
        high: Upper bounds. Shape (k,).
        config: Numbers of samples and knots, kernel, sampling.
    """

    def __init__(self, horizon: int, low: np.ndarray, high: np.ndarray, config: MpcConfig) -> None:
        super().__init__(horizon, low, high, config)
        self._share = np.ones_like(self.knots)  # of the noise, (S, k)
        self._noise_std = np.zeros(len(self.low))

    def reset(self, command: np.ndarray) -> None:
        """Plan to hold `command`, (k,), with the full noise."""
        super().reset(command)
        self._share = np.ones_like(self.knots)

    def sample(
        self, rng: np.random.Generator, noise_std: np.ndarray, candidates: np.ndarray
    ) -> Samples:
        """Draw samples around the plan with the noise's share of `noise_std`."""
        self._noise_std = np.asarray(noise_std)
        return super().sample(rng, noise_std * self._share, candidates)

    def update(self, samples: Samples, costs: np.ndarray) -> np.ndarray:
        """Move the plan to the mean of the best. Returns the weights, shape (K,)."""
        before = self.knots
        weights = super().update(samples, costs)
        used = weights > 0
        spread = np.sqrt(np.square(samples.knots[used] - before).mean(axis=0))
        noisy = self._noise_std > 0
        share = np.divide(spread, self._noise_std, where=noisy, out=np.ones_like(spread))
        if np.isfinite(costs).any():
            self._share = np.clip(share, _LEAST, 1.0)
        return weights

    def _weigh(self, costs: np.ndarray) -> np.ndarray:
        order = np.argsort(np.where(np.isfinite(costs), costs, np.inf), kind="stable")
        best = order[: max(1, round(self.config.effective_samples))]
        best = best[np.isfinite(costs[best])]
        weights = np.zeros(len(costs))
        weights[best if len(best) else 0] = 1 / max(1, len(best))
        return weights
