"""The paced proposal: as far as all entries of a command can go together."""

from __future__ import annotations

import numpy as np

from xop_lerobot.retarget.model.proposal import pace

REACH = np.array([0.1, 0.02, 1.0])


def test_the_slowest_entry_sets_the_pace():
    executed, wanted = np.array([0.0, 1.0, 0.0]), np.array([0.1, 1.08, -0.4])
    np.testing.assert_allclose(pace(executed, wanted, REACH), [0.025, 1.02, -0.1])


def test_what_is_near_is_reached():
    executed = np.array([0.0, 1.0, 0.0])
    wanted = executed + [0.1, -0.02, 0.5]
    np.testing.assert_allclose(pace(executed, wanted, REACH), wanted)
    np.testing.assert_array_equal(pace(executed, executed, REACH), executed)


def test_no_entry_goes_further_than_it_can():
    rng = np.random.default_rng(0)
    for _ in range(50):
        executed, wanted = rng.normal(size=(2, 3))
        step = pace(executed, wanted, REACH) - executed
        assert (np.abs(step) <= REACH + 1e-12).all()
        # It is on the way, and one entry is at its limit or all have arrived.
        share = step / (wanted - executed)
        np.testing.assert_allclose(share, share[0])
        assert np.isclose(np.abs(step) / REACH, 1).any() or np.isclose(share[0], 1)


def test_an_entry_without_reach_holds_all_of_them():
    np.testing.assert_array_equal(
        pace(np.zeros(3), np.ones(3), np.array([1.0, 0.0, 1.0])), np.zeros(3)
    )
