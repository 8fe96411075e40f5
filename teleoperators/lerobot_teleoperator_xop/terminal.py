"""Terminal keys that change settings, shared with LeRobot's own keys where necessary."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from typing import Any

from lerobot.utils.keyboard_input import (
    TerminalKeyListener,
    apply_recording_control,
    create_key_listener,
    pynput_can_capture,
)

from xop_lerobot.control.client import HELP, Target, press
from xop_lerobot.recording.lerobot_patches import CONTEXT_MODULE, RECORD_MODULE, runs

logger = logging.getLogger(__name__)

_RECORDING_KEYS = {
    "right": "right", "n": "right", "left": "left", "r": "left", "esc": "esc", "q": "esc",
}  # fmt: skip


def listen_to_terminal(target: Target) -> TerminalKeyListener | None:
    """Change `target` by keys of this terminal; None if they cannot be read.

    Without a display LeRobot's record and rollout commands read the terminal themselves, and two
    readers would take each other's keys. `xop-record` shares its reader instead.
    """
    taken = not pynput_can_capture() and (runs(RECORD_MODULE) or runs(CONTEXT_MODULE))
    if taken or not sys.stdin.isatty():
        reason = "LeRobot reads this terminal" if taken else "this is no terminal"
        logger.warning("--teleop.keys: %s; use xop-record, or --teleop.control.", reason)
        return None

    def on_key(key: str) -> None:
        press(key, target)

    listener = TerminalKeyListener(on_key)
    listener.start()
    logger.info("Keys: %s.", HELP)
    return listener


def listen_while_recording(target: Target) -> tuple[Any, dict[str, bool]]:
    """Read LeRobot's recording keys and the settings keys with one listener.

    Returns:
        The listener with a method `stop()`, or None; and the events that its keys set.
    """
    events = {"exit_early": False, "rerecord_episode": False, "stop_recording": False}
    help_text = f"Right/Left/Esc, or n=next, r=re-record, q=quit; {HELP}"
    return create_key_listener(make_dispatch(target, events), controls_help=help_text), events


def make_dispatch(target: Target, events: dict[str, bool]) -> Callable[[str], None]:
    """Make the callback for key names."""

    def dispatch(key: str) -> None:
        if key.lower() in _RECORDING_KEYS:
            apply_recording_control(_RECORDING_KEYS[key.lower()], events)
        else:
            press(key, target)

    return dispatch
