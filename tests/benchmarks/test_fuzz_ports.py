"""Garbage at every port that is open; `benchmarks/run_fuzz_ports.py` sends more of it."""

from __future__ import annotations

import random

import fuzzing
import pytest

RUNS = {
    "webxr": fuzzing.fuzz_webxr,
    "webxr with TLS": lambda total: fuzzing.fuzz_webxr(total, tls=True),
    "control": fuzzing.fuzz_control,
    "avp": fuzzing.fuzz_avp,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(RUNS))
def test_garbage_disturbs_nothing(name):
    result = RUNS[name](200_000)
    assert result.sent >= 200_000
    assert result.find_faults(growth_mb=20.0) == []


def test_faults_are_found():
    memory = [(40.0, 50.0, 53.0), (60.0, 62.0, 70.0)]
    result = fuzzing.Result("x", memory=memory, left=(3, 0), good=(10, 9))
    result.counts, result.errors = {"late": 1}, ["boom"]
    assert result.find_faults() == [
        "logged: boom",
        "memory grew from 62.0 to 70.0 MB",
        "memory grew from 40.0 to 70.0 MB in all",
        "3 threads and 0 files are left",
        "only 9 of 10 good messages were taken: {'late': 1}",
    ]


def test_garbage_is_the_same_for_a_seed():
    made = [fuzzing.mutate(random.Random(3), b"0123456789") for _ in range(2)]
    assert made[0] == made[1] != b"0123456789"
