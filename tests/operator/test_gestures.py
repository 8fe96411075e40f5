"""The double pinch: what toggles, and what must not, at any sampling rate."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import DoublePinchConfig, DoublePinchDetector, grip_from_pinch
from xop_lerobot.operator.recording import load_recording
from xop_lerobot.operator.script import list_scripts

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[3] / "shared"))
RATES = [25, 30, 50, 60, 90, 120]
POSE = np.array([0.0, 0, 1.6, 1, 0, 0, 0])


def run(
    taps: list[tuple[float, float]],
    rate: float = 90,
    *,
    speed: float = 0.0,
    lost: tuple[float, float] = (9, 9),
    hand: int = 0,
    shift: float = 0.0,
    length: float = 6.0,
) -> list[float]:
    """Stamps of the toggles in a stream whose `hand` is closed during `taps` (start, end)."""
    detector = DoublePinchDetector()
    toggles = []
    for time in np.arange(shift, length, 1 / rate).tolist():
        pinch = np.full(2, 0.08)
        for start, end in taps:
            # Fingers need 40 ms to close and to open.
            closing = np.clip((time - start + 0.04) / 0.04, 0, 1)
            opening = np.clip((time - end) / 0.04, 0, 1)
            pinch[hand] -= 0.072 * closing * (1 - opening)
        wrist = POSE + np.array([speed * time, 0, 0, 0, 0, 0, 0])
        tracked = np.array([True, not lost[0] <= time < lost[1], True])
        if detector.update(OperatorFrame(time, POSE, wrist, wrist, pinch, tracked)):
            toggles.append(time)
    return toggles


DOUBLE = [(1.0, 1.12), (1.3, 1.42)]


@pytest.mark.slow
@pytest.mark.parametrize("rate", RATES)
@settings(max_examples=15, deadline=None)
@given(shift=st.floats(0, 0.039))
def test_a_double_pinch_toggles_once_at_any_rate_and_phase(rate: int, shift: float) -> None:
    toggles = run(DOUBLE, rate, shift=shift, length=2.5)
    assert len(toggles) == 1
    assert 1.42 + 0.4 < toggles[0] < 1.42 + 0.4 + 0.04 + 2 / rate


@pytest.mark.parametrize("rate", RATES)
def test_double_pinches_toggle_each(rate: int) -> None:
    later = [(start + 3.0, end + 3.0) for start, end in DOUBLE]
    assert len(run(DOUBLE + later, rate)) == 2


NOT_DOUBLE = {
    "nothing": [],
    "single": [(1.0, 1.12)],
    "slow": [(1.0, 1.12), (1.9, 2.02)],
    "triple": [*DOUBLE, (1.6, 1.72)],
    "quadruple": [*DOUBLE, (1.6, 1.72), (1.9, 2.02)],
    "long hold": [(1.0, 3.0)],
    "hold then tap": [(1.0, 1.7), (1.9, 2.02)],
    "tap then hold": [(1.0, 1.12), (1.3, 2.5)],
    "hold then double": [(0.2, 0.85), *DOUBLE],
    "too close": [(1.0, 1.06), (1.08, 1.14)],
}


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("name", NOT_DOUBLE)
def test_others_do_not_toggle(name: str, rate: int) -> None:
    assert run(NOT_DOUBLE[name], rate, length=3.5) == []


def test_fast_hand_lost_hand_and_other_hand_do_not_toggle() -> None:
    assert len(run(DOUBLE, speed=0.4)) == 1
    assert run(DOUBLE, speed=0.6) == []
    assert run(DOUBLE, lost=(0.7, 0.9)) == []
    assert run(DOUBLE, lost=(1.2, 1.25)) == []
    assert run(DOUBLE, lost=(1.05, 1.5)) == []
    assert run(DOUBLE, lost=(1.05, 1.08)) == []  # long before the second press
    assert run(DOUBLE, lost=(1.35, 1.38)) == []
    assert len(run(DOUBLE, lost=(0.3, 0.7))) == 1
    assert len(run(DOUBLE, lost=(1.6, 3.0))) == 1  # it was complete
    assert run(DOUBLE, hand=1) == []


def test_flicker_of_one_sample_is_no_pinch() -> None:
    detector = DoublePinchDetector()
    toggles = 0
    for i in range(400):
        pinch = np.array([0.01 if i in (100, 120) else 0.08, 0.08])
        toggles += detector.update(OperatorFrame(i / 120, POSE, POSE, POSE, pinch))
    assert toggles == 0


def test_refractory_and_repeated_samples() -> None:
    detector = DoublePinchDetector(DoublePinchConfig(refractory=3.0))
    toggles = []
    taps = [(1.0, 1.12), (1.3, 1.42), (3.0, 3.12), (3.3, 3.42), (6.0, 6.12), (6.3, 6.42)]
    for time in np.repeat(np.arange(0, 8, 1 / 60), 3):
        closed = any(start <= time < end for start, end in taps)
        pinch = np.array([0.01 if closed else 0.08, 0.08])
        if detector.update(OperatorFrame(time, POSE, POSE, POSE, pinch)):
            toggles.append(round(time, 1))
    assert toggles == [1.8, 6.8]


def test_a_clock_that_goes_back_starts_anew() -> None:
    detector = DoublePinchDetector()
    for _ in range(2):
        toggles = 0
        for time in np.arange(0, 2.5, 1 / 50).tolist():
            closed = any(start <= time < end for start, end in DOUBLE)
            pinch = np.array([0.01 if closed else 0.08, 0.08])
            toggles += detector.update(OperatorFrame(time, POSE, POSE, POSE, pinch))
        assert toggles == 1


@pytest.mark.slow
@pytest.mark.parametrize("rate", [25, 50])
@pytest.mark.parametrize("script", list_scripts())
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_scripts_toggle_twice(script: str, seed: int, rate: int) -> None:
    device = make_device(DeviceConfig(path=script, seed=seed))
    device.connect()
    device.start(0.0)
    detector = DoublePinchDetector()
    frames = [device.read(i / rate) for i in range(17 * rate)]
    assert sum(detector.update(frame) for frame in frames if frame is not None) == 2


@pytest.mark.parametrize("hand", ["left", "right"])
def test_real_motion_makes_no_toggle(hand: str) -> None:
    files = sorted((SHARED / "operator").glob("*.npz"))
    if not files:
        pytest.skip("the real recordings are not here")
    for file in files:
        recording = load_recording(file)
        detector = DoublePinchDetector(DoublePinchConfig(hand=hand))
        times = np.arange(0, recording.duration + 1, 1 / 90).tolist()
        assert not any(detector.update(recording.frame_at(time)) for time in times)


def test_grip_closes_with_the_pinch() -> None:
    distances = np.array([0.2, 0.06, 0.0375, 0.015, 0.0])
    np.testing.assert_allclose(grip_from_pinch(distances), [0, 0, 0.5, 1, 1])


def test_settings_are_checked() -> None:
    with pytest.raises(UnknownName) as error:
        DoublePinchConfig(hand="both")
    assert str(error.value) == "unknown double_pinch.hand 'both'. Known: left, right"
    with pytest.raises(BadValue) as value_error:
        DoublePinchConfig(on=0.05)
    assert str(value_error.value) == "double_pinch.on must be below off, got 0.05 and 0.035"
