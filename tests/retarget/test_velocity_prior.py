"""Prior of the state synchronisation: the velocity that the executed action brings about."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.sync.prior import VelocityPrior

DT = 0.04


def make_prior(robot):
    morphology = make_morphology(robot)
    policy, model = make_policy(morphology.policies[0]), build_model(morphology, "planning")
    plant = Simulation(morphology, SimulationConfig(), kind="planning")
    loop = PolicyLoop(morphology, plant, policy)
    loop.reset(0, settle_s=0.4)
    return loop, VelocityPrior(morphology, policy, model, DT)


def predict(prior: VelocityPrior, time: float, since: float) -> np.ndarray:
    velocity = prior.predict(time, since)
    assert velocity is not None
    return velocity


@pytest.mark.parametrize("robot", ["g1", "rby1m"])
def test_the_velocity_is_the_one_that_comes(robot):
    """With the planning model as the plant, while command, arms and mode change."""
    loop, prior = make_prior(robot)
    rest, rng = loop.morphology.rest_action(), np.random.default_rng(0)
    moved = 0.0
    for tick in range(10):
        state = loop.state
        action = RobotAction(
            rest.command + 0.3 * rng.standard_normal(len(rest.command)),
            Mode.STATIONARY if tick < 2 else Mode.MOBILE,
            rest.arms + 0.1 * rng.standard_normal(len(rest.arms)),
        )
        executed = loop.execute(action, DT)
        prior.note(state, executed)
        expected = predict(prior, loop.state.time, state.time)
        np.testing.assert_allclose(expected, loop.state.true_qvel[:3], atol=1e-6)
        moved = max(moved, float(np.abs(expected - state.true_qvel[:3]).max()))
    assert moved > 0.01
    loop.close()
    prior.close()


def test_it_holds_for_its_own_state_and_period_alone():
    loop, prior = make_prior("g1")
    state = loop.state
    assert prior.predict(state.time + DT, state.time) is None
    prior.note(state, loop.action)
    steps = [predict(prior, state.time + t, state.time) for t in (0.0, 0.01, 0.02, 0.04, 0.049)]
    np.testing.assert_allclose(steps[0], state.qvel[:3])
    np.testing.assert_allclose(steps[1], (steps[0] + steps[2]) / 2)
    np.testing.assert_allclose(steps[3], steps[4], atol=1e-12)
    assert prior.predict(state.time + 0.051, state.time) is None
    assert prior.predict(state.time - 0.011, state.time) is None
    assert prior.predict(state.time + 2 * DT, state.time + DT) is None
    prior.note(dataclasses.replace(state, qvel=np.full(len(state.qvel), 1e6)), loop.action)
    assert prior.predict(state.time + DT, state.time) is None  # diverged
    prior.note(state, loop.action)
    prior.forget()
    assert prior.predict(state.time + DT, state.time) is None
    loop.close()
    prior.close()
