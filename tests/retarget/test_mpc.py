"""The controller as a whole: small goals are reached, the same seed gives the same plan."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.core.transforms import quat_from_yaw, quat_multiply, quat_rotate, rotation_error
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.morphology.rby1 import RBY1
from xop_lerobot.morphology.scene import add_block, add_floor, build_model
from xop_lerobot.morphology.sensing import add_sensing
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.candidates import Intervention
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.factory import make_retargeter
from xop_lerobot.retarget.horizon_goals import preview
from xop_lerobot.retarget.model.kinematics import SiteKinematics
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.plan import Plan, Status

POLICIES = {"g1": "default", "rby1": "diff_drive"}
SMALL = RetargeterConfig(num_samples=8, horizon=4, threads=1)
robots = pytest.mark.parametrize("name", list(POLICIES))
modes = pytest.mark.parametrize("mode", list(Mode))


class Bench:
    """A robot in simulation, its retargeter, and where its head is."""

    def __init__(
        self,
        morphology: Morphology,
        config: RetargeterConfig = SMALL,
        model: mujoco.MjModel | None = None,
    ) -> None:
        policy = make_policy(POLICIES[morphology.name])
        self.morphology = morphology = morphology.fit(policy)
        model = model or build_model(morphology, "planning")
        plant = Simulation(morphology, SimulationConfig(), kind="planning")
        self.loop = PolicyLoop(morphology, plant, policy)
        self.loop.reset(seed=0, settle_s=0.4)
        self.retargeter = make_retargeter(config, morphology, policy, model)
        assert isinstance(self.retargeter, MpcRetargeter)
        self.site = morphology.frames["head"]
        self.kinematics = SiteKinematics(model, (self.site,))
        self.start = self.head
        self.retargeter.reset(self.loop.state)

    @property
    def head(self) -> np.ndarray:
        return self.kinematics.compute_poses(self.loop.state.true_qpos)[self.site]

    def make_goal(self, mode: Mode, offset, yaw: float = 0.0, **fields) -> Goal:
        """The head `offset` away from where it was at first, and turned by `yaw`."""
        pose = self.start.copy()
        pose[:3] += offset
        pose[3:] = quat_multiply(quat_from_yaw(yaw), pose[3:])
        return Goal({"head": pose}, mode=mode, **fields)

    def tick(self, goal: Goal, dt: float = 0.04) -> Plan:
        plan = self.retargeter.plan(self.loop.state, goal)
        self.loop.execute(RobotAction(plan.command, goal.mode, self.loop.action.arms), dt)
        return plan

    def drive(self, goal: Goal, seconds: float) -> np.ndarray:
        """Distance and angle to the goal after every tick. Shape (ticks, 2)."""
        errors = []
        for _ in range(round(seconds / 0.04)):
            self.tick(goal)
            head, wanted = self.head, goal.poses["head"]
            turn = rotation_error(wanted[3:], head[3:])
            errors.append([np.linalg.norm(head[:3] - wanted[:3]), np.linalg.norm(turn)])
        assert not self.loop.state.fallen
        return np.array(errors)

    def close(self) -> None:
        self.retargeter.close()
        self.loop.close()


@pytest.fixture
def bench():
    """Makes benches and closes them."""
    made: list[Bench] = []

    def make(name: str, **settings) -> Bench:
        config = dataclasses.replace(SMALL, **settings)
        made.append(Bench(make_morphology(name), config))
        return made[-1]

    yield make
    for each in made:
        each.close()


# -- closed loop ---------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, mode, offset, yaw, seconds, distance, angle",
    [
        ("g1", Mode.STATIONARY, (0.02, 0, -0.10), 0.0, 3, 0.07, 0.15),
        ("g1", Mode.STATIONARY, (0, 0, 0), 0.4, 2, 0.04, 0.15),
        ("g1", Mode.MOBILE, (0.4, 0, 0), 0.0, 4, 0.10, 0.25),
        ("rby1", Mode.STATIONARY, (0.04, 0, -0.10), 0.0, 3, 0.03, 0.08),
        ("rby1", Mode.STATIONARY, (0, 0, 0), 0.4, 2, 0.03, 0.08),
        ("rby1", Mode.MOBILE, (0.5, 0, 0), 0.0, 4, 0.05, 0.08),
        ("rby1", Mode.MOBILE, (0.3, 0.2, 0), 0.6, 5, 0.10, 0.15),
    ],
)
def test_a_small_goal_is_reached(bench, name, mode, offset, yaw, seconds, distance, angle):
    b = bench(name)
    errors = b.drive(b.make_goal(mode, offset, yaw), seconds)
    quarter = len(errors) // 4
    first, last = errors[:3].mean(0), errors[-quarter:].mean(0)
    assert last[0] < distance
    assert last[1] < angle
    # What the goal is about, place or heading, gets clearly better on the way.
    about = 1 if yaw and not any(offset) else 0
    assert last[about] < 0.6 * first[about]
    assert last[about] < errors[quarter : 2 * quarter, about].mean() + 0.02


@pytest.mark.slow
@robots
@modes
def test_at_the_goal_the_robot_stays(bench, name, mode):
    b = bench(name)
    errors = b.drive(b.make_goal(mode, (0, 0, 0)), 2)
    assert errors[:, 0].max() < (0.12 if name == "g1" else 0.03)


@pytest.mark.slow
def test_a_goal_out_of_reach_is_followed_as_far_as_is_safe(bench):
    b = bench("g1")
    b.drive(b.make_goal(Mode.STATIONARY, (0, 0, -0.7)), 3)
    assert 0.4 < b.loop.state.qpos[2] < 0.62


@pytest.mark.slow
def test_a_moving_goal_is_followed_more_closely_when_its_velocity_is_known(bench):
    lags = []
    for known in (True, False):
        b = bench("rby1")
        speed, lag = 0.4, []
        for tick in range(75):
            velocity = {"head": np.array([speed, 0, 0, 0, 0, 0.0])} if known else {}
            goal = b.make_goal(Mode.MOBILE, (speed * tick * 0.04, 0, 0), velocities=velocity)
            b.tick(goal)
            lag.append(np.linalg.norm(b.head[:2] - goal.poses["head"][:2]))
        lags.append(np.mean(lag[25:]))
    assert lags[0] < 0.6 * lags[1]


class GuardedRby1(RBY1):
    """RB-Y1 with one point on its hull."""

    hull_points = {RBY1.frames["head"]: 0.3}


@pytest.fixture(scope="module")
def walled() -> tuple[Morphology, mujoco.MjModel, float]:
    """A robot, its model with a wall 0.9 m ahead of its head, and where the wall is."""
    morphology = GuardedRby1()
    spec = morphology.build_spec("planning")
    add_sensing(spec, morphology)
    add_floor(spec, seen=False)
    heads = SiteKinematics(spec.compile(), ("head",)).compute_poses(morphology.standing_qpos())
    wall = float(heads["head"][0]) + 0.9
    add_block(spec, "wall", (wall + 0.05, 0, 1), (0.05, 3, 1), (1, 1, 1, 1))
    return morphology, spec.compile(), wall


@pytest.mark.slow
def test_a_wall_shows_in_the_cost(walled):
    """Seen, it costs more the nearer it is, and keeps the robot further away."""
    morphology, model, wall = walled
    costs, distances = [], []
    for seen in (model, None):
        b = Bench(morphology, SMALL, seen)
        goal = b.make_goal(Mode.MOBILE, (0.8, 0, 0))
        plans = [b.tick(goal) for _ in range(25)]
        costs.append(max(plan.cost["collision"] for plan in plans))
        distances.append(wall - b.head[0])
        b.close()
    assert costs[0] > 0.02
    assert costs[1] == 0
    assert distances[0] > distances[1] + 0.05


def test_a_wall_before_the_goal_is_not_driven_into(walled):
    morphology, model, wall = walled
    b = Bench(morphology, SMALL, model)
    goal = b.make_goal(Mode.MOBILE, (0.8, 0, 0))
    clearances = []
    for _ in range(40):
        b.tick(goal)
        clearances.append(wall - b.head[0] - 0.3)
    b.close()
    assert min(clearances) > 0


# -- determinism ---------------------------------------------------------------------------


def run(b: Bench, ticks: int = 6, mode: Mode = Mode.MOBILE) -> list[np.ndarray]:
    goal = b.make_goal(mode, (0.2, 0.1, -0.05), 0.2)
    return [b.tick(goal).commands for _ in range(ticks)]


@pytest.mark.slow
@robots
@modes
def test_same_seed_same_plans(bench, name, mode):
    first, same, other = (run(bench(name, seed=seed), mode=mode) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, same)
    assert (np.array(first) != np.array(other)).any()


@pytest.mark.slow
@robots
@modes
def test_threads_do_not_change_the_plan(bench, name, mode):
    one, two = (run(bench(name, threads=threads), 3, mode) for threads in (1, 2))
    np.testing.assert_array_equal(one, two)


def test_reset_starts_the_samples_anew(bench):
    b = bench("rby1")
    state, goal = b.loop.state, b.make_goal(Mode.MOBILE, (0.2, 0, 0))
    first = b.retargeter.plan(state, goal).commands
    second = b.retargeter.plan(state, goal).commands
    b.retargeter.reset(state)
    np.testing.assert_array_equal(b.retargeter.plan(state, goal).commands, first)
    assert (first != second).any()


# -- what a plan holds ---------------------------------------------------------------------


@robots
@modes
def test_a_plan_is_complete(bench, name, mode):
    b = bench(name)
    plan = b.tick(b.make_goal(mode, (0.1, 0, 0)))
    space = b.morphology.command_space
    assert plan.commands.shape == (4, len(space))
    np.testing.assert_array_equal(plan.command, plan.commands[0])
    assert (plan.commands >= space.low).all()
    assert (plan.commands <= space.high).all()
    assert plan.qpos.shape == (5, len(b.loop.state.qpos))
    assert plan.status is Status.OK
    assert plan.mode is mode
    assert tuple(plan.cost) == b.retargeter.cost_names
    assert all(np.isfinite(value) and value >= 0 for value in plan.cost.values())
    assert 1 <= plan.effective_samples <= 8
    parts = ("proposal", "rollout", "cost")
    assert sum(plan.timings[part] for part in parts) == pytest.approx(plan.timings["solve"])


@pytest.mark.parametrize("mode", list(Mode))
def test_the_plan_is_what_the_robot_then_does(bench, mode):
    """One sample is the standing plan alone; the plant is the planning model."""
    b = bench("g1", num_samples=1, horizon=8)
    walking = b.make_goal(Mode.MOBILE, (0.3, 0, 0))
    for _ in range(3):
        b.tick(walking)
    plan = b.retargeter.plan(b.loop.state, b.make_goal(mode, (0.1, 0, 0)))
    arms = b.loop.action.arms
    for k in range(8):
        executed = b.loop.execute(RobotAction(plan.commands[k], mode, arms), POLICY_DT)
        np.testing.assert_array_equal(executed.command, plan.commands[k])
        np.testing.assert_allclose(b.loop.state.qpos, plan.qpos[k + 1], rtol=0, atol=1e-9)


@pytest.mark.slow
@robots
def test_stationary_plans_sway_at_most(bench, name):
    b = bench(name)
    goal = b.make_goal(Mode.STATIONARY, (0.5, 0.5, 0), 0.5)
    plans = [b.tick(goal) for _ in range(60)]
    space = b.morphology.command_space
    assert (np.abs(plans[-1].commands) <= space.sway)[:, space.mobile_only].all()
    assert not b.loop.state.fallen


@pytest.mark.slow
@robots
def test_a_change_of_mode_makes_no_step(bench, name):
    """Whatever is planned, the robot's command moves at its rate; and it comes to rest."""
    b = bench(name)
    space = b.morphology.command_space
    goals = {mode: b.make_goal(mode, (0.5, 0, -0.05), 0.3) for mode in Mode}
    previous = b.loop.action.command
    for tick in range(40):
        mode = Mode.MOBILE if 10 <= tick < 25 else Mode.STATIONARY
        plan = b.tick(goals[mode])
        assert plan.mode is mode
        assert np.isfinite(plan.commands).all()
        command = b.loop.action.command
        # Actions are rounded to single precision.
        assert (np.abs(command - previous) <= space.max_rate * 0.04 + 1e-6).all()
        previous = command
    assert (np.abs(previous) <= space.sway + 1e-6)[space.mobile_only].all()
    assert not b.loop.state.fallen


def test_no_goal_is_no_motion(bench):
    b = bench("rby1")
    plan = b.retargeter.plan(b.loop.state, Goal({}, mode=Mode.MOBILE))
    assert plan.status is Status.OK
    np.testing.assert_allclose(plan.command[:2], 0, atol=0.1)


# -- when the state is no state ------------------------------------------------------------


def spoil(state: RobotState, index: int) -> RobotState:
    qpos = state.qpos.copy()
    qpos[index] = np.nan
    return dataclasses.replace(state, qpos=qpos)


@robots
def test_a_state_that_is_not_finite_is_reported(bench, name):
    b = bench(name)
    goal = b.make_goal(Mode.STATIONARY, (0, 0, -0.05))
    b.tick(goal)
    plan = b.retargeter.plan(spoil(b.loop.state, 9), goal)
    assert plan.status is Status.DIVERGED
    b.retargeter.reset(b.loop.state)
    assert b.tick(goal).status is Status.OK


@robots
def test_a_diverged_plan_brakes_and_keeps_the_posture(bench, name):
    b = bench(name)
    goal = b.make_goal(Mode.MOBILE, (0.1, 0, 0))
    b.tick(goal)
    state, velocities = b.loop.state, b.retargeter.command_model.is_velocity()
    plan = b.retargeter.plan(spoil(state, 0), goal)
    expected = np.where(velocities[: len(state.command)], 0, state.command)
    np.testing.assert_allclose(plan.command, expected, atol=1e-9)
    assert plan.health == {"intervention": Intervention.DIVERGED, "risk": 1.0}


# -- settings ------------------------------------------------------------------------------


def test_settings_override_the_robots_own_parameters(bench):
    own = make_morphology("g1").mpc_config(Mode.MOBILE)
    b = bench("g1", num_samples=5, horizon=0, control_hz=50.0)
    config = b.retargeter.configs[Mode.MOBILE]
    assert (config.num_samples, config.horizon, config.control_hz) == (5, own.horizon, 50.0)
    assert b.retargeter.control_period(Mode.MOBILE) == 0.02


def test_an_unknown_frame_lists_the_known_ones():
    morphology = make_morphology("rby1")
    model = build_model(morphology, "planning")
    morphology.frames = {"head": "nose"}
    with pytest.raises(UnknownName, match="^unknown site 'nose'. Known: "):
        MpcRetargeter(morphology, make_policy("diff_drive"), model, SMALL)


def test_it_may_be_closed_twice(bench):
    b = bench("rby1", threads=2)
    b.retargeter.close()


def test_the_goal_is_carried_on_at_its_velocity(bench):
    """Slow reference of the preview: constant velocity up to `preview_s`, then it stands."""
    b = bench("rby1")
    velocity = np.array([0.3, -0.2, 0.1, 0, 0, 0.5])
    goal = b.make_goal(Mode.MOBILE, (0, 0, 0), velocities={"head": velocity})
    config = b.retargeter.configs[Mode.MOBILE]
    times = np.array([0.0, 0.1, config.preview_s, 5.0])
    poses = preview(goal, ("head",), times, config.preview_s)["head"]
    start = goal.poses["head"]
    for time, pose in zip(times, poses, strict=True):
        held = min(time, config.preview_s)
        np.testing.assert_allclose(pose[:3], start[:3] + held * velocity[:3])
        ahead = quat_rotate(pose[3:], np.array([1.0, 0, 0]))
        expected = quat_rotate(
            quat_from_yaw(0.5 * held), quat_rotate(start[3:], np.array([1.0, 0, 0]))
        )
        np.testing.assert_allclose(ahead, expected, atol=1e-9)


class ManyKnots(RBY1):
    """RB-Y1 with several knots, and noise where nothing may act."""

    def mpc_config(self, mode: Mode) -> MpcConfig:
        noise = {"v": 0.2, "torso_5": 0.1}
        return MpcConfig(num_samples=6, horizon=10, noise_std=noise, num_knots=4)


@pytest.fixture
def many_knots():
    b = Bench(ManyKnots(), RetargeterConfig(threads=1))
    yield b
    b.close()


def test_noise_on_what_does_not_act_is_masked(many_knots):
    plan = many_knots.tick(many_knots.make_goal(Mode.STATIONARY, (0.5, 0, 0), 0.5))
    np.testing.assert_array_equal(plan.commands[:, :2], 0)
    turning = many_knots.morphology.command_space.index("torso_5")
    assert np.ptp(plan.commands[:, turning]) > 0  # several knots: it varies over the horizon


def test_a_plan_goes_on_where_the_last_one_was(many_knots):
    """The standing plan is shifted by the time that has passed on the robot's clock."""
    b = many_knots
    planner = b.retargeter._planners[Mode.MOBILE].optimizer
    goal = b.make_goal(Mode.MOBILE, (0.1, 0, 0), 0.2)
    b.tick(goal)  # two control steps pass
    planner.knots = planner.knots + 0.1 * np.arange(4)[:, None]
    before, sampled = planner.commands, []
    sample = planner.sample

    def watch(*args):
        sampled.append(sample(*args))
        return sampled[-1]

    planner.sample = watch
    b.tick(goal)
    shifted = sampled[0].commands[0]  # the first sample is the standing plan
    # At the knots, that is; between them the kernel of four knots ripples.
    np.testing.assert_allclose(shifted[[0, 3, 6], 0], before[[2, 5, 8], 0], atol=1e-9)
    assert np.abs(before[2:9, 0] - before[:7, 0]).max() > 0.05


def test_a_goal_that_runs_away_is_held_near(bench):
    b = bench("g1")
    reach = b.retargeter.configs[Mode.MOBILE].reach
    commands = []
    for distance in (reach + 0.01, 50.0):
        b.retargeter.reset(b.loop.state)
        goal = b.make_goal(Mode.MOBILE, (distance, 0, 0))
        commands.append(b.retargeter.plan(b.loop.state, goal).command)
    np.testing.assert_allclose(commands[0], commands[1], atol=1e-6)


# -- the documentation ---------------------------------------------------------------------


def test_the_documented_parameters_are_the_real_ones():
    """Table of the parameters in the retargeter's page: a row each, G1 and RB-Y1, both modes."""
    text = (Path(__file__).parents[2] / "docs" / "how_it_works" / "retargeter.md").read_text()
    configs = [make_morphology(name).mpc_config(mode) for name in POLICIES for mode in Mode]
    seen = 0
    for row in text.splitlines():
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        if not row.startswith("| `") or len(cells) != 5:
            continue
        path = cells[0].split("`")[1].split(".")
        for config, cell in zip(configs, cells[1:], strict=True):
            value = config
            for name in path:
                value = getattr(value, name)
            assert float(cell) == value, f"retargeter.md: {cells[0]} of {config}"
            seen += 1
    assert seen >= 24
