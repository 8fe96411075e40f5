"""Computes the metrics of each episode of a dataset, one episode at a time."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError

from xop_lerobot.core.errors import BadDataset, XopError
from xop_lerobot.curate.expression import Kind
from xop_lerobot.curate.measures import FIGURES, KINDS, MEASURES, Episode, Measure
from xop_lerobot.curate.order_check import OrderCheck
from xop_lerobot.curate.source import EpisodeEntry, Source
from xop_lerobot.curate.video import VideoIndex, index_video

_HEAD = 8
"""Size of an MP4 box header: length and type [bytes]."""
_SLACK = 0.5
"""Tolerance for the end of a video [frames]: below half a frame no image is missing."""


class VideoCheck:
    """Checks headers and packets of videos without decoding an image, each file once.

    Args:
        source: The dataset.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._last: dict[str, tuple[Path, str, float, VideoIndex | None]] = {}

    def check(self, entry: EpisodeEntry) -> list[str]:
        """List the faults of an episode's videos; empty if there are none."""
        problems = []
        dt = 1 / self._source.fps
        for key, span in entry.videos.items():
            if self._last.get(key, (None,))[0] != span.file:
                self._last[key] = (span.file, *self._look(span.file))
            _, fault, end, index = self._last[key]
            frames = (span.stop - span.start) / dt
            if fault:
                problems.append(f"{span.file} is not readable ({fault})")
            elif end < span.stop - _SLACK * dt:
                problems.append(
                    f"{span.file} ends at {end:.2f} s, episode {entry.index} needs it until "
                    f"{span.stop:.2f} s"
                )
            elif abs(frames - entry.length) > _SLACK:
                problems.append(
                    f"episode {entry.index} has {entry.length} frames, but {frames:g} images of "
                    f"'{key}'"
                )
            damaged = index.count_damaged(span.start, span.stop, self._source.fps) if index else 0
            if damaged:
                problems.append(
                    f"{span.file} is damaged: {damaged} of the {entry.length} images of episode "
                    f"{entry.index}"
                )
        return problems

    def _look(self, file: Path) -> tuple[str, float, VideoIndex | None]:
        """Return a file's fault, the end time of its images [s], and its packet index."""
        fault, end = probe(self._source.root / file)
        if fault:
            return fault, end, None
        try:
            return fault, end, index_video(self._source.root, file)
        except BadDataset as error:
            return error.fault, end, None


def probe(path: Path) -> tuple[str, float]:
    """Return the fault of a video, empty if none, and the end time of its images [s]."""
    if not path.is_file():
        return "there is no such file", 0.0
    try:
        if _is_cut_off(path):
            return "it is cut off", 0.0
        end = None
        with av.open(str(path)) as container:
            if container.streams.video:
                end = _find_end(container.streams.video[0])
        return ("it has no video", 0.0) if end is None else ("", end)
    except (FFmpegError, OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error), 0.0


def _find_end(stream: av.VideoStream) -> float:
    """Return the end time of a stream's last image [s]."""
    if stream.duration and stream.time_base:
        return float((stream.duration + (stream.start_time or 0)) * stream.time_base)
    return stream.frames / float(stream.average_rate or 1)


def _is_cut_off(path: Path) -> bool:
    """Whether the last box of an MP4 file extends beyond the end of the file."""
    size, place = path.stat().st_size, 0
    with path.open("rb") as file:
        while place + _HEAD <= size:
            file.seek(place)
            length, kind, long = struct.unpack(">I4sQ", file.read(2 * _HEAD).ljust(2 * _HEAD))
            if not kind.isalnum():  # not an MP4 file; FFmpeg decides whether it is a video
                return False
            length = {0: size - place, 1: long}.get(length, length)
            place += max(length, _HEAD)
    return place != size


_FACTS = {
    name: name
    for name in (
        "finished", "late", "dropped_frames", "real_fps", "clock", "scene", "low_level", "seed",
        "start_time", "collision",
    )
}  # fmt: skip
"""Metrics taken from the episode metadata, and their keys there."""


@dataclass(frozen=True)
class Finding:
    """Metrics of an episode.

    Attributes:
        entry: The episode's metadata.
        figures: The requested metrics by name, in the order of `FIGURES`; None if missing.
        problems: What could not be read, or contradicts the metadata.
    """

    entry: EpisodeEntry
    figures: Mapping[str, Any]
    problems: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return metrics and problems as plain values."""
        return {**self.figures, "problems": list(self.problems)}


def survey(
    source: Source,
    names: Collection[str] = tuple(FIGURES),
    note: Callable[[str], None] | None = None,
    episodes: Collection[int] | None = None,
) -> Iterator[Finding]:
    """Compute metrics of each episode in order, reading only what they need.

    Unreadable rows are no error: their metrics are None, and `problems` says why.

    Args:
        source: The dataset.
        names: Names of the metrics.
        note: Receives unreadable files of metadata; None makes them errors.
        episodes: Indices of the episodes; all if None.

    Raises:
        BadDataset: If the metadata is missing or malformed.
    """
    wanted = [name for name in FIGURES if name in names]
    measures = [each for each in MEASURES if not set(wanted).isdisjoint(each.figures)]
    videos = order = None
    if "readable" in names:
        videos, order = VideoCheck(source), OrderCheck(source)
    for entry in source.iterate(note):
        if episodes is not None and entry.index not in episodes:
            if order is not None:
                order.check(entry, None)
            continue
        problems = list(entry.faults)
        values = _read_facts(source, entry)
        more = None if order is None else order.columns
        measured, rows = _measure(source, entry, measures, problems, more)
        values |= measured
        if videos is not None and order is not None:
            problems += videos.check(entry) if entry.has_rows else ()
            values["readable"] = not problems
            problems += order.check(entry, rows)
        figures = {name: _clean(values.get(name), name, problems) for name in wanted}
        yield Finding(entry, figures, tuple(dict.fromkeys(problems)))


def _read_facts(source: Source, entry: EpisodeEntry) -> dict[str, Any]:
    facts = entry.facts
    settings = facts.get("settings")
    return {
        "episode": entry.index,
        "length": entry.length,
        "duration": entry.length / source.fps,
        "robot": facts.get("robot", source.robot),
        "task": " | ".join(entry.tasks) or facts.get("task"),
        "preset": settings.get("preset") if isinstance(settings, Mapping) else None,
        **{name: facts.get(fact) for name, fact in _FACTS.items()},
    }


def _measure(
    source: Source,
    entry: EpisodeEntry,
    measures: list[Measure],
    problems: list[str],
    more: tuple[str, ...] | None,
) -> tuple[dict[str, Any], Mapping[str, np.ndarray] | None]:
    """Compute metrics, and read further columns `more` for checks.

    Returns:
        The metrics, and the columns; None if a column cannot be read.
    """
    columns = {each: each.find_columns(source.features, entry) for each in measures}
    able = {each: names for each, names in columns.items() if names is not None}
    together = tuple(
        dict.fromkeys((*(name for names in able.values() for name in names), *(more or ())))
    )
    rows: Mapping[str, np.ndarray] | None = None
    try:
        if more is not None:
            source.check_rows(entry)
    except BadDataset as error:
        problems.append(error.fault)
    try:
        rows = source.read(entry, together) if together else {}
    except BadDataset as error:
        problems.append(error.fault)
    values: dict[str, Any] = {}
    for measure, names in able.items():
        try:
            # If a column is unreadable, metrics that do not need it are still computed.
            held = source.read(entry, names) if rows is None and names else rows or {}
            values |= _compute(source, entry, measure, {name: held[name] for name in names})
        except BadDataset as error:
            problems.append(error.fault)
        except XopError as error:
            problems.append(f"episode {entry.index}: {error}")
    return values, rows


def _compute(
    source: Source, entry: EpisodeEntry, measure: Measure, rows: Mapping[str, np.ndarray]
) -> Mapping[str, Any]:
    robot = entry.facts.get("robot", source.robot)
    robot = robot if isinstance(robot, str) else None
    with np.errstate(all="ignore"):  # `_clean` turns non-finite values into None
        return measure.compute(Episode(entry, source.features, rows, 1 / source.fps, robot))


def _clean(value: Any, name: str, problems: list[str]) -> Any:
    """Return `value` if it is finite and of the metric's type, else None."""
    if value is None:
        return None
    kind = KINDS[name]
    is_flag = isinstance(value, bool)
    if kind is Kind.FLAG and is_flag:
        return value
    if kind is Kind.TEXT and isinstance(value, str):
        return value
    if kind is Kind.NUMBER and not is_flag and isinstance(value, int | float):
        return value if math.isfinite(value) else None
    problems.append(f"'{name}' must be {kind.value}, the metadata says {value!r}")
    return None
