"""What this project changes in LeRobot's modules, for whom, and when it stays out."""

from __future__ import annotations

import gc
import logging
import math
import signal
import sys
import types
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_robot import ForeignRobot, ForeignRobotConfig, ForeignTeleopConfig
from lerobot.configs.dataset import DatasetRecordConfig
from lerobot.datasets import LeRobotDataset
from lerobot.rollout import context as rollout_module
from lerobot.scripts import lerobot_record as record_module
from lerobot.utils.keyboard_input import apply_recording_control
from lerobot_rows import get_row
from toy_robot import SMALL, XopToyConfig, make_teleop, make_toy

from tests.recording.test_dataset import STREAMING, tick
from xop_lerobot.core.errors import BadValue, LinkError
from xop_lerobot.recording import host, lerobot_patches
from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.facts import read_facts
from xop_lerobot.recording.lerobot_patches import LeRobotMisfit
from xop_lerobot.recording.opening import DatasetExists, WrongFps
from xop_lerobot.recording.record import build_features

STOCK_DATASET, STOCK_LOOP = LeRobotDataset, record_module.record_loop


@pytest.fixture
def session(request) -> str:
    return request.node.name


@pytest.fixture(autouse=True)
def leave_lerobot_as_it_was():
    lerobot_patches._said.clear()
    yield
    gc.collect()
    assert record_module.LeRobotDataset is STOCK_DATASET
    assert rollout_module.LeRobotDataset is STOCK_DATASET
    assert record_module.record_loop is STOCK_LOOP
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def record(robot, teleop, root: Path, **dataset):
    """LeRobot's own `record`, without a terminal."""
    settings = {
        "repo_id": "local/data", "single_task": "play", "root": root, "fps": 25,
        "episode_time_s": 0.4, "reset_time_s": 0, "num_episodes": 2, "push_to_hub": False,
        "no_stamp": True, "streaming_encoding": True,
    }  # fmt: skip
    flags = DatasetRecordConfig(**(settings | dataset))
    config = record_module.RecordConfig(
        robot=robot, dataset=flags, teleop=teleop, play_sounds=False
    )
    return record_module.record(config)


def get_dataset_class() -> type[XopDataset]:
    """What LeRobot's `record` makes datasets of."""
    ours = record_module.LeRobotDataset
    assert issubclass(ours, XopDataset)
    return ours


def test_an_xop_teleoperator_brings_its_dataset(session):
    teleop = make_teleop(session)
    ours = get_dataset_class()
    assert ours.session_name == session
    assert rollout_module.LeRobotDataset is ours
    assert record_module.record_loop is not STOCK_LOOP
    assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    teleop.disconnect()


def test_two_teleoperators_leave_nothing_behind(session):
    first, second = make_teleop(f"{session}-1"), make_teleop(f"{session}-2")
    first.disconnect()
    assert get_dataset_class().session_name == f"{session}-2"
    second.disconnect()


def test_columns_can_be_left_out(session):
    teleop = make_teleop(session)
    teleop.host.remove()
    bare = host.Host(session, extra_columns=False)
    bare.install()
    assert get_dataset_class().extra_columns is False
    bare.remove()
    teleop.disconnect()


def read_files(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def test_others_get_stock_datasets(session, tmp_path, monkeypatch):
    """A foreign pair records the same files, byte for byte, as without this project."""

    def run(name: str) -> dict[str, bytes]:
        ticks = iter(range(10**9))
        clock = types.SimpleNamespace(perf_counter=lambda: 0.01 * next(ticks))
        monkeypatch.setattr(record_module, "time", clock)
        pair = ForeignRobotConfig(), ForeignTeleopConfig()
        dataset = record(*pair, tmp_path / name)
        assert type(dataset) is LeRobotDataset
        return read_files(tmp_path / name)

    before = run("before")
    make_teleop(session).disconnect()
    after = run("after")
    assert before == after
    assert len([name for name in after if name.endswith(".parquet")]) == 3
    assert not [name for name in after if "xop" in name]


def test_a_foreign_robot_with_an_xop_teleoperator_is_refused(session, tmp_path):
    config = make_teleop(session).config
    with pytest.raises(LinkError, match=f"no xop robot in session '{session}'"):
        record(ForeignRobotConfig(), config, tmp_path / "data")
    assert not (tmp_path / "data").exists()


def run_xop(session, root, teleop=None, **dataset):
    robot = XopToyConfig(session=session, **SMALL)
    return record(robot, teleop or make_teleop(session).config, root, **dataset)


@pytest.mark.slow
def test_lerobot_records_lockstep_episodes_of_exact_length(session, tmp_path, monkeypatch):
    """However slow the machine: here LeRobot sees a clock that runs a thousand times as fast."""
    ticks = iter(range(10**9))
    clock = types.SimpleNamespace(perf_counter=lambda: float(next(ticks)), sleep=lambda _: None)
    monkeypatch.setattr(record_module, "time", clock)
    dataset = run_xop(session, tmp_path / "data", reset_time_s=60)
    assert isinstance(dataset, XopDataset)
    loaded = LeRobotDataset("local/data", root=tmp_path / "data")
    assert (loaded.num_episodes, len(loaded)) == (2, 20)
    assert get_row(loaded, 19)["operator.engaged"].item()
    assert [row["length"] for row in read_facts(tmp_path / "data")] == [10, 10]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_dataset(session, tmp_path):
    tables = []
    for name in ("first", "second"):
        run_xop(session, tmp_path / name, num_episodes=1)
        dataset = LeRobotDataset("local/data", root=tmp_path / name)
        tables.append((dataset.hf_dataset.with_format("numpy")[:], dataset[9]))
    (first, last), (second, other) = tables
    for key in set(first) - {"time.wall", "retargeter.health"}:
        assert np.array_equal(np.stack(first[key]), np.stack(second[key])), key
    image = "observation.images.head"
    assert np.array_equal(last[image].numpy(), other[image].numpy())


def test_an_episode_ends_when_the_device_has_played_out(session, tmp_path, monkeypatch):
    from xop_lerobot.operator.devices.scripted import ScriptedDevice

    monkeypatch.setattr(ScriptedDevice, "is_finished", lambda self, time: time > 1.1)
    run_xop(session, tmp_path / "data", num_episodes=1, episode_time_s=60)
    (facts,) = read_facts(tmp_path / "data")
    assert facts["finished"] is True
    assert facts["length"] == 4


def test_mistakes_are_refused_before_the_robot_moves(session, tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_robot_xop.xop_robot.XopRobot.connect", lambda *_: 1 / 0)
    with pytest.raises(WrongFps):
        run_xop(session, tmp_path / "data", fps=30)
    with pytest.raises(DatasetExists):
        run_xop(session, tmp_path)


def test_a_slow_lockstep_loop_is_not_complained_of(session, tmp_path, monkeypatch, caplog):
    robot, teleop = make_toy(session), make_teleop(session)
    said = []

    def loop(robot, events, fps, dataset=None, teleop=None, control_time_s=None):
        logging.warning("Record loop is running slower (1 Hz)")
        logging.warning("something else")
        said.append(control_time_s)

    wrapped = teleop.host._wrap_loop(loop)
    dataset = types.SimpleNamespace(fps=25, begin=lambda events, limit: said.append(limit))
    wrapped(robot=robot, events={}, fps=25, dataset=dataset, control_time_s=2)
    assert said == [50, math.inf]
    assert [record.message for record in caplog.records] == ["something else"]
    wrapped(robot=ForeignRobot(ForeignRobotConfig()), events={}, fps=25, control_time_s=3)
    assert said[-1] == 3
    teleop.disconnect()
    robot.disconnect()


def test_the_pause_between_episodes_is_for_people(session):
    robot, teleop = make_toy(session), make_teleop(session)
    paused = []

    def loop(robot, events, fps, dataset=None, teleop=None, control_time_s=None):
        paused.append(control_time_s)

    person = host.Host(session, has_person=True)
    for each in (teleop.host, person):
        each._wrap_loop(loop)(robot=robot, events={}, fps=25, control_time_s=60)
    assert paused == [60]
    teleop.disconnect()
    robot.disconnect()


def moved_create(cls, name, fps, features, root=None):
    """A `create` whose first parameter has another name."""


def moved_loop(robot, events, fps, dataset=None, teleop=None):
    """A `record_loop` without `control_time_s`."""


@pytest.mark.parametrize(
    ("owner", "name", "moved", "fault"),
    [
        (
            record_module,
            "record_loop",
            moved_loop,
            "the patch 'loop of lerobot-record', made for 0.6.1: "
            "lerobot.scripts.lerobot_record.record_loop() must take robot, events, dataset, "
            "control_time_s, and takes robot, events, fps, dataset, teleop. In lerobot-record an "
            "episode in lock-step would end by the wall clock, and gestures would not end any. Use "
            "xop-record, which takes the same flags.",
        ),
        (
            record_module,
            "LeRobotDataset",
            None,
            "the patch 'dataset of lerobot-record', made for 0.6.1: "
            "lerobot.scripts.lerobot_record.LeRobotDataset is expected, and "
            "lerobot.scripts.lerobot_record has no LeRobotDataset. lerobot-record cannot record "
            "the operator's columns. Use xop-record, which takes the same flags.",
        ),
    ],
)
def test_if_lerobot_has_moved_lerobot_record_is_refused(
    session, monkeypatch, owner, name, moved, fault
):
    """And LeRobot is left as it is, while programs with a loop of their own go on."""
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, moved)
        before = (record_module.LeRobotDataset, record_module.record_loop)
        with pytest.raises(LeRobotMisfit) as refusal:
            make_teleop(session)
        assert str(refusal.value) == f"LeRobot {version('lerobot')} does not fit {fault}"
        assert (record_module.LeRobotDataset, record_module.record_loop) == before
        with host.own_loop():
            teleop = make_teleop(session)
        assert (record_module.LeRobotDataset, record_module.record_loop) == before
        teleop.disconnect()


def test_no_dataset_is_made_of_a_lerobot_that_has_moved(session, tmp_path, monkeypatch):
    monkeypatch.setattr(LeRobotDataset, "create", classmethod(moved_create))
    robot = make_toy(session)
    with pytest.raises(LeRobotMisfit) as refusal:
        XopDataset.bind(session).create("local/toy", 25, {}, root=tmp_path / "data")
    assert str(refusal.value) == (
        f"LeRobot {version('lerobot')} does not fit the patch 'subclass of LeRobotDataset', made "
        "for 0.6.1: lerobot.datasets.LeRobotDataset.create() must take repo_id, fps, features, "
        "root, and takes name, fps, features, root. Nothing can be recorded. Install LeRobot "
        "0.6.1, or a newer xop-lerobot."
    )
    robot.disconnect()


@pytest.mark.parametrize("module", ["lerobot.scripts.lerobot_record", "lerobot.rollout.context"])
def test_a_command_whose_module_has_moved_is_noticed(session, monkeypatch, caplog, module):
    """The program's name tells that it runs."""
    command = "lerobot-record" if "record" in module else "lerobot-rollout"
    other = {"lerobot-record": "lerobot.rollout.context"}.get(command, record_module.__name__)
    with monkeypatch.context() as patch:
        patch.delitem(sys.modules, other)
        patch.setitem(sys.modules, module, None)
        patch.setattr(sys, "argv", [f"/usr/bin/{command}"])
        if command == "lerobot-record":
            with pytest.raises(LeRobotMisfit, match="import of lerobot.scripts.lerobot_record"):
                make_teleop(session)
        else:
            make_teleop(session).disconnect()
            assert "import of lerobot.rollout.context halted" in caplog.text


# LeRobot after 0.6.1: the loops have a timer and no rate, and the timer complains of slow ticks.


def next_record_loop(robot, events, timer, dataset=None, teleop=None, control_time_s=None):
    """LeRobot's next `record_loop`, reduced to what it is called with and how it ends."""
    timer.run(robot, teleop, events, dataset, control_time_s)


class NextStrategy:
    """LeRobot's next `EpisodicStrategy`; `timer` runs the loop with `driver` as the policy."""

    driver = None

    def __init__(self) -> None:
        self._interpolator = None

    def _policy_loop(
        self, ctx, robot, events, features, timer, control_time_s, dataset, single_task
    ):
        timer.run(robot, self.driver, events, dataset, control_time_s)


class NextTimer:
    """Stands for LeRobot's next `CycleTimer`, on a clock on which every tick is far too slow."""

    def __init__(self, presses: tuple[int, ...] = ()) -> None:
        self._presses = presses

    def run(self, robot, teleop, events, dataset, control_time_s) -> None:
        elapsed, frame = 0.0, 0
        while elapsed < control_time_s and not events["exit_early"]:
            tick(robot, teleop, dataset)
            warner = logging.getLogger("lerobot.utils.cycle_timer")
            warner.warning("Control loop is running slower (1.0 Hz) than the target FPS (25 Hz).")
            elapsed, frame = elapsed + 1.0, frame + 1
            events["exit_early"] |= frame in self._presses
        events["exit_early"] = False


def make_events() -> dict[str, bool]:
    return dict.fromkeys(("exit_early", "rerecord_episode", "stop_recording"), False)


@pytest.fixture
def recording(session, tmp_path):
    """A connected pair and its dataset."""
    robot, teleop = make_toy(session), make_teleop(session)
    teleop.connect()
    robot.connect()
    features = build_features(robot, use_videos=True)
    bound = XopDataset.bind(session)
    dataset = bound.create("local/toy", 25, features, root=tmp_path / "data", **STREAMING)
    yield robot, teleop, dataset
    dataset.finalize()
    teleop.disconnect()
    robot.disconnect()


def test_the_next_record_loop_ends_by_frames(recording, caplog):
    robot, teleop, dataset = recording
    loop = teleop.host._wrap_loop(next_record_loop)
    events = make_events()
    loop(robot, events, NextTimer(), dataset=dataset, teleop=teleop, control_time_s=0.2)
    dataset.save_episode()
    assert [row["length"] for row in read_facts(dataset.root)] == [5]
    assert "slower" not in caplog.text


def test_the_next_rollouts_end_by_frames(session, recording, monkeypatch, caplog):
    robot, teleop, dataset = recording
    monkeypatch.setattr(NextStrategy, "driver", teleop)
    teleop.host.remove()
    stock = NextStrategy._policy_loop
    with monkeypatch.context() as patch:
        patch.setattr("lerobot.rollout.strategies.episodic.EpisodicStrategy", NextStrategy)
        teleop.host.install()
        assert NextStrategy._policy_loop is not stock
        NextStrategy()._policy_loop(
            ctx=None, robot=robot, events=make_events(), features={}, timer=NextTimer(),
            control_time_s=0.2, dataset=dataset, single_task="play",
        )  # fmt: skip
        dataset.save_episode()
        teleop.host.remove()
    assert NextStrategy._policy_loop is stock
    assert [row["length"] for row in read_facts(dataset.root)] == [5]
    assert "slower" not in caplog.text
    assert "does not fit" not in caplog.text


def hide(func):
    """LeRobot's `safe_stop_image_writer`, under which a loop has no signature of its own."""

    def wrapper(*args, **kwargs):
        return func(*args, **kwargs)

    return wrapper


def test_the_next_lerobot_record_is_patched(recording, monkeypatch, caplog):
    """From its own module, and put back."""
    robot, teleop, dataset = recording
    teleop.host.remove()
    stock = hide(next_record_loop)
    with monkeypatch.context() as patch:
        patch.setattr(record_module, "record_loop", stock)
        teleop.host.install()
        assert record_module.record_loop is not stock
        next_module: Any = record_module
        next_module.record_loop(
            robot=robot, events=make_events(), timer=NextTimer(), dataset=dataset, teleop=teleop,
            control_time_s=0.2,
        )  # fmt: skip
        dataset.save_episode()
        teleop.host.remove()
        assert record_module.record_loop is stock
    assert [row["length"] for row in read_facts(dataset.root)] == [5]
    assert "slower" not in caplog.text
    assert "does not fit" not in caplog.text


class NoLoop:
    _interpolator = None


class OtherLoop:
    _interpolator = None

    def _policy_loop(self, events, dataset, seconds):
        pass


@pytest.mark.parametrize(
    ("strategy", "fault"),
    [
        (
            None,
            "EpisodicStrategy._policy_loop() is expected, and "
            "lerobot.rollout.strategies.episodic has no EpisodicStrategy; "
            "lerobot.rollout.strategies.episodic.EpisodicStrategy is expected, and "
            "lerobot.rollout.strategies.episodic has no EpisodicStrategy",
        ),
        (
            NoLoop,
            "EpisodicStrategy._policy_loop() is expected, and "
            "lerobot.rollout.strategies.episodic.EpisodicStrategy has no _policy_loop",
        ),
        (
            OtherLoop,
            "EpisodicStrategy._policy_loop() must take events, dataset, control_time_s, and takes "
            "events, dataset, seconds",
        ),
    ],
)
def test_a_rollout_that_cannot_be_held_to_its_length_says_so(
    session, monkeypatch, caplog, strategy, fault
):
    with monkeypatch.context() as patch:
        patch.setattr("lerobot.rollout.strategies.episodic.EpisodicStrategy", strategy)
        teleop = make_teleop(session)
        # The columns are recorded all the same.
        assert issubclass(rollout_module.LeRobotDataset, XopDataset)
        teleop.disconnect()
    assert caplog.messages == [
        f"LeRobot {version('lerobot')} does not fit the patch 'loop of lerobot-rollout', made for "
        f"0.6.1: lerobot.rollout.strategies.episodic.{fault}. In lerobot-rollout an episode in "
        "lock-step ends by the wall clock: its length depends on the machine."
    ]


def test_lockstep_takes_no_actions_between_the_policys(session, recording):
    _, _, dataset = recording
    loop = host.count_in_frames(NextStrategy._policy_loop, session)
    strategy = types.SimpleNamespace(_interpolator=types.SimpleNamespace(multiplier=2))
    with pytest.raises(BadValue) as refusal:
        loop(
            strategy, ctx=None, robot=None, events=make_events(), features={}, timer=None,
            control_time_s=1, dataset=dataset, single_task="play",
        )  # fmt: skip
    assert str(refusal.value) == (
        "--interpolation_multiplier must be 1 with a robot in lock-step, got 2: each action that "
        "is sent takes 1/25 s. Use --robot.clock=realtime for more"
    )


# Keys that are pressed again while an episode is saved.


@pytest.mark.slow
@pytest.mark.parametrize("key", ["right", "left"])
def test_a_key_that_is_pressed_again_is_not_for_the_next_episode(recording, key):
    """The second press comes while the first episode is saved, the third while the robot resets."""
    robot, teleop, dataset = recording
    loop = teleop.host._wrap_loop(next_record_loop)
    events, start = make_events(), robot._start_episode

    def run(*presses: int) -> None:
        loop(robot, events, NextTimer(presses), dataset=dataset, teleop=teleop, control_time_s=0.4)

    run(3)
    dataset.save_episode()
    apply_recording_control(key, events)
    robot._start_episode = lambda: (apply_recording_control(key, events), start())
    run()
    assert events == make_events()
    dataset.save_episode()
    assert [row["length"] for row in read_facts(dataset.root)] == [3, 10]


def test_esc_counts_whenever_it_is_pressed(recording):
    """Also while the robot resets; the episode that has not begun is left out."""
    robot, teleop, dataset = recording
    loop = teleop.host._wrap_loop(next_record_loop)
    events, start = make_events(), robot._start_episode
    robot._start_episode = lambda: (apply_recording_control("esc", events), start())
    loop(robot, events, NextTimer(), dataset=dataset, teleop=teleop, control_time_s=9)
    assert (events["stop_recording"], events["rerecord_episode"]) == (True, True)


def test_an_episode_without_a_frame_is_not_saved(recording, caplog):
    _, _, dataset = recording
    dataset.save_episode()  # as LeRobot's rollouts do at their end
    assert not caplog.records
    dataset.begin(make_events(), 9)
    dataset.save_episode()
    assert dataset.num_episodes == 0
    assert [record.message for record in caplog.records] == [
        "Episode 0 has no frame; it is not saved."
    ]
