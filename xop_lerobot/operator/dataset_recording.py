"""Operator columns of a recorded LeRobot dataset, read as an operator recording.

Recordings of hardware are less regular than simulated ones: tracking drops out, the person
disengages and engages again, and clocks jitter. All of that is replayed.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from xop_lerobot.core.command import MODE_KEY
from xop_lerobot.core.errors import BadRecording
from xop_lerobot.core.state import FRAMES
from xop_lerobot.core.transforms import IDENTITY_POSE
from xop_lerobot.operator.recording import (
    MIN_SAMPLES,
    NORM_TOLERANCE,
    Recording,
    make_recording,
)
from xop_lerobot.operator.row_clock import RowClock, read_row_clock

logger = logging.getLogger(__name__)

POSE_COLUMNS = tuple(f"operator.{frame}" for frame in FRAMES)
COLUMNS = {**dict.fromkeys(POSE_COLUMNS, 7), "operator.pinch": 2, "operator.tracked": 3}
"""Required columns, and the size of their rows."""
ENGAGED_COLUMN = "operator.engaged"
CLOCKS = {"time.sim": 1.0, "time.wall": 1e-9, "timestamp": 1.0}
"""Time columns in order of preference, with seconds per unit. For a robot without a clock of its
own the first stands still."""
OPTIONAL_COLUMNS = (ENGAGED_COLUMN, "action", *CLOCKS)
_MOST = 0.9
"""Share of the rows at which a clock must advance, not counting adjustments, to be used."""
_MOVED_M = 0.15
"""Largest plausible motion of head or wrist between two rows [m]."""
_FAR_OFF = 100.0
"""Factor from the dataset's rate beyond which a clock must be in other units."""


def is_dataset(path: str | Path) -> bool:
    """Whether `path` is the directory of a LeRobot dataset."""
    return (Path(path) / "meta" / "info.json").is_file()


def load_dataset_recording(root: str | Path, episode: int = 0) -> Recording:
    """Read the operator's motion in one episode, from the first engagement.

    The mode is that of the recorded action (`mode.pos`), so that the same motion drives another
    robot in the same modes.

    Args:
        root: Directory of the dataset.
        episode: Index of the episode.

    Raises:
        BadRecording: If the dataset lacks operator columns or the episode, or has bad data.
    """
    root = Path(root)
    info = _read_info(root)
    features = info["features"]
    wanted = choose_columns(root, features)
    arrays = _read_episode(root, wanted, episode, info)
    fps = info.get("fps")
    fps = fps if isinstance(fps, int | float) and not isinstance(fps, bool) else None
    return make_dataset_recording(arrays, features, f"{root} (episode {episode})", fps)[0]


def choose_columns(root: object, features: Mapping[str, Any]) -> list[str]:
    """Return the columns to read for a recording.

    Args:
        root: The dataset, for messages.
        features: Its features.

    Raises:
        BadRecording: If a required column is missing or malformed.
    """
    missing = [column for column in COLUMNS if column not in features]
    if missing:
        raise BadRecording(
            root,
            f"the dataset has no column {', '.join(missing)}. Its columns: "
            f"{', '.join(sorted(features))}",
        )
    for column, size in COLUMNS.items():
        feature = features[column]
        shape = list(feature.get("shape") or ())
        if shape != [size] or not _holds_numbers(feature):
            raise BadRecording(
                root,
                f"column {column} must hold {size} numbers a row, it holds "
                f"{feature.get('dtype')} of shape {shape}",
            )
    able = (column for column in OPTIONAL_COLUMNS if column in features)
    return [*COLUMNS, *(column for column in able if _holds_numbers(features[column]))]


def _holds_numbers(feature: Mapping[str, Any]) -> bool:
    return str(feature.get("dtype")).startswith(("float", "int", "uint", "bool"))


def make_dataset_recording(
    columns: Mapping[str, np.ndarray],
    features: Mapping[str, Any],
    source: object,
    fps: float | None = None,
) -> tuple[Recording, np.ndarray]:
    """Make a recording from the columns of an episode.

    It spans the first to the last engaged row. Rows at which the clock stands still are left out,
    and its adjustments are removed.

    Args:
        columns: The columns of `choose_columns`. Shapes (n, size).
        features: The dataset's features.
        source: Their origin, for messages.
        fps: The dataset's frame rate [Hz], if known; a clock far from it is not used.

    Returns:
        The recording, and the row of each of its samples. Shape (T,).

    Raises:
        BadRecording: If nobody engaged, no clock runs, or the data are bad.
    """
    engaged = np.ones(len(columns["operator.tracked"]), bool)
    if ENGAGED_COLUMN in columns:
        engaged = columns[ENGAGED_COLUMN][:, 0] > 0
    if not engaged.any():
        raise BadRecording(source, "the operator never engaged in it")
    driven = np.flatnonzero(engaged)
    span = np.arange(driven[0], driven[-1] + 1)
    if len(span) < MIN_SAMPLES:
        raise BadRecording(source, "the operator was engaged in a single row of it")
    ticks = {name: columns[name][span, 0] for name in CLOCKS if name in columns}
    clock = _choose_clock(ticks, _find_leaps(columns, span), source, fps)
    if clock is None:
        rate = f" at about {fps:g} Hz" if fps else ""
        tried = ", ".join(ticks) or "(it has none)"
        raise BadRecording(source, f"no clock of it runs{rate}. Tried: {tried}")
    rows = span[clock.goes_on]
    tracked = columns["operator.tracked"][rows] > 0
    arrays = {
        "t": clock.t[clock.goes_on],
        "left_pinch": columns["operator.pinch"][rows, 0],
        "right_pinch": columns["operator.pinch"][rows, 1],
        "tracked": tracked,
    }
    for limb, frame in enumerate(FRAMES):
        poses = np.asarray(columns[f"operator.{frame}"][rows], float)
        # Unknown poses are stored as zeros, with the flag False: make them valid poses.
        unknown = ~tracked[:, limb] & ~_is_pose(poses)
        arrays[f"{frame}_pose"] = np.where(unknown[:, None], IDENTITY_POSE, poses)
    names = (features.get("action") or {}).get("names")
    if "action" in columns and isinstance(names, list) and MODE_KEY in names:
        place = names.index(MODE_KEY)
        if place < columns["action"].shape[1]:
            arrays["mode"] = np.round(columns["action"][rows, place])
    recording = make_recording(arrays, source)
    return dataclasses.replace(recording, engaged=engaged[rows]), rows


def _is_pose(poses: np.ndarray) -> np.ndarray:
    """Whether rows are finite poses with a unit quaternion. Shape (n, 7) -> (n,)."""
    with np.errstate(invalid="ignore", over="ignore"):
        norm = np.linalg.norm(poses[:, 3:], axis=1)
        return np.isfinite(poses).all(axis=1) & (np.abs(norm - 1) <= NORM_TOLERANCE)


def _find_leaps(columns: Mapping[str, np.ndarray], span: np.ndarray) -> np.ndarray:
    """Find the rows in which a limb has jumped since the previous row. Shape (n,), bool."""
    leaps = np.zeros(len(span), bool)
    tracked = columns["operator.tracked"][span] > 0
    for limb, frame in enumerate(FRAMES):
        place = np.asarray(columns[f"operator.{frame}"][span, :3], float)
        seen = tracked[1:, limb] & tracked[:-1, limb]
        with np.errstate(invalid="ignore"):
            leaps[1:] |= seen & (np.linalg.norm(np.diff(place, axis=0), axis=1) > _MOVED_M)
    return leaps


def _choose_clock(
    clocks: Mapping[str, np.ndarray], moved: np.ndarray, source: object, fps: float | None
) -> RowClock | None:
    """Choose the most preferred clock that runs at about the rate of the rows; None if none does.

    Args:
        clocks: Columns of `CLOCKS`. Shapes (n,).
        moved: Whether the person has moved too far since the previous row. Shape (n,), bool.
        source: Their origin, for the log.
        fps: Frame rate [Hz], if known.
    """
    for name, ticks in clocks.items():
        clock = read_row_clock(ticks, CLOCKS[name], moved)
        count = int(clock.goes_on.sum())
        if count - len(clock.jumps) < max(2, _MOST * len(ticks)):
            continue
        if fps and not 1 / _FAR_OFF < np.ptp(clock.t[clock.goes_on]) * fps / count < _FAR_OFF:
            continue
        for row, seconds in clock.jumps:
            logger.warning(
                "%s: %s jumps by %+.6g s at row %d of what the operator drove; it is replayed "
                "without.", source, name, seconds, row,
            )  # fmt: skip
        return clock
    return None


def _read_info(root: Path) -> dict:
    path = root / "meta" / "info.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        info["features"].keys()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadRecording(root, f"meta/info.json is not readable ({error!r})") from error
    return info


def _read_episode(
    root: Path, columns: list[str], episode: int, info: dict
) -> dict[str, np.ndarray]:
    """Return the columns of one episode, each of shape (n, size)."""
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    # LeRobot numbers data files consecutively, so sorting gives their order in time.
    files = sorted((root / "data").glob("**/*.parquet"))
    only = [("episode_index", "==", episode)]
    try:
        parts = [pq.read_table(file, columns=columns, filters=only) for file in files]
    except (pa.ArrowException, OSError) as error:
        raise BadRecording(root, f"its data files are not readable ({error})") from error
    parts = [part for part in parts if part.num_rows]
    if not parts:
        total = info.get("total_episodes", "an unknown number of")
        raise BadRecording(root, f"it has no episode {episode} (it has {total} episodes)")
    table = pa.concat_tables(parts)
    arrays = {}
    for column in columns:
        values = np.array(table[column].to_pylist())
        arrays[column] = values.reshape(len(values), -1)
    return arrays
