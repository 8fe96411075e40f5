"""Words that YAML takes for something else come through flags and files as they were meant."""

from __future__ import annotations

import dataclasses
import math
import sys
from dataclasses import dataclass, field

import draccus
import pytest
from draccus import cfgparsing
from draccus.parsers.decoding import decode
from draccus.utils import DecodingError, deflatten
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig

from benchmarks.tracking_setup import parse_overrides
from lerobot_robot_xop import XopG1Config
from lerobot_teleoperator_xop import XopConfig
from xop_lerobot.collect.config import add_config
from xop_lerobot.control.protocol import find_socket
from xop_lerobot.core.command_line import CommandParser, find_mistake
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.yaml_words import fill_nulls, find_word, load_yaml
from xop_lerobot.curate.retarget_job import read_settings, read_weights
from xop_lerobot.evaluation.study import load_study
from xop_lerobot.plant.config import NOISE_PRESETS
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.obstacles import load_obstacles


@dataclass
class Flags:
    robot: RobotConfig
    teleop: TeleoperatorConfig


TYPES = ("--robot.type=xop_g1", "--teleop.type=xop")


def parse(*flags: str) -> Flags:
    """What LeRobot's parser makes of the flags of a command, less the time for its help."""
    values = {}
    for flag in (*TYPES, *flags):
        name, _, text = flag.partition("=")
        values[name.removeprefix("--")] = cfgparsing.parse_string(text)
    return decode(Flags, deflatten(values, sep="."))


def get_robot(flags: Flags) -> XopG1Config:
    assert isinstance(flags.robot, XopG1Config)
    return flags.robot


def robot(*flags: str) -> XopG1Config:
    return get_robot(parse(*(f"--robot.{flag}" for flag in flags)))


def teleop(*flags: str) -> XopConfig:
    teleop = parse(*(f"--teleop.{flag}" for flag in flags)).teleop
    assert isinstance(teleop, XopConfig)
    return teleop


# -- LeRobot's flags and files ---------------------------------------------------------------


@pytest.mark.parametrize("word", ["off", "Off", "OFF", "no", "false", "none", "null", "~", "'off'"])
def test_noise_is_switched_off_by_any_word(word):
    assert robot("sim.noise=mild", f"sim.noise={word}").sim.noise == "off"


@pytest.mark.parametrize("word", NOISE_PRESETS)
def test_every_noise_can_be_typed(word):
    assert robot(f"sim.noise={word}").sim.noise == word


def test_the_same_through_the_whole_parser_and_from_a_file(tmp_path):
    path = tmp_path / "record.yaml"
    path.write_text("robot:\n  type: xop_g1\n  sim:\n    noise: off\n  session: null\n")
    from_file = get_robot(draccus.parse(Flags, config_path=path, args=[TYPES[1]]))
    assert (from_file.sim.noise, from_file.session) == ("off", "default")
    path.write_text("robot:\n  type: xop_g1\n  sim:\n    noise: harsh\n")
    flags = [*TYPES, "--robot.sim.noise=off"]
    assert get_robot(draccus.parse(Flags, config_path=path, args=flags)).sim.noise == "off"


@pytest.mark.parametrize("word", ["on", "yes", "true"])
def test_a_noise_that_there_is_not_is_refused(word):
    with pytest.raises(
        DecodingError, match="unknown noise preset 'True'. Known: harsh, mild, off"
    ) as refusal:
        robot(f"sim.noise={word}")
    assert isinstance(find_mistake(refusal.value), UnknownName)


@pytest.mark.parametrize("word", ["none", "off", "no", "null"])
def test_what_a_gesture_does_is_switched_off_by_any_word(word):
    gestures = teleop(
        *(f"gestures.{name}={word}" for name in ("other_double_pinch", "both_double_pinch")),
        *(f"gestures.raised.{name}={word}" for name in ("end", "redo", "stop")),
    ).gestures
    raised = gestures.raised
    assert {gestures.other_double_pinch, gestures.both_double_pinch} == {"none"}
    assert {raised.end, raised.redo, raised.stop} == {"none"}


@pytest.mark.parametrize("word", ["none", "off", "null", ""])
def test_what_may_be_none_can_be_typed_so(word):
    """As README's table has the defaults of these."""
    config = robot(f"task={word}", f"sim.scene={word}")
    assert (config.task, config.scene) == ("", "empty")
    names = ("variant", "targets", "body", "constraints", "obstacles")
    plain = RetargeterConfig()
    assert teleop(*(f"retargeter.{name}={word}" for name in names)).retargeter == plain


@pytest.mark.parametrize("word", ["none", "off", "[]", ""])
def test_no_cameras(word):
    assert robot(f"cameras={word}").cameras == []


def test_flags_whose_help_says_none_take_it():
    parser = CommandParser("collect")
    add_config(parser)
    plain = vars(parser.parse([]))
    nothing = [name.replace("_", "-") for name, value in plain.items() if value == ""]
    assert "scene" in nothing and "variant" in nothing
    assert vars(parser.parse([f"--{name}=none" for name in nothing])) == plain
    assert parser.parse(["--cameras=none", "--plugins=none"]).cameras == ()


@pytest.mark.parametrize("word", ["", "off", "no", "false", "none", "null"])
def test_the_control_socket_is_switched_off_by_any_word(word):
    assert find_socket(teleop(f"control={word}").control, "default") is None


@pytest.mark.parametrize("word", ["on", "yes", "true", "True"])
def test_the_control_socket_is_switched_on_by_any_word(word):
    path = find_socket(teleop(f"control={word}").control, "left")
    assert path is not None and path.name == "left.sock"


def list_fields(config, place: str) -> list[str]:
    """Flags of everything that a configuration holds, but for the type."""
    flags = []
    for each in dataclasses.fields(config):
        value = getattr(config, each.name)
        if dataclasses.is_dataclass(value):
            flags += list_fields(value, f"{place}.{each.name}")
        elif each.name != "frames":  # a list is what LeRobot's parser asks for
            flags.append(f"{place}.{each.name}")
    return flags


def test_null_is_the_default_of_every_setting():
    """Or nothing, where nothing may be given; in no setting is it an error of ours."""
    plain, nulls = parse(), []
    off = {"sim.noise", "other_double_pinch", "both_double_pinch", "end", "redo", "stop"}
    for part in ("robot", "teleop"):
        for flag in list_fields(getattr(plain, part), part):
            if not flag.endswith(tuple(off)):
                nulls.append(f"--{flag}=null")
    assert len(nulls) > 80
    assert parse(*nulls) == plain


@pytest.mark.parametrize(
    "flag, text",
    [
        ("robot.session", "007"),
        ("robot.session", "1_000"),
        ("robot.session", "on"),
        ("robot.low_level.path", "1.10"),
        ("teleop.session", "0x1F"),
        ("teleop.device.code", "01234567"),
        ("teleop.device.code", "123456"),
        ("teleop.device.path", "2024_05"),
        ("teleop.device.host", "12:30"),
        ("teleop.retargeter.obstacles", "1.0"),
        ("teleop.session", "plain"),
        ("teleop.session", "it's"),
    ],
)
@pytest.mark.parametrize("form", ["one word", "two words"])
def test_free_text_is_what_was_typed(monkeypatch, flag, text, form):
    words = [f"--{flag}={text}"] if form == "one word" else [f"--{flag}", text]
    monkeypatch.setattr(sys, "argv", ["lerobot-record", f"--{flag}=other", *words])
    value = parse(f"--{flag}={text}")
    for name in flag.split("."):
        value = getattr(value, name)
    assert value == text


def test_what_is_quoted_for_yaml_is_not_typed_text(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lerobot-record", "--robot.session='007'"])
    assert robot("session='007'").session == "007"


# -- this project's own files and pairs --------------------------------------------------------


@pytest.mark.parametrize(
    "text, value",
    [
        ("off", "off"), ("on", "on"), ("yes", "yes"), ("No", "No"), ("true", True),
        ("False", False), ("null", None), ("", None), ("~", None), ("1", 1), ("-12", -12),
        ("0", 0), ("007", "007"), ("1_000", "1_000"), ("0x10", "0x10"), ("12:30", "12:30"),
        ("1e-3", 0.001), ("1.5E3", 1500.0), (".5", 0.5), ("1.", 1.0), ("-.inf", -math.inf),
        ("2024-05-01", "2024-05-01"), ("'1'", "1"), ("1.2.3", "1.2.3"), ("=", "="),
        ("[off, 1e2]", ["off", 100.0]),
    ],
)  # fmt: skip
def test_yaml_is_what_it_looks_like(text, value):
    read = load_yaml(text)
    assert read == value and type(read) is type(value)


def test_switches_where_they_are_asked_for():
    assert load_yaml("[on, Off, yes, NO, true]", switches=True) == [True, False, True, False, True]


def test_merged_mappings_stay():
    assert load_yaml("a: &a {x: 1}\nb:\n  <<: *a\n  y: off")["b"] == {"x": 1, "y": "off"}


@pytest.mark.parametrize("noise, expected", [("off", "off"), ("false", "off"), ("none", "off"),
                                             ("harsh", "harsh"), ("", "mild")])  # fmt: skip
@pytest.mark.parametrize("where", ["study", "group"])
def test_the_noise_of_a_study(tmp_path, noise, expected, where):
    study = f"noise: {noise}\n" if where == "study" else ""
    group = f"  noise: {noise}\n" if where == "group" else ""
    path = tmp_path / "study.yaml"
    path.write_text(
        f"{study}groups:\n- robot: rby1\n{group}  tasks: [dual_point_touch]\n  methods: [direct]\n"
    )
    (cell,) = load_study(path)
    assert cell.setup.noise == expected


def test_a_study_without_its_noise_is_refused_and_not_run_with_another(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text(
        "noise: on\ngroups:\n- {robot: rby1, tasks: [dual_point_touch], methods: [direct]}\n"
    )
    with pytest.raises(UnknownName, match="unknown noise preset 'on'. Known: harsh, mild, off"):
        load_study(path)


@pytest.mark.parametrize("name", ["off", "007", "12:30", "no"])
def test_names_of_obstacles(tmp_path, name):
    path = tmp_path / "obstacles.yaml"
    path.write_text(
        f"obstacles:\n- {{name: {name}, shape: sphere, position: [1e0, 0, 5e-1], radius: 1e-1}}\n"
        "- {name: , shape: sphere, position: [2, 0, 0], radius: 0.1}\n"
    )
    first, second = load_obstacles(path)
    assert (first.name, second.name) == (name, "sphere_2")
    assert first.position.tolist() == [1.0, 0.0, 0.5]


def test_pairs_of_settings():
    assert read_weights(["position=1e-1", "stance=1e1", "collision_range=inf"]) == {
        "position": 0.1, "stance": 10.0, "collision_range": math.inf,
    }  # fmt: skip
    assert parse_overrides(["temperature=1e-3", "sample_plan=off", "shift=one"]) == {
        "temperature": 0.001, "sample_plan": False, "shift": "one",
    }  # fmt: skip
    pairs = ["sync=off", "control_hz=1e1", "variant=007"]
    assert read_settings(RetargeterConfig, "retargeter", pairs) == {
        "sync": False, "control_hz": 10.0, "variant": "007",
    }  # fmt: skip
    with pytest.raises(BadValue, match="retargeter 'sync': "):
        read_settings(RetargeterConfig, "retargeter", ["sync=perhaps"])


# -- the helpers -------------------------------------------------------------------------------


def test_words():
    assert find_word(False, ("off", "mild")) == "off"
    assert find_word("None", ("none", "upright")) == "none"
    assert find_word(False, ("left", "right")) == "False"
    assert find_word("none", ("off", "none")) == "none"


def test_nulls():
    @dataclass(frozen=True)
    class Config:
        number: int = 3
        perhaps: float | None = 1.0
        names: list[str] = field(default_factory=lambda: ["a"])

    config = Config(number=None, perhaps=None, names=None)  # type: ignore[arg-type]
    fill_nulls(config)
    assert config == Config(3, None, ["a"])
