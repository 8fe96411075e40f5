"""What happens in an episode over time: bands of states, and panels of series, from its columns.

Each part takes the columns that it needs; what a dataset has not, is left out and can be told.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from xop_lerobot.core.state import FRAMES
from xop_lerobot.curate import quality
from xop_lerobot.curate.measures import (
    ACTION,
    ENGAGED,
    HEALTH,
    IDLE,
    TRACKED,
    Episode,
    Features,
    find_idle,
    find_morphology,
    has_column,
)
from xop_lerobot.curate.source import EpisodeEntry
from xop_lerobot.evaluation.metrics import compute_pose_errors, find_runs

POSE = 7
MOST_ENTRIES = 32
"""Entries of an action that are shown, where nothing tells which of them matter."""
_TOGETHER = 4
"""Entries of an action in a panel, where nothing tells their units."""
MOST_RUNS = 400
"""Runs of a band that are shown."""
_AXES = ("x", "y", "z")
_COST, _COMMAND, _STATE, _PINCH = (
    "retargeter.cost", "retargeter.command", "observation.state", "operator.pinch",
)  # fmt: skip
_MODE = "mode.pos"
_NUMBERS = r"(bool|u?int|float)"


class Series(NamedTuple):
    """A curve.

    Attributes:
        name: What the legend says.
        values: Its values; what is not finite is not known. Shape (n,).
        style: `goal` for what is wanted; empty for what is.
        colour: Curves of one colour belong together; its number.
    """

    name: str
    values: np.ndarray
    style: str = ""
    colour: int = 0


@dataclass(frozen=True)
class Panel:
    """A plot over the time of the episode.

    Attributes:
        title: What it shows.
        unit: Unit of its values.
        series: Its curves.
    """

    title: str
    unit: str
    series: tuple[Series, ...]


@dataclass(frozen=True)
class Band:
    """When something was the case.

    Attributes:
        name: What.
        kind: `good`, `bad` or `plain`.
        runs: First frame of each run, the one after its last, and a text.
    """

    name: str
    kind: str
    runs: tuple[tuple[int, int, str], ...]


class Part(NamedTuple):
    """A part of the timeline of an episode.

    Attributes:
        title: What it shows.
        needs: What a dataset without it has not, in words.
        find_columns: Finds the columns that it takes; none if it cannot be made.
        build: Builds it; returns bands or panels.
    """

    title: str
    needs: str
    find_columns: Callable[[Features, EpisodeEntry], Sequence[str]]
    build: Callable[[Episode], Sequence[Panel | Band]]


def _present(features: Features, *columns: tuple[str, int | None]) -> list[str]:
    return [
        name
        for name, size in columns
        if has_column(features, name, size) and re.match(_NUMBERS, features[name]["dtype"])
    ]


def _get_names(episode: Episode, column: str) -> list[str]:
    """Names of a column's entries, as far as there are entries; empty if it is not there."""
    if column not in episode.rows:
        return []
    return episode.get_names(column)[: episode.rows[column].shape[1]]


def _make_band(name: str, kind: str, flags: np.ndarray) -> Band:
    runs = [(int(first), int(last), "") for first, last in find_runs(np.asarray(flags, bool))]
    return Band(name, kind, tuple(runs[:MOST_RUNS]))


# States.


def _find_states(features: Features, entry: EpisodeEntry) -> list[str]:
    found = _present(
        features, (ENGAGED, 1), (TRACKED, len(FRAMES)), (ACTION, None), (HEALTH, None),
        ("next.success", 1),
    )  # fmt: skip
    return list(dict.fromkeys([*found, *(IDLE.find_columns(features, entry) or ())]))


def _build_states(episode: Episode) -> list[Band]:
    rows, bands = episode.rows, []
    if ENGAGED in rows:
        bands.append(_make_band("engaged", "good", rows[ENGAGED][:, 0]))
    action_names = _get_names(episode, ACTION)
    if _MODE in action_names:
        mode = rows[ACTION][:, action_names.index(_MODE)]
        bands.append(_make_band("mobile", "plain", mode > 0.5))
    if TRACKED in rows and ENGAGED in rows:
        for index, frame in enumerate(FRAMES):
            lost = quality.find_gaps(rows[TRACKED][:, index : index + 1], episode.engaged)
            bands.append(_make_band(f"{frame.replace('_', ' ')} lost", "bad", lost))
    names = _get_names(episode, HEALTH)
    if "status" in names:
        status = rows[HEALTH][:, names.index("status")]
        bands.append(_make_band("unsolved", "bad", (status != 0) & episode.engaged))
    wanted = IDLE.find_columns(episode.features, episode.entry)
    if wanted:
        held = {name: rows[name] for name in wanted}
        idle = find_idle(Episode(episode.entry, episode.features, held, episode.dt, episode.robot))
        bands.append(_make_band("idle", "plain", idle))
    if "next.success" in rows:
        bands.append(_make_band("success", "good", rows["next.success"][:, 0]))
    return [*bands, *_build_subtasks(episode)]


def _build_subtasks(episode: Episode) -> list[Band]:
    marks = episode.entry.facts.get("subtasks")
    runs = []
    for mark in marks if isinstance(marks, list) else []:
        match mark:
            case [str(name), int(first), int(last)]:
                runs.append((first, last, name))
    return [Band("sub-tasks", "plain", tuple(runs[:MOST_RUNS]))] if runs else []


# Poses.


def _mask(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    return np.where(known, np.asarray(values, float), np.nan)


def _find_operator(features: Features, entry: EpisodeEntry) -> list[str]:
    poses = _present(features, *((f"operator.{frame}", POSE) for frame in FRAMES))
    return poses and [*poses, *_present(features, (TRACKED, len(FRAMES)), (_PINCH, 2))]


def _build_operator(episode: Episode) -> list[Panel]:
    panels = []
    for index, frame in enumerate(FRAMES):
        pose = episode.rows.get(f"operator.{frame}")
        if pose is None:
            continue
        known = np.any(pose[:, 3:], axis=1)  # zeros are no pose
        if TRACKED in episode.rows:
            known = known & episode.rows[TRACKED][:, index].astype(bool)
        curves = [
            Series(axis, _mask(pose[:, place], known), colour=place)
            for place, axis in enumerate(_AXES)
        ]
        panels.append(Panel(f"operator's {frame.replace('_', ' ')}", "m", tuple(curves)))
    if _PINCH in episode.rows:
        pinch = episode.rows[_PINCH]
        curves = [Series(side, pinch[:, i], colour=i) for i, side in enumerate(("left", "right"))]
        panels.append(Panel("thumb to index", "m", tuple(curves)))
    return panels


def _list_frames(features: Features) -> list[str]:
    return [
        frame
        for frame in FRAMES
        if all(has_column(features, f"{kind}.{frame}", POSE) for kind in ("goal", "robot"))
    ]


def _find_goals(features: Features, entry: EpisodeEntry) -> list[str]:
    frames = _list_frames(features)
    return [f"{kind}.{frame}" for frame in frames for kind in ("goal", "robot")]


def _build_goals(episode: Episode) -> list[Panel]:
    panels, distances, angles = [], [], []
    for index, frame in enumerate(_list_frames(episode.features)):
        goal, robot = (
            np.asarray(episode.rows[f"{kind}.{frame}"], float) for kind in ("goal", "robot")
        )
        known = np.any(goal[:, 3:], axis=1) & np.all(np.isfinite(goal), axis=1)
        name = frame.replace("_", " ")
        curves = []
        for place, axis in enumerate(_AXES):
            curves += [
                Series(f"{axis} goal", _mask(goal[:, place], known), "goal", place),
                Series(axis, robot[:, place], colour=place),
            ]
        panels.append(Panel(name, "m", tuple(curves)))
        distance, angle = compute_pose_errors(robot, goal)
        distances.append(Series(name, _mask(distance, known), colour=index))
        angles.append(Series(name, _mask(angle, known), colour=index))
    return [
        Panel("distance from the goal", "m", tuple(distances)),
        Panel("angle from the goal", "rad", tuple(angles)),
        *panels,
    ]


# Command, cost, planner.


def _find_command(features: Features, entry: EpisodeEntry) -> list[str]:
    return [
        name
        for name in _present(features, (ACTION, None), (_COMMAND, None), (_STATE, None))
        if len(features[name]["shape"]) == 1
    ]


def _build_command(episode: Episode) -> list[Panel]:
    rows = episode.rows
    morphology = find_morphology(episode.robot)
    dims = () if morphology is None else morphology.command_space.dims
    names = {name: _get_names(episode, name) for name in rows}
    if ACTION in rows and dims and all(dim.key in names[ACTION] for dim in dims):
        by_unit: dict[str, list[Series]] = {}
        for dim in dims:
            curves = by_unit.setdefault(dim.unit, [])
            colour = len(curves) // 2
            if dim.name in names.get(_COMMAND, ()):
                wanted = rows[_COMMAND][:, names[_COMMAND].index(dim.name)]
                curves.append(Series(f"{dim.name} wanted", wanted, "goal", colour))
            executed = rows[ACTION][:, names[ACTION].index(dim.key)]
            curves.append(Series(dim.name, executed, colour=colour))
        return [Panel("", unit, tuple(curves)) for unit, curves in by_unit.items()]
    if ACTION not in rows:
        return []
    panels, count = [], min(rows[ACTION].shape[1], MOST_ENTRIES)
    for first in range(0, count, _TOGETHER):
        curves = []
        for colour, place in enumerate(range(first, min(first + _TOGETHER, count))):
            known = place < len(names[ACTION])
            name = names[ACTION][place] if known else f"action {place}"
            curves.append(Series(f"{name} wanted", rows[ACTION][:, place], "goal", colour))
            if known and name in names.get(_STATE, ()):
                state = rows[_STATE][:, names[_STATE].index(name)]
                curves.append(Series(name, state, colour=colour))
        panels.append(Panel("", "", tuple(curves)))
    return panels


def _find_cost(features: Features, entry: EpisodeEntry) -> list[str]:
    return _present(features, (_COST, None))


def _build_cost(episode: Episode) -> list[Panel]:
    rows, names = episode.rows[_COST], _get_names(episode, _COST)
    # A term that a retargeter does not have is 0 throughout.
    places = [i for i, name in enumerate(names) if rows[:, i].any()]
    known = np.any(rows, axis=1)  # before engaging there is no plan
    curves = [
        Series(names[place], _mask(rows[:, place], known), colour=number)
        for number, place in enumerate(places)
    ]
    return [Panel("cost of the plan by term", "", tuple(curves))] if curves else []


_PLAN = (
    ("plan age and solve time", "s", ("plan_age", "solve_time")),
    ("effective samples", "", ("effective_samples",)),
    ("residual of the state synchronisation", "m", ("sync_residual",)),
    ("risk of a fall or a collision", "", ("risk",)),
)


def _find_plan(features: Features, entry: EpisodeEntry) -> list[str]:
    return _present(features, (HEALTH, None))


def _build_plan(episode: Episode) -> list[Panel]:
    rows, names = episode.rows[HEALTH], _get_names(episode, HEALTH)
    panels = []
    for title, unit, wanted in _PLAN:
        curves = [
            Series(name.replace("_", " "), rows[:, names.index(name)], colour=number)
            for number, name in enumerate(wanted)
            if name in names
        ]
        if any(curve.values.any() for curve in curves):
            panels.append(Panel(title, unit, tuple(curves)))
    return panels


PARTS = (
    Part("States", "operator, mode or idle time", _find_states, _build_states),
    Part("Goal and robot", "goal.* beside robot.*", _find_goals, _build_goals),
    Part("Command", "action", _find_command, _build_command),
    Part("Cost by term", "retargeter.cost", _find_cost, _build_cost),
    Part("Planner", "retargeter.health", _find_plan, _build_plan),
    Part("Operator", "operator.head, …", _find_operator, _build_operator),
)
"""All parts, in their order on a page."""


def list_missing(features: Features) -> list[str]:
    """List the parts that cannot be made of a dataset's columns, with what it lacks."""
    entry = EpisodeEntry(0, 0, (), {}, Path())
    return [
        f"{part.title.lower()} (no {part.needs})"
        for part in PARTS
        if not part.find_columns(features, entry)
    ]


def describe_changes(entry: EpisodeEntry, fps: float) -> list[dict[str, Any]]:
    """List what was changed in the course of an episode: time from its beginning [s], and text."""
    changes = entry.facts.get("changes")
    found = []
    for change in changes if isinstance(changes, list) else []:
        match change:
            case {"frame": int(frame), "change": what}:
                if isinstance(what, dict):
                    what = ", ".join(f"{name} {value}" for name, value in what.items())
                found.append({"t": round(frame / fps, 3), "text": str(what)[:300]})
    return found[:MOST_RUNS]


_STEPS = 65534
"""Steps from the lowest to the highest value; one more stands for none."""
_NONE = 65535


def thin(values: np.ndarray, points: int) -> np.ndarray:
    """Thin a series out, and keep its peaks.

    A series that is too long is cut into `points // 2` pieces of equal length, and of each remain
    its lowest and its highest value, in their order.

    Args:
        values: One or more series. Shape (n,) or (n, k).
        points: How many values may be left; at least 2.

    Returns:
        The series. Shape (m,) or (m, k), m = min(n, points - points % 2).
    """
    count = len(values)
    if count <= points - points % 2:
        return values
    flat = np.asarray(values, float).reshape(count, -1)
    edges = np.linspace(0, count, points // 2 + 1).astype(int)
    out = np.empty((2 * (len(edges) - 1), flat.shape[1]))
    places = np.arange(flat.shape[1])
    for index, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        piece = flat[first:last]
        known = np.isfinite(piece)
        low = np.where(known, piece, np.inf).argmin(axis=0)
        high = np.where(known, piece, -np.inf).argmax(axis=0)
        out[2 * index] = piece[np.minimum(low, high), places]
        out[2 * index + 1] = piece[np.maximum(low, high), places]
    return out.reshape(len(out), *values.shape[1:])


def encode(values: np.ndarray) -> dict[str, Any]:
    """Write a series as base64 of 16 bits a value, between its lowest and highest one.

    Args:
        values: The series; what is not finite is written as none. Shape (n,).

    Returns:
        `lo`, `hi` and `data`: little-endian numbers q for lo + (hi - lo) q / 65534; 65535 is none.
    """
    values = np.asarray(values, float)
    known = np.isfinite(values)
    low, high = (
        (float(f"{values[known].min():.7g}"), float(f"{values[known].max():.7g}"))
        if known.any()
        else (0.0, 0.0)
    )
    scale = _STEPS / (high - low) if high > low else 0.0
    if not np.isfinite(scale):
        scale = 0.0
    steps = np.full(len(values), _NONE, "<u2")
    steps[known] = np.clip(np.round((values[known] - low) * scale), 0, _STEPS)
    return {"lo": low, "hi": high, "data": base64.b64encode(steps.tobytes()).decode()}


def decode(series: dict[str, Any]) -> np.ndarray:
    """Read what `encode` wrote, as a page does. Shape (n,)."""
    steps = np.frombuffer(base64.b64decode(series["data"]), "<u2").astype(float)
    values = series["lo"] + (series["hi"] - series["lo"]) * steps / _STEPS
    return np.where(steps == _NONE, np.nan, values)
