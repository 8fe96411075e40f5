"""Feedback to the operator: notices, current gestures and warnings."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import RobotState
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices.live import HANDS, LiveDevice
from xop_lerobot.operator.display import Cue, Display, NoticeBoard, Progress
from xop_lerobot.operator.engagement import Engagement
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.raised_hands import HOLDING, RaisedHands

if TYPE_CHECKING:
    from xop_lerobot.retarget.changes import Change
    from xop_lerobot.retarget.online import AppliedChange

SLOW_HZ = 25.0
"""Stream rate below which gestures are missed [Hz]."""
LATE_S = 0.3
"""Plan age above which the robot lags noticeably [s]."""


class Feedback:
    """Notices to the operator, and the display of each tick.

    Attributes:
        board: Latest notices.
        shown: Display without notices and progress, None before the first tick.
    """

    def __init__(self) -> None:
        self.board = NoticeBoard()
        self.reset()

    def reset(self) -> None:
        """Start over; the notices remain."""
        self._trouble = ""
        self.shown: Display | None = None

    @property
    def notice(self) -> str:
        """Latest notice; empty if there was none."""
        notices = self.board.notices
        return notices[-1].text if notices else ""

    def tell_trouble(self, trouble: str, *, engaged: bool, retreats: bool) -> None:
        """Report a new trouble of the robot.

        Args:
            trouble: Description of the trouble; empty for none.
            engaged: Whether the operator was engaged until now.
            retreats: Whether the robot's arms return to rest because of it.
        """
        if trouble and trouble != self._trouble:
            text = trouble[:1].upper() + trouble[1:]
            ends = "Disengaged: it" if engaged else "It"
            does = "stands, its arms go back to rest" if retreats else "holds"
            self.board.tell(Cue.DISENGAGED, f"{text}. {ends} {does}.")
        self._trouble = trouble

    def note(
        self,
        state: RobotState,
        frame: OperatorFrame | None,
        engagement: Engagement,
        raised: RaisedHands,
        *,
        mode: Mode,
        plan_age: float | None,
        pictures: Mapping[str, np.ndarray],
    ) -> None:
        """Compose the display of a tick.

        Args:
            state: The robot now.
            frame: The operator's frame, None before the first.
            engagement: State of the engagement and its clutch.
            raised: Detector of raised hands.
            mode: Requested mode.
            plan_age: Age of the current plan [s], None without one.
            pictures: Camera images by name. Shapes (height, width, 3), uint8.
        """
        engaged, trouble = engagement.is_engaged, state.trouble
        holding, progress = describe_hold(raised, engagement.progress, engaged=engaged)
        self.shown = Display(
            time=state.time,
            engaged=engaged,
            mode=mode,
            clutch=progress,
            holding=holding,
            warnings=list_warnings(
                engagement.device, frame, engaged=engaged, plan_age=plan_age, trouble=trouble
            ),
            fallen=state.fallen,
            pictures=pictures,
        )

    def show(self, device: Device, progress: Progress | None) -> None:
        """Show the tick on `device`, with the progress of a recording (None without one)."""
        if self.shown is not None:
            notices = self.board.notices
            device.show(dataclasses.replace(self.shown, notices=notices, progress=progress))


def tell_changes(board: NoticeBoard, changes: Iterable[AppliedChange]) -> None:
    """Post notices of the changes in a tick: one for the mode, one for the rest."""
    changed = [each.change for each in changes]
    modes = [change.mode for change in changed if change.mode is not None]
    if modes:
        board.tell(Cue.MODE, f"Mode: {modes[-1].name.lower()}.")
    settings = [text for change in changed if (text := describe_settings(change))]
    if settings:
        board.tell(Cue.SETTING, f"{'. '.join(settings)}.")


def describe_settings(change: Change) -> str:
    """Describe `change` without the mode; empty if nothing else changes."""
    parts = [
        f"constraint {name} {'on' if on else 'off'}" for name, on in change.constraints.items()
    ]
    if change.preset is not None:
        parts.append(f"preset {change.preset}")
    if change.variant is not None:
        parts.append(f"variant {change.variant}")
    parts += [f"weight {name} {value:g}" for name, value in change.weights.items()]
    if change.targets is not None:
        parts.append(f"targets {', '.join(change.targets)}")
    if change.body is not None:
        parts.append(f"body {', '.join(change.body) or 'whole'}")
    text = "; ".join(parts)
    return text[:1].upper() + text[1:]


def describe_hold(raised: RaisedHands, clutch: float, *, engaged: bool) -> tuple[str, float]:
    """Describe the current gesture.

    Args:
        raised: Detector of raised hands, which take precedence over the clutch.
        clutch: Elapsed share of the clutch's hold, from 0 to 1.
        engaged: Whether the operator is engaged.

    Returns:
        Its effect, and the elapsed share of its hold; empty and 0 without one.
    """
    if raised.request is not None:
        return HOLDING[raised.request], raised.progress
    if clutch <= 0:
        return "", 0.0
    return f"Keep holding to {'disengage' if engaged else 'engage'}", clutch


def list_warnings(
    device: Device,
    frame: OperatorFrame | None,
    *,
    engaged: bool,
    plan_age: float | None,
    trouble: str = "",
) -> tuple[str, ...]:
    """List the present warnings, most severe first.

    Args:
        device: Source of the operator's motion.
        frame: The operator's frame, None before the first.
        engaged: Whether the operator is engaged.
        plan_age: Age of the current plan [s], None without one.
        trouble: Trouble of the robot; empty for none.
    """
    warnings = [f"{trouble[:1].upper()}{trouble[1:]}."] if trouble else []
    if device.trouble:
        warnings.append(device.trouble)
    status = device.status if isinstance(device, LiveDevice) else None
    if frame is not None and not frame.tracked[0]:
        if not device.trouble:
            warnings.append("The headset has lost its position, or sends nothing.")
    elif frame is not None:
        slow = () if status is None else status.slow_hands  # reported by the device
        tracked = zip(HANDS, frame.tracked[1:], strict=True)
        lost = [side for side, seen in tracked if not seen and side not in slow]
        if lost:
            hands = f"{lost[0]} hand is" if len(lost) == 1 else "hands are"
            stands = f": {'its arm stands' if len(lost) == 1 else 'the arms stand'} still"
            warnings.append(f"Your {hands} not seen{stands if engaged else ''}.")
        rate = math.inf if status is None else status.rate
        if rate < SLOW_HZ:
            warnings.append(
                f"Only {rate:.0f} poses per second arrive: gestures need {SLOW_HZ:.0f}."
            )
    if plan_age is not None and plan_age > LATE_S:
        warnings.append(
            f"The plan is {plan_age:.1f} s old: this computer is too slow for the planner."
        )
    return tuple(warnings)
