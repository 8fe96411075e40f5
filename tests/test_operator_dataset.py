"""The operator's columns of a recorded dataset, replayed as a recording."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from xop_lerobot.command import Mode
from xop_lerobot.errors import BadRecording
from xop_lerobot.operator.dataset_recording import load_dataset_recording
from xop_lerobot.operator.devices import DeviceConfig, make_device

FPS = 25
LENGTH = 20
ENGAGED_AT = 5


def write_dataset(root: Path, without: str | None = None, engages: bool = True) -> Path:
    """Write two episodes of a dataset as LeRobot lays it out, one file each."""
    names = ["height.pos", "x.vel", "mode.pos", "arm.pos"]
    features = {
        name: {"dtype": "float32", "shape": [size], "names": None}
        for name, size in {
            "operator.head": 7, "operator.left_wrist": 7, "operator.right_wrist": 7,
            "operator.pinch": 2, "operator.tracked": 3, "operator.engaged": 1, "time.sim": 1,
        }.items()
    }  # fmt: skip
    features["action"] = {"dtype": "float32", "shape": [4], "names": names}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    features.pop(without or "", None)
    (root / "meta").mkdir(parents=True)
    info = {"features": features, "total_episodes": 2}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    for episode in range(2):
        columns: dict[str, list] = {"episode_index": [episode] * LENGTH}
        seen = np.arange(LENGTH) >= 2
        for limb in ("head", "left_wrist", "right_wrist"):
            pose = np.zeros((LENGTH, 7))
            pose[seen, 0] = episode + np.arange(LENGTH)[seen] / FPS
            pose[seen, 2:4] = (1.6, 1.0)
            if limb == "left_wrist":
                pose[10:12] = 0  # the device lost it: zeros and a flag
            columns[f"operator.{limb}"] = pose.astype(np.float32).tolist()
        tracked = np.repeat(seen[:, None], 3, axis=1).astype(np.float32)
        tracked[10:12, 1] = 0
        columns["operator.tracked"] = tracked.tolist()
        columns["operator.pinch"] = np.full((LENGTH, 2), 0.05, np.float32).tolist()
        engaged = engages * (np.arange(LENGTH) >= ENGAGED_AT)
        columns["operator.engaged"] = engaged.astype(np.float32).tolist()
        columns["time.sim"] = (3.0 + np.arange(LENGTH) / FPS).tolist()
        columns["timestamp"] = (np.arange(LENGTH) / FPS).tolist()
        action = np.zeros((LENGTH, 4), np.float32)
        action[10:, 2] = 1
        columns["action"] = action.tolist()
        columns.pop(without or "", None)
        path = root / "data" / "chunk-000" / f"file-{episode:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(columns), path)
    return root


def test_episode_replays_from_the_moment_of_engaging(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "set")
    device = make_device(DeviceConfig(type="replay", path=str(root), episode=1, hold_s=5.0))
    device.connect()
    device.start(0.0)
    for i in range(LENGTH - ENGAGED_AT):
        frame = device.read(i / FPS)
        assert frame is not None
        assert frame.head[0] == pytest.approx(1 + (ENGAGED_AT + i) / FPS, abs=1e-6)
        assert frame.mode is (Mode.MOBILE if ENGAGED_AT + i >= 10 else Mode.STATIONARY)
        lost = ENGAGED_AT + i in (10, 11)
        assert frame.tracked.tolist() == [True, not lost, True]
        if lost:
            assert frame.left_wrist[0] == pytest.approx(1 + 9 / FPS, abs=1e-6)
    end = (LENGTH - 1 - ENGAGED_AT) / FPS + 5.0
    assert not device.is_finished(end - 0.01)
    assert device.is_finished(end)


def test_time_falls_back_on_the_timestamp(tmp_path: Path) -> None:
    recording = load_dataset_recording(write_dataset(tmp_path / "set", without="time.sim"))
    assert recording.duration == pytest.approx((LENGTH - 1 - ENGAGED_AT) / FPS)


def test_faults_are_named(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "set")
    with pytest.raises(BadRecording, match=r"it has no episode 7 \(it has 2 episodes\)"):
        load_dataset_recording(root, 7)
    stock = write_dataset(tmp_path / "stock", without="operator.pinch")
    with pytest.raises(BadRecording, match=r"the dataset has no column operator\.pinch\. Its"):
        load_dataset_recording(stock)
    idle = write_dataset(tmp_path / "idle", engages=False)
    with pytest.raises(BadRecording, match=r"\(episode 0\)': the operator never engaged in it"):
        load_dataset_recording(idle)
    (root / "meta" / "info.json").write_text("{")
    with pytest.raises(BadRecording, match=r"meta/info\.json is not readable"):
        load_dataset_recording(root)
    cut = write_dataset(tmp_path / "cut")
    (cut / "data" / "chunk-000" / "file-000.parquet").write_bytes(b"PAR1")
    with pytest.raises(BadRecording, match="data files are not readable"):
        load_dataset_recording(cut)
