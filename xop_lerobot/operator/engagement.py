"""Engagement: begins and ends on request of the device or of the person in the headset."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.state import RobotState
from xop_lerobot.core.transforms import quat_rotate
from xop_lerobot.core.yaml_words import fill_nulls
from xop_lerobot.operator.alignment import Alignment, EngageRefused, is_lost
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.display import Cue, NoticeBoard
from xop_lerobot.operator.frame import OperatorFrame

GESTURES = ("palms_up", "both_pinch")
"""`palms_up`: both hands pinch with palms up. `both_pinch`: both pinch in any orientation."""
WRISTS = ("left_wrist", "right_wrist")
PALM_UP = -0.5
"""Largest vertical component of the back-of-hand axis of a palm-up hand: 30° below the horizon."""


@dataclass
class ClutchConfig:
    """Settings of the gesture that engages and disengages.

    Attributes:
        gesture: The gesture, one of `GESTURES`. Pinches also close grippers, so with
            ``"both_pinch"`` carrying something with both hands disengages the robot.
        hold: Time it is held [s].
        on: Distance of thumb and index tip at which a hand closes [m].
        off: Distance at which it opens again [m].
        max_speed: Hand speed above which the hold is interrupted [m/s].
        max_gap: Longest time between two frames that continues the gesture [s].
    """

    gesture: str = "palms_up"
    hold: float = 1.0
    on: float = 0.018
    off: float = 0.035
    max_speed: float = 0.25
    max_gap: float = 0.2

    def __post_init__(self) -> None:
        """Validate all values.

        Raises:
            UnknownName: If there is no such gesture, listing the known ones.
            BadValue: If a number is not above 0, or `on` is not below `off`.
        """
        fill_nulls(self)
        if self.gesture not in GESTURES:
            raise UnknownName("clutch.gesture", self.gesture, GESTURES)
        for name in ("hold", "on", "off", "max_speed", "max_gap"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise BadValue(f"clutch.{name} must be finite and above 0, got {value}")
        if self.on >= self.off:
            raise BadValue(f"clutch.on must be below off, got {self.on} and {self.off}")


class ClutchRequest(Enum):
    """Request of the clutch."""

    NOTHING = "nothing"
    ENGAGE = "engage"
    LET_GO = "let go"


class Clutch:
    """Detects the gesture that engages and disengages.

    The gesture counts after `hold` seconds with both hands tracked and still. The request then
    persists until it is granted, which `engaged` reports, and is not repeated until the hands have
    opened: one long hold has one effect. A lost head, or a stream that stalls, disengages at once.
    Only stamps count, so a recorded stream replays with the same engagements.

    Args:
        config: Gesture and durations.
    """

    def __init__(self, config: ClutchConfig | None = None) -> None:
        self.config = config or ClutchConfig()
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._time: float | None = None
        self._wrists: np.ndarray | None = None
        self._since: float | None = None
        self._spent = True  # hands that start closed must open first
        self._engaged: bool | None = None
        self.progress = 0.0
        """Elapsed share of `hold`, from 0 to 1."""

    def update(self, frame: OperatorFrame | None, engaged: bool) -> ClutchRequest:
        """Process one sample.

        Frames with the previous stamp change nothing; an earlier stamp resets the detector.

        Args:
            frame: The operator's frame, None before the first.
            engaged: Whether the operator is engaged.
        """
        if engaged is not self._engaged:
            self._spent, self._engaged = True, engaged
        if frame is None or not frame.tracked[0]:
            self._stop()
            return ClutchRequest.LET_GO if engaged else ClutchRequest.NOTHING
        if self._time is not None and frame.time < self._time:
            self.reset()
            self._engaged = engaged
        if frame.time != self._time:
            self._follow(frame)
        if self._spent or self.progress < 1:
            return ClutchRequest.NOTHING
        return ClutchRequest.LET_GO if engaged else ClutchRequest.ENGAGE

    def _stop(self) -> None:
        self._time = self._wrists = self._since = None
        self._spent, self.progress = True, 0.0

    def _follow(self, frame: OperatorFrame) -> None:
        wrists = np.stack([frame.pose(name)[:3] for name in WRISTS])
        still = self._is_still(frame.time, wrists)
        self._time, self._wrists = frame.time, wrists
        if not self._is_shown(frame) or not still:
            self._since, self.progress = None, 0.0
            # Only tracked hands can be seen to open.
            self._spent &= not (
                frame.tracked.all() and bool((frame.pinch >= self.config.off).any())
            )
            return
        if self._since is None:
            self._since = frame.time
        self.progress = 0.0 if self._spent else self._compute_progress(frame.time - self._since)

    def _compute_progress(self, held: float) -> float:
        # Sums of stamps round; a microsecond of tolerance saves waiting for another sample.
        return min((held + 1e-6) / self.config.hold, 1.0)

    def _is_still(self, time: float, wrists: np.ndarray) -> bool:
        if self._time is None or self._wrists is None:
            return False
        dt = time - self._time
        speed = np.linalg.norm(wrists - self._wrists, axis=1).max() / dt
        return dt <= self.config.max_gap and bool(speed <= self.config.max_speed)

    def _is_shown(self, frame: OperatorFrame) -> bool:
        """Whether both hands make the gesture; once started, until they open."""
        near = self.config.on if self._since is None else self.config.off
        if not frame.tracked.all() or not bool((frame.pinch < near).all()):
            return False
        if self.config.gesture == "both_pinch":
            return True
        up = np.array([0.0, 0, 1])
        return all(quat_rotate(frame.pose(name)[3:], up)[2] <= PALM_UP for name in WRISTS)


logger = logging.getLogger(__name__)

UNSEEN = "the headset has lost its position, or sends nothing"
"""Fallback reason for a disengagement if the device reports none."""


class Engagement:
    """Engages and disengages the operator.

    A self-engaging device engages as soon as the robot has settled. A person in a headset engages
    and disengages by the clutch gesture. Loss of head tracking, a fall, and any other trouble of
    the robot end an engagement; the next one aligns again, and none starts while the trouble lasts.

    Args:
        device: Source of the operator's motion.
        alignment: Mapping from the operator to the robot.
        clutch: Detects the gesture; None for self-engaging devices.
        board: Notices to the operator.
        robot_reach: Forward reach of the robot's arms [m], None if not needed.
        begin: Called with the state and the robot's frames when an engagement starts.
        end: Called when one ends.
    """

    def __init__(
        self,
        device: Device,
        alignment: Alignment,
        clutch: Clutch | None,
        board: NoticeBoard,
        *,
        robot_reach: float | None = None,
        begin: Callable[[RobotState, Mapping[str, np.ndarray]], None],
        end: Callable[[], None],
    ) -> None:
        self.alignment, self.clutch = alignment, clutch
        self.device, self._board = device, board
        self._robot_reach = robot_reach
        self._begin, self._end = begin, end
        self._was_engaged = False
        self.reset()

    def reset(self) -> None:
        """Reset: not engaged, no refusal pending."""
        self.alignment.disengage()
        if self.clutch is not None:
            self.clutch.reset()
        self._refusal = ""
        self._started = self._was_refused = False

    @property
    def is_engaged(self) -> bool:
        """Whether the operator is engaged."""
        return self.alignment.is_engaged

    @property
    def progress(self) -> float:
        """Progress of the clutch's hold, 0 to 1."""
        return 0.0 if self.clutch is None else self.clutch.progress

    def follow(
        self, state: RobotState, frame: OperatorFrame | None, poses: Mapping[str, np.ndarray]
    ) -> OperatorFrame | None:
        """Engage or disengage if requested.

        Args:
            state: The robot now.
            frame: The operator's frame, None before the first.
            poses: The robot's frames by name. Shapes (7,).

        Returns:
            The frame to use, which is a new one if the device's clock starts with this tick.

        Raises:
            EngageRefused: If a self-engaging device cannot engage the first time.
        """
        if self.clutch is not None:
            self._follow_clutch(self.clutch, state, frame, poses)
            return frame
        is_over = state.fallen or bool(state.trouble) or self.device.is_paused(state.time)
        if self.is_engaged:
            if frame is None or is_lost(frame):
                self.disengage()
                reason = self.device.trouble or UNSEEN
                self._board.tell(
                    Cue.DISENGAGED, f"Disengaged: {reason}. The robot holds until tracking returns."
                )
            elif is_over:
                self.disengage()
            return frame
        if not state.settled or is_over:
            return frame
        if not self._started:
            self.device.start(state.time)
            self._started = True
            frame = self.device.read(state.time)
        if frame is not None and not is_lost(frame):
            self._engage_itself(state, frame, poses)
        return frame

    def _engage_itself(
        self, state: RobotState, frame: OperatorFrame, poses: Mapping[str, np.ndarray]
    ) -> None:
        """Engage; a refusal is an error the first time, and retried later."""
        try:
            self.engage(state, frame, poses)
        except EngageRefused as refusal:
            if not self._was_engaged:
                raise
            if not self._was_refused:
                logger.warning("%s The robot holds.", refusal)
            self._was_refused = True

    def _follow_clutch(
        self,
        clutch: Clutch,
        state: RobotState,
        frame: OperatorFrame | None,
        poses: Mapping[str, np.ndarray],
    ) -> None:
        """Engage and disengage on the gesture of the person in the headset."""
        request = clutch.update(frame, self.is_engaged)
        if self.is_engaged:
            if state.fallen:
                self._let_go("the robot has fallen")
            elif state.trouble:
                self.disengage()  # the trouble itself is reported elsewhere, engaged or not
            elif request is ClutchRequest.LET_GO and (frame is None or is_lost(frame)):
                self._let_go(self.device.trouble or UNSEEN)
            elif request is ClutchRequest.LET_GO:
                self._let_go("you have let go")
            return
        if request is not ClutchRequest.ENGAGE or frame is None:
            return
        if state.fallen:
            self._refuse("Not engaged: the robot has fallen. It engages when it stands.")
        elif state.trouble:
            self._refuse(f"Not engaged yet: {state.trouble}. Keep holding the gesture.")
        elif not state.settled:
            self._refuse("Not engaged yet: the robot still moves. Keep holding the gesture.")
        else:
            try:
                self.engage(state, frame, poses)
            except EngageRefused as refusal:
                self._refuse(f"Not engaged: {refusal}")
            else:
                self._refusal = ""
                self._board.tell(Cue.ENGAGED, "Engaged: the robot follows you.")

    def _let_go(self, reason: str) -> None:
        self.disengage()
        self._board.tell(
            Cue.DISENGAGED,
            f"Disengaged: {reason}. The robot holds; engage again by the gesture.",
        )

    def _refuse(self, refusal: str) -> None:
        """Report why engaging is refused, once per gesture."""
        if refusal != self._refusal:
            self._board.tell(Cue.REFUSED, refusal)
        self._refusal = refusal

    def engage(
        self, state: RobotState, frame: OperatorFrame, poses: Mapping[str, np.ndarray]
    ) -> None:
        """Align the operator with the robot and start driving it.

        Raises:
            EngageRefused: If the head is not tracked, or is too close to the floor.
        """
        self.alignment.engage(frame, poses, float(poses["head"][2]), self._robot_reach)
        self._was_engaged, self._was_refused = True, False
        self._spend()
        self._begin(state, poses)

    def disengage(self) -> None:
        """Stop driving; the robot holds."""
        self.alignment.disengage()
        self._spend()
        self._end()

    def _spend(self) -> None:
        """Mark the gesture as used; holding it longer has no effect."""
        if self.clutch is not None:
            self.clutch.progress = 0.0
