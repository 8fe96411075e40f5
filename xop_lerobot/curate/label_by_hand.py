"""Manual labelling: an image strip per episode in a file, answers typed in the terminal."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.labels import Label, read_labels, write_labels
from xop_lerobot.curate.source import EpisodeEntry, Source
from xop_lerobot.curate.video import Cut, decode
from xop_lerobot.evaluation.film import choose_moments, write_strip

_STRIP = 8
"""Images per strip, evenly spaced from the first to the last frame."""
_LEAST_WIDTH = 160
"""Smallest image width that fits the image's caption [px]."""

HELP = (
    "s success   f failure   k keep as it is   b back   q stop\n"
    "NUMBER TIME: sub-task NUMBER begins at TIME [s]   c clear sub-tasks"
)


class LabelSession:
    """Iterates over episodes and saves every answer at once.

    Episodes with an answer in the file are skipped.

    Args:
        episodes: Indices of the episodes, in display order.
        path: File of the answers.
        names: Names of the sub-tasks, numbered from 1.

    Attributes:
        labels: Answers so far, by episode.
        message: Result of the last key, or why it had none.
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
        """Index of the current episode; None when all are answered."""
        if self._stopped or self._place >= len(self._episodes):
            return None
        return self._episodes[self._place]

    @property
    def progress(self) -> str:
        """Progress as text."""
        return f"episode {self.current} ({self._place + 1} of {len(self._episodes)})"

    @property
    def marks(self) -> Sequence[tuple[str, float]]:
        """Sub-tasks set in this episode, with their start times [s]."""
        return tuple(self._marks)

    def press(self, word: str) -> None:
        """Handle a key, or a sub-task's number followed by its start time."""
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
            self._mark(words)
        else:
            self.message = f"'{word}' is no answer. Known: {', '.join(actions)}, or a number"

    def _mark(self, words: Sequence[str]) -> None:
        number = int(words[0])
        if not 1 <= number <= len(self._names):
            known = ", ".join(f"{i} {name}" for i, name in enumerate(self._names, 1))
            self.message = f"there is no sub-task {number}. Known: {known or 'none (--names)'}"
            return
        try:
            start = float(words[1])
        except (IndexError, ValueError):
            start = math.inf
        if not 0 <= start < math.inf:
            self.message = f"missing start time [s], such as '{number} 1.5'"
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


def ask(
    source: Source, path: Path, names: Sequence[str], answers: TextIO | None = None
) -> dict[int, Label]:
    """Ask the user for labels, episode by episode.

    An image strip of each episode is written beside the file of the answers.

    Args:
        source: The dataset.
        path: File of the answers.
        names: Names of the sub-tasks.
        answers: Stream of the answers; standard input if None.

    Returns:
        All labels in the file, including those of earlier runs.

    Raises:
        BadDataset: If an episode has no images, or a video is not readable.
    """
    entries = {entry.index: entry for entry in source.episodes}
    session = LabelSession(sorted(entries), path, names)
    print(HELP)
    shown: int | None = None
    while (index := session.current) is not None:
        if index != shown:
            entry = entries[index]
            strip = path.with_name(f"{path.stem}_strips") / f"episode_{index:06d}.png"
            images = read_images(source, entry, _STRIP)
            count = len(next(iter(images.values())))
            # The first image is the first frame and the last one the last.
            rate = max(1, count - 1) * source.fps / max(1, entry.length - 1)
            write_strip(strip, images, rate, count)
            print(f"{session.progress}: {strip}")
            shown = index
        print("> ", end="", flush=True)
        line = (answers or sys.stdin).readline()
        if not line:  # end of input, same as q
            break
        session.press(line.strip())
        if session.message:
            print(session.message)
    return session.labels


def read_images(source: Source, entry: EpisodeEntry, count: int) -> dict[str, np.ndarray]:
    """Decode `count` images of an episode per camera, enlarging small ones for their captions.

    Returns:
        Images by camera. Shapes (count, height, width, 3), uint8; fewer in shorter episodes.

    Raises:
        BadDataset: If the episode has no images, or a video is not readable.
    """
    from xop_lerobot.curate.stats import read_pictures  # noqa: PLC0415 torch

    wanted = choose_moments(entry.length, count).tolist()
    strips = {}
    for key, feature in source.features.items():
        name = key.rpartition(".")[2]
        if key in entry.videos:
            span = entry.videos[key]
            cut = Cut(source.root, span.file, span.start, span.stop)
            strips[name] = [image for _, image in decode(cut, source.fps, set(wanted))]
        elif feature["dtype"] == "image":
            strips[name] = list(read_pictures(source.read_table(entry)[key], wanted))
    if not strips or not all(strips.values()):
        raise BadDataset(source.root, f"episode {entry.index} has no images to show")
    return {name: _enlarge(np.stack(images)) for name, images in strips.items()}


def _enlarge(images: np.ndarray) -> np.ndarray:
    """Enlarge small images by an integer factor. Shape (n, h, w, 3)."""
    factor = -(-_LEAST_WIDTH // images.shape[2])
    return images.repeat(factor, axis=1).repeat(factor, axis=2)
