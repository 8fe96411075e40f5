"""Recorded datasets for the tests of curation: the toy robot's, and packed ones of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import numpy as np
import pandas as pd
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.io_utils import load_stats
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame
from toy_robot import make_teleop, make_toy

from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.record import build_features

FPS = 20
CAMERA = "observation.images.top"
SIZE = (48, 64)


def record_toy(
    root: Path, lengths: tuple[int, ...] = (30, 24, 36), *, session: str, video: bool = True
) -> Path:
    """Record episodes of the toy robot with `XopDataset`, a task for each."""
    robot, teleop = make_toy(session), make_teleop(session)
    teleop.connect()
    robot.connect()
    options = {
        "robot_type": robot.name, "use_videos": video, "streaming_encoding": video,
        "rgb_encoder": RGBEncoderConfig(vcodec="h264", preset="ultrafast"),
    }  # fmt: skip
    features = build_features(robot, use_videos=video)
    dataset = XopDataset.bind(session).create("local/toy", 25, features, root=root, **options)
    add_episodes(robot, teleop, dataset, lengths)
    dataset.finalize()
    teleop.disconnect()
    robot.disconnect()
    return root


def add_episodes(robot, teleop, dataset, lengths: tuple[int, ...]) -> None:
    for number, length in enumerate(lengths):
        for _ in range(length):
            observation = robot.get_observation()
            action = teleop.get_action()
            robot.send_action(action)
            frame = build_dataset_frame(dataset.features, observation, prefix=OBS_STR)
            frame |= build_dataset_frame(dataset.features, action, prefix=ACTION)
            dataset.add_frame({**frame, "task": f"task {number % 2}"})
        dataset.save_episode()


def make_packed(
    root: Path, lengths: tuple[int, ...] = (37, 25, 44), *, finalize: bool = True, **encoder
) -> LeRobotDataset:
    """Record with LeRobot alone: several episodes in one parquet file and one video."""
    features = {
        "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
        CAMERA: {
            "dtype": "video", "shape": (*SIZE, 3), "names": ["height", "width", "channels"],
        },
    }  # fmt: skip
    dataset = LeRobotDataset.create(
        "somebody/packed", FPS, features, root=root, robot_type="so100",
        rgb_encoder=RGBEncoderConfig(**encoder), encoder_threads=1,
    )  # fmt: skip
    rng = np.random.default_rng(0)
    for number, length in enumerate(lengths):
        for i in range(length):
            picture = np.zeros((*SIZE, 3), np.uint8)
            picture[:, :, number % 3] = i * 5 % 256
            picture[:, 2 * i % 56 : 2 * i % 56 + 6] = 255
            action = rng.normal(size=2).astype(np.float32)
            dataset.add_frame({"action": action, CAMERA: picture, "task": f"task {number % 2}"})
        dataset.save_episode()
    if finalize:
        dataset.finalize()
    return dataset


def load(repo_id: str, root: Path | str) -> Any:
    """Load a dataset with LeRobot. Its rows are dicts, whatever its annotations say."""
    return LeRobotDataset(repo_id, root=root)


def read_rows(root: Path, episode: int) -> Any:
    table = pd.concat(pd.read_parquet(file) for file in sorted(root.glob("data/*/*.parquet")))
    return table[table.episode_index == episode].reset_index(drop=True)


def read_metadata(root: Path) -> Any:
    files = sorted(root.glob("meta/episodes/*/*.parquet"))
    table = pd.concat((pd.read_parquet(file) for file in files), ignore_index=True)
    return table.set_index("episode_index", drop=False).sort_index()


def read_stats(root: Path) -> Any:
    """Statistics of a whole dataset by column and kind."""
    return load_stats(root)


def read_pictures(root: Path, episode: int, key: str, fps: float) -> np.ndarray:
    """Decode a video from its first picture on, and take those that the metadata names."""
    row = read_metadata(root).loc[episode]
    chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
    path = root / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
    start = row[f"videos/{key}/from_timestamp"]
    frames: dict[int, np.ndarray] = {}
    with av.open(str(path)) as container:
        frames = {
            round(float(frame.pts * (frame.time_base or 0)) * fps): frame.to_ndarray(format="rgb24")
            for frame in container.decode(video=0)
        }
    first = round(start * fps)
    return np.stack([frames[first + i] for i in range(row["length"])])
