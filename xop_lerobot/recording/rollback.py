"""Undo an episode that could not be saved.

A save creates files of rows, images and metadata, and rewrites a few small ones in place. If the
disk fills up meanwhile, LeRobot leaves truncated files and a truncated `info.json`, and continues
writing when closed, so the dataset no longer loads. Here new files are removed, which also frees
space, and the small ones are restored.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xop_lerobot.core.command_line import say_count
from xop_lerobot.core.errors import XopError
from xop_lerobot.recording.facts import EPISODES_FILE

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

_FOLDERS = ("data", "videos", "meta")
_TEMPORARY = "tmp????????"
"""LeRobot's temporary directories for videos being encoded, inside the dataset."""
_FULL_BELOW = 1 << 20
"""Free space below which a full disk is assumed to be the reason for missing files [byte]."""


class NotSaved(XopError):
    """An episode could not be written.

    Args:
        root: Directory of the dataset.
        index: Index of the episode, which equals the number of complete ones.
        reason: Reason given by the system.
        whole: Whether the dataset is in its previous state.
    """

    def __init__(self, root: Path, index: int, reason: str, *, whole: bool = True) -> None:
        self.index, self.reason = index, reason
        text = f"episode {index} could not be saved to '{root}': {reason}. "
        if not whole:
            text += (
                f"What it left there could not be removed. `xop-curate repair --root {root} --out "
                "DIR` restores the episodes before it"
            )
        elif index:
            text += (
                f"What was saved before it is complete: {say_count(index, 'episode')}. Fix the "
                "cause, then continue with --resume=true"
            )
        else:
            text += "None was saved before it"
        super().__init__(text)


class Checkpoint:
    """Snapshot of a dataset's files, for rollback.

    Args:
        root: Directory of the dataset.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._files = set(self._list())
        self._rewritten = {
            path: path.read_bytes() for path in (root / "meta").glob("*") if path.is_file()
        }
        facts = root / EPISODES_FILE
        self._facts_size = facts.stat().st_size if facts.exists() else 0

    def restore(self) -> bool:
        """Restore the files; return whether all are restored."""
        try:
            for path in set(self._list()) - self._files:
                path.unlink()
            for folder in self._root.glob(_TEMPORARY):
                shutil.rmtree(folder, ignore_errors=True)
            for path, content in self._rewritten.items():
                if not path.exists() or path.read_bytes() != content:
                    replace_file(path, content)
            if self._facts_size:
                os.truncate(self._root / EPISODES_FILE, self._facts_size)
        except OSError:
            return False
        return True

    def _list(self) -> Iterator[Path]:
        for name in _FOLDERS:
            for folder, _, files in os.walk(self._root / name):
                yield from (Path(folder, file) for file in files)


def replace_file(path: Path, content: bytes) -> None:
    """Rewrite a file atomically: at any time there is the old or the new one, complete."""
    fresh = path.with_name(f".{path.name}.new")
    try:
        fresh.write_bytes(content)
        fresh.replace(path)
    except OSError:
        fresh.unlink(missing_ok=True)
        raise


def abandon_writers(dataset: LeRobotDataset) -> None:
    """Make LeRobot close `dataset` without finishing its open files.

    This uses private attributes of LeRobot, see the patch `ROLLBACK`; missing ones are ignored.
    """
    writer, meta = dataset.writer, dataset.meta
    if writer is not None:
        with suppress(Exception):
            writer.stop_image_writer()
        with suppress(Exception):
            writer.cancel_pending_videos()
    for owner in (writer, meta):
        if owner is not None:
            _drop(getattr(owner, "_pq_writer", None))
            owner._pq_writer, owner._finalized = None, True
    getattr(meta, "_metadata_buffer", []).clear()


def _drop(parquet: Any) -> None:
    """Close a Parquet writer whose file is discarded."""
    if parquet is None:
        return
    with suppress(Exception):
        parquet.close()
    parquet.is_open = False  # else garbage collection closes it again, which fails
    with suppress(Exception):
        parquet.file_handle.close()


@contextmanager
def rolled_back_on_failure(dataset: LeRobotDataset) -> Iterator[None]:
    """Save an episode in the block; on failure roll back and close `dataset`.

    Raises:
        NotSaved: If the system could not write.
    """
    info = dataset.meta.info
    counts = info.total_episodes, info.total_frames
    checkpoint = Checkpoint(dataset.root)
    try:
        yield
    except Exception as error:
        abandon_writers(dataset)
        whole = checkpoint.restore()
        # `dataset` may have reopened its files meanwhile, which resets its counts.
        dataset.meta.info.total_episodes, dataset.meta.info.total_frames = counts
        dataset.finalize()
        raise_if_not_written(dataset, error, whole=whole)
        raise


def raise_if_not_written(dataset: LeRobotDataset, error: Exception, *, whole: bool = True) -> None:
    """Raise `NotSaved` if `error` was caused by a failed write.

    Raises:
        NotSaved: If it was.
    """
    reason = find_reason(error)
    if reason and not isinstance(error, NotSaved):
        index = dataset.meta.total_episodes
        raise NotSaved(dataset.root, index, reason, whole=whole) from error


def check_pictures(dataset: LeRobotDataset, index: int) -> None:
    """Check that the image files of an episode were written.

    LeRobot's image writer only logs failed writes, and its encoder uses the files it finds: the
    video would be shorter than the episode, and its images shifted.

    Args:
        dataset: The dataset, with an episode about to be saved.
        index: Index of the episode.

    Raises:
        NotSaved: If one is missing.
    """
    writer = dataset.writer
    if writer is None:
        return
    if writer.image_writer is not None:
        writer.image_writer.wait_until_done()
    columns = [writer.episode_buffer.get(key, ()) for key in dataset.meta.camera_keys]
    paths = [Path(name) for column in columns for name in column if isinstance(name, str)]
    lost = [path for path in paths if not path.is_file() or path.stat().st_size == 0]
    if lost:
        reason = f"{len(lost)} of its {say_count(len(paths), 'image')} could not be written"
        if shutil.disk_usage(dataset.root).free < _FULL_BELOW:
            reason = f"{os.strerror(errno.ENOSPC)}; {reason}"
        raise NotSaved(dataset.root, index, reason)


def find_reason(error: BaseException | None) -> str:
    """Return why the system could not write; empty if `error` has another cause."""
    full = os.strerror(errno.ENOSPC)
    while error is not None:
        if isinstance(error, OSError):
            return os.strerror(error.errno) if error.errno else str(error).splitlines()[0]
        if full in str(error):  # raised in an encoder's thread
            return full
        error = error.__cause__ or error.__context__
    return ""
