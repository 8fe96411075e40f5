"""The verbs of `xop-curate`.

A verb is a module with

    SUMMARY: str                                        one line of the list of verbs
    add_arguments(parser: CommandParser) -> None        its flags
    run(arguments: argparse.Namespace) -> int           does it; returns the exit code

and its docstring heads its own `--help`. Modules are imported for `--help`, so whatever takes
long to import (LeRobot, MuJoCo) is imported in `run`.
"""

from __future__ import annotations

import argparse
import importlib
from typing import Protocol, cast

from xop_lerobot.core.command_line import CommandParser
from xop_lerobot.core.errors import UnknownName

_PACKAGE = "xop_lerobot.curate"
VERBS = {
    "inspect": "inspect",
    "filter": "filter",
    "trim": "trim",
    "merge": "merge",
    "split": "split",
    "repair": "repair",
    "label": "label",
    "retarget": "retarget",
    "report": "report",
}
"""Module of each verb, in the order of the list."""


class Verb(Protocol):
    """What a verb's module has."""

    SUMMARY: str

    def add_arguments(self, parser: CommandParser) -> None:
        """Add the verb's flags."""
        ...

    def run(self, arguments: argparse.Namespace) -> int:
        """Do what the flags ask for; returns the exit code."""
        ...


def load_verb(name: str) -> Verb:
    """Import a verb.

    Raises:
        UnknownName: Listing the known ones.
    """
    if name not in VERBS:
        raise UnknownName("verb of xop-curate", name, VERBS)
    return cast("Verb", importlib.import_module(f"{_PACKAGE}.{VERBS[name]}"))
