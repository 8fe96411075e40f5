"""What is done about a predicted fall or collision: judged by hand, and with robots at walls."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import quat_from_rpy
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.candidates import Intervention, Verdict, judge
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.costs import CollisionCost
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.obstacles import Obstacle
from xop_lerobot.retarget.plan import Plan, Status

NAN = np.nan
NONE = [False] * 4


def judge_by_hand(
    weights: list[float],
    costs: list[float],
    falls: list[bool] = NONE,
    touches: list[bool] = NONE,
    stop: int | None = 3,
) -> Verdict:
    return judge(np.array(weights), np.array(costs), np.array(falls), np.array(touches), stop)


# -- by hand -------------------------------------------------------------------------------


def test_a_plan_whose_samples_are_sound_stays():
    verdict = judge_by_hand([0.4, 0.3, 0.2, 0.1], [1.0, 2.0, 3.0, 4.0])
    assert verdict == (Intervention.NONE, 0.0, None, 1.0)


def test_a_failure_that_hardly_counts_changes_nothing():
    verdict = judge_by_hand(
        [0.5, 0.4, 0.05, 0.05], [1.0, 2.0, 3.0, 4.0], falls=[False, False, True, False]
    )
    assert verdict == (Intervention.NONE, 0.05, None, 1.0)


@pytest.mark.parametrize(
    "falls, reason",
    [(True, Intervention.SLOWED_FALL), (False, Intervention.SLOWED_COLLISION)],
)
def test_some_of_the_weight_on_failures_slows(falls, reason):
    failing = [False, True, False, False]
    verdict = judge_by_hand(
        [0.5, 0.3, 0.1, 0.1], [1.0, 2.0, 3.0, 4.0], *((failing, NONE) if falls else (NONE, failing))
    )
    assert verdict.intervention is reason
    assert verdict.sample is None
    assert verdict.risk == pytest.approx(0.3)
    assert verdict.scale == pytest.approx(0.7)


@pytest.mark.parametrize(
    "falls, reason",
    [(True, Intervention.VETOED_FALL), (False, Intervention.VETOED_COLLISION)],
)
def test_most_of_it_takes_the_cheapest_sample_that_is_safe(falls, reason):
    failing = [True, False, False, False]
    verdict = judge_by_hand(
        [0.6, 0.1, 0.2, 0.1], [1.0, 3.0, 2.0, 4.0], *((failing, NONE) if falls else (NONE, failing))
    )
    assert (verdict.intervention, verdict.sample, verdict.scale) == (reason, 2, 1.0)
    assert verdict.risk == pytest.approx(0.6)


def test_where_all_fail_it_stops():
    verdict = judge_by_hand([0.4, 0.3, 0.2, 0.1], [1.0, 2.0, 3.0, 4.0], touches=[True] * 4)
    assert (verdict.intervention, verdict.sample) == (Intervention.VETOED_COLLISION, 3)
    assert verdict.risk == pytest.approx(1.0)


def test_where_all_fail_and_none_stops_the_base_does():
    verdict = judge_by_hand([0.4, 0.3, 0.2, 0.1], [1.0, 2.0, 3.0, 4.0], falls=[True] * 4, stop=None)
    assert (verdict.intervention, verdict.sample, verdict.scale) == (
        Intervention.VETOED_FALL,
        None,
        0.0,
    )


def test_a_safe_sample_that_diverged_is_not_taken():
    verdict = judge_by_hand(
        [0.9, 0.0, 0.1, 0.0], [1.0, NAN, 5.0, NAN], falls=[True, False, False, False]
    )
    assert (verdict.intervention, verdict.sample) == (Intervention.VETOED_FALL, 2)


def test_a_sample_that_falls_and_touches_counts_once():
    both = [False, True, False, False]
    verdict = judge_by_hand([0.6, 0.4, 0.0, 0.0], [1.0, 2.0, 3.0, 4.0], both, both)
    assert verdict.risk == pytest.approx(0.4)
    assert verdict.intervention is Intervention.SLOWED_FALL


def test_the_greater_danger_is_the_reason():
    falls, touches = [True, False, False, False], [False, True, False, False]
    for weights, reason in (
        ([0.4, 0.2, 0.2, 0.2], Intervention.VETOED_FALL),
        ([0.2, 0.4, 0.2, 0.2], Intervention.VETOED_COLLISION),
    ):
        verdict = judge_by_hand(weights, [1.0, 2.0, 3.0, 4.0], falls, touches)
        assert verdict.intervention is reason
        assert verdict.sample == 2


def test_predictions_that_are_no_numbers_stop_the_base():
    verdict = judge_by_hand([1.0, 0, 0, 0], [NAN, np.inf, NAN, NAN], falls=[True] * 4)
    assert verdict == (Intervention.DIVERGED, 1.0, None, 0.0)


def test_risk_grows_without_a_gap_up_to_the_veto():
    """Just under the veto half of the velocity is left: no figure jumps from 1 to nothing."""
    scales = []
    for risk in np.linspace(0.0, 0.499, 50):
        verdict = judge_by_hand(
            [1 - risk, risk, 0, 0], [1.0, 2.0, 3.0, 4.0], touches=[False, True, False, False]
        )
        assert verdict.sample is None
        scales.append(verdict.scale)
    assert (np.diff(scales) <= 0).all()
    assert np.abs(np.diff(scales)).max() < 0.12
    assert scales[-1] == pytest.approx(0.501)


# -- with robots ---------------------------------------------------------------------------


def make_wall(x: float) -> Obstacle:
    """A wall across the way whose near side is at `x` [m]."""
    level = np.array([1.0, 0, 0, 0])
    return Obstacle("wall", np.array([x + 0.5, 0, 1]), level, np.array([0.5, 5, 2]))


class Driver:
    """RB-Y1 at a speed, 2 m before its goal, and walls that its cost does not see.

    So the samples and their weights are the same whatever the wall.
    """

    def __init__(self, speed: float) -> None:
        self.morphology = make_morphology("rby1")
        self.loop = PolicyLoop(
            self.morphology, Simulation(self.morphology, kind="planning"), make_policy("diff_drive")
        )
        self.loop.reset(0, settle_s=0.2)
        command = self.morphology.command_space.neutral.copy()
        command[0] = speed
        for _ in range(25):
            arms = self.loop.action.arms
            self.loop.execute(RobotAction(command, Mode.MOBILE, arms), 0.04)
        model = build_model(self.morphology, "planning")
        self.retargeter = MpcRetargeter(
            self.morphology,
            make_policy("diff_drive"),
            model,
            RetargeterConfig(threads=1),
            obstacles=[make_wall(100.0)],
        )
        blind = {}
        for mode, config in self.retargeter.configs.items():
            weights = dataclasses.replace(config.weights, collision=0.0, collision_velocity=0.0)
            blind[mode] = dataclasses.replace(config, weights=weights)
        self.retargeter.configure(blind)
        (self.collision,) = (
            cost for cost in self.retargeter.problem.costs if isinstance(cost, CollisionCost)
        )
        data = mujoco.MjData(model)
        data.qpos[:] = self.loop.state.qpos
        mujoco.mj_kinematics(model, data)
        hull = self.morphology.hull_points.items()
        self.front = max(data.site(site).xpos[0] + radius for site, radius in hull)

    def plan(self, distance: float) -> Plan:
        """Plan with a wall that far ahead of the hull [m]."""
        self.collision.set_obstacles([make_wall(self.front + distance)])
        state = self.loop.state
        self.retargeter.reset(state)
        sites = {"head": self.morphology.frames["head"]}
        pose = self.retargeter.problem.readings.compute_poses(state.qpos, sites)["head"]
        pose[0] += 2.0
        return self.retargeter.plan(state, Goal({"head": pose}, mode=Mode.MOBILE))

    def compute_clearance(self, plan: Plan, distance: float) -> float:
        """Least distance to the wall while the plan is carried out [m]."""
        state, retargeter = self.loop.state, self.retargeter
        join, count = retargeter.decision.join, len(state.command)
        decisions = np.array([[join(command, state.arms) for command in plan.commands]])
        executed = join(state.command, state.arms)
        limited = retargeter.command_model.limit_rates(executed, decisions, plan.mode, 0.02)
        sensed = retargeter.rollout.predict(
            state.qpos,
            state.qvel,
            state.memory,
            limited[..., :count],
            state.arms,
            plan.mode,
            (state.command, state.arms, state.mode),
        ).sensordata
        points = retargeter.problem.readings.read(sensed, {}).points
        self.collision.set_obstacles([make_wall(self.front + distance)])
        return float(self.collision.compute_clearance(points)[0])

    def close(self) -> None:
        self.retargeter.close()
        self.loop.close()


@pytest.fixture(scope="module", params=[0.3, 0.6, 1.0])
def driver(request):
    made = Driver(request.param)
    yield made
    made.close()


@pytest.mark.slow
def test_the_nearer_a_wall_the_more_is_done(driver):
    """The reason and the risk are in `Plan.health`, and the velocity is what they say."""
    free = driver.plan(5.0)
    assert free.health == {"intervention": Intervention.NONE, "risk": 0.0}
    distances = np.linspace(0.02, 0.5, 33)
    plans = [driver.plan(distance) for distance in distances]
    risks = [plan.health["risk"] for plan in plans]
    assert (np.diff(risks) <= 1e-12).all()
    for plan, risk, distance in zip(plans, risks, distances, strict=True):
        assert plan.status is Status.OK
        if risk <= 0.1:
            assert plan.health["intervention"] == Intervention.NONE
            np.testing.assert_array_equal(plan.commands, free.commands)
        elif risk < 0.5:
            assert plan.health["intervention"] == Intervention.SLOWED_COLLISION
            np.testing.assert_allclose(plan.commands[:, :2], (1 - risk) * free.commands[:, :2])
            np.testing.assert_array_equal(plan.commands[:, 2:], free.commands[:, 2:])
        else:
            assert plan.health["intervention"] == Intervention.VETOED_COLLISION
            if not plan.commands[:, :2].any():  # it stops: nothing that was tried is safe
                continue
            assert driver.compute_clearance(plan, distance) > -0.001
    assert risks[0] > 0.99
    assert risks[-1] < 0.01


@pytest.mark.slow
def test_some_are_slowed_before_they_are_vetoed():
    seen = set()
    for speed in (0.3, 1.0):
        driver = Driver(speed)
        for distance in np.linspace(0.08, 0.4, 65):
            seen.add(Intervention(int(driver.plan(distance).health["intervention"])))
        driver.close()
    assert seen == {
        Intervention.NONE,
        Intervention.SLOWED_COLLISION,
        Intervention.VETOED_COLLISION,
    }


def test_what_cannot_be_avoided_is_braked_for():
    """From 1 m/s the wheels need 0.33 m: at 4 cm all samples touch, and it is told to stop."""
    driver = Driver(1.0)
    plan = driver.plan(0.04)
    assert plan.health["risk"] == pytest.approx(1.0)
    np.testing.assert_array_equal(plan.commands[:, :2], 0)
    driver.close()


def test_without_the_intervention_the_plan_stays_and_its_risk_is_still_told():
    driver = Driver(1.0)
    bare = {
        mode: dataclasses.replace(config, aids=tuple(set(config.aids) - {"intervention"}))
        for mode, config in driver.retargeter.configs.items()
    }
    driver.retargeter.configure(bare)
    free, plan = driver.plan(5.0), driver.plan(0.04)
    assert plan.health["intervention"] == Intervention.NONE
    assert plan.health["risk"] == pytest.approx(1.0)
    np.testing.assert_array_equal(plan.commands, free.commands)
    driver.close()


def lean(morphology, roll: float) -> np.ndarray:
    qpos = morphology.standing_qpos()
    qpos[2] -= 0.05
    qpos[3:7] = quat_from_rpy(roll, 0.0, 0.0)
    return qpos


@pytest.mark.parametrize("roll, intervention", [(0.0, "NONE"), (0.7, "VETOED_FALL")])
def test_a_robot_that_tips_over_is_told_of(roll, intervention):
    """G1 far beyond its balance: whatever is tried, it falls, so it is told to stop."""
    morphology = make_morphology("g1")
    loop = PolicyLoop(morphology, Simulation(morphology, kind="planning"), make_policy("default"))
    loop.reset(0, settle_s=0.2)
    state = loop.state
    if roll:
        qvel = np.zeros_like(state.qvel)
        qvel[3] = 4.0  # it rolls over
        state = dataclasses.replace(state, qpos=lean(morphology, roll), qvel=qvel)
    retargeter = MpcRetargeter(
        morphology,
        make_policy("default"),
        build_model(morphology, "planning"),
        RetargeterConfig(threads=1),
    )
    retargeter.reset(state)
    pose = retargeter.problem.readings.compute_poses(loop.state.qpos, {"head": "head"})["head"]
    pose[0] += 0.5
    plan = retargeter.plan(state, Goal({"head": pose}, mode=Mode.MOBILE))
    assert plan.health["intervention"] == Intervention[intervention]
    assert plan.status is Status.OK
    if roll:
        assert plan.health["risk"] == pytest.approx(1.0)
        np.testing.assert_allclose(plan.command[-3:], 0, atol=1e-9)
        assert plan.cost["fall"] > 0
    retargeter.close()
    loop.close()
