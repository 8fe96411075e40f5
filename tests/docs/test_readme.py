"""README and docs: their commands parse, their examples are Python, their links lead somewhere."""

from __future__ import annotations

import ast
import dataclasses
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pytest

import lerobot_teleoperator_xop  # noqa: F401  registers robots and teleoperator
from xop_lerobot.doctor.cli import parse_arguments as parse_doctor
from xop_lerobot.evaluation.bench import parse_arguments as parse_bench
from xop_lerobot.operator.recording import load_recording

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
COMMANDS = re.compile(r"(lerobot-[a-z-]+|xop-[a-z]+|make [a-z]+)\b")


def read_blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.S | re.M)


def read_commands(page: Path) -> Iterator[list[str]]:
    """The lines of `page`'s shell blocks, comments left out and continued lines joined."""
    for block in read_blocks(page, "(?:bash|sh)"):
        for line in block.replace("\\\n", " ").splitlines():
            if COMMANDS.match(line.strip()):
                yield shlex.split(line, comments=True)


ALL_COMMANDS = [
    pytest.param(page, command, id=f"{page.name}: {' '.join(command)[:60]}")
    for page in PAGES
    for command in read_commands(page)
]


def find_config_class(name: str) -> type:
    """The class that the command `name` parses its flags into."""
    if name == "lerobot-record":
        from lerobot.scripts.lerobot_record import RecordConfig as Config
    elif name == "xop-record":
        from xop_lerobot.recording.record import XopRecordConfig as Config
    elif name == "lerobot-teleoperate":
        from lerobot.scripts.lerobot_teleoperate import TeleoperateConfig as Config
    elif name == "lerobot-replay":
        from lerobot.scripts.lerobot_replay import ReplayConfig as Config
    elif name == "lerobot-train":
        import lerobot.policies  # noqa: F401  registers the types of policies
        from lerobot.configs.train import TrainPipelineConfig as Config
    elif name == "lerobot-calibrate":
        from lerobot.scripts.lerobot_calibrate import CalibrateConfig as Config
    elif name == "lerobot-rollout":
        from lerobot.rollout import RolloutConfig as Config
    else:
        raise AssertionError(f"README tells of a command {name!r} that this test does not know")
    return Config


def parse(command: list[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """Parse the flags as the command would; a policy that was never trained is any ACT."""
    name, *flags = command
    paths = [flag.split("=")[1] for flag in flags if flag.startswith("--config_path=")]
    flags = [
        "--policy.type=act" if flag.startswith("--policy.path=") else flag
        for flag in flags
        if not flag.startswith("--config_path=")
    ]
    monkeypatch.setattr(sys, "argv", [name, *flags])
    monkeypatch.chdir(ROOT)
    return draccus.parse(find_config_class(name), config_path=next(iter(paths), None), args=flags)


def check_control(flags: list[str]) -> None:
    """Check that the flags of `xop-control` make a change that RB-Y1 takes."""
    from xop_lerobot.control.client import build_request, make_parser
    from xop_lerobot.morphology.morphology import make_morphology
    from xop_lerobot.retarget.changes import apply_change, make_settings, parse_change
    from xop_lerobot.retarget.config import RetargeterConfig

    request = build_request(make_parser().parse_args(flags))
    if not {"toggle", "get"} & set(request):
        robot = make_morphology("rby1")
        apply_change(robot, make_settings(robot, RetargeterConfig()), parse_change(request))


def check_curate(words: list[str]) -> None:
    """Check that a verb takes the flags, and that expressions are ones."""
    from xop_lerobot.curate.cli import load_verb, make_verb_parser
    from xop_lerobot.curate.expression import Expression
    from xop_lerobot.curate.measures import KINDS

    parsed = make_verb_parser(words[0], load_verb(words[0])).parse(words[1:])
    if hasattr(parsed, "where"):
        Expression(parsed.where, KINDS)


@pytest.mark.slow
@pytest.mark.parametrize(("page", "command"), ALL_COMMANDS)
def test_commands_parse(page: Path, command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    if command[0] == "make":
        verbs = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M)
        assert command[1] in verbs, f"{page.name} tells of 'make {command[1]}'"
        return
    if command[0] == "xop-control":
        check_control(command[1:])
        return
    if command[0] in {"xop-bench", "xop-doctor"}:
        (parse_bench if command[0] == "xop-bench" else parse_doctor)(command[1:])
        return
    if command[0] == "xop-collect":
        from xop_lerobot.collect.cli import parse_arguments as parse_collect

        parse_collect(command[1:])[0].check()
        return
    if command[0] == "xop-eval":
        from xop_lerobot.evaluation import study
        from xop_lerobot.evaluation.cli import make_study, parse_arguments

        monkeypatch.chdir(ROOT)
        monkeypatch.setattr(study, "_find_absence", lambda *_: "")
        assert make_study(parse_arguments(command[1:]))
        return
    if command[0] == "xop-curate":
        check_curate(command[1:])
        return
    config = parse(command, monkeypatch)
    dataset = getattr(config, "dataset", None)
    if dataset is not None and hasattr(config, "robot") and hasattr(dataset, "num_episodes"):
        assert dataset.fps == config.robot.fps, "robot and dataset run at one rate"
        assert dataset.push_to_hub is False, "an example uploads nothing"


def read_modules() -> dict[str, set[str]]:
    """The flags that the pages give to each `python -m benchmarks.…` and `scripts.…`."""
    modules: dict[str, set[str]] = {}
    for page in PAGES:
        blocks = "\n".join(read_blocks(page, "[a-z]*")).replace("\\\n", " ")
        prose = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M)
        spans = [text.replace("\n", " ") for text in re.findall(r"`([^`]+)`", prose)]
        for line in (*blocks.splitlines(), *spans):
            found = re.search(r"python -m ((?:benchmarks|scripts)\.\w+)(.*)", line)
            if found:
                flags = re.findall(r"(?<= )--[a-z-]+", found[2].split("#")[0])
                modules.setdefault(found[1], set()).update(flags)
    return modules


@pytest.mark.slow
@pytest.mark.parametrize(("module", "flags"), sorted(read_modules().items()))
def test_benchmarks_have_the_flags_that_pages_give_them(module: str, flags: set[str]) -> None:
    command = [sys.executable, "-m", module, "--help"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert flags <= set(re.findall(r"--[a-z-]+", done.stdout)), module


def test_a_wrong_flag_is_found(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    with pytest.raises(SystemExit):
        parse(["lerobot-replay", "--robot.type=xop_g1", "--robot.camz=1"], monkeypatch)
    assert "--robot.camz" in capsys.readouterr().err


def test_the_main_commands_are_told() -> None:
    told = {command[0] for command in read_commands(ROOT / "README.md")}
    assert told >= {
        "make", "lerobot-record", "lerobot-teleoperate", "lerobot-replay", "lerobot-train",
        "lerobot-rollout", "xop-record", "xop-control", "xop-bench",
    }  # fmt: skip


def test_flags_in_prose_and_tables_exist() -> None:
    """`--robot.…` and `--teleop.…` anywhere in the pages are fields of the configurations."""
    from lerobot_robot_xop import XopG1Config
    from lerobot_teleoperator_xop import XopConfig

    known = {
        f"{prefix}.{key}"
        for prefix, config in (("robot", XopG1Config()), ("teleop", XopConfig()))
        for key in (*list_fields(config), "type")
    }
    for page in PAGES:
        for flag in re.findall(r"--((?:robot|teleop)\.[a-z_0-9.]+[a-z0-9])", page.read_text()):
            assert flag in known, f"{page.name} tells of --{flag}"


def list_fields(config: object, prefix: str = "") -> Iterator[str]:
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        value = getattr(config, field.name)
        yield f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            yield from list_fields(value, f"{prefix}{field.name}.")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("http://", "https://")):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name} links to {target}"
        if anchor:
            titles = re.findall(r"^#+ (.+)$", file.read_text(), re.M)
            anchors = {re.sub(r"[^\w -]", "", title).strip().lower().replace(" ", "-")
                       for title in titles}  # fmt: skip
            assert anchor in anchors, f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_modules_that_are_named_exist(page: Path) -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("this is no checkout")
    files = [f"/{file}" for file in listed.stdout.split()]
    for name in re.findall(r"`([a-z_0-9/]+\.py)`", page.read_text()):
        assert any(file.endswith(f"/{name}") for file in files), f"{page.name} names {name}"


def test_pages_that_are_named_in_files_exist() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("this is no checkout")
    for file in listed.stdout.split():
        if file.endswith((".py", ".js", ".toml", ".yaml", ".yml", ".sh", "Makefile")):
            for name in re.findall(r"\bdocs/[\w/]+\.md\b", (ROOT / file).read_text()):
                assert (ROOT / name).exists(), f"{file} names {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples_are_python(page: Path) -> None:
    for block in read_blocks(page, "python"):
        ast.parse(block, str(page))


def test_the_example_recording_is_one(tmp_path: Path) -> None:
    blocks = read_blocks(ROOT / "README.md", "python")
    (example,) = (block for block in blocks if "np.savez" in block)
    subprocess.run([sys.executable, "-c", example], cwd=tmp_path, check=True, env=os.environ)
    (path,) = tmp_path.glob("*.npz")
    recording = load_recording(path)
    assert recording.duration > 2.0
    wrists = recording.poses[:, 1:, 1] - recording.poses[:, :1, 1]
    assert np.allclose(wrists, [0.2, -0.2]), "left is +Y"
