"""Height and reach of a person: measured in five seconds, kept in LeRobot's folder, and used."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import toy_robot  # noqa: F401  registers the toy
from toy_robot import make_toy

from lerobot_teleoperator_xop import Xop, XopConfig
from tests.recording.test_lerobot_cli import run
from xop_lerobot.core.errors import BadValue, NotConnected, XopError
from xop_lerobot.core.transforms import make_pose, quat_from_rpy, quat_rotate
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.reach import compute_forward_reach
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.operator.alignment import Alignment, AlignmentConfig
from xop_lerobot.operator.calibration import (
    Calibration,
    CalibrationFailed,
    Guide,
    Step,
    calibrate,
    load_calibration,
    save_calibration,
)
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices import DEVICES, DeviceConfig
from xop_lerobot.operator.display import Display
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.session import get_session

RATE = 50
EYES, REACH = 1.63, 0.58


def make_frame(
    t: float, *, stretched: bool, heading: float = 0.7, height: float = EYES, tracked=(1, 1, 1)
) -> OperatorFrame:
    """Somebody who sways, looks a little aside, and has the arms down or stretched forward."""
    facing = quat_from_rpy(0, 0, heading)
    sway = 0.006 * np.array([np.sin(t), np.cos(1.3 * t), 0.2 * np.sin(2 * t)])
    head = np.array([1.0, -2.0, height]) + sway
    out = np.array([REACH, 0.2, -0.25]) if stretched else np.array([0.1, 0.25, -0.7])
    wrists = [
        make_pose(head + quat_rotate(facing, out * np.array([1, side, 1])), facing)
        for side in (1, -1)
    ]
    look = quat_from_rpy(0, 0.1, heading + 0.15)
    seen = np.array(tracked, dtype=bool)
    return OperatorFrame(t, make_pose(head, look), *wrists, pinch=np.full(2, 0.07), tracked=seen)


def guide_through(frames) -> Guide:
    guide = Guide()
    for frame in frames:
        guide.update(frame)
    return guide


def times(start: float, end: float, rate: float = RATE) -> np.ndarray:
    return np.arange(start, end, 1 / rate)


@pytest.mark.parametrize("heading", [0.0, 0.7, 3.0])
@pytest.mark.parametrize("rate", [25, 50, 90])
def test_five_seconds_are_enough(rate, heading):
    frames = [make_frame(t, stretched=t > 3, heading=heading) for t in times(0, 5, rate)]
    result = guide_through(frames).result
    assert result is not None
    assert result.eye_height == pytest.approx(EYES, abs=0.005)
    assert result.arm_reach == pytest.approx(REACH, abs=0.005)


def test_nothing_is_measured_while_somebody_moves_or_is_not_seen():
    rising = [make_frame(t, stretched=False, height=1.2 + 0.1 * t) for t in times(0, 5)]
    assert guide_through(rising).step is Step.STAND
    lost = [make_frame(t, stretched=False, tracked=(t % 1.5 > 0.1, 1, 1)) for t in times(0, 6)]
    assert guide_through(lost).result is None
    gaps = [make_frame(t, stretched=t > 3) for t in times(0, 9, 2.5)]
    assert guide_through(gaps).step is Step.STAND


def test_hints_say_why_it_does_not_go_on():
    guide = guide_through(make_frame(t, stretched=False, height=0.3) for t in times(0, 3))
    assert guide.hint.startswith("Your head is 0.30 m over the headset's floor: set the floor")
    guide = guide_through([])
    guide.update(None)
    assert (guide.step, guide.hint) == (Step.WAIT, "The headset is not seen.")
    standing = [make_frame(t, stretched=False) for t in times(0, 3)]
    guide = guide_through(standing)
    assert (guide.step, guide.hint) == (Step.STRETCH, "Stretch both arms forward.")
    guide.update(make_frame(3.0, stretched=True, tracked=(1, 0, 1)))
    assert guide.hint == "A hand is not seen."
    frame = make_frame(3.02, stretched=True, heading=0.0)
    frame.left_wrist[0] -= 0.2
    guide.update(frame)
    assert guide.hint == "One arm is farther out than the other."
    frame = make_frame(3.04, stretched=True)
    frame.right_wrist[2] -= 0.4
    guide.update(frame)
    assert guide.hint == "Hold your hands level with your shoulders."


def test_a_file_and_back(tmp_path):
    path = tmp_path / "folder" / "ann.json"
    save_calibration(Calibration(1.63456, 0.581), path)
    assert load_calibration(path) == Calibration(1.6346, 0.581)
    for text, fault in (
        ("{", "Expecting property name"),
        ("[]", "it must be an object of eye_height and arm_reach"),
        ('{"eye_height": 1.6}', "it must be an object of eye_height and arm_reach"),
        ('{"eye_height": 163, "arm_reach": 0.6}', "eye_height must be from 0.5 to 2.3 m, got 163"),
        ('{"eye_height": 1.6, "arm_reach": null}', "arm_reach must be from 0.3 to 1 m, got None"),
    ):
        path.write_text(text)
        with pytest.raises(BadValue) as error:
            load_calibration(path)
        assert str(error.value).startswith(f"calibration '{path}' cannot be used: {fault}")
        assert str(error.value).endswith("Calibrate again with lerobot-calibrate, or delete it")


# -- how it is used ------------------------------------------------------------------------


def test_scales_follow_from_it():
    robot = {"head": make_pose(np.array([0, 0, 1.2]), np.array([1.0, 0, 0, 0]))}
    frame = make_frame(0.0, stretched=False, height=1.1)  # bent down at engage

    def scales(robot_reach: float | None = 0.36, **settings) -> list[float]:
        alignment = Alignment(AlignmentConfig(frames=("head",), **settings))
        alignment.engage(frame, robot, 1.2, robot_reach)
        return [alignment.scales[name] for name in ("height_scale", "reach_scale")]

    stooped = 1.2 / frame.head[2]
    assert scales() == pytest.approx([stooped, stooped])
    assert scales(eye_height=1.6) == pytest.approx([0.75, 0.75])
    assert scales(eye_height=1.6, arm_reach=0.6) == pytest.approx([0.75, 0.6])
    assert scales(robot_reach=None, arm_reach=0.6) == pytest.approx([stooped, stooped])
    assert scales(arm_reach=0.6, reach_scale=0.9, height_scale=1.0) == pytest.approx([1.0, 0.9])
    with pytest.raises(BadValue, match=r"alignment\.eye_height must be finite and above 0, got 0"):
        AlignmentConfig(eye_height=0)


def test_reach_of_the_toy():
    """Two links of 0.2 m under the head, at right angles, that straighten by 2 degrees alone."""
    toy = make_morphology("toy")
    reach = compute_forward_reach(toy, build_model(toy, "planning", scene="empty"))
    assert reach == pytest.approx(0.4 * np.cos(np.radians(44)), abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "longest"), [("g1", 0.45), ("rby1", 0.75)])
def test_reach_of_the_robots(name, longest):
    """Not more than the links from the shoulder to the wrist are long in all, and near to it."""
    morphology = make_morphology(name)
    model = build_model(morphology, "planning", scene="empty")
    reach = compute_forward_reach(morphology, model)
    assert 0.6 * longest < reach < longest


# -- through LeRobot -----------------------------------------------------------------------


class Stretcher(Device):
    """A person who does what the display asks for."""

    def __init__(self, config: DeviceConfig) -> None:
        self._asked, self._count = "", 0

    def read(self, time: float) -> OperatorFrame:
        self._count += 1
        return make_frame(self._count / 30, stretched=self._asked == Step.STRETCH.value)

    def show(self, display: Display) -> None:
        self._asked = display.holding


@pytest.fixture(autouse=True)
def stretcher() -> Iterator[None]:
    DEVICES.add("stretcher", Stretcher)
    yield
    DEVICES.remove("stretcher")


def test_who_does_not_stretch_is_given_up():
    device, now, said = Stretcher(DeviceConfig()), [0.0], []
    device.show = lambda display: None  # sees nothing

    def sleep(duration: float) -> None:
        now[0] += duration

    with pytest.raises(CalibrationFailed, match="nothing was measured within 9 s: Stretch both"):
        calibrate(device, say=said.append, clock=lambda: now[0], sleep=sleep, patience_s=9.0)
    assert said == [
        Step.STAND.value,
        Step.STRETCH.value,
        "Stretch both arms forward.",
    ]


@pytest.mark.slow
def test_lerobot_calibrate_and_then_drive(tmp_path, monkeypatch, request, capsys):
    folder = tmp_path / "calibration"
    flags = ["--teleop.type=xop", "--teleop.id=ann", f"--teleop.calibration_dir={folder}"]
    run(monkeypatch, "lerobot-calibrate", *flags, "--teleop.device.type=stretcher")
    said = capsys.readouterr().err
    saved = json.loads((folder / "ann.json").read_text())
    assert saved == pytest.approx({"eye_height": EYES, "arm_reach": REACH}, abs=0.005)
    assert said.count("Stretch both arms out in front of you") == 1
    assert f"Saved for '--teleop.id=ann' in '{folder / 'ann.json'}'." in said

    session = request.node.name

    def make(**settings) -> Xop:
        config = {"session": session, "id": "ann", "calibration_dir": folder} | settings
        device, retargeter = DeviceConfig(type="stretcher"), RetargeterConfig(type="direct")
        return Xop(XopConfig(device=device, retargeter=retargeter, **config))

    robot, teleop = make_toy(session), make()
    assert teleop.is_calibrated
    teleop.connect()
    robot.connect()
    robot.get_observation()
    teleop.get_action()
    assert teleop._teleoperation is not None
    config = teleop._teleoperation.config.alignment
    assert [config.eye_height, config.arm_reach] == list(saved.values())
    kept = get_session(session).configs["teleop"]["alignment"]
    assert [kept["eye_height"], kept["arm_reach"]] == list(saved.values())
    with pytest.raises(XopError, match="a robot is driven already; calibrate with lerobot-cal"):
        teleop.calibrate()
    teleop.disconnect()
    robot.disconnect()

    # What the flags say counts over it; somebody else is not Ann; and a bad file is told.
    tall = make(alignment=AlignmentConfig(eye_height=1.9))
    assert tall._make_alignment().eye_height == 1.9
    other = make(id="bob")
    assert not other.is_calibrated
    with pytest.raises(NotConnected):
        other.calibrate()
    (folder / "bob.json").write_text("{}")
    with pytest.raises(BadValue, match=r"calibration '.*bob\.json' cannot be used"):
        make(id="bob")


@pytest.mark.slow
def test_recordings_need_none(tmp_path, monkeypatch, capsys):
    flags = ["--teleop.type=xop", f"--teleop.calibration_dir={Path(tmp_path)}"]
    run(monkeypatch, "lerobot-calibrate", *flags)
    assert "Device 'scripted' needs no calibration." in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
