"""Time of recorded rows by a clock that may have been set during the recording."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LONGEST_PAUSE_S = 1.0
"""A recorder is rarely held up for longer between two rows; a clock that goes on by more was set,
unless the person has moved meanwhile [s]."""
LONGEST_HOLD_S = 60.0
"""A recorder is never held up for longer [s]."""


class RowClock(NamedTuple):
    """The times of rows by a clock.

    Attributes:
        t: Time of each row since the first, without the jumps [s]. What it is where the clock
            does not go on means nothing. Shape (n,).
        goes_on: Whether the clock went on with that row. Shape (n,), bool.
        jumps: Rows with which it was set, and by how much [s].
    """

    t: np.ndarray
    goes_on: np.ndarray
    jumps: tuple[tuple[int, float], ...] = ()


def read_row_clock(
    ticks: np.ndarray, unit: float = 1.0, moved: np.ndarray | None = None
) -> RowClock:
    """Read a clock without the jumps of its adjustments.

    A board without a battery begins in 1970 until the network tells the time, and an hour that is
    wrong is set right: from one row to the next the clock goes back, or on by more than any
    recorder is held up, and runs on from there. Such a step is taken for a usual one. But where
    the person is elsewhere after it, they had the time to go there, and it stays. A single row
    whose stamp is wrong, or with which the clock stands still, has no time instead.

    Args:
        ticks: What the clock shows. Shape (n,).
        unit: Seconds that one tick is.
        moved: Whether the person is elsewhere than in the row before, farther than anybody moves
            from one row to the next. Shape (n,), bool; nowhere if None.
    """
    # Whole nanoseconds since 1970 are too many for a float: from the first on they are not.
    first = ticks[np.isfinite(ticks)][:1]
    t = np.asarray((ticks - first) * unit, float) if first.size else np.full(len(ticks), np.nan)
    with np.errstate(invalid="ignore"):
        steps = np.diff(t)
        runs = steps > 0
    usual = float(np.median(steps[runs])) if runs.any() else 0.0
    longest = usual + LONGEST_PAUSE_S
    if runs.all() and (steps <= longest).all():
        return RowClock(t, np.isfinite(t))
    goes_on, jumps = np.zeros(len(t), bool), list[tuple[int, float]]()
    last = -1  # the last row with which it went on
    shift = 0.0
    for row in np.flatnonzero(np.isfinite(t)).tolist():
        if last < 0:
            goes_on[row], last = True, row
            continue
        # However long it stood still before, the rows say how much time has passed.
        expected = (row - last) * usual
        step = t[row] + shift - t[last]
        pause = LONGEST_HOLD_S if moved is not None and moved[row] else LONGEST_PAUSE_S
        if not 0 < step <= expected + pause:
            follows = row + 1 < len(t) and 0 < t[row + 1] - t[row] <= longest
            after = t[row + 1] + shift - t[last] if follows else 0.0
            if not follows or 0 < after <= expected + longest:  # a single stamp is wrong
                continue
            shift += expected - step
            jumps.append((row, float(step - expected)))
        t[row] += shift
        goes_on[row], last = True, row
    return RowClock(t, goes_on, tuple(jumps))
