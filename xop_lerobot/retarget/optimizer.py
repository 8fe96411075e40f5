"""The base of sampling optimizers, and a check that a class keeps its contract."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.errors import BadShape, BadValue
from xop_lerobot.core.registry import Registry
from xop_lerobot.morphology.tuning import SAMPLINGS, MpcConfig


class Samples(NamedTuple):
    """Sampled command sequences.

    Attributes:
        knots: What the optimizer drew, for its own `update`. Shape (K, S, k).
        commands: What is to be rolled out. Shape (K, T, k).
        penalty: Cost that the sampling itself adds, or None. Shape (K,).
    """

    knots: np.ndarray
    commands: np.ndarray
    penalty: np.ndarray | None = None


class SamplingOptimizer(ABC):
    """Improves a plan, a sequence of T commands with k entries, from K scored samples of it.

    One solve is `shift`, `sample`, a rollout that scores the samples, `update`; `commands` is
    the plan. What a subclass must keep, and `check_optimizer` checks:

    - After `reset(command)` the plan holds `command`, (k,) -> (T, k).
    - `shift(steps)` moves the plan on by `steps` >= 0 control steps, not always whole ones. A
      plan that holds a command still holds it after any shift.
    - `sample` returns K = `config.num_samples` sequences, all within the bounds. First comes
      the plan itself (unless `config.sample_plan` is off), then every candidate held over the
      horizon, as many as there is room for, then noise around the plan: of standard deviation
      `noise_std` at the support points right after a reset, none where it is zero. The same
      generator state gives the same samples.
    - `update` moves the plan to where the costs are low, and returns weights that sum to one.
      A sample whose cost is not finite weighs nothing; if none is finite, the plan stays, with
      all weight on the first sample.
    - No array that is returned is changed later, and changing it changes nothing.

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
        """Move the plan on by `steps` control steps."""

    @abstractmethod
    def sample(
        self, rng: np.random.Generator, noise_std: np.ndarray, candidates: np.ndarray
    ) -> Samples:
        """Draw K sequences around the plan.

        Args:
            rng: Source of randomness.
            noise_std: Standard deviation of every entry. Shape (k,).
            candidates: Commands to try held over the horizon. Shape (c, k).
        """

    @abstractmethod
    def update(self, samples: Samples, costs: np.ndarray) -> np.ndarray:
        """Improve the plan from what `samples` cost, (K,). Returns their weights, (K,)."""


Factory = Callable[[int, np.ndarray, np.ndarray, MpcConfig], SamplingOptimizer]
"""What `check_optimizer` takes: (horizon, low, high, config) -> optimizer; a class is one."""

OPTIMIZERS: Registry[Factory] = Registry(
    "optimizer",
    {"cem": "xop_lerobot.retarget.cem:Cem", "kmppi": "xop_lerobot.retarget.kmppi:Kmppi"},
)


def build_optimizer(
    horizon: int, low: np.ndarray, high: np.ndarray, config: MpcConfig
) -> SamplingOptimizer:
    """Build the optimizer that `config.optimizer` names.

    Raises:
        UnknownName: Listing the known optimizers.
    """
    return OPTIMIZERS[config.optimizer](horizon, low, high, config)


# -- the contract, checked -----------------------------------------------------------------

_LOW, _HIGH = np.array([-1.0, 0.2, -3.0]), np.array([1.0, 0.9, 3.0])
_COMMAND = np.array([0.3, 0.55, -0.5])
_NOISE = np.array([0.05, 0.02, 0.1])
_HORIZON = 6


def check_optimizer(factory: Factory) -> None:
    """Check that what `factory` makes keeps the contract of `SamplingOptimizer`.

    It runs a few hundred solves of small problems with each kind of sampling, within seconds.

    Args:
        factory: The optimizer's class, or a function with the class's arguments.

    Raises:
        BadValue: Naming the first clause that is broken.
    """
    for sampling in SAMPLINGS:
        for num_samples in (1, 2, 5, 24):
            for num_knots in (1, 3):
                config = MpcConfig(
                    num_samples=num_samples,
                    horizon=_HORIZON,
                    noise_std={},
                    num_knots=num_knots,
                    sampling=sampling,
                )
                _check_plan(factory, config)
                _check_samples(factory, config)
                _check_update(factory, config)
        _check_noise(factory, config)
        _check_progress(factory, config)


def _make(factory: Factory, config: MpcConfig, command: np.ndarray) -> SamplingOptimizer:
    optimizer = factory(_HORIZON, _LOW, _HIGH, config)
    optimizer.reset(command)
    return optimizer


def _require(optimizer: SamplingOptimizer, holds: object, clause: str) -> None:
    if not holds:
        config = optimizer.config
        raise BadValue(
            f"{type(optimizer).__name__} breaks the contract of SamplingOptimizer: {clause} "
            f"(sampling {config.sampling!r}, {config.num_samples} samples, "
            f"{config.num_knots} knots)"
        )


def _is_close(actual: np.ndarray, expected: np.ndarray) -> bool:
    return np.shape(actual) == np.shape(expected) and np.allclose(actual, expected, atol=1e-8)


def _check_plan(factory: Factory, config: MpcConfig) -> None:
    held = np.tile(_COMMAND, (_HORIZON, 1))
    optimizer = _make(factory, config, _COMMAND)
    _require(
        optimizer,
        _is_close(optimizer.commands, held),
        f"after reset(command) commands must be it, {_HORIZON} times, got {optimizer.commands}",
    )
    optimizer.commands[:] = 0
    _require(optimizer, _is_close(optimizer.commands, held), "commands must be a copy")
    for steps in (0, 1, 0.37, 2.5, 1000):
        optimizer.shift(steps)
        _require(
            optimizer,
            _is_close(optimizer.commands, held),
            f"a held command must survive shift({steps}), got {optimizer.commands}",
        )
    optimizer.reset(_HIGH + 1)
    _require(
        optimizer,
        (optimizer.commands <= _HIGH).all(),
        f"commands must be within the bounds, got {optimizer.commands} after a reset beyond",
    )


def _check_samples(factory: Factory, config: MpcConfig) -> None:
    optimizer = _make(factory, config, _COMMAND)
    candidates = np.array([[0.1, 0.5, 0.2], [9.0, -9.0, 0.0]])
    samples = optimizer.sample(np.random.default_rng(0), 30 * _NOISE, candidates)
    shape = (config.num_samples, _HORIZON, 3)
    _require(
        optimizer,
        samples.commands.shape == shape,
        f"sampled commands must have shape {shape}, got {samples.commands.shape}",
    )
    within = (samples.commands >= _LOW).all() and (samples.commands <= _HIGH).all()
    _require(optimizer, within, "samples must be within the bounds")
    expected = np.clip(np.concatenate([[_COMMAND], candidates]), _LOW, _HIGH)
    for row, command in enumerate(expected[: config.num_samples]):
        _require(
            optimizer,
            _is_close(samples.commands[row], np.tile(command, (_HORIZON, 1))),
            f"sample {row} must be {'a candidate' if row else 'the plan'}, {command} held, "
            f"got {samples.commands[row]}",
        )
    before = samples.commands.copy()
    same = optimizer.sample(np.random.default_rng(0), 30 * _NOISE, candidates).commands
    _require(optimizer, (same == before).all(), "the same seed must give the same samples")
    other = optimizer.sample(np.random.default_rng(1), 30 * _NOISE, candidates).commands
    if config.num_samples > len(expected):
        _require(optimizer, (other != before).any(), "another seed must give other samples")
    _require(
        optimizer,
        (samples.commands == before).all(),
        "sample() must not change the samples that it returned before",
    )
    still = optimizer.sample(np.random.default_rng(0), np.array([0.1, 0.0, 0.1]), candidates[:0])
    _require(
        optimizer,
        (np.abs(still.commands[..., 1] - _COMMAND[1]) < 1e-12).all(),
        "entries without noise must stay",
    )


def _check_update(factory: Factory, config: MpcConfig) -> None:
    optimizer = _make(factory, config, _COMMAND)
    none, rng = np.zeros((0, 3)), np.random.default_rng(2)
    samples = optimizer.sample(rng, _NOISE, none)
    plan = optimizer.commands
    weights = optimizer.update(samples, np.full(config.num_samples, np.nan))
    first = np.eye(config.num_samples)[0]
    _require(
        optimizer,
        _is_close(optimizer.commands, plan) and _is_close(weights, first),
        f"without any finite cost the plan must stay, with weights {first}, got {weights}",
    )
    optimizer.reset(_COMMAND)
    samples = optimizer.sample(rng, _NOISE, none)
    costs = np.arange(config.num_samples, dtype=float)
    costs[1::2] = np.nan
    before = samples.commands.copy()
    weights = optimizer.update(samples, costs)
    _require(
        optimizer,
        np.shape(weights) == costs.shape
        and (np.asarray(weights) >= 0).all()
        and abs(np.sum(weights) - 1) < 1e-9,
        f"weights must be {config.num_samples} that are not negative and sum to 1, got {weights}",
    )
    _require(
        optimizer,
        (np.asarray(weights)[1::2] == 0).all() and np.isfinite(optimizer.commands).all(),
        f"a sample of cost nan must weigh nothing, got {weights}",
    )
    _require(optimizer, (samples.commands == before).all(), "update() must not change its samples")


def _check_noise(factory: Factory, config: MpcConfig) -> None:
    """Mean and standard deviation of many samples at the first support point."""
    optimizer, rng = _make(factory, config, _COMMAND), np.random.default_rng(3)
    none = np.zeros((0, 3))
    drawn = [optimizer.sample(rng, _NOISE, none).commands[1:, 0] for _ in range(200)]
    noise = (np.concatenate(drawn) - _COMMAND) / _NOISE
    mean, std = noise.mean(axis=0), noise.std(axis=0)
    _require(
        optimizer,
        (np.abs(mean) < 0.1).all() and (np.abs(std - 1) < 0.1).all(),
        f"noise over noise_std must have mean 0 and standard deviation 1, got {mean}, {std}",
    )


def _check_progress(factory: Factory, config: MpcConfig) -> None:
    """Squared distance to a target of which one entry is out of bounds."""
    optimizer, rng = _make(factory, config, _COMMAND), np.random.default_rng(4)
    target = np.array([-0.4, 1.5, 1.0])
    best, none = np.clip(target, _LOW, _HIGH), np.zeros((0, 3))
    start = np.abs(optimizer.commands - best).max()
    for iteration in range(80):
        samples = optimizer.sample(rng, 3 * _NOISE * 0.97**iteration, none)
        optimizer.update(samples, np.square(samples.commands - target).sum(axis=(1, 2)))
    error = np.abs(optimizer.commands - best).max()
    _require(
        optimizer,
        error < 0.2 * start,
        f"80 updates must move the plan to the minimum of a quadratic: the distance was {start} "
        f"and is {error}",
    )
