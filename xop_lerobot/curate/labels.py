"""Labels of episodes: whether they succeeded, and which sub-task began when."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.folders import write_whole


@dataclass(frozen=True)
class Label:
    """What is said of an episode.

    Attributes:
        success: Whether it succeeded; None leaves that as it is.
        subtasks: Sub-tasks and when each begins [s], in their order.
    """

    success: bool | None = None
    subtasks: tuple[tuple[str, float], ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the label as plain values."""
        return {"success": self.success, "subtasks": [list(each) for each in self.subtasks]}


def read_labels(path: Path) -> dict[int, Label]:
    """Read labels by episode from a JSON file; empty if there is none.

    Raises:
        BadValue: If it is malformed; says where.
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
    """Write labels; the file is there as a whole or as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, {str(index): labels[index].to_json() for index in sorted(labels)})


def number_frames(
    label: Label, names: Sequence[str], length: int, fps: float, rest: int
) -> np.ndarray:
    """Number the sub-task of each frame; `rest` before the first begins. Shape (n,)."""
    numbers = np.full(length, rest)
    for name, start in label.subtasks:
        numbers[max(0, round(start * fps)) :] = names.index(name)
    return numbers


def list_runs(numbers: np.ndarray, names: Sequence[str]) -> list[dict[str, Any]]:
    """List which sub-task goes from which frame to before which."""
    edges = np.flatnonzero(np.diff(numbers)) + 1
    starts, stops = [0, *edges.tolist()], [*edges.tolist(), len(numbers)]
    return [
        {"name": names[int(numbers[start])], "start": start, "stop": stop}
        for start, stop in zip(starts, stops, strict=True)
    ]


def set_success(column: np.ndarray | None, length: int, success: bool) -> np.ndarray:
    """Bring `next.success` in line with a label: true in the last frame, or nowhere.

    Args:
        column: What it was; None where there was none. Shape (n, 1).
        length: Frames.
        success: The label.
    """
    values = np.zeros((length, 1), bool) if column is None else column.astype(bool).copy()
    if success:
        values[-1] = True
    else:
        values[:] = False
    return values


HELP = (
    "s success   f failure   k keep as it is   b back   q stop\n"
    "NUMBER [TIME]: sub-task NUMBER begins at TIME [s], in a window at the picture shown   "
    "c clear sub-tasks"
)


class LabelSession:
    """Goes through episodes and keeps every answer in a file at once.

    Answers that the file holds already are not asked for again.

    Args:
        episodes: Indices of the episodes, in the order in which they are shown.
        path: File of the answers.
        names: Names of the sub-tasks, numbered from 1.

    Attributes:
        labels: Answers so far, by episode.
        message: What the last key did, or why it did nothing.
    """

    def __init__(self, episodes: Sequence[int], path: Path, names: Sequence[str] = ()) -> None:
        self._episodes, self._path, self._names = list(episodes), path, list(names)
        self.labels: dict[int, Label] = read_labels(path)
        self._place = 0
        self._marks: list[tuple[str, float]] = []
        self._stopped = False
        self.message = ""
        self._skip_known()

    @property
    def current(self) -> int | None:
        """Index of the episode that is asked about; None when all is said."""
        if self._stopped or self._place >= len(self._episodes):
            return None
        return self._episodes[self._place]

    @property
    def progress(self) -> str:
        """How far it is, in words."""
        return f"episode {self.current} ({self._place + 1} of {len(self._episodes)})"

    @property
    def marks(self) -> Sequence[tuple[str, float]]:
        """Sub-tasks that were set in this episode, and when they begin [s]."""
        return tuple(self._marks)

    def press(self, word: str, time: float | None = None) -> None:
        """Do what a key or a typed word asks for.

        Args:
            word: A key, or a sub-task's number with or without a time after it.
            time: Time of the picture that is shown [s]; None where there is none.
        """
        actions: Mapping[str, Callable[[], None]] = {
            "s": lambda: self._answer(True),
            "f": lambda: self._answer(False),
            "k": lambda: self._answer(None),
            "b": self._go_back,
            "q": self._stop,
            "c": self._marks.clear,
        }
        words = word.split()
        self.message = ""
        if len(words) == 1 and words[0] in actions:
            actions[words[0]]()
        elif words and words[0].isdigit():
            self._mark(words, time)
        else:
            self.message = f"'{word}' is no answer. Known: {', '.join(actions)}, or a number"

    def _mark(self, words: Sequence[str], time: float | None) -> None:
        number = int(words[0])
        if not 1 <= number <= len(self._names):
            known = ", ".join(f"{i} {name}" for i, name in enumerate(self._names, 1))
            self.message = f"there is no sub-task {number}. Known: {known or 'none (--names)'}"
            return
        try:
            start = float(words[1]) if len(words) > 1 else time
        except ValueError:
            start = None
        if start is None or not 0 <= start < float("inf"):
            self.message = f"say when it begins [s], such as '{number} 1.5'"
            return
        name = self._names[number - 1]
        self._marks = sorted([*self._marks, (name, start)], key=lambda mark: mark[1])
        self.message = f"'{name}' begins at {start:.2f} s"

    def _answer(self, success: bool | None) -> None:
        index = self.current
        if index is None:
            return
        self.labels[index] = Label(success, tuple(self._marks))
        write_labels(self._path, self.labels)
        word = {True: "success", False: "failure", None: "as it is"}[success]
        self.message = f"episode {index}: {word}"
        self._marks.clear()
        self._place += 1
        self._skip_known()

    def _go_back(self) -> None:
        if not self._place:
            self.message = "this is the first"
            return
        self._place -= 1
        self._marks = list(self.labels[self._episodes[self._place]].subtasks)
        del self.labels[self._episodes[self._place]]

    def _stop(self) -> None:
        self._stopped = True

    def _skip_known(self) -> None:
        while (index := self.current) is not None and index in self.labels:
            self._place += 1
