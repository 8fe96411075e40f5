"""Time of recorded rows by a clock that may have been adjusted during the recording."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LONGEST_PAUSE_S = 1.0
"""Longest usual pause of a recorder between two rows; a longer step means an adjusted clock, unless
the person has moved meanwhile [s]."""
LONGEST_HOLD_S = 60.0
"""Longest possible pause of a recorder [s]."""


class RowClock(NamedTuple):
    """Times of rows by a clock.

    Attributes:
        t: Time of each row since the first, without adjustments [s]; meaningless where `goes_on` is
            False. Shape (n,).
        goes_on: Whether the clock advanced with that row. Shape (n,), bool.
        jumps: Rows at which it was adjusted, with the adjustment [s].
    """

    t: np.ndarray
    goes_on: np.ndarray
    jumps: tuple[tuple[int, float], ...] = ()


def read_row_clock(
    ticks: np.ndarray, unit: float = 1.0, moved: np.ndarray | None = None
) -> RowClock:
    """Read a clock without its adjustments.

    A board without a battery starts in 1970 until the network provides the time, and wrong time
    zones get corrected: between two rows the clock then goes back, or forward by more than any
    recorder pauses, and continues from there. Such a step is replaced by a usual one. But if the
    person has moved across it, that time has passed, and the step stays. A single row with a wrong
    stamp, or at which the clock stands still, gets no time instead.

    Args:
        ticks: Clock readings. Shape (n,).
        unit: Seconds per tick.
        moved: Whether the person has moved farther since the previous row than possible in one row.
            Shape (n,), bool; None for nowhere.
    """
    # Nanoseconds since 1970 exceed a float's precision; differences to the first row do not.
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
        # After a standstill the number of rows tells the elapsed time.
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
