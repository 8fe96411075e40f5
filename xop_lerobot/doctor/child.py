"""Runs a few lines in a Python of their own, which may crash or hang without harm."""

from __future__ import annotations

import subprocess
import sys
from typing import NamedTuple


class Answer(NamedTuple):
    """What became of it."""

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
