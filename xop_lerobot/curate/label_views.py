"""Where somebody who labels by hand sees an episode: a window, or picture files and a terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from xop_lerobot.core.errors import BadDataset, BadValue
from xop_lerobot.curate.labels import HELP, LabelSession
from xop_lerobot.curate.video import Cut, decode
from xop_lerobot.evaluation.film import build_film, choose_moments, write_strip

if TYPE_CHECKING:
    from xop_lerobot.curate.source import EpisodeEntry, Source

type Films = Mapping[str, np.ndarray]
type Load = Callable[[int], Films]

_PLAY_MS = 40
_LEAST_WIDTH = 160
"""Width of a picture that its label fits over [pixel]."""
_STRIDE = {"left": -1, "right": 1, "down": -10, "up": 10}


def read_films(source: Source, entry: EpisodeEntry, number: int | None = None) -> Films:
    """Decode the pictures of an episode by camera.

    Args:
        source: The dataset.
        entry: The episode.
        number: How many, evenly from first to last; None for all.

    Returns:
        Pictures by camera. Shapes (number, height, width, 3), uint8.

    Raises:
        BadDataset: If it has none, or a video is not readable.
    """
    from xop_lerobot.curate.stats import read_pictures  # noqa: PLC0415 torch

    length = entry.length
    wanted = range(length) if number is None else choose_moments(length, number).tolist()
    films = {}
    for key, feature in source.features.items():
        name = key.rpartition(".")[2]
        if key in entry.videos:
            span = entry.videos[key]
            cut = Cut(source.root, span.file, span.start, span.stop)
            films[name] = [picture for _, picture in decode(cut, source.fps, set(wanted))]
        elif feature["dtype"] == "image":
            films[name] = list(read_pictures(source.read_table(entry)[key], list(wanted)))
    if not films or not all(films.values()):
        raise BadDataset(source.root, f"episode {entry.index} has no pictures to show")
    return {name: _enlarge(np.stack(pictures)) for name, pictures in films.items()}


def _enlarge(film: np.ndarray) -> np.ndarray:
    """Repeat the pixels of small pictures, so that their labels fit. Shape (n, h, w, 3)."""
    factor = -(-_LEAST_WIDTH // film.shape[2])
    return film.repeat(factor, axis=1).repeat(factor, axis=2)


def has_display() -> bool:
    """Whether a window can be opened."""
    return sys.platform == "darwin" or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def ask_in_terminal(
    session: LabelSession,
    load: Load,
    folder: Path,
    fps: Callable[[int], float],
    answers: TextIO | None = None,
) -> None:
    """Write a strip of pictures of each episode to a file, and read the answers line by line.

    Args:
        session: What is asked.
        load: Loads some pictures of an episode.
        folder: Where the files go.
        fps: Tells how many of them there are a second of an episode [Hz].
        answers: Where the answers come from; standard input if None.
    """
    print(HELP)
    shown: int | None = None
    while (index := session.current) is not None:
        if index != shown:
            path = folder / f"episode_{index:06d}.png"
            films = load(index)
            write_strip(path, films, fps(index), len(next(iter(films.values()))))  # pyright: ignore
            print(f"{session.progress}: {path}")
            shown = index
        print("> ", end="", flush=True)
        line = (answers or sys.stdin).readline()
        if not line:  # the end of the input stops as q does
            break
        session.press(line.strip())
        if session.message:
            print(session.message)


class LabelWindow:
    """Plays each episode in a window; keys answer.

    Space stops and plays, the arrows go one picture (left, right) or ten (down, up).

    Args:
        session: What is asked.
        load: Loads all pictures of an episode.
        fps: Pictures a second [Hz].

    Raises:
        BadValue: If matplotlib has no window here.
    """

    def __init__(self, session: LabelSession, load: Load, fps: float) -> None:
        import matplotlib.pyplot as plt  # noqa: PLC0415 slow

        self._session, self._load, self._fps = session, load, fps
        for name, keys in plt.rcParams.items():
            if name.startswith("keymap.") and isinstance(keys, list):
                plt.rcParams[name] = []  # they would take s, f, k and q
        self._plt = plt
        self.figure, self._axes = plt.subplots(num="xop-curate label")
        self._axes.set_axis_off()
        self._image: Any = None
        self._film: list[np.ndarray] = []
        self.frame, self._plays = 0, True
        self._shown: int | None = None
        self.figure.canvas.mpl_connect("key_press_event", self._on_key)
        self._timer = self.figure.canvas.new_timer(interval=_PLAY_MS)
        self._timer.add_callback(self._on_time)
        self._show_episode()

    def run(self) -> None:
        """Show the window until all is said or it is closed.

        Raises:
            BadValue: If matplotlib has no window here.
        """
        if self._plt.get_backend().lower() == "agg":
            raise BadValue("no window can be opened here. Use --view=terminal")
        self._timer.start()
        self._plt.show()

    def _show_episode(self) -> None:
        index = self._session.current
        if index is None:
            self._timer.stop()
            self._plt.close(self.figure)
            return
        if index != self._shown:
            self._film = list(build_film(self._load(index), round(self._fps)))
            self._shown, self.frame, self._plays = index, 0, True
            self._axes.clear()
            self._axes.set_axis_off()
            self._image = self._axes.imshow(self._film[0])
        self._draw()

    def _draw(self) -> None:
        self._image.set_data(self._film[self.frame])
        marks = "   ".join(f"{name} {start:.1f} s" for name, start in self._session.marks)
        lines = (
            f"{self._session.progress}   {self.frame / self._fps:.2f} s   {marks}",
            self._session.message,
            HELP,
        )
        self._axes.set_title("\n".join(line for line in lines if line), fontsize=8)
        self.figure.canvas.draw_idle()

    def _on_time(self) -> None:
        if self._plays and self._film:
            self.frame = min(self.frame + 1, len(self._film) - 1)
            self._draw()

    def _on_key(self, event: Any) -> None:
        key = str(event.key)
        if key == " ":
            self._plays = not self._plays
        elif key in _STRIDE:
            self._plays = False
            self.frame = int(np.clip(self.frame + _STRIDE[key], 0, len(self._film) - 1))
        else:
            self._session.press(key, self.frame / self._fps)
        self._show_episode()
