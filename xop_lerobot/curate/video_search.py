"""Images of episodes whose metadata does not say where they are, found by counting frames."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xop_lerobot.core.errors import BadDataset
from xop_lerobot.curate.entries import EpisodeEntry, VideoSpan
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.video import VideoIndex, index_video


@dataclass
class _Gap:
    """Pictures of a video, one after another, that the metadata gives to no episode.

    Attributes:
        file: The video, relative to the dataset's directory.
        start: The first of them.
        size: How many they are.
        is_tail: Whether they are the last of the video, where an unfinished episode's may be.
        low: They are of episodes after this one.
        high: They are of episodes before this one.
        used: How many of them are claimed.
    """

    file: Path
    start: int
    size: int
    is_tail: bool
    low: float = -1
    high: float = np.inf
    used: int = 0


class VideoSearch:
    """Finds the pictures of episodes.

    Where the metadata says where they are, and they are there and nobody else's, it is believed.
    All others are found by counting: a recorder puts one episode's pictures after the other's
    into a file, until it begins another one. So what no episode has between the pictures of
    episodes 3 and 5 is episode 4's, if it is as many as that has rows.

    Args:
        source: The dataset.
        known: Episodes whose metadata is there.
        found: Episodes of which there are rows, in order; those that are lost have pictures too.
        lost: Indices of the episodes that are lost already, whose pictures are not checked.
        note: Told what else is found.
    """

    def __init__(
        self,
        source: Source,
        known: Mapping[int, EpisodeEntry],
        found: Sequence[EpisodeEntry],
        lost: Container[int],
        note: Callable[[str], None],
    ) -> None:
        self._root, self._fps, self._note = source.root, source.fps, note
        self._cache: dict[Path, VideoIndex | None] = {}
        features = source.features.items()
        self._keys = [key for key, each in features if each["dtype"] == "video"]
        shared = source.video_use.shared
        self._faults: dict[int, str] = {}
        """Why the pictures are not where the metadata says, by the episode's index."""
        for entry in found if self._keys else ():
            if entry.index in shared:
                self._faults[entry.index] = shared[entry.index][0]
            elif entry.videos.keys() != set(self._keys):
                self._faults[entry.index] = "its pictures are gone"
            elif entry.index not in lost:
                fault = self._check(entry.videos, entry)
                if fault:
                    self._faults[entry.index] = fault
        taken = {
            index: entry
            for index, entry in known.items()
            if index not in self._faults and index not in shared
        }
        sought = [entry for entry in found if entry.index in self._faults]
        # Pictures of an episode of which nothing else is left may lie between those of others.
        there = taken.keys() | self._faults.keys()
        self._is_strict = there != set(range(len(there)))
        self._spans: dict[int, dict[str, VideoSpan]] = {entry.index: {} for entry in sought}
        for key in self._keys if sought else ():
            self._claim(key, self._list_gaps(key, taken), sought)

    def find(self, entry: EpisodeEntry) -> Mapping[str, VideoSpan] | str:
        """Find the pictures of an episode; say what is wrong where they are not to be had."""
        fault = self._faults.get(entry.index)
        if fault is None:
            return entry.videos
        spans = self._spans[entry.index]
        if spans.keys() != set(self._keys) or self._check(spans, entry):
            return fault
        if entry.videos or entry.faults:
            places = ", ".join(f"{span.file} from {span.start:.2f} s on" for span in spans.values())
            self._note(f"the pictures of episode {entry.index} are found: {places}")
        return spans

    def _list_gaps(self, key: str, taken: Mapping[int, EpisodeEntry]) -> list[_Gap]:
        """List the pictures of a camera that are nobody's, file by file."""
        spans: dict[Path, list[tuple[int, int, int]]] = {}
        for index, entry in taken.items():
            span = entry.videos.get(key)
            if span is not None:
                start, stop = (round(each * self._fps) for each in (span.start, span.stop))
                spans.setdefault(span.file, []).append((start, stop, index))
        gaps: list[_Gap] = []
        held: list[tuple[int | None, _Gap | None]] = []  # what lies there, one after another
        for file in self._list(key):
            place, size = 0, self._count(file)
            for start, stop, index in sorted(spans.get(file, ())):
                if start > place:
                    gaps.append(_Gap(file, place, start - place, is_tail=False))
                    held.append((None, gaps[-1]))
                held.append((index, None))
                place = max(place, stop)
            if size > place:
                gaps.append(_Gap(file, place, size - place, is_tail=True))
                held.append((None, gaps[-1]))
        low, high = -1, np.inf
        for index, gap in held:
            low = low if index is None else max(low, index)
            if gap is not None:
                gap.low = low
        for index, gap in reversed(held):
            high = high if index is None else min(high, index)
            if gap is not None:
                gap.high = high
        return gaps

    def _claim(self, key: str, gaps: list[_Gap], sought: Sequence[EpisodeEntry]) -> None:
        """Give what is nobody's to the episodes whose pictures are sought, all in their order."""
        claims: list[tuple[EpisodeEntry, _Gap, int]] = []
        number = 0
        for entry in sought:
            while number < len(gaps) and entry.index > gaps[number].low:
                gap = gaps[number]
                if entry.index < gap.high and gap.used + entry.length <= gap.size:
                    claims.append((entry, gap, gap.start + gap.used))
                    gap.used += entry.length
                    break
                number += 1
        for gap in gaps[:number]:
            if 0 < gap.used < gap.size and gap.is_tail:
                self._note(
                    f"{gap.file}: {gap.size - gap.used} pictures at its end belong to no episode"
                )
        for entry, gap, start in claims:
            if gap.used == gap.size or (gap.is_tail and not self._is_strict):
                begin, end = (each / self._fps for each in (start, start + entry.length))
                self._spans[entry.index][key] = VideoSpan(gap.file, begin, end)

    def _list(self, key: str) -> list[Path]:
        files = (self._root / "videos" / key).glob("*/*.mp4")
        return sorted(file.relative_to(self._root) for file in files)

    def _count(self, file: Path) -> int:
        index = self._index(file)
        return 0 if index is None else len(index.pts)

    def _index(self, file: Path) -> VideoIndex | None:
        if file not in self._cache:
            try:
                self._cache[file] = index_video(self._root, file)
            except BadDataset as error:
                self._note(error.fault)
                self._cache[file] = None
        return self._cache[file]

    def _check(self, spans: Mapping[str, VideoSpan], entry: EpisodeEntry) -> str:
        """Check that the pictures of an episode are there; return what is wrong, or nothing."""
        for key, span in spans.items():
            index = self._index(span.file)
            if index is None:
                return f"its pictures of '{key}' are not readable"
            dropped = entry.facts.get("dropped_frames")
            missing = index.count_missing(span.start, entry.length, self._fps)
            if missing > (dropped if isinstance(dropped, int) else 0):
                return f"{missing} of its {entry.length} pictures of '{key}' are gone"
            damaged = index.count_damaged(span.start, span.stop, self._fps)
            if damaged:
                return f"{damaged} of its {entry.length} pictures of '{key}' are damaged"
        return ""
