"""The whole of the teleoperator's side: engage, follow, lose track, change mode, plan, record."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.state import FRAMES, Goal, RobotState
from xop_lerobot.core.transforms import make_pose, quat_from_rpy, quat_from_yaw, quat_rotate
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.operator.alignment import EngageRefused
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices import DEVICES, DeviceConfig
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.model.kinematics import SiteKinematics
from xop_lerobot.retarget.plan import Plan, Retargeter, StampedPlan
from xop_lerobot.retarget.plan_follower import BackgroundPlanner
from xop_lerobot.session import RobotInfo, Tick
from xop_lerobot.teleoperation import Teleoperation, TeleoperationConfig

POLICIES = {"g1": "default", "rby1": "diff_drive"}
SMALL = RetargeterConfig(num_samples=6, horizon=4, threads=1)
robots = pytest.mark.parametrize("name", list(POLICIES))
OPEN, PINCHED = np.full(2, 0.08), np.array([0.005, 0.08])


class Person(Device):
    """Somebody whose every sample is a function of time, on the robot's clock."""

    def __init__(self, config: DeviceConfig) -> None:
        self.self_engaging = True
        self.start_mode = config.start_mode
        self.motion: Callable[[float], OperatorFrame | None] = stand
        self.starts: list[float] = []

    def start(self, time: float) -> None:
        self.starts.append(time)

    def read(self, time: float) -> OperatorFrame | None:
        return self.motion(time)


def make_frame(
    t: float, head=(0.0, 0.0, 1.7), yaw: float = 0.0, tracked=True, **fields
) -> OperatorFrame:
    """A person with the hands in front of the body."""
    turn = quat_from_yaw(yaw)
    left, right = (
        make_pose(head + quat_rotate(turn, np.array([0.35, y, -0.5])), turn) for y in (0.2, -0.2)
    )
    seen = np.array([tracked, True, True])
    values: dict[str, Any] = {"pinch": OPEN, "tracked": seen, **fields}
    return OperatorFrame(t, make_pose(head, turn), left, right, **values)


def stand(t: float) -> OperatorFrame:
    return make_frame(t, (2.0, -1.0, 1.7), 0.8)


def pinch_twice(at: float, **fields) -> Callable[[float], OperatorFrame]:
    """Two clean left pinches from `at` on; the toggle comes 0.4 s after the second."""

    def motion(t: float) -> OperatorFrame:
        closed = at <= t < at + 0.16 or at + 0.32 <= t < at + 0.48
        return make_frame(t, pinch=PINCHED if closed else OPEN, **fields)

    return motion


class Rig:
    """A robot in simulation and its teleoperation, tick by tick as LeRobot's loop does it."""

    def __init__(self, name: str, fps: int = 25, retargeter: RetargeterConfig = SMALL, **device):
        morphology = make_morphology(name)
        self.morphology, self.dt = morphology, 1 / fps
        plant = Simulation(morphology, SimulationConfig(), kind="planning")
        self.loop = PolicyLoop(morphology, plant, make_policy(POLICIES[name]))
        self.info = RobotInfo(f"xop_{name}", morphology, POLICIES[name], None, "empty", fps, 0)
        settings: dict[str, Any] = {"type": "person", **device}
        config = TeleoperationConfig(device=DeviceConfig(**settings), retargeter=retargeter)
        self.teleop = Teleoperation(config, self.info)
        self.teleop.connect()
        self.kinematics = SiteKinematics(plant.model, tuple(morphology.frames.values()))
        self.loop.reset(seed=0, settle_s=0.8)

    @property
    def person(self) -> Person:
        """The device, where the test is the person."""
        device = self.teleop.device
        assert isinstance(device, Person)
        return device

    @property
    def frames(self) -> dict[str, np.ndarray]:
        """Where the robot's tracked frames are."""
        return self.place(self.loop.state.true_qpos)

    def place(self, qpos: np.ndarray) -> dict[str, np.ndarray]:
        """Where they are at `qpos`."""
        poses = self.kinematics.compute_poses(qpos)
        return {name: poses[site] for name, site in self.morphology.frames.items()}

    def tick(self) -> tuple[RobotAction, Tick]:
        action, record = self.teleop.step(Tick(self.loop.state))
        executed = self.loop.execute(action, self.dt)
        # What is recorded as the action is what the robot does, to the last bit.
        np.testing.assert_array_equal(executed.command, action.command)
        np.testing.assert_array_equal(executed.arms, action.arms)
        assert executed.mode is action.mode
        return action, record

    def run(self, seconds: float) -> list[tuple[RobotAction, Tick]]:
        return [self.tick() for _ in range(round(seconds / self.dt))]

    def close(self) -> None:
        self.teleop.disconnect()
        self.loop.close()


@pytest.fixture(autouse=True)
def person() -> Iterator[None]:
    DEVICES.add("person", Person)
    yield
    DEVICES.remove("person")


@pytest.fixture
def rig() -> Iterator[Callable[..., Rig]]:
    made: list[Rig] = []

    def make(name: str, **settings) -> Rig:
        made.append(Rig(name, **settings))
        return made[-1]

    yield make
    for each in made:
        each.close()


def assert_no_step(rig: Rig, ticks: list[tuple[RobotAction, Tick]]) -> None:
    """No command, and no arm, moves faster than the robot may."""
    space = rig.teleop.morphology.command_space
    for (before, _), (after, _) in zip(ticks[:-1], ticks[1:], strict=True):
        assert (np.abs(after.command - before.command) <= space.max_rate * rig.dt + 1e-6).all()
        num_joints = rig.teleop._arms.ik.num_joints
        assert np.abs(after.arms - before.arms)[:num_joints].max() <= 3.0 * rig.dt + 1e-6


# -- engage and lose -----------------------------------------------------------------------


@robots
@pytest.mark.parametrize(
    "motion", [lambda t: None, lambda t: make_frame(t, tracked=False)], ids=["silent", "unseen"]
)
def test_until_somebody_is_there_the_robot_holds(rig, name, motion):
    r = rig(name)
    r.person.motion = motion
    rest = r.morphology.rest_action()
    for action, record in r.run(0.4):
        np.testing.assert_allclose(action.command, rest.command, atol=1e-6)
        np.testing.assert_allclose(action.arms, rest.arms, atol=1e-6)
        assert action.mode is Mode.STATIONARY
        assert not record.engaged
        assert record.goal is None
        assert set(record.health) == {"sync_residual", "sync_status"}
        assert record.cost == {"total": 0}


@pytest.mark.slow
@robots
def test_engaging_makes_no_step(rig, name):
    r = rig(name)
    r.person.motion = lambda t: make_frame(t, tracked=False)
    waiting = r.run(0.2)
    r.person.motion = stand
    head = r.frames["head"]
    driving = r.run(1.0)
    first = driving[0][1]
    assert first.engaged
    np.testing.assert_allclose(first.goal.poses["head"], r.place(first.estimate)["head"], atol=1e-9)
    assert_no_step(r, waiting + driving)
    # At its goal, the robot has nothing to do with its body.
    assert np.linalg.norm(r.frames["head"][:3] - head[:3]) < 0.05


@robots
def test_it_does_not_engage_while_the_robot_moves_or_lies(rig, name):
    r = rig(name)
    for fault in ({"settled": False}, {"fallen": True}):
        _, record = r.teleop.step(Tick(dataclasses.replace(r.loop.state, **fault)))
        assert not record.engaged
        r.loop.execute(r.morphology.rest_action(), r.dt)
    assert r.person.starts == []
    _, record = r.teleop.step(Tick(r.loop.state))
    assert record.engaged
    assert r.person.starts == [r.loop.state.time]


@pytest.mark.slow
@robots
def test_a_lost_head_stops_the_robot_and_the_next_engagement_aligns_anew(rig, name, caplog):
    caplog.set_level("INFO")
    r = rig(name, mode="mobile")
    start = r.loop.state.time
    r.person.motion = lambda t: make_frame(t, (0.5 * (t - start), 0, 1.7))
    walking = r.run(1.2)
    assert walking[-1][0].mode is Mode.MOBILE
    assert np.abs(walking[-1][0].command[r.morphology.command_space.mobile_only]).max() > 0.1

    r.person.motion = lambda t: make_frame(t, tracked=False)
    stopping = r.run(1.6)
    action, record = stopping[-1]
    assert not record.engaged
    lost = "Disengaged: the headset has lost its position, or sends nothing."
    assert caplog.messages.count(f"{lost} The robot holds until tracking returns.") == 1
    assert action.mode is Mode.STATIONARY
    np.testing.assert_array_equal(action.command[r.morphology.command_space.mobile_only], 0)
    arms = stopping[0][0].arms
    np.testing.assert_array_equal(action.arms, arms)

    r.person.motion = lambda t: make_frame(t, (-7.0, 4.0, 1.6), 2.0)
    again = r.run(0.6)
    first = again[0][1]
    assert first.engaged
    np.testing.assert_allclose(first.goal.poses["head"], r.place(first.estimate)["head"], atol=1e-9)
    assert_no_step(r, walking + stopping + again)
    assert len(r.person.starts) == 1  # a recording is not rewound


@pytest.mark.slow
def test_who_lets_go_though_seen_stops_the_robot_and_takes_it_up_anew(rig):
    r = rig("rby1", mode="mobile")
    start = r.loop.state.time
    r.person.motion = lambda t: make_frame(t, (0.4 * (t - start), 0, 1.7))
    driven = r.run(0.8)
    r.person.is_paused = lambda time: True
    let_go = r.run(0.8)
    assert not any(record.engaged for _, record in let_go)
    # The frames are there all the same, and count for nothing.
    assert let_go[-1][1].frame is not None and let_go[-1][1].goal is None
    r.person.is_paused = lambda time: False
    again = r.run(0.4)
    first = again[0][1]
    assert first.engaged
    np.testing.assert_allclose(first.goal.poses["head"], r.place(first.estimate)["head"], atol=1e-9)
    assert_no_step(r, driven + let_go + again)


@pytest.mark.slow
def test_a_lost_hand_does_not_end_the_engagement(rig):
    r = rig("rby1")
    r.run(0.2)
    r.person.motion = lambda t: make_frame(t, tracked=True)
    seen = r.run(0.2)[-1][1]
    lost = np.array([True, False, True])
    r.person.motion = lambda t: dataclasses.replace(make_frame(t), tracked=lost)
    _, record = r.run(0.2)[-1]
    assert record.engaged
    np.testing.assert_allclose(
        record.goal.poses["left_wrist"], seen.goal.poses["left_wrist"], atol=1e-6
    )


def test_each_engagement_plans_from_the_command_that_is_executed(rig, monkeypatch):
    r, starts = rig("rby1"), []
    monkeypatch.setattr(r.teleop.retargeter, "reset", lambda state: starts.append(state.time))
    expected = [r.loop.state.time]
    r.run(0.2)
    r.person.motion = lambda t: None
    r.run(0.2)
    assert r.teleop._follower.current is None
    expected.append(r.loop.state.time)
    r.person.motion = stand
    r.run(0.2)
    assert starts == expected


def test_a_fall_ends_the_engagement_until_the_robot_stands_again(rig):
    r = rig("rby1", mode="mobile")
    r.run(0.2)
    assert r.teleop.alignment.is_engaged
    for _ in range(5):
        state = dataclasses.replace(r.loop.state, fallen=True)
        action, record = r.teleop.step(Tick(state))
        assert not record.engaged
        assert action.mode is Mode.STATIONARY
        np.testing.assert_array_equal(action.arms, state.arms)
        r.loop.execute(action, r.dt)
    r.teleop.reset()
    r.loop.reset(seed=0, settle_s=0.8)
    assert r.tick()[1].engaged


def test_an_operator_too_low_to_engage_is_an_error_before_the_robot_moves(rig):
    r = rig("rby1")
    r.person.motion = lambda t: make_frame(t, (0, 0, 0.3))
    with pytest.raises(EngageRefused) as caught:
        r.tick()
    assert str(caught.value) == (
        "cannot engage: the operator's head is 0.30 m over the device's floor, less than 0.5 m. "
        "Set the device's floor, or --teleop.alignment.height_scale."
    )
    np.testing.assert_array_equal(r.loop.action.arms, r.loop.state.arms)


def test_a_later_refusal_is_waited_out(rig, caplog):
    """The person bends low while the head is lost: no reason to end the session."""
    r = rig("rby1")
    r.run(0.2)
    r.person.motion = lambda t: None
    r.run(0.2)
    r.person.motion = lambda t: make_frame(t, (0, 0, 0.3))
    assert not any(record.engaged for _, record in r.run(0.4))
    told = [r.message[:13] for r in caplog.records if r.name == "xop_lerobot.operator.engagement"]
    assert told == ["cannot engage"]
    r.person.motion = stand
    assert r.tick()[1].engaged


@robots
def test_reset_starts_over(rig, name):
    r = rig(name)
    r.run(0.2)
    assert r.teleop.alignment.is_engaged
    r.teleop.reset()
    assert not r.teleop.alignment.is_engaged
    r.loop.reset(seed=0, settle_s=0.8)
    _, record = r.tick()
    np.testing.assert_allclose(
        record.goal.poses["head"], r.place(record.estimate)["head"], atol=1e-9
    )
    assert len(r.person.starts) == 2


# -- mode ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_double_pinch_toggles_the_mode(rig):
    r = rig("rby1")
    start = r.loop.state.time
    r.person.motion = pinch_twice(start + 0.2)
    ticks = r.run(1.6)
    modes = [action.mode for action, _ in ticks]
    toggles = [i for i in range(1, len(modes)) if modes[i] != modes[i - 1]]
    assert len(toggles) == 1
    assert (modes[0], modes[-1]) == (Mode.STATIONARY, Mode.MOBILE)
    assert toggles[0] * r.dt > 0.2 + 0.48
    assert_no_step(r, ticks)
    r.person.motion = pinch_twice(r.loop.state.time + 0.5)
    assert r.run(1.6)[-1][0].mode is Mode.STATIONARY


def test_the_mode_of_the_device_counts_over_gestures(rig):
    r = rig("rby1")
    r.person.motion = lambda t: make_frame(t, mode=Mode.MOBILE)
    assert r.run(0.2)[-1][0].mode is Mode.MOBILE
    r.person.motion = lambda t: make_frame(t, mode=Mode.STATIONARY)
    assert r.tick()[0].mode is Mode.STATIONARY


def test_a_change_of_mode_is_planned_for_at_once(rig):
    r = rig("rby1", fps=50, retargeter=dataclasses.replace(SMALL, control_hz=10.0))
    r.run(0.04)  # the next plan is due in three ticks
    r.person.motion = lambda t: make_frame(t, mode=Mode.MOBILE)
    _, record = r.tick()
    assert record.health["plan_age"] == 0
    assert r.teleop._follower.current.plan.mode is Mode.MOBILE


# -- following -----------------------------------------------------------------------------


@pytest.mark.slow
@robots
def test_the_robot_follows_head_and_hands(rig, name):
    """The person leans down by 6 cm of the robot's and moves the hands."""
    r = rig(name)
    start, frames = r.loop.state.time, r.frames
    scale = frames["head"][2] / 1.7

    def motion(t: float) -> OperatorFrame:
        share = min(1.0, (t - start) / 1.0)
        frame = make_frame(t, (0, 0, 1.7 - 0.06 / scale * share))
        wrist = frame.left_wrist.copy()
        wrist[:3] += share * np.array([-0.02, 0.05, 0.1])
        wrist[3:] = quat_from_rpy(0.2 * share, 0, 0.2 * share)
        return dataclasses.replace(frame, left_wrist=wrist)

    r.person.motion = motion
    ticks = r.run(4.5)
    goal = ticks[-1][1].goal
    now = r.frames
    assert goal.poses["head"][2] == pytest.approx(frames["head"][2] - 0.06, abs=1e-3)
    assert abs(now["head"][2] - goal.poses["head"][2]) < 0.03
    # G1's policy adds up to 0.2 rad to what its arms are asked for; that is taken out again.
    for wrist in FRAMES[1:]:
        distance = np.linalg.norm(now[wrist][:3] - goal.poses[wrist][:3])
        assert distance < (0.06 if name == "g1" else 0.02)
    assert_no_step(r, ticks)


def test_grippers_close_with_the_pinch(rig):
    r = rig("rby1")
    closed, opened = r.morphology.arms[0].gripper_range
    r.person.motion = lambda t: make_frame(t, pinch=np.array([0.015, 0.06]))
    action, record = r.run(0.1)[-1]
    np.testing.assert_allclose(action.arms[-2:], [closed, opened], atol=1e-7)
    np.testing.assert_allclose(record.goal.grips, [1, 0])
    r.person.motion = lambda t: make_frame(t, pinch=np.full(2, (0.015 + 0.06) / 2))
    np.testing.assert_allclose(r.tick()[0].arms[-2:], np.full(2, (closed + opened) / 2), atol=1e-7)


def test_each_gripper_follows_the_hand_of_its_own_arm(rig):
    """By the frame that the arm carries, in whatever order, and with fewer arms than hands."""
    r = rig("rby1")
    closed, opened = r.morphology.arms[0].gripper_range
    goal = Goal({}, grips=np.array([1.0, 0.0]))
    left, right = r.morphology.arms
    for arms, expected in (
        ((left, right), [closed, opened]),
        ((right, left), [opened, closed]),
        ((right,), [opened]),
        ((dataclasses.replace(left, gripper=None), right), [opened]),
    ):
        r.teleop._arms.morphology = SimpleNamespace(arms=arms)
        np.testing.assert_array_equal(r.teleop._arms.compute_grippers(goal), expected)


def test_a_walking_goal_has_a_velocity(rig):
    r = rig("rby1", mode="mobile")
    start = r.loop.state.time
    r.person.motion = lambda t: make_frame(t, (0.4 * (t - start), 0, 1.7))
    goal = r.run(1.0)[-1][1].goal
    np.testing.assert_allclose(goal.velocities["head"][:2], [0.4, 0], atol=0.02)


# -- plans ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "fps, control_hz, every", [(25, 25.0, 1), (50, 25.0, 2), (50, 10.0, 5), (10, 25.0, 1)]
)
def test_plans_are_made_at_their_own_rate(rig, fps, control_hz, every):
    r = rig("rby1", fps=fps, retargeter=dataclasses.replace(SMALL, control_hz=control_hz))
    ages = [record.health["plan_age"] for _, record in r.run(10 / fps)]
    assert [round(age * fps) for age in ages] == [i % every for i in range(10)]


def test_between_two_plans_the_last_one_is_played_out(rig):
    r = rig("rby1", fps=50, retargeter=dataclasses.replace(SMALL, control_hz=10.0))
    r.tick()
    steps = np.arange(4)[:, None]
    follower = r.teleop._follower
    plan = follower.current.plan
    plan = dataclasses.replace(plan, commands=plan.commands + 0.001 * steps)
    follower.current = follower.current._replace(plan=plan)
    for k in range(1, 5):
        _, record = r.tick()
        assert follower.current.plan is plan
        np.testing.assert_array_equal(record.command, plan.commands[min(k, 3)])


def test_the_record_of_a_tick_is_complete(rig):
    r = rig("rby1")
    r.run(0.1)
    state = r.loop.state
    action, record = r.teleop.step(Tick(state))
    assert record.state is state
    assert record.frame.time == state.time
    assert set(record.goal.poses) == set(FRAMES)
    assert set(record.cost) == {*r.teleop.retargeter.cost_names, "total"}
    assert record.cost["total"] == pytest.approx(
        sum(value for name, value in record.cost.items() if name != "total")
    )
    assert record.health["solve_time"] > 0
    assert 1 <= record.health["effective_samples"] <= 6
    np.testing.assert_allclose(  # a* is before the limits
        action.command,
        r.morphology.command_space.limit(record.command, state.command, r.dt, action.mode),
        atol=1e-6,
    )


def walk_and_squat(r: Rig) -> Callable[[float], OperatorFrame]:
    start = r.loop.state.time
    return lambda t: make_frame(
        t, (0.3 * (t - start), 0.1 * np.sin(t), 1.7), 0.2 * (t - start), mode=Mode.MOBILE
    )


@pytest.mark.slow
@pytest.mark.parametrize("type_", ["mpc", "direct"])
@robots
def test_same_seed_same_episode(rig, name, type_):
    runs = []
    for _ in range(2):
        r = rig(name, retargeter=dataclasses.replace(SMALL, type=type_))
        r.person.motion = walk_and_squat(r)
        runs.append([(a.command, a.arms) for a, _ in r.run(0.8)] + [(r.loop.state.qpos,)])
    for first, second in zip(*runs, strict=True):
        for a, b in zip(first, second, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_another_seed_is_another_episode(rig):
    ends = []
    for seed in (0, 1):
        r = rig("rby1", retargeter=dataclasses.replace(SMALL, seed=seed))
        r.person.motion = walk_and_squat(r)
        r.run(0.4)
        ends.append(r.loop.state.qpos)
    assert (ends[0] != ends[1]).any()


# -- the end of a recording ----------------------------------------------------------------


def test_when_a_script_has_played_out_the_tick_says_so(rig, tmp_path):
    script = tmp_path / "short.yaml"
    script.write_text("""
duration: 0.4
wrists_in: body
head: [{t: 0, position: [0, 0, 1.65], rpy_deg: [0, 0, 0]}]
left_wrist: [{t: 0, position: [0.36, 0.2, -0.52], rpy_deg: [0, 0, 0]}]
right_wrist: [{t: 0, position: [0.36, -0.2, -0.52], rpy_deg: [0, 0, 0]}]
""")
    r = rig("rby1", type="scripted", path=str(script), hold_s=0.2)
    finished = [record.finished for _, record in r.run(1.0)]
    assert finished == [False] * 15 + [True] * 10
    assert r.tick()[1].engaged  # the robot goes on holding the last frame


# -- planning in a thread ------------------------------------------------------------------


class SlowRetargeter(Retargeter):
    """Plans when it is told to, and remembers what it was asked."""

    def __init__(self) -> None:
        self.go = threading.Semaphore(0)
        self.asked: list[float] = []
        self.resets: list[float] = []
        self.failure: Exception | None = None

    def reset(self, state: RobotState) -> None:
        self.resets.append(state.time)

    def plan(self, state: RobotState, goal: Goal) -> Plan:
        self.asked.append(state.time)
        assert self.go.acquire(timeout=120)
        if self.failure is not None:
            raise self.failure
        return Plan(np.array([state.time]), np.array([[state.time]]), goal.mode)

    def control_period(self, mode: Mode) -> float:
        return 0.04


def make_state(t: float) -> RobotState:
    none = np.zeros(0)
    return RobotState(t, none, none, none, none, none, Mode.STATIONARY, none, none, none, 0.0)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.002)


def wait_for_plan(planner: BackgroundPlanner) -> StampedPlan:
    wait_for(lambda: planner.latest is not None)
    latest = planner.latest
    assert latest is not None
    return latest


@pytest.fixture
def background() -> Iterator[tuple[BackgroundPlanner, SlowRetargeter]]:
    retargeter = SlowRetargeter()
    planner = BackgroundPlanner(retargeter)
    yield planner, retargeter
    for _ in range(20):
        retargeter.go.release()
    planner.close()
    planner.close()


def test_the_planner_never_makes_its_caller_wait(background):
    planner, retargeter = background
    assert planner.latest is None
    planner.submit(make_state(1.0), Goal({}))
    wait_for(lambda: retargeter.asked == [1.0])
    assert planner.latest is None  # it is at it
    retargeter.go.release()
    latest = wait_for_plan(planner)
    assert latest.time == 1.0
    assert latest.plan.command[0] == 1.0


def test_a_slow_planner_goes_on_from_the_newest_state(background):
    planner, retargeter = background
    planner.submit(make_state(1.0), Goal({}))
    wait_for(lambda: retargeter.asked == [1.0])
    for t in (2.0, 3.0, 4.0):
        planner.submit(make_state(t), Goal({}))
    retargeter.go.release()
    wait_for(lambda: len(retargeter.asked) == 2)
    assert retargeter.asked == [1.0, 4.0]


def test_a_plan_from_before_a_reset_is_thrown_away(background):
    planner, retargeter = background
    planner.submit(make_state(1.0), Goal({}))
    wait_for(lambda: retargeter.asked == [1.0])
    planner.reset(make_state(5.0))
    planner.submit(make_state(5.0), Goal({}))
    retargeter.go.release()
    wait_for(lambda: len(retargeter.asked) == 2)
    assert planner.latest is None
    assert retargeter.resets == [5.0]
    retargeter.go.release()
    assert wait_for_plan(planner).time == 5.0


def test_a_failure_of_the_planner_reaches_the_caller(background):
    planner, retargeter = background
    retargeter.failure = RuntimeError("no plan")
    planner.submit(make_state(1.0), Goal({}))
    retargeter.go.release()
    with pytest.raises(RuntimeError, match="^no plan$"):
        wait_for(lambda: planner.latest is not None)
    with pytest.raises(RuntimeError, match="^no plan$"):
        planner.submit(make_state(2.0), Goal({}))
    # A new engagement starts anew.
    retargeter.failure = None
    planner.reset(make_state(3.0))
    assert planner.latest is None
    planner.submit(make_state(3.0), Goal({}))
    retargeter.go.release()
    assert wait_for_plan(planner).time == 3.0
    assert retargeter.resets == [3.0]


def test_in_real_time_the_robot_holds_until_the_first_plan_and_then_follows():
    morphology = make_morphology("rby1")
    info = RobotInfo("xop_rby1", morphology, "diff_drive", None, "empty", 25, 0, realtime=True)
    config = TeleoperationConfig(device=DeviceConfig(type="person"), retargeter=SMALL)
    teleop = Teleoperation(config, info)
    real, slow = teleop.retargeter, SlowRetargeter()
    slow.plan = lambda state, goal: (slow.go.acquire(timeout=120), real.plan(state, goal))[1]
    slow.reset = real.reset
    planner, person = teleop._follower.background, teleop.device
    assert planner is not None
    assert isinstance(person, Person)
    planner._retargeter = slow
    person.motion = lambda t: make_frame(t, (0, 0, 1.7 - 0.2 * min(t, 1.0)))
    loop = PolicyLoop(
        morphology, Simulation(morphology, SimulationConfig()), make_policy("diff_drive")
    )
    loop.reset(seed=0, settle_s=0.4)
    rest = morphology.rest_action()
    for _ in range(5):
        action, record = teleop.step(Tick(loop.state))
        assert record.engaged
        assert "plan_age" not in record.health
        np.testing.assert_allclose(action.command, rest.command, atol=1e-6)
        loop.execute(action, 0.04)
    for _ in range(1000):
        slow.go.release()
    wait_for_plan(planner)
    for _ in range(24):
        action, _ = teleop.step(Tick(loop.state))
        loop.execute(action, 0.04)
    action, record = teleop.step(Tick(loop.state))
    assert record.health["plan_age"] >= 0
    assert np.abs(action.command - rest.command).max() > 0.01
    teleop.disconnect()
    teleop.disconnect()
    loop.close()
    assert not any(thread.name == "xop-planner" for thread in threading.enumerate())


def test_two_ticks_in_one_period_of_the_policy(rig):
    """On the wall clock the robot's time moves in steps of 20 ms, LeRobot's loop does not."""
    r = rig("rby1")
    r.run(0.1)
    state = r.loop.state
    r.teleop.step(Tick(state))
    second, _ = r.teleop.step(Tick(state))
    np.testing.assert_array_equal(second.arms, state.arms)
    assert np.isfinite(second.command).all()
    assert np.isfinite(second.arms).all()
