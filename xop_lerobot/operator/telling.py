"""What the operator is told in words: what has changed, and what is wrong now."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from xop_lerobot.operator.display import Cue, NoticeBoard

if TYPE_CHECKING:
    from xop_lerobot.retarget.changes import Change
    from xop_lerobot.retarget.online import AppliedChange


def tell_changes(board: NoticeBoard, changes: Iterable[AppliedChange]) -> None:
    """Tell what has come into force: the mode with its own cue, and the rest."""
    for each in changes:
        if each.change.mode is not None:
            board.tell(Cue.MODE, f"Mode: {each.change.mode.name.lower()}.")
        settings = describe_settings(each.change)
        if settings:
            board.tell(Cue.SETTING, f"{settings}.")


def describe_settings(change: Change) -> str:
    """Describe what `change` does but for the mode; empty if it does nothing else."""
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
