"""Lines of text for figures: a table that is printed row by row, and totals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from xop_lerobot.core.wording import say_count
from xop_lerobot.curate.expression import Kind
from xop_lerobot.curate.figures import FIGURES

UNKNOWN = "-"
_HEADS = {
    "episode": "ep",
    "duration": "time",
    "collision": "coll.",
    "tracking_mean": "track",
    "tracking_p95": "p95",
    "tracking_angle_mean": "angle",
    "tracking_angle_p95": "p95",
    "command_roughness": "rough",
    "gap_time": "gaps",
    "dropped_frames": "drop",
    "plan_age_p95": "age p95",
    "idle_time": "idle",
}
"""Heads that are shorter than the figure's name."""
_WIDTHS = {"robot": 8, "task": 40, "scene": 10, "low_level": 10, "clock": 8, "preset": 12}
_MINIMUM = 5


class Table:
    """A table of episodes; its widths are known before the first row is.

    Args:
        names: Names of the figures that are its columns.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        heads = [_HEADS.get(name, name) for name in names]
        units = [FIGURES[name].unit for name in names]
        least = [_WIDTHS.get(name, _MINIMUM) for name in names]
        self._widths = [
            max(len(head), len(unit), low)
            for head, unit, low in zip(heads, units, least, strict=True)
        ]
        self.head = f"{self._join(heads)}\n{self._join(units)}"

    def format(self, figures: Mapping[str, Any]) -> str:
        """Format the row of one episode."""
        return self._join([format_value(name, figures[name]) for name in self._names])

    def _join(self, cells: Sequence[str]) -> str:
        parts = []
        for name, cell, width in zip(self._names, cells, self._widths, strict=True):
            is_text = FIGURES[name].kind is Kind.TEXT
            cell = f"{cell[: width - 1]}…" if len(cell) > width else cell  # noqa: PLW2901
            parts.append(cell.ljust(width) if is_text else cell.rjust(width))
        return "  ".join(parts).rstrip()


def format_value(name: str, value: Any) -> str:
    """Format a figure for people: a few digits, - for what is not known."""
    if value is None:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        digits = {"m": 3, "rad": 2, "s": 1}.get(FIGURES[name].unit, 1)
        return f"{value:.{3 if name.startswith(('plan', 'solve')) else digits}f}"
    return " ".join(str(value).split())


class Totals:
    """Sums over the episodes, of constant size.

    Args:
        names: Names of the numbers whose mean and range are wanted.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self.episodes = self.frames = self.faulty = 0
        self._seconds = self._idle = 0.0
        self._flags: dict[str, list[int]] = {}
        self._spreads: dict[str, tuple[int, float, float, float]] = {}
        self._robots: dict[str, int] = {}
        self._tasks: dict[str, int] = {}

    def add(self, figures: Mapping[str, Any], has_problems: bool) -> None:
        """Add an episode."""
        self.episodes += 1
        self.frames += figures["length"]
        self.faulty += has_problems
        self._seconds += figures["duration"]
        self._idle += figures["idle_time"] or 0.0
        for name in _COUNTED:
            value = figures[name]
            if value is not None:
                counts = self._flags.setdefault(name, [0, 0])
                counts[0] += bool(value)
                counts[1] += 1
        for name in self._names:
            value = figures[name]
            if value is not None:
                count, total, low, high = self._spreads.get(name, (0, 0.0, value, value))
                self._spreads[name] = count + 1, total + value, min(low, value), max(high, value)
        _count(self._robots, figures["robot"])
        _count(self._tasks, figures["task"])

    def format(self) -> str:
        """Format the totals, several lines."""
        hours = self._seconds / 3600
        time = f"{hours:.2f} h" if hours >= 1 else f"{self._seconds:.1f} s"
        size = f"{say_count(self.episodes, 'episode')}, {say_count(self.frames, 'frame')}"
        lines = [f"{size}, {time}, {self._idle:.1f} s idle"]
        if not self.episodes:
            return "0 episodes"
        lines.append(f"robots: {_list(self._robots)}")
        lines.append(f"tasks: {_list(self._tasks)}")
        counts = []
        for name, text in _COUNTED.items():
            number, known = self._flags.get(name, (0, 0))
            of = "" if known == self.episodes else f" of {known} known"
            counts.append(f"{text} {number}{of}" if known else f"{text} {UNKNOWN}")
        lines.append("episodes with " + ", ".join(counts))
        for name, (count, total, low, high) in self._spreads.items():
            unit = FIGURES[name].unit
            mean, low_text, high_text = (
                format_value(name, float(each)) for each in (total / count, low, high)
            )
            lines.append(f"{name}: {mean} {unit}, {low_text} to {high_text}".replace(" ,", ","))
        return "\n".join(lines)


_COUNTED = {
    "success": "success",
    "fall": "a fall",
    "collision": "a collision",
    "trouble": "trouble",
    "gaps": "gaps in tracking",
    "late": "lateness",
    "dropped_frames": "dropped pictures",
    "missing_frames": "missing frames",
}
"""Figures of which it is counted in how many episodes they are true, or over zero."""
_LISTED = 8


def _count(counts: dict[str, int], value: str | None) -> None:
    """Count a value; those after a hundred different ones are counted together."""
    name = UNKNOWN if value is None else value
    if name not in counts and len(counts) >= 100:
        name = "…"
    counts[name] = counts.get(name, 0) + 1


def _list(counts: Mapping[str, int]) -> str:
    ranked = sorted(counts.items(), key=lambda pair: -pair[1])
    shown = [f"{' '.join(name.split())} ({number})" for name, number in ranked[:_LISTED]]
    rest = len(ranked) - _LISTED
    return ", ".join([*shown, *([f"and {rest} more"] if rest > 0 else [])])
