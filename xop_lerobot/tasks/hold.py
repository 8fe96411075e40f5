"""How long something has been so without a break."""

from __future__ import annotations


class Hold:
    """A stopwatch that starts anew whenever its condition is not met.

    Args:
        needed: Time for which it has to be met [s].
    """

    def __init__(self, needed: float) -> None:
        self.needed = needed
        self.reset()

    def reset(self) -> None:
        """Start anew."""
        self._since: float | None = None
        self.duration = 0.0

    def update(self, time: float, met: bool) -> bool:
        """Take down whether the condition is met at `time` [s]; whether it was for long enough."""
        if not met:
            self.reset()
            return False
        if self._since is None:
            self._since = time
        self.duration = time - self._since
        # Half a physics step absorbs what floating point leaves of sums of 0.02.
        return self.duration >= self.needed - 0.0025
