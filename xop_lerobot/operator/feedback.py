"""Feedback to the operator in words: changes and warnings."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices.live import HANDS, LiveDevice
from xop_lerobot.operator.display import Cue, NoticeBoard
from xop_lerobot.operator.frame import OperatorFrame

if TYPE_CHECKING:
    from xop_lerobot.retarget.changes import Change
    from xop_lerobot.retarget.online import AppliedChange

SLOW_HZ = 25.0
"""Rate of a stream under which gestures are missed [Hz]."""
LATE_S = 0.3
"""Age of a plan from which the robot lags behind what is asked of it [s]."""


def tell_changes(board: NoticeBoard, changes: Iterable[AppliedChange]) -> None:
    """Notify of changes in a tick: the mode with its own notice, the rest in one."""
    changed = [each.change for each in changes]
    modes = [change.mode for change in changed if change.mode is not None]
    if modes:
        board.tell(Cue.MODE, f"Mode: {modes[-1].name.lower()}.")
    settings = [text for change in changed if (text := describe_settings(change))]
    if settings:
        board.tell(Cue.SETTING, f"{'. '.join(settings)}.")


def describe_settings(change: Change) -> str:
    """Describe `change` except for the mode; empty if there is nothing else."""
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


def list_warnings(
    device: Device,
    frame: OperatorFrame | None,
    *,
    engaged: bool,
    plan_age: float | None,
    trouble: str = "",
) -> tuple[str, ...]:
    """List the present warnings, the worst first.

    Args:
        device: Where the operator's motion comes from.
        frame: The operator now, None before the first frame.
        engaged: Whether the operator drives.
        plan_age: Age of the plan that is followed [s], None where there is none.
        trouble: What the robot does that it was not told to; empty if nothing.
    """
    warnings = [f"{trouble[:1].upper()}{trouble[1:]}."] if trouble else []
    if device.trouble:
        warnings.append(device.trouble)
    status = device.status if isinstance(device, LiveDevice) else None
    if frame is not None and not frame.tracked[0]:
        if not device.trouble:
            warnings.append("The headset has lost its position, or sends nothing.")
    elif frame is not None:
        slow = () if status is None else status.slow_hands  # the device tells of these
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
