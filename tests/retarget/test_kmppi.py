"""KMPPI: interpolation, sampling, weights, and convergence on a problem with a known answer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.kmppi import Kmppi, compute_effective_samples, compute_weights

LOW, HIGH = np.array([-1.0, 0.2]), np.array([1.0, 0.9])
COMMAND = np.array([0.3, 0.75])
NO_CANDIDATES = np.zeros((0, 2))
knot_counts = pytest.mark.parametrize("num_knots", [1, 2, 4, 10])


def make_config(**settings) -> MpcConfig:
    return MpcConfig(**({"num_samples": 16, "horizon": 10, "noise_std": {}} | settings))


def make_kmppi(low=LOW, high=HIGH, **settings) -> Kmppi:
    config = make_config(**settings)
    return Kmppi(config.horizon, low, high, config)


# -- interpolation -------------------------------------------------------------------------


@knot_counts
@pytest.mark.parametrize("kernel_width", [0.5, 2.0, 4.0])
def test_a_steady_plan_is_represented_and_survives_shifts(num_knots, kernel_width):
    kmppi = make_kmppi(num_knots=num_knots, kernel_width=kernel_width)
    kmppi.reset(COMMAND)
    for steps in (0, 1, 2.5, 5, 100):
        kmppi.shift(steps)
        np.testing.assert_allclose(kmppi.commands, np.tile(COMMAND, (10, 1)), atol=1e-6)


@knot_counts
def test_the_interpolation_passes_through_the_knots(num_knots):
    kmppi = make_kmppi(num_knots=num_knots, horizon=10, kernel_width=1.0)
    kmppi.knots = np.random.default_rng(0).uniform(LOW, HIGH, kmppi.knots.shape)
    times = np.round(kmppi.knot_times).astype(int)
    whole = np.isclose(times, kmppi.knot_times)
    np.testing.assert_allclose(kmppi.commands[times[whole]], kmppi.knots[whole], atol=1e-9)


def test_the_interpolation_is_a_gaussian_process_around_the_last_knot():
    """Slow twin: the posterior mean, one time at a time."""
    kmppi = make_kmppi(num_knots=3, kernel_width=1.7)
    kmppi.knots = np.random.default_rng(1).uniform(LOW, HIGH, (3, 2))
    times, last = kmppi.knot_times, kmppi.knots[-1]

    def kernel(a: float, b: float) -> float:
        return np.exp(-((a - b) ** 2) / (2 * 1.7**2))

    gram = np.array([[kernel(a, b) for b in times] for a in times])
    alpha = np.linalg.inv(gram) @ (kmppi.knots - last)
    expected = [
        last + sum(kernel(t, b) * a for b, a in zip(times, alpha, strict=True)) for t in range(10)
    ]
    np.testing.assert_allclose(kmppi.commands, np.clip(expected, LOW, HIGH), atol=1e-10)


def test_a_shift_moves_the_plan_on_and_holds_its_end():
    kmppi = make_kmppi(num_knots=10, kernel_width=1.0)
    kmppi.knots = np.random.default_rng(2).uniform(LOW, HIGH, (10, 2))
    before = kmppi.commands
    kmppi.shift(3)
    np.testing.assert_allclose(kmppi.commands[:7], before[3:], atol=1e-8)
    np.testing.assert_allclose(kmppi.commands[7:], np.tile(before[-1], (3, 1)), atol=1e-8)


def test_more_knots_than_steps_are_as_many_as_steps():
    assert make_kmppi(horizon=3, num_knots=8).knots.shape == (3, 2)


# -- samples -------------------------------------------------------------------------------


@knot_counts
def test_samples_are_within_the_bounds(num_knots):
    kmppi = make_kmppi(num_knots=num_knots, num_samples=64)
    kmppi.reset(HIGH)
    samples = kmppi.sample(np.random.default_rng(0), np.full(2, 5.0), np.array([[9.0, -9.0]]))
    for values in (samples.knots, samples.commands):
        assert (values >= LOW).all()
        assert (values <= HIGH).all()
    assert samples.commands.shape == (64, 10, 2)


def test_the_plan_and_the_candidates_come_first():
    kmppi = make_kmppi()
    kmppi.reset(COMMAND)
    candidates = np.array([[0.1, 0.5], [0.0, 0.75]])
    commands = kmppi.sample(np.random.default_rng(0), np.full(2, 0.1), candidates).commands
    for row, command in enumerate([COMMAND, *candidates]):
        np.testing.assert_allclose(commands[row], np.tile(command, (10, 1)))


@pytest.mark.parametrize("num_samples", [1, 2, 3, 4, 7])
def test_few_samples_still_hold_the_plan(num_samples):
    kmppi = make_kmppi(num_samples=num_samples)
    kmppi.reset(COMMAND)
    samples = kmppi.sample(np.random.default_rng(0), np.full(2, 0.1), np.zeros((3, 2)))
    assert len(samples.commands) == num_samples
    np.testing.assert_allclose(samples.commands[0, 0], COMMAND)


def test_antithetic_samples_have_the_plan_as_their_mean():
    kmppi = make_kmppi(num_samples=33, num_knots=3)
    kmppi.reset(np.array([0.0, 0.55]))
    samples = kmppi.sample(np.random.default_rng(0), np.full(2, 0.03), NO_CANDIDATES)
    np.testing.assert_allclose(samples.knots.mean(0), kmppi.knots, atol=1e-12)
    assert samples.knots[1:].std() > 0.02


def test_entries_without_noise_stay():
    kmppi = make_kmppi()
    kmppi.reset(COMMAND)
    samples = kmppi.sample(np.random.default_rng(0), np.array([0.2, 0.0]), NO_CANDIDATES)
    assert (samples.commands[..., 1] == COMMAND[1]).all()


def test_same_seed_same_samples():
    kmppi = make_kmppi()
    kmppi.reset(COMMAND)
    first, same, other = (
        kmppi.sample(np.random.default_rng(seed), np.full(2, 0.1), NO_CANDIDATES).commands
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, same)
    assert (first != other).any()


# -- weights -------------------------------------------------------------------------------

# On a grid of 1e-6: a difference of 1e-320 has no meaning, and no reciprocal.
costs_strategy = st.lists(st.floats(-50, 50), min_size=2, max_size=30).map(
    lambda costs: np.round(costs, 6)
)
weightings = pytest.mark.parametrize("weighting", ["raw", "ess"])


@weightings
@given(costs=costs_strategy)
def test_weights_are_a_distribution_that_prefers_the_cheaper(weighting, costs):
    weights = compute_weights(costs, make_config(weighting=weighting))
    assert weights.sum() == pytest.approx(1)
    assert (weights >= 0).all()
    order = np.argsort(costs)
    assert (np.diff(weights[order]) <= 1e-12).all()


@pytest.mark.slow
@weightings
@given(costs=costs_strategy, offset=st.floats(-10, 10))
def test_a_constant_cost_changes_nothing(weighting, costs, offset):
    config = make_config(weighting=weighting)
    shifted = compute_weights(costs + offset, config)
    if np.ptp(costs) > 1e-3 or np.ptp(costs) == 0:
        np.testing.assert_allclose(shifted, compute_weights(costs, config), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-6, 0.1, 1e6])
def test_the_scale_of_the_cost_does_not_matter(scale):
    costs = np.random.default_rng(0).exponential(size=20)
    config = make_config(weighting="ess")
    np.testing.assert_allclose(
        compute_weights(scale * costs, config), compute_weights(costs, config), atol=1e-9
    )


def test_raw_weights_are_the_softmin_of_the_paper():
    costs, temperature = np.array([0.3, 0.1, 0.15]), 0.05
    expected = np.exp(-costs / temperature)
    weights = compute_weights(costs, make_config(weighting="raw", temperature=temperature))
    np.testing.assert_allclose(weights, expected / expected.sum())


@pytest.mark.parametrize("wanted", [1.5, 4.0, 10.0])
def test_the_effective_sample_size_is_met(wanted):
    costs = np.random.default_rng(0).exponential(size=30)
    weights = compute_weights(costs, make_config(effective_samples=wanted))
    assert compute_effective_samples(weights) == pytest.approx(wanted, rel=1e-3)


def test_more_effective_samples_than_samples_is_nearly_the_mean():
    weights = compute_weights(np.array([1.0, 2.0, 4.0]), make_config(effective_samples=50.0))
    assert compute_effective_samples(weights) == pytest.approx(0.99 * 3, rel=1e-3)


def test_effective_samples_range_from_one_to_all():
    assert compute_effective_samples(np.array([0, 1.0, 0])) == 1
    assert compute_effective_samples(np.full(8, 1 / 8)) == pytest.approx(8)


def find_weights_slowly(costs: np.ndarray, wanted: float) -> np.ndarray:
    """Bisection on log λ, to the last bit."""
    excess = costs - costs.min()
    low, high, weights = -300.0, np.log(1e4 * excess.max()), np.empty(0)
    for _ in range(200):
        middle = (low + high) / 2
        weights = np.exp(-excess / np.exp(middle))
        weights /= weights.sum()
        low, high = (middle, high) if 1 / (weights @ weights) < wanted else (low, middle)
    return weights


COSTS = {
    "exponential": lambda rng, k: rng.exponential(size=k),
    "squared distances": lambda rng, k: 3 + np.square(rng.standard_normal((k, 7))).sum(1),
    "over four orders of magnitude": lambda rng, k: np.exp(2 * rng.standard_normal(k)),
    "over fifty": lambda rng, k: np.exp(30 * rng.standard_normal(k)),
    "with one diverged": lambda rng, k: np.append(rng.exponential(size=k - 1), 1e12),
    "two far from the others": lambda rng, k: np.append(1e5 + rng.exponential(size=k - 2), [0, 1]),
    "equal but for one": lambda rng, k: np.append(np.ones(k - 1), 0.5),
}


@pytest.mark.parametrize("kind", COSTS)
@pytest.mark.parametrize("num_samples", [3, 12, 30, 128])
@pytest.mark.parametrize("wanted", [1.2, 4.0, 10.0, 100.0])
def test_the_effective_sample_size_is_found_as_by_bisection(kind, num_samples, wanted):
    rng = np.random.default_rng(0)
    for _ in range(5):
        costs = COSTS[kind](rng, num_samples)
        weights = compute_weights(costs, make_config(effective_samples=wanted))
        expected = find_weights_slowly(costs, min(wanted, 0.99 * num_samples))
        size = compute_effective_samples(expected)
        assert compute_effective_samples(weights) == pytest.approx(size, rel=1e-5)
        # Where the size hardly depends on λ, the weights are less certain than the size.
        np.testing.assert_allclose(weights, expected, atol=1e-5 if kind != "over fifty" else 1e-3)


def test_a_diverged_sample_does_not_level_the_others():
    costs = np.append(np.random.default_rng(0).exponential(size=29), 1e12)
    weights = compute_weights(costs, make_config(effective_samples=4.0))
    np.testing.assert_allclose(weights[:29], compute_weights(costs[:29], make_config()), atol=1e-5)


def test_more_ties_for_the_best_than_wanted_count_alike():
    costs = np.append(np.ones(6), [2.0, 3.0, 1e6])
    weights = compute_weights(costs, make_config(effective_samples=4.0))
    np.testing.assert_allclose(weights, np.append(np.full(6, 1 / 6), np.zeros(3)))


@weightings
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_costs_that_are_not_finite_get_no_weight(weighting, bad):
    config = make_config(weighting=weighting)
    costs = np.array([bad, 0.3, 0.1, bad, 0.2])
    weights = compute_weights(costs, config)
    np.testing.assert_array_equal(weights[[0, 3]], 0)
    np.testing.assert_allclose(weights[[1, 2, 4]], compute_weights(costs[[1, 2, 4]], config))


@weightings
def test_without_any_finite_cost_the_standing_plan_is_kept(weighting):
    weights = compute_weights(np.full(4, np.nan), make_config(weighting=weighting))
    np.testing.assert_array_equal(weights, [1, 0, 0, 0])


@weightings
def test_equal_costs_weigh_the_same(weighting):
    weights = compute_weights(np.array([2.0, np.nan, 2.0]), make_config(weighting=weighting))
    np.testing.assert_array_equal(weights, [0.5, 0, 0.5])


def test_a_candidate_that_is_not_finite_does_not_spoil_the_plan():
    kmppi = make_kmppi()
    kmppi.reset(COMMAND)
    bad = np.full((1, 2), np.nan)
    samples = kmppi.sample(np.random.default_rng(0), np.full(2, 0.1), bad)
    costs = np.where(np.isfinite(samples.commands).all((1, 2)), 1.0, np.nan)
    kmppi.update(samples, costs)
    assert np.isfinite(kmppi.commands).all()


# -- the optimizer as a whole --------------------------------------------------------------


@weightings
@pytest.mark.parametrize("num_knots", [1, 3])
def test_converges_on_a_quadratic(weighting, num_knots):
    """The cost is the squared distance to a target, the answer the target or the bound."""
    target = np.array([0.4, 1.5])  # the second is out of bounds
    kmppi = make_kmppi(num_knots=num_knots, num_samples=32, weighting=weighting)
    kmppi.reset(np.array([-0.9, 0.3]))
    rng = np.random.default_rng(0)
    errors = []
    for iteration in range(80):
        samples = kmppi.sample(rng, np.full(2, 0.1 * 0.96**iteration), NO_CANDIDATES)
        kmppi.update(samples, np.square(samples.commands - target).sum((1, 2)))
        errors.append(np.abs(kmppi.commands - [0.4, HIGH[1]]).max())
    assert errors[0] > 1.0
    assert errors[-1] < (0.02 if num_knots == 1 else 0.1)


# -- parameters ----------------------------------------------------------------------------


def test_an_unknown_weighting_lists_the_known_ones():
    with pytest.raises(UnknownName) as caught:
        make_config(weighting="mean")
    assert str(caught.value) == "unknown weighting 'mean'. Known: ess, raw"


@pytest.mark.parametrize("name", ["num_samples", "horizon", "num_knots"])
def test_sizes_are_at_least_one(name):
    with pytest.raises(BadValue) as caught:
        make_config(**{name: 0})
    assert str(caught.value) == f"{name} must be at least 1, got 0"


def test_an_unknown_retargeter_lists_the_known_ones():
    with pytest.raises(UnknownName) as caught:
        RetargeterConfig(type="mppi")
    assert str(caught.value) == "unknown retargeter 'mppi'. Known: direct, mpc"


@pytest.mark.parametrize("name", ["num_samples", "horizon", "control_hz", "threads"])
def test_settings_are_not_negative(name):
    settings: dict[str, Any] = {name: -1}
    with pytest.raises(BadValue) as caught:
        RetargeterConfig(**settings)
    assert str(caught.value) == f"{name} must not be negative, got -1"


def test_threads_default_to_the_cores_and_can_be_chosen():
    assert RetargeterConfig().num_threads >= 1
    assert RetargeterConfig(threads=3).num_threads == 3
