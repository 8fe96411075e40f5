"""Postures at goals: found from anywhere, held by servos, and no further than they serve."""

from __future__ import annotations

import dataclasses
import os

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.core.transforms import make_pose, quat_from_rpy, quat_from_yaw, rotation_error
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.model.command_model import PlannerState, Start
from xop_lerobot.retarget.model.linearisation import Placement
from xop_lerobot.retarget.model.posture import AT_REST_S
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.static_load import StaticLoad

ROBOTS = ("g1", "rby1")
robots = pytest.mark.parametrize("name", ROBOTS)
GOALS, STARTS = int(os.environ.get("XOP_TEST_GOALS", "60")), 3
STEP_S, STEPS = 0.4, 25  # of an ideal robot that does what it is proposed
LOWEST, MOST_TILTED = 0.5, np.radians(100)  # goals lower, or more tilted, are nobody's head's


class Robot:
    """A robot that does at once, within its rates, what its kinematic proposal says."""

    def __init__(self, name: str) -> None:
        self.morphology = make_morphology(name)
        model = build_model(self.morphology, "planning")
        policy = make_policy(self.morphology.policies[0])
        policy.adapt(model)
        self.mpc = MpcRetargeter(self.morphology, policy, model, RetargeterConfig(threads=1))
        self.model, self.command_model = model, self.mpc.command_model
        self.space, self.standing = self.mpc.space, self.morphology.standing_qpos()
        self.site = self.morphology.frames["head"]
        self._placement = Placement(model, (self.site,), com_of=self.morphology.base_body)
        joints = [effect.joint for effect in self.morphology.effects if effect.joint]
        share = self.morphology.servos.load_share if self.morphology.servos else 0.75
        self.load = StaticLoad(model, joints, share)

    def rest(self, command: np.ndarray) -> np.ndarray:
        """Where it comes to rest on the spot. Shape (nq,)."""
        return self.command_model.extrapolate(
            Start(self.standing, settled=command), command, AT_REST_S, Mode.STATIONARY
        )

    def place(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose of the head and centre of mass."""
        poses, _, com = self._placement.compute(qpos[None])
        return poses[self.site][0], com[0]

    def is_held(self, qpos: np.ndarray) -> bool:
        """Whether it can stand so: over its support, and by its servos."""
        if self.mpc.problem.support is None:
            return True
        _, com = self.place(qpos)
        stands = self.mpc.problem.support.compute_excess(qpos[:7], com[:2]).max() <= 0
        return bool(stands and self.load.compute_excess(qpos[None]).max() <= 0)

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """A command in which it can stand, anywhere in its bounds, its head like a person's.

        Its neck is straight: it never turns further than the head, or the other way.
        """
        moves = self.command_model.acting(Mode.STATIONARY) & ~self.command_model.is_velocity()
        moves &= ~self.command_model.neck
        while True:
            drawn = rng.uniform(self.space.low, self.space.high)
            command = np.where(moves, drawn, self.space.neutral)
            qpos = self.rest(command)
            head, _ = self.place(qpos)
            upright = 1 - 2 * (head[4] ** 2 + head[5] ** 2)
            if head[2] > LOWEST and upright > np.cos(MOST_TILTED) and self.is_held(qpos):
                return command

    def start(self, command: np.ndarray) -> np.ndarray:
        """Start from rest under a command; returns the configuration."""
        qpos = self.rest(command)
        self.mpc.reset(make_state(self, qpos, command))
        return qpos

    def step(
        self, qpos: np.ndarray, command: np.ndarray, goal: Goal, dt: float, time: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Do for `dt` what is proposed for a goal; returns configuration and command then."""
        config = self.mpc.configs[goal.mode]
        self.mpc.offset.reset(command)  # it rests where it is told to
        head, _ = self.place(qpos)
        offset = self.mpc.offset.offset
        now = PlannerState(qpos, command, np.zeros(3), offset, command, {"head": head}, time)
        reference = self.mpc.references.lead(now, goal, config)
        proposal = self.mpc.candidates.propose(now, reference, goal.mode, config, command)
        reach = self.space.compute_max_rate(goal.mode, command) * dt
        proposal = self.space.restrict(proposal, goal.mode)
        following = np.clip(proposal, command - reach, command + reach)
        start = Start(qpos, settled=command)
        qpos = self.command_model.extrapolate(start, following, dt, goal.mode)
        return qpos, following

    def go(self, command: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Go from one command to a goal by proposals alone; returns the configuration."""
        goal, qpos = Goal({"head": pose}), self.start(command)
        for _ in range(STEPS):
            qpos, command = self.step(qpos, command, goal, STEP_S)
            if is_there(self.place(qpos)[0], pose, share=0.5):
                break
        return qpos


def make_state(robot: Robot, qpos: np.ndarray, command: np.ndarray) -> RobotState:
    rest = robot.morphology.rest_action()
    count = len(robot.morphology.command_space)
    return RobotState(
        time=0.0,
        qpos=qpos,
        qvel=np.zeros(robot.model.nv),
        memory=np.zeros(0),
        command=command[:count],
        arms=rest.arms,
        mode=Mode.STATIONARY,
        effort=np.zeros(robot.model.nu),
        true_qpos=qpos,
        true_qvel=np.zeros(robot.model.nv),
        wall_time=0.0,
    )


def is_there(head: np.ndarray, goal: np.ndarray, share: float = 1.0) -> bool:
    """Within 5 cm and 5 degrees, or a share of that."""
    turn = np.linalg.norm(rotation_error(goal[3:], head[3:]))
    return bool(np.linalg.norm(head[:3] - goal[:3]) < 0.05 * share and turn < np.radians(5) * share)


@pytest.fixture(scope="module")
def fleet() -> dict[str, Robot]:
    return {name: Robot(name) for name in ROBOTS}


@pytest.mark.slow
@robots
def test_random_goals_are_reached_from_any_posture(fleet, name):
    """Goals that are reachable by construction, from the neutral posture and two random ones."""
    robot, rng = fleet[name], np.random.default_rng(0)
    missed = []
    for i in range(GOALS):
        pose, _ = robot.place(robot.rest(robot.draw(rng)))
        starts = [robot.space.neutral, *(robot.draw(rng) for _ in range(STARTS - 1))]
        for j, start in enumerate(starts):
            head, _ = robot.place(robot.go(start, pose))
            if not is_there(head, pose):
                missed.append((i, j, np.round(np.linalg.norm(head[:3] - pose[:3]), 3)))
    # Of 200 goals, RB-Y1 misses one behind its back, and another from one start.
    assert len(missed) <= 0.01 * max(GOALS - 60, 0) * STARTS, missed


# -- where a person goes that the robot does not ----------------------------------------------


def bend_and_walk(clock: float) -> np.ndarray:
    """A head that drops low within a second, looks down, walks on and ends at chest height."""
    rows = np.array(
        [  # time, x, height, pitch, heading
            (0.0, 0.0, 1.34, 0.0, 0.0),
            (1.0, 0.25, 1.1, 0.8, 0.0),
            (2.0, 0.4, 0.5, 1.4, -0.2),
            (3.5, 0.9, 0.45, 1.5, 0.2),
            (6.0, 1.7, 0.65, 1.5, -0.4),
            (8.5, 2.5, 0.8, 1.1, 0.0),
            (10.0, 3.0, 0.9, 0.8, -0.1),
        ]
    )
    x, z, pitch, yaw = (np.interp(clock, rows[:, 0], column) for column in rows[:, 1:].T)
    return make_pose(np.array([x, 0.0, z]), quat_from_rpy(0.0, pitch, yaw))


@pytest.mark.slow
def test_who_bends_quickly_and_walks_on_is_met_with_folded_knees(fleet):
    """RB-Y1 used to end with straight knees, its head 12 cm too high."""
    robot, dt, command = fleet["rby1"], 0.04, fleet["rby1"].space.neutral
    qpos, ticks = robot.start(command), 400
    heaviest = 0.0
    for i in range(ticks):
        pose, later = bend_and_walk(i * dt), bend_and_walk((i + 1) * dt)
        velocity = np.zeros(6)
        velocity[:3] = (later[:3] - pose[:3]) / dt
        goal = Goal({"head": pose}, {"head": velocity}, Mode.MOBILE)
        qpos, command = robot.step(qpos, command, goal, dt, i * dt)
        heaviest = max(heaviest, float(robot.load.compute_excess(qpos[None]).max()))
    head, _ = robot.place(qpos)
    pose = bend_and_walk((ticks - 1) * dt)
    assert np.linalg.norm(head[:3] - pose[:3]) < 0.05
    assert command[robot.space.index("torso_2")] < -1.0
    assert heaviest < 0.1  # of what the motors can, beyond 85 percent


@robots
def test_who_walks_off_leaves_a_robot_that_stands(fleet, name):
    """It leans a little after its goal, within its servos, and does not tilt for centimetres."""
    robot = fleet[name]
    home, _ = robot.place(robot.rest(robot.space.neutral))
    for direction in ((1.5, 0.0), (-1.5, 0.0), (0.3, 1.2)):
        pose = make_pose(home[:3] + np.array([*direction, 0.0]), home[3:])
        qpos = robot.go(robot.space.neutral, pose)
        head, _ = robot.place(qpos)
        led = np.linalg.norm(head[:2] - home[:2])
        assert led < robot.morphology.standing_reach + 0.02
        assert robot.is_held(qpos)
        assert np.linalg.norm(rotation_error(home[3:], head[3:])) < np.radians(10)
        assert abs(head[2] - home[2]) < 0.05


@robots
def test_who_turns_beyond_what_a_waist_can_is_not_helped_by_a_tilt(fleet, name):
    robot = fleet[name]
    home, _ = robot.place(robot.rest(robot.space.neutral))
    waist = {"g1": 1.0, "rby1": 2.356}[name]
    for turn in (waist + 0.4, -waist - 0.4):
        pose = make_pose(home[:3], quat_from_yaw(turn))
        head, _ = robot.place(robot.go(robot.space.neutral, pose))
        # RB-Y1's neck turns on where its waist ends.
        most = turn if name == "rby1" else np.sign(turn) * waist
        assert is_there(head, make_pose(home[:3], quat_from_yaw(most)))


def test_a_goal_that_turns_past_half_a_turn_stays_on_its_side(fleet):
    """The waist waits at its limit; it goes all the way round once that is much shorter."""
    guide, robot = fleet["rby1"].mpc.references.postures, fleet["rby1"]
    guide.reset()
    beyond = [
        guide._compute_turn_beyond(quat_from_yaw(turn), 0.0)
        for turn in np.arange(0.0, 3.9, 0.1).tolist()
    ]
    assert min(beyond[:38]) >= 0  # up to 3.7 rad it is beyond the limit on the left
    assert beyond[-1] <= 0
    assert robot.space.high[robot.space.index("torso_5")] == pytest.approx(2.356, abs=1e-3)


@robots
def test_a_change_of_mode_in_mid_drive_first_stops_in_the_posture_it_has(fleet, name):
    """A torso that leans after its goal while wheels brake folds."""
    robot = fleet[name]
    command = robot.space.neutral.copy()
    forward = robot.space.index("v" if name == "rby1" else "vx")
    command[forward] = 0.9
    if name == "rby1":
        command[robot.space.index("torso_1")] += 0.15
    qpos = robot.rest(np.where(robot.command_model.is_velocity(), 0.0, command))
    state = make_state(robot, qpos, command)
    head, _ = robot.place(qpos)
    pose = make_pose(head[:3] + np.array([0.4, 0.0, 0.0]), head[3:])
    robot.mpc.reset(state)
    policy = make_policy(robot.morphology.policies[0])
    state = dataclasses.replace(state, memory=policy.initial_memory(1)[0])
    plan = robot.mpc.plan(state, Goal({"head": pose}, {"head": np.array([1.0, *np.zeros(5)])}))
    still = ~robot.command_model.is_velocity()[: len(plan.command)]
    np.testing.assert_allclose(plan.command[still], state.command[still], atol=1e-9)
    assert abs(plan.command[forward]) <= robot.space.sway[forward] + 1e-9


# -- static loads -----------------------------------------------------------------------------


@robots
def test_static_loads_are_mujocos_gravity_torques_and_their_derivative(fleet, name):
    robot, rng = fleet[name], np.random.default_rng(1)
    model, data = robot.model, mujoco.MjData(robot.model)
    joints = [effect.joint for effect in robot.morphology.effects if effect.joint]
    load = StaticLoad(model, joints, share=0.02)
    dofs = [int(model.joint(joint).dofadr[0]) for joint in load.joints]

    def place(qpos: np.ndarray) -> mujoco.MjData:
        data.qpos[:], data.qvel[:] = qpos, 0.0
        mujoco.mj_forward(model, data)
        return data

    for _ in range(3):
        qpos = robot.rest(robot.draw(rng))
        qpos[7:] += 0.3 * rng.normal(size=len(qpos) - 7)
        torques = place(qpos).qfrc_bias[dofs] / load.limits
        np.testing.assert_allclose(load.compute(data), torques, atol=1e-9)
        excess, jacobian = load.linearise_excess(data)
        np.testing.assert_allclose(excess, np.maximum(np.abs(torques) - 0.02, 0), atol=1e-9)
        np.testing.assert_allclose(load.compute_excess(qpos[None])[0], excess, atol=1e-12)
        for dof in model.jnt_dofadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]:
            ends = []
            for sign in (1, -1):
                moved, step = qpos.copy(), np.zeros(model.nv)
                step[dof] = sign * 1e-6
                mujoco.mj_integratePos(model, moved, step, 1.0)
                ends.append(load.linearise_excess(place(moved))[0])
            np.testing.assert_allclose(jacobian[:, dof], (ends[0] - ends[1]) / 2e-6, atol=1e-6)
