"""The kinematic proposal and the command model it inverts."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.core.transforms import (
    heading_error,
    make_pose,
    quat_exp,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    quat_yaw,
    rotation_error,
)
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.g1.mpc import WALKING_LEAN
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.costs import SupportArea
from xop_lerobot.retarget.decision import DecisionSpace
from xop_lerobot.retarget.direct import DirectRetargeter
from xop_lerobot.retarget.model.command_model import CommandModel, Start
from xop_lerobot.retarget.model.heading import linearise_heading
from xop_lerobot.retarget.model.kinematics import SiteKinematics
from xop_lerobot.retarget.model.linearisation import Placement
from xop_lerobot.retarget.model.proposal import KinematicProposal, ProposalWeights

ROBOTS = ("g1", "rby1")
DT = 0.6
robots = pytest.mark.parametrize("name", ROBOTS)
modes = pytest.mark.parametrize("mode", list(Mode))


class Parts:
    """A robot and its proposal."""

    def __init__(self, name: str) -> None:
        self.morphology = make_morphology(name)
        self.model = self.morphology.build_spec("planning").compile()
        self.space = self.morphology.command_space
        self.qpos = self.morphology.standing_qpos()
        self.command_model = CommandModel(
            self.model, self.space, self.morphology.effects, self.morphology.pivot
        )
        self.body = np.array([not effect.neck for effect in self.morphology.effects])
        self.head = self.morphology.frames["head"]
        self.kinematics = SiteKinematics(self.model, (self.head,))
        self.proposal = self.make()

    def make(self, **settings) -> KinematicProposal:
        settings.setdefault("base_body", self.morphology.base_body)
        return KinematicProposal(self.model, self.command_model, {"head": self.head}, **settings)

    def solve(self, goals: dict, mode: Mode, dt: float, *, drift=None, **how) -> np.ndarray:
        return self.proposal.solve(Start(self.qpos, drift=drift), goals, mode, dt, **how).command

    def reach(self, command: np.ndarray, mode: Mode, dt: float = DT, drift=None) -> np.ndarray:
        """Where the head of an ideal robot is after `dt` of a command."""
        future = self.command_model.extrapolate(Start(self.qpos, drift=drift), command, dt, mode)
        return self.kinematics.compute_poses(future)[self.head]

    def draw(self, rng: np.random.Generator, mode: Mode, share: float = 0.3) -> np.ndarray:
        """A command around neutral, within the bounds, that acts in `mode`, the neck straight."""
        scale = share * (self.space.high - self.space.low)[self.body] / 2
        command = self.space.neutral.copy()
        command[self.body] += scale * rng.uniform(-1, 1, len(scale))
        command = np.clip(command, self.space.low, self.space.high)
        return np.where(self.command_model.acting(mode), command, self.space.neutral)


@pytest.fixture(scope="module")
def parts() -> dict[str, Parts]:
    return {name: Parts(name) for name in ROBOTS}


def measure_error(pose: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    turn = rotation_error(goal[3:], pose[3:])
    return float(np.linalg.norm(pose[:3] - goal[:3])), float(np.linalg.norm(turn))


# -- the command model ---------------------------------------------------------------------


def test_the_base_moves_along_the_arc_of_its_twist(parts):
    """Slow twin: the twist integrated in small steps."""
    model, qpos = parts["g1"].command_model, parts["g1"].qpos.copy()
    qpos[3:7] = quat_from_yaw(0.7)
    command = parts["g1"].space.neutral.copy()
    command[-3:] = 0.5, -0.2, 0.8
    x, y, yaw, steps = qpos[0], qpos[1], 0.7, 2000
    for _ in range(steps):
        x += (0.5 * np.cos(yaw) + 0.2 * np.sin(yaw)) * DT / steps
        y += (0.5 * np.sin(yaw) - 0.2 * np.cos(yaw)) * DT / steps
        yaw += 0.8 * DT / steps
    got = model.extrapolate(Start(qpos), command, DT, Mode.MOBILE)
    np.testing.assert_allclose(got[:2], [x, y], atol=0.005)
    assert quat_yaw(got[3:7]) == pytest.approx(yaw)


def test_a_pivot_ahead_of_the_base_stays_where_it_is(parts):
    rby1 = parts["rby1"]
    command = rby1.space.neutral.copy()
    command[rby1.space.index("yaw_rate")] = 1.0
    qpos = rby1.qpos.copy()
    qpos[3:7] = quat_from_yaw(-1.1)

    def axle(q: np.ndarray) -> np.ndarray:
        return q[:3] + quat_rotate(q[3:7], np.array([rby1.morphology.pivot, 0, 0]))

    got = rby1.command_model.extrapolate(Start(qpos), command, 0.8, Mode.MOBILE)
    np.testing.assert_allclose(axle(got), axle(qpos), atol=1e-12)
    assert quat_yaw(got[3:7]) == pytest.approx(-0.3)


@robots
@modes
def test_heights_and_joints_follow_with_their_lag(parts, name, mode):
    p = parts[name]
    command = p.draw(np.random.default_rng(0), mode)
    got = p.command_model.extrapolate(Start(p.qpos), command, 0.2, mode)
    for i, effect in enumerate(p.morphology.effects):
        if p.command_model.is_velocity()[i] or not p.command_model.acting(mode)[i]:
            continue
        address = 2 if not effect.joint else int(p.model.joint(effect.joint).qposadr[0])
        expected = command[i] + (p.qpos[address] - command[i]) * np.exp(-0.2 / effect.lag_s)
        assert got[address] == pytest.approx(expected)


@robots
def test_the_neutral_command_leaves_place_and_heading_alone(parts, name):
    p = parts[name]
    got = p.command_model.extrapolate(Start(p.qpos), p.space.neutral, 2.0, Mode.MOBILE)
    np.testing.assert_allclose(got[:2], p.qpos[:2], atol=1e-12)
    np.testing.assert_allclose(got[3:7], p.qpos[3:7], atol=1e-12)


@robots
@modes
def test_a_batch_equals_one_at_a_time(parts, name, mode):
    p, rng = parts[name], np.random.default_rng(1)
    commands = np.stack([p.draw(rng, mode) for _ in range(4)])
    batch = p.command_model.extrapolate(Start(p.qpos), commands, 0.3, mode)
    for row, command in zip(batch, commands, strict=True):
        np.testing.assert_array_equal(
            row, p.command_model.extrapolate(Start(p.qpos), command, 0.3, mode)
        )


@robots
def test_in_stationary_mode_velocities_sway_or_do_nothing(parts, name):
    model = parts[name].command_model
    acting = model.acting(Mode.STATIONARY) & model.is_velocity()
    np.testing.assert_array_equal(acting, parts[name].space.sway > 0)
    assert (model.acting(Mode.MOBILE) & model.is_velocity()).any()


def test_a_sway_shifts_the_base_and_stops(parts):
    """From where it stands under one velocity to where it comes to stand under another."""
    p = parts["g1"]
    qpos = p.qpos.copy()
    qpos[3:7] = quat_from_yaw(np.pi / 2)
    settled, command = p.space.neutral.copy(), p.space.neutral.copy()
    settled[4], command[4] = 0.1, 0.2
    gain = p.morphology.effects[4].sway_s
    for dt, share in ((0.3, 1 - np.exp(-1)), (10.0, 1.0)):
        got = p.command_model.extrapolate(
            Start(qpos, settled=settled), command, dt, Mode.STATIONARY
        )
        np.testing.assert_allclose(got[:2] - qpos[:2], [0, 0.1 * gain * share], atol=1e-5)
    stays = p.command_model.extrapolate(
        Start(qpos, settled=settled), settled, 10.0, Mode.STATIONARY
    )
    np.testing.assert_allclose(stays[:2], qpos[:2], atol=1e-12)


def test_the_policy_sways_as_its_effects_say(parts):
    """The command model's displacement against the robot's, standing, to a third of it."""
    p = parts["g1"]
    loop = PolicyLoop(p.morphology, Simulation(p.morphology), make_policy("default"))
    places = []
    for velocity in (0.0, 0.15):
        loop.reset(seed=0)
        command = p.space.neutral.copy()
        command[4] = velocity
        for _ in range(75):
            loop.execute(dataclasses.replace(loop.action, command=command), 0.04)
        places.append(loop.state.true_qpos[:2])
        assert not loop.state.fallen
    loop.close()
    moved = places[1] - places[0]
    assert moved[0] == pytest.approx(velocity * p.morphology.effects[4].sway_s, rel=0.33)
    assert abs(moved[1]) < 0.01


# -- the proposal --------------------------------------------------------------------------


@robots
@modes
def test_it_recovers_what_the_goal_was_made_with(parts, name, mode):
    """Commands are redundant, so the head's pose is compared, not the command."""
    p = parts[name]
    for seed in range(5):
        wanted = p.draw(np.random.default_rng(seed), mode)
        goal = p.reach(wanted, mode)
        far = measure_error(p.reach(p.space.neutral, mode), goal)
        got = p.solve({"head": goal}, mode, DT, free=p.command_model.acting(mode) & p.body)
        near = measure_error(p.reach(got, mode), goal)
        # The effort keeps it a little short of the goal.
        assert near[0] < max(0.1 * far[0], 0.01)
        assert near[1] < max(0.15 * far[1], 0.05)


def look(yaw: float, pitch: float, home: np.ndarray) -> np.ndarray:
    """Pose of a head at its place that is turned aside and down."""
    return make_pose(home[:3], quat_multiply(quat_from_yaw(yaw), quat_from_rpy(0.0, pitch, 0.0)))


@modes
@pytest.mark.parametrize("aside", [(0.3, 0.0), (0.0, 0.3), (-0.2, -0.2)])
def test_a_neck_stays_straight_for_a_head_that_looks_ahead(parts, mode, aside):
    """It does not turn against the chest, to move the head by some centimetres."""
    p = parts["rby1"]
    goal = p.reach(p.space.neutral, mode)
    goal[:2] += aside
    got = p.solve({"head": goal}, mode, DT)
    np.testing.assert_allclose(got[~p.body], 0, atol=1e-9)


@pytest.mark.parametrize("pitch", [0.0, 0.4])
@pytest.mark.parametrize("aside", [(0.6, 0.0, 0.0), (0.0, 0.0, -0.2), (0.0, 0.4, 0.0)])
def test_a_walking_waist_bends_little_beyond_the_head_of_the_operator(parts, aside, pitch):
    """It bows neither to one who is ahead of it nor to one who crouches, as a standing one does."""
    p = parts["g1"]
    home = p.reach(p.space.neutral, Mode.MOBILE)
    goal = look(0.0, pitch, home)
    goal[:3] += aside
    names = p.space.names
    roll, bow = names.index("waist_roll"), names.index("waist_pitch")
    got = p.solve({"head": goal}, Mode.MOBILE, 0.2)
    assert abs(got[roll]) <= WALKING_LEAN + 1e-9
    assert -WALKING_LEAN - 1e-9 <= got[bow] <= pitch + WALKING_LEAN + 1e-9
    standing = p.command_model.limit_gaze(
        (p.space.low, p.space.high), goal, p.qpos[:7], Mode.STATIONARY
    )
    np.testing.assert_array_equal(standing, (p.space.low, p.space.high))


@pytest.mark.parametrize(
    "turn, least, most", [(1.7, 0.0, 1.57), (-1.2, -1.2, 0.0), (3.0, -1.57, 1.57)]
)
def test_a_neck_turns_to_either_side_only_for_a_goal_behind_the_robot(parts, turn, least, most):
    p = parts["rby1"]
    bounds = (p.space.low, p.space.high)
    base = p.qpos[:7]
    low, high = p.command_model.limit_gaze(bounds, look(turn, 0.3, base), base, Mode.MOBILE)
    i, j = p.space.index("head_0"), p.space.index("head_1")
    assert (low[i], high[i]) == pytest.approx((least, most))
    assert (low[j], high[j]) == pytest.approx((0.0, 0.3))
    np.testing.assert_array_equal(low[p.body], p.space.low[p.body])


@robots
@modes
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_bounds_hold_and_what_does_not_act_stays_neutral(name, mode, seed, parts):
    p, rng = parts[name], np.random.default_rng(seed)
    goal = p.reach(p.space.neutral, mode)
    goal[:3] += rng.uniform(-3, 3, 3)
    goal[3:] = quat_multiply(quat_from_yaw(rng.uniform(-3, 3)), goal[3:])
    start = rng.uniform(p.space.low, p.space.high)
    got = p.solve({"head": goal}, mode, DT, start=start)
    assert (got >= p.space.low).all()
    assert (got <= p.space.high).all()
    rest = ~p.command_model.acting(mode)
    np.testing.assert_array_equal(got[rest], p.space.neutral[rest])


@robots
def test_stationary_leaves_the_velocities_neutral(parts, name):
    p = parts[name]
    goal = p.reach(p.space.neutral, Mode.STATIONARY)
    goal[0] += 1.0
    got = p.solve({"head": goal}, Mode.STATIONARY, DT)
    velocities = p.command_model.is_velocity() & (p.space.sway == 0)
    np.testing.assert_array_equal(got[velocities], p.space.neutral[velocities])


@robots
@modes
def test_it_beats_random_commands(parts, name, mode):
    """At goals within reach and beyond it, by its own least squares."""
    p, rng = parts[name], np.random.default_rng(3)
    scale = p.proposal.scale
    effort = p.proposal.weights.effort * np.array([e.effort for e in p.morphology.effects])

    def compute_objective(commands: np.ndarray, goal: np.ndarray) -> np.ndarray:
        future = p.command_model.extrapolate(Start(p.qpos), commands, DT, mode)
        poses = p.kinematics.compute_poses(future)[p.head]
        error = np.square(poses[:, :3] - goal[:3]).sum(1)
        error += np.square(0.4 * heading_error(goal[3:], poses[:, 3:])).sum(1)
        return error + np.square(effort * (commands - p.space.neutral) / scale).sum(1)

    for _ in range(5):
        goal = p.reach(p.draw(rng, mode, 0.6), mode)
        goal[:3] += rng.uniform(-0.2, 0.2, 3)
        got = p.solve({"head": goal}, mode, DT)
        others = np.stack([p.draw(rng, mode, 1.0) for _ in range(500)])
        assert compute_objective(got[None], goal)[0] <= compute_objective(others, goal).min()


@robots
@modes
def test_more_iterations_do_not_move_it(parts, name, mode):
    """Four Gauss-Newton steps have converged: the Jacobian leads where it should."""
    p = parts[name]
    goal = p.reach(p.draw(np.random.default_rng(5), mode), mode)
    few, many = (
        p.make(iterations=count).solve(Start(p.qpos), {"head": goal}, mode, DT).command
        for count in (4, 40)
    )
    np.testing.assert_allclose(few, many, atol=0.02)


def test_a_known_drift_is_walked_against(parts):
    p, drift = parts["g1"], np.array([-0.1, 0.05, 0.1])
    goal = p.reach(p.space.neutral, Mode.MOBILE)
    got = p.solve({"head": goal}, Mode.MOBILE, DT, drift=drift)
    twist = p.command_model.compute_twist(got)
    np.testing.assert_allclose(twist, -drift, atol=0.03)


def test_the_centre_of_mass_stays_over_the_support_area(parts):
    p = parts["rby1"]
    area = SupportArea(p.morphology.support)
    goal = p.reach(p.space.neutral, Mode.STATIONARY)
    goal[0] += 0.6  # lean far ahead

    def compute_excess(support: SupportArea | None) -> float:
        got = (
            p.make(support=support)
            .solve(Start(p.qpos), {"head": goal}, Mode.STATIONARY, DT)
            .command
        )
        future = p.command_model.extrapolate(Start(p.qpos), got, DT, Mode.STATIONARY)
        com = Placement(p.model, (), (), p.morphology.base_body).compute(future[None])[2][0]
        return float(area.compute_excess(future[:7], com[:2]).max())

    assert compute_excess(None) > 0.05
    assert compute_excess(area) < 0.01


def test_entries_that_are_not_free_stay_neutral(parts):
    p = parts["g1"]
    goal = p.reach(p.space.neutral, Mode.STATIONARY)
    goal[2] -= 0.1
    free = np.zeros(len(p.space), dtype=bool)
    free[p.space.index("height")] = True
    got = p.solve({"head": goal}, Mode.STATIONARY, DT, free=free)
    assert got[0] < 0.72
    np.testing.assert_array_equal(got[1:], p.space.neutral[1:])


@robots
def test_without_goals_it_is_where_it_starts(parts, name):
    p = parts[name]
    start = p.draw(np.random.default_rng(0), Mode.MOBILE)
    np.testing.assert_array_equal(p.solve({}, Mode.MOBILE, DT, start=start), start)


def test_a_dear_entry_is_used_less(parts):
    p = parts["g1"]
    goal = p.reach(p.space.neutral, Mode.STATIONARY)
    goal[0] += 0.1
    cheap, dear = (
        p.make(weights=ProposalWeights(effort=effort))
        .solve(Start(p.qpos), {"head": goal}, Mode.STATIONARY, DT)
        .command
        for effort in (0.01, 1.0)
    )
    assert np.abs(dear - p.space.neutral)[3:5].max() < np.abs(cheap - p.space.neutral)[3:5].max()


# -- derivatives -----------------------------------------------------------------------------


@robots
@modes
@pytest.mark.parametrize("ramped", [False, True])
def test_the_command_models_derivative_equals_finite_differences(parts, name, mode, ramped):
    p, rng = parts[name], np.random.default_rng(4)
    qpos = p.qpos.copy()
    qpos[3:7] = quat_exp(np.array([0.1, -0.2, 0.7]))
    command, drift = p.draw(rng, mode), np.array([0.05, -0.1, 0.2])
    executed = command + 0.1 * p.space.max_rate * DT * rng.normal(size=len(p.space))
    offset, settled = 0.02 * rng.normal(size=(2, len(p.space)))
    start = Start(qpos, executed if ramped else None, drift, offset, settled)
    future, got = p.command_model.linearise(start, command, DT, mode)
    batch = p.command_model.extrapolate(replace(start, qpos=qpos[None]), command[None], DT, mode)
    np.testing.assert_allclose(future, batch[0], atol=1e-12)
    for i, step in enumerate(1e-6 * np.eye(len(command))):
        ahead, behind = (
            p.command_model.extrapolate(start, command + sign * step, DT, mode) for sign in (1, -1)
        )
        tangent = np.empty(p.model.nv)
        mujoco.mj_differentiatePos(p.model, tangent, 2e-6, behind, ahead)
        np.testing.assert_allclose(got[:, i], tangent, atol=1e-8)


@robots
@modes
def test_the_residuals_derivative_equals_finite_differences(parts, name, mode):
    """With every kind of residual there is, on two frames."""
    p, rng = parts[name], np.random.default_rng(6)
    corners = p.morphology.support or ((0.01, -0.01), (0.01, 0.01), (-0.01, 0.01), (-0.01, -0.01))
    decision = DecisionSpace(p.morphology, p.model)
    model = CommandModel(p.model, decision.space, decision.effects, p.morphology.pivot)
    frames = {frame: p.morphology.frames[frame] for frame in ("head", "left_wrist")}
    proposal = KinematicProposal(
        p.model,
        model,
        frames,
        ProposalWeights(orientation=(0.3, 0.5, 0.7), lean=3.0, lateral=0.4),
        SupportArea(corners, free=0.01, margin=0.0),
        p.morphology.base_body,
    )
    qpos = p.qpos.copy()
    qpos[3:7] = quat_exp(np.array([0.1, -0.2, 0.7]))
    command = decision.space.neutral + 0.1 * rng.normal(size=len(decision.space))
    turn = quat_exp(np.array([0.2, 0.3, 0.5]))
    goals = {frame: np.array([0.5, 0.2, 1.1, *turn]) for frame in frames}

    def linearise(command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        wanted = np.array([0.4, 0.3])
        return proposal.linearise(Start(qpos), command, goals, mode, DT, facing=wanted)

    _, got = linearise(command)
    steps = 1e-6 * np.eye(len(command))
    numeric = [(linearise(command + s)[0] - linearise(command - s)[0]) / 2e-6 for s in steps]
    np.testing.assert_allclose(got, np.transpose(numeric), atol=1e-7)
    assert not np.allclose(got, np.transpose(numeric[::-1]), atol=1e-2)  # a wrong one is caught


@given(st.integers(0, 2**32 - 1))
def test_heading_errors_of_one_orientation_equal_those_of_a_batch(seed):
    rng = np.random.default_rng(seed)
    goal, turn = quat_exp(0.8 * rng.normal(size=3)), quat_exp(0.5 * rng.normal(size=3))
    quat = quat_multiply(turn, goal)
    error, jacobian = linearise_heading(goal, quat)
    np.testing.assert_allclose(error, heading_error(goal, quat), atol=1e-9)
    steps = 1e-6 * np.eye(3)
    numeric = [
        -(
            heading_error(goal, quat_multiply(quat_exp(step), quat))
            - heading_error(goal, quat_multiply(quat_exp(-step), quat))
        )
        / 2e-6
        for step in steps
    ]
    np.testing.assert_allclose(jacobian, np.transpose(numeric), atol=1e-4)


@robots
@modes
def test_at_the_solution_no_free_entry_can_do_better(parts, name, mode):
    """Optimality: the gradient vanishes inside the bounds and points outwards at them."""
    p, rng = parts[name], np.random.default_rng(8)
    for share in (0.3, 1.5):  # within reach, and far beyond it
        goal = p.reach(p.draw(rng, mode, 0.5), mode)
        goal[:2] += share * rng.uniform(-0.5, 0.5, 2)
        proposal = p.make(iterations=60)
        got = proposal.solve(Start(p.qpos), {"head": goal}, mode, DT).command
        residual, jacobian = proposal.linearise(Start(p.qpos), got, {"head": goal}, mode, DT)
        effort = proposal.weights.effort * np.array([e.effort for e in p.morphology.effects])
        scaled = (got - p.space.neutral) / proposal.scale
        gradient = proposal.scale * (jacobian.T @ residual) + effort**2 * scaled
        acting = p.command_model.acting(mode)
        bounds = (p.space.low, p.space.high)
        low, high = p.command_model.limit_gaze(bounds, goal, p.qpos[:7], mode)
        at_low, at_high = got <= low + 1e-9, got >= high - 1e-9
        assert (np.abs(gradient[acting & ~at_low & ~at_high]) < 2e-4).all()
        assert (gradient[acting & at_low] > -2e-4).all()
        assert (gradient[acting & at_high] < 2e-4).all()


# -- the direct baseline -------------------------------------------------------------------


def make_state(p: Parts, qpos: np.ndarray, command: np.ndarray | None = None) -> RobotState:
    rest = p.morphology.rest_action()
    return RobotState(
        time=0.0,
        qpos=qpos,
        qvel=np.zeros(p.model.nv),
        memory=np.zeros(0),
        command=rest.command if command is None else command,
        arms=rest.arms,
        mode=Mode.STATIONARY,
        effort=np.zeros(p.model.nu),
        true_qpos=qpos,
        true_qvel=np.zeros(p.model.nv),
        wall_time=0.0,
    )


def test_direct_maps_the_height_and_ignores_the_place(parts):
    p = parts["g1"]
    direct = DirectRetargeter(p.morphology, p.model)
    state = make_state(p, p.qpos)
    direct.reset(state)
    goal = p.reach(p.space.neutral, Mode.STATIONARY, 2.0)
    goal[2] -= 0.1
    near = direct.plan(state, Goal({"head": goal})).command
    assert near[0] == pytest.approx(p.space.neutral[0] - 0.1, abs=0.02)
    far = goal.copy()
    far[:2] += 5.0
    direct.reset(state)
    np.testing.assert_allclose(direct.plan(state, Goal({"head": far})).command, near, atol=1e-3)


@pytest.mark.parametrize("yaw", [0.0, 1.2, -2.5])
def test_direct_maps_the_velocity_in_the_heading_of_the_head(parts, yaw):
    """Wherever the base has drifted to."""
    p = parts["g1"]
    direct = DirectRetargeter(p.morphology, p.model)
    state = make_state(p, p.qpos)
    direct.reset(state)
    head = p.reach(p.space.neutral, Mode.MOBILE)
    head[3:] = quat_multiply(quat_from_yaw(yaw), head[3:])
    velocity = np.zeros(6)
    velocity[:3] = quat_rotate(quat_from_yaw(quat_yaw(head[3:])), np.array([0.4, -0.1, 0.0]))
    velocity[5] = 0.3
    goal = Goal({"head": head}, {"head": velocity}, Mode.MOBILE)
    plan = direct.plan(state, goal)
    np.testing.assert_allclose(plan.command[-3:], [0.4, -0.1, 0.3], atol=1e-9)
    assert plan.mode is Mode.MOBILE
    np.testing.assert_array_equal(plan.commands, [plan.command])
    standing = direct.plan(state, Goal(goal.poses, goal.velocities, Mode.STATIONARY))
    np.testing.assert_array_equal(standing.command[-3:], 0)


@robots
def test_direct_stays_within_the_bounds(parts, name):
    p = parts[name]
    direct = DirectRetargeter(p.morphology, p.model)
    state = make_state(p, p.qpos)
    direct.reset(state)
    goal = p.reach(p.space.neutral, Mode.MOBILE)
    goal[2] -= 2
    command = direct.plan(
        state, Goal({"head": goal}, {"head": np.full(6, 50.0)}, Mode.MOBILE)
    ).command
    assert (command >= p.space.low).all()
    assert (command <= p.space.high).all()


def test_direct_plans_at_the_rate_that_is_asked_for(parts):
    p = parts["g1"]
    assert DirectRetargeter(p.morphology, p.model, 50.0).control_period(Mode.MOBILE) == 0.02
