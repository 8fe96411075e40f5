"""Scripted people: human-like motion, the same stream for a seed, clear faults."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import (
    compute_minimum_jerk,
    quat_from_rpy,
    quat_rotate,
    rotation_error,
)
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.operator.noise import HEAD_SWAY, TREMOR, TREMOR_BAND, BandNoise, HumanNoise
from xop_lerobot.operator.script import BadScript, Script, list_scripts, load_script, make_script

DT = 0.01


def make_content(**changes: object) -> dict:
    """Content of a small valid script."""
    hand = [{"t": 0, "position": [0.3, 0.2, 1.1]}]
    content = {
        "head": [{"t": 0, "position": [0, 0, 1.6]}, {"t": 2, "position": [1, 0, 1.6]}],
        "left_wrist": hand,
        "right_wrist": hand,
    }
    return {**content, **changes}


def play(name: str, seed: int = 0, noise: float = 1.0) -> dict[str, np.ndarray]:
    """Poses of every frame at 100 Hz, and two seconds beyond the end."""
    device = make_device(DeviceConfig(path=name, seed=seed, noise=noise))
    device.connect()
    device.start(0.0)
    length = load_script(name).duration + 2
    frames = [device.read(time) for time in np.arange(0, length, DT).tolist()]
    return {n: np.array([frame.pose(n) for frame in frames if frame is not None]) for n in FRAMES}


def test_minimum_jerk_starts_and_ends_at_rest() -> None:
    assert (compute_minimum_jerk(-1), compute_minimum_jerk(0)) == (0, 0)
    assert (compute_minimum_jerk(1), compute_minimum_jerk(2)) == (1, 1)
    assert compute_minimum_jerk(0.5) == pytest.approx(0.5)
    step = 1e-4
    for end in (0.0, 1.0):
        before, here, after = (compute_minimum_jerk(end + i * step) for i in (-1, 0, 1))
        assert abs(after - before) / (2 * step) < 1e-6
        assert abs(after - 2 * here + before) / step**2 < 0.01
    middle = (compute_minimum_jerk(0.5 + step) - compute_minimum_jerk(0.5 - step)) / (2 * step)
    assert middle == pytest.approx(1.875, abs=1e-4)


def test_waypoints_are_passed_at_rest_and_left_out_parts_stay() -> None:
    head = [
        {"t": 1, "position": [0, 0, 1.6], "rpy_deg": [0, 0, 90]},
        {"t": 2, "position": [1, 0, 1.6]},
        {"t": 4, "rpy_deg": [0, 0, -170]},
    ]
    track = make_script(make_content(head=head)).tracks["head"]
    np.testing.assert_allclose(track.at(0.0)[:3], [0, 0, 1.6])
    np.testing.assert_allclose(track.at(1.5)[:3], [0.5, 0, 1.6], atol=1e-12)
    np.testing.assert_allclose(track.at(9.0)[:3], [1, 0, 1.6])
    quarter = quat_from_rpy(0, 0, np.pi / 2)
    np.testing.assert_allclose(rotation_error(track.at(2.0)[3:], quarter), 0, atol=1e-12)
    # From 90° to −170° it is shorter to turn left by 100°.
    halfway = quat_from_rpy(0, 0, np.radians(140))
    np.testing.assert_allclose(rotation_error(track.at(3.0)[3:], halfway), 0, atol=1e-9)
    for time in (1.0, 2.0, 4.0):
        speed = (track.at(time + 1e-4)[:3] - track.at(time - 1e-4)[:3]) / 2e-4
        assert np.abs(speed).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("name", list_scripts())
def test_shipped_scripts_move_like_a_calm_person(name: str) -> None:
    for seed in (0, 1):
        poses = play(name, seed)
        for frame, most in (("head", 0.6), ("left_wrist", 0.9), ("right_wrist", 0.9)):
            speed = np.linalg.norm(np.diff(poses[frame][:, :3], axis=0), axis=1) / DT
            assert speed.max() < most, frame
            turn = rotation_error(poses[frame][1:, 3:], poses[frame][:-1, 3:]) / DT
            assert np.linalg.norm(turn, axis=1).max() < 1.5, frame
            reach = np.linalg.norm(poses[frame][:, :3] - poses["head"][:, :3], axis=1)
            assert reach.max() < 0.75, frame
    walked = poses["head"][-1, :2] - poses["head"][0, :2]
    assert np.linalg.norm(walked) > 0.75


def test_g1_script_squats_walks_turns_and_reaches() -> None:
    head = play("g1_squat_walk_reach", noise=0.0)["head"]
    assert head[0, 2] - head[:, 2].min() == pytest.approx(0.12, abs=1e-3)
    np.testing.assert_allclose(head[-1, :3], [0.8, 0, 1.65], atol=1e-9)
    forward = quat_rotate(head[-1, 3:], np.array([1.0, 0, 0]))
    assert np.arctan2(forward[1], forward[0]) == pytest.approx(0.5, abs=1e-3)


@pytest.mark.slow
def test_same_seed_same_stream_another_seed_another() -> None:
    first, again, other = (play("rby1_drive_reach", seed) for seed in (7, 7, 8))
    for name in FRAMES:
        np.testing.assert_array_equal(first[name], again[name])
        assert np.abs(first[name] - other[name]).max() > 1e-4


def test_stream_does_not_depend_on_what_was_read_before() -> None:
    device = make_device(DeviceConfig(seed=3))
    device.connect()
    device.start(1.0)
    alone = device.read(6.0)
    for time in (2.0, 14.0, 3.3):
        device.read(time)
    again = device.read(6.0)
    assert alone is not None
    assert again is not None
    np.testing.assert_array_equal(alone.left_wrist, again.left_wrist)


def test_noise_has_the_published_size_and_band() -> None:
    noise = HumanNoise(seed=0)
    sway = np.array([noise.at(time).head for time in np.arange(0, 300, 0.1).tolist()])
    np.testing.assert_allclose(sway.std(axis=0), HEAD_SWAY, rtol=0.15)
    tremor = BandNoise(np.random.default_rng(0), TREMOR_BAND, TREMOR)
    signal = np.array([tremor.at(time)[0] for time in np.arange(0, 60, 0.01).tolist()])
    assert signal.std() == pytest.approx(TREMOR[0], rel=0.15)
    power = np.abs(np.fft.rfft(signal)) ** 2
    frequency = np.fft.rfftfreq(len(signal), 0.01)
    inside = (frequency > 7.9) & (frequency < 12.1)
    assert power[inside].sum() > 0.99 * power.sum()
    still = HumanNoise(seed=0, scale=0.0).at(1.0)
    assert not still.head.any()
    assert not still.wrist_turns.any()


def test_pinches_modes_and_wrists_in_body() -> None:
    head = [{"t": 0, "position": [1, 2, 1.6], "rpy_deg": [0, 0, 90]}, {"t": 9}]
    hand = [{"t": 0, "position": [0.3, 0.2, -0.5]}]
    script = make_script(
        make_content(
            head=head,
            left_wrist=hand,
            wrists_in="body",
            pinch=[{"t": 1, "right": 0.08}, {"t": 2, "right": 0.01}],
            double_pinches=[{"t": 4}],
            modes=[{"t": 3, "mode": "mobile"}, {"t": 6, "mode": "stationary"}],
        )
    )
    np.testing.assert_allclose(script.pinch_at(0.0), [0.08, 0.08])
    np.testing.assert_allclose(script.pinch_at(3.0), [0.08, 0.01])
    np.testing.assert_allclose(script.pinch_at(4.12), [0.008, 0.01])
    np.testing.assert_allclose(script.pinch_at(4.3), [0.08, 0.01])
    modes = [script.mode_at(time) for time in (0, 3, 5.9, 6, 99)]
    assert modes == [None, Mode.MOBILE, Mode.MOBILE, Mode.STATIONARY, Mode.STATIONARY]


def test_wrists_in_body_turn_with_the_head(tmp_path: Path) -> None:
    path = tmp_path / "turn.yaml"
    path.write_text(
        "wrists_in: body\n"
        "head:\n- {t: 0, position: [1, 2, 1.6], rpy_deg: [0, 0, 90]}\n- {t: 1}\n"
        "left_wrist:\n- {t: 0, position: [0.3, 0.2, -0.5]}\n"
        "right_wrist:\n- {t: 0, position: [0.3, -0.2, -0.5]}\n"
        "modes:\n- {t: 0.5, mode: mobile}\n"
    )
    device = make_device(DeviceConfig(path=str(path), noise=0.0, hold_s=0.5))
    device.connect()
    frame = device.read(0.0)
    assert frame is not None
    np.testing.assert_allclose(frame.left_wrist[:3], [0.8, 2.3, 1.1], atol=1e-12)
    assert frame.mode is Mode.STATIONARY
    device.start(0.0)
    later = device.read(0.6)
    assert later is not None
    assert later.mode is Mode.MOBILE
    assert [device.is_finished(time) for time in (1.4, 1.5)] == [False, True]


FAULTS = {
    "unknown key": (
        make_content(haed=[]),
        "unknown key 'haed' in the script. Known: description, duration, wrists_in, head, "
        "left_wrist, right_wrist, double_pinches, pinch, modes",
    ),
    "missing track": (
        {"head": [{"t": 0, "position": [0, 0, 1]}]},
        "the script lacks left_wrist, right_wrist",
    ),
    "not a mapping": ([1, 2], "the script must be a mapping, got [1, 2]"),
    "not a list": (make_content(head={"t": 0}), "head must be a list, got {'t': 0}"),
    "no position": (
        make_content(head=[{"t": 0}]),
        "head must start with a waypoint that has a position",
    ),
    "unknown waypoint key": (
        make_content(head=[{"t": 0, "pos": [0, 0, 1]}]),
        "unknown key 'pos' in head[0]. Known: t, position, rpy_deg, quat",
    ),
    "two numbers": (
        make_content(head=[{"t": 0, "position": [0, 1]}]),
        "head[0].position must be a list of 3 numbers, got [0, 1]",
    ),
    "coordinates of a map": (
        make_content(head=[{"t": 0, "position": [449_000, 5_411_000, 1.6]}]),
        "head[0].position is 5411000 m from the origin, where the 32 bits of a dataset are no "
        "longer exact to a millimetre. Move the origin, of all poses alike, to within 10000 m",
    ),
    "text": (
        make_content(head=[{"t": 0, "position": [0, "x", 1]}]),
        "head[0].position[1] must be a finite number, got 'x'",
    ),
    "not finite": (
        make_content(head=[{"t": 0, "position": [0, float("nan"), 1]}]),
        "head[0].position[1] must be a finite number, got nan",
    ),
    "time going back": (
        make_content(head=[{"t": 1, "position": [0, 0, 1]}, {"t": 1}]),
        "head[1].t must be after 1 s, got 1",
    ),
    "negative time": (
        make_content(head=[{"t": -1, "position": [0, 0, 1]}]),
        "head[0].t must be at least 0 s, got -1",
    ),
    "two orientations": (
        make_content(
            head=[{"t": 0, "position": [0, 0, 1], "quat": [1, 0, 0, 0], "rpy_deg": [0, 0, 0]}]
        ),
        "head[0] has both rpy_deg and quat; give one",
    ),
    "quaternion": (
        make_content(head=[{"t": 0, "position": [0, 0, 1], "quat": [1, 1, 0, 0]}]),
        "head[0].quat (qw qx qy qz) must have norm 1, got 1.41421",
    ),
    "duration": (
        make_content(duration=1),
        "duration must be above 0 and at least the last waypoint's 2 s, got 1",
    ),
    "hand": (
        make_content(double_pinches=[{"t": 0, "hand": "both"}]),
        "double_pinches[0].hand must be one of left, right, got 'both'",
    ),
    "mode": (
        make_content(modes=[{"t": 0, "mode": "run"}]),
        "modes[0].mode must be one of stationary, mobile, got 'run'",
    ),
    "wrists_in": (
        make_content(wrists_in="hip"),
        "wrists_in must be one of world, body, got 'hip'",
    ),
    "negative pinch": (
        make_content(pinch=[{"t": 0, "left": -0.1}]),
        "pinch[0] must not be negative, got -0.1",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_malformed_script_is_named(name: str) -> None:
    content, fault = FAULTS[name]
    with pytest.raises(BadScript) as error:
        make_script(content, "a.yaml")
    assert str(error.value) == f"operator script 'a.yaml': {fault}"


def test_missing_and_unreadable_scripts_are_named(tmp_path: Path) -> None:
    with pytest.raises(BadScript) as error:
        load_script("dance")
    assert str(error.value) == (
        "operator script 'dance': there is no such file. Built-in scripts: "
        "g1_squat_walk_reach, rby1_drive_reach, rby1m_sidestep_reach"
    )
    path = tmp_path / "broken.yaml"
    path.write_text("head: [")
    with pytest.raises(BadScript, match="it is not readable YAML"):
        load_script(str(path))


@pytest.mark.parametrize("name", list_scripts())
def test_every_built_in_script_loads(name: str) -> None:
    assert isinstance(load_script(name), Script)


def test_importing_the_operator_is_light() -> None:
    """Configs are imported with every LeRobot command, so nothing heavy may come along."""
    code = (
        "import sys\n"
        "import xop_lerobot.operator.devices, xop_lerobot.operator.alignment\n"
        "import xop_lerobot.operator.gestures, xop_lerobot.operator.goal\n"
        "heavy = {'mujoco', 'torch', 'lerobot', 'scipy', 'pyarrow', 'yaml', 'mink'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
