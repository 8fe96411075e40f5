"""Rest pose of the base of a standing robot as a function of its command."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.errors import BadValue


class BaseRest(NamedTuple):
    """Pose of the base at rest, and its derivatives by the command.

    Attributes:
        pitch: Pitch of the base [rad]. Shape (...).
        forward: Forward position relative to the middle of the feet [m]. Shape (...).
        pitch_slope: Derivative of `pitch` by the two entries. Shape (..., 2).
        forward_slope: Derivative of `forward` by the two entries. Shape (..., 2).
    """

    pitch: np.ndarray
    forward: np.ndarray
    pitch_slope: np.ndarray
    forward_slope: np.ndarray


class RestMap:
    r"""Pitch and position of a standing robot's base as a function of two command entries.

    A policy that balances a low or bent robot leans the pelvis and moves the hips by itself. The
    map is measured on a grid (`python -m benchmarks.run_policies --parts rest`) with bilinear
    interpolation, :math:`g(a) = \sum_{ij} \lambda_i(a_1) \lambda_j(a_2) g_{ij}`, and constant
    beyond the grid.

    Args:
        axes: Two command entries and their increasing grid values.
        pitch: Pitch of the base [rad]; one row per value of the first entry.
        forward: Forward position relative to the middle of the feet [m]; same layout.
        held: Entries whose joint does not move: the base leans instead.

    Raises:
        BadValue: If axes or rows do not fit.
    """

    def __init__(
        self,
        axes: Mapping[str, Sequence[float]],
        pitch: Sequence[Sequence[float]],
        forward: Sequence[Sequence[float]],
        held: Iterable[str] = (),
    ) -> None:
        self.entries, self.held = tuple(axes), frozenset(held)
        if len(axes) != 2:
            raise BadValue(
                f"rest needs two entries of the command, got {', '.join(axes) or 'none'}"
            )
        self._axes = [np.array(values, dtype=float) for values in axes.values()]
        for name, values in zip(axes, self._axes, strict=True):
            if len(values) < 2 or (np.diff(values) <= 0).any():
                raise BadValue(f"rest: values of {name} must increase, got {values.tolist()}")
        shape = tuple(len(values) for values in self._axes)
        for name, rows in (("pitch", pitch), ("forward", forward)):
            widths = {len(row) for row in rows}
            if len(rows) != shape[0] or widths != {shape[1]}:
                raise BadValue(f"rest: {name} must have {shape[0]} rows of {shape[1]} numbers")
        self._values = np.stack([np.array(pitch, dtype=float), np.array(forward, dtype=float)])

    def __call__(self, first: np.ndarray, second: np.ndarray) -> BaseRest:
        """Compute the rest pose for values of the two entries, which broadcast. Shapes (...)."""
        (i, s, inside_s), (j, t, inside_t) = (
            _locate(values, np.asarray(at, dtype=float))
            for values, at in zip(self._axes, (first, second), strict=True)
        )
        values = self._values
        low, high = values[:, i, j], values[:, i + 1, j]
        low_end, high_end = values[:, i, j + 1], values[:, i + 1, j + 1]
        at_low, at_high = low + t * (low_end - low), high + t * (high_end - high)
        by_first = (at_high - at_low) * inside_s
        by_second = ((1 - s) * (low_end - low) + s * (high_end - high)) * inside_t
        pitch, forward = at_low + s * (at_high - at_low)
        slopes = np.stack([by_first, by_second], axis=-1)
        return BaseRest(pitch, forward, slopes[0], slopes[1])


def _locate(values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grid cell, fraction within it, and derivative of the fraction (zero beyond the grid)."""
    cell = np.clip(np.searchsorted(values, at, side="right") - 1, 0, len(values) - 2)
    width = values[cell + 1] - values[cell]
    share = (at - values[cell]) / width
    inside = (share >= 0) & (share <= 1)
    return cell, np.clip(share, 0.0, 1.0), inside / width
