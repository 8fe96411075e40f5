"""Confidence intervals: Wilson's for rates, a bootstrap's for means."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from xop_lerobot.core.errors import BadValue


class Interval(NamedTuple):
    """Where a figure lies with 95% confidence.

    Attributes:
        low: Lower end.
        high: Upper end.
    """

    low: float
    high: float


def compute_rate_interval(count: int, trials: int) -> Interval:
    r"""Compute Wilson's score interval of a rate, 95%.

    .. math:: \frac{\hat p + z^2/2n \pm z\sqrt{\hat p(1-\hat p)/n + z^2/4n^2}}{1 + z^2/n}

    It is sound for few trials and for rates of 0 and 1, where the normal one has no width.

    Raises:
        BadValue: If `count` is not between 0 and `trials`, or there is no trial.
    """
    if not 0 <= count <= trials or trials < 1:
        raise BadValue(f"a rate needs 0 <= count <= trials and a trial, got {count} of {trials}")
    found = stats.binomtest(count, trials).proportion_ci(0.95, method="wilson")
    return Interval(float(found.low), float(found.high))


def compute_mean_interval(values: Sequence[float], seed: int = 0) -> Interval:
    """Compute the bootstrap interval of a mean, 95%, percentile, 2000 draws.

    Args:
        values: Values; those that are not finite do not count.
        seed: Seed of the draws.

    Returns:
        The interval; nan without a value, and of no width with one alone.
    """
    known = np.asarray([value for value in values if np.isfinite(value)], float)
    if known.size == 0:
        return Interval(float("nan"), float("nan"))
    if known.size == 1 or np.ptp(known) == 0:
        return Interval(float(known[0]), float(known[0]))
    found = stats.bootstrap(
        (known,),
        np.mean,
        n_resamples=2000,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(float(found.low), float(found.high))
