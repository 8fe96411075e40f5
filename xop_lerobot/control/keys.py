"""Keys that change settings while a session runs in a terminal."""

from __future__ import annotations

import logging
from typing import Any, Protocol

from xop_lerobot.core.errors import XopError
from xop_lerobot.core.paced_log import PacedLog

_log = PacedLog(logging.getLogger(__name__))  # a key that is held down repeats

PRESET_KEYS = {"d": "default", "c": "conservative", "a": "aggressive", "t": "table1"}
TOGGLE_KEYS = {"m": "mode", "u": "upright"}
HELP = "d/c/a/t: preset default, conservative, aggressive, table1; u: upright; m: mode"
"""What the keys do. LeRobot's own are n, r, q, the arrows and Esc."""


class Target(Protocol):
    """What the keys change: a `Teleoperation`."""

    def change(self, change: dict[str, Any], source: str = "call") -> dict[str, Any]:
        """Ask for other settings."""
        ...

    def toggle(self, name: str, source: str = "call") -> dict[str, Any]:
        """Toggle one."""
        ...


def press(key: str, target: Target) -> bool:
    """Do what `key` stands for; return whether it stands for anything. Refusals are logged."""
    key = key.lower()
    try:
        if key in PRESET_KEYS:
            settings = target.change({"preset": PRESET_KEYS[key]}, "key")
        elif key in TOGGLE_KEYS:
            settings = target.toggle(TOGGLE_KEYS[key], "key")
        else:
            return False
    except XopError as refusal:
        _log.warning("Key %r changes nothing: %s", key, refusal)
        return True
    constraints = ", ".join(settings["constraints"]) or "none"
    _log.info("Key %r: preset %s, constraints %s.", key, settings["preset"], constraints)
    return True
