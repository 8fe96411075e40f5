"""Text settings that YAML 1.1 reads as booleans, nulls or numbers: `off`, `null`, `007`.

LeRobot parses flags and files of its commands as YAML 1.1, so a text setting may arrive as the text
of a converted value: `--robot.sim.noise=off` arrives as "False". The functions here recover the
original text. Files of this project are read by `load_yaml`, by the rules of YAML 1.2.
"""

from __future__ import annotations

import dataclasses
import re
import sys
from collections.abc import Collection
from typing import Any

_NOTHING = ("false", "off", "no", "none", "null", "~")
"""Words for a setting that is switched off, and their YAML values as text."""
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
"""Types of plain scalars other than text in YAML 1.2: pattern and possible first characters."""


def find_word(value: object, known: Collection[str]) -> str:
    """Recover a name from its YAML value.

    Args:
        value: The name, or the YAML value of a word such as `off`, `no` or `null`.
        known: All valid names; `off` or `none` among them is what such words mean.

    Returns:
        The name; any other value as text, for the caller to validate.
    """
    text = str(value)
    if text not in known and text.lower() in _NOTHING:
        return next((name for name in _NAMES_OF_NOTHING if name in known), text)
    return text


def find_text(value: str) -> str:
    """Text of an optional setting: empty for `none`, `off` and similar words."""
    return "" if value.lower() in _NOTHING else value


def fill_nulls(config: Any) -> None:
    """Set fields that must not be None, but were given `null`, to their defaults.

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
    """Restore text fields as typed if YAML converted them to a number or boolean.

    Otherwise a code of `012345` would become the octal number 5349. A field is restored only if
    its value is the conversion of what is on this process's command line.

    Args:
        config: A dataclass with text fields.
        flag: Flag of the configuration, such as `teleop.device`.
        names: Its text fields.
    """
    import yaml  # noqa: PLC0415 (needed only for such a flag)

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
    """Value of the last occurrence of `flag` on the command line; None without one."""
    found = None
    for word, after in zip(sys.argv, [*sys.argv[1:], None], strict=True):
        name, equals, text = word.partition("=")
        if name == flag:
            found = text if equals else after
    return found


def load_yaml(text: str, *, switches: bool = False) -> Any:
    """Read YAML by the rules of version 1.2, which has fewer implicit conversions than 1.1.

    `off`, `on`, `yes` and `no`, `007`, `12:30` and dates are text; `1e-3` is a number.

    Args:
        text: The YAML text.
        switches: Whether `on`, `off`, `yes` and `no` are booleans as in version 1.1.

    Raises:
        yaml.YAMLError: If it is malformed.
    """
    import yaml  # noqa: PLC0415

    class Loader(yaml.SafeLoader):
        """`yaml.SafeLoader` with the plain scalars of YAML 1.2."""

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
    return yaml.load(text, Loader)  # a subclass of the safe loader
