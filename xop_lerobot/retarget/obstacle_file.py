"""Obstacles from a YAML file: what stands around a robot that no scene knows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from xop_lerobot.core.errors import XopError
from xop_lerobot.core.transforms import quat_from_rpy
from xop_lerobot.core.yaml_words import load_yaml
from xop_lerobot.retarget.obstacles import Obstacle

SIZES = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
}
"""Keys that give the size of each shape."""

_OPTIONAL = ("name", "rpy")


class BadObstacles(XopError, ValueError):
    """A file of obstacles is missing or malformed; the message names the file and the fault."""

    def __init__(self, path: object, fault: str) -> None:
        super().__init__(f"obstacles '{path}': {fault}")


def load_obstacles(path: str | Path) -> tuple[Obstacle, ...]:
    """Read obstacles; docs/retargeter.md has the format.

    Raises:
        BadObstacles: Naming the file, the entry and its fault.
    """
    import yaml  # noqa: PLC0415 (only who has such a file needs it)

    try:
        content = load_yaml(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise BadObstacles(path, f"cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BadObstacles(path, f"is no YAML: {error}") from error
    entries = content.get("obstacles") if isinstance(content, Mapping) else None
    if not isinstance(entries, list):
        raise BadObstacles(path, "must hold 'obstacles:' and a list of them")
    obstacles = []
    for i, entry in enumerate(entries):
        try:
            obstacles.append(_parse(entry, i))
        except _Fault as fault:
            raise BadObstacles(path, f"obstacle {_label(entry, i)}: {fault}") from None
    names = [obstacle.name for obstacle in obstacles]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise BadObstacles(path, f"the name '{twice[0]}' is used twice")
    return tuple(obstacles)


class _Fault(Exception):
    """What is wrong with one entry."""


def _label(entry: Any, index: int) -> str:
    name = entry.get("name") if isinstance(entry, Mapping) else None
    return f"{index + 1}" if name is None else f"{index + 1} ('{name}')"


def _parse(entry: Any, index: int) -> Obstacle:
    """Make the obstacle of one entry."""
    if not isinstance(entry, Mapping):
        raise _Fault(f"must be keys and values, got {entry!r}")
    shape = entry.get("shape")
    if shape not in SIZES:
        raise _Fault(f"unknown shape {shape!r}. Known: {', '.join(sorted(SIZES))}")
    needed = ("shape", "position", *SIZES[shape])
    for key in needed:
        if key not in entry:
            raise _Fault(f"a {shape} needs '{key}'")
    allowed = sorted({*needed, *_OPTIONAL})
    for key in entry:
        if key not in allowed:
            raise _Fault(f"unknown key {key!r}. Known of a {shape}: {', '.join(allowed)}")
    if shape == "box":
        half = _read_numbers(entry, "size", 3, "m", positive=True) / 2
    else:
        radius = float(_read_numbers(entry, "radius", 1, "m", positive=True)[0])
        half = np.array([radius, radius, radius])
        if shape != "sphere":
            half[2] = float(_read_numbers(entry, "length", 1, "m", positive=True)[0]) / 2
        if shape == "capsule" and half[2] < radius:
            raise _Fault(
                f"'length' holds both caps, so it must be at least twice the radius, "
                f"{2 * radius:g} m, got {2 * half[2]:g}"
            )
    rpy = _read_numbers(entry, "rpy", 3, "rad") if "rpy" in entry else np.zeros(3)
    return Obstacle(
        name=f"{shape}_{index + 1}" if entry.get("name") is None else str(entry["name"]),
        position=_read_numbers(entry, "position", 3, "m"),
        quat=quat_from_rpy(*rpy),
        half_size=half,
        shape=shape,
    )


def _read_numbers(
    entry: Mapping[str, Any], key: str, count: int, unit: str, *, positive: bool = False
) -> np.ndarray:
    """Read `count` finite numbers of `entry`. Shape (count,)."""
    what = "a number" if count == 1 else f"a list of {count} numbers"
    value = entry[key] if count > 1 else [entry[key]]
    valid = isinstance(value, list) and len(value) == count
    if not valid or any(isinstance(x, bool) or not isinstance(x, int | float) for x in value):
        raise _Fault(f"'{key}' must be {what} [{unit}], got {entry[key]!r}")
    numbers = np.array(value, dtype=float)
    if not np.isfinite(numbers).all():
        raise _Fault(f"'{key}' must be finite, got {entry[key]!r}")
    if positive and not (numbers > 0).all():
        raise _Fault(f"'{key}' must be positive [{unit}], got {entry[key]!r}")
    return numbers
