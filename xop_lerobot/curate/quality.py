r"""Quality measures of a recorded episode: pure functions of its columns.

Arrays have one row per frame, `n` in all, at a time step of `dt` seconds. Poses are x y z qw qx qy
qz. A metric whose average has no samples (such as when the operator never engaged) is nan.

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
"""Time window in which a stationary pose must not move [s]."""
STILL_LIMIT_M = 0.04
"""Largest motion of a stationary pose's points within that window [m]. A standing person's sway
stays below, as does a balancing G1, whose wrists give by 3 cm when it is engaged."""
LEVER_M = 0.3
"""Lever arm at which the rotation of a pose counts as motion [m]."""
LDLJ_WINDOW_S = 2.0
"""Length of the segments over which smoothness is computed [s], about one movement."""
LATE_FACTOR = 1.5
"""A frame is late if it comes more than so many periods after its predecessor."""


class GapFigures(NamedTuple):
    """Tracking losses of an episode.

    Attributes:
        number: Number of gaps.
        total: Total duration [s].
        longest: Duration of the longest [s].
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
    """Summarise a quantity of shape (n,); all nan if n is 0."""
    if not values.size:
        return SpreadFigures(NEVER, NEVER, NEVER)
    return SpreadFigures(
        float(values.mean()), float(np.percentile(values, 95)), float(values.max())
    )


def compute_ldlj(
    path: np.ndarray, dt: float, chosen: np.ndarray | None = None, window_s: float = LDLJ_WINDOW_S
) -> float:
    r"""Compute the log dimensionless jerk of a path.

    .. math:: -\ln\frac{T^3}{v_{peak}^2}\int\lVert\dddot x\rVert^2 dt

    It is independent of a movement's amplitude [1, 2]; higher is smoother. A minimum-jerk movement
    over all of T has :math:`-\ln 204.8 = -5.3`. As it depends on the number of movements within T,
    it is computed over segments of length T = `window_s`; the result is the median over segments
    with motion.

    Args:
        path: Trajectory; its entries must be of comparable size. Shape (n, k).
        dt: Time between frames [s].
        chosen: Frames to use, None for all; no segment crosses the end of a run of them. Shape
            (n,), bool.
        window_s: Length of a segment [s].

    Returns:
        Log dimensionless jerk, nan if no segment has motion.
    """
    if path.ndim != 2:
        raise BadShape("path", ("n", "k"), path.shape)
    size = round(window_s / dt) + 1
    if size < 4:  # the third difference needs four points
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
    """Find the frames in which the device lost the operator, after the first engagement.

    Args:
        tracked: Whether each limb was tracked. Shape (n, limbs), bool.
        engaged: Whether the operator drove. Shape (n,), bool.

    Returns:
        Whether a limb was lost; False before the first engaged frame. Shape (n,), bool.
    """
    if not engaged.any():
        return np.zeros(len(engaged), bool)
    gaps = np.asarray(~np.asarray(tracked, bool).all(axis=1))
    gaps[: int(np.argmax(engaged))] = False
    return gaps


def summarise_gaps(gaps: np.ndarray, dt: float) -> GapFigures:
    """Count and time the runs in `gaps`, of shape (n,), bool."""
    times = [(last - first) * dt for first, last in find_runs(gaps)]
    return GapFigures(len(times), float(sum(times)), float(max(times, default=0.0)))


def count_late(stamps: np.ndarray, dt: float) -> int:
    """Count the frames later than `LATE_FACTOR` periods after their predecessor.

    Args:
        stamps: Time stamp of each frame [s]. Shape (n,).
        dt: Nominal period [s].
    """
    return int((np.diff(stamps) > LATE_FACTOR * dt).sum())


def count_missing(stamps: np.ndarray, dt: float) -> int:
    """Count the frames missing between recorded ones; arguments as `count_late`."""
    steps = np.round(np.diff(stamps) / dt)
    return int(np.maximum(steps - 1, 0).sum())


def find_still(
    points: np.ndarray, dt: float, limit: float, window_s: float = STILL_WINDOW_S
) -> np.ndarray:
    """Find the frames around which no entry's range within the window exceeds `limit`.

    Args:
        points: Quantities to watch. Shape (n, k).
        dt: Time between frames [s].
        limit: Largest range [unit of the points].
        window_s: Length of the window, centred on the frame [s].

    Returns:
        Whether all are stationary. Shape (n,), bool.
    """
    if not points.size:
        return np.ones(len(points), bool)
    size = 2 * max(round(window_s / dt / 2), 1) + 1
    # Filtering along the last axis is faster: it is contiguous.
    rows = np.ascontiguousarray(points.T)
    high = maximum_filter1d(rows, size, axis=1, mode="nearest")
    low = minimum_filter1d(rows, size, axis=1, mode="nearest")
    with np.errstate(invalid="ignore"):  # non-finite values count as moving
        return np.asarray((high - low <= limit).all(axis=0))


def make_points(pose: np.ndarray) -> np.ndarray:
    """Represent a pose by its origin and a point on its X and on its Y axis, at `LEVER_M`.

    Shape (n, 7) -> (n, 9) [m].
    """
    origin, quat = pose[:, :3], pose[:, 3:]
    with np.errstate(invalid="ignore"):
        ends = [origin + quat_rotate(quat, LEVER_M * axis) for axis in np.eye(3)[:2]]
    return np.concatenate([origin, *ends], axis=1)


def find_idle(
    poses: Sequence[np.ndarray], engaged: np.ndarray, dt: float, limit: float = STILL_LIMIT_M
) -> np.ndarray:
    """Find the frames in which nobody is engaged, or neither operator nor robot moves.

    Args:
        poses: Poses of operator and robot. Shapes (n, 7).
        engaged: Whether the operator is engaged. Shape (n,), bool.
        dt: Time between frames [s].
        limit: Largest motion of a stationary pose's points [m].

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
    """Return the first non-idle frame and the one after the last; (n, n) if all are idle."""
    active = np.flatnonzero(~np.asarray(idle, bool))
    if not active.size:
        return len(idle), len(idle)
    return int(active[0]), int(active[-1]) + 1
