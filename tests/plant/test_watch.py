"""A robot that moves though it is told to stand, or gives way: noticed, told, marked, stopped."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from toy_robot import Toy, make_teleop, make_toy

from tests.recording.test_dataset import create, tick
from tests.test_teleoperation import POLICIES, Person, Rig, make_frame, robots
from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.transforms import quat_from_yaw
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.operator.devices import DEVICES
from xop_lerobot.operator.display import Cue
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.plant.watch import GIVES_WAY, MOVES, Watch
from xop_lerobot.recording.facts import read_facts

every_robot = pytest.mark.parametrize("name", ["g1", "rby1", "toy"])


@pytest.fixture(autouse=True)
def person():
    DEVICES.add("person", Person)
    yield
    DEVICES.remove("person")


def make_robot(name: str) -> Morphology:
    return Toy() if name == "toy" else make_morphology(name)


class Walk:
    """Periods of a robot whose base is moved about by hand."""

    def __init__(self, name: str) -> None:
        self.morphology = make_robot(name)
        self.watch = Watch(self.morphology)
        self.qpos = self.morphology.standing_qpos()
        self.action = self.morphology.rest_action()

    def run(self, seconds: float, vx: float = 0.0, yaw_rate: float = 0.0, **noise) -> float | None:
        """Let time pass; the time after which there was trouble [s], None if there was none."""
        rng, sigma = np.random.default_rng(0), noise.get("noise", 0.0)
        yaw = 0.0
        for step in range(round(seconds / POLICY_DT)):
            self.qpos[0] += vx * POLICY_DT
            yaw += yaw_rate * POLICY_DT
            self.qpos[3:7] = quat_from_yaw(yaw)
            seen = self.qpos.copy()
            seen[:2] += sigma * rng.standard_normal(2)
            self.watch.update(seen, self.action)
            if self.watch.trouble:
                return (step + 1) * POLICY_DT
        return None

    def command(self, mode: Mode, **entries: float) -> None:
        command = self.morphology.command_space.neutral.copy()
        for name, value in entries.items():
            command[self.morphology.command_space.index(name)] = value
        self.action = RobotAction(command, mode, self.action.arms)


@every_robot
@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("motion", [{"vx": 0.4}, {"vx": -0.4}, {"yaw_rate": 1.0}])
def test_who_moves_though_told_to_stand_is_noticed_within_half_a_second(name, mode, motion):
    walk = Walk(name)
    walk.command(mode)
    assert walk.run(3.0) is None
    noticed = walk.run(2.0, **motion)
    assert noticed is not None and noticed <= 0.5
    assert walk.watch.trouble == MOVES == "the robot moves though it is told to stand"


@every_robot
def test_standing_still_is_no_trouble_however_noisy_or_drifting_the_odometry(name):
    walk = Walk(name)
    assert walk.run(20.0, noise=0.03) is None
    assert walk.run(20.0, vx=0.005) is None


@every_robot
def test_creeping_is_noticed_before_it_has_gone_far(name):
    walk = Walk(name)
    walk.run(2.0)
    noticed = walk.run(20.0, vx=0.05)
    assert noticed is not None and noticed * 0.05 < 0.12


@pytest.mark.parametrize("name", ["g1", "rby1"])
def test_who_was_told_to_move_moves_and_may_take_a_second_to_stop(name):
    walk = Walk(name)
    forward = walk.morphology.command_space.names[4 if name == "g1" else 0]
    walk.command(Mode.MOBILE, **{forward: 0.8})
    assert walk.run(5.0, vx=0.8) is None
    walk.command(Mode.STATIONARY)
    assert walk.run(0.8, vx=0.4) is None
    assert walk.run(5.0) is None
    walk.command(Mode.MOBILE)
    assert walk.run(5.0, vx=0.08) is None  # policies that step on the spot drift


def test_trouble_is_over_after_a_second_of_calm():
    walk = Walk("rby1")
    walk.run(2.0)
    assert walk.run(1.0, vx=0.4) is not None
    for _ in range(round(0.9 / POLICY_DT)):
        walk.watch.update(walk.qpos, walk.action)
    assert walk.watch.trouble
    for _ in range(round(0.6 / POLICY_DT)):
        walk.watch.update(walk.qpos, walk.action)
    assert not walk.watch.trouble


def test_a_servo_that_gives_way_is_noticed_within_a_third_of_a_second():
    walk = Walk("rby1")
    place = walk.watch._addresses[1]
    walk.run(0.2)
    walk.qpos[place] += 0.2
    noticed = walk.run(1.0)
    assert noticed is not None and noticed <= 0.35
    assert walk.watch.trouble == GIVES_WAY == "the robot's servos give way under the load"


def test_a_servo_that_is_late_for_a_moment_does_not_give_way():
    walk = Walk("rby1")
    place = walk.watch._addresses[1]
    for _ in range(5):
        walk.qpos[place] += 0.2
        assert walk.run(0.28) is None
        walk.qpos[place] -= 0.2
        assert walk.run(0.28) is None


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["off", "mild"])
@robots
def test_robots_that_stand_squat_lean_and_stop_are_in_no_trouble(name, noise):
    morphology = make_morphology(name)
    plant = Simulation(morphology, SimulationConfig(noise=noise), kind="planning")
    loop = PolicyLoop(morphology, plant, make_policy(POLICIES[name]))
    loop.reset(seed=0)
    rest, space = morphology.rest_action(), morphology.command_space
    velocities = [i for i, dim in enumerate(space.dims) if dim.mobile_only]
    for step in range(250):
        t, command = step / 25, rest.command.copy()
        mode = Mode.MOBILE if t < 4 else Mode.STATIONARY
        if mode is Mode.MOBILE:
            command[velocities[0]], command[velocities[-1]] = 0.6, 0.4
        elif name == "g1":
            command[:4] = 0.70 - 0.05 * np.cos(t), 0.5 * np.sin(t), 0, 0.2 * np.sin(1.3 * t)
        else:
            command[3:6] += np.array([0.2, -0.4, 0.2]) * np.sin(t)
        loop.execute(RobotAction(command, mode, rest.arms), 0.04)
        assert not loop.state.trouble, t
    loop.close()


@pytest.mark.slow
@robots
def test_the_operator_is_told_and_the_arms_go_back_to_rest(name, monkeypatch):
    """Whoever drives is let go, and drives again once the robot stands."""
    rig = Rig(name, mode="stationary")
    raised = np.array([0, 0, 0.15])

    def motion(t: float):
        frame = make_frame(t)
        lift = min(t, 1.0) * raised
        left, right = (frame.pose(side).copy() for side in ("left_wrist", "right_wrist"))
        left[:3] += lift
        right[:3] += lift
        return dataclasses.replace(frame, left_wrist=left, right_wrist=right)

    rig.person.motion = motion
    rig.run(2.0)
    assert rig.teleop.alignment.is_engaged
    arms = rig.loop.state.arms
    rest = rig.morphology.rest_action()
    away = np.abs(arms - rest.arms).max()
    assert away > 0.1

    watch = rig.loop._watch
    watch.trouble, watch._calm = MOVES, 0.0
    _, record = rig.tick()
    assert not record.engaged
    assert rig.teleop.notice == (
        "The robot moves though it is told to stand. "
        "Disengaged: it stands, its arms go back to rest."
    )
    assert rig.teleop._board.notices[-1].cue is Cue.DISENGAGED
    shown = rig.teleop._feedback.shown
    assert shown is not None
    assert "The robot moves though it is told to stand." in shown.warnings
    first = rig.loop.state.arms
    for _ in range(5):
        action, record = rig.tick()
        assert action.mode is Mode.STATIONARY
    assert np.abs(rig.loop.state.arms - rest.arms).max() < np.abs(first - rest.arms).max()
    rig.run(2.0)
    assert rig.teleop.alignment.is_engaged


def test_an_episode_says_when_its_robot_was_in_trouble(tmp_path):
    robot, teleop = make_toy("watch"), make_teleop("watch")
    robot.connect()
    teleop.connect()
    assert isinstance(robot._loop, PolicyLoop)
    watch = robot._loop._watch
    dataset = create("watch", robot, tmp_path / "d")
    for index in range(12):
        if index == 4:
            watch.trouble, watch._calm = GIVES_WAY, 0.0
        tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    changes = read_facts(tmp_path / "d")[0]["changes"]
    robots_own = [each for each in changes if each["source"] == "robot"]
    assert [each["frame"] for each in robots_own] == [4]
    assert robots_own[0]["change"] == {"trouble": GIVES_WAY}
    teleop.disconnect()
    robot.disconnect()
