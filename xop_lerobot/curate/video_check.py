"""Whether the videos of a dataset are there, whole, and as long as its metadata says."""

from __future__ import annotations

import struct
from pathlib import Path

import av
from av.error import FFmpegError

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.source import EpisodeEntry, Source
from xop_lerobot.curate.video import VideoIndex, index_video

_HEAD = 8
"""Bytes of the size and the name of a box."""
_SLACK = 0.5
"""Frames by which a video may end early without a picture being missed: half of one."""


class VideoCheck:
    """Looks at videos' heads and packets, without decoding a picture; each file once.

    Args:
        source: The dataset.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._last: dict[str, tuple[Path, str, float, VideoIndex | None]] = {}

    def check(self, entry: EpisodeEntry) -> list[str]:
        """Say what is wrong with the videos of an episode; empty if nothing is."""
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
                    f"episode {entry.index} has {entry.length} frames, but {frames:g} pictures of "
                    f"'{key}'"
                )
            damaged = index.count_damaged(span.start, span.stop, self._source.fps) if index else 0
            if damaged:
                problems.append(
                    f"{span.file} is damaged: {damaged} of the {entry.length} pictures of episode "
                    f"{entry.index}"
                )
        return problems

    def _look(self, file: Path) -> tuple[str, float, VideoIndex | None]:
        """What is wrong with a file, when its pictures end [s], and its packets."""
        fault, end = probe(self._source.root / file)
        if fault:
            return fault, end, None
        try:
            return fault, end, index_video(self._source.root, file)
        except BadDataset as error:
            return error.fault, end, None


def probe(path: Path) -> tuple[str, float]:
    """Return what is wrong with a video, empty if nothing, and when its pictures end [s]."""
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
    """Find when the last picture of a stream ends [s]."""
    if stream.duration and stream.time_base:
        return float((stream.duration + (stream.start_time or 0)) * stream.time_base)
    return stream.frames / float(stream.average_rate or 1)


def _is_cut_off(path: Path) -> bool:
    """Whether the last of the boxes that an MP4 file consists of reaches beyond its end."""
    size, place = path.stat().st_size, 0
    with path.open("rb") as file:
        while place + _HEAD <= size:
            file.seek(place)
            length, kind, long = struct.unpack(">I4sQ", file.read(2 * _HEAD).ljust(2 * _HEAD))
            if not kind.isalnum():  # no MP4: whether it is a video at all is for FFmpeg to say
                return False
            length = {0: size - place, 1: long}.get(length, length)
            place += max(length, _HEAD)
    return place != size
