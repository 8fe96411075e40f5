"""Calibration: measures a person's eye height and arm reach within five seconds."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.operator.alignment import MIN_OPERATOR_HEIGHT
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.display import Cue, Display, NoticeBoard
from xop_lerobot.operator.frame import OperatorFrame

STILL = 0.04
"""Largest motion of the measured quantities that counts as still [m]."""
STAND_S, STRETCH_S = 2.0, 1.5
"""Time to stand upright, and to hold the arms stretched [s]."""
EYE_HEIGHT = (MIN_OPERATOR_HEIGHT, 2.3)
"""Plausible eye heights above the floor, standing or sitting [m]."""
ARM_REACH = (0.3, 1.0)
"""Plausible horizontal distances from eyes to wrists, arms stretched forward [m]."""
UNEVEN = 0.1
"""Largest difference between the reaches of both arms [m]."""
SHOULDERS = (0.0, 0.5)
"""Plausible depths of the wrists below the eyes, arms stretched forward [m]."""
MAX_GAP = 0.3
"""Longest time between frames that continues a measurement [s]."""
RATE_HZ = 50.0
"""Rate at which frames are read [Hz]."""
HINT_S = 2.0
"""Time for which a problem must persist before it is shown [s]."""


class CalibrationFailed(XopError):
    """The person could not be measured; the message gives the reason."""


@dataclass(frozen=True)
class Calibration:
    """Measurements of a person.

    Attributes:
        eye_height: Height of the head's frame over the floor, standing upright [m].
        arm_reach: Horizontal distance from the head to the wrists, arms stretched forward [m].
    """

    eye_height: float
    arm_reach: float

    def __post_init__(self) -> None:
        """Validate both values.

        Raises:
            BadValue: If one is implausible for a person.
        """
        for name, (low, high) in (("eye_height", EYE_HEIGHT), ("arm_reach", ARM_REACH)):
            value = getattr(self, name)
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (number and math.isfinite(value) and low <= value <= high):
                raise BadValue(f"{name} must be from {low:g} to {high:g} m, got {value!r}")


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write `calibration` to `path`, as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rounded = {name: round(value, 4) for name, value in asdict(calibration).items()}
    path.write_text(json.dumps(rounded, indent=4) + "\n", encoding="utf-8")


def load_calibration(path: Path) -> Calibration:
    """Read a file of `save_calibration`.

    Raises:
        BadValue: If the file is malformed; names it and says what to do.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, Mapping) or set(values) != {"eye_height", "arm_reach"}:
            raise BadValue("it must be an object of eye_height and arm_reach")
        return Calibration(**values)
    except (ValueError, BadValue) as error:
        raise BadValue(
            f"calibration '{path}' cannot be used: {error}. Calibrate again with "
            "lerobot-calibrate, or delete it"
        ) from None


class Step(Enum):
    """Step of the calibration; the value is its instruction."""

    WAIT = "Waiting for the headset."
    STAND = "Stand upright and look straight ahead."
    STRETCH = "Stretch both arms out in front of you, level with your shoulders, and hold still."
    DONE = "Done."


class Guide:
    """State machine of the calibration, driven by time-stamped frames.

    Attributes:
        step: Current step.
        progress: Completed share of the step, from 0 to 1.
        result: Measured values, None before the end.
    """

    def __init__(self) -> None:
        self.step, self.progress = Step.WAIT, 0.0
        self.result: Calibration | None = None
        self._seen: deque[tuple[float, np.ndarray]] = deque()
        self._eye_height = 0.0
        self.hint = ""
        """Why the measurement does not advance; empty if it does."""

    def update(self, frame: OperatorFrame | None) -> None:
        """Process a frame, None before the first."""
        if self.step is Step.DONE or frame is None or not frame.tracked[0]:
            self._begin(self.step)
            self.hint = "" if self.step is Step.DONE else "The headset is not seen."
            return
        if self.step is Step.WAIT:
            self._begin(Step.STAND)
        if self._seen and not 0 < frame.time - self._seen[-1][0] <= MAX_GAP:
            if frame.time == self._seen[-1][0]:
                return
            self._seen.clear()
        if self.step is Step.STAND:
            self._measure_height(frame)
        else:
            self._measure_reach(frame)

    def _begin(self, step: Step) -> None:
        self.step, self.progress, self.hint = step, 0.0, ""
        self._seen.clear()

    def _measure_height(self, frame: OperatorFrame) -> None:
        height = float(frame.head[2])
        if height < MIN_OPERATOR_HEIGHT:
            self._seen.clear()
            self.progress = 0.0
            self.hint = (
                f"Your head is {height:.2f} m over the headset's floor: set the floor in the "
                "headset, or restart its app, standing."
            )
            return
        measured = self._watch(frame.time, frame.head[:3], STAND_S)
        if measured is not None:
            self._eye_height = float(measured[2])
            self._begin(Step.STRETCH)

    def _measure_reach(self, frame: OperatorFrame) -> None:
        arms = np.stack([frame.left_wrist[:3], frame.right_wrist[:3]]) - frame.head[:3]
        self.hint = _find_fault(frame, arms)
        if self.hint:
            self._seen.clear()
            self.progress = 0.0
            return
        forward = np.array([np.linalg.norm(arms.mean(axis=0)[:2]), *arms[:, 2]])
        measured = self._watch(frame.time, forward, STRETCH_S)
        if measured is not None:
            self.result = Calibration(self._eye_height, float(measured[0]))
            self._begin(Step.DONE)

    def _watch(self, time: float, value: np.ndarray, length: float) -> np.ndarray | None:
        """Median of `value` over the last `length` [s] without motion; None before that."""
        self._seen.append((time, np.array(value)))
        values = np.array([each for _, each in self._seen])
        while len(values) > 1 and np.ptp(values, axis=0).max() > STILL:
            self._seen.popleft()
            values = values[1:]
        self.progress = min((time - self._seen[0][0] + 1e-6) / length, 1.0)
        return np.median(values, axis=0) if self.progress >= 1 else None


def _find_fault(frame: OperatorFrame, arms: np.ndarray) -> str:
    """Why `arms` (2, 3), relative to the head, are not stretched forward; empty if they are."""
    if not frame.tracked.all():
        return "A hand is not seen."
    middle = arms.mean(axis=0)
    reach = float(np.linalg.norm(middle[:2]))
    if reach < ARM_REACH[0]:
        return "Stretch both arms forward."
    forward = middle[:2] / reach
    if abs(float((arms[0] - arms[1])[:2] @ forward)) > UNEVEN:
        return "One arm is farther out than the other."
    if not all(SHOULDERS[0] <= -z <= SHOULDERS[1] for z in arms[:, 2]):
        return "Hold your hands level with your shoulders."
    if reach > ARM_REACH[1]:
        return f"Your hands seem to be {reach:.2f} m away, farther than any arm reaches."
    return ""


def calibrate(
    device: Device,
    *,
    say: Callable[[str], None],
    clock: Callable[[], float],
    sleep: Callable[[float], None],
    patience_s: float = 120.0,
) -> Calibration:
    """Guide the person in the headset through the calibration.

    Instructions are passed to `say`, and shown in the headset.

    Args:
        device: Connected headset.
        say: Called with each instruction.
        clock: Time [s].
        sleep: Waits for the given time [s].
        patience_s: Time without a result after which calibration fails [s].

    Raises:
        CalibrationFailed: If it fails; says what was missing.
    """
    guide, board = Guide(), NoticeBoard()

    def tell(cue: Cue, text: str) -> None:
        say(text)
        board.post(cue, text)

    begun = hinted = clock()
    step, hint = None, ""
    while guide.result is None:
        now = clock()
        guide.update(device.read(now))
        problem = guide.hint
        if guide.step is Step.WAIT:
            problem = device.trouble or problem
        if guide.step is not step:
            step, hint, hinted = guide.step, "", now
            tell(Cue.SETTING, step.value)
        elif problem != hint and now - hinted >= HINT_S:
            # No hint while the person is still starting to follow the instruction.
            hint, hinted = problem, now
            if problem:
                tell(Cue.REFUSED, problem)
        elif not problem:
            hinted = now
        shown = Display(
            now,
            notices=board.notices,
            warnings=(problem,) if problem else (),
            clutch=guide.progress,
            holding=guide.step.value,
        )
        device.show(shown)
        if now - begun > patience_s:
            missing = f"{guide.step.value} {problem}".strip()
            raise CalibrationFailed(f"nothing was measured within {patience_s:g} s: {missing}")
        sleep(1 / RATE_HZ)
    result = guide.result
    tell(
        Cue.SUCCESS,
        f"Measured: eyes {result.eye_height:.2f} m over the floor, arms reach "
        f"{result.arm_reach:.2f} m forward.",
    )
    device.show(Display(clock(), notices=board.notices))
    return result
