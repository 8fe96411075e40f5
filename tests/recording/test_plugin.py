"""The LeRobot plugins: registration, configuration, and the devices' contract on a toy robot."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
import pytest
from lerobot.robots.config import RobotConfig
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators.utils import make_teleoperator_from_config
from toy_robot import ARM_JOINTS, SMALL, XopToy, XopToyConfig, make_teleop, make_toy, observe

from lerobot_robot_xop import (
    LowLevelConfig,
    SceneConfig,
    XopG1,
    XopG1Config,
    XopRby1Config,
    XopRobot,
    XopRobotConfig,
)
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadRecording, BadValue, LinkError, NotConnected, UnknownName
from xop_lerobot.session import get_session

REPO = Path(__file__).parents[2]
HEAVY = ("mujoco", "lerobot.datasets", "lerobot.policies", "mink", "onnxruntime", "viser", "scipy")


@pytest.fixture
def session(request) -> str:
    return request.node.name


@pytest.fixture
def robot(session):
    robot = make_toy(session)
    robot.connect()
    yield robot
    robot.disconnect()


def run_python(code: str, *paths: Path) -> subprocess.CompletedProcess:
    """Run `code` in a fresh interpreter that sees `paths` and not this repository."""
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    env["PYTHONPATH"] = os.pathsep.join(map(str, paths))
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=env, cwd="/", capture_output=True, text=True, timeout=300)


# Registration.


@pytest.mark.slow
def test_import_is_light():
    """What the plugin itself loads, beyond what LeRobot's two configuration modules do."""
    code = f"""
import sys
import lerobot.robots.config, lerobot.teleoperators.config
before = set(sys.modules)
import lerobot_teleoperator_xop
new = set(sys.modules) - before
print([name for name in {HEAVY!r} if name in new])
print(sorted({{n.split('.')[0] for n in new}}))
"""
    done = run_python(code, REPO, REPO / "robots", REPO / "teleoperators")
    assert done.returncode == 0, done.stderr
    heavy, packages = done.stdout.splitlines()
    assert heavy == "[]"
    assert "torch" not in packages


@pytest.mark.slow
def test_wheel_offers_the_types(tmp_path):
    """LeRobot's parser offers robots and teleoperator when the built wheel is installed."""
    source, site = tmp_path / "source", tmp_path / "site"
    ignored = shutil.ignore_patterns(".*", "outputs", "build", "*.egg-info", "__pycache__")
    shutil.copytree(REPO, source, ignore=ignored)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", tmp_path, source]
    subprocess.run([*pip, *build], check=True, capture_output=True, cwd=tmp_path)
    wheel = next(tmp_path.glob("*.whl"))
    subprocess.run([*pip, "install", "--no-deps", "--target", site, wheel], check=True)

    metadata = next(site.glob("*.dist-info/METADATA")).read_text()
    assert "\nName: lerobot_teleoperator_xop\n" in metadata
    code = """
import json, logging
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
import lerobot_teleoperator_xop, xop_lerobot, pathlib
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig
scripts = pathlib.Path(xop_lerobot.__file__).parent / "operator" / "scripts"
print(json.dumps([lerobot_teleoperator_xop.__file__, *RobotConfig.get_known_choices(),
    *TeleoperatorConfig.get_known_choices(), *(p.name for p in scripts.iterdir())]))
"""
    done = run_python(code, site)
    assert done.returncode == 0, done.stderr
    where, *names = json.loads(done.stdout.splitlines()[-1])
    assert where.startswith(str(site))
    assert {"xop_g1", "xop_rby1", "xop", "g1_squat_walk_reach.yaml"} <= set(names)


# Configuration.


@dataclass
class Flags:
    robot: RobotConfig


def parse_robot(*flags: str) -> XopRobotConfig:
    """What LeRobot's parser makes of command line flags."""
    robot = draccus.parse(Flags, args=[f"--robot.{flag}" for flag in flags]).robot
    assert isinstance(robot, XopRobotConfig)
    return robot


@pytest.mark.parametrize("value", ["[head,scene]", "head,scene", "[head, scene]"])
def test_cameras_from_the_command_line(value):
    assert parse_robot("type=xop_g1", f"cameras={value}").cameras == ["head", "scene"]


def test_no_cameras_from_the_command_line():
    assert parse_robot("type=xop_rby1", "cameras=[]").cameras == []


def test_nested_flags():
    config = parse_robot("type=xop_g1", "sim.noise=mild", "low_level.name=falcon", "fps=10")
    assert (config.sim.noise, config.low_level.name, config.fps) == ("mild", "falcon", 10)


BAD_CONFIGS = {
    "fps": (
        {"fps": 30},
        "robot.fps must divide the low-level policy's 50 Hz, got 30. "
        "Use one of 1, 2, 5, 10, 25, 50",
    ),
    "clock": (
        {"clock": "wall"},
        "unknown robot.clock 'wall'. Known: lockstep, realtime",
    ),
    "cameras": (
        {"cameras": ["head", "head"]},
        "robot.cameras names a camera twice: head, head",
    ),
    "noise": (
        {"sim": SceneConfig(noise="loud")},
        "unknown noise preset 'loud'. Known: harsh, mild, off",
    ),
    "size": ({"width": 0}, "an image must be at least 1 x 1 pixels, got 0 x 240"),
    "seed": ({"seed": -1}, "seed must be 0 or more, got -1"),
}


@pytest.mark.parametrize("case", BAD_CONFIGS)
@pytest.mark.parametrize("config", [XopG1Config, XopRby1Config])
def test_bad_config(config, case):
    settings, text = BAD_CONFIGS[case]
    with pytest.raises((BadValue, UnknownName)) as error:
        config(**settings)
    assert str(error.value) == text


BAD_ROBOTS = {
    "camera": (
        {"cameras": ["head", "hed"]},
        "unknown camera of toy 'hed'. Known: back, head",
    ),
    "policy": (
        {"low_level": LowLevelConfig(name="falcon")},
        "unknown low-level policy of toy 'falcon'. Known: toy_hold",
    ),
    "scene": ({"sim": SceneConfig(scene="moon")}, "unknown scene 'moon'. Known: "),
}


@pytest.mark.parametrize("case", BAD_ROBOTS)
def test_bad_robot_is_refused_before_it_exists(session, case):
    settings, text = BAD_ROBOTS[case]
    with pytest.raises(UnknownName) as error:
        make_toy(session, **settings)
    assert str(error.value).startswith(text)
    with pytest.raises(LinkError):
        _ = get_session(session).robot


# The robot.


def test_lerobot_makes_the_toy(session):
    robot = make_robot_from_config(XopToyConfig(session=session, **SMALL))
    assert type(robot) is XopToy


@pytest.mark.parametrize("config", [XopG1Config, XopRby1Config])
def test_features_are_known_before_connect(session, config):
    robot = make_robot_from_config(config(session=session, cameras=["head", "scene"]))
    assert isinstance(robot, XopRobot)
    keys = [key for key, kind in robot.observation_features.items() if kind is float]
    assert all(key.endswith((".pos", ".vel")) for key in (*keys, *robot.action_features))
    assert keys[-9:-6] == ["base.height.pos", "base.roll.pos", "base.pitch.pos"]
    assert robot.observation_features["scene"] == (240, 320, 3)
    assert len(robot.cameras) == 2
    assert robot.name == robot.config.type
    assert not robot.is_connected


def test_action_keys_of_the_contract(session):
    g1 = make_robot_from_config(XopG1Config(session=f"{session}-g1"))
    rby1 = make_robot_from_config(XopRby1Config(session=f"{session}-rby1"))
    assert [*g1.action_features][:8] == [
        "height.pos",
        "waist_yaw.pos",
        "waist_roll.pos",
        "waist_pitch.pos",
        "x.vel",
        "y.vel",
        "theta.vel",
        "mode.pos",
    ]
    assert [*rby1.action_features][:3] == ["x.vel", "theta.vel", "torso_0.pos"]


def test_observation_matches_its_features(robot):
    observation = robot.get_observation()
    assert list(observation) == list(robot.observation_features)
    assert observation["head"].shape == (48, 64, 3)
    assert observation["head"].dtype == np.uint8
    floats = [value for value in observation.values() if isinstance(value, float)]
    assert len(floats) == len(observation) - 1
    assert np.isfinite(floats).all()
    assert observation["base.height.pos"] == pytest.approx(0.2, abs=0.01)


def test_base_velocity_is_in_the_body(robot):
    state = observe(robot)
    qpos, qvel = state.qpos.copy(), state.qvel.copy()
    # Heading +Y and moving along the world's +X: to the robot's right.
    qpos[3:7], qvel[:6] = (np.sqrt(0.5), 0, 0, np.sqrt(0.5)), (0.3, 0, 0, 0.1, 0.2, 0.4)
    turned = type(state)(**{**vars(state), "qpos": qpos, "qvel": qvel})
    values = robot._body.compute_proprioception(turned)
    assert values["base.x.vel"] == pytest.approx(0.0)
    assert values["base.y.vel"] == pytest.approx(-0.3)
    assert values["base.yaw.vel"] == pytest.approx(0.4)


def test_observing_lets_no_time_pass(robot):
    first, second = robot.get_observation(), robot.get_observation()
    assert all(np.array_equal(first[key], second[key]) for key in first)


def test_an_action_lasts_one_period(robot):
    before = observe(robot).time
    robot.send_action({})
    assert observe(robot).time - before == pytest.approx(1 / 25, abs=1e-9)


def test_sent_action_is_what_is_executed(robot):
    robot.get_observation()
    sent = robot.send_action({"lift.pos": 9.0, "left_elbow.pos": 0.1})
    assert list(sent) == list(robot.action_features)
    assert sent["lift.pos"] == pytest.approx(0.5 / 25)  # its rate limit
    assert sent["left_elbow.pos"] == pytest.approx(0.1)
    assert robot.send_action({})["lift.pos"] == sent["lift.pos"]


def test_positions_of_an_observation_may_be_sent_back(robot):
    """LeRobot's rollout returns a robot to where it started by sending its `.pos` keys."""
    observation = robot.get_observation()
    sent = robot.send_action({k: v for k, v in observation.items() if k.endswith(".pos")})
    assert set(sent) == set(robot.action_features)


def test_who_moves_joints_alone_does_not_walk_on():
    """As LeRobot does when a policy has ended in mid-walk and the robot goes to its start."""
    robot = XopG1(XopG1Config(session="joints alone", cameras=[]))
    robot.connect()
    keys, sent = ("x.vel", "y.vel", "theta.vel"), {}
    try:
        for _ in range(8):
            sent = robot.send_action(
                {"mode.pos": 1.0, **dict.fromkeys(keys, 0.3), "height.pos": 0.7}
            )
        assert sent["x.vel"] == pytest.approx(0.3)
        observation = robot.get_observation()
        back = {key: value for key, value in observation.items() if key.endswith(".pos")}
        for _ in range(10):
            sent = robot.send_action(back)
        assert [sent[key] for key in keys] == [0.0, 0.0, 0.0]
        assert sent["height.pos"] == pytest.approx(0.7)
        # Whoever asks for a velocity anew has it.
        assert robot.send_action({"x.vel": 0.3})["x.vel"] > 0
    finally:
        robot.disconnect()


def test_bad_actions(robot):
    with pytest.raises(UnknownName, match="unknown action key 'elbow.pos'. Known: left_elbow"):
        robot.send_action({"elbow.pos": 0.0})
    with pytest.raises(BadValue, match="action 'lift.pos' must be finite, got nan"):
        robot.send_action({"lift.pos": float("nan")})


def test_not_connected(session):
    robot = make_toy(session)
    for call in (robot.get_observation, lambda: robot.send_action({})):
        with pytest.raises(NotConnected, match=r"XopToy is not connected. Call connect\(\) first."):
            call()


def test_reconnecting(robot):
    robot.disconnect()
    robot.disconnect()
    assert not robot.is_connected
    robot.connect()
    assert get_session(robot.config.session).robot.name == "xop_toy"
    robot.get_observation()


def test_an_episode_starts_the_same_from_anywhere(session):
    robot = make_toy(session, seed=3, sim=SceneConfig(noise="harsh"))
    robot.connect()
    link = get_session(session)

    def roll(episode: int) -> np.ndarray:
        link.begin_episode(episode)
        rows = []
        for _ in range(5):
            rows.append([v for v in robot.get_observation().values() if isinstance(v, float)])
            robot.send_action({"lift.pos": 0.1})
        return np.array(rows)

    first, other, again = roll(0), roll(1), roll(0)
    robot.disconnect()
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


# The teleoperator.


@pytest.mark.slow
@pytest.mark.parametrize("retargeter", ["direct", "mpc"])
def test_a_third_robot_is_driven(session, retargeter):
    robot, teleop = make_toy(session), make_teleop(session, retargeter)
    assert list(teleop.action_features) == list(robot.action_features)
    teleop.connect()
    robot.connect()
    action = {}
    for _ in range(60):
        robot.get_observation()
        action = teleop.get_action()
        assert list(action) == list(robot.action_features)
        assert robot.send_action(action) == action
    tick = get_session(session).tick
    assert tick is not None
    assert tick.engaged
    assert tick.goal is not None
    assert tick.goal.mode in Mode
    assert tick.command is not None
    assert tick.command.shape == (2,)
    moved = [action[f"{joint}.pos"] for joint in ARM_JOINTS]
    assert np.abs(moved).max() > 1e-3
    teleop.disconnect()
    robot.disconnect()


def test_a_tick_grows_stage_by_stage(session):
    robot, teleop = make_toy(session), make_teleop(session)
    teleop.connect()
    robot.connect()
    link = get_session(session)
    robot.send_action({})
    assert link.tick is None  # nobody has observed it yet
    robot.get_observation()
    observed = link.tick
    assert observed is not None
    assert observed.command is None
    assert observed.executed is None
    action = teleop.get_action()
    decided = link.tick
    assert decided is not None
    assert decided.state is observed.state
    assert decided.command is not None
    robot.send_action(action)
    executed = link.tick
    assert executed is not None
    assert executed.command is decided.command
    assert executed.executed == action
    assert observed.command is None  # a tick that somebody holds does not change
    robot.get_observation()
    link.put(decided)  # too late: the next tick has begun
    assert link.tick is not None
    assert link.tick.command is None
    link.confirm_reset()
    link.put(decided)
    assert link.tick is None
    teleop.disconnect()
    robot.disconnect()


def test_teleoperator_before_robot(session):
    teleop = make_teleop(session)
    assert teleop.action_features == {}
    assert teleop.feedback_features == {}
    teleop.connect()
    robot = make_toy(session)
    robot.connect()
    with pytest.raises(LinkError) as error:
        teleop.get_action()
    assert str(error.value) == (
        f"xop_toy in session '{session}' has published no state yet. Call its get_observation() "
        "before get_action()."
    )
    robot.get_observation()
    assert list(teleop.get_action()) == list(robot.action_features)
    teleop.disconnect()
    robot.disconnect()


def test_no_robot_in_the_session(session):
    teleop = make_teleop(session)
    teleop.connect()
    with pytest.raises(LinkError) as error:
        teleop.get_action()
    assert str(error.value) == (
        f"no xop robot in session '{session}'. Use --robot.type=xop_g1, xop_rby1 or xop_rby1m with "
        f"--robot.session={session}, the same as --teleop.session."
    )


def test_two_robots_in_the_session(session):
    robots = [make_toy(session), make_toy(session)]
    teleop = make_teleop(session)
    teleop.connect()
    with pytest.raises(LinkError) as error:
        teleop.get_action()
    assert str(error.value) == (
        f"2 robots in session '{session}' (xop_toy, xop_toy); a teleoperator drives one. Give "
        "each pair its own --robot.session and --teleop.session."
    )
    robots.clear()


def test_a_robot_that_is_gone_left_the_session(session):
    robot = make_toy(session)
    del robot
    with pytest.raises(LinkError, match="no xop robot in session"):
        _ = get_session(session).robot


def test_teleoperator_not_connected(session):
    with pytest.raises(NotConnected, match=r"Xop is not connected. Call connect\(\) first."):
        make_teleop(session).get_action()


def test_bad_operator_is_refused_before_any_robot_moves(session, tmp_path):
    with pytest.raises(UnknownName, match="unknown device 'wand'. Known: "):
        make_teleop(session, type="wand")
    missing = tmp_path / "nobody.npz"
    robot = make_toy(session)
    teleop = make_teleop(session, type="replay", path=str(missing))
    with pytest.raises(BadRecording, match=f"operator recording '{missing}': "):
        teleop.connect()
    assert not robot.is_connected


def test_lerobot_makes_the_teleoperator(session):
    config = make_teleop(session).config
    assert type(make_teleoperator_from_config(config)).__name__ == "Xop"
