"""LeRobot's own commands, and xop-record, from the command line to the data and back.

The commands run in this process, as importing LeRobot's scripts takes ten seconds each time.
"""

from __future__ import annotations

import importlib
import json
import signal
import sys
import threading
import time
from pathlib import Path

import draccus
import numpy as np
import pytest
import toy_robot  # registers the toy
from lerobot.datasets import LeRobotDataset
from lerobot.scripts.lerobot_record import RecordConfig
from lerobot.utils.keyboard_input import apply_recording_control
from lerobot_rows import get_episodes, get_row

from xop_lerobot.control.client import ControlClient
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.facts import read_facts
from xop_lerobot.recording.record import XopRecordConfig
from xop_lerobot.session import get_session

pytestmark = pytest.mark.slow

REPO = Path(__file__).parents[2]
ROBOT = ("--robot.type=xop_toy", "--robot.width=64", "--robot.height=48")
TELEOP = (
    "--teleop.type=xop",
    "--teleop.device.path=g1_squat_walk_reach",
    "--teleop.retargeter.type=direct",
)


def run(monkeypatch, command: str, *flags: str) -> None:
    """Run `command` with `flags`, and leave no signal handler behind."""
    name = command.replace("-", "_")
    module = "xop_lerobot.recording.record" if name == "xop_record" else f"lerobot.scripts.{name}"
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(sys, "argv", [command, *flags])
    try:
        importlib.import_module(module).main()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def record_flags(root: Path, **changes: object) -> list[str]:
    flags = {
        "repo_id": "local/toy", "root": root, "fps": 25, "num_episodes": 2, "reset_time_s": 0,
        "episode_time_s": 0.4, "single_task": "play", "push_to_hub": "false",
        "streaming_encoding": "true", "no_stamp": "true",
    } | changes  # fmt: skip
    return [f"--dataset.{key}={value}" for key, value in flags.items()]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A dataset of two episodes, by stock `lerobot-record`."""
    root = tmp_path_factory.mktemp("recorded") / "data"
    with pytest.MonkeyPatch.context() as patch:
        flags = (*ROBOT, *TELEOP, *record_flags(root), "--play_sounds=false")
        run(patch, "lerobot-record", *flags)
    return root


def test_lerobot_record(recorded):
    dataset = LeRobotDataset("local/toy", root=recorded)
    assert (dataset.num_episodes, len(dataset)) == (2, 20)
    assert get_row(dataset, 15)["operator.engaged"].item()
    assert dataset.meta.robot_type == "xop_toy"


def test_xop_record_writes_the_same(recorded, tmp_path, monkeypatch):
    root = tmp_path / "data"
    run(monkeypatch, "xop-record", *ROBOT, *TELEOP, *record_flags(root), "--play_sounds=false")
    ours, theirs = (LeRobotDataset("local/toy", root=path) for path in (root, recorded))
    assert list(ours.features) == list(theirs.features)
    for key in ("action", "observation.state", "goal.head", "retargeter.command", "time.sim"):
        first, second = (
            np.stack(each.hf_dataset.with_format("numpy")[key]) for each in (ours, theirs)
        )
        assert np.array_equal(first, second), key


def test_resuming_from_the_command_line(recorded, tmp_path, monkeypatch):
    root = tmp_path / "data"
    flags = [*ROBOT, *TELEOP, *record_flags(root, num_episodes=1), "--play_sounds=false"]
    run(monkeypatch, "lerobot-record", *flags)
    run(monkeypatch, "lerobot-record", *flags, "--resume=true")
    assert [row["episode_index"] for row in read_facts(root)] == [0, 1]
    assert LeRobotDataset("local/toy", root=root).num_episodes == 2


@pytest.mark.parametrize("command", ["lerobot-record", "xop-record"])
def test_a_key_pressed_twice(tmp_path, monkeypatch, command):
    """The second press comes while the episode is saved; the session goes on with whole ones."""
    save = XopDataset.save_episode

    def save_and_press(self: XopDataset, *args, **kwargs) -> None:
        events = self._events
        assert isinstance(events, dict)
        save(self, *args, **kwargs)
        apply_recording_control("right", events)

    monkeypatch.setattr(XopDataset, "save_episode", save_and_press)
    root = tmp_path / "data"
    flags = [*ROBOT, *TELEOP, *record_flags(root, num_episodes=3), "--play_sounds=false"]
    run(monkeypatch, command, *flags)
    assert [row["length"] for row in read_facts(root)] == [10, 10, 10]


@pytest.mark.parametrize("command", ["lerobot-record", "xop-record"])
def test_real_time(tmp_path, monkeypatch, command):
    """On the wall clock an episode ends by the wall clock, and says how it went."""
    root = tmp_path / "data"
    flags = [*ROBOT, *TELEOP, *record_flags(root, num_episodes=2, episode_time_s=1)]
    run(monkeypatch, command, *flags, "--robot.clock=realtime", "--play_sounds=false")
    dataset = LeRobotDataset("local/toy", root=root)
    episodes = np.array(dataset.hf_dataset["episode_index"])
    times = np.ravel(dataset.hf_dataset["time.sim"])
    for facts in read_facts(root):
        assert facts["clock"] == "realtime"
        assert facts["length"] <= 26
        assert facts["late"] == (facts["real_fps"] < 0.95 * 25)
        stamps = times[episodes == facts["episode_index"]]
        assert len(stamps) == facts["length"]
        assert (np.diff(stamps) >= 0).all()
        # The second in which the robot starts over and settles is not on the episode's time.
        assert len(stamps) > 1


def test_lerobot_teleoperate(monkeypatch):
    run(monkeypatch, "lerobot-teleoperate", *ROBOT, *TELEOP, "--fps=50", "--teleop_time_s=1")


def test_lerobot_replay(recorded, monkeypatch):
    sent = []
    execute = toy_robot.XopToy.send_action
    monkeypatch.setattr(
        toy_robot.XopToy,
        "send_action",
        lambda self, action: sent.append(execute(self, action)) or sent[-1],
    )
    dataset = ("--dataset.repo_id=local/toy", f"--dataset.root={recorded}", "--dataset.episode=1")
    run(monkeypatch, "lerobot-replay", *ROBOT, *dataset, "--play_sounds=false")
    actions = LeRobotDataset("local/toy", root=recorded).hf_dataset[10:]["action"]
    replayed = np.array([list(action.values()) for action in sent])
    assert replayed == pytest.approx(np.stack(actions), abs=1e-6)


@pytest.fixture(scope="module")
def policy(recorded, tmp_path_factory) -> Path:
    """ACT after two steps of `lerobot-train`."""
    pytest.importorskip("accelerate", reason="lerobot-train needs accelerate")
    out = tmp_path_factory.mktemp("train") / "out"
    act = {
        "type": "act", "device": "cpu", "push_to_hub": "false", "use_vae": "false",
        "pretrained_backbone_weights": "null", "dim_model": 32, "n_heads": 2,
        "dim_feedforward": 32, "n_encoder_layers": 1, "chunk_size": 5, "n_action_steps": 5,
    }  # fmt: skip
    flags = [f"--policy.{key}={value}" for key, value in act.items()]
    flags += ["--dataset.repo_id=local/toy", f"--dataset.root={recorded}", "--steps=2"]
    flags += ["--batch_size=2", "--num_workers=0", f"--output_dir={out}", "--save_freq=2"]
    with pytest.MonkeyPatch.context() as patch:
        run(patch, "lerobot-train", *flags)
    return out / "checkpoints" / "last" / "pretrained_model"


def test_lerobot_train_takes_state_and_pictures(policy):
    from lerobot.configs import PreTrainedConfig

    config = PreTrainedConfig.from_pretrained(policy)
    assert config.input_features is not None
    assert set(config.input_features) == {"observation.state", "observation.images.head"}
    assert config.output_features is not None
    assert set(config.output_features) == {"action"}


def test_lerobot_rollout(policy, tmp_path, monkeypatch):
    root = tmp_path / "data"
    executed, execute = [], toy_robot.XopToy.send_action
    monkeypatch.setattr(
        toy_robot.XopToy,
        "send_action",
        lambda self, action: executed.append(execute(self, action)) or executed[-1],
    )
    flags = [*ROBOT, *TELEOP, f"--policy.path={policy}", "--device=cpu", "--fps=25"]
    flags += ["--strategy.type=episodic", "--task=play", "--play_sounds=false"]
    flags += ["--strategy.smooth_handover=false"]
    flags += record_flags(root, repo_id="local/rollout_toy", episode_time_s=1)
    run(monkeypatch, "lerobot-rollout", *flags)
    dataset = LeRobotDataset("local/rollout_toy", root=root)
    # In lock-step an episode has its frames however slow the machine is, and the robot starts over.
    assert [facts["length"] for facts in read_facts(root)] == [25, 25]
    times = np.ravel(dataset.hf_dataset["time.sim"]).reshape(2, 25)
    assert times[0] == pytest.approx(times[1])
    assert np.diff(times) == pytest.approx(0.04, abs=1e-6)
    assert not any(dataset.hf_dataset["operator.engaged"])
    assert any(np.ravel(dataset.hf_dataset["robot.head"]))
    # What was executed, and not what the policy asked for.
    actions = np.array([list(action.values()) for action in executed[:50]], np.float32)
    assert np.array_equal(np.stack(dataset.hf_dataset["action"]), actions)


def test_a_policy_of_another_size_is_refused(policy, tmp_path, monkeypatch):
    """Before the robot is connected, and before a dataset is made."""
    monkeypatch.setattr("toy_robot.XopToy.connect", lambda *_: 1 / 0)
    robot = ("--robot.type=xop_toy", "--robot.width=96", "--robot.height=72")
    flags = [*robot, *TELEOP, f"--policy.path={policy}", "--device=cpu", "--fps=25"]
    flags += ["--strategy.type=episodic", "--task=play", "--play_sounds=false"]
    flags += record_flags(tmp_path / "data", repo_id="local/rollout_toy")
    with pytest.raises(BadValue, match="Use --robot.width=64 --robot.height=48$"):
        run(monkeypatch, "lerobot-rollout", *flags)
    assert not (tmp_path / "data").exists()


# Mistakes.


def test_xop_record_takes_our_types_only(tmp_path, monkeypatch):
    flags = ("--robot.type=koch_follower", "--robot.port=/dev/null", *TELEOP)
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, "xop-record", *flags, *record_flags(tmp_path / "data"))
    assert str(stop.value) == (
        "error: xop-record takes --robot.type=xop_g1, xop_rby1 or xop_rby1m and "
        "--teleop.type=xop, got koch_follower and xop. Use lerobot-record for others"
    )


def test_an_unknown_flag_names_it(tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit):
        flags = record_flags(tmp_path / "data")
        run(monkeypatch, "xop-record", *ROBOT, *TELEOP, "--robot.camz=[head]", *flags)
    assert "camz" in capsys.readouterr().err


BAD_FLAGS = {
    "--robot.fps=30": "robot.fps must divide the low-level policy's 50 Hz, got 30",
    "--robot.sim.noise=loud": "unknown noise preset 'loud'. Known: harsh, mild, off",
    "--robot.width=0": "an image must be at least 1 x 1 pixels, got 0 x 48",
    "--teleop.device.hold_s=-1": "device.hold_s must be finite and at least 0, got -1.0",
    "--teleop.device.mode=fly": "unknown device.mode 'fly'. Known: mobile, stationary",
    "--teleop.retargeter.preset=fast": (
        "unknown preset 'fast'. Known: aggressive, conservative, default, table1, table1_charitable"
    ),
    "--teleop.gestures.both_double_pinch=wave": (
        "unknown gestures.both_double_pinch 'wave'. Known: aggressive, conservative, default, none"
    ),
    "--teleop.retargeter.type=magic": "unknown retargeter 'magic'. Known: direct, mpc",
    "--teleop.alignment.walk_scale=0": "alignment.walk_scale must be finite and above 0, got 0.0",
}


@pytest.mark.parametrize("flag", BAD_FLAGS)
@pytest.mark.parametrize("command", ["lerobot-record", "xop-record"])
def test_a_bad_setting_says_what_is_wrong(tmp_path, monkeypatch, capsys, command, flag):
    """LeRobot's parser stops at the configuration, long before a robot is made."""
    robot = [each for each in ROBOT if not each.startswith(flag.split("=")[0])]
    with pytest.raises(SystemExit):
        run(monkeypatch, command, *robot, *TELEOP, *record_flags(tmp_path / "data"), flag)
    assert BAD_FLAGS[flag] in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_a_mistake_is_one_line(tmp_path, monkeypatch):
    flags = record_flags(tmp_path)
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, "xop-record", *ROBOT, *TELEOP, *flags)
    assert str(stop.value).startswith(f"error: dataset directory '{tmp_path}' exists already.")


@pytest.mark.parametrize("robot", ["g1", "rby1"])
@pytest.mark.parametrize("config_class", [RecordConfig, XopRecordConfig])
def test_configs_that_are_shipped(robot, config_class):
    path = REPO / "configs" / f"record_{robot}.yaml"
    config = draccus.parse(config_class, config_path=path, args=[])
    assert config.robot.type == f"xop_{robot}"
    assert config.robot.fps == config.dataset.fps
    assert config.dataset.rgb_encoder.vcodec == "h264"
    assert config.teleop.device.start_mode is Mode.STATIONARY


# Changed while it records.
@pytest.mark.parametrize("command", ["lerobot-record", "xop-record"])
def test_settings_change_while_it_records(tmp_path, monkeypatch, command):
    """Through the control socket, as another terminal does it, and into the episode."""
    root, path = tmp_path / "data", tmp_path / "xop.sock"
    answers: list[dict] = []

    def ask() -> None:
        """Change the preset as soon as some frames are recorded."""
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and len(answers) < 2:
            tick = get_session().tick
            if tick is None or tick.command is None:
                time.sleep(0.01)
                continue
            try:
                with ControlClient(path) as client:
                    time.sleep(0.2)
                    answers.append(client.request({"preset": "conservative"}))
                    answers.append(client.request({"weights": {"position": 3}}))
            except XopError:
                time.sleep(0.05)

    thread = threading.Thread(target=ask)
    thread.start()
    teleop = [flag for flag in TELEOP if "retargeter" not in flag]
    flags = [*ROBOT, *teleop, *record_flags(root, num_episodes=1, episode_time_s=12)]
    flags += [f"--teleop.control={path}", "--teleop.keys=true", "--play_sounds=false"]
    flags += ["--teleop.retargeter.threads=1"]
    run(monkeypatch, command, *flags)
    thread.join()
    assert not path.exists()
    assert answers[-1]["weights"] == {"position": 3}
    (facts,) = read_facts(root)
    assert facts["settings"]["preset"] == "default"
    changes = [each for each in facts["changes"] if each["source"] == "control"]
    assert [each["change"] for each in changes] == [
        {"preset": "conservative"}, {"weights": {"position": 3}},
    ]  # fmt: skip
    # The person in the script pinches twice to walk, and twice to stand.
    modes = [each["change"]["mode"] for each in facts["changes"] if each["source"] == "gesture"]
    assert modes == ["mobile", "stationary"]
    assert 0 < changes[0]["frame"] <= changes[1]["frame"] < facts["length"]
    dataset = LeRobotDataset("local/toy", root=root)
    stored = json.loads(get_episodes(dataset)[0]["xop/changes"])
    assert stored == facts["changes"]
    times = np.ravel(dataset.hf_dataset["time.sim"])
    assert times[changes[0]["frame"]] == changes[0]["time"]
