"""Settings of the controller that change between two solves."""

from __future__ import annotations

import dataclasses
import threading

import cem  # noqa: F401  registers it
import numpy as np
import pytest

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.state import Goal
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.plan import Plan, Status

DT = 0.04


class Bench:
    """RB-Y1 in simulation and its controller, with few samples."""

    def __init__(self, threads: int = 1) -> None:
        self.morphology = make_morphology("rby1")
        policy = make_policy("diff_drive")
        self.loop = PolicyLoop(
            self.morphology, Simulation(self.morphology, kind="planning"), policy
        )
        self.loop.reset(0, settle_s=0.2)
        model = build_model(self.morphology, "planning")
        config = RetargeterConfig(num_samples=8, horizon=4, threads=threads)
        self.retargeter = MpcRetargeter(self.morphology, policy, model, config)
        self.retargeter.reset(self.loop.state)
        self.poses = self.retargeter.problem.readings.compute_poses(
            self.loop.state.qpos, self.morphology.frames
        )

    def make_goal(self, offset, frame: str = "head", mode: Mode = Mode.MOBILE) -> Goal:
        pose = self.poses[frame].copy()
        pose[:3] += offset
        return Goal({frame: pose}, mode=mode)

    def tick(self, goal: Goal) -> Plan:
        plan = self.retargeter.plan(self.loop.state, goal)
        self.loop.execute(RobotAction(plan.command, goal.mode, self.loop.action.arms), DT)
        return plan

    def replace(self, **changes) -> dict[Mode, MpcConfig]:
        """The present parameters with changes in both modes."""
        configs = self.retargeter.configs
        return {mode: dataclasses.replace(config, **changes) for mode, config in configs.items()}

    def weigh(self, **weights: float) -> dict[Mode, MpcConfig]:
        return {
            mode: dataclasses.replace(
                config, weights=dataclasses.replace(config.weights, **weights)
            )
            for mode, config in self.retargeter.configs.items()
        }

    def close(self) -> None:
        self.retargeter.close()
        self.loop.close()


@pytest.fixture
def bench():
    made = Bench()
    yield made
    made.close()


# -- all or nothing --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes, text",
    [
        (
            {"targets": ("head", "nose")},
            "unknown tracked frame 'nose'. Known: head, left_wrist, right_wrist",
        ),
        (
            {"constraints": frozenset({"sober"})},
            "unknown constraint 'sober'. Known: upright",
        ),
        ({"body": ("torso_0", "tail")}, "unknown command 'tail'. Known: head_0"),
    ],
)
def test_a_bad_name_changes_nothing(bench, changes, text):
    """Everything else in the same call is good, and would be seen."""
    goal = bench.make_goal((0.4, 0, 0))
    bench.tick(goal)
    retargeter = bench.retargeter
    before = (
        retargeter.configs, retargeter.frames, retargeter.constraints, retargeter.references.sites,
        retargeter._planners, retargeter.candidates.proposals,
    )  # fmt: skip
    body = retargeter.command_model.body.copy()
    good = {
        "configs": bench.replace(num_samples=5),
        "targets": ("left_wrist",),
        "body": ("torso_0",),
        "constraints": frozenset({"upright"}),
    }
    with pytest.raises(UnknownName) as caught:
        retargeter.configure(**(good | changes))
    assert str(caught.value).startswith(text)
    after = (
        retargeter.configs, retargeter.frames, retargeter.constraints, retargeter.references.sites,
        retargeter._planners, retargeter.candidates.proposals,
    )  # fmt: skip
    assert all(old is new for old, new in zip(before, after, strict=True))
    np.testing.assert_array_equal(retargeter.command_model.body, body)


@pytest.mark.parametrize("name", ["vx", "left_wheel"])
def test_noise_and_optimizers_are_checked_too(bench, name):
    configs = bench.retargeter.configs
    for changes in ({"noise_std": {name: 0.1}}, {"optimizer": name}):
        with pytest.raises(UnknownName, match=f"^unknown (command|optimizer) '{name}'. Known: "):
            bench.retargeter.configure(bench.replace(**changes))
        assert bench.retargeter.configs is configs
    assert bench.tick(bench.make_goal((0, 0, 0))).status is Status.OK


def test_a_refused_change_leaves_the_next_plan_alone():
    plans = []
    for spoil in (False, True):
        bench = Bench()
        goal = bench.make_goal((0.3, 0.1, 0))
        bench.tick(goal)
        if spoil:
            with pytest.raises(UnknownName):
                bench.retargeter.configure(bench.weigh(position=9.0), targets=("nose",))
        plans.append([bench.tick(goal).commands for _ in range(3)])
        bench.close()
    np.testing.assert_array_equal(*plans)


# -- what changes, and when ------------------------------------------------------------------


def test_new_weights_act_at_the_next_plan(bench):
    goal = bench.make_goal((0.4, 0, 0))
    bench.tick(goal)
    state = bench.loop.state
    bench.retargeter.configure(bench.weigh(position=1.0, orientation=0.0, tilt_share=0.0))
    bench.retargeter.reset(state)
    plan = bench.retargeter.plan(state, goal)
    bench.retargeter.configure(bench.weigh(position=3.0, orientation=0.0, tilt_share=0.0))
    bench.retargeter.reset(state)  # the same samples again
    changed = bench.retargeter.plan(state, goal)
    assert plan.cost["tracking"] > 0
    assert changed.cost["tracking"] == pytest.approx(3 * plan.cost["tracking"], rel=0.2)


def test_weights_alone_leave_the_plan_and_its_optimizer(bench):
    goal = bench.make_goal((0.4, 0, 0))
    for _ in range(5):
        bench.tick(goal)
    planners = {mode: each.optimizer for mode, each in bench.retargeter._planners.items()}
    knots = planners[Mode.MOBILE].knots.copy()
    bench.retargeter.configure(bench.weigh(position=2.0))
    assert all(bench.retargeter._planners[mode].optimizer is planners[mode] for mode in Mode)
    np.testing.assert_array_equal(bench.retargeter._planners[Mode.MOBILE].optimizer.knots, knots)


@pytest.mark.parametrize(
    "changes",
    [
        {"num_samples": 12},
        {"num_samples": 1},
        {"horizon": 9},
        {"horizon": 1},
        {"num_knots": 3, "horizon": 6},
        {"optimizer": "cem"},
        {"sampling": "gaussian"},
    ],
    ids=str,
)
def test_sizes_change_between_two_solves(bench, changes):
    """The next plan has the new size, and goes on from the command of the last one."""
    goal = bench.make_goal((0.5, 0, 0))
    last = [bench.tick(goal) for _ in range(8)][-1]
    bench.retargeter.configure(bench.replace(**changes))
    for mode in Mode:
        held = bench.retargeter._planners[mode].optimizer.commands[0, 0]
        if mode is Mode.MOBILE:
            assert held == pytest.approx(last.command[0])
    plan = bench.tick(goal)
    horizon = bench.retargeter.configs[Mode.MOBILE].horizon
    assert plan.commands.shape == (horizon, 10)
    assert plan.qpos.shape[0] == horizon + 1
    assert plan.effective_samples <= bench.retargeter.configs[Mode.MOBILE].num_samples
    assert plan.status is Status.OK
    assert abs(plan.command[0] - last.command[0]) < 0.3


def test_one_mode_can_be_changed_alone(bench):
    stationary = bench.retargeter.configs[Mode.STATIONARY]
    changed = dataclasses.replace(bench.retargeter.configs[Mode.MOBILE], control_hz=50.0)
    bench.retargeter.configure({Mode.MOBILE: changed})
    assert bench.retargeter.configs[Mode.STATIONARY] is stationary
    assert bench.retargeter.control_period(Mode.MOBILE) == 0.02
    assert bench.retargeter.control_period(Mode.STATIONARY) == 1 / stationary.control_hz


def test_what_is_not_given_stays(bench):
    retargeter = bench.retargeter
    retargeter.configure(
        targets=("left_wrist",), body=("torso_0", "left_arm_3"), constraints=frozenset({"upright"})
    )
    mask = retargeter.command_model.body.copy()
    retargeter.configure(bench.replace(num_samples=9))
    assert retargeter.frames == ("left_wrist",)
    assert retargeter.constraints == {"upright"}
    np.testing.assert_array_equal(retargeter.command_model.body, mask)
    retargeter.configure()
    assert retargeter.configs[Mode.MOBILE].num_samples == 9


def test_the_body_changes_in_the_middle(bench):
    """Arms that are decided are in the plan; what is decided no longer holds where it is."""
    goal = bench.make_goal((0.05, 0.0, 0.05), "left_wrist", Mode.STATIONARY)
    bench.retargeter.configure(targets=("left_wrist",), body=("torso_1", "left_arm_3"))
    plan = bench.tick(goal)
    assert set(plan.arms) == {"left_arm_3"}
    assert plan.arms["left_arm_3"].shape == (4,)
    executed = bench.loop.action.command.copy()
    bench.retargeter.configure(body=("left_arm_0", "left_arm_3"))
    plan = bench.tick(goal)
    assert set(plan.arms) == {"left_arm_0", "left_arm_3"}
    np.testing.assert_allclose(plan.commands, np.tile(executed, (4, 1)), atol=1e-12)
    bench.retargeter.configure(targets=("head",), body=())
    plan = bench.tick(bench.make_goal((0, 0, -0.1), mode=Mode.STATIONARY))
    assert plan.arms == {}
    assert (plan.command != executed).any()


def test_targets_and_body_bind_freely(bench):
    """Any subset to any subset: the turn of the chest alone follows a hand that goes sideways."""
    bench.retargeter.configure(targets=("right_wrist",), body=("torso_5",))
    goal = bench.make_goal((0, 0.1, 0), "right_wrist", Mode.STATIONARY)
    plan = [bench.tick(goal) for _ in range(10)][-1]
    rest = bench.morphology.command_space.neutral
    moved = np.abs(plan.command - rest) > 1e-6
    assert [bench.morphology.command_space.names[i] for i in np.flatnonzero(moved)] == ["torso_5"]
    hand = bench.retargeter.problem.readings.compute_poses(
        bench.loop.state.qpos, {"right_wrist": "right_wrist"}
    )["right_wrist"]
    assert hand[1] - bench.poses["right_wrist"][1] > 0.03


def test_a_goal_without_a_bound_frame_is_no_motion(bench):
    bench.retargeter.configure(targets=("left_wrist",))
    plan = bench.tick(bench.make_goal((0.5, 0, 0), "head"))
    assert plan.status is Status.OK
    np.testing.assert_allclose(plan.command[:2], 0, atol=0.1)


def test_without_the_observers_nothing_that_they_knew_is_left(bench):
    """A preset without them, in mid-episode, must not plan with what was true before."""
    retargeter, goal = bench.retargeter, bench.make_goal((0.3, 0, 0))
    for _ in range(10):
        bench.tick(goal)
    assert retargeter.drift.drift.any()
    retargeter.configure(bench.replace(aids=()))
    bench.tick(goal)
    np.testing.assert_array_equal(retargeter.drift.drift, 0)
    np.testing.assert_array_equal(retargeter.offset.offset, 0)


# -- from other threads ----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_changes_from_another_thread_arrive_whole(threads):
    """Every plan is of one configuration or the other: its length, arms and frames agree."""
    bench = Bench(threads)
    retargeter, goal = bench.retargeter, bench.make_goal((0.1, 0, 0), "left_wrist")
    goal.poses["head"] = bench.poses["head"]  # type: ignore[index]
    kinds = (
        ({"horizon": 3, "num_samples": 6}, ("head",), ()),
        ({"horizon": 6, "num_samples": 10}, ("left_wrist",), ("torso_0", "left_arm_3")),
    )
    configs = [bench.replace(**changes) for changes, _, _ in kinds]
    retargeter.configure(configs[0], *kinds[0][1:])
    stop, errors = threading.Event(), []

    def change() -> None:
        turn = 0
        try:
            while not stop.is_set():
                turn = 1 - turn
                retargeter.configure(configs[turn], *kinds[turn][1:])
                stop.wait(0.0007)  # else who holds the lock decides what is seen
        except Exception as error:  # it is raised below
            errors.append(error)

    changer = threading.Thread(target=change)
    changer.start()
    state, seen = bench.loop.state, set()
    try:
        for count in range(2000):
            if count >= 60 and len(seen) > 1:
                break
            plan = retargeter.plan(state, goal)
            seen.add((len(plan.commands), tuple(plan.arms)))
            assert plan.status is Status.OK
            assert plan.qpos.shape[0] == len(plan.commands) + 1
    finally:
        stop.set()
        changer.join()
        bench.close()
    assert not errors
    assert seen <= {(3, ()), (6, ("left_arm_3",))}
    assert len(seen) == 2
