"""Video files of a new dataset, for one camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from xop_lerobot.curate.row_files import next_place
from xop_lerobot.curate.video import (
    Cut,
    VideoFile,
    VideoIndex,
    copy_whole,
    index_video,
)


class VideoFiles:
    """Writes images of episodes.

    A video of a single episode is copied unchanged. Consecutive episodes from one source file share
    a file.

    Args:
        root: Directory of the new dataset.
        template: `video_path` of its `meta/info.json`.
        chunks_size: Number of files per directory.
        key: Feature key of the camera.
        fps: Frame rate [Hz].
    """

    def __init__(self, root: Path, template: str, chunks_size: int, key: str, fps: float) -> None:
        self._root, self._template, self._chunks_size = root, template, chunks_size
        self._key, self._fps = key, fps
        self._place = (0, -1)
        self._origin: tuple[Path, Path] | None = None
        self._index: VideoIndex | None = None
        self._file: VideoFile | None = None

    def write(self, cut: Cut) -> dict[str, Any]:
        """Write the images of an episode.

        Returns:
            Their location, as columns of LeRobot's episode metadata.

        Raises:
            BadDataset: If images are missing, or the video is not readable.
        """
        origin = (cut.root, cut.file)
        if origin != self._origin or self._index is None:
            self._index, self._origin = index_video(cut.root, cut.file), origin
            self.close()
        cut.check(self._index, self._fps)
        start, stop = cut.start, cut.stop
        if self._file is None:
            self._place = next_place(self._place, self._chunks_size)
        path = self._find_path()
        if self._file is not None or not copy_whole(cut, self._index, path, self._fps):
            if self._file is None:
                self._file = VideoFile(path, self._fps)
            start, stop = self._file.add(cut, self._index)
        prefix = f"videos/{self._key}/"
        return {
            f"{prefix}chunk_index": self._place[0],
            f"{prefix}file_index": self._place[1],
            f"{prefix}from_timestamp": start,
            f"{prefix}to_timestamp": stop,
        }

    def _find_path(self) -> Path:
        chunk, file = self._place
        return self._root / self._template.format(
            video_key=self._key, chunk_index=chunk, file_index=file
        )

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._file is not None:
            self._file.close()
            self._file = None
