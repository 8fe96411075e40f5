"""Metrics of a recorded episode: definitions, required columns, and computation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.state import FRAMES
from xop_lerobot.curate import quality
from xop_lerobot.curate.entries import EpisodeEntry
from xop_lerobot.curate.expression import Kind
from xop_lerobot.evaluation.metrics import (
    compute_falls,
    compute_jerk,
    compute_pose_errors,
    compute_roughness,
    summarise_errors,
)
from xop_lerobot.morphology.morphology import Morphology, make_morphology

_FLAG, _NUMBER, _TEXT = Kind.FLAG, Kind.NUMBER, Kind.TEXT


class Figure(NamedTuple):
    """A metric.

    Attributes:
        name: Name in expressions and JSON.
        kind: Type of its value.
        unit: Unit; empty for flags, texts, counts and ratios.
        text: Description.
    """

    name: str
    kind: Kind
    unit: str
    text: str


def _make_tracking(prefix: str, of: str) -> list[Figure]:
    return [
        Figure(
            f"{prefix}_mean", _NUMBER, "m", f"mean distance of {of} from the goal while engaged"
        ),
        Figure(f"{prefix}_p95", _NUMBER, "m", "95th percentile of it"),
        Figure(f"{prefix}_angle_mean", _NUMBER, "rad", f"mean angle of {of} from the goal"),
        Figure(f"{prefix}_angle_p95", _NUMBER, "rad", "95th percentile of it"),
    ]


_ALL = [
    Figure("episode", _NUMBER, "", "index of the episode"),
    Figure("length", _NUMBER, "", "number of frames"),
    Figure("duration", _NUMBER, "s", "duration, frames over fps"),
    Figure("robot", _TEXT, "", "LeRobot's robot type"),
    Figure("task", _TEXT, "", "task description; several joined by ' | '"),
    Figure("success", _FLAG, "", "the task was accomplished in the last frame"),
    Figure("fall", _FLAG, "", "the robot fell"),
    Figure("collision", _FLAG, "", "it touched itself, or anything but the ground"),
    Figure("trouble", _FLAG, "", "it moved though it should stand, or gave way"),
    Figure("finished", _FLAG, "", "the operator's recording or script had played out"),
    Figure("engaged_time", _NUMBER, "s", "time in which the operator was engaged"),
    *_make_tracking("tracking", "head and wrists, pooled,"),
    *(each for frame in FRAMES for each in _make_tracking(f"tracking_{frame}", frame)),
    Figure("command_roughness", _NUMBER, "1/s²", "RMS second difference over half the range"),
    Figure("command_ldlj", _NUMBER, "", "log dimensionless jerk of commands, higher is smoother"),
    Figure("hand_jerk", _NUMBER, "m/s³", "mean jerk of the robot's wrists"),
    Figure("gaps", _NUMBER, "", "number of tracking losses after the first engagement"),
    Figure("gap_time", _NUMBER, "s", "their total duration"),
    Figure("gap_max", _NUMBER, "s", "duration of the longest"),
    Figure("late", _FLAG, "", "a real-time episode ran at less than 95 % of its rate"),
    Figure("late_frames", _NUMBER, "", "frames later than 1.5 periods (real-time clock only)"),
    Figure("missing_frames", _NUMBER, "", "frames missing by the robot's clock"),
    Figure("dropped_frames", _NUMBER, "", "images that the video encoder dropped"),
    Figure("real_fps", _NUMBER, "Hz", "frames per second of the host clock"),
    Figure("plan_age_mean", _NUMBER, "s", "mean age of the current plan while engaged"),
    Figure("plan_age_p95", _NUMBER, "s", "95th percentile of it"),
    Figure("plan_age_max", _NUMBER, "s", "maximum"),
    Figure("solve_time_p95", _NUMBER, "s", "95th percentile of the planning time"),
    Figure("unsolved", _NUMBER, "", "engaged frames without a new solution"),
    Figure("idle_start", _NUMBER, "s", "idle time before the first motion"),
    Figure("idle_end", _NUMBER, "s", "idle time after the last motion"),
    Figure("idle_time", _NUMBER, "s", "total idle time"),
    Figure("clock", _TEXT, "", "lockstep or realtime"),
    Figure("scene", _TEXT, "", "scene of the simulation"),
    Figure("low_level", _TEXT, "", "low-level policy"),
    Figure("preset", _TEXT, "", "preset of the retargeter at the start"),
    Figure("seed", _NUMBER, "", "seed of the session"),
    Figure("start_time", _NUMBER, "s", "host clock at the first frame, since 1970"),
    Figure("readable", _FLAG, "", "its rows and videos are complete and match the metadata"),
]

FIGURES = {figure.name: figure for figure in _ALL}
"""Every metric by name, in output order."""
KINDS = {figure.name: figure.kind for figure in _ALL}
"""Type of each metric, for an `Expression`."""


def describe_figures() -> str:
    """List the metrics, one per line, for `--help`."""
    width = max(map(len, FIGURES))
    lines = []
    for figure in FIGURES.values():
        what = figure.unit or {_FLAG: "flag", _TEXT: "text"}.get(figure.kind, "")
        lines.append(f"  {figure.name:{width}}  {what:5}  {figure.text}")
    return "\n".join(lines)


type Features = Mapping[str, Mapping[str, Any]]
type Values = Mapping[str, float | int | bool | None]

ENGAGED, TRACKED, ACTION, HEALTH = (
    "operator.engaged",
    "operator.tracked",
    "action",
    "retargeter.health",
)
BASE = "robot.base_pose"
_STILL_SHARE = 0.02
"""Share of its range within which an action entry counts as stationary, without pose columns."""
_ROBOT_PREFIX = "xop_"
_POSE_SIZE = 7


@dataclass(frozen=True)
class Episode:
    """Input of a measure.

    Attributes:
        entry: The episode's metadata.
        features: Features of the dataset.
        rows: The columns that the measure needs. Shapes (n, size).
        dt: Time between frames [s].
        robot: LeRobot's robot type, None if unknown.
    """

    entry: EpisodeEntry
    features: Features
    rows: Mapping[str, np.ndarray]
    dt: float
    robot: str | None

    @property
    def engaged(self) -> np.ndarray:
        """Whether the operator drove; all True without that column. Shape (n,), bool."""
        if ENGAGED in self.rows:
            return self.rows[ENGAGED][:, 0].astype(bool)
        return np.ones(self.entry.length, bool)

    def get_names(self, column: str) -> list[str]:
        """Return the names of a column's entries; empty if it has none."""
        names = self.features[column].get("names")
        return [str(name) for name in names] if isinstance(names, list) else []


class Measure(NamedTuple):
    """Metrics computed from the same columns.

    Attributes:
        figures: Names of the metrics.
        find_columns: Returns the columns it needs; None if they are missing.
        compute: Computes the metrics.
    """

    figures: tuple[str, ...]
    find_columns: Callable[[Features, EpisodeEntry], tuple[str, ...] | None]
    compute: Callable[[Episode], Values]


def find_morphology(robot: str | None) -> Morphology | None:
    """Return the morphology of a robot type; None for robots of other projects."""
    try:
        return _make_morphology((robot or "").removeprefix(_ROBOT_PREFIX))
    except UnknownName:
        return None


@cache
def _make_morphology(name: str) -> Morphology:
    return make_morphology(name)


def has_column(features: Features, name: str, size: int | None = None) -> bool:
    """Whether there is a numeric or boolean column, of `size` entries if given."""
    feature = features.get(name)
    if feature is None or feature["dtype"] in ("video", "image", "string"):
        return False
    return size is None or list(feature["shape"]) == [size]


def _need(*columns: str) -> Callable[[Features, EpisodeEntry], tuple[str, ...] | None]:
    def find(features: Features, entry: EpisodeEntry) -> tuple[str, ...] | None:
        return columns if all(has_column(features, column) for column in columns) else None

    return find


def _with_engaged(features: Features, columns: list[str]) -> tuple[str, ...] | None:
    if not columns:
        return None
    return (*columns, ENGAGED) if has_column(features, ENGAGED, 1) else tuple(columns)


# Outcome, from the episode metadata or else from rows.


def _find_success(features: Features, entry: EpisodeEntry) -> tuple[str, ...] | None:
    if isinstance(entry.facts.get("success"), bool):
        return ()
    return ("next.success",) if has_column(features, "next.success", 1) else None


def _compute_success(episode: Episode) -> Values:
    if "next.success" not in episode.rows:
        return {"success": episode.entry.facts["success"]}
    column = episode.rows["next.success"]
    return {"success": bool(column[-1, 0]) if len(column) else None}


def _find_fall(features: Features, entry: EpisodeEntry) -> tuple[str, ...] | None:
    if isinstance(entry.facts.get("fallen"), bool):
        return ()
    return (BASE,) if has_column(features, BASE, _POSE_SIZE) else None


def _compute_fall(episode: Episode) -> Values:
    if BASE not in episode.rows:
        return {"fall": episode.entry.facts["fallen"]}
    morphology = find_morphology(episode.robot)
    if morphology is None:
        return {"fall": None}
    limits = (morphology.fall_height, morphology.fall_tilt)
    return {"fall": compute_falls(episode.rows[BASE], *limits) > 0}


def _find_trouble(features: Features, entry: EpisodeEntry) -> tuple[str, ...] | None:
    return () if isinstance(entry.facts.get("changes"), list) else None


def _compute_trouble(episode: Episode) -> Values:
    changes = (each.get("change") for each in episode.entry.facts["changes"])
    return {"trouble": any(isinstance(each, dict) and "trouble" in each for each in changes)}


# Tracking, smoothness.


def _list_pairs(features: Features) -> list[str]:
    return [
        frame
        for frame in FRAMES
        if all(has_column(features, f"{kind}.{frame}", _POSE_SIZE) for kind in ("goal", "robot"))
    ]


def _find_tracking(features: Features, entry: EpisodeEntry) -> tuple[str, ...] | None:
    pairs = _list_pairs(features)
    return _with_engaged(
        features, [f"{kind}.{frame}" for frame in pairs for kind in ("goal", "robot")]
    )


def _compute_tracking(episode: Episode) -> Values:
    values: dict[str, float] = {}
    chosen, errors = episode.engaged, {}
    for frame in _list_pairs(episode.features):
        goal, pose = (
            np.asarray(episode.rows[f"{kind}.{frame}"], float) for kind in ("goal", "robot")
        )
        # A goal of zeros is a missing goal: its quaternion has no length.
        chosen = chosen & np.isfinite(goal).all(axis=1) & goal[:, 3:].any(axis=1)
        errors[frame] = compute_pose_errors(pose, goal)
    groups = {"tracking": list(errors.values())}
    groups |= {f"tracking_{frame}": [each] for frame, each in errors.items()}
    for prefix, pairs in groups.items():
        figures = summarise_errors(pairs, chosen)
        values |= {f"{prefix}_{name}": value for name, value in figures._asdict().items()}
    return values


def _find_command(features: Features, entry: EpisodeEntry) -> tuple[str, ...] | None:
    shape = features[ACTION]["shape"] if has_column(features, ACTION) else []
    return _with_engaged(features, [ACTION] if len(shape) == 1 else [])


def _compute_command(episode: Episode) -> Values:
    action, engaged = np.asarray(episode.rows[ACTION], float), episode.engaged
    morphology, names = find_morphology(episode.robot), episode.get_names(ACTION)
    roughness = quality.NEVER
    dims = [] if morphology is None else morphology.command_space.dims
    if dims and all(dim.key in names for dim in dims):
        command = action[:, [names.index(dim.key) for dim in dims]]
        half = np.array([(dim.high - dim.low) / 2 for dim in dims])
        command = command / half
        roughness = compute_roughness(command[engaged], np.ones(len(dims)), episode.dt)
    else:
        command = _scale(action)
    smoothness = quality.compute_ldlj(command, episode.dt, engaged)
    return {"command_roughness": roughness, "command_ldlj": smoothness}


def _scale(action: np.ndarray) -> np.ndarray:
    """Scale each entry by its range in the episode; constant entries are left out."""
    if not len(action):
        return action
    spread = np.ptp(action, axis=0)
    return action[:, spread > 0] / spread[spread > 0]


def _find_hands(features: Features, entry: EpisodeEntry) -> tuple[str, ...] | None:
    hands = [
        f"robot.{name}" for name in FRAMES[1:] if has_column(features, f"robot.{name}", _POSE_SIZE)
    ]
    return _with_engaged(features, hands)


def _compute_hands(episode: Episode) -> Values:
    hands = [rows for key, rows in episode.rows.items() if key != ENGAGED]
    jerks = [
        compute_jerk(np.asarray(hand[:, :3], float), episode.dt, episode.engaged) for hand in hands
    ]
    return {"hand_jerk": float(np.mean(jerks))}


# Device, clocks, planner.


def _compute_engaged(episode: Episode) -> Values:
    return {"engaged_time": float(episode.engaged.sum() * episode.dt)}


def _compute_gaps(episode: Episode) -> Values:
    if not episode.engaged.any():  # gaps are counted from the first engagement on
        return {"gaps": None, "gap_time": None, "gap_max": None}
    gaps = quality.find_gaps(episode.rows[TRACKED], episode.engaged)
    count, total, longest = quality.summarise_gaps(gaps, episode.dt)
    return {"gaps": count, "gap_time": total, "gap_max": longest}


def _find_late(features: Features, entry: EpisodeEntry) -> tuple[str, ...] | None:
    # In lock-step the host clock is irrelevant: a frame takes as long as its computation.
    is_realtime = entry.facts.get("clock") == "realtime"
    return ("time.wall",) if is_realtime and has_column(features, "time.wall", 1) else None


def _compute_late(episode: Episode) -> Values:
    stamps = episode.rows["time.wall"][:, 0]
    seconds = (stamps - stamps[:1]) * 1e-9
    return {"late_frames": quality.count_late(seconds, episode.dt)}


def _compute_missing(episode: Episode) -> Values:
    stamps = np.asarray(episode.rows["time.sim"][:, 0], float)
    return {"missing_frames": quality.count_missing(stamps, episode.dt)}


def _compute_plan(episode: Episode) -> Values:
    names, engaged = episode.get_names(HEALTH), episode.engaged
    health = np.asarray(episode.rows[HEALTH], float)[engaged]
    columns = {name: health[:, names.index(name)] for name in names[: health.shape[1]]}
    values: dict[str, float | None] = {}
    if "plan_age" in columns:
        spread = quality.summarise_spread(columns["plan_age"])
        values |= {f"plan_age_{name}": value for name, value in spread._asdict().items()}
    if "solve_time" in columns:
        values["solve_time_p95"] = quality.summarise_spread(columns["solve_time"]).p95
    if "status" in columns:
        values["unsolved"] = int((columns["status"] != 0).sum()) if engaged.any() else None
    return values


def _find_idle(features: Features, entry: EpisodeEntry) -> tuple[str, ...] | None:
    poses = (
        [f"operator.{frame}" for frame in FRAMES] + [BASE] + [f"robot.{name}" for name in FRAMES]
    )
    if all(has_column(features, name, _POSE_SIZE) for name in poses):
        return _with_engaged(features, poses)
    return _find_command(features, entry)


def find_idle(episode: Episode, limit: float = quality.STILL_LIMIT_M) -> np.ndarray:
    """Find the idle frames by the poses of operator and robot, else by the action. Shape (n,).

    If nobody engaged, a policy drove, and only the motion counts.

    Args:
        episode: The episode, with the columns of `IDLE`.
        limit: Largest motion of a stationary pose's points [m].
    """
    engaged = episode.engaged if episode.engaged.any() else ~episode.engaged
    if ACTION in episode.rows:
        still = quality.find_still(_scale(episode.rows[ACTION]), episode.dt, _STILL_SHARE)
        return still | ~engaged
    poses = [rows for key, rows in episode.rows.items() if key != ENGAGED]
    # Zeros are no pose: not tracked, or not yet.
    known = [pose for pose in poses if pose[:, 3:].any(axis=1).all()]
    return quality.find_idle(known, engaged, episode.dt, limit)


def _compute_idle(episode: Episode) -> Values:
    idle = find_idle(episode)
    first, last = quality.find_active_span(idle)
    return {
        "idle_start": first * episode.dt,
        "idle_end": (len(idle) - last) * episode.dt,
        "idle_time": float(idle.sum() * episode.dt),
    }


IDLE = Measure(("idle_start", "idle_end", "idle_time"), _find_idle, _compute_idle)
"""Idle time; its `find_columns` names what `find_idle` needs."""

MEASURES = (
    Measure(("success",), _find_success, _compute_success),
    Measure(("fall",), _find_fall, _compute_fall),
    Measure(("trouble",), _find_trouble, _compute_trouble),
    Measure(("engaged_time",), _need(ENGAGED), _compute_engaged),
    Measure(
        tuple(name for name in FIGURES if name.startswith("tracking_")),
        _find_tracking,
        _compute_tracking,
    ),
    Measure(("command_roughness", "command_ldlj"), _find_command, _compute_command),
    Measure(("hand_jerk",), _find_hands, _compute_hands),
    Measure(("gaps", "gap_time", "gap_max"), _need(TRACKED, ENGAGED), _compute_gaps),
    Measure(("late_frames",), _find_late, _compute_late),
    Measure(("missing_frames",), _need("time.sim"), _compute_missing),
    Measure(
        ("plan_age_mean", "plan_age_p95", "plan_age_max", "solve_time_p95", "unsolved"),
        _need(HEALTH, ENGAGED),
        _compute_plan,
    ),
    IDLE,
)
"""All measures."""
