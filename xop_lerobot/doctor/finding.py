"""What a check finds, and what it is told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import Any


class Level(Enum):
    """How well it is."""

    OK = "ok"
    WARN = "warn"
    """It works, with a drawback."""
    FAIL = "fail"
    """It does not work."""
    SKIP = "skip"
    """It was not asked for, or cannot be known."""


@dataclass(frozen=True)
class Finding:
    """What a check has found.

    Attributes:
        level: How well it is.
        text: What was found, in a sentence.
        advice: What to do about it; empty where there is nothing to do.
        figures: The same in numbers, fit for JSON.
    """

    level: Level
    text: str
    advice: str = ""
    figures: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class Setup:
    """What somebody wants to do with this machine.

    Attributes:
        device: The headset, `avp` or `webxr`; empty for none.
        host: `avp`: its address. `webxr`: address to listen at; empty is loopback.
        port: Its port, 0 for the usual one.
        seconds: How long its stream is measured [s].
        wait: How long it is waited for [s].
        robot: Robot whose planner is timed.
        mode: In which mode.
        root: Where datasets are written.
    """

    device: str = ""
    host: str = ""
    port: int = 0
    seconds: float = 3.0
    wait: float = 60.0
    robot: str = "g1"
    mode: str = "stationary"
    root: Path = Path()
