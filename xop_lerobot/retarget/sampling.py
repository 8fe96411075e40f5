"""Standard normal noise, drawn in three ways."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
"""(rng, shape) -> standard normal values; the first axis counts the samples."""

_SCRAMBLES = 16
_BITS = 30


def draw_gaussian(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw independent samples."""
    return rng.standard_normal(shape)


def draw_antithetic(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw pairs of opposite samples: the mean of an even number is zero."""
    half = rng.standard_normal(((shape[0] + 1) // 2, *shape[1:]))
    return np.concatenate([half, -half])[: shape[0]]


def draw_sobol(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    r"""Draw scrambled Sobol points, which fill the space evenly, as normal values.

    A few scrambled point sets per shape are made once. Each call takes one of them and moves it
    by a random digital shift, :math:`u_{ij} = x_{ij} \oplus s_j`: every point is uniform, and
    the set as even as before, at the price of a few array operations.
    """
    from scipy.special import ndtri  # noqa: PLC0415  (half a second that others need not wait)

    points = _make_sobol(shape[0], int(np.prod(shape[1:])))
    chosen = points[rng.integers(_SCRAMBLES)]
    shift = rng.integers(1 << _BITS, size=chosen.shape[1], dtype=np.int64)
    return ndtri(((chosen ^ shift) + 0.5) * 2.0**-_BITS).reshape(shape)


@lru_cache(maxsize=16)
def _make_sobol(count: int, dimension: int) -> np.ndarray:
    """Scrambled Sobol points as integers below 2^30. Shape (scrambles, count, dimension)."""
    from scipy.stats import qmc  # noqa: PLC0415

    power = max(0, int(np.ceil(np.log2(count))))  # whole blocks are balanced
    return np.stack(
        [
            qmc.Sobol(dimension, bits=_BITS, rng=np.random.default_rng(seed)).random_base2(power)[
                :count
            ]
            * 2.0**_BITS
            for seed in range(_SCRAMBLES)
        ]
    ).astype(np.int64)


DRAWS: dict[str, Draw] = {
    "gaussian": draw_gaussian,
    "antithetic": draw_antithetic,
    "sobol": draw_sobol,
}
