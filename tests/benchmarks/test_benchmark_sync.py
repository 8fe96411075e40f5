"""The benchmark of the state synchronisation: it runs its cases, and memory predicts best."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import run_sync as benchmark

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("case", ["g1 stands", "rby1 drives"])
def test_synchronised_states_predict_better_than_raw_ones(case, capsys):
    errors = {name: benchmark.Errors() for name in ("raw", *benchmark.VARIANTS)}
    benchmark.run(benchmark.CASES[case], "mild", 0, 6.0, errors)
    benchmark.print_table(case, errors)
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == f"{case}: 10 predictions, 100 states; RMS"
    assert [line[:28].strip() for line in lines[4:]] == list(errors)
    raw, best = errors["raw"], errors["NLS + velocity + memory"]
    for horizon in benchmark.HORIZONS:
        short = [np.mean(np.square(e.predicted[horizon])) for e in (best, raw)]
        assert short[0] < 0.25 * short[1]
    assert np.mean(best.position) < 0.4 * np.mean(raw.position)


def test_without_noise_a_prediction_from_the_raw_state_is_the_true_one():
    errors = {name: benchmark.Errors() for name in ("raw", *benchmark.VARIANTS)}
    benchmark.run(benchmark.CASES["rby1 stands"], "off", 0, 2.5, errors)
    assert max(errors["raw"].predicted[10]) == 0
    assert max(errors["NLS + velocity + memory"].predicted[10]) < 1e-3


def test_in_teleoperation_the_synchronised_state_is_the_better_one(capsys):
    errors = {name: benchmark.Errors() for name in ("raw", benchmark.TELEOPERATION)}
    benchmark.run_motion("g1", "walk_brisk", "mild", 0, errors)
    benchmark.print_table("g1 walk_brisk", errors)
    assert "g1 walk_brisk: 63 predictions, 125 states; RMS" in capsys.readouterr().out
    raw, synced = errors.values()
    assert np.mean(np.square(synced.velocity)) < 0.6 * np.mean(np.square(raw.velocity))
    assert np.mean(np.square(synced.predicted[3])) < 0.25 * np.mean(np.square(raw.predicted[3]))
