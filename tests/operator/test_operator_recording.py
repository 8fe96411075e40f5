"""Operator recordings: what is refused and how it is said, and what comes out between samples."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadRecording, BadValue, NotConnected, UnknownName
from xop_lerobot.core.state import FRAMES
from xop_lerobot.operator.devices import DEVICES, DeviceConfig, make_device
from xop_lerobot.operator.recording import load_recording

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[3] / "shared"))
POSES = [f"{frame}_pose" for frame in FRAMES]


def make_arrays(n: int = 5, seed: int = 0) -> dict[str, np.ndarray]:
    """Valid content of a recording, with uneven times and any orientation."""
    rng = np.random.default_rng(seed)
    arrays = {"t": np.cumsum(rng.uniform(0.01, 0.5, n))}
    for key in POSES:
        quat = rng.normal(size=(n, 4))
        quat /= np.linalg.norm(quat, axis=1, keepdims=True)
        arrays[key] = np.hstack([rng.normal(size=(n, 3)), quat])
    for key in ("left_pinch", "right_pinch"):
        arrays[key] = rng.uniform(0, 0.1, n)
    return arrays


def save(path: Path, **changes: object) -> Path:
    """Save a valid recording with `changes`; None takes a key away."""
    arrays = {**make_arrays(), **changes}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


def altered(key: str, index: int | tuple[int | slice, ...], value: float) -> np.ndarray:
    array = make_arrays()[key].copy()
    array[index] = value
    return array


def with_step_back() -> np.ndarray:
    return np.array([0.0, 0.1, 0.3, 0.2, 0.4])


FAULTS = {
    "missing key": (
        {"left_pinch": None, "t": None},
        "missing t, left_pinch. Expected: t, head_pose, left_wrist_pose, right_wrist_pose, "
        "left_pinch, right_pinch; optional: tracked, mode. Found: head_pose, left_wrist_pose, "
        "right_wrist_pose, right_pinch",
    ),
    "wrong width": (
        {"head_pose": np.zeros((5, 6))},
        "head_pose must have shape (5, 7), got (5, 6)",
    ),
    "wrong length": (
        {"left_pinch": np.zeros(4)},
        "left_pinch must have shape (5,), got (4,)",
    ),
    "times in two dimensions": (
        {"t": np.zeros((5, 1))},
        "t must have shape (T,), got (5, 1)",
    ),
    "one sample": (
        {key: value[:1] for key, value in make_arrays().items()},
        "it has 1 samples; at least 2 are needed",
    ),
    "NaN": (
        {"left_wrist_pose": altered("left_wrist_pose", (2, 1), np.nan)},
        "left_wrist_pose must be finite, but left_wrist_pose[2, 1] = nan",
    ),
    "infinite time": (
        {"t": altered("t", 4, np.inf)},
        "t must be finite, but t[4] = inf",
    ),
    "time going back": (
        {"t": with_step_back()},
        "t must increase strictly, but t[2] = 0.3 s is followed by t[3] = 0.2 s",
    ),
    "time standing still": (
        {"t": np.array([0.0, 0.1, 0.1, 0.2, 0.3])},
        "t must increase strictly, but t[1] = 0.1 s is followed by t[2] = 0.1 s",
    ),
    "an hour's jump of the clock": (
        {"t": np.array([0.0, 0.1, 0.2, 3600.3, 3600.4])},
        "t must be in seconds, from a monotonic clock: its steps may be up to 60 s long, "
        "but t[2] = 0.2 s is followed by t[3] = 3600.3 s",
    ),
    "milliseconds since 1970": (
        {"t": 1.7e12 + 1e5 * np.arange(5)},
        "t must be in seconds, from a monotonic clock: its steps may be up to 60 s long, "
        "but t[0] = 1.7e+12 s is followed by t[1] = 1.7000001e+12 s",
    ),
    "coordinates of a map": (
        {"left_wrist_pose": altered("left_wrist_pose", (2, 1), 5_411_000.0)},
        "left_wrist_pose[2] is 5411000 m from the origin, where the 32 bits of a dataset are no "
        "longer exact to a millimetre. Move the origin, of all poses alike, to within 10000 m",
    ),
    "quaternion of zeros": (
        {"right_wrist_pose": altered("right_wrist_pose", (3, slice(3, 7)), 0.0)},
        "right_wrist_pose[3, 3:] must be a unit quaternion (qw qx qy qz), its norm is 0",
    ),
    "quaternion too long": (
        {"head_pose": np.tile([0, 0, 1.6, 1.01, 0, 0, 0], (5, 1))},
        "head_pose[0, 3:] must be a unit quaternion (qw qx qy qz), its norm is 1.01",
    ),
    "negative pinch": (
        {"right_pinch": np.array([0, 0, 0, 0, -0.01])},
        "right_pinch must not be negative, but right_pinch[4] = -0.01 m",
    ),
    "strange mode": (
        {"mode": np.array([0, 1, 2, 1, 1])},
        "mode must be 0 (stationary) or 1 (mobile), but mode[2] = 2",
    ),
    "tracked as numbers": (
        {"tracked": np.ones((5, 3))},
        "tracked must have dtype bool, got float64",
    ),
    "tracked of wrong shape": (
        {"tracked": np.ones((5, 2), dtype=bool)},
        "tracked must have shape (5, 3), got (5, 2)",
    ),
    "head never tracked": (
        {"tracked": np.zeros((5, 3), dtype=bool)},
        "tracked says that the head is never seen",
    ),
    "text": (
        {"left_pinch": np.array(["a"] * 5)},
        "left_pinch must hold numbers, got dtype <U1",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_malformed_recording_is_named_before_anything_moves(tmp_path: Path, name: str) -> None:
    changes, fault = FAULTS[name]
    path = save(tmp_path / "bad.npz", **changes)
    device = make_device(DeviceConfig(type="replay", path=str(path)))
    with pytest.raises(BadRecording) as error:
        device.connect()
    assert str(error.value) == f"operator recording '{path}': {fault}"


def test_missing_file_and_directory_are_named(tmp_path: Path) -> None:
    with pytest.raises(BadRecording) as error:
        load_recording(tmp_path / "absent.npz")
    assert str(error.value) == (
        f"operator recording '{tmp_path / 'absent.npz'}': there is no such file"
    )
    with pytest.raises(BadRecording, match="a directory, but no dataset"):
        load_recording(tmp_path)


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04broken"])
def test_other_files_are_not_archives(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.npz"
    path.write_bytes(content)
    with pytest.raises(BadRecording, match="not a readable .npz archive"):
        load_recording(path)


def test_single_array_is_no_archive(tmp_path: Path) -> None:
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(BadRecording, match="a single array, not an .npz archive"):
        load_recording(tmp_path / "array.npy")


def test_pickled_content_is_never_loaded(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple:
            return (Path.touch, (tmp_path / "exploded",))

    path = save(tmp_path / "bomb.npz", t=np.array([Bomb()], dtype=object))
    with pytest.raises(BadRecording, match="allow_pickle=False"):
        load_recording(path)
    assert not (tmp_path / "exploded").exists()


def test_nearly_unit_quaternions_are_normalised(tmp_path: Path) -> None:
    head = make_arrays()["head_pose"]
    head[:, 3:] *= 1.0009
    recording = load_recording(save(tmp_path / "a.npz", head_pose=head))
    norm = np.linalg.norm(recording.poses[..., 3:], axis=-1)
    np.testing.assert_allclose(norm, 1, atol=1e-14)


def test_interpolation_agrees_with_scipy(tmp_path: Path) -> None:
    arrays = make_arrays(12, seed=3)
    arrays["head_pose"][::2, 3:] *= -1  # the sign of a quaternion must not matter
    recording = load_recording(save(tmp_path / "a.npz", **arrays))
    t = arrays["t"] - arrays["t"][0]
    for stamp in np.linspace(0, t[-1], 101):
        frame = recording.frame_at(stamp)
        assert frame.time == stamp
        for name, key in zip(FRAMES, POSES, strict=True):
            position = [np.interp(stamp, t, arrays[key][:, i]) for i in range(3)]
            np.testing.assert_allclose(frame.pose(name)[:3], position, atol=1e-12)
            rotations = Rotation.from_quat(arrays[key][:, 3:], scalar_first=True)
            expected = Slerp(t, rotations)(stamp)
            actual = Rotation.from_quat(frame.pose(name)[3:], scalar_first=True)
            assert (expected.inv() * actual).magnitude() < 1e-7
        pinch = [np.interp(stamp, t, arrays[key]) for key in ("left_pinch", "right_pinch")]
        np.testing.assert_allclose(frame.pinch, pinch, atol=1e-12)


def test_ends_are_held(tmp_path: Path) -> None:
    arrays = make_arrays()
    recording = load_recording(save(tmp_path / "a.npz"))
    for stamp, row in ((-1.0, 0), (recording.duration, -1), (recording.duration + 9, -1)):
        frame = recording.frame_at(stamp)
        for name, key in zip(FRAMES, POSES, strict=True):
            actual, expected = frame.pose(name), arrays[key][row]
            np.testing.assert_allclose(actual[:3], expected[:3], atol=1e-14)
            assert abs(actual[3:] @ expected[3:]) == pytest.approx(1)


def test_untracked_limb_stands_still_and_flag_is_the_nearest(tmp_path: Path) -> None:
    tracked = np.ones((5, 3), dtype=bool)
    tracked[0, 2] = False  # right wrist is first seen in sample 1
    tracked[2:4, 1] = False  # left wrist is lost in samples 2 and 3
    arrays = make_arrays()
    t = arrays["t"] - arrays["t"][0]
    recording = load_recording(save(tmp_path / "a.npz", tracked=tracked))
    left = arrays["left_wrist_pose"][1, :3]
    for stamp in np.linspace(t[1], t[3], 20):
        np.testing.assert_allclose(recording.frame_at(stamp).left_wrist[:3], left, atol=1e-14)
    first = recording.frame_at(0)
    np.testing.assert_allclose(first.right_wrist[:3], arrays["right_wrist_pose"][1, :3])
    assert first.tracked.tolist() == [True, True, False]
    assert recording.frame_at(0.51 * t[1] + 0.49 * t[2]).tracked.tolist() == [True, True, True]
    assert recording.frame_at(0.49 * t[1] + 0.51 * t[2]).tracked.tolist() == [True, False, True]


def test_stated_mode_is_that_of_the_last_sample(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", t=np.arange(5.0), mode=np.array([0, 0, 1, 1, 0]))
    recording = load_recording(path)
    modes = [recording.frame_at(t).mode for t in (-1, 0, 1.99, 2, 3.9, 4, 9)]
    assert modes == [Mode.STATIONARY] * 3 + [Mode.MOBILE] * 2 + [Mode.STATIONARY] * 2
    assert load_recording(save(tmp_path / "b.npz")).frame_at(0).mode is None


def test_replay_plays_from_start_holds_and_finishes(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", t=np.arange(5.0))
    config = DeviceConfig(type="replay", path=str(path), mode="mobile", hold_s=1.5, speed=2.0)
    device = make_device(config)
    assert device.self_engaging
    assert device.start_mode is Mode.MOBILE
    with pytest.raises(NotConnected):
        device.read(0.0)
    device.connect()
    waiting = device.read(100.0)
    assert waiting is not None
    assert waiting.time == 0.0
    assert not device.is_finished(100.0)
    device.start(10.0)
    frame = device.read(10.75)
    assert frame is not None
    assert frame.time == pytest.approx(1.5)
    arrays = make_arrays()
    np.testing.assert_allclose(frame.head[:3], arrays["head_pose"][1:3, :3].mean(axis=0))
    assert not device.is_finished(13.49)
    assert device.is_finished(13.5)
    device.start(20.0)  # a new episode plays it again
    assert not device.is_finished(20.0)
    device.disconnect()
    device.disconnect()


def test_unknown_device_lists_the_available_ones() -> None:
    with pytest.raises(UnknownName) as error:
        make_device(DeviceConfig(type="gamepad"))
    # Others, for tests and for retargeting, are added by who is imported before.
    assert {"avp", "replay", "scripted", "simulated", "webxr"} <= set(DEVICES)
    assert str(error.value) == f"unknown device 'gamepad'. Known: {', '.join(DEVICES)}"


def test_replay_needs_a_path() -> None:
    with pytest.raises(BadValue, match="device 'replay' needs a recording: --teleop.device.path"):
        make_device(DeviceConfig(type="replay"))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("speed", 0.0, "device.speed must be finite and above 0, got 0.0"),
        ("hold_s", -1.0, "device.hold_s must be finite and at least 0, got -1.0"),
        ("noise", float("nan"), "device.noise must be finite and at least 0, got nan"),
        ("mode", "flying", "unknown device.mode 'flying'. Known: mobile, stationary"),
    ],
)
def test_device_settings_are_checked(field: str, value: object, message: str) -> None:
    settings: dict[str, Any] = {field: value}
    with pytest.raises((BadValue, UnknownName)) as error:
        DeviceConfig(**settings)
    assert str(error.value) == message


def test_real_recordings_load() -> None:
    files = sorted((SHARED / "operator").glob("*.npz"))
    if not files:
        pytest.skip("the real recordings are not here")
    for file in files:
        recording = load_recording(file)
        assert recording.duration > 2
        assert recording.tracked.all()
        assert (np.abs(recording.poses[:, 0, 2] - 1.6) < 0.2).all()
