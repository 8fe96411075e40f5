"""A recording keeps the priority of the thread that it runs in."""

from __future__ import annotations

import os

import pytest

from xop_lerobot.recording.writer import keep_schedule

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="only on Linux")


@pytest.fixture(autouse=True)
def _ordinary():
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    yield
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def raise_priority():
    """As SVT-AV1 does; who is not root may change to another policy at least."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(99))
    except PermissionError:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def test_it_gives_the_policy_back():
    with keep_schedule():
        raise_priority()
        assert os.sched_getscheduler(0) != os.SCHED_OTHER
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    assert os.sched_getparam(0).sched_priority == 0


def test_it_gives_it_back_after_an_error():
    with pytest.raises(ValueError, match="encoder"), keep_schedule():
        raise_priority()
        raise ValueError("encoder")
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_who_had_another_policy_keeps_it():
    raise_priority()
    before = os.sched_getscheduler(0)
    with keep_schedule():
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    assert os.sched_getscheduler(0) == before


def test_another_priority_within_the_policy_is_given_back():
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(5))
    except PermissionError:
        pytest.skip("only root may have real-time priorities")
    with keep_schedule():
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(99))
    assert os.sched_getparam(0).sched_priority == 5
