"""The figures of an episode, by name: what `inspect` shows and `filter` chooses by."""

from __future__ import annotations

from typing import NamedTuple

from xop_lerobot.core.state import FRAMES
from xop_lerobot.curate.expression import Kind

_FLAG, _NUMBER, _TEXT = Kind.FLAG, Kind.NUMBER, Kind.TEXT


class Figure(NamedTuple):
    """A figure.

    Attributes:
        name: Its name in expressions and in JSON.
        kind: What its value is, unless it is not known.
        unit: Its unit; empty for flags, texts, counts and ratios.
        text: What it is.
    """

    name: str
    kind: Kind
    unit: str
    text: str


def _make_tracking(prefix: str, of: str) -> list[Figure]:
    return [
        Figure(f"{prefix}_mean", _NUMBER, "m", f"mean distance of {of} from the goal, engaged"),
        Figure(f"{prefix}_p95", _NUMBER, "m", "95th percentile of it"),
        Figure(f"{prefix}_angle_mean", _NUMBER, "rad", f"mean angle of {of} from the goal"),
        Figure(f"{prefix}_angle_p95", _NUMBER, "rad", "95th percentile of it"),
    ]


_ALL = [
    Figure("episode", _NUMBER, "", "index of the episode"),
    Figure("length", _NUMBER, "", "its frames"),
    Figure("duration", _NUMBER, "s", "its time, frames over fps"),
    Figure("robot", _TEXT, "", "LeRobot's robot type"),
    Figure("task", _TEXT, "", "task in words; several with ' | ' between"),
    Figure("success", _FLAG, "", "the task was accomplished in the last frame"),
    Figure("fall", _FLAG, "", "the robot fell"),
    Figure("collision", _FLAG, "", "it touched anything but the ground, itself included"),
    Figure("trouble", _FLAG, "", "it moved though it was told to stand, or gave way"),
    Figure("finished", _FLAG, "", "the operator's recording or script had played out"),
    Figure("engaged_time", _NUMBER, "s", "time in which the operator drove"),
    *_make_tracking("tracking", "head and wrists, pooled,"),
    *(each for frame in FRAMES for each in _make_tracking(f"tracking_{frame}", frame)),
    Figure("command_roughness", _NUMBER, "1/s²", "RMS second difference over half the range"),
    Figure("command_ldlj", _NUMBER, "", "log dimensionless jerk of commands, higher is smoother"),
    Figure("hand_jerk", _NUMBER, "m/s³", "mean jerk of the robot's wrists"),
    Figure("gaps", _NUMBER, "", "times that the device lost a limb, once engaged"),
    Figure("gap_time", _NUMBER, "s", "time of all of them"),
    Figure("gap_max", _NUMBER, "s", "time of the longest"),
    Figure("late", _FLAG, "", "a real-time episode ran at less than 95 % of its rate"),
    Figure("late_frames", _NUMBER, "", "frames over 1.5 periods after the one before; real time"),
    Figure("missing_frames", _NUMBER, "", "frames that the robot's clock went on without"),
    Figure("dropped_frames", _NUMBER, "", "pictures that the video encoder dropped"),
    Figure("real_fps", _NUMBER, "Hz", "frames a second of the host's clock"),
    Figure("plan_age_mean", _NUMBER, "s", "mean age of the plan in force, engaged"),
    Figure("plan_age_p95", _NUMBER, "s", "95th percentile of it"),
    Figure("plan_age_max", _NUMBER, "s", "the oldest"),
    Figure("solve_time_p95", _NUMBER, "s", "95th percentile of the time that a plan took"),
    Figure("unsolved", _NUMBER, "", "engaged frames without a new solution"),
    Figure("idle_start", _NUMBER, "s", "time before anything happens"),
    Figure("idle_end", _NUMBER, "s", "time after the last that happens"),
    Figure("idle_time", _NUMBER, "s", "all time in which nothing happens"),
    Figure("clock", _TEXT, "", "lockstep or realtime"),
    Figure("scene", _TEXT, "", "scene of the simulation"),
    Figure("low_level", _TEXT, "", "low-level policy"),
    Figure("preset", _TEXT, "", "preset of the retargeter at the beginning"),
    Figure("seed", _NUMBER, "", "seed of the session"),
    Figure("start_time", _NUMBER, "s", "host's clock at the first frame, since 1970"),
    Figure("readable", _FLAG, "", "its rows and videos are there, whole and as announced"),
]

FIGURES = {figure.name: figure for figure in _ALL}
"""Every figure by name, in the order in which they are written."""
KINDS = {figure.name: figure.kind for figure in _ALL}
"""What each is, for an `Expression`."""


def describe_figures() -> str:
    """List the figures, a line each, for `--help`."""
    width = max(map(len, FIGURES))
    lines = []
    for figure in FIGURES.values():
        what = figure.unit or {_FLAG: "flag", _TEXT: "text"}.get(figure.kind, "")
        lines.append(f"  {figure.name:{width}}  {what:5}  {figure.text}")
    return "\n".join(lines)
