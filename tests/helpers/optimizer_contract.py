"""The contract of `SamplingOptimizer`, as a check of any class that is to keep it."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.morphology.tuning import SAMPLINGS, MpcConfig
from xop_lerobot.retarget.optimizer import Factory, SamplingOptimizer

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
