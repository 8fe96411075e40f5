"""Flags that the commands which simulate episodes share."""

from __future__ import annotations

import argparse
from dataclasses import MISSING, fields
from typing import Any

from xop_lerobot.collect.config import CollectConfig
from xop_lerobot.core.command_line import CommandParser
from xop_lerobot.core.yaml_words import find_text


def add_config(
    parser: CommandParser, kind: type[CollectConfig] = CollectConfig, **texts: str
) -> None:
    """Add the flags that decide what each episode is simulated with, but for robot and task.

    Args:
        parser: Parser of the command.
        kind: Configuration whose defaults are shown.
        texts: What the help says of a flag instead.
    """
    defaults = {each.name: each.default for each in fields(kind) if each.default is not MISSING}

    def add(name: str, text: str, **options: Any) -> None:
        default = defaults[name.replace("-", "_")]
        shown = ",".join(default) if isinstance(default, tuple) else default
        text = texts.get(name) or f"{text} (default: {'none' if shown == '' else shown})"
        if default == "":  # "none" is what the help says of it
            options.setdefault("type", find_text)
        parser.add_argument(f"--{name}", help=text, default=default, **options)

    add("seed", "seed of all that is random", type=int)
    add("cameras", "cameras, with commas between", type=split)
    add("low-level", "low-level policy; default: the robot's own")
    add("low-level-path", "file of the low-level policy; empty: its default")
    add("fps", "rate of control and dataset [Hz]; divides 50", type=int)
    add("width", "width of a picture [pixel]", type=int)
    add("height", "height of a picture [pixel]", type=int)
    add("noise", "noise of the sensors: off, mild or harsh")
    add("method", "mpc, mpc_no_sync, mpc_table1, direct or direct_amo")
    add("variant", "binding, constraints and preset with _ between, such as v2_upright")
    add("scene", "scene; empty: the task's own")
    add("heights", "heights over the task's own, as support=0.35,table=0.6:0.7 [m]")
    add("plugins", "modules to import first, with commas between", type=split)
    parser.add_argument(
        "--images", action="store_true", help="store pictures as PNG and not as h264 video"
    )


def add_crew(parser: CommandParser) -> None:
    """Add `--workers` and `--ray`, which say who makes the episodes."""
    parser.add_argument(
        "--workers", type=int, default=0, help="processes; 0: one per core (default: 0)"
    )
    parser.add_argument(
        "--ray",
        default="",
        metavar="ADDRESS",
        help="make the episodes on a Ray cluster: local, auto, HOST:PORT or ray://HOST:PORT "
        "(default: none)",
    )


def split(text: str) -> tuple[str, ...]:
    """Read names with commas between."""
    names = find_text(text.strip("[] ")).split(",")
    return tuple(name.strip() for name in names if name.strip())


def read_config[C: CollectConfig](kind: type[C], arguments: argparse.Namespace, **more: Any) -> C:
    """Make a configuration of all flags that are named as its fields.

    Args:
        kind: Its class.
        arguments: The flags.
        more: Fields that have no flag of their name.
    """
    names = {each.name for each in fields(kind)} & vars(arguments).keys()
    values = {name: getattr(arguments, name) for name in names}
    return kind(**{**values, "video": not arguments.images, **more})
