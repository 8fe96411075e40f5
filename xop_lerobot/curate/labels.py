"""Labels of episodes: success, and the start times of sub-tasks."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.folders import write_whole


@dataclass(frozen=True)
class Label:
    """Label of an episode.

    Attributes:
        success: Whether it succeeded; None leaves the present label.
        subtasks: Sub-tasks with their start times [s], in order.
    """

    success: bool | None = None
    subtasks: tuple[tuple[str, float], ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the label as plain values."""
        return {"success": self.success, "subtasks": [list(each) for each in self.subtasks]}


def read_labels(path: Path) -> dict[int, Label]:
    """Read labels by episode from a JSON file; empty if there is no file.

    Raises:
        BadValue: If it is malformed; the message says where.
    """
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise BadValue(f"labels '{path}' are not readable ({error})") from error
    if not isinstance(rows, dict):
        raise BadValue(f"labels '{path}' must be one JSON object by episode")
    labels = {}
    for key, row in rows.items():
        try:
            success = row.get("success")
            if success not in (None, True, False):
                raise ValueError("success")
            pairs = [(str(name), float(start)) for name, start in row.get("subtasks", ())]
            labels[int(key)] = Label(success, tuple(sorted(pairs, key=lambda pair: pair[1])))
        except (AttributeError, TypeError, ValueError) as error:
            raise BadValue(
                f"labels '{path}': episode {key} must have success (true, false or null) and "
                f"subtasks ([[name, start in s], …]), got {row}"
            ) from error
    return labels


def write_labels(path: Path, labels: Mapping[int, Label]) -> None:
    """Write labels; the file is replaced atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, {str(index): labels[index].to_json() for index in sorted(labels)})


def number_frames(
    label: Label, names: Sequence[str], length: int, fps: float, rest: int
) -> np.ndarray:
    """Index the sub-task of each frame; `rest` before the first one starts. Shape (n,)."""
    numbers = np.full(length, rest)
    for name, start in label.subtasks:
        numbers[max(0, round(start * fps)) :] = names.index(name)
    return numbers


def list_runs(numbers: np.ndarray, names: Sequence[str]) -> list[dict[str, Any]]:
    """List the runs of equal sub-tasks with their first frame and the frame after the last."""
    edges = np.flatnonzero(np.diff(numbers)) + 1
    starts, stops = [0, *edges.tolist()], [*edges.tolist(), len(numbers)]
    return [
        {"name": names[int(numbers[start])], "start": start, "stop": stop}
        for start, stop in zip(starts, stops, strict=True)
    ]


def set_success(column: np.ndarray | None, length: int, success: bool) -> np.ndarray:
    """Set `next.success` to a label: True in the last frame, or nowhere.

    Args:
        column: Present values; None if there are none. Shape (n, 1).
        length: Number of frames.
        success: The label.
    """
    values = np.zeros((length, 1), bool) if column is None else column.astype(bool).copy()
    if success:
        values[-1] = True
    else:
        values[:] = False
    return values
