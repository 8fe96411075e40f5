"""Types of `xop-doctor`'s checks: setup and finding; and a child process for what may hang."""

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
    """Whether it exited with status 0."""
    text: str
    """Its output, or the last line of its error."""


def run_child(code: str, *arguments: str, timeout: float = 120.0) -> Answer:
    """Run `code` in a child process, with `arguments` in `sys.argv[1:]`.

    Args:
        code: Python program.
        arguments: Its arguments.
        timeout: Time after which it is killed [s].
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
        level: Severity of the finding.
        text: Result, in one sentence.
        advice: What to do about it; empty if nothing.
        figures: Measured values, as plain values for JSON.
    """

    level: Level
    text: str
    advice: str = ""
    figures: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class Setup:
    """Intended use of this machine.

    Attributes:
        device: Headset, `avp` or `webxr`; empty for none.
        host: `avp`: its address. `webxr`: address to listen at; empty for loopback.
        port: Port; 0 for the default.
        seconds: Duration of the stream measurement [s].
        wait: Time to wait for the stream [s].
        robot: Robot whose planner is timed.
        mode: Mode of the planner.
        root: Folder of datasets.
    """

    device: str = ""
    host: str = ""
    port: int = 0
    seconds: float = 3.0
    wait: float = 60.0
    robot: str = MORPHOLOGIES.built_in[0]
    mode: str = "stationary"
    root: Path = Path()
