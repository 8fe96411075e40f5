"""The dataset: columns, facts, errors before anything moves, and durability."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from queue import Queue
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame, dataset_to_policy_features
from lerobot_rows import get_episodes, get_row
from toy_robot import get_state, make_teleop, make_toy, observe

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, LinkError, XopError
from xop_lerobot.core.shutdown import hold_signals
from xop_lerobot.core.state import FRAMES, Goal
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.recording import writer
from xop_lerobot.recording.columns import COST_NAMES, HEALTH_NAMES, Columns
from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.executed import put_executed
from xop_lerobot.recording.facts import compute_config_hash, read_facts
from xop_lerobot.recording.lerobot_patches import ROTATION, LeRobotMisfit
from xop_lerobot.recording.opening import BatchedEncoding, DatasetExists, WrongFps
from xop_lerobot.recording.record import build_features
from xop_lerobot.recording.writer import MAX_IMAGES, VideoQueue
from xop_lerobot.session import TaskStatus, Tick, get_session

REPO = Path(__file__).parents[2]
POSE = ["x", "y", "z", "qw", "qx", "qy", "qz"]
STREAMING = {"streaming_encoding": True, "encoder_queue_maxsize": 2}


@pytest.fixture
def session(request) -> str:
    return request.node.name


@pytest.fixture
def pair(session):
    """A connected robot and teleoperator."""
    robot, teleop = make_toy(session), make_teleop(session)
    teleop.connect()
    robot.connect()
    yield robot, teleop
    teleop.disconnect()
    robot.disconnect()


def create(session, robot, root, **options) -> XopDataset:
    features = build_features(robot, use_videos=True)
    options = {"robot_type": robot.name, **options}
    return XopDataset.bind(session).create("local/toy", 25, features, root=root, **options)


def tick(robot, teleop, dataset, act=None, outcome: TaskStatus | None = None) -> None:
    """One tick of LeRobot's loops; `act` stands in for the teleoperator, as a policy does.

    The toy has no task: `outcome` stands in for the status of one.
    """
    observation = robot.get_observation()
    action = act or teleop.get_action()
    robot.send_action(action)
    link = get_session(robot.config.session)
    assert link.tick is not None
    link.put(dataclasses.replace(link.tick, outcome=outcome))
    frame = build_dataset_frame(dataset.features, observation, prefix=OBS_STR)
    frame |= build_dataset_frame(dataset.features, action, prefix=ACTION)
    dataset.add_frame({**frame, "task": "play"})


def read_rows(root: Path, episode: int = 0) -> pd.DataFrame:
    files = sorted(root.glob("data/*/*.parquet"))
    table = pd.concat([pd.read_parquet(file) for file in files])
    return table.loc[table.episode_index == episode]


def stack(rows: pd.DataFrame, key: str) -> np.ndarray:
    return np.stack([np.atleast_1d(value) for value in rows[key]])


# Columns.


def test_columns_of_the_contract(session):
    robot = make_toy(session)
    features = Columns(get_session(session).robot).features
    assert {key: len(value["names"]) for key, value in features.items()} == {
        "operator.head": 7,
        "operator.left_wrist": 7,
        "operator.right_wrist": 7,
        "operator.pinch": 2,
        "operator.tracked": 3,
        "operator.engaged": 1,
        "goal.head": 7,
        "goal.left_wrist": 7,
        "goal.right_wrist": 7,
        "retargeter.command": 2,
        "retargeter.cost": len(COST_NAMES),
        "retargeter.health": len(HEALTH_NAMES),
        "robot.base_pose": 7,
        "robot.base_estimate": 7,
        "robot.head": 7,
        "robot.left_wrist": 7,
        "robot.right_wrist": 7,
        "robot.effort": 5,
        "time.sim": 1,
        "time.wall": 1,
        "next.success": 1,
        "next.done": 1,
    }
    assert features["goal.head"]["names"] == POSE
    assert not any(key.startswith(("observation", "action")) for key in features)
    robot.disconnect()


def make_frame() -> OperatorFrame:
    poses = [np.array([i, 2, 3, 1, 0, 0, 0.0]) for i in range(len(FRAMES))]
    return OperatorFrame(1.0, *poses, pinch=np.array([0.01, 0.02]), tracked=np.array([1, 0, 1]))


def make_tick(state, **changes) -> Tick:
    goal = Goal({"head": np.arange(7.0)}, mode=Mode.MOBILE)
    record = Tick(
        state=state,
        frame=make_frame(),
        goal=goal,
        command=np.array([0.1, 0.2]),
        cost={"tracking": 1.0, "total": 1.5},
        health={"solve_time": 0.01, "plan_age": 0.04},
    )
    return dataclasses.replace(record, **changes)


def test_row_says_what_the_tick_said(session, pair):
    state = observe(pair[0])
    columns = Columns(get_session(session).robot)
    row = columns.build_row(make_tick(state, outcome=TaskStatus(success=True, done=False)))
    for key, value in row.items():
        assert value.dtype == columns.features[key]["dtype"], key
        assert value.shape == columns.features[key]["shape"], key
    assert row["operator.right_wrist"].tolist() == [2, 2, 3, 1, 0, 0, 0]
    assert row["operator.tracked"].tolist() == [True, False, True]
    assert row["goal.head"].tolist() == list(range(7))
    assert row["goal.left_wrist"].tolist() == [0] * 7
    assert row["retargeter.command"] == pytest.approx([0.1, 0.2])
    assert row["retargeter.cost"][[0, -1]].tolist() == [1.0, 1.5]
    assert row["retargeter.health"] == pytest.approx([0.01, 0.04, *[0] * 6])
    assert (row["next.success"].item(), row["next.done"].item()) == (True, False)
    assert row["robot.base_pose"] == pytest.approx(state.true_qpos[:7])
    assert row["robot.head"][:3] == pytest.approx([0, 0, 1.0], abs=0.02)
    assert row["time.sim"].item() == state.time
    assert abs(row["time.wall"].item() - state.wall_time * 1e9) < 1e3


def test_robot_frames_are_those_of_the_simulation(session, pair):
    robot, teleop = pair
    for _ in range(30):
        robot.get_observation()
        robot.send_action(teleop.get_action())
    state = observe(robot)
    row = Columns(get_session(session).robot).build_row(Tick(state))
    for frame in FRAMES:
        assert row[f"robot.{frame}"] == pytest.approx(robot._plant.get_site_pose(frame), abs=1e-6)


def test_row_without_a_teleoperator_is_zero_and_flagged(session, pair):
    state = observe(pair[0])
    row = Columns(get_session(session).robot).build_row(Tick(state))
    assert not row["operator.engaged"].any()
    assert all(not row[key].any() for key in row if key.startswith(("operator", "goal")))


def test_no_column_is_ever_nan(session, pair):
    state = observe(pair[0])
    record = make_tick(state, command=np.array([np.nan, 1]), cost={"tracking": np.inf})
    row = Columns(get_session(session).robot).build_row(record)
    assert all(np.isfinite(value).all() for value in row.values())
    assert row["retargeter.command"].tolist() == [0, 1]


# Recording.


@pytest.mark.slow
def test_round_trip(session, pair, tmp_path):
    robot, teleop = pair
    root = tmp_path / "data"
    dataset = create(session, robot, root)
    assert set(dataset.features) == {
        "action", "observation.state", "observation.images.head",
        "timestamp", "frame_index", "episode_index", "index", "task_index",
    }  # fmt: skip
    for _ in range(2):
        for _ in range(6):
            tick(robot, teleop, dataset)
        dataset.save_episode()
    dataset.finalize()

    loaded = LeRobotDataset("local/toy", root=root)
    assert (loaded.num_episodes, loaded.num_frames) == (2, 12)
    item = get_row(loaded, 7)
    assert item["goal.head"].shape == (7,)
    assert item["observation.images.head"].shape == (3, 48, 64)
    assert item["time.wall"].item() > 1e18  # whole nanoseconds survive the way to a tensor
    assert loaded.features["operator.head"]["names"] == POSE
    stats = json.loads((root / "meta" / "stats.json").read_text())
    for key, values in stats.items():
        assert all(np.isfinite(np.ravel(value)).all() for value in values.values()), key

    # LeRobot gives a policy the state and the pictures, and asks it for the action.
    policy = dataset_to_policy_features(loaded.features)
    assert set(policy) == {"observation.state", "observation.images.head", "action"}

    # Both episodes are the same, as robot and operator start over in each.
    first, second = read_rows(root, 0), read_rows(root, 1)
    different = {"episode_index", "index", "time.wall", "retargeter.health"}
    for key in set(first.columns) - different:
        assert np.array_equal(stack(first, key), stack(second, key)), key
    assert np.diff(stack(first, "time.sim")[:, 0]) == pytest.approx(1 / 25)


@pytest.mark.slow
@pytest.mark.parametrize("use_videos", [True, False])
def test_tables_are_what_lerobot_writes(session, pair, tmp_path, monkeypatch, use_videos):
    """Leaving out the pass that embeds image files changes nothing, and it stays where needed."""
    robot, teleop = pair
    features = build_features(robot, use_videos=use_videos)
    tables = []
    for name, skip in (("ours", writer.skip_embedding), ("stock", lambda _: nullcontext())):
        monkeypatch.setattr("xop_lerobot.recording.dataset.skip_embedding", skip)
        bound = XopDataset.bind(session)
        dataset = bound.create(
            "local/toy", 25, features, root=tmp_path / name, use_videos=use_videos
        )
        for _ in range(5):
            tick(robot, teleop, dataset)
        dataset.save_episode()
        dataset.finalize()
        (path,) = dataset.root.glob("data/*/*.parquet")
        tables.append(pq.read_table(path))
    ours, stock = tables
    assert ours.schema == stock.schema
    for key in set(ours.column_names) - {"time.wall", "retargeter.health"}:
        assert ours[key].to_pylist() == stock[key].to_pylist(), key


@pytest.mark.slow
def test_facts_of_an_episode(session, pair, tmp_path):
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data")
    tick(robot, teleop, dataset)
    for i in range(3):
        tick(robot, teleop, dataset, outcome=TaskStatus(success=i > 0, done=i > 0))
    dataset.save_episode()
    dataset.finalize()
    root = dataset.root
    (facts,) = read_facts(root)
    assert facts["length"] == 4
    assert (facts["success"], facts["fallen"], facts["dropped_frames"]) == (True, False, 0)
    assert (facts["robot"], facts["scene"], facts["clock"]) == ("xop_toy", "empty", "lockstep")
    assert facts["versions"]["lerobot"] == "0.6.1"
    row = get_episodes(LeRobotDataset("local/toy", root=root))[0]
    assert row["xop/success"] is True
    assert row["xop/config_hash"] == facts["config_hash"]
    config = json.loads((root / "meta" / "xop" / "config.json").read_text())
    assert compute_config_hash(config) == facts["config_hash"]
    assert config["robot"]["type"] == "xop_toy"
    assert config["teleop"]["retargeter"]["type"] == "direct"


def test_a_cut_line_of_facts_is_left_out(tmp_path):
    path = tmp_path / "meta" / "xop" / "episodes.jsonl"
    path.parent.mkdir(parents=True)
    path.write_text('{"episode_index": 0}\n{"episode_ind')
    assert read_facts(tmp_path) == [{"episode_index": 0}]


def test_frames_that_a_policy_drives_have_no_operator(session, pair, tmp_path):
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data")
    tick(robot, teleop, dataset)
    tick(robot, teleop, dataset, act=robot.morphology.layout.to_dict(robot._last_action))
    dataset.save_episode()
    dataset.finalize()
    rows = read_rows(dataset.root)
    assert stack(rows, "operator.engaged")[:, 0].tolist() == [True, False]
    assert not stack(rows, "goal.head")[1].any()


def test_the_action_is_what_the_robot_executes(session, pair, tmp_path):
    """A policy may ask for more than the limits let through."""
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data")
    rest = robot.morphology.layout.to_dict(robot._last_action)
    executed = []
    for _ in range(2):
        tick(robot, teleop, dataset, act={**rest, "lift.pos": 9.0, "left_elbow.pos": -3.0})
        executed.append(list(robot.morphology.layout.to_dict(robot._last_action).values()))
    dataset.save_episode()
    dataset.finalize()
    actions = stack(read_rows(dataset.root), "action")
    assert np.array_equal(actions, np.array(executed, np.float32))
    assert 0 < actions[0, 0] < actions[1, 0] < 0.15


def test_actions_of_another_tick_or_robot_stay(session, pair, tmp_path):
    features = build_features(pair[0], use_videos=True)
    observation = pair[0].get_observation()
    tick = get_session(session).tick
    assert tick is not None
    executed = dataclasses.replace(tick, executed=pair[1].get_action())
    state = build_dataset_frame(features, observation, prefix=OBS_STR)["observation.state"]
    asked = np.full(6, 9.0, np.float32)
    frame = {"observation.state": state, "action": asked}
    assert put_executed(frame, None, features)["action"] is asked
    assert put_executed(frame, executed, features)["action"] is not asked
    late = frame | {"observation.state": state + 1}
    assert put_executed(late, executed, features)["action"] is asked
    hand = features | {"action": {"dtype": "float32", "shape": (1,), "names": ["hand.x"]}}
    assert put_executed(frame, executed, hand)["action"] is asked
    assert frame["action"] is asked


def test_frames_that_were_kept_back_are_refused(session, pair, tmp_path):
    """Their columns would be those of a later moment."""
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data")
    observation = robot.get_observation()
    action = teleop.get_action()
    robot.send_action(action)
    frame = build_dataset_frame(dataset.features, observation, prefix=OBS_STR)
    frame |= build_dataset_frame(dataset.features, action, prefix=ACTION)
    dataset.add_frame({**frame, "task": "play"})
    with pytest.raises(BadValue, match="^a frame came late: .* use another strategy, or --teleop"):
        dataset.add_frame({**frame, "task": "play"})


def test_a_frame_before_its_tick_is_complete_is_refused(session, pair, tmp_path):
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data")
    observation = robot.get_observation()
    frame = build_dataset_frame(dataset.features, observation, prefix=OBS_STR)
    frame |= build_dataset_frame(dataset.features, teleop.get_action(), prefix=ACTION)
    with pytest.raises(LinkError, match=rf"call send_action\(\) of xop_toy in session '{session}'"):
        dataset.add_frame({**frame, "task": "play"})
    get_session(session).confirm_reset()
    with pytest.raises(LinkError, match=r"call get_observation\(\) of xop_toy in session"):
        dataset.add_frame({**frame, "task": "play"})
    assert not dataset.has_pending_frames()


def test_an_episode_ends_by_itself(session, pair, tmp_path):
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data")
    events = {"exit_early": False}

    def count() -> int:
        frames = 0
        while not events["exit_early"]:
            success = frames >= 3
            tick(robot, teleop, dataset, outcome=TaskStatus(success=success, done=success))
            frames += 1
        events["exit_early"] = False
        dataset.clear_episode_buffer()
        return frames

    dataset.begin(events, 5)
    assert count() == 5
    dataset.begin(events, 9, stop_on_success=True)
    assert count() == 4


def test_clearing_starts_the_episode_over(session, pair, tmp_path):
    robot, teleop = pair
    dataset, qpos = create(session, robot, tmp_path / "data"), None
    for _ in range(2):
        for _ in range(4):
            tick(robot, teleop, dataset)
        qpos = get_state(robot).qpos
        dataset.clear_episode_buffer()
    tick(robot, teleop, dataset)
    assert get_state(robot).time == pytest.approx(1.0)
    assert get_session(session).episode == 0
    assert qpos is not None
    assert not np.array_equal(get_state(robot).qpos, qpos)


@pytest.mark.slow
def test_resume(session, pair, tmp_path):
    robot, teleop = pair
    root = tmp_path / "data"
    dataset = create(session, robot, root)
    tick(robot, teleop, dataset)
    tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    dataset = XopDataset.bind(session).resume("local/toy", root=root)
    assert get_session(session).episode == 1
    tick(robot, teleop, dataset)
    tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    assert LeRobotDataset("local/toy", root=root).num_episodes == 2
    assert [row["episode_index"] for row in read_facts(root)] == [0, 1]


def test_resuming_a_stock_dataset_leaves_its_columns_alone(session, pair, tmp_path, caplog):
    robot, teleop = pair
    root = tmp_path / "data"
    features = build_features(robot, use_videos=True)
    stock = LeRobotDataset.create("local/toy", 25, features, root=root, robot_type=robot.name)
    tick(robot, teleop, stock)
    tick(robot, teleop, stock)
    stock.save_episode()
    stock.finalize()
    with caplog.at_level(logging.WARNING):
        dataset = XopDataset.bind(session).resume("local/toy", root=root)
    assert "was recorded without the operator's columns" in caplog.text
    tick(robot, teleop, dataset)
    tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    loaded = LeRobotDataset("local/toy", root=root)
    assert loaded.num_episodes == 2
    assert "goal.head" not in loaded.features


# Refused before anything moves.


def test_existing_directory(session, pair, tmp_path):
    with pytest.raises(DatasetExists) as error:
        create(session, pair[0], tmp_path)
    assert str(error.value) == (
        f"dataset directory '{tmp_path}' exists already. Choose another --dataset.root, delete "
        "it, or add episodes to it with --resume=true"
    )


def test_wrong_fps(session, pair, tmp_path):
    features = build_features(pair[0], use_videos=True)
    with pytest.raises(WrongFps) as error:
        XopDataset.bind(session).create("local/toy", 30, features, root=tmp_path / "data")
    assert str(error.value) == (
        "the robot runs at 25 Hz (--robot.fps) and the dataset at 30 Hz (--dataset.fps); they "
        "must be equal. Use --dataset.fps=25"
    )
    assert not (tmp_path / "data").exists()


def test_videos_are_not_encoded_in_batches(session, pair, tmp_path):
    """A batch is encoded after its episodes are saved: whoever stops in between loses pictures."""
    root = tmp_path / "data"
    with pytest.raises(BatchedEncoding) as error:
        create(session, pair[0], root, batch_encoding_size=2)
    assert str(error.value) == (
        "--dataset.video_encoding_batch_size must be 1, got 2: an episode is saved with its "
        "videos, so that a later failure cannot lose them. To save sooner, use "
        "--dataset.streaming_encoding=true"
    )
    assert not root.exists()
    with pytest.raises(BatchedEncoding):
        XopDataset.bind(session).resume("local/toy", root=root, batch_encoding_size=3)
    assert not root.exists()


def test_no_robot(session, tmp_path):
    with pytest.raises(LinkError, match="no xop robot in session"):
        XopDataset.bind(session).create("local/toy", 25, {}, root=tmp_path / "data")


def test_an_empty_dataset_does_not_stay(session, pair, tmp_path):
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data")
    tick(robot, teleop, dataset)
    assert dataset, "lerobot-record finalizes its dataset `if dataset`, be it empty or not"
    dataset.finalize()
    assert not (tmp_path / "data").exists()


# Videos.


class FakeEncoder:
    """The parts of LeRobot's streaming encoder that `VideoQueue` reads."""

    def __init__(self, *, alive: bool = True) -> None:
        queue: Queue = Queue(maxsize=1)
        queue.put("frame")
        thread = threading.Thread(target=lambda: (time.sleep(0.05), queue.get()))
        if alive:
            thread.start()
        self._frame_queues, self._threads = {"head": queue}, {"head": thread}
        self._dropped_frames = {"head": 2, "scene": 1}


def test_waiting_for_the_encoder():
    encoder = FakeEncoder()
    VideoQueue(encoder).wait()
    assert not encoder._frame_queues["head"].full()


def test_a_dead_encoder_is_not_waited_for():
    VideoQueue(FakeEncoder(alive=False)).wait()


@pytest.mark.parametrize("alive", [True, False])
def test_pictures_that_wait_for_the_disk_are_bounded(monkeypatch, alive):
    """Who adds a frame waits until the image files have caught up; dead workers never do."""
    waiting = list(range(MAX_IMAGES + 2))
    monkeypatch.setattr("xop_lerobot.recording.writer.time.sleep", lambda _: waiting.pop())
    queue = SimpleNamespace(qsize=lambda: len(waiting))
    worker = SimpleNamespace(is_alive=lambda: alive)
    images = SimpleNamespace(queue=queue, threads=[worker], processes=[])
    VideoQueue(None, SimpleNamespace(image_writer=images)).wait_for_images()
    assert len(waiting) == (MAX_IMAGES - 1 if alive else MAX_IMAGES + 2)
    VideoQueue(None, SimpleNamespace(image_writer=None)).wait_for_images()
    VideoQueue(None).wait_for_images()


def test_image_files_are_waited_for_while_recording(session, pair, tmp_path, monkeypatch):
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data", image_writer_threads=1)
    asked = []
    monkeypatch.setattr(VideoQueue, "wait_for_images", lambda queue: asked.append(queue._writer))
    tick(robot, teleop, dataset)
    assert asked == [dataset.writer]
    assert dataset.writer is not None
    assert {"queue", "threads", "processes"} <= set(vars(dataset.writer.image_writer))
    dataset.save_episode()
    dataset.finalize()


def test_dropped_frames_are_counted():
    assert VideoQueue(FakeEncoder()).dropped == 3
    assert VideoQueue(None).dropped == 0


def test_an_encoder_that_cannot_be_waited_for_is_refused(session, pair, tmp_path, monkeypatch):
    """Its pictures would belong to other rows; image files need no such encoder."""
    encoder = type("Encoder", (), {"_frame_queues": None, "_threads": None})
    monkeypatch.setattr("lerobot.datasets.video_utils.StreamingVideoEncoder", encoder)
    with pytest.raises(LeRobotMisfit) as refusal:
        create(session, pair[0], tmp_path / "data", **STREAMING)
    assert str(refusal.value) == (
        f"LeRobot {version('lerobot')} does not fit the patch 'queues of the video encoder', made "
        "for 0.6.1: lerobot.datasets.video_utils.StreamingVideoEncoder must have _frame_queues, "
        "_threads, _dropped_frames, and has no _dropped_frames. Frames of a video could be lost "
        "without a sign, and its images then belong to other rows. Use "
        "--dataset.streaming_encoding=false."
    )
    assert not (tmp_path / "data").exists()
    create(session, pair[0], tmp_path / "data").finalize()


@pytest.mark.slow
def test_lockstep_loses_no_frame_to_a_slow_encoder(session, pair, tmp_path, monkeypatch):
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data", **STREAMING)
    tick(robot, teleop, dataset)
    assert dataset.writer is not None
    encoder = dataset.writer._streaming_encoder
    assert encoder is not None
    queue = encoder._frame_queues["observation.images.head"]
    take = queue.get
    # Slower than the 0.1 s after which LeRobot drops a frame.
    monkeypatch.setattr(queue, "get", lambda **kw: (time.sleep(0.15), take(**kw))[1])
    for _ in range(9):
        tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    loaded = LeRobotDataset("local/toy", root=dataset.root)
    assert read_facts(dataset.root)[0]["dropped_frames"] == 0
    assert get_row(loaded, 9)["observation.images.head"].shape == (3, 48, 64)
    assert get_episodes(loaded)[0]["videos/observation.images.head/to_timestamp"] == 0.4


def test_an_episode_with_lost_frames_is_marked_in_real_time(session, pair, tmp_path, monkeypatch):
    robot, teleop = pair
    monkeypatch.setattr(VideoQueue, "dropped", 4)
    dataset = create(session, robot, tmp_path / "data")
    tick(robot, teleop, dataset)
    with pytest.raises(XopError, match="episode 0 lost 4 video frames; it is not saved"):
        dataset.save_episode()
    dataset._info = dataclasses.replace(dataset._info, realtime=True)
    tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    (facts,) = read_facts(dataset.root)
    assert (facts["dropped_frames"], facts["clock"]) == (4, "realtime")


# Durability.


NO_ROTATION = dataclasses.replace(
    ROTATION, expects={"lerobot.datasets.dataset_writer:DatasetWriter": ("_gone",)}
)
"""A LeRobot without the private names that `ROTATION` needs."""


@pytest.mark.slow
@pytest.mark.parametrize("rotates", [True, False])
def test_saved_episodes_load_while_the_session_goes_on(
    session, pair, tmp_path, monkeypatch, rotates
):
    """The files on disk are whole after each save, also when LeRobot's private names are gone."""
    if not rotates:
        monkeypatch.setattr("xop_lerobot.recording.dataset.ROTATION", NO_ROTATION)
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data", **STREAMING)
    for saved in range(1, 4):
        for _ in range(3):
            tick(robot, teleop, dataset)
        dataset.save_episode()
        loaded = LeRobotDataset("local/toy", root=dataset.root)
        assert (loaded.num_episodes, len(loaded)) == (saved, 3 * saved)
        assert get_row(loaded, 3 * saved - 1)["observation.images.head"].shape == (3, 48, 64)
    dataset.finalize()
    # The recording object itself reads on afterwards.
    assert get_row(dataset, 8)["goal.head"].shape == (7,)
    assert len(read_facts(dataset.root)) == 3


def test_signals_wait_for_the_save():
    done = []
    # A process that was started in the background ignores the signal.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            with hold_signals():
                signal.raise_signal(signal.SIGINT)
                done.append("saved")
    finally:
        signal.signal(signal.SIGINT, before)
    assert done == ["saved"]


def start_recording(command: str, root: Path, *flags: str) -> subprocess.Popen:
    """A recording of the toy by `command`, in a process of its own."""
    words = [
        sys.executable, str(REPO / "tests" / "helpers" / "record_toy.py"), command,
        "--robot.type=xop_toy", "--robot.width=64", "--robot.height=48", "--teleop.type=xop",
        "--teleop.device.path=g1_squat_walk_reach", "--teleop.retargeter.type=direct",
        "--dataset.repo_id=local/toy", f"--dataset.root={root}", "--dataset.fps=25",
        "--dataset.single_task=play", "--dataset.episode_time_s=0.4",
        "--dataset.streaming_encoding=true", "--dataset.push_to_hub=false",
        "--play_sounds=false", *flags,
    ]  # fmt: skip
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def wait_for_episodes(process: subprocess.Popen, root: Path, number: int) -> None:
    while len(read_facts(root)) < number:
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "number"),
    [
        ("xop-record", signal.SIGTERM),
        ("lerobot-record", signal.SIGTERM),
        ("lerobot-record", signal.SIGKILL),
    ],
)
def test_a_killed_session_keeps_its_episodes(tmp_path, command, number):
    root = tmp_path / "data"
    process = start_recording(command, root, "--dataset.num_episodes=1000")
    wait_for_episodes(process, root, 2)
    os.kill(process.pid, number)
    _, errors = process.communicate(timeout=120)
    if number == signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL
    elif command == "xop-record":
        assert process.returncode == 130, errors
        assert "interrupted; saved episodes are kept" in errors
    else:
        assert "SIGTERM: stopping; the episodes that are saved stay." in errors
    loaded = LeRobotDataset("local/toy", root=root)
    assert loaded.num_episodes >= 2
    assert len(loaded) == 10 * loaded.num_episodes
    for index in (0, 10, len(loaded) - 1):
        assert get_row(loaded, index)["observation.images.head"].shape == (3, 48, 64)


# Settings and changes.


@pytest.mark.slow
def test_changes_are_recorded_with_their_frame(session, tmp_path):
    robot, teleop = make_toy(session), make_teleop(session, retargeter="mpc")
    teleop.connect()
    robot.connect()
    dataset = create(session, robot, tmp_path / "data")
    for frame in range(8):
        if frame == 3:
            teleop.change({"preset": "conservative", "weights": {"position": 2.0}}, "control")
        if frame == 5:
            teleop.toggle("upright", "key")
            teleop.change({"mode": "mobile"})
        tick(robot, teleop, dataset)
    dataset.save_episode()
    tick(robot, teleop, dataset)
    tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    teleop.disconnect()
    robot.disconnect()

    first, second = read_facts(dataset.root)
    times = stack(read_rows(dataset.root), "time.sim")[:, 0]
    expected = [
        (3, "control", {"preset": "conservative", "weights": {"position": 2.0}}),
        (5, "key", {"constraints": {"upright": True}}),
        (5, "call", {"mode": "mobile"}),
    ]
    for change, (frame, source, what) in zip(first["changes"], expected, strict=True):
        assert change == {
            "frame": frame, "time": times[frame], "source": source, "change": what,
        }  # fmt: skip
    assert (first["settings"]["preset"], first["settings"]["mode"]) == ("default", "stationary")
    assert second["changes"] == []
    # What was changed stays in force; the mode is that of the operator's start.
    assert second["settings"] == {
        "preset": "conservative", "weights": {"position": 2.0}, "variant": "v1",
        "targets": ["head"], "body": [], "constraints": ["upright"], "mode": "stationary",
    }  # fmt: skip
    episodes = get_episodes(LeRobotDataset("local/toy", root=dataset.root))
    assert json.loads(episodes[0]["xop/changes"]) == first["changes"]
    assert json.loads(episodes[1]["xop/settings"]) == second["settings"]


def test_a_discarded_episode_takes_its_changes_along(session, pair, tmp_path):
    robot, teleop = pair
    dataset = create(session, robot, tmp_path / "data")
    tick(robot, teleop, dataset)
    teleop.change({"mode": "mobile"})
    tick(robot, teleop, dataset)
    dataset.clear_episode_buffer()
    tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    (facts,) = read_facts(dataset.root)
    assert facts["changes"] == []


@pytest.mark.slow
def test_columns_of_another_version_are_not_mixed(session, pair, tmp_path, monkeypatch):
    robot, teleop = pair
    root = tmp_path / "data"
    with monkeypatch.context() as patch:
        patch.setattr("xop_lerobot.recording.columns.HEALTH_NAMES", ("solve_time", "plan_age"))
        dataset = create(session, robot, root)
        tick(robot, teleop, dataset)
        dataset.save_episode()
        dataset.finalize()
    with pytest.raises(BadValue) as refusal:
        XopDataset.bind(session).resume("local/toy", root=root)
    assert str(refusal.value) == (
        f"'{root}' was recorded by another version: its column 'retargeter.health' has the "
        f"entries solve_time, plan_age, and not {', '.join(HEALTH_NAMES)}. Begin a new dataset"
    )


def test_hardware_has_the_estimate_where_a_simulation_has_the_truth(session, pair):
    robot, _ = pair
    state, info = observe(robot), get_session(session).robot
    estimate = np.array(state.qpos) + 0.01
    record = make_tick(state, estimate=estimate)
    simulated = Columns(info).build_row(record)
    real = Columns(dataclasses.replace(info, has_truth=False)).build_row(record)
    np.testing.assert_allclose(simulated["robot.base_pose"], state.true_qpos[:7], atol=1e-6)
    np.testing.assert_allclose(real["robot.base_pose"], estimate[:7], atol=1e-6)
    for row in (simulated, real):  # the goals' world
        np.testing.assert_allclose(row["robot.base_estimate"], estimate[:7], atol=1e-6)
    measured = Columns(info).build_row(make_tick(state))["robot.base_estimate"]
    np.testing.assert_allclose(measured, state.qpos[:7], atol=1e-6)
    assert real["robot.head"][0] == pytest.approx(simulated["robot.head"][0] + 0.01, abs=0.02)


def test_health_of_a_tick_is_in_its_columns(session, tmp_path):
    robot, teleop = make_toy(session), make_teleop(session, retargeter="mpc")
    teleop.connect()
    robot.connect()
    dataset = create(session, robot, tmp_path / "data")
    for _ in range(4):
        tick(robot, teleop, dataset)
    dataset.save_episode()
    dataset.finalize()
    health = stack(read_rows(dataset.root), "retargeter.health")
    columns = dict(zip(HEALTH_NAMES, health.T, strict=True))
    assert (columns["solve_time"] > 0).all()
    assert (columns["plan_age"] == 0).all()  # lock-step
    assert (columns["effective_samples"] >= 1).all()
    assert set(columns["status"]) <= {0, 1}
    assert set(columns["sync_status"]) <= {0, 1, 2, 3}
    assert (columns["sync_residual"] >= 0).all()
    assert (columns["risk"] >= 0).all()
    assert (columns["risk"] <= 1).all()
    teleop.disconnect()
    robot.disconnect()
