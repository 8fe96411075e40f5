"""Optimizers keep their contract, and the check of the contract finds what breaks it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from cem import Cem
from optimizer_contract import check_optimizer
from scipy.stats import kstest

from xop_lerobot.core.errors import BadShape, BadValue, UnknownName
from xop_lerobot.morphology.tuning import KERNEL_MEANS, SAMPLINGS, MpcConfig
from xop_lerobot.retarget.kmppi import DRAWS, Kmppi
from xop_lerobot.retarget.optimizer import (
    OPTIMIZERS,
    Samples,
    SamplingOptimizer,
    build_optimizer,
)

samplings = pytest.mark.parametrize("sampling", SAMPLINGS)
BOUNDS = (np.array([-1.0, 0.2]), np.array([1.0, 0.9]))
NONE = np.zeros((0, 2))


def make_config(**settings) -> MpcConfig:
    return MpcConfig(**({"num_samples": 16, "horizon": 6, "noise_std": {}} | settings))


# -- the contract --------------------------------------------------------------------------


def test_every_registered_optimizer_is_known_by_name():
    optimizer = build_optimizer(6, *BOUNDS, make_config(optimizer="cem"))
    assert type(optimizer) is Cem
    assert type(build_optimizer(6, *BOUNDS, make_config())) is Kmppi
    assert list(OPTIMIZERS) == ["cem", "kmppi"]


@pytest.mark.parametrize("name", ["kmppi", "cem"])
def test_every_optimizer_keeps_the_contract(name):
    check_optimizer(OPTIMIZERS[name])


@pytest.mark.parametrize("weighting", ["raw", "ess"])
def test_the_contract_holds_for_every_weighting(weighting):
    def factory(horizon, low, high, config):
        config = dataclasses.replace(config, weighting=weighting, temperature=0.1)
        return Kmppi(horizon, low, high, config)

    check_optimizer(factory)


def test_an_unknown_optimizer_lists_the_known_ones():
    with pytest.raises(UnknownName) as caught:
        build_optimizer(6, *BOUNDS, make_config(optimizer="adam"))
    assert str(caught.value) == "unknown optimizer 'adam'. Known: cem, kmppi"


class RandomSearch(SamplingOptimizer):
    """The least that keeps the contract: hold the best of K constant commands."""

    def reset(self, command):
        self.command = np.clip(command, self.low, self.high)

    @property
    def commands(self):
        return np.tile(self.command, (self.horizon, 1))

    def shift(self, steps):
        pass

    def sample(self, rng, noise_std, candidates):
        rows = self.command + rng.standard_normal((self.config.num_samples, len(self.low))) * (
            noise_std
        )
        fixed = np.concatenate([self.command[None], candidates])[: len(rows)]
        rows[: len(fixed)] = fixed
        rows = np.clip(rows, self.low, self.high)
        return Samples(rows[:, None], np.repeat(rows[:, None], self.horizon, axis=1))

    def update(self, samples, costs):
        best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        self.command = samples.knots[best, 0].copy()
        return np.eye(len(costs))[best]


def test_a_class_of_a_user_passes():
    check_optimizer(RandomSearch)


class OutOfBounds(RandomSearch):
    def sample(self, rng, noise_std, candidates):
        samples = super().sample(rng, noise_std, candidates)
        return samples._replace(commands=samples.commands + 0.5)


class ForgetsThePlan(RandomSearch):
    def sample(self, rng, noise_std, candidates):
        samples = super().sample(rng, noise_std, candidates)
        return samples._replace(commands=samples.commands[::-1])


class OwnSeed(RandomSearch):
    def sample(self, rng, noise_std, candidates):
        self.rng = getattr(self, "rng", rng)
        return super().sample(self.rng, noise_std, candidates)


class Fades(RandomSearch):
    def shift(self, steps):
        self.command = np.clip(self.command * 0.9**steps, self.low, self.high)


class SharesItsPlan(RandomSearch):
    @property
    def commands(self):
        self.held = getattr(self, "held", np.tile(self.command, (self.horizon, 1)))
        return self.held


class TrustsNan(RandomSearch):
    def update(self, samples, costs):
        best = int(np.argmin(costs))  # that of a nan
        self.command = samples.knots[best, 0].copy()
        return np.eye(len(costs))[best]


class Uphill(RandomSearch):
    def update(self, samples, costs):
        return super().update(samples, -costs)


class HalfTheNoise(RandomSearch):
    def sample(self, rng, noise_std, candidates):
        return super().sample(rng, 0.5 * noise_std, candidates)


class Unnormalised(RandomSearch):
    def update(self, samples, costs):
        weights = super().update(samples, costs)
        return weights if np.isnan(costs).all() else 2 * weights


@pytest.mark.parametrize(
    ("wrong", "clause"),
    [
        (OutOfBounds, "samples must be within the bounds"),
        (ForgetsThePlan, "must be the plan"),
        (OwnSeed, "the same seed must give the same samples"),
        (Fades, "a held command must survive shift(1)"),
        (SharesItsPlan, "commands must be a copy"),
        (TrustsNan, "a sample of cost nan must weigh nothing"),
        (Uphill, "80 updates must move the plan to the minimum of a quadratic"),
        (HalfTheNoise, "noise over noise_std must have mean 0 and standard deviation 1"),
        (Unnormalised, "weights must be"),
    ],
)
def test_a_broken_contract_is_named(wrong, clause):
    with pytest.raises(BadValue) as caught:
        check_optimizer(wrong)
    text = str(caught.value)
    assert text.startswith(f"{wrong.__name__} breaks the contract of SamplingOptimizer: ")
    assert clause in text


def test_bounds_are_checked():
    with pytest.raises(BadValue) as caught:
        Kmppi(6, np.array([0.0, 2.0]), np.array([1.0, 1.0]), make_config())
    assert str(caught.value) == "low must not be above high, got [0. 2.] and [1. 1.]"
    with pytest.raises(BadShape) as shape:
        Kmppi(6, np.zeros(2), np.ones(3), make_config())
    assert str(shape.value) == "high must have shape (2,), got (3,)"


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda o: o.reset(np.zeros(3)), "command must have shape (2,), got (3,)"),
        (
            lambda o: o.sample(np.random.default_rng(0), np.zeros(3), NONE),
            "noise_std must have shape (2,), got (3,)",
        ),
        (
            lambda o: o.sample(np.random.default_rng(0), np.zeros(2), np.zeros(2)),
            "candidates must have shape (c, 2), got (2,)",
        ),
        (
            lambda o: o.update(o.sample(np.random.default_rng(0), np.zeros(2), NONE), np.zeros(15)),
            "costs must have shape (16,), got (15,)",
        ),
    ],
)
def test_shapes_are_checked(call, text):
    with pytest.raises(BadShape) as caught:
        call(Kmppi(6, *BOUNDS, make_config()))
    assert str(caught.value) == text


# -- noise ---------------------------------------------------------------------------------


@samplings
@pytest.mark.parametrize("count", [1, 2, 11, 16, 127])
def test_noise_is_standard_normal(sampling, count):
    rng = np.random.default_rng(0)
    draws = np.stack([DRAWS[sampling](rng, (count, 2, 3)) for _ in range(4000 // count + 40)])
    noise = draws.reshape(-1, 6)
    error = 5 / np.sqrt(len(noise))  # of independent draws; the others are no worse
    np.testing.assert_allclose(noise.mean(0), 0, atol=error)
    np.testing.assert_allclose(np.cov(noise.T), np.eye(6), atol=2 * error)
    assert kstest(noise[:, 0], "norm").statistic < 3 / np.sqrt(len(noise))
    assert np.isfinite(noise).all()


def test_antithetic_noise_cancels():
    noise = DRAWS["antithetic"](np.random.default_rng(0), (12, 3, 7))
    np.testing.assert_array_equal(noise[:6], -noise[6:])
    assert len(np.unique(np.abs(noise))) > 100


@samplings
def test_without_the_plan_all_samples_are_noise(sampling):
    planner = Kmppi(6, *BOUNDS, make_config(sampling=sampling, sample_plan=False))
    planner.reset(np.array([0.0, 0.5]))
    commands = planner.sample(np.random.default_rng(0), np.full(2, 0.1), NONE).commands
    assert (np.abs(commands[:, 0] - [0.0, 0.5]).max(axis=1) > 1e-6).all()


# -- kernel mean, shift, importance ----------------------------------------------------------


def make_plan(**settings) -> Kmppi:
    config = make_config(num_knots=6, kernel_width=1.0, **settings)
    planner = Kmppi(6, np.full(2, -1.0), np.ones(2), config)
    planner.knots = np.random.default_rng(5).uniform(-0.9, 0.9, (6, 2))
    return planner


def test_a_kernel_of_zero_mean_forgets_and_one_that_holds_does_not():
    for mean, left in (("zero", 0.0), ("hold", 1.0)):
        planner = make_plan(kernel_mean=mean)
        planner.reset(np.array([0.8, -0.8]))
        for _ in range(20):
            planner.shift(1)
        np.testing.assert_allclose(
            planner.knots, np.tile([0.8 * left, -0.8 * left], (6, 1)), atol=1e-3
        )
        assert set(KERNEL_MEANS) == {"zero", "hold"}


def test_one_step_whatever_the_time():
    one, measured, expected = make_plan(shift="one"), make_plan(), make_plan()
    one.shift(2.5)
    measured.shift(2.5)
    expected.shift(1)
    np.testing.assert_array_equal(one.knots, expected.knots)
    assert np.abs(measured.knots - expected.knots).max() > 0.01


def test_shifts_by_times_that_never_come_back_need_no_memory():
    planner = make_plan()
    for steps in np.random.default_rng(0).uniform(0, 3, 500):
        planner.shift(steps)
    assert len(planner._shifts) <= 64


def test_a_shift_from_the_cache_is_the_first_one():
    planner, plan = make_plan(), make_plan().knots
    results = []
    for _ in range(2):
        planner.knots = plan
        planner.shift(1.7)
        results.append(planner.knots)
    np.testing.assert_array_equal(*results)


def test_importance_costs_what_the_formula_says():
    planner = make_plan(importance_cost=True, temperature=0.3)
    std, nominal = np.array([0.2, 0.0]), planner.nominal
    samples = planner.sample(np.random.default_rng(0), std, np.full((1, 2), 0.4))
    expected = [
        sum(0.3 * nominal[t, 0] * (sample[t, 0] - nominal[t, 0]) / 0.2**2 for t in range(6))
        for sample in samples.commands
    ]  # the second entry has no noise, and no density
    assert samples.penalty is not None
    np.testing.assert_allclose(samples.penalty, expected, rtol=1e-10)


def test_importance_counts_in_the_weights():
    with_it, without = (make_plan(importance_cost=flag, weighting="raw") for flag in (True, False))
    weights = [
        each.update(each.sample(np.random.default_rng(0), np.full(2, 0.1), NONE), np.zeros(16))
        for each in (with_it, without)
    ]
    np.testing.assert_allclose(weights[1], 1 / 16)
    assert np.abs(weights[0] - weights[1]).max() > 0.01


# -- CEM -------------------------------------------------------------------------------------


def test_cem_counts_the_best_alike():
    cem = Cem(6, *BOUNDS, make_config(effective_samples=3.0))
    cem.reset(np.array([0.0, 0.5]))
    samples = cem.sample(np.random.default_rng(0), np.full(2, 0.1), NONE)
    costs = np.arange(16.0)[::-1].copy()
    costs[15] = np.nan
    weights = cem.update(samples, costs)
    np.testing.assert_allclose(weights, np.where(np.isin(np.arange(16), [12, 13, 14]), 1 / 3, 0))
    np.testing.assert_allclose(cem.knots, samples.knots[12:15].mean(0), atol=1e-12)


def test_the_noise_of_cem_shrinks_at_the_minimum_and_comes_back_when_it_moves():
    cem = Cem(6, np.full(2, -1.0), np.ones(2), make_config(num_samples=64))
    cem.reset(np.zeros(2))
    rng, noise = np.random.default_rng(0), np.full(2, 0.1)

    def solve(target: float) -> float:
        samples = cem.sample(rng, noise, NONE)
        cem.update(samples, np.square(samples.commands - target).sum((1, 2)))
        return float(cem._share.mean())

    shares = [solve(0.0) for _ in range(10)]
    assert shares[-1] < 0.35
    assert max(solve(0.8) for _ in range(10)) > 2 * shares[-1]


# -- parameters ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["sampling", "kernel_mean", "shift", "weighting"])
def test_unknown_choices_list_the_known_ones(name):
    known = {
        "sampling": "antithetic, gaussian",
        "kernel_mean": "hold, zero",
        "shift": "measured, one",
        "weighting": "ess, raw",
    }
    with pytest.raises(UnknownName) as caught:
        make_config(**{name: "best"})
    assert str(caught.value) == f"unknown {name} 'best'. Known: {known[name]}"


@pytest.mark.parametrize(
    "name",
    ["temperature", "kernel_width", "full_noise_error", "control_hz", "proposal_s"],
)
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_numbers_that_must_be_positive(name, value):
    with pytest.raises(BadValue) as caught:
        make_config(**{name: value})
    assert str(caught.value) == f"{name} must be positive and finite, got {value}"


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_noise_is_not_negative(value):
    with pytest.raises(BadValue) as caught:
        make_config(noise_std={"height": value})
    assert str(caught.value) == f"noise_std of 'height' must be at least 0, got {value}"


@pytest.mark.parametrize("value", [0.5, np.nan])
def test_effective_samples_are_at_least_one(value):
    with pytest.raises(BadValue) as caught:
        make_config(effective_samples=value)
    assert str(caught.value) == f"effective_samples must be at least 1, got {value}"


def test_counts_are_whole_numbers():
    with pytest.raises(BadValue) as caught:
        make_config(num_samples=2.5)
    assert str(caught.value) == "num_samples must be a whole number, got 2.5"
