"""The observer of the arms' offsets: what it learns, when, and what it makes of it."""

from __future__ import annotations

import numpy as np
import pytest

from xop_lerobot.retarget.arms.contact import ArmBias

DT = 0.04
RANGE = np.array([[-1.0, 1.0], [-0.5, 2.0], [-3.0, 3.0]])
STILL = np.zeros(3)
OFFSET = np.array([0.1, -0.2, 0.05])


def learn(bias: ArmBias, offset: np.ndarray, moved: np.ndarray, seconds: float) -> None:
    for _ in range(round(seconds / DT)):
        bias.update(offset, moved, DT)


def test_a_constant_offset_is_learned_and_taken_out():
    bias = ArmBias(RANGE)
    wanted = np.array([0.3, 0.4, -1.0])
    np.testing.assert_array_equal(bias.compute_targets(wanted), wanted)
    learn(bias, OFFSET, STILL, 5.0)
    np.testing.assert_allclose(bias.bias, OFFSET, atol=1e-4)
    np.testing.assert_allclose(bias.compute_targets(wanted) + OFFSET, wanted, atol=1e-4)


def test_it_learns_at_its_time_constant_whatever_the_rate():
    for dt in (0.01, 0.02, 0.05):
        bias = ArmBias(RANGE, time_constant=0.5, rest_s=0.0)
        for _ in range(round(0.5 / dt)):
            bias.update(OFFSET, STILL, dt)
        np.testing.assert_allclose(bias.bias, OFFSET * (1 - np.exp(-1)), rtol=1e-9)


def test_a_plant_that_answers_late_and_beside_its_target_is_brought_to_it():
    """In closed loop: a servo of 0.1 s whose offset depends on where the arm is."""
    bias = ArmBias(RANGE)
    wanted, angle, sent = np.array([0.3, 0.4, -1.0]), np.zeros(3), np.zeros(3)
    for _ in range(200):
        bias.update(angle - sent, STILL, DT)
        sent = bias.compute_targets(wanted)
        angle = angle + 0.3 * (sent + OFFSET - 0.15 * angle - angle)
    np.testing.assert_allclose(angle, wanted, atol=1e-3)


def test_while_any_joint_moves_nothing_is_learned():
    bias = ArmBias(RANGE)
    learn(bias, OFFSET, np.array([0.0, 0.5, 0.0]) * DT, 2.0)
    before = bias.bias.copy()
    learn(bias, OFFSET, np.array([0.0, 2.0, 0.0]) * DT, 1.0)
    np.testing.assert_array_equal(bias.bias, before)
    learn(bias, OFFSET, STILL, 0.2)  # it may still be swinging out
    np.testing.assert_array_equal(bias.bias, before)
    learn(bias, OFFSET, STILL, 3.0)
    np.testing.assert_allclose(bias.bias, OFFSET, atol=0.01)


def test_noise_of_the_wanted_angles_does_not_keep_it_from_learning():
    bias, rng = ArmBias(RANGE), np.random.default_rng(0)
    angles = 0.01 * rng.standard_normal((200, 3))
    for moved in np.diff(angles, axis=0):
        bias.update(OFFSET, moved, DT)
    np.testing.assert_allclose(bias.bias, OFFSET, atol=0.01)


def test_offsets_and_targets_keep_their_limits():
    bias = ArmBias(RANGE, max_bias=0.3)
    learn(bias, np.array([5.0, -5.0, 0.0]), STILL, 5.0)
    np.testing.assert_array_equal(bias.bias, [0.3, -0.3, 0.0])
    np.testing.assert_array_equal(bias.compute_targets(RANGE[:, 0])[0], -1.0)
    np.testing.assert_array_equal(bias.compute_targets(RANGE[:, 1])[1], 2.0)
    learn(bias, OFFSET, STILL, 5.0)  # nothing has wound up
    np.testing.assert_allclose(bias.bias, OFFSET, atol=1e-4)


@pytest.mark.parametrize("dt", [0.0, -0.02])
def test_without_time_nothing_is_learned(dt):
    bias = ArmBias(RANGE, rest_s=0.0)
    bias.update(OFFSET, STILL, dt)
    np.testing.assert_array_equal(bias.bias, 0)


def test_reset_forgets():
    bias = ArmBias(RANGE)
    learn(bias, OFFSET, STILL, 2.0)
    bias.reset()
    np.testing.assert_array_equal(bias.bias, 0)
    bias.update(OFFSET, STILL, DT)
    np.testing.assert_array_equal(bias.bias, 0)  # and rests before it learns
