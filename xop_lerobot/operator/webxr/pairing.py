"""Who may come in: the code of a session, and how often somebody may guess it."""

from __future__ import annotations

import functools
import hmac
import math
import secrets
from collections import OrderedDict, deque

from xop_lerobot.core.errors import BadValue

ALPHABET = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"
"""No letter looks like a digit."""
LENGTH = 8
MIN_LENGTH = 6
MAX_WRONG = 5
"""Wrong codes from one address until it is blocked."""
BLOCK_S = 60.0
"""For how long [s]."""
MAX_ADDRESSES = 256
"""Addresses that are remembered; the oldest are forgotten."""
MAX_RATE = 400
"""Messages that one client may send in a second."""


@functools.cache
def make_code() -> str:
    """The code of this process, 40 random bits; the next process has another."""
    return "".join(secrets.choice(ALPHABET) for _ in range(LENGTH))


def check_code(code: str) -> None:
    """Check a code that somebody has chosen.

    Raises:
        BadValue: If it is short, or cannot stand in an address.
    """
    if len(code) < MIN_LENGTH or not (code.isascii() and code.isalnum()):
        raise BadValue(
            f"device.code must have at least {MIN_LENGTH} letters or digits, got {code!r}"
        )


class Door:
    """Compares codes, and blocks addresses from which too many wrong ones come.

    Args:
        code: The right one.
    """

    def __init__(self, code: str) -> None:
        self._code = code.encode()
        self._wrong: OrderedDict[str, tuple[int, float]] = OrderedDict()  # how many, when last

    def refuse(self, address: str, code: str, time: float) -> str | None:
        """Why a client from `address` may not come in at `time` [s], None if it may."""
        count, last = self._wrong.get(address, (0, time))
        wait = last + BLOCK_S - time
        if wait <= 0:
            count = 0
        elif count >= MAX_WRONG:
            return f"blocked after too many wrong codes; try again in {math.ceil(wait)} s"
        if hmac.compare_digest(code.encode(errors="replace"), self._code):
            self._wrong.pop(address, None)
            return None
        self._wrong[address] = (count + 1, time)
        self._wrong.move_to_end(address)
        while len(self._wrong) > MAX_ADDRESSES:
            self._wrong.popitem(last=False)
        return "wrong code; open the address that the terminal shows now"


class RateLimit:
    """Whether a client sends more than `MAX_RATE` messages in a second."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()

    def is_broken(self, time: float) -> bool:
        """Count a message at `time` [s]."""
        self._times.append(time)
        while self._times[0] <= time - 1.0:
            self._times.popleft()
        return len(self._times) > MAX_RATE
