"""Raised hands: gestures that make requests to the recorder."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import compute_heading, quat_from_yaw, quat_rotate
from xop_lerobot.core.yaml_words import fill_nulls, find_word
from xop_lerobot.operator.display import RecordingRequest
from xop_lerobot.operator.frame import OperatorFrame

RAISED = ("left", "right", "both", "none")
WRISTS = ("left_wrist", "right_wrist")
UPRIGHT, STILL_UPRIGHT = 0.7, 0.5
"""Least vertical component of the fingers and forward component of the palm, to start (45°) and to
continue (30°)."""
BELOW_EYES = 0.5
"""Largest depth of a raised wrist below the eyes [m]."""
REQUESTS = {
    "end": RecordingRequest.END,
    "redo": RecordingRequest.REDO,
    "stop": RecordingRequest.STOP,
}
HOLDING = {
    RecordingRequest.END: "Keep holding to end the episode",
    RecordingRequest.REDO: "Keep holding to discard the episode",
    RecordingRequest.STOP: "Keep holding to stop the session",
}
"""Text shown while a gesture is held."""


@dataclass
class RaisedHandsConfig:
    """Hands of each request: ``"left"``, ``"right"``, ``"both"`` or ``"none"``.

    Attributes:
        end: Raised to end and save the episode.
        redo: Raised to discard the episode and record it again.
        stop: Raised to end the session.
        hold: Hold time of `end` [s].
        long_hold: Hold time of `redo` and `stop`, which cannot be undone [s].
        on: Distance of thumb and index tip at which a hand closes [m].
        off: Distance at which it opens again [m].
        slack: Largest motion of a held hand from where it closed [m].
        max_gap: Longest time between two frames that continues a gesture [s].
    """

    end: str = "right"
    redo: str = "left"
    stop: str = "both"
    hold: float = 1.0
    long_hold: float = 2.0
    on: float = 0.018
    off: float = 0.035
    slack: float = 0.06
    max_gap: float = 0.2

    def __post_init__(self) -> None:
        """Validate all values.

        Raises:
            UnknownName: If there are no such hands, listing the known ones.
            BadValue: If a number is not above 0, `on` is not below `off`, or two requests have the
                same hands.
        """
        for name in REQUESTS:
            setattr(self, name, find_word(getattr(self, name), RAISED))
        fill_nulls(self)
        hands = {name: getattr(self, name) for name in REQUESTS}
        for name, which in hands.items():
            if which not in RAISED:
                raise UnknownName(f"gestures.raised.{name}", which, RAISED)
        used = [which for which in hands.values() if which != "none"]
        for which in set(used):
            if used.count(which) > 1:
                names = " and ".join(name for name in hands if hands[name] == which)
                raise BadValue(f"gestures.raised: {names} must not have the same hand ({which})")
        for name in ("hold", "long_hold", "on", "off", "slack", "max_gap"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise BadValue(f"gestures.raised.{name} must be finite and above 0, got {value}")
        if self.on >= self.off:
            raise BadValue(f"gestures.raised.on must be below off, got {self.on} and {self.off}")


class _Hand:
    """State of one hand: raised, and closed since.

    Only a pinch that starts in a raised hand counts, so a hand that carries something makes no
    gesture in any orientation.
    """

    def __init__(self, name: str, config: RaisedHandsConfig) -> None:
        self._name, self._config = name, config
        self.reset()

    def reset(self) -> None:
        self.raised = self._ready = False
        self._place: np.ndarray | None = None

    @property
    def closed(self) -> bool:
        """Whether it has closed while raised, and was still since."""
        return self._place is not None

    def follow(self, frame: OperatorFrame, forward: np.ndarray, pinch: float) -> None:
        wrist = frame.pose(self._name)
        limit = STILL_UPRIGHT if self.raised else UPRIGHT
        fingers = quat_rotate(wrist[3:], np.array([1.0, 0, 0]))
        palm = quat_rotate(wrist[3:], np.array([0.0, 0, -1]))
        high = wrist[2] >= frame.head[2] - BELOW_EYES
        self.raised = bool(high and fingers[2] >= limit and palm @ forward >= limit)
        if not self.raised:
            self.reset()
        elif pinch >= self._config.off:
            self._ready, self._place = True, None
        elif self._place is not None:
            if np.linalg.norm(wrist[:3] - self._place) > self._config.slack:
                self._ready, self._place = False, None
        elif self._ready and pinch <= self._config.on:
            self._place = wrist[:3].copy()

    def spend(self) -> None:
        """Mark the gesture as used; the next one starts with an open hand."""
        self._ready, self._place = False, None


class RaisedHands:
    """Detects requests to the recorder by raised hands.

    A hand is raised as in a "halt" sign: fingers up, palm away from the person. It pinches there
    and is held still. The request depends on which hands are raised. Head and both hands must be
    tracked. Only stamps count, so a recorded stream replays with the same gestures.

    Args:
        config: Hand and hold time of each request.
    """

    def __init__(self, config: RaisedHandsConfig | None = None) -> None:
        self.config = config or RaisedHandsConfig()
        c = self.config
        self._requests = {getattr(c, name): request for name, request in REQUESTS.items()}
        self._requests.pop("none", None)
        self._hands = [_Hand(name, c) for name in WRISTS]
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._time: float | None = None
        self._stop()

    def _stop(self) -> None:
        for hand in self._hands:
            hand.reset()
        self.request: RecordingRequest | None = None
        """Request of the current gesture, None if none is held."""
        self._since = 0.0
        self.progress = 0.0
        """Elapsed share of its hold, from 0 to 1."""

    def update(self, frame: OperatorFrame | None) -> RecordingRequest | None:
        """Process one sample; return its request, once per gesture.

        Frames with the previous stamp change nothing; an earlier stamp resets the detector.

        Args:
            frame: The operator's frame, None before the first.
        """
        if frame is None or not frame.tracked.all():
            self.reset()
            return None
        if self._time is not None:
            if frame.time == self._time:
                return None
            if not 0 < frame.time - self._time <= self.config.max_gap:
                self._stop()
        self._time = frame.time
        forward = quat_rotate(quat_from_yaw(compute_heading(frame.head[3:])), np.eye(3)[0])
        for hand, pinch in zip(self._hands, frame.pinch, strict=True):
            hand.follow(frame, forward, float(pinch))
        return self._hold(frame.time)

    def _hold(self, time: float) -> RecordingRequest | None:
        request = self._find_request()
        if request is not self.request:
            self.request, self._since = request, time
        if request is None:
            self.progress = 0.0
            return None
        length = self.config.hold if request is RecordingRequest.END else self.config.long_hold
        # Sums of stamps round; a microsecond of tolerance saves waiting for another sample.
        self.progress = min((time - self._since + 1e-6) / length, 1.0)
        if self.progress < 1:
            return None
        for hand in self._hands:
            hand.spend()
        self.request, self.progress = None, 0.0
        return request

    def _find_request(self) -> RecordingRequest | None:
        """Return the present request; all raised hands must be closed."""
        raised = [hand.raised for hand in self._hands]
        if not any(raised) or [hand.closed for hand in self._hands] != raised:
            return None
        which = "both" if all(raised) else "left" if raised[0] else "right"
        return self._requests.get(which)
