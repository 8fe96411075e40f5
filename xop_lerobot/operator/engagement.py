"""Who drives: engagements begin and end as the device, or the person in the headset, asks."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

import numpy as np

from xop_lerobot.core.state import RobotState
from xop_lerobot.operator.alignment import Alignment, EngageRefused, is_lost
from xop_lerobot.operator.clutch import Clutch, Wish
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.display import Cue, NoticeBoard
from xop_lerobot.operator.frame import OperatorFrame

logger = logging.getLogger(__name__)

UNSEEN = "the headset no longer sees where the head is, or is silent"
"""Why the operator has let go, where the device knows no better."""


class Engagement:
    """Engages the operator, and lets go of the robot again.

    A device that engages by itself does so as soon as the robot has settled. Who wears a headset
    engages, and lets go, by the gesture of the clutch. Loss of the head's tracking, a fall and
    whatever else the robot does that it was not told to end an engagement, the next one aligns
    anew, and nobody engages meanwhile.

    Args:
        device: Where the operator's motion comes from.
        alignment: Lays the operator on the robot.
        clutch: Reads the gesture; None for devices that engage by themselves.
        board: Where the operator is told what happens.
        robot_reach: Forward reach of the robot's arms [m], None where it does not matter.
        begin: Called with the state and the robot's frames when an engagement begins.
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
        """Start over: nobody is engaged, and nobody has been refused."""
        self.alignment.disengage()
        if self.clutch is not None:
            self.clutch.reset()
        self._refusal = ""
        self._started = self._was_refused = False

    @property
    def is_engaged(self) -> bool:
        """Whether the operator drives."""
        return self.alignment.is_engaged

    @property
    def progress(self) -> float:
        """How much of the clutch's hold has passed, from 0 to 1."""
        return 0.0 if self.clutch is None else self.clutch.progress

    def follow(
        self, state: RobotState, frame: OperatorFrame | None, poses: Mapping[str, np.ndarray]
    ) -> OperatorFrame | None:
        """Engage or disengage where it is time to.

        Args:
            state: The robot now.
            frame: The operator now, None before the first frame.
            poses: The robot's frames by name. Shapes (7,).

        Returns:
            The frame to use: another one where the device's clock starts with this tick.

        Raises:
            EngageRefused: If a device that engages by itself cannot, the first time.
        """
        if self.clutch is not None:
            self._follow_clutch(self.clutch, state, frame, poses)
            return frame
        is_over = state.fallen or bool(state.trouble) or self.device.is_paused(state.time)
        if self.is_engaged:
            if frame is None or is_lost(frame) or is_over:
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
        """Engage; a refusal is a fault of the set-up at first, and waited out later on."""
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
        """Engage and let go as the person in the headset asks."""
        wish = clutch.update(frame, self.is_engaged)
        if self.is_engaged:
            if state.fallen:
                self._let_go("the robot has fallen")
            elif state.trouble:
                self.disengage()  # what is wrong is told whether anybody drives or not
            elif wish is Wish.LET_GO and (frame is None or is_lost(frame)):
                self._let_go(self.device.trouble or UNSEEN)
            elif wish is Wish.LET_GO:
                self._let_go("you have let go")
            return
        if wish is not Wish.ENGAGE or frame is None:
            return
        if state.fallen:
            self._refuse("Not engaged: the robot has fallen. It engages when it stands.")
        elif state.trouble:
            self._refuse(f"Not engaged yet: {state.trouble}. Hold the gesture on.")
        elif not state.settled:
            self._refuse("Not engaged yet: the robot still moves. Hold the gesture on.")
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
        """Tell why nobody engages, once for each gesture that asks for it."""
        if refusal != self._refusal:
            self._board.tell(Cue.REFUSED, refusal)
        self._refusal = refusal

    def engage(
        self, state: RobotState, frame: OperatorFrame, poses: Mapping[str, np.ndarray]
    ) -> None:
        """Lay the operator on the robot and begin to drive it.

        Raises:
            EngageRefused: If the head is not tracked, or is too low to be over the floor.
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
        """The gesture has had its effect: what is held of it from now on does nothing."""
        if self.clutch is not None:
            self.clutch.progress = 0.0
