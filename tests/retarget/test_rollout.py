"""Predictions: equal to a plain loop, to any number of threads, and to what the plant then does."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.state import RobotState
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.rollout import PolicyRollout, Prediction

ROBOTS = {"g1": "default", "rby1": "diff_drive"}
robots = pytest.mark.parametrize("name", list(ROBOTS))
K, H = 6, 5


class Parts:
    """A robot that has settled, and stands in a state of its own making."""

    def __init__(self, name: str) -> None:
        self.morphology: Morphology = make_morphology(name)
        self.policy: LowLevelPolicy = make_policy(ROBOTS[name])
        self.model = build_model(self.morphology, "planning")
        self.loop = self.make_loop("planning")

    def make_loop(self, kind, settle_s: float = 0.3) -> PolicyLoop:
        plant = Simulation(self.morphology, SimulationConfig(), kind=kind)
        loop = PolicyLoop(self.morphology, plant, self.policy)
        loop.reset(seed=0, settle_s=settle_s)
        return loop

    def draw_commands(self, seed: int, mode: Mode) -> np.ndarray:
        space, rng = self.morphology.command_space, np.random.default_rng(seed)
        noise = 0.2 * rng.normal(size=(K, H, len(space)))
        if mode is Mode.STATIONARY:
            noise[..., space.mobile_only] = 0
        commands = space.neutral + noise * (space.high - space.low) / 2
        return np.clip(commands, space.low, space.high)

    def predict(self, state: RobotState, commands: np.ndarray, mode: Mode, threads: int = 1):
        rollout = PolicyRollout(self.model, self.policy, threads)
        try:
            executed = (state.command, state.arms, state.mode) if self.morphology.ramps else None
            return rollout.predict(
                state.qpos, state.qvel, state.memory, commands, state.arms, mode, executed
            )
        finally:
            rollout.close()


@pytest.fixture(scope="module")
def parts() -> dict[str, Parts]:
    return {name: Parts(name) for name in ROBOTS}


def predict_slowly(p: Parts, state: RobotState, commands: np.ndarray, mode: Mode) -> Prediction:
    """One policy call for the batch, one `mj_step` after the other for each sample."""
    model, data = p.model, mujoco.MjData(p.model)
    num, horizon, _ = commands.shape
    qpos = np.empty((num, horizon + 1, model.nq))
    qvel = np.empty((num, horizon + 1, model.nv))
    qpos[:, 0], qvel[:, 0] = state.qpos, state.qvel
    memory, arms = np.tile(state.memory, (num, 1)), np.tile(state.arms, (num, 1))
    command = np.tile(state.command, (num, 1))
    executed, _ = p.policy.act(qpos[:, 0], qvel[:, 0], command, arms, memory, state.mode)
    substeps = round(POLICY_DT / model.opt.timestep)
    for k in range(horizon):
        targets, memory = p.policy.act(qpos[:, k], qvel[:, k], commands[:, k], arms, memory, mode)
        for i in range(num):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = qpos[i, k], qvel[i, k]
            begin = executed[i] if p.morphology.ramps else targets[i]
            for step in range(substeps):
                share = (step + 1) / substeps
                data.ctrl[:] = begin + share * (targets[i] - begin)
                mujoco.mj_step(model, data)
            qpos[i, k + 1], qvel[i, k + 1] = data.qpos, data.qvel
        executed = targets
    return Prediction(qpos, qvel, commands, np.zeros(0), memory, 0.0, 0.0)


@robots
@pytest.mark.parametrize("mode", list(Mode))
def test_it_equals_a_plain_loop_bit_for_bit(parts, name, mode):
    p = parts[name]
    commands = p.draw_commands(0, mode)
    got = p.predict(p.loop.state, commands, mode)
    expected = predict_slowly(p, p.loop.state, commands, mode)
    np.testing.assert_array_equal(got.qpos, expected.qpos)
    np.testing.assert_array_equal(got.qvel, expected.qvel)
    assert np.ptp(got.qpos[:, -1], axis=0).max() > 1e-3  # the samples do differ


@robots
@pytest.mark.parametrize("threads", [2, 3])
def test_threads_do_not_change_a_bit(parts, name, threads):
    p = parts[name]
    commands = p.draw_commands(1, Mode.MOBILE)
    one = p.predict(p.loop.state, commands, Mode.MOBILE)
    more = p.predict(p.loop.state, commands, Mode.MOBILE, threads)
    np.testing.assert_array_equal(one.qpos, more.qpos)
    np.testing.assert_array_equal(one.qvel, more.qvel)


@robots
def test_a_sample_does_not_depend_on_the_others_nor_on_what_was_asked_before(parts, name):
    p = parts[name]
    commands = p.draw_commands(2, Mode.MOBILE)
    state = p.loop.state
    rollout = PolicyRollout(p.model, p.policy, 1)
    try:
        args = (state.qpos, state.qvel, state.memory)
        whole = rollout.predict(*args, commands, state.arms, Mode.MOBILE)
        rollout.predict(*args, commands[::-1] * 1.1, state.arms, Mode.MOBILE)
        again = rollout.predict(*args, commands, state.arms, Mode.MOBILE)
        np.testing.assert_array_equal(whole.qpos, again.qpos)
        part = rollout.predict(*args, commands[3:5], state.arms, Mode.MOBILE)
        # A network's batches differ in the last bit by their size.
        np.testing.assert_allclose(part.qpos, whole.qpos[3:5], atol=1e-5)
    finally:
        rollout.close()


# A plant carries its solver's warm start from step to step, a rollout begins without: the solvers
# meet within their tolerance. G1's contacts converge to the last digits, the wheels of RB-Y1 less.
WITHIN = {"g1": 1e-9, "rby1": 2e-6}


@robots
@pytest.mark.parametrize("mode", list(Mode))
def test_a_prediction_is_what_the_plant_then_does(parts, name, mode):
    """With the planning model as the plant, and the policy's memory copied from it."""
    p = parts[name]
    loop = p.make_loop("planning", settle_s=0.1)
    command = p.morphology.command_space.neutral.copy()
    command[0] += 0.004 if name == "rby1" and mode is Mode.MOBILE else -0.004
    if name == "rby1" and mode is Mode.STATIONARY:
        command[0] = 0.0
        command[3] += 0.004
    command = command.astype(np.float32).astype(float)  # as robots execute it
    loop.execute(loop.action, POLICY_DT)  # the arms' rest angles too
    for _ in range(2):  # again from a state in motion, with a memory that has seen it
        state = loop.state
        steps = 8
        predicted = p.predict(state, np.tile(command, (1, steps, 1)), mode)
        action = RobotAction(command, mode, state.arms)
        for k in range(steps):
            executed = loop.execute(action, POLICY_DT)
            np.testing.assert_array_equal(executed.command, command)
            np.testing.assert_allclose(
                loop.state.qpos, predicted.qpos[0, k + 1], rtol=0, atol=WITHIN[name]
            )


def test_without_the_policys_memory_the_prediction_is_wrong(parts):
    """The memory h matters: a prediction from an empty one is off by more than 1e-5."""
    p = parts["g1"]
    state = p.make_loop("planning", settle_s=0.1).state
    command = np.tile(p.morphology.command_space.neutral, (1, H, 1))
    rollout = PolicyRollout(p.model, p.policy, 1)
    args = (command, state.arms, Mode.STATIONARY)
    right = rollout.predict(state.qpos, state.qvel, state.memory, *args)
    empty = p.policy.initial_memory(1)[0]
    wrong = rollout.predict(state.qpos, state.qvel, empty, *args)
    rollout.close()
    assert np.abs(right.qpos - wrong.qpos).max() > 1e-5


def test_the_planning_model_predicts_the_full_one(parts):
    """The full model has more contacts and joint friction; over 0.1 s that is millimetres."""
    p = parts["g1"]
    loop = p.make_loop("full")
    state = loop.state
    command = p.morphology.command_space.neutral
    predicted = p.predict(state, np.tile(command, (1, H, 1)), Mode.STATIONARY)
    loop.execute(RobotAction(command, Mode.STATIONARY, state.arms), H * POLICY_DT)
    np.testing.assert_allclose(loop.state.qpos[:3], predicted.qpos[0, -1, :3], atol=0.005)


def test_inputs_are_left_untouched(parts):
    p = parts["g1"]
    commands = p.draw_commands(3, Mode.MOBILE)
    before = commands.copy()
    prediction = p.predict(p.loop.state, commands, Mode.MOBILE)  # the state is read-only anyway
    np.testing.assert_array_equal(commands, before)
    for values, start in (
        (prediction.qpos, p.loop.state.qpos),
        (prediction.qvel, p.loop.state.qvel),
    ):
        np.testing.assert_array_equal(values[:, 0], np.tile(start, (K, 1)))


def test_times_are_counted(parts):
    p = parts["rby1"]
    prediction = p.predict(p.loop.state, p.draw_commands(0, Mode.MOBILE), Mode.MOBILE)
    assert prediction.policy_s > 0
    assert prediction.physics_s > 0


def test_a_time_step_that_does_not_divide_the_policys_period_is_refused(parts):
    model = build_model(parts["rby1"].morphology, "planning")
    model.opt.timestep = 0.003
    with pytest.raises(BadValue) as caught:
        PolicyRollout(model, parts["rby1"].policy, 1)
    assert str(caught.value) == (
        "the policy period 0.02 s must be a whole multiple of the time step 0.003 s"
    )


def test_a_sample_that_diverges_is_not_finite(parts):
    p = parts["rby1"]
    state = p.loop.state
    qvel = state.qvel.copy()
    qvel[8] = 1e12
    rollout = PolicyRollout(p.model, p.policy, 1)
    commands = p.draw_commands(0, Mode.MOBILE)
    got = rollout.predict(state.qpos, qvel, state.memory, commands, state.arms, Mode.MOBILE)
    rollout.close()
    assert not np.isfinite(got.qpos[:, -1]).all()
