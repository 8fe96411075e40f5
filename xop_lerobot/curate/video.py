"""Cut and copy videos of episodes without re-encoding.

A video can be cut only before a key frame, but an episode of LeRobot's may start anywhere in its
file: its metadata states the time. So a cut keeps the whole groups of pictures (GOPs) that the
episode needs, and the times stay exact. With LeRobot's encoder settings (every second image is a
key frame) at most one superfluous image remains at each end.

Damaged packets are detected by their framing, without decoding. H.264 and HEVC in MP4 consist of
units prefixed by their length, AV1 of OBUs that contain theirs. The lengths must fill the packet
exactly, and one header bit of each must be 0. Overwritten parts of a file (with zeros, or a block
of another file) violate this in nearly every packet whose header they cover. A flipped bit inside
an image does not: only decoding shows it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError

from xop_lerobot.core.errors import BadDataset

_LENGTH = 4
"""Size of a unit's length prefix [bytes], the same for every encoder that LeRobot uses."""
_OBU_EXTENDED, _OBU_SIZED = 0x04, 0x02
"""Header bits of an OBU: an extension byte follows; a length follows."""
_OBU_KINDS = (1, 2, 3, 4, 5, 6, 7, 8, 15)
"""All defined OBU types; the others are reserved."""
_OBU_PICTURES = (4, 6)
"""OBU types that end a packet: tile group and frame. The last OBU may lack a length."""


def find_framing(codec: str, extradata: bytes | None) -> Callable[[bytes], bool] | None:
    """Return a function that checks whether a packet is intact; None if the codec has none.

    Args:
        codec: Name of the codec in FFmpeg.
        extradata: Codec configuration record of the file.
    """
    if codec == "av1":
        return is_whole_av1
    if codec in ("h264", "hevc") and extradata and extradata[0] == 1:  # avcC, hvcC
        place = 4 if codec == "h264" else 21
        if len(extradata) > place and (extradata[place] & 3) + 1 == _LENGTH:
            return is_whole_nal
    return None


def is_whole_nal(packet: bytes) -> bool:
    """Whether a packet consists of H.264 or HEVC units with four-byte length prefixes."""
    place, end = 0, len(packet)
    while place + _LENGTH < end:
        length = int.from_bytes(packet[place : place + _LENGTH], "big")
        if not length or packet[place + _LENGTH] & 0x80:
            return False
        place += _LENGTH + length
    return place == end and end > 0


def is_whole_av1(packet: bytes) -> bool:
    """Whether a packet consists of AV1 OBUs, the last of which may lack a length."""
    place, end = 0, len(packet)
    while place < end:
        head = packet[place]
        kind = head >> 3 & 15
        if head & 0x81 or kind not in _OBU_KINDS:  # the forbidden and the reserved bit
            return False
        place += 2 if head & _OBU_EXTENDED else 1
        if not head & _OBU_SIZED:
            return kind in _OBU_PICTURES and place < end
        length, shift = 0, 0
        while True:
            if place >= end or shift > 49:  # at most eight bytes
                return False
            byte = packet[place]
            length |= (byte & 0x7F) << shift
            place, shift = place + 1, shift + 7
            if not byte & 0x80:
                break
        place += length
    return place == end and end > 0


@dataclass(frozen=True)
class VideoIndex:
    """Packets of a video, in decoding order.

    Attributes:
        pts: Presentation time of each, in units of `time_base`. Shape (n,).
        keys: Whether each is a key frame. Shape (n,), bool.
        time_base: Unit of the times [s].
        damaged: Indices of packets with broken framing. Shape (m,).
    """

    pts: np.ndarray
    keys: np.ndarray
    time_base: Fraction
    damaged: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def times(self) -> np.ndarray:
        """Presentation time of each image [s]. Shape (n,)."""
        return self.pts * float(self.time_base)

    def count_missing(self, start: float, length: int, fps: float) -> int:
        """Count which of `length` frames from `start` [s] on have no image."""
        wanted = start + np.arange(length) / fps
        times = np.concatenate([[-np.inf], np.sort(self.times), [np.inf]])
        after = np.searchsorted(times, wanted)
        near = np.minimum(wanted - times[after - 1], times[after] - wanted)
        return int((near > 0.25 / fps).sum())

    def count_damaged(self, start: float, stop: float, fps: float) -> int:
        """Count the images from `start` to `stop` [s] that are damaged or depend on damaged ones.

        Images after a damaged one depend on it until the next key frame.
        """
        spoiled = np.zeros(len(self.pts), bool)
        keys = np.append(np.flatnonzero(self.keys), len(self.pts))
        for packet in self.damaged:
            spoiled[packet : keys[np.searchsorted(keys, packet, side="right")]] = True
        half, times = 0.5 / fps, self.times
        return int((spoiled & (times > start - half) & (times < stop - half)).sum())

    def find_groups(self, start: float, stop: float, fps: float) -> tuple[int, int] | None:
        """Find the groups of pictures that contain the images from `start` to `stop` [s].

        Returns:
            First packet, and the packet after the last; None if there is no image.
        """
        half = 0.5 / fps
        shown = np.flatnonzero((self.times > start - half) & (self.times < stop - half))
        if not shown.size:
            return None
        keys = np.flatnonzero(self.keys)
        before = keys[(keys <= shown[0]) & (self.times[keys] < start + half)]
        after = keys[keys > shown.max()]
        first = int(before[-1]) if before.size else 0
        return first, int(after[0]) if after.size else len(self.pts)


def index_video(root: Path, file: Path) -> VideoIndex:
    """Index the packets of `root / file` and check their framing, without decoding.

    Raises:
        BadDataset: If there is no such file, or it is not a video.
    """
    pts, keys, damaged, time_base = [], [], [], Fraction(1, 1)
    try:
        size = (root / file).stat().st_size
        with av.open(str(root / file)) as container:
            stream = container.streams.video[0]
            codec = stream.codec_context
            is_whole = find_framing(codec.codec.canonical_name, codec.extradata)
            for packet in container.demux(stream):
                if packet.pts is None or packet.dts is None:
                    continue
                # A file cut off inside this packet; FFmpeg does not always flag it.
                if packet.is_corrupt or (packet.pos or 0) + packet.size > size:
                    break
                if is_whole is not None and not is_whole(bytes(packet)):
                    damaged.append(len(pts))
                pts.append(packet.pts)
                keys.append(packet.is_keyframe)
            time_base = stream.time_base or Fraction(1, 1)
    except FileNotFoundError:
        raise BadDataset(root, f"{file} is missing") from None
    except (FFmpegError, OSError, IndexError, ValueError) as error:
        raise BadDataset(root, f"{file} is not readable ({_say(error)})") from error
    places = np.array(damaged, np.int64)
    return VideoIndex(np.array(pts, np.int64), np.array(keys, bool), time_base, places)


@dataclass(frozen=True)
class Cut:
    """Time span of a video.

    Attributes:
        root: Directory of the dataset.
        file: The video, relative to it.
        start: Time of the first image [s].
        stop: End time of the last image [s].
        length: Expected number of images; None if unknown.
        spare: Number of them that may be missing because the encoder dropped them.
    """

    root: Path
    file: Path
    start: float
    stop: float
    length: int | None = None
    spare: int = 0

    def check(self, index: VideoIndex, fps: float) -> None:
        """Check that all its images are present and undamaged.

        Raises:
            BadDataset: If an image is missing or damaged.
        """
        damaged = index.count_damaged(self.start, self.stop, fps)
        if damaged:
            raise BadDataset(
                self.root,
                f"{self.file} is damaged: {damaged} images from {self.start:.3f} s to "
                f"{self.stop:.3f} s. `xop-curate repair` keeps the other episodes",
            )
        missing = index.count_missing(self.start, self.length or 0, fps)
        if missing > self.spare:
            raise BadDataset(
                self.root,
                f"{self.file} lacks {missing} of the {self.length} images from "
                f"{self.start:.3f} s on, at {fps:g} Hz. `xop-curate repair` keeps what is complete",
            )


class VideoFile:
    """A new video, concatenated from spans of one source video.

    Args:
        path: Output path.
        fps: Frame rate [Hz].
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self._fps = path, fps
        self._container: Any = None
        self._stream: Any = None
        self._end = 0  # in the source's units
        self._last_dts: int | None = None
        path.parent.mkdir(parents=True, exist_ok=True)

    def add(self, cut: Cut, index: VideoIndex) -> tuple[float, float]:
        """Append a span of the video.

        Args:
            cut: The span.
            index: Index of its video, the same for all spans.

        Returns:
            Start and stop of the span in this file [s].

        Raises:
            BadDataset: If the span contains no image.
        """
        groups = index.find_groups(cut.start, cut.stop, self._fps)
        if groups is None:
            raise BadDataset(
                cut.root, f"{cut.file} has no image from {cut.start:.3f} s to {cut.stop:.3f} s"
            )
        first, last = groups
        pts = index.pts[first:last]
        lowest = index.pts[first]
        shift = self._end - int(lowest)
        self._copy(cut, index, first, last, shift)
        step = round(1 / (self._fps * index.time_base))
        self._end = int(pts.max()) + shift + step
        offset = shift * float(index.time_base)
        return cut.start + offset, cut.stop + offset

    def _copy(self, cut: Cut, index: VideoIndex, first: int, last: int, shift: int) -> None:
        with av.open(str(cut.root / cut.file)) as container:
            stream = container.streams.video[0]
            if self._container is None:
                self._container = av.open(
                    str(self.path), mode="w", options={"movflags": "faststart"}
                )
                self._stream = self._container.add_stream_from_template(stream, opaque=True)
                self._stream.time_base = stream.time_base
            lowest, count = index.pts[first], -1
            for packet in container.demux(stream):
                if packet.pts is None or packet.dts is None:
                    continue
                count += 1
                if count >= last:
                    break
                # Images shown before the key frame also depend on the group before it: skip them.
                if count < first or packet.pts < lowest:
                    continue
                packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                if self._last_dts is not None and packet.dts <= self._last_dts:
                    packet.dts = self._last_dts + 1
                self._last_dts = packet.dts
                packet.stream = self._stream
                self._container.mux(packet)

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._container is not None:
            self._container.close()
            self._container = None


def copy_whole(cut: Cut, index: VideoIndex, path: Path, fps: float) -> bool:
    """Copy a video byte by byte if the span is all of it; return whether it was."""
    if index.find_groups(cut.start, cut.stop, fps) != (0, len(index.pts)):
        return False
    times = index.times
    if times.min() < cut.start - 0.5 / fps or times.max() > cut.stop - 0.5 / fps:
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(cut.root / cut.file, path)
    return True


def decode(cut: Cut, fps: float, wanted: set[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Decode images of a span, by their index `wanted` from its start.

    Yields:
        The number of each, and the image. Shape (height, width, 3), uint8.

    Raises:
        BadDataset: If the video is not readable.
    """
    half, left = 0.5 / fps, set(wanted)
    try:
        with av.open(str(cut.root / cut.file)) as container:
            stream = container.streams.video[0]
            unit = float(stream.time_base or 1)
            container.seek(int(max(cut.start - half, 0) / unit), stream=stream, backward=True)
            for frame in container.decode(stream):
                if frame.pts is None:
                    continue
                time = frame.pts * unit - cut.start
                number = round(time * fps)
                if time > -half and number in left:
                    left.discard(number)
                    yield number, frame.to_ndarray(format="rgb24")
                if not left or time > cut.stop - cut.start:
                    return
    except (FFmpegError, OSError, IndexError) as error:
        raise BadDataset(cut.root, f"{cut.file} is not readable ({_say(error)})") from error


def _say(error: Exception) -> str:
    """Return the error message without number and path."""
    return getattr(error, "strerror", None) or str(error)
