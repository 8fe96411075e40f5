"""Synthetic datasets of any size without images, to test dataset tools on.

They have the features, columns and facts of a robot's recordings, and LeRobot loads them. The
person walks to and fro and waves, the robot follows with an error, and at random (seeded) an
episode fails, falls, or loses the tracking of a hand for a while. No physics is simulated.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import compute_episode_stats
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.utils import DEFAULT_DATA_PATH

from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import make_pose, quat_from_yaw
from xop_lerobot.core.versions import read_versions
from xop_lerobot.morphology.body import Body
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.recording.columns import HEALTH_NAMES, Columns
from xop_lerobot.recording.facts import (
    EpisodeFacts,
    append_facts,
    compute_config_hash,
    write_config,
)
from xop_lerobot.session import RobotInfo

TASK = "walk to and fro and wave"
_SUCCEEDS, _FALLS, _LOSES = 0.7, 0.05, 0.1
"""Probabilities that an episode succeeds, falls and loses tracking."""
_DIGITS = 3
"""Decimals to which values are rounded: full-precision noise would compress unlike recordings."""


def make_dataset(
    root: Path, episodes: int, frames: int, *, seed: int = 0, robot: str = "g1", fps: int = 25
) -> None:
    """Write a synthetic dataset.

    Args:
        root: Directory of the dataset, which must not exist.
        episodes: Number of episodes.
        frames: Frames per episode.
        seed: Seed; episode i depends only on it and on i.
        robot: Name of the robot's morphology.
        fps: Frame rate [Hz].
    """
    morphology = make_morphology(robot)
    name = f"xop_{robot}"
    features = make_features(morphology, name, fps)
    meta = LeRobotDatasetMetadata.create(
        f"local/{root.name}", fps, features, robot_type=name, root=root, use_videos=False
    )
    config = {"robot": {"type": name}, "synthetic": {"seed": seed, "frames": frames}}
    write_config(root, config)
    pattern = _make_pattern(features, frames, fps, seed)
    stats = compute_episode_stats({**pattern}, features)
    schema = get_hf_features_from_features(meta.features).arrow_schema
    meta.save_episode_tasks([TASK])
    for index in range(episodes):
        rows, facts = _vary(pattern, index, seed)
        facts |= {"robot": name, "config_hash": compute_config_hash(config)}
        whole = EpisodeFacts(**facts)
        place = {"chunk_index": index // 1000, "file_index": index % 1000}
        path = root / DEFAULT_DATA_PATH.format(**place)
        path.parent.mkdir(parents=True, exist_ok=True)
        rows |= _count(index, frames, fps)
        pq.write_table(_make_table(rows, schema), path)
        metadata = {f"data/{key}": value for key, value in place.items()}
        metadata |= {
            "dataset_from_index": index * frames,
            "dataset_to_index": (index + 1) * frames,
            **whole.to_metadata(),
        }
        meta.save_episode(index, frames, [TASK], stats, metadata)
        append_facts(root, index, frames, whole)
    meta.finalize()


def make_features(morphology: Morphology, robot: str, fps: int) -> dict[str, dict[str, Any]]:
    """Return the LeRobot features of a recording without cameras."""
    info = RobotInfo(robot, morphology, morphology.policies[0], None, "empty", fps, 0)
    names = {"action": morphology.layout.keys, "observation.state": Body(morphology).state_keys}
    own = {
        key: {"dtype": "float32", "shape": (len(entries),), "names": list(entries)}
        for key, entries in names.items()
    }
    return {**own, **Columns(info).features}


def _make_pattern(
    features: dict[str, dict[str, Any]], frames: int, fps: int, seed: int
) -> dict[str, np.ndarray]:
    """Make the columns of a flawless episode, without the counters of `_count`."""
    rng = np.random.default_rng([seed, 0])
    t = np.arange(frames) / fps
    rows: dict[str, np.ndarray] = {}
    for key, feature in features.items():
        phase = rng.uniform(0, 2 * np.pi, feature["shape"])
        wave = 0.3 * np.sin(2 * np.pi * 0.2 * t[:, None] + phase)
        rows[key] = np.round(wave, _DIGITS).astype(feature["dtype"])
    head = np.stack([np.sin(0.2 * t), 0.2 * np.sin(0.3 * t), 1.5 + 0.05 * np.sin(0.5 * t)], axis=1)
    quat = quat_from_yaw(0.3 * np.sin(0.2 * t))
    for side, frame in zip((0.0, 0.2, -0.2), FRAMES, strict=True):
        place = head + [0.3 * (side != 0), side, -0.5 * (side != 0)]
        place[:, 2] += 0.1 * np.sin(t) * (side != 0)
        pose = np.round(make_pose(place, quat), _DIGITS).astype(np.float32)
        for kind in ("operator", "goal", "robot"):
            rows[f"{kind}.{frame}"] = pose.copy()
    rows["robot.base_pose"] = np.round(make_pose(head - [0, 0, 0.75], quat), 3).astype(np.float32)
    rows["operator.tracked"][:] = rows["operator.engaged"][:] = True
    rows["next.success"][:] = rows["next.done"][:] = False
    health = rows["retargeter.health"]
    health[:] = 0
    health[:, HEALTH_NAMES.index("solve_time")] = np.round(
        0.02 + 0.001 * rng.normal(size=frames), 4
    )
    rows["time.sim"] = (1.0 + t)[:, None]
    rows["time.wall"] = np.round(1.7e18 + t * 1e9).astype(np.int64)[:, None]
    return rows


def _vary(
    pattern: dict[str, np.ndarray], index: int, seed: int
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Vary the pattern into one episode; returns its columns and its facts."""
    rng = np.random.default_rng([seed, 1, index])
    rows, frames = dict(pattern), len(pattern["action"])
    success, fallen, lost = rng.random(3) < (_SUCCEEDS, _FALLS, _LOSES)
    success &= not fallen
    error = 0.03 * rng.lognormal(sigma=0.5)
    for frame in FRAMES:
        pose = pattern[f"robot.{frame}"].copy()
        noise = error * np.abs(rng.normal(size=frames)) / np.sqrt(2 / np.pi)
        pose[:, 0] += np.round(noise, _DIGITS)
        rows[f"robot.{frame}"] = pose
    if fallen:
        rows["robot.base_pose"] = pattern["robot.base_pose"].copy()
        rows["robot.base_pose"][-frames // 10 :, 2] = 0.1
    if lost:
        rows["operator.tracked"] = pattern["operator.tracked"].copy()
        start = int(rng.integers(0, frames))
        rows["operator.tracked"][start : start + frames // 20, 1] = False
    rows["next.success"] = pattern["next.success"].copy()
    rows["next.done"] = pattern["next.done"].copy()
    rows["next.success"][-1], rows["next.done"][-1] = success, True
    facts = {
        "success": bool(success),
        "fallen": bool(fallen),
        "collision": bool(fallen),
        "finished": True,
        "seed": seed,
        "task": TASK,
        "scene": "empty",
        "low_level": "default",
        "clock": "lockstep",
        "versions": read_versions(),
        "start_time": 1.7e9,
        "real_fps": 25.0,
        "dropped_frames": 0,
        "late": False,
        "settings": json.dumps({"preset": "default", "mode": "stationary"}),
    }
    return rows, facts


def _count(index: int, frames: int, fps: int) -> dict[str, np.ndarray]:
    """Make the timestamp and index columns of episode `index`."""
    numbers = np.arange(frames)
    return {
        "timestamp": (numbers / fps).astype(np.float32),
        "frame_index": numbers,
        "episode_index": np.full(frames, index),
        "index": index * frames + numbers,
        "task_index": np.zeros(frames, np.int64),
    }


def _make_table(rows: dict[str, np.ndarray], schema: pa.Schema) -> pa.Table:
    """Make a table of `schema`; vectors become fixed-size lists without Python objects."""
    columns = []
    for field in schema:
        values = rows[field.name]
        flat = pa.array(values.reshape(-1))
        if pa.types.is_fixed_size_list(field.type) or pa.types.is_list(field.type):
            flat = pa.FixedSizeListArray.from_arrays(flat, values.shape[1]).cast(field.type)
        columns.append(flat.cast(field.type))
    return pa.Table.from_arrays(columns, schema=schema)
