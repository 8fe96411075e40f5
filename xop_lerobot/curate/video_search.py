"""Locate images of episodes whose metadata does not state where they are, by counting frames."""

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
    """Consecutive images of a video that the metadata assigns to no episode.

    Attributes:
        file: The video, relative to the dataset's directory.
        start: Index of the first.
        size: Number of images.
        is_tail: Whether they end the video, where images of an unfinished episode may be.
        low: They belong to episodes after this one.
        high: They belong to episodes before this one.
        used: Number of claimed images.
    """

    file: Path
    start: int
    size: int
    is_tail: bool
    low: float = -1
    high: float = np.inf
    used: int = 0


class VideoSearch:
    """Locates the images of episodes.

    The metadata is trusted where the images it states exist and no other episode claims them. All
    others are located by counting: a recorder appends the images of consecutive episodes to a file
    until it starts another. So unassigned images between those of episodes 3 and 5 belong to
    episode 4 if their number matches its rows.

    Args:
        source: The dataset.
        known: Episodes with metadata.
        found: Episodes with rows, in order; lost ones are included because they have images, too.
        lost: Indices of episodes already known to be lost, whose images are not checked.
        note: Receives further findings.
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
        """Why the images are not where the metadata states, by episode index."""
        for entry in found if self._keys else ():
            if entry.index in shared:
                self._faults[entry.index] = shared[entry.index][0]
            elif entry.videos.keys() != set(self._keys):
                self._faults[entry.index] = "its images are gone"
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
        # Images of a completely lost episode may lie between those of others: then a tail with
        # superfluous images cannot be assigned.
        there = taken.keys() | self._faults.keys()
        self._is_strict = there != set(range(len(there)))
        self._spans: dict[int, dict[str, VideoSpan]] = {entry.index: {} for entry in sought}
        for key in self._keys if sought else ():
            self._claim(key, self._list_gaps(key, taken), sought)

    def find(self, entry: EpisodeEntry) -> Mapping[str, VideoSpan] | str:
        """Return the location of an episode's images, or the fault if it is unknown."""
        fault = self._faults.get(entry.index)
        if fault is None:
            return entry.videos
        spans = self._spans[entry.index]
        if spans.keys() != set(self._keys) or self._check(spans, entry):
            return fault
        if entry.videos or entry.faults:
            places = ", ".join(f"{span.file} from {span.start:.2f} s on" for span in spans.values())
            self._note(f"the images of episode {entry.index} are found: {places}")
        return spans

    def _list_gaps(self, key: str, taken: Mapping[int, EpisodeEntry]) -> list[_Gap]:
        """List the unassigned images of a camera, file by file."""
        spans: dict[Path, list[tuple[int, int, int]]] = {}
        for index, entry in taken.items():
            span = entry.videos.get(key)
            if span is not None:
                start, stop = (round(each * self._fps) for each in (span.start, span.stop))
                spans.setdefault(span.file, []).append((start, stop, index))
        gaps: list[_Gap] = []
        held: list[tuple[int | None, _Gap | None]] = []  # (episode, gap) in file order
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
        """Assign gaps to the episodes whose images are sought, both in order."""
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
                    f"{gap.file}: {gap.size - gap.used} images at its end belong to no episode"
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
        """Check the images of an episode; return the fault, empty if there is none."""
        for key, span in spans.items():
            index = self._index(span.file)
            if index is None:
                return f"its images of '{key}' are not readable"
            dropped = entry.facts.get("dropped_frames")
            missing = index.count_missing(span.start, entry.length, self._fps)
            if missing > (dropped if isinstance(dropped, int) else 0):
                return f"{missing} of its {entry.length} images of '{key}' are gone"
            damaged = index.count_damaged(span.start, span.stop, self._fps)
            if damaged:
                return f"{damaged} of its {entry.length} images of '{key}' are damaged"
        return ""
