"""Words that YAML takes for something else: `off` is a boolean, `null` nothing, `007` a number.

LeRobot reads flags and files of its commands as YAML 1.1, whose surprises reach a configuration
as the text of what it was taken for: `--robot.sim.noise=off` comes in as "False". Files that this
project reads itself are read by `load_yaml`, which takes words for words.
"""

from __future__ import annotations

import dataclasses
import re
import sys
from collections.abc import Collection
from typing import Any

_NOTHING = ("false", "off", "no", "none", "null", "~")
"""Words, and what YAML makes of them, for a setting that is switched off."""
_NAMES_OF_NOTHING = ("off", "none")
_CORE = (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("int", r"[-+]?(?:0|[1-9][0-9]*)", "-+0123456789"),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+\.[0-9]*)(?:[eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        "-+.0123456789",
    ),
)
"""What a plain scalar may be but text, by YAML 1.2: its pattern and how it may begin."""


def find_word(value: object, known: Collection[str]) -> str:
    """Find which of the known names is meant by what YAML has made of it.

    Args:
        value: The name; or what a word such as `off`, `no` or `null` was taken for.
        known: Every name that is valid; `off` or `none` among them is what such words mean.

    Returns:
        The name; what is none comes back as text, for who checks it.
    """
    text = str(value)
    if text not in known and text.lower() in _NOTHING:
        return next((name for name in _NAMES_OF_NOTHING if name in known), text)
    return text


def find_text(value: str) -> str:
    """Find the text of a setting that may be none: empty for `none`, `off` and their like."""
    return "" if value.lower() in _NOTHING else value


def fill_nulls(config: Any) -> None:
    """Give the default to each field that must have a value and was given `null`.

    Args:
        config: A dataclass, frozen or not, whose fields were read from YAML.
    """
    for each in dataclasses.fields(config):
        optional = "None" in str(each.type) or "Optional" in str(each.type)
        if optional or getattr(config, each.name) is not None:
            continue
        if each.default is not dataclasses.MISSING:
            object.__setattr__(config, each.name, each.default)
        elif each.default_factory is not dataclasses.MISSING:
            object.__setattr__(config, each.name, each.default_factory())


def recover_typed(config: Any, flag: str, *names: str) -> None:
    """Give free text back as it was typed, where YAML took it for a number or a switch.

    A code of `012345` would be the octal number 5349 else. Only what stands on this process's
    command line, and has become the very value of the field, is put in its place.

    Args:
        config: A dataclass with fields of text.
        flag: Flag of the configuration, `teleop.device`.
        names: Its fields.
    """
    import yaml  # noqa: PLC0415 (only who has such a flag needs it)

    for name in names:
        typed = _find_typed(f"--{flag}.{name}")
        value = getattr(config, name)
        if typed is None or value is None or typed == value:
            continue
        try:
            read = yaml.safe_load(typed)
        except (yaml.YAMLError, ValueError):
            continue
        if not isinstance(read, str) and str(read) == value:
            setattr(config, name, typed)


def _find_typed(flag: str) -> str | None:
    """What stands after `flag` on the command line, the last time it is there."""
    found = None
    for word, after in zip(sys.argv, [*sys.argv[1:], None], strict=True):
        name, equals, text = word.partition("=")
        if name == flag:
            found = text if equals else after
    return found


def load_yaml(text: str, *, switches: bool = False) -> Any:
    """Read YAML as its version 1.2 does, so that names and numbers are what they look like.

    `off`, `on`, `yes` and `no`, `007`, `12:30` and dates are text; `1e-3` is a number.

    Args:
        text: The YAML.
        switches: Whether `on`, `off`, `yes` and `no` are booleans all the same.

    Raises:
        yaml.YAMLError: If it is none.
    """
    import yaml  # noqa: PLC0415

    class Loader(yaml.SafeLoader):
        """`yaml.SafeLoader` with other plain scalars."""

    Loader.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in rules if tag == "tag:yaml.org,2002:merge"]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    for kind, pattern, first in _CORE:
        whole = re.compile(rf"^(?:{pattern})$")
        Loader.add_implicit_resolver(f"tag:yaml.org,2002:{kind}", whole, list(first))
    if switches:
        words = re.compile(r"^(?:on|off|yes|no)$", re.IGNORECASE)
        Loader.add_implicit_resolver("tag:yaml.org,2002:bool", words, list("oOyYnN"))
    return yaml.load(text, Loader)  # it is a safe loader
