"""Scripted operator: timed waypoints of head and wrists, read from a small YAML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import XopError
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import compute_minimum_jerk, interpolate_poses, quat_from_rpy
from xop_lerobot.core.yaml_words import load_yaml
from xop_lerobot.operator.recording import FARTHEST_M, describe_distance

SCRIPTS = Path(__file__).parent / "scripts"
"""Folder of the built-in scripts."""
OPEN_PINCH = 0.08
"""Distance of thumb and index tip of an open hand [m]."""
CLOSED_PINCH = 0.008
"""Distance of thumb and index tip in a scripted pinch [m]."""
HANDS = ("left", "right")
WRISTS_IN = ("world", "body")
KEYS = (
    "description", "duration", "wrists_in", *FRAMES, "double_pinches", "pinch", "modes",
)  # fmt: skip
WAYPOINT_KEYS = ("t", "position", "rpy_deg", "quat")
# A double pinch: closing, holding and opening each take TAP_S; the second starts at SECOND_TAP_S.
TAP_S = 0.08
SECOND_TAP_S = 0.36


class BadScript(XopError, ValueError):
    """An operator script is missing or malformed; the message names file, place and fault."""

    def __init__(self, path: object, fault: str) -> None:
        super().__init__(f"operator script '{path}': {fault}")


@dataclass(frozen=True)
class Track:
    """Waypoints with zero velocity, connected by minimum-jerk movements.

    Attributes:
        times: Times [s], increasing. Shape (K,).
        values: Poses (K, 7), or numbers (K, n) that are interpolated individually.
    """

    times: np.ndarray
    values: np.ndarray

    def at(self, time: float) -> np.ndarray:
        """Value at `time` [s]; the outermost waypoints are held. Shape (7,) or (n,)."""
        i = int(np.searchsorted(self.times, time, side="right")) - 1
        if i < 0 or i + 1 >= len(self.times):
            return self.values[0 if i < 0 else -1].copy()
        u = compute_minimum_jerk((time - self.times[i]) / (self.times[i + 1] - self.times[i]))
        start, end = self.values[i], self.values[i + 1]
        if len(start) == 7:  # a pose
            return interpolate_poses(start, end, u)
        return (1 - u) * start + u * end


@dataclass(frozen=True)
class Script:
    """Content of an operator script.

    Attributes:
        duration: Duration [s].
        tracks: Head and wrists by name.
        wrists_in_body: Whether wrists are relative to the head, along its heading, instead of in
            the operator's world.
        pinch: Distances of thumb and index tip, left and right [m].
        double_pinches: Time [s] and hand (0 left, 1 right) of each.
        modes: Time [s] and mode of each change stated by the script.
    """

    duration: float
    tracks: Mapping[str, Track]
    wrists_in_body: bool
    pinch: Track
    double_pinches: tuple[tuple[float, int], ...]
    modes: tuple[tuple[float, Mode], ...]

    def pinch_at(self, time: float) -> np.ndarray:
        """Distance of thumb and index tip, left and right [m]. Shape (2,)."""
        distance = self.pinch.at(time)
        for start, hand in self.double_pinches:
            for tap in (start, start + SECOND_TAP_S):
                rise = compute_minimum_jerk((time - tap) / TAP_S)
                fall = compute_minimum_jerk((time - tap) / TAP_S - 2)
                closing = rise - fall
                distance[hand] += closing * (min(CLOSED_PINCH, distance[hand]) - distance[hand])
        return distance

    def mode_at(self, time: float) -> Mode | None:
        """Mode stated by the script at `time` [s], None before the first."""
        return next((mode for start, mode in reversed(self.modes) if time >= start), None)


def list_scripts() -> list[str]:
    """Return the names of the built-in scripts."""
    return sorted(path.stem for path in SCRIPTS.glob("*.yaml"))


def load_script(name: str) -> Script:
    """Read a script.

    Args:
        name: Path of a YAML file, or name of a built-in script.

    Raises:
        BadScript: If there is no such script, or it is malformed.
    """
    import yaml  # noqa: PLC0415 only scripts need it

    path = Path(name).expanduser()
    if not path.is_file() and name in list_scripts():
        path = SCRIPTS / f"{name}.yaml"
    if not path.is_file():
        choices = ", ".join(list_scripts())
        raise BadScript(name, f"there is no such file. Built-in scripts: {choices}")
    try:
        content = load_yaml(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        fault = " ".join(str(error).split())
        raise BadScript(path, f"it is not readable YAML ({fault})") from error
    return make_script(content, path)


def make_script(content: object, source: object = "(inline)") -> Script:
    """Validate the content of a script and make it.

    Raises:
        BadScript: Naming the first fault and its place.
    """
    reader = _Reader(source)
    table = reader.table("the script", content, KEYS, required=FRAMES)
    tracks = {name: reader.poses(name, table[name]) for name in FRAMES}
    last = max(float(track.times[-1]) for track in tracks.values())
    duration = reader.number("duration", table.get("duration", last))
    if duration < last or duration <= 0:
        raise BadScript(
            source, f"duration must be above 0 and at least the last waypoint's {last:g} s, "
            f"got {duration:g}"
        )  # fmt: skip
    wrists_in = reader.choice("wrists_in", table.get("wrists_in", "world"), WRISTS_IN)
    return Script(
        duration=duration,
        tracks=tracks,
        wrists_in_body=wrists_in == "body",
        pinch=reader.pinches(table.get("pinch", [{"t": 0}])),
        double_pinches=reader.double_pinches(table.get("double_pinches", [])),
        modes=reader.modes(table.get("modes", [])),
    )


class _Reader:
    """Reads and validates values; every error names the script and the place."""

    def __init__(self, source: object) -> None:
        self.source = source

    def table(
        self, place: str, value: object, keys: Sequence[str], required: Sequence[str]
    ) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise BadScript(self.source, f"{place} must be a mapping, got {value!r}")
        for key in value:
            if key not in keys:
                known = ", ".join(keys)
                raise BadScript(self.source, f"unknown key {key!r} in {place}. Known: {known}")
        missing = [key for key in required if key not in value]
        if missing:
            raise BadScript(self.source, f"{place} lacks {', '.join(missing)}")
        return value

    def rows(
        self, place: str, value: object, keys: Sequence[str], required: Sequence[str]
    ) -> list[tuple[str, float, dict[str, Any]]]:
        """Return place, time and content of each row of a list, times increasing."""
        if not isinstance(value, list):
            raise BadScript(self.source, f"{place} must be a list, got {value!r}")
        rows: list[tuple[str, float, dict[str, Any]]] = []
        for i, item in enumerate(value):
            here = f"{place}[{i}]"
            row = self.table(here, item, keys, required)
            time = self.number(f"{here}.t", row["t"])
            if time < 0 or (rows and time <= rows[-1][1]):
                before = f"after {rows[-1][1]:g}" if rows else "at least 0"
                raise BadScript(self.source, f"{here}.t must be {before} s, got {time:g}")
            rows.append((here, time, row))
        return rows

    def number(self, place: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise BadScript(self.source, f"{place} must be a finite number, got {value!r}")
        return float(value)

    def vector(self, place: str, value: object, size: int) -> np.ndarray:
        if not isinstance(value, list) or len(value) != size:
            raise BadScript(self.source, f"{place} must be a list of {size} numbers, got {value!r}")
        return np.array([self.number(f"{place}[{i}]", item) for i, item in enumerate(value)])

    def choice(self, place: str, value: object, choices: Sequence[str]) -> str:
        if value not in choices:
            raise BadScript(
                self.source, f"{place} must be one of {', '.join(choices)}, got {value!r}"
            )
        return str(value)

    def poses(self, name: str, value: object) -> Track:
        """Read waypoints; omitted values are those of the previous one."""
        rows = self.rows(name, value, WAYPOINT_KEYS, required=("t",))
        if not rows or "position" not in rows[0][2]:
            raise BadScript(self.source, f"{name} must start with a waypoint that has a position")
        position, quat = np.zeros(3), np.array([1.0, 0, 0, 0])
        poses = []
        for here, _, row in rows:
            if "position" in row:
                position = self.vector(f"{here}.position", row["position"], 3)
            if "rpy_deg" in row and "quat" in row:
                raise BadScript(self.source, f"{here} has both rpy_deg and quat; give one")
            if "rpy_deg" in row:
                quat = quat_from_rpy(*np.radians(self.vector(f"{here}.rpy_deg", row["rpy_deg"], 3)))
            if "quat" in row:
                quat = self.vector(f"{here}.quat", row["quat"], 4)
                norm = float(np.linalg.norm(quat))
                if abs(norm - 1) > 1e-3:
                    raise BadScript(
                        self.source, f"{here}.quat (qw qx qy qz) must have norm 1, got {norm:g}"
                    )
                quat = quat / norm
            farthest = float(np.abs(position).max())
            if farthest > FARTHEST_M:
                raise BadScript(self.source, describe_distance(f"{here}.position", farthest))
            poses.append(np.concatenate([position, quat]))
        return Track(np.array([time for _, time, _ in rows]), np.array(poses))

    def pinches(self, value: object) -> Track:
        rows = self.rows("pinch", value, ("t", *HANDS), required=("t",))
        distance = np.full(2, OPEN_PINCH)
        times, values = [0.0], [distance]
        for here, time, row in rows:
            distance = distance.copy()
            for hand, side in enumerate(HANDS):
                if side in row:
                    distance[hand] = self.number(f"{here}.{side}", row[side])
            if (distance < 0).any():
                raise BadScript(self.source, f"{here} must not be negative, got {distance.min():g}")
            if time == 0:
                times, values = [], []
            times.append(time)
            values.append(distance)
        return Track(np.array(times), np.array(values))

    def double_pinches(self, value: object) -> tuple[tuple[float, int], ...]:
        rows = self.rows("double_pinches", value, ("t", "hand"), required=("t",))
        return tuple(
            (time, HANDS.index(self.choice(f"{here}.hand", row.get("hand", "left"), HANDS)))
            for here, time, row in rows
        )

    def modes(self, value: object) -> tuple[tuple[float, Mode], ...]:
        names = [mode.name.lower() for mode in Mode]
        return tuple(
            (time, Mode[self.choice(f"{here}.mode", row["mode"], names).upper()])
            for here, time, row in self.rows("modes", value, ("t", "mode"), ("t", "mode"))
        )
