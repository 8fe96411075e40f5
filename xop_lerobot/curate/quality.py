r"""How good a recorded episode is: pure functions of its columns.

Arrays have one row for each frame, `n` in all, at a time step of `dt` seconds. Poses are
x y z qw qx qy qz. What a figure would be an average of may never have come (the operator never
engaged); the figure is nan then.

Tracking errors, jerk, roughness and falls are those of `xop_lerobot.evaluation.metrics`.

References:
    [1] N. Hogan, D. Sternad. Sensitivity of smoothness measures to movement duration, amplitude,
        and arrests. J. Motor Behavior 41(6), 2009.
    [2] S. Balasubramanian et al. On the analysis of movement smoothness. J. NeuroEngineering and
        Rehabilitation 12:112, 2015.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from xop_lerobot.core.errors import BadShape
from xop_lerobot.core.transforms import quat_rotate
from xop_lerobot.evaluation.metrics import NEVER, find_runs

STILL_WINDOW_S = 0.5
"""Time within which a thing that stands still does not leave its place [s]."""
STILL_LIMIT_M = 0.04
"""How far the points of a pose that stands still move within that time [m]. The sway of a standing
person stays below, and so does a G1 that balances, whose wrists give by 3 cm when it is engaged."""
LEVER_M = 0.3
"""Distance from a pose's origin at which its turning counts as motion [m]."""
LDLJ_WINDOW_S = 2.0
"""Length of the pieces that smoothness is computed of [s]: about that of one movement."""
LATE_FACTOR = 1.5
"""A frame is late if it came this many periods after the one before."""


class GapFigures(NamedTuple):
    """For how long the device did not see the operator.

    Attributes:
        number: Number of gaps.
        total: Their time [s].
        longest: Time of the longest [s].
    """

    number: int
    total: float
    longest: float


class SpreadFigures(NamedTuple):
    """Mean, 95th percentile and maximum of a quantity, in its unit."""

    mean: float
    p95: float
    max: float


def summarise_spread(values: np.ndarray) -> SpreadFigures:
    """Summarise a quantity. Shape (n,); all nan if n is 0."""
    if not values.size:
        return SpreadFigures(NEVER, NEVER, NEVER)
    return SpreadFigures(
        float(values.mean()), float(np.percentile(values, 95)), float(values.max())
    )


def compute_ldlj(
    path: np.ndarray, dt: float, chosen: np.ndarray | None = None, window_s: float = LDLJ_WINDOW_S
) -> float:
    r"""Compute the log dimensionless jerk, :math:`-\ln\frac{T^3}{v_{peak}^2}\int\lVert\dddot x\rVert^2 dt`.

    It does not depend on the size of a movement [1, 2], and the higher the smoother; a movement of
    minimum jerk over all of T has :math:`-\ln 204.8 = -5.3`. Since it depends on how many movements
    there are in T, it is taken of pieces of one length T = `window_s`, and the median over the
    pieces in which anything moves is given.

    Args:
        path: What should be smooth; its entries must be of comparable size. Shape (n, k).
        dt: Time between frames [s].
        chosen: Frames that count, all where None; no piece reaches beyond a run of them.
            Shape (n,), bool.
        window_s: Length of a piece [s].

    Returns:
        Log dimensionless jerk, nan if nothing moves for as long as one piece.
    """  # noqa: E501 the formula
    if path.ndim != 2:
        raise BadShape("path", ("n", "k"), path.shape)
    size = round(window_s / dt) + 1
    if size < 4:  # a jerk takes four points
        return NEVER
    values = []
    for first, last in find_runs(np.ones(len(path), bool) if chosen is None else chosen):
        count = (last - first - 1) // (size - 1)
        for start in first + (size - 1) * np.arange(count):
            piece = np.asarray(path[start : start + size], float)
            speed = np.linalg.norm(np.diff(piece, axis=0), axis=1).max() / dt
            jerk = np.diff(piece, n=3, axis=0) / dt**3
            total = float(np.square(jerk).sum()) * dt
            if speed > 0 and total > 0:
                values.append(-np.log(window_s**3 / speed**2 * total))
    return float(np.median(values)) if values else NEVER


def find_gaps(tracked: np.ndarray, engaged: np.ndarray) -> np.ndarray:
    """Find the frames in which the device did not see all of the operator, once they had engaged.

    Args:
        tracked: Whether each limb was seen. Shape (n, limbs), bool.
        engaged: Whether the operator drove. Shape (n,), bool.

    Returns:
        Whether something was not seen; never before the first engaged frame. Shape (n,), bool.
    """
    if not engaged.any():
        return np.zeros(len(engaged), bool)
    gaps = np.asarray(~np.asarray(tracked, bool).all(axis=1))
    gaps[: int(np.argmax(engaged))] = False
    return gaps


def summarise_gaps(gaps: np.ndarray, dt: float) -> GapFigures:
    """Count and time the runs of `gaps`. Shape (n,), bool."""
    times = [(last - first) * dt for first, last in find_runs(gaps)]
    return GapFigures(len(times), float(sum(times)), float(max(times, default=0.0)))


def count_late(stamps: np.ndarray, dt: float) -> int:
    """Count the frames that came more than one and a half periods after the one before.

    Args:
        stamps: Clock of each frame [s]. Shape (n,).
        dt: Period that they should have [s].
    """
    return int((np.diff(stamps) > LATE_FACTOR * dt).sum())


def count_missing(stamps: np.ndarray, dt: float) -> int:
    """Count the frames that should lie between those that are there. Same arguments."""
    steps = np.round(np.diff(stamps) / dt)
    return int(np.maximum(steps - 1, 0).sum())


def find_still(
    points: np.ndarray, dt: float, limit: float, window_s: float = STILL_WINDOW_S
) -> np.ndarray:
    """Find the frames around which nothing moves: no entry's range within the window is over `limit`.

    Args:
        points: What may move. Shape (n, k).
        dt: Time between frames [s].
        limit: Largest range [unit of the points].
        window_s: Length of the window, centred on the frame [s].

    Returns:
        Whether all stands still. Shape (n,), bool.
    """  # noqa: E501 one sentence
    if not points.size:
        return np.ones(len(points), bool)
    size = 2 * max(round(window_s / dt / 2), 1) + 1
    # The axis that is filtered comes last, where it is contiguous.
    rows = np.ascontiguousarray(points.T)
    high = maximum_filter1d(rows, size, axis=1, mode="nearest")
    low = minimum_filter1d(rows, size, axis=1, mode="nearest")
    with np.errstate(invalid="ignore"):  # what is not finite does not stand still
        return np.asarray((high - low <= limit).all(axis=0))


def make_points(pose: np.ndarray) -> np.ndarray:
    """Stand for a pose by its origin and two points on its X and Y axis, which turn with it.

    Shape (n, 7) -> (n, 9) [m].
    """
    origin, quat = pose[:, :3], pose[:, 3:]
    with np.errstate(invalid="ignore"):
        ends = [origin + quat_rotate(quat, LEVER_M * axis) for axis in np.eye(3)[:2]]
    return np.concatenate([origin, *ends], axis=1)


def find_idle(
    poses: Sequence[np.ndarray], engaged: np.ndarray, dt: float, limit: float = STILL_LIMIT_M
) -> np.ndarray:
    """Find the frames in which nothing happens: nobody drives, or neither person nor robot moves.

    Args:
        poses: Poses of the operator and of the robot. Shapes (n, 7).
        engaged: Whether the operator drove. Shape (n,), bool.
        dt: Time between frames [s].
        limit: How far a point of a pose moves that stands still [m].

    Returns:
        Whether the frame is idle. Shape (n,), bool.
    """
    idle = ~np.asarray(engaged, bool)
    still = np.ones(len(idle), bool)
    for pose in poses:
        if pose.shape != (len(idle), 7):
            raise BadShape("pose", (len(idle), 7), pose.shape)
        still &= find_still(make_points(pose), dt, limit)
    return idle | still


def find_active_span(idle: np.ndarray) -> tuple[int, int]:
    """Find the first frame that is not idle, and the one after the last; (n, n) if all are."""
    active = np.flatnonzero(~np.asarray(idle, bool))
    if not active.size:
        return len(idle), len(idle)
    return int(active[0]), int(active[-1]) + 1
