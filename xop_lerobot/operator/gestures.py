"""Gestures: double pinches of one or both hands, raised hands, and their effects.

Their effects concern the robot (engage, disengage, change the mode) and the recording.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.yaml_words import fill_nulls, find_word
from xop_lerobot.operator.display import RecordingRequest
from xop_lerobot.operator.engagement import ClutchConfig
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.raised_hands import RaisedHands, RaisedHandsConfig
from xop_lerobot.retarget.config import CONSTRAINTS, PRESETS

HANDS = ("left", "right")
GRIP_OPEN = 0.06
"""Distance of thumb and index tip from which a hand counts as open [m]."""
GRIP_CLOSED = 0.015
"""Distance of thumb and index tip up to which a hand counts as closed [m]."""


def grip_from_pinch(distance: np.ndarray | float) -> np.ndarray:
    """Closing of a hand: 0 open (≥ 0.06 m), 1 closed (≤ 0.015 m), linear in between.

    Args:
        distance: Distance of thumb and index tip [m]. Any shape.
    """
    fraction = (GRIP_OPEN - np.asarray(distance, float)) / (GRIP_OPEN - GRIP_CLOSED)
    return np.clip(fraction, 0.0, 1.0)


@dataclass
class DoublePinchConfig:
    """Limits of a double pinch.

    Attributes:
        hand: Hand that toggles the mode, ``"left"`` or ``"right"``.
        on: Distance of thumb and index tip at which a hand closes [m].
        off: Distance at which it opens again [m].
        min_frames: Least number of samples in which each pinch is closed.
        min_pinch: Shortest pinch [s].
        max_pinch: Longest pinch [s].
        min_gap: Shortest time from release to the next press [s].
        max_gap: Longest time from release to the next press. A third pinch within it cancels the
            double pinch, so the toggle comes that long after the second release [s].
        refractory: Time after a toggle before another double pinch may start [s].
        max_wrist_speed: Wrist speed above which a pinch is a grasp, not a gesture [m/s].
        veto: Time for which pinches are ignored after the hand was lost or fast [s].
    """

    hand: str = "left"
    on: float = 0.018
    off: float = 0.035
    min_frames: int = 2
    min_pinch: float = 0.05
    max_pinch: float = 0.35
    min_gap: float = 0.06
    max_gap: float = 0.4
    refractory: float = 0.8
    max_wrist_speed: float = 0.5
    veto: float = 0.2

    def __post_init__(self) -> None:
        """Validate all values.

        Raises:
            UnknownName: If `hand` is not a hand.
            BadValue: If a number is negative, or a pair is in the wrong order.
        """
        fill_nulls(self)
        if self.hand not in HANDS:
            raise UnknownName("double_pinch.hand", self.hand, HANDS)
        for name, value in vars(self).items():
            if name != "hand" and not (math.isfinite(value) and value >= 0):
                raise BadValue(f"double_pinch.{name} must be finite and at least 0, got {value}")
        for low, high in (("on", "off"), ("min_pinch", "max_pinch"), ("min_gap", "max_gap")):
            if getattr(self, low) >= getattr(self, high):
                raise BadValue(
                    f"double_pinch.{low} must be below {high}, got {getattr(self, low)} and "
                    f"{getattr(self, high)}"
                )


class DoublePinchDetector:
    """Distinguishes double pinches from grasps by the stamps of the samples.

    Pinches separated by at most `max_gap` form a burst. A burst of exactly two clean pinches is a
    double pinch; a pinch that is too short or too long, or a hand that is lost or moves fast,
    invalidates its burst. Only stamps count, so a recorded stream replays with the same toggles.

    Args:
        config: Thresholds and durations.
    """

    def __init__(self, config: DoublePinchConfig | None = None) -> None:
        self.config = config or DoublePinchConfig()
        self._hand = HANDS.index(self.config.hand)
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._time: float | None = None
        self._wrist: np.ndarray | None = None
        self._closed = False
        self._closed_frames = 0
        self._pressed_at = self._released_at = self._began_at = -math.inf
        self._taps = 0
        self._spoiled = False
        self._distrusted_at = self._toggled_at = -math.inf

    def update(self, frame: OperatorFrame) -> bool:
        """Process one sample; return whether it completes a double pinch.

        Samples with the previous stamp are ignored; an earlier stamp resets the detector.
        """
        if self._time is not None and frame.time < self._time:
            self.reset()
        if self._time == frame.time:
            return False
        if self._is_distrusted(frame):
            self._distrusted_at = frame.time
            # Once the second pinch is released, the hand may move on.
            self._spoiled |= self._closed or self._taps == 1
        self._time = frame.time
        if self._is_tracked(frame):
            self._follow(frame.time, float(frame.pinch[self._hand]))
        return self._take_double(frame.time)

    @property
    def is_busy(self) -> bool:
        """Whether pinches are in progress that may become a double pinch."""
        return self._closed or self._taps > 0

    def _is_tracked(self, frame: OperatorFrame) -> bool:
        return bool(frame.tracked[1 + self._hand])

    def _is_distrusted(self, frame: OperatorFrame) -> bool:
        """Whether the hand is lost, had a gap, or moves fast."""
        if not self._is_tracked(frame):
            self._wrist = None
            return True
        wrist = frame.pose(f"{self.config.hand}_wrist")[:3]
        last, self._wrist = self._wrist, np.array(wrist, dtype=float)
        if self._time is None or last is None:
            return False
        dt = frame.time - self._time
        speed = float(np.linalg.norm(wrist - last)) / dt
        return dt > self.config.veto or speed > self.config.max_wrist_speed

    def _follow(self, time: float, distance: float) -> None:
        if not self._closed and distance <= self.config.on:
            self._press(time)
        elif self._closed and distance >= self.config.off:
            self._release(time)
        elif self._closed and distance <= self.config.on:
            self._closed_frames += 1

    def _press(self, time: float) -> None:
        if time - self._released_at > self.config.max_gap:
            self._taps, self._spoiled, self._began_at = 0, False, time
        elif time - self._released_at < self.config.min_gap:
            self._spoiled = True
        self._spoiled |= time - self._distrusted_at < self.config.veto
        self._closed, self._closed_frames, self._pressed_at = True, 1, time

    def _release(self, time: float) -> None:
        length = time - self._pressed_at
        clean = self.config.min_pinch <= length <= self.config.max_pinch
        self._spoiled |= not clean or self._closed_frames < self.config.min_frames
        self._closed, self._released_at = False, time
        self._taps += 1

    def _take_double(self, time: float) -> bool:
        """Evaluate the burst once it is over."""
        if self._closed or not self._taps or time - self._released_at <= self.config.max_gap:
            return False
        rested = self._began_at - self._toggled_at >= self.config.refractory
        double = self._taps == 2 and not self._spoiled and rested
        self._taps, self._spoiled = 0, False
        if double:
            self._toggled_at = time
        return double


class Gesture(Enum):
    """Gesture of the operator's hands."""

    DOUBLE_PINCH = "double_pinch"
    OTHER_DOUBLE_PINCH = "other_double_pinch"
    BOTH_DOUBLE_PINCH = "both_double_pinch"


OTHER_PINCHES = ("success", "none")
"""Effects of a double pinch of the hand that does not toggle the mode."""


@dataclass
class GestureConfig:
    """Effects of the gestures.

    Attributes:
        double_pinch: Thresholds of the double pinch that toggles the mode.
        other_double_pinch: Effect of a double pinch of the other hand: ``"success"`` marks the
            episode as a success, or removes the mark; or ``"none"``.
        both_double_pinch: What a double pinch of both hands at once toggles: a constraint
            (`upright`), a preset against `default`, or `none`.
        window: Longest time between the double pinches of the two hands [s].
        raised: Requests to the recorder by raised hands.
        clutch: Gesture that engages and disengages.
    """

    double_pinch: DoublePinchConfig = field(default_factory=DoublePinchConfig)
    other_double_pinch: str = "success"
    both_double_pinch: str = "upright"
    window: float = 0.5
    raised: RaisedHandsConfig = field(default_factory=RaisedHandsConfig)
    clutch: ClutchConfig = field(default_factory=ClutchConfig)

    def __post_init__(self) -> None:
        """Validate the values not validated by its parts.

        Raises:
            UnknownName: If there is no such effect.
            BadValue: If the window is not positive.
        """
        known = ("none", *CONSTRAINTS, *PRESETS)
        self.both_double_pinch = find_word(self.both_double_pinch, known)
        self.other_double_pinch = find_word(self.other_double_pinch, OTHER_PINCHES)
        fill_nulls(self)
        if self.both_double_pinch not in known:
            raise UnknownName("gestures.both_double_pinch", self.both_double_pinch, known)
        if self.other_double_pinch not in OTHER_PINCHES:
            raise UnknownName("gestures.other_double_pinch", self.other_double_pinch, OTHER_PINCHES)
        if not (math.isfinite(self.window) and self.window > 0):
            raise BadValue(f"gestures.window must be finite and above 0, got {self.window}")


class GestureReader:
    """Distinguishes double pinches of one hand from those of both.

    The double pinch of one hand counts at once, unless the other hand is or was just pinching: then
    it counts once decided, as one of both hands or of its own.

    Args:
        config: Hand that toggles, thresholds and window.
    """

    def __init__(self, config: GestureConfig | None = None) -> None:
        config = config or GestureConfig()
        first = config.double_pinch
        other = HANDS[1 - HANDS.index(first.hand)]
        self._detectors = {
            Gesture.DOUBLE_PINCH: DoublePinchDetector(first),
            Gesture.OTHER_DOUBLE_PINCH: DoublePinchDetector(dataclasses.replace(first, hand=other)),
        }
        self._window = config.window
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        for detector in self._detectors.values():
            detector.reset()
        self._pending: dict[Gesture, float] = {}  # start times of undecided gestures

    def update(self, frame: OperatorFrame) -> Gesture | None:
        """Process one sample; return the gesture it completes, None if none."""
        for gesture, detector in self._detectors.items():
            if detector.update(frame):
                self._pending[gesture] = frame.time
        if len(self._pending) > 1:
            first, second = sorted(self._pending.values())
            if second - first <= self._window:
                self._pending.clear()
                return Gesture.BOTH_DOUBLE_PINCH
        for gesture, since in sorted(self._pending.items(), key=lambda item: item[1]):
            others = [each for name, each in self._detectors.items() if name is not gesture]
            waits = 0 <= frame.time - since < self._window
            if not (waits and any(each.is_busy for each in others)):
                del self._pending[gesture]
                return gesture
        return None


class Effects(NamedTuple):
    """Effects of the gestures completed by a frame."""

    mode: bool = False
    """Whether to toggle the mode."""
    toggle: str = ""
    """Constraint or preset to toggle; empty for none."""
    requests: tuple[RecordingRequest, ...] = ()
    """Requests to the recorder."""


class Hands:
    """Reads all gestures except the clutch's, engaged or not.

    Args:
        config: Effects of the gestures.
        has_person: Whether a person wears a headset. Recordings and scripts replay their mode
            gestures, but must not control the present recording.
    """

    def __init__(self, config: GestureConfig, *, has_person: bool) -> None:
        self._config, self._has_person = config, has_person
        self._pinches = GestureReader(config)
        self.raised = RaisedHands(config.raised)

    def reset(self) -> None:
        """Forget all samples."""
        self._pinches.reset()
        self.raised.reset()

    def read(self, frame: OperatorFrame | None) -> Effects:
        """Process the frame of a tick, None before the first."""
        requests = []
        if self._has_person and (request := self.raised.update(frame)) is not None:
            requests.append(request)
        pinched = None if frame is None else self._pinches.update(frame)
        both, other = self._config.both_double_pinch, self._config.other_double_pinch
        if pinched is Gesture.OTHER_DOUBLE_PINCH and self._has_person and other == "success":
            requests.append(RecordingRequest.SUCCESS)
        toggles = pinched is Gesture.BOTH_DOUBLE_PINCH and both != "none"
        return Effects(pinched is Gesture.DOUBLE_PINCH, both if toggles else "", tuple(requests))


def explain_gestures(config: GestureConfig) -> dict[str, str]:
    """Explain each gesture in a sentence, by its effect."""
    clutch, raised = config.clutch, config.raised
    palms = "turn both palms up, " if clutch.gesture == "palms_up" else ""
    first = config.double_pinch.hand
    other = "right" if first == "left" else "left"
    explained = {
        "engage": f"{palms}pinch with both hands, and hold still for {clutch.hold:g} s".capitalize()
        + "; the same gesture disengages",
        "mode": f"Pinch twice with the {first} hand",
    }
    for name, length in (
        ("end", raised.hold), ("redo", raised.long_hold), ("stop", raised.long_hold)
    ):  # fmt: skip
        hands = getattr(raised, name)
        if hands != "none":
            which = "both hands, palms" if hands == "both" else f"the {hands} hand, palm"
            explained[name] = (
                f"Raise {which} away from you, pinch there, and hold still for {length:g} s"
            )
    if config.other_double_pinch == "success":
        explained["success"] = f"Pinch twice with the {other} hand"
    if config.both_double_pinch != "none":
        explained[config.both_double_pinch] = "Pinch twice with both hands at once"
    return explained
