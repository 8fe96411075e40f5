"""Messages between page and server, and conversion of poses to our convention.

Everything but pictures is JSON text. A page sends `frame`, `pong`, `wish` and `bye`; the server
sends `welcome`, `ping`, `display`, `pose` and `refused`, and pictures as a byte with the number of
the camera followed by a JPEG. `docs/how_it_works/webxr_protocol.md` holds every field.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from xop_lerobot.core.transforms import make_pose, quat_from_matrix, quat_multiply, quat_rotate
from xop_lerobot.operator.axes import WORLD
from xop_lerobot.operator.display import Display, RecordingRequest
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.stream import NORM_TOLERANCE, OPEN_PINCH

VERSION = 1
PORT = 8012
MAX_MESSAGE = 8192
"""Longest message of a page [bytes]."""
MAX_REASON = 200
"""Longest forwarded reason of a `bye` [characters]."""
SOURCES = ("hands", "controllers", "standin")
GRIP_TO_WRIST = 0.08
"""Distance from the middle of a fist around a controller back to the wrist [m]."""

# Columns: our axes in the frame of a joint. WebXR heads and wrists are parallel to its world when
# ours are: x right, y up or out of the back of the hand, z back or away from the fingers.
PARALLEL = WORLD.T
# A grip frame has z from the thumb along the held rod, x out of the back of a right hand and into
# that of a left one, and y towards the forearm.
GRIPS = {
    "left": np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]),
    "right": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
}
_WORLD_QUAT = quat_from_matrix(WORLD)
_PARALLEL_QUAT = quat_from_matrix(PARALLEL)
_GRIP_QUATS = {side: quat_from_matrix(axes) for side, axes in GRIPS.items()}
_NOWHERE = np.full(7, np.nan)
"""Pose of a limb that is not tracked."""


@dataclass(frozen=True)
class FrameMessage:
    """Head and hands of the operator.

    Attributes:
        number: Frame counter of the page.
        sent: Send time on the page's clock [s].
        source: Input source, one of `SOURCES`, except for a hand that states its own.
        frame: The frame in our convention, at time 0; malformed values are NaN.
    """

    number: int
    sent: float
    source: str
    frame: OperatorFrame


@dataclass(frozen=True)
class Pong:
    """Answer to a ping.

    Attributes:
        number: Number of the ping.
        sent: Time of the answer on the page's clock [s].
    """

    number: int
    sent: float


@dataclass(frozen=True)
class Bye:
    """The operator has ended the session, or taken off the headset.

    Attributes:
        reason: The reason, as text.
    """

    reason: str


Message = FrameMessage | Pong | RecordingRequest | Bye


def parse_message(text: str) -> Message | str:
    """Decode a message of a page.

    Returns:
        The message; or why it is invalid, in one word.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        return "no_message"
    if not isinstance(values, dict):
        return "no_message"
    parse = _PARSERS.get(str(values.get("type")))
    return "no_message" if parse is None else parse(values)


def _parse_pong(values: Mapping[str, Any]) -> Pong | str:
    number, sent = _read_count(values.get("id")), _read_number(values.get("t"))
    if number is None or not math.isfinite(sent):
        return "bad_pong"
    return Pong(number, sent / 1e3)


def _parse_request(values: Mapping[str, Any]) -> RecordingRequest | str:
    try:
        return RecordingRequest(values.get("wish"))
    except ValueError:
        return "bad_wish"


def _parse_bye(values: Mapping[str, Any]) -> Bye:
    reason = values.get("reason")
    return Bye(clean(reason) if isinstance(reason, str) else "")


def clean(text: str) -> str:
    """Return `text` for a log: one line, printable, truncated."""
    return "".join(c if c.isprintable() else " " for c in text[:MAX_REASON]).strip()


def _parse_frame(values: Mapping[str, Any]) -> FrameMessage | str:
    number, sent = _read_count(values.get("seq")), _read_number(values.get("t"))
    source = values.get("source")
    if number is None or not math.isfinite(sent) or source not in SOURCES:
        return "bad_frame"
    tracked = np.zeros(3, dtype=bool)
    head = _NOWHERE
    if values.get("head") is not None:
        head, tracked[0] = _to_ours(_read_numbers(values["head"], 7), _PARALLEL_QUAT), True
    wrists, pinch = [], np.full(2, np.nan)
    for i, side in enumerate(("left", "right")):
        hand = values.get(side)
        wrist = _NOWHERE
        # WebXR marks guessed positions as emulated; they do not count as tracked.
        if hand is not None and not (isinstance(hand, dict) and hand.get("emulated") is True):
            wrist, pinch[i] = _read_hand(hand, source, side)
            tracked[1 + i] = True
        wrists.append(wrist)
    return FrameMessage(
        number, sent / 1e3, source, OperatorFrame(0.0, head, *wrists, pinch=pinch, tracked=tracked)
    )


_PARSERS: dict[str, Callable[[Mapping[str, Any]], Message | str]] = {
    "frame": _parse_frame,
    "pong": _parse_pong,
    "wish": _parse_request,
    "bye": _parse_bye,
}


def _read_hand(hand: Any, source: str, side: str) -> tuple[np.ndarray, float]:
    """Pose of a wrist, shape (7,), and distance of thumb and index tip [m]; NaN if malformed."""
    if not isinstance(hand, dict):
        return _NOWHERE, math.nan
    source = hand.get("source", source)
    if source not in SOURCES:
        return _NOWHERE, math.nan
    if source == "controllers":
        grip = _read_numbers(hand.get("grip"), 7)
        pose = _to_ours(grip, _GRIP_QUATS[side])
        # Leave non-finite poses as they are: the stream guard counts them.
        if np.isfinite(pose).all():
            pose[:3] -= quat_rotate(pose[3:], np.array([GRIP_TO_WRIST, 0, 0]))
        trigger = _read_number(hand.get("trigger"))
        return pose, OPEN_PINCH * (1 - trigger) if 0 <= trigger <= 1 else math.nan
    pose = _to_ours(_read_numbers(hand.get("wrist"), 7), _PARALLEL_QUAT)
    if source == "standin":
        return pose, _read_number(hand.get("pinch"))
    thumb, index = (_read_numbers(hand.get(tip), 3) for tip in ("thumb", "index"))
    return pose, math.hypot(*(thumb - index))


def _to_ours(theirs: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Convert a WebXR pose x y z qx qy qz qw, given our axes in its frame as wxyz. Shape (7,)."""
    position, quat = WORLD @ theirs[:3], theirs[[6, 3, 4, 5]]
    norm = math.hypot(*quat)
    if not abs(norm - 1) <= NORM_TOLERANCE:
        return make_pose(position, quat)  # not a rotation: left for the stream guard to reject
    turned = quat_multiply(quat_multiply(_WORLD_QUAT, quat / norm), axes)
    return make_pose(position, turned)


def _read_number(value: Any) -> float:
    """Return `value` as a finite number, NaN if it is not one."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        number = float(value)
    except OverflowError:
        return math.nan
    return number if math.isfinite(number) else math.nan


def _read_numbers(values: Any, count: int) -> np.ndarray:
    """Return a list of `count` numbers, NaN where malformed. Shape (count,)."""
    if not isinstance(values, list) or len(values) != count:
        return np.full(count, np.nan)
    return np.array([_read_number(value) for value in values])


def _read_count(value: Any) -> int | None:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        return None
    return value


def write_welcome(role: str, robot: str, gestures: Mapping[str, str]) -> str:
    """Write the welcome message to a new client."""
    return json.dumps(
        {
            "type": "welcome",
            "role": role,
            "robot": robot,
            "gestures": dict(gestures),
            "version": VERSION,
        }
    )


def write_ping(number: int, time: float) -> str:
    """Write a ping sent at `time` [s] of the server's clock."""
    return json.dumps({"type": "ping", "id": number, "t": round(time * 1e3, 3)})


def write_refused(reason: str) -> str:
    """Write why the connection is closed."""
    return json.dumps({"type": "refused", "reason": reason})


def write_display(
    display: Display,
    warnings: Sequence[str],
    tracked: np.ndarray,
    rate: float,
    delay: float | None,
) -> str:
    """Write the content of the display.

    Args:
        display: Display of the teleoperation.
        warnings: All warnings, including the display's.
        tracked: Whether head, left and right wrist are tracked. Shape (3,), bool.
        rate: Frames in the last second [Hz].
        delay: Delay of the frames [s], None if unknown.
    """
    progress = display.progress
    return json.dumps(
        {
            "type": "display",
            "time": round(display.time, 3),
            "engaged": display.engaged,
            "mode": display.mode.name.lower(),
            "clutch": round(display.clutch, 3),
            "holding": display.holding,
            "notices": [
                {"number": notice.number, "cue": notice.cue.value, "text": notice.text}
                for notice in display.notices
            ],
            "warnings": list(warnings),
            "fallen": display.fallen,
            "progress": None if progress is None else dataclasses.asdict(progress),
            "delay_ms": None if delay is None else round(delay * 1e3, 1),
            "tracked": [bool(seen) for seen in tracked],
            "rate": round(rate, 1),
        }
    )


def write_pose(frame: OperatorFrame) -> str:
    """Write head and wrists for monitors: x y z qw qx qy qz, null if not tracked."""
    names = ("head", "left_wrist", "right_wrist")
    poses = [
        [round(float(x), 4) for x in frame.pose(name)] if seen else None
        for name, seen in zip(names, frame.tracked, strict=True)
    ]
    return json.dumps({"type": "pose", "head": poses[0], "left": poses[1], "right": poses[2]})
