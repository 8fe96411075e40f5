"""Interface and registry of sampling optimizers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.errors import BadShape, BadValue
from xop_lerobot.core.registry import Registry
from xop_lerobot.morphology.tuning import MpcConfig


class Samples(NamedTuple):
    """Sampled command sequences.

    Attributes:
        knots: Support points drawn by the optimizer, for its own `update`. Shape (K, S, k).
        commands: Sequences to roll out. Shape (K, T, k).
        penalty: Cost added by the sampling itself, or None. Shape (K,).
    """

    knots: np.ndarray
    commands: np.ndarray
    penalty: np.ndarray | None = None


class SamplingOptimizer(ABC):
    """Improves a plan, a sequence of T commands with k entries, from K scored samples.

    One solve is `shift`, `sample`, a rollout that scores the samples, and `update`; `commands` is
    the plan. Contract of a subclass (checked by `tests/helpers/optimizer_contract.py`):

    - After `reset(command)` the plan holds `command`, (k,) -> (T, k).
    - `shift(steps)` advances the plan by `steps` >= 0 control steps, not necessarily an integer. A
      plan that holds a command still holds it after any shift.
    - `sample` returns K = `config.num_samples` sequences, all within the bounds. First comes
      the plan itself (unless `config.sample_plan` is off), then every candidate held over the
      horizon, as many as fit, then noise around the plan: of standard deviation `noise_std` at
      the support points right after a reset, and none for entries where it is zero. The same
      generator state gives the same samples.
    - `update` moves the plan towards low costs and returns weights that sum to one. A sample
      whose cost is not finite has zero weight; if none is finite, the plan stays, with all weight
      on the first sample.
    - Returned arrays are copies: neither side sees later changes of the other.

    Args:
        horizon: Number of control steps T.
        low: Lower bounds. Shape (k,).
        high: Upper bounds. Shape (k,).
        config: Number of samples, kind of sampling, weighting.
    """

    def __init__(self, horizon: int, low: np.ndarray, high: np.ndarray, config: MpcConfig) -> None:
        self.horizon, self.config = horizon, config
        self.low, self.high = np.array(low, dtype=float), np.array(high, dtype=float)
        if horizon < 1:
            raise BadValue(f"horizon must be at least 1, got {horizon}")
        if self.low.ndim != 1:
            raise BadShape("low", "(k,)", self.low.shape)
        if self.high.shape != self.low.shape:
            raise BadShape("high", self.low.shape, self.high.shape)
        if not (self.low <= self.high).all():
            raise BadValue(f"low must not be above high, got {self.low} and {self.high}")

    @abstractmethod
    def reset(self, command: np.ndarray) -> None:
        """Plan to hold `command`. Shape (k,)."""

    @property
    @abstractmethod
    def commands(self) -> np.ndarray:
        """The planned sequence, within the bounds. Shape (T, k)."""

    @abstractmethod
    def shift(self, steps: float) -> None:
        """Advance the plan by `steps` control steps."""

    @abstractmethod
    def sample(
        self, rng: np.random.Generator, noise_std: np.ndarray, candidates: np.ndarray
    ) -> Samples:
        """Draw K sequences around the plan.

        Args:
            rng: Source of randomness.
            noise_std: Standard deviation of every entry. Shape (k,).
            candidates: Fixed commands, each held over the horizon. Shape (c, k).
        """

    @abstractmethod
    def update(self, samples: Samples, costs: np.ndarray) -> np.ndarray:
        """Improve the plan by the `costs` of `samples`, (K,). Returns their weights, (K,)."""


Factory = Callable[[int, np.ndarray, np.ndarray, MpcConfig], SamplingOptimizer]
"""(horizon, low, high, config) -> optimizer; usually a class."""

OPTIMIZERS: Registry[Factory] = Registry("optimizer", {"kmppi": "xop_lerobot.retarget.kmppi:Kmppi"})


def build_optimizer(
    horizon: int, low: np.ndarray, high: np.ndarray, config: MpcConfig
) -> SamplingOptimizer:
    """Build the optimizer that `config.optimizer` names.

    Raises:
        UnknownName: Listing the known optimizers.
    """
    return OPTIMIZERS[config.optimizer](horizon, low, high, config)
