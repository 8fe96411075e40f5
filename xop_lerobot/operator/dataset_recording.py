"""The operator's columns of a recorded LeRobot dataset, read as an operator recording."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from xop_lerobot.command import MODE_KEY
from xop_lerobot.errors import BadRecording
from xop_lerobot.operator.recording import Recording, make_recording
from xop_lerobot.state import FRAMES
from xop_lerobot.transforms import IDENTITY_POSE

POSE_COLUMNS = tuple(f"operator.{frame}" for frame in FRAMES)
COLUMNS = (*POSE_COLUMNS, "operator.pinch", "operator.tracked")
ENGAGED_COLUMN = "operator.engaged"
TIME_COLUMNS = ("time.sim", "timestamp")


def is_dataset(path: str | Path) -> bool:
    """Whether `path` is the directory of a LeRobot dataset."""
    return (Path(path) / "meta" / "info.json").is_file()


def load_dataset_recording(root: str | Path, episode: int = 0) -> Recording:
    """Read what the operator did in one episode, from the moment of engaging.

    The mode is what the robot was told (`mode.pos` of the action), so that the same motion
    drives another robot in the same modes.

    Args:
        root: Directory of the dataset.
        episode: Index of the episode.

    Raises:
        BadRecording: If the dataset has no operator columns, no such episode, or bad data.
    """
    root = Path(root)
    source = f"{root} (episode {episode})"
    info = _read_info(root)
    features = info["features"]
    missing = [column for column in COLUMNS if column not in features]
    if missing:
        raise BadRecording(
            root,
            f"the dataset has no column {', '.join(missing)}. Its columns: "
            f"{', '.join(sorted(features))}",
        )
    time_column = next(name for name in TIME_COLUMNS if name in features or name == "timestamp")
    wanted = [*COLUMNS, time_column]
    wanted += [name for name in (ENGAGED_COLUMN, "action") if name in features]
    table = _read_episode(root, wanted, episode, info)

    engaged = table[ENGAGED_COLUMN][:, 0] if ENGAGED_COLUMN in table else np.ones(len(table["t"]))
    if not (engaged > 0).any():
        raise BadRecording(source, "the operator never engaged in it")
    rows = slice(int(np.argmax(engaged > 0)), None)
    tracked = table["operator.tracked"][rows] > 0
    arrays = {
        "t": table["t"][rows],
        "left_pinch": table["operator.pinch"][rows, 0],
        "right_pinch": table["operator.pinch"][rows, 1],
        "tracked": tracked,
    }
    for limb, frame in enumerate(FRAMES):
        poses = table[f"operator.{frame}"][rows]
        # Columns hold zeros where the device gave nothing; the flag says so.
        empty = ~tracked[:, limb] & ~poses[:, 3:].any(axis=1)
        arrays[f"{frame}_pose"] = np.where(empty[:, None], IDENTITY_POSE, poses)
    names = (features.get("action") or {}).get("names") or []
    if "action" in table and MODE_KEY in names:
        arrays["mode"] = np.round(table["action"][rows, list(names).index(MODE_KEY)])
    return make_recording(arrays, source)


def _read_info(root: Path) -> dict:
    path = root / "meta" / "info.json"
    try:
        info = json.loads(path.read_text())
        info["features"].keys()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadRecording(root, f"meta/info.json is not readable ({error!r})") from error
    return info


def _read_episode(
    root: Path, columns: list[str], episode: int, info: dict
) -> dict[str, np.ndarray]:
    """Return the columns of one episode, each of shape (T, size), and the time as `t` (T,)."""
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    # LeRobot numbers an episode's files along with it, so the sorted order is the order in time.
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
        values = np.array(table[column].to_pylist(), dtype=float)
        arrays[column] = values.reshape(len(values), -1)
    time_column = next(name for name in columns if name in TIME_COLUMNS)
    arrays["t"] = arrays.pop(time_column)[:, 0]
    return arrays
