"""The operator's columns of a recorded dataset, replayed as a recording."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadRecording
from xop_lerobot.core.state import FRAMES
from xop_lerobot.operator.dataset_recording import (
    COLUMNS,
    choose_columns,
    load_dataset_recording,
    make_dataset_recording,
)
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.operator.row_clock import read_row_clock

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


def make_columns(**changed: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of an episode in which all is as it should be."""
    pose = np.tile([0, 0, 1.6, 1, 0, 0, 0], (LENGTH, 1))
    pose[:, 0] = np.arange(LENGTH) / FPS
    return {
        "operator.head": pose,
        "operator.left_wrist": pose,
        "operator.right_wrist": pose,
        "operator.pinch": np.full((LENGTH, 2), 0.05),
        "operator.tracked": np.ones((LENGTH, 3), bool),
        "operator.engaged": np.ones((LENGTH, 1), bool),
        "time.sim": np.arange(LENGTH)[:, None] / FPS,
        "time.wall": 1_700_000_000_000_000_000 + np.arange(LENGTH)[:, None] * 50_000_000,
        **changed,
    }


def test_person_who_lets_go_of_the_robot_does_so_again() -> None:
    engaged = np.ones((LENGTH, 1), bool)
    engaged[:2] = engaged[8:12] = engaged[18:] = False
    recording, rows = make_dataset_recording(make_columns(**{"operator.engaged": engaged}), {}, "x")
    assert rows.tolist() == list(range(2, 18))
    assert [recording.is_engaged_at(i / FPS) for i in range(16)] == engaged[2:18, 0].tolist()
    # A clock that adds up rounding takes the very sample that it means.
    assert not recording.is_engaged_at(6 / FPS - 1e-12)


def test_rows_in_which_the_clock_stands_still_are_left_out() -> None:
    t = np.arange(LENGTH) / FPS
    t[7], t[11] = t[6], t[9]
    recording, rows = make_dataset_recording(make_columns(**{"time.sim": t[:, None]}), {}, "x")
    assert rows.tolist() == [i for i in range(LENGTH) if i not in (7, 11)]
    assert recording.t == pytest.approx(t[rows])
    for i in (6, 8, 10, 12):
        assert recording.frame_at(t[i]).head[0] == pytest.approx(i / FPS)


@pytest.mark.parametrize("broken", [np.zeros(LENGTH), np.full(LENGTH, np.nan)])
def test_robot_without_a_clock_has_the_hosts(broken: np.ndarray) -> None:
    recording, _ = make_dataset_recording(make_columns(**{"time.sim": broken[:, None]}), {}, "x")
    assert recording.t == pytest.approx(np.arange(LENGTH) * 0.05)
    columns = make_columns(**{"time.sim": broken[:, None]})
    del columns["time.wall"]
    with pytest.raises(BadRecording, match=r"'x': no clock of it runs\. Tried: time\.sim"):
        make_dataset_recording(columns, {}, "x")


WALL = 1_700_000_000_000_000_000 + np.arange(LENGTH) * 40_000_000
HOUR = 3_600_000_000_000


def set_wall(*sets: tuple[int, int]) -> np.ndarray:
    """The host's clock, set by so many nanoseconds from so many rows on. Shape (n, 1)."""
    wall = WALL.copy()
    for row, by in sets:
        wall[row:] += by
    return wall[:, None]


@pytest.mark.parametrize(
    "sets",
    [
        [(10, HOUR)],
        [(10, -HOUR)],
        [(10, 1_700_000_000_000_000_000)],
        [(10, -1_700_000_000_000_000_000)],
        [(10, -500_000_000)],
        [(10, 1_500_000_000)],
        [(1, HOUR)],
        [(5, HOUR), (15, -HOUR)],
    ],
)
def test_clock_that_is_set_loses_no_time_and_no_row(sets, caplog) -> None:
    columns = make_columns(**{"time.sim": np.zeros((LENGTH, 1)), "time.wall": set_wall(*sets)})
    recording, rows = make_dataset_recording(columns, {}, "x", FPS)
    assert rows.tolist() == list(range(LENGTH))
    assert recording.t == pytest.approx(np.arange(LENGTH) / FPS)
    assert [record.args[1] for record in caplog.records] == ["time.wall"] * len(sets)
    assert caplog.records[0].getMessage() == (
        f"x: time.wall jumps by {sets[0][1] / 1e9:+.6g} s at row {sets[0][0]} of what the "
        "operator drove; it is replayed without."
    )


def test_pause_in_which_the_person_moves_is_no_jump() -> None:
    """A recorder that was held up for two seconds: the hand had the time to go elsewhere."""
    wrist = make_columns()["operator.left_wrist"].copy()
    wrist[10:, 1] += 0.5
    changed = {"time.sim": np.zeros((LENGTH, 1)), "operator.left_wrist": wrist}
    for by, expected in ((2_000_000_000, 2.0), (HOUR, 0.0), (-HOUR, 0.0)):
        columns = make_columns(**changed, **{"time.wall": set_wall((10, by))})
        recording, _ = make_dataset_recording(columns, {}, "x", FPS)
        assert recording.duration == pytest.approx((LENGTH - 1) / FPS + expected)


def test_single_wrong_stamp_costs_its_row_alone(caplog) -> None:
    wall = set_wall((8, HOUR), (9, -HOUR))
    columns = make_columns(**{"time.sim": np.zeros((LENGTH, 1)), "time.wall": wall})
    recording, rows = make_dataset_recording(columns, {}, "x", FPS)
    assert rows.tolist() == [row for row in range(LENGTH) if row != 8]
    assert recording.t == pytest.approx(rows / FPS)
    assert not caplog.records


def test_clock_that_stands_still_and_then_is_right_again() -> None:
    t = np.arange(100) * 0.05
    t[20:60] = t[19]
    clock = read_row_clock(t)
    assert np.flatnonzero(~clock.goes_on).tolist() == list(range(20, 60))
    assert clock.t[clock.goes_on] == pytest.approx(np.arange(100)[clock.goes_on] * 0.05)
    assert clock.jumps == ()


@pytest.mark.parametrize("step", [0.33, 2.5])
def test_camera_that_is_slow_plays_slowly(step: float) -> None:
    """Rows that really came late, all of them, are no jumps."""
    wall = (np.arange(LENGTH) * step * 1e9).astype(np.int64)
    columns = make_columns(**{"time.sim": np.zeros((LENGTH, 1)), "time.wall": wall[:, None]})
    recording, _ = make_dataset_recording(columns, {}, "x", FPS)
    assert recording.duration == pytest.approx((LENGTH - 1) * step)


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1e-3])
def test_clock_in_other_units_is_not_believed(unit: float) -> None:
    """`time.wall` in seconds, milliseconds or microseconds, and not in nanoseconds."""
    wall = 1000 + np.arange(LENGTH)[:, None] / FPS / (unit * 1e9)
    columns = make_columns(**{"time.sim": np.zeros((LENGTH, 1)), "time.wall": wall})
    if unit == 1e-9:
        with pytest.raises(BadRecording, match=r"no clock of it runs at about 25 Hz\. Tried: time"):
            make_dataset_recording(columns, {}, "x", FPS)
    columns["timestamp"] = np.arange(LENGTH)[:, None] / FPS
    recording, _ = make_dataset_recording(columns, {}, "x", FPS)
    assert recording.duration == pytest.approx((LENGTH - 1) / FPS)


def test_limb_that_is_not_seen_may_hold_anything() -> None:
    tracked = np.ones((LENGTH, 3), bool)
    tracked[5:9, 2] = False
    wrist = make_columns()["operator.right_wrist"].copy()
    wrist[5:7], wrist[7:9] = np.nan, 0.3
    columns = make_columns(**{"operator.tracked": tracked, "operator.right_wrist": wrist})
    recording, _ = make_dataset_recording(columns, {}, "x")
    assert recording.poses[5:9, 2, 0] == pytest.approx(4 / FPS)
    with pytest.raises(BadRecording, match=r"right_wrist_pose must be finite"):
        make_dataset_recording(make_columns(**{"operator.right_wrist": wrist}), {}, "x")


def test_operator_in_the_coordinates_of_a_map_is_refused() -> None:
    pose = make_columns()["operator.head"].copy()
    pose[:, 1] += 5_411_000
    columns = make_columns(**{f"operator.{name}": pose for name in FRAMES})
    with pytest.raises(BadRecording, match=r"head_pose\[0\] is 5411000 m from the origin"):
        make_dataset_recording(columns, {}, "x", FPS)


def test_faults_are_named(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "set")
    with pytest.raises(BadRecording, match=r"it has no episode 7 \(it has 2 episodes\)"):
        load_dataset_recording(root, 7)
    odd = {"operator.head": {"dtype": "float32", "shape": [3]}}
    features = {name: {"dtype": "float32", "shape": [size]} for name, size in COLUMNS.items()}
    with pytest.raises(BadRecording, match=r"head must hold 7 numbers a row, it holds float32 of"):
        choose_columns("x", features | odd)
    text = {"operator.engaged": {"dtype": "string", "shape": [1]}}
    assert choose_columns("x", features | text) == list(COLUMNS)
    stock = write_dataset(tmp_path / "stock", without="operator.pinch")
    with pytest.raises(BadRecording, match=r"the dataset has no column operator\.pinch\. Its"):
        load_dataset_recording(stock)
    idle = write_dataset(tmp_path / "idle", engages=False)
    with pytest.raises(BadRecording, match=r"\(episode 0\)': the operator never engaged in it"):
        load_dataset_recording(idle)
    once = np.arange(LENGTH)[:, None] == 3
    with pytest.raises(BadRecording, match=r"was engaged in a single row of it"):
        make_dataset_recording(make_columns(**{"operator.engaged": once}), {}, "x")
    (root / "meta" / "info.json").write_text("{")
    with pytest.raises(BadRecording, match=r"meta/info\.json is not readable"):
        load_dataset_recording(root)
    cut = write_dataset(tmp_path / "cut")
    (cut / "data" / "chunk-000" / "file-000.parquet").write_bytes(b"PAR1")
    with pytest.raises(BadRecording, match="data files are not readable"):
        load_dataset_recording(cut)
