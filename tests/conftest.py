"""What holds for all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def ordinary_schedule() -> Iterator[None]:
    """No test, nor what it starts, keeps the tests beside it from a processor.

    An encoder that LeRobot starts by itself gives the thread that starts it real-time priority,
    where it may.
    """
    _make_ordinary()
    yield
    _make_ordinary()


def _make_ordinary() -> None:
    if hasattr(os, "sched_setscheduler") and os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
