"""The demo script: its command line, its environment, and how it fails."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def demo() -> ModuleType:
    spec = importlib.util.spec_from_file_location("xop_demo", ROOT / "scripts" / "demo.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["xop_demo"] = module  # dataclasses look their module up by name
    spec.loader.exec_module(module)
    return module


def test_each_demo_is_a_stock_recording(demo: ModuleType, tmp_path: Path) -> None:
    for name, robot in (("g1", "xop_g1"), ("rby1", "xop_rby1")):
        command = demo.build_command(demo.DEMOS[name], tmp_path / name)
        assert command[0] == "lerobot-record"
        assert f"--robot.type={robot}" in command
        assert f"--dataset.root={tmp_path / name}" in command
        assert "--dataset.push_to_hub=false" in command
        assert 50 % demo.FPS == 0


def test_the_scripts_fit_in_their_episodes(demo: ModuleType) -> None:
    import yaml

    folder = ROOT / "xop_lerobot" / "operator" / "scripts"
    for show in demo.DEMOS.values():
        script = yaml.safe_load((folder / f"{show.script}.yaml").read_text())
        assert script["duration"] + 2.0 <= show.episode_s


def test_what_the_user_sets_wins(demo: ModuleType, tmp_path: Path) -> None:
    environment = demo.build_environment(tmp_path, {"MUJOCO_GL": "glfw", "HOME": "/h"})
    assert environment["MUJOCO_GL"] == "glfw"
    assert environment["HF_LEROBOT_HOME"] == str(tmp_path / ".lerobot")
    assert environment["HF_HUB_OFFLINE"] == "1"


def test_an_older_recording_is_kept(demo: ModuleType, tmp_path: Path) -> None:
    assert demo.move_aside(tmp_path / "g1") is None
    for text in ("first", "second"):
        (tmp_path / "g1").mkdir()
        (tmp_path / "g1" / "data").write_text(text)
        demo.move_aside(tmp_path / "g1")
    assert not (tmp_path / "g1").exists()
    assert (tmp_path / "g1.1" / "data").read_text() == "first"
    assert (tmp_path / "g1.2" / "data").read_text() == "second"


def test_an_unknown_robot_is_named(
    demo: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert demo.main(["--robots", "g2", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == "demo failed: unknown robot 'g2'. Known: g1, rby1\n"


def test_a_failing_recording_shows_its_end(
    demo: ModuleType,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    program = tmp_path / "bin" / "lerobot-record"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\necho the robot is away\nexit 7\n")
    program.chmod(0o755)
    monkeypatch.setattr(demo.sys, "executable", str(program.with_name("python")))
    assert demo.main(["--robots", "g1", "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert "lerobot-record for 'g1' ended with status 7:\nthe robot is away\n" in told
    assert (tmp_path / "out" / "g1.log").read_text() == "the robot is away\n"


@pytest.mark.slow
def test_a_shorter_demo_is_recorded_and_shown(
    demo: ModuleType,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in demo.build_environment(tmp_path, {}):  # what it sets goes with the test
        monkeypatch.setenv(name, demo.build_environment(tmp_path, dict(os.environ))[name])
    short = dataclasses.replace(demo.DEMOS["rby1"], episode_s=3.0)
    monkeypatch.setitem(demo.DEMOS, "rby1", short)
    assert demo.main(["--robots", "rby1", "--out", str(tmp_path)]) == 0, capsys.readouterr().err
    assert (tmp_path / "rby1" / "meta" / "info.json").exists()
    for suffix in ("png", "mp4", "gif"):
        assert (tmp_path / f"rby1.{suffix}").stat().st_size > 1000
    table = capsys.readouterr().out.split("rby1.png, .gif and .mp4")[1]
    assert "rby1" in table and " 75 " in table
