"""Labelling by hand: what a key or a typed word does to the labels, wherever it comes from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from xop_lerobot.curate.labels import Label, read_labels, write_labels

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
