"""Keep the priority that a thread has."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def keep_schedule() -> Iterator[None]:
    """Give the calling thread its scheduling policy back afterwards.

    SVT-AV1 asks for the highest real-time priority for the thread that opens it. For root, as in
    a container, that is granted, stays, and is inherited by every process that is started from
    then on: two that wait actively can take a small machine for themselves.
    """
    if not hasattr(os, "sched_getscheduler"):  # not Linux
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if (os.sched_getscheduler(0), os.sched_getparam(0)) != before:
            os.sched_setscheduler(0, *before)
