"""What a check of `xop-doctor` is given and returns, and a Python of its own for what may hang."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from xop_lerobot.morphology.morphology import MORPHOLOGIES


class Answer(NamedTuple):
    """Result of a child process."""

    ok: bool
    """Whether it has ended well."""
    text: str
    """What it has printed, or the last line of why not."""


def run_child(code: str, *arguments: str, timeout: float = 120.0) -> Answer:
    """Run `code` with `arguments` in `sys.argv[1:]`.

    Args:
        code: The program.
        arguments: What it is given.
        timeout: It is ended after so long [s].
    """
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Answer(False, f"no answer within {timeout:g} s")
    if done.returncode == 0:
        return Answer(True, done.stdout.strip())
    lines = done.stderr.strip().splitlines()
    return Answer(False, lines[-1] if lines else f"it ended with status {done.returncode}")


class Level(Enum):
    """Severity of a finding."""

    OK = "ok"
    WARN = "warn"
    """It works, with a warning."""
    FAIL = "fail"
    """It does not work."""
    SKIP = "skip"
    """Not requested, or not decidable."""


@dataclass(frozen=True)
class Finding:
    """Result of a check.

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
    """Intended use of this machine.

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
    robot: str = MORPHOLOGIES.built_in[0]
    mode: str = "stationary"
    root: Path = Path()
