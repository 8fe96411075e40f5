"""Joints on stiff servos: their noise is damped, their motion is not late."""

from __future__ import annotations

import numpy as np
import pytest

from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.retarget.arms.driver import ServoFilter, SteadyBody

DT, LAG = 0.04, 0.1


def run(targets: np.ndarray, noise: np.ndarray, sag: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Angles of one servo that follows `targets`, and what the filter makes of them."""
    servo = ServoFilter(np.array([LAG]))
    angle, true, seen = targets[0], [], []
    for target, error in zip(targets, noise, strict=True):
        angle += -np.expm1(-DT / LAG) * (target - angle)
        true.append(angle + sag)
        measured = np.array([angle + sag + error])
        seen.append(float(servo.update(np.array([target]), measured, DT)[0]))
    return np.array(true), np.array(seen)


def test_motion_is_not_late():
    targets = np.sin(np.arange(100) * DT * 3)
    true, seen = run(targets, np.zeros(100))
    np.testing.assert_allclose(seen, true, atol=1e-12)


def test_noise_is_damped_as_stated():
    noise = np.random.default_rng(0).normal(0, 3e-3, 5000)
    true, seen = run(np.zeros(5000), noise)
    assert np.std((seen - true)[100:]) == pytest.approx(3e-3 * np.sqrt(DT / 0.8), rel=0.1)


def test_sag_is_seen_in_time():
    targets = np.zeros(200)
    servo = ServoFilter(np.array([LAG]))
    servo.update(targets[:1], np.zeros(1), DT)
    seen = np.zeros(1)
    for _ in range(50):  # 2 s, five time constants
        seen = servo.update(targets[:1], np.full(1, -0.01), DT)
    assert seen[0] == pytest.approx(-0.01, rel=0.01)


def test_only_a_body_on_stiff_servos_is_filtered():
    for name, changes in (("g1", False), ("rby1", True)):
        morphology = make_morphology(name)
        body = SteadyBody(morphology, morphology.build_spec("full").compile())
        command = morphology.command_space.neutral
        qpos = morphology.standing_qpos()
        np.testing.assert_array_equal(body.update(qpos, command, DT), qpos)
        moved = body.update(qpos + 0.1, command, DT)
        assert (moved != qpos + 0.1).any() == changes
        assert np.count_nonzero(moved != qpos + 0.1) == (8 if changes else 0)
