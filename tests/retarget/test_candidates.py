"""Fixed candidates are among the samples, and the control energy counts from its reference."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import (
    make_pose,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    rotation_error,
)
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.morphology.tuning import CONTROL_REFERENCES
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.direct import DirectRetargeter
from xop_lerobot.retarget.model.proposal import pace
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.optimizer import Samples
from xop_lerobot.retarget.plan import Plan

POLICIES = {"g1": "default", "rby1": "diff_drive"}
robots = pytest.mark.parametrize("name", list(POLICIES))
modes = pytest.mark.parametrize("mode", list(Mode))
DT = 0.04


class Bench:
    """A robot that has begun to move, and what its controller samples and scores."""

    def __init__(self, name: str, **changes) -> None:
        self.morphology = make_morphology(name)
        policy = make_policy(POLICIES[name])
        self.model = build_model(self.morphology, "planning")
        self.loop = PolicyLoop(
            self.morphology, Simulation(self.morphology, kind="planning"), policy
        )
        self.loop.reset(0, settle_s=0.2)
        self.retargeter = MpcRetargeter(
            self.morphology, policy, self.model, RetargeterConfig(threads=1)
        )
        self.retargeter.configure(
            {
                mode: dataclasses.replace(config, num_samples=10, horizon=4, **changes)
                for mode, config in self.retargeter.configs.items()
            }
        )
        self.retargeter.reset(self.loop.state)
        self.head = self.compute_head(self.loop.state.qpos)
        self.sampled: list[Samples] = []
        self.costs: list[np.ndarray] = []
        self.evaluations: list = []
        for planner in self.retargeter._planners.values():
            self._watch(planner.optimizer)
        self._watch_evaluations()

    def _watch(self, planner) -> None:
        sample, update = planner.sample, planner.update

        def watched_sample(*args):
            self.sampled.append(sample(*args))
            return self.sampled[-1]

        def watched_update(samples, costs):
            self.costs.append(costs.copy())
            return update(samples, costs)

        planner.sample, planner.update = watched_sample, watched_update

    def _watch_evaluations(self) -> None:
        evaluate = self.retargeter.problem.evaluate

        def watched(*args):
            self.evaluations.append(evaluate(*args))
            return self.evaluations[-1]

        self.retargeter.problem.evaluate = watched  # type: ignore[method-assign]

    def compute_head(self, qpos: np.ndarray) -> np.ndarray:
        sites = {"head": self.morphology.frames["head"]}
        return self.retargeter.problem.readings.compute_poses(qpos, sites)["head"]

    def make_goal(self, mode: Mode, offset=(0.25, 0.05, -0.05)) -> Goal:
        pose = self.head.copy()
        pose[:3] += offset
        return Goal({"head": pose}, {"head": np.array([0.2, 0, 0, 0, 0, 0.1])}, mode)

    def tick(self, mode: Mode) -> Plan:
        plan = self.retargeter.plan(self.loop.state, self.make_goal(mode))
        self.loop.execute(RobotAction(plan.command, mode, self.loop.action.arms), DT)
        return plan

    def close(self) -> None:
        self.retargeter.close()
        self.loop.close()


@pytest.fixture
def bench():
    made: list[Bench] = []

    def make(name: str, **changes) -> Bench:
        made.append(Bench(name, **changes))
        return made[-1]

    yield make
    for each in made:
        each.close()


ALL = ("proposal", "paced", "direct", "previous", "stop")


@robots
@modes
def test_every_candidate_is_among_the_samples(bench, name, mode):
    """After the plan itself, in order, each held over the horizon; computed here on its own."""
    b = bench(name, candidates=ALL)
    for _ in range(4):
        b.tick(mode)
    retargeter, goal, state = b.retargeter, b.make_goal(mode), b.loop.state
    config, space = retargeter.configs[mode], retargeter.space
    retargeter.plan(state, goal)
    commands = b.sampled[-1].commands
    assert commands.shape[:2] == (10, 4)
    assert (commands[1:6] == commands[1:6, :1]).all()  # held

    count = retargeter.decision.num_commands
    executed = retargeter.decision.join(state.command, state.arms)
    velocities = retargeter.command_model.is_velocity()
    neck = retargeter.command_model.neck
    acting = retargeter.command_model.acting(mode) & ~neck
    held = np.where(velocities, 0.0, executed)
    held[:count] = space.neutral[:count]
    proposal = b.evaluations[-1].reference  # control_reference is the proposal
    np.testing.assert_allclose(commands[1, 0][acting], proposal[acting], atol=1e-12)
    reach = space.compute_max_rate(mode, executed) * 2 / config.control_hz
    paced = pace(executed, np.where(acting, proposal, held), reach)
    np.testing.assert_allclose(commands[2, 0][acting], paced[acting], atol=1e-9)
    direct = DirectRetargeter(b.morphology, b.model)
    direct.reset(state)
    mapped = direct.plan(state, goal).command
    decided = acting[:count]
    np.testing.assert_allclose(commands[3, 0, :count][decided], mapped[decided], atol=0.02)
    np.testing.assert_allclose(commands[4, 0][acting], executed[acting], atol=1e-12)
    stop = np.where(velocities, 0.0, executed)
    np.testing.assert_allclose(commands[5, 0][acting], stop[acting], atol=1e-12)
    assert len(np.unique(commands[1:6, 0].round(9), axis=0)) >= 4  # they do differ
    tried = b.evaluations[-1].commands  # a neck is not sampled
    np.testing.assert_array_equal(
        tried[..., neck], np.broadcast_to(proposal[neck], (10, 4, neck.sum()))
    )


@modes
@pytest.mark.parametrize("yaw, pitch", [(0.5, 0.0), (0.0, 0.6), (-0.4, 0.4), (0.0, -0.5)])
def test_a_neck_takes_what_is_too_quick_for_the_chest(bench, mode, yaw, pitch):
    """The plan turns the head within 0.2 s, in which the chest turns by 0.24 rad at most."""
    b = bench("rby1", candidates=("proposal",))
    turn = quat_multiply(quat_from_yaw(yaw), quat_from_rpy(0.0, pitch, 0.0))
    head = make_pose(b.head[:3], quat_multiply(turn, b.head[3:]))
    for _ in range(5):
        plan = b.retargeter.plan(b.loop.state, Goal({"head": head}, mode=mode))
        b.loop.execute(RobotAction(plan.command, mode, b.loop.action.arms), DT)
    reached = b.compute_head(b.loop.state.qpos)
    assert np.linalg.norm(rotation_error(head[3:], reached[3:])) < 0.2
    # The eyes are 8 cm from the neck's axes, and the chest has begun to take its share.
    assert np.linalg.norm(reached[:3] - head[:3]) < 0.12
    neck = [name.startswith("head") for name in b.morphology.command_space.names]
    assert np.abs(b.loop.state.command[neck]).max() > 0.1


def test_a_neck_that_is_not_free_stays_where_it_is(bench):
    b = bench("rby1", candidates=("proposal",))
    space, model = b.morphology.command_space, b.retargeter.command_model
    turned = space.neutral.copy()
    turned[space.index("head_0")] = 0.3
    for _ in range(10):
        b.loop.execute(RobotAction(turned, Mode.STATIONARY, b.loop.action.arms), DT)
    b.retargeter.configure(body=("torso_5",))
    plan = b.tick(Mode.STATIONARY)
    assert plan.command[space.index("head_0")] == pytest.approx(0.3)
    assert not (model.neck & model.body).any()


def test_a_neck_turns_back_from_a_chest_that_is_slower(bench):
    """A head that looks ahead again, with the chest turned by 0.6 rad."""
    b = bench("rby1", candidates=("proposal",))
    space = b.morphology.command_space
    turned = space.neutral.copy()
    turned[space.index("torso_5")] = 0.6
    for _ in range(30):
        b.loop.execute(RobotAction(turned, Mode.STATIONARY, b.loop.action.arms), DT)
    b.retargeter.reset(b.loop.state)
    for _ in range(6):
        plan = b.retargeter.plan(b.loop.state, Goal({"head": b.head}, mode=Mode.STATIONARY))
        b.loop.execute(RobotAction(plan.command, Mode.STATIONARY, b.loop.action.arms), DT)
    command = b.loop.state.command
    assert command[space.index("torso_5")] > 0.25
    assert command[space.index("head_0")] < -0.2
    reached = b.compute_head(b.loop.state.qpos)
    assert np.linalg.norm(rotation_error(b.head[3:], reached[3:])) < 0.1


@robots
def test_without_candidates_there_is_the_plan_and_noise(bench, name):
    b = bench(name, candidates=(), sample_plan=True)
    b.tick(Mode.MOBILE)
    commands = b.sampled[-1].commands[:, 0]
    assert len(np.unique(commands, axis=0)) == 10


@robots
@modes
def test_the_optimizer_gets_the_sum_of_the_terms(bench, name, mode):
    """And nothing else: what the sampling itself costs, the optimizer adds."""
    b = bench(name, importance_cost=True, candidates=(), sample_plan=False, weighting="raw")
    plan = b.tick(mode)
    assert b.sampled[-1].penalty is not None
    assert sum(plan.cost.values()) == pytest.approx(b.costs[-1].min())
    assert b.costs[-1].shape == (10,)


@robots
@modes
@pytest.mark.parametrize("kind", CONTROL_REFERENCES)
def test_control_counts_from_its_reference(bench, name, mode, kind):
    b = bench(name, control_reference=kind)
    b.tick(mode)
    b.tick(mode)
    evaluation, retargeter = b.evaluations[-1], b.retargeter
    acting = retargeter.command_model.acting(mode)
    expected = {
        "neutral": retargeter.space.neutral,
        "zero": np.zeros(len(retargeter.space)),
        "proposal": b.sampled[-1].commands[1, 0],
    }[kind]
    np.testing.assert_allclose(evaluation.reference[acting], expected[acting], atol=1e-12)
    # What is not decided is the same in all samples, and must not count.
    rest = evaluation.commands[..., ~acting] - evaluation.reference[~acting]
    np.testing.assert_array_equal(rest, 0)
    (control,) = (cost for cost in retargeter.problem.costs if cost.name == "control")
    share = (evaluation.commands - evaluation.reference) / control.scale
    slow = evaluation.weights.control * np.square(share).sum(-1).mean(-1)
    np.testing.assert_allclose(control.compute(evaluation), slow)


def test_the_direct_mapping_starts_anew_after_a_reset(bench):
    b = bench("g1", candidates=("direct", "stop"))
    start = b.loop.state
    first = b.retargeter.plan(start, b.make_goal(Mode.STATIONARY, (0, 0, -0.15))).commands
    for _ in range(5):
        b.retargeter.plan(start, b.make_goal(Mode.STATIONARY, (0, 0, 0.02)))
    b.retargeter.reset(start)
    again = b.retargeter.plan(start, b.make_goal(Mode.STATIONARY, (0, 0, -0.15))).commands
    np.testing.assert_array_equal(first, again)


def test_pace_moves_all_entries_together():
    executed, wanted = np.array([0.0, 1.0, -1.0]), np.array([1.0, 1.0, -1.2])
    paced = pace(executed, wanted, np.array([0.25, 0.1, 0.1]))
    np.testing.assert_allclose(paced, [0.25, 1.0, -1.05])
    np.testing.assert_allclose(pace(executed, wanted, np.full(3, 5.0)), wanted)
    np.testing.assert_array_equal(pace(executed, executed, np.zeros(3)), executed)
