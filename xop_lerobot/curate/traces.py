"""Long series of numbers as few that show the same: for plots in a page."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

_STEPS = 65534
"""Steps from the lowest to the highest value; one more stands for none."""
_NONE = 65535


def thin(values: np.ndarray, points: int) -> np.ndarray:
    """Thin a series out, and keep its peaks.

    A series that is too long is cut into `points // 2` pieces of equal length, and of each remain
    its lowest and its highest value, in their order.

    Args:
        values: One or more series. Shape (n,) or (n, k).
        points: How many values may be left; at least 2.

    Returns:
        The series. Shape (m,) or (m, k), m = min(n, points - points % 2).
    """
    count = len(values)
    if count <= points - points % 2:
        return values
    flat = np.asarray(values, float).reshape(count, -1)
    edges = np.linspace(0, count, points // 2 + 1).astype(int)
    out = np.empty((2 * (len(edges) - 1), flat.shape[1]))
    places = np.arange(flat.shape[1])
    for index, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        piece = flat[first:last]
        known = np.isfinite(piece)
        low = np.where(known, piece, np.inf).argmin(axis=0)
        high = np.where(known, piece, -np.inf).argmax(axis=0)
        out[2 * index] = piece[np.minimum(low, high), places]
        out[2 * index + 1] = piece[np.maximum(low, high), places]
    return out.reshape(len(out), *values.shape[1:])


def encode(values: np.ndarray) -> dict[str, Any]:
    """Write a series as base64 of 16 bits a value, between its lowest and highest one.

    Args:
        values: The series; what is not finite is written as none. Shape (n,).

    Returns:
        `lo`, `hi` and `data`: little-endian numbers q for lo + (hi - lo) q / 65534; 65535 is none.
    """
    values = np.asarray(values, float)
    known = np.isfinite(values)
    low, high = (
        (float(f"{values[known].min():.7g}"), float(f"{values[known].max():.7g}"))
        if known.any()
        else (0.0, 0.0)
    )
    scale = _STEPS / (high - low) if high > low else 0.0
    if not np.isfinite(scale):
        scale = 0.0
    steps = np.full(len(values), _NONE, "<u2")
    steps[known] = np.clip(np.round((values[known] - low) * scale), 0, _STEPS)
    return {"lo": low, "hi": high, "data": base64.b64encode(steps.tobytes()).decode()}


def decode(series: dict[str, Any]) -> np.ndarray:
    """Read what `encode` wrote, as a page does. Shape (n,)."""
    steps = np.frombuffer(base64.b64decode(series["data"]), "<u2").astype(float)
    values = series["lo"] + (series["hi"] - series["lo"]) * steps / _STEPS
    return np.where(steps == _NONE, np.nan, values)
