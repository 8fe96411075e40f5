"""Heights of a task's supports and points, as set by the user."""

from __future__ import annotations

import math
from collections.abc import Mapping

from xop_lerobot.core.command_line import split_pair
from xop_lerobot.core.errors import BadValue, UnknownName

type HeightRange = tuple[float, float]
"""Lowest and highest height above the floor [m]."""

_FORM = "NAME=HEIGHT or NAME=LOW:HIGH [m], comma-separated"


def parse_heights(text: str) -> dict[str, HeightRange]:
    """Parse heights by name: ``"support=0.35,table=0.6:0.7"``.

    Args:
        text: Comma-separated heights or ranges by name; empty for none.

    Raises:
        BadValue: If it is malformed, or a range is reversed.
    """
    heights: dict[str, HeightRange] = {}
    for part in filter(None, (piece.strip() for piece in text.strip("{} ").split(","))):
        name, numbers = split_pair(part, f"heights must be {_FORM}")
        first, colon, second = numbers.partition(":")
        try:
            low, high = float(first), float(second if colon else first)
        except ValueError:
            low = high = math.nan
        if not (math.isfinite(low) and math.isfinite(high)):
            raise BadValue(f"heights must be {_FORM}, got '{part}'")
        if name in heights:
            raise BadValue(f"heights give '{name}' twice")
        if low > high:
            raise BadValue(f"heights of '{name}' must go from low to high, got {low:g}:{high:g}")
        heights[name] = (low, high)
    return heights


def check_heights(
    heights: Mapping[str, HeightRange], limits: Mapping[str, HeightRange], task: str, robot: str
) -> None:
    """Check that a task has these heights, and that the robot can work there.

    Args:
        heights: Requested ranges by name.
        limits: Allowed ranges by name.
        task: Name of the task.
        robot: Name of the robot.

    Raises:
        UnknownName: If the task has no such height, listing those that it has.
        BadValue: If a range exceeds its limits.
    """
    for name, (low, high) in heights.items():
        if name not in limits:
            raise UnknownName(f"height of {task}", name, limits)
        lowest, highest = limits[name]
        if low < lowest or high > highest:
            asked = f"{low:g}" if low == high else f"{low:g}:{high:g}"
            raise BadValue(
                f"height of the {name} in {task} must be within {lowest:g} to {highest:g} m, "
                f"where {robot} can work, got {asked}"
            )
