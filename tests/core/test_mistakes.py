"""LeRobot's commands end in one line on this project's errors, and as ever on all others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from xop_lerobot.core.command_line import TRACEBACK_VARIABLE, find_mistake, report_mistakes
from xop_lerobot.core.errors import BadValue

ROOT = Path(__file__).parents[2]


def wrap(error: Exception) -> Exception:
    """Raise `error` as LeRobot's factories do."""
    try:
        try:
            raise error
        except Exception as cause:
            raise ValueError(f"Error creating robot with config (long): {cause}") from cause
    except ValueError as wrapped:
        return wrapped


@pytest.fixture
def stock(monkeypatch: pytest.MonkeyPatch) -> list[BaseException]:
    """What reaches the hook that was there before."""
    seen: list[BaseException] = []
    monkeypatch.setattr(sys, "excepthook", lambda kind, error, trace: seen.append(error))
    monkeypatch.setattr(sys, "argv", ["/usr/bin/lerobot-record"])
    monkeypatch.delenv(TRACEBACK_VARIABLE, raising=False)
    return seen


def fail(error: Exception) -> None:
    sys.excepthook(type(error), error, error.__traceback__)


def test_a_mistake_is_one_line(stock, capsys):
    report_mistakes()
    report_mistakes()
    fail(wrap(BadValue("the leg is too long")))
    assert capsys.readouterr().err == "error: the leg is too long\n"
    assert stock == []


def test_other_errors_stay_as_they_are(stock, capsys):
    report_mistakes()
    error = wrap(RuntimeError("a fault of the code"))
    fail(error)
    assert stock == [error]
    assert capsys.readouterr().err == ""


def test_the_traceback_can_be_had(stock, monkeypatch):
    report_mistakes()
    monkeypatch.setenv(TRACEBACK_VARIABLE, "1")
    error = wrap(BadValue("the leg is too long"))
    fail(error)
    assert stock == [error]


def test_programs_of_others_are_left_alone(stock, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["my_robot.py"])
    before = sys.excepthook
    report_mistakes()
    assert sys.excepthook is before


def test_the_outermost_error_is_told():
    inner, outer = BadValue("inner"), BadValue("outer")
    outer.__cause__ = inner
    assert find_mistake(outer) is outer
    assert find_mistake(KeyError("leg")) is None
    assert find_mistake(None) is None


@pytest.mark.slow
def test_a_robot_in_a_command_reports(tmp_path):
    program = tmp_path / "lerobot-try"
    program.write_text(
        "from lerobot.robots.utils import make_robot_from_config\n"
        "from lerobot_robot_xop import XopG1Config\n"
        "make_robot_from_config(XopG1Config(cameras=['knee']))\n"
    )
    paths = (ROOT, ROOT / "robots", ROOT / "teleoperators")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run(
        [sys.executable, program], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "error: unknown camera of g1 'knee'. Known: head, left_wrist, right_wrist, scene"
    )
    assert "Traceback" not in done.stderr
