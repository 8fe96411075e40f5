"""Where a new dataset is built, and how it gets to its place: as a whole, or not at all.

Everything lies beside the place, in a hidden directory `.<name>.curating`, until it is finished:

    lock         held by the run that is at work
    dataset/     the dataset being built
    previous/    the dataset that it replaces, for as long as its deletion takes

The last step is one rename. Where a dataset is changed in place, the two change names with each
other in one step, so that at any moment one of them is there, whole.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
from pathlib import Path
from types import TracebackType
from typing import IO

from xop_lerobot.collect.folder import FolderTaken, sync_folder, sync_tree
from xop_lerobot.core.errors import XopError

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
_NOT_SUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)


class Destination:
    """A new dataset's place; a context in which it is built.

        with Destination(out, source.root) as draft:
            make_dataset(root=draft)

    When the block ends, the draft is written to the disk and takes its place. When it raises,
    nothing stays behind, and nothing that was there has changed.

    Args:
        out: Directory of the new dataset; None to change the source in place.
        source: Directory of the dataset that is read.
        others: Directories of further ones.

    Attributes:
        root: Where the dataset will be.
        in_place: Whether it replaces the source.
        draft: Where it is built. It does not exist when the block begins; its parent does.

    Raises:
        FolderTaken: If `out` is there already, or lies in a source, or a source in it.
    """

    def __init__(self, out: Path | None, source: Path, *others: Path) -> None:
        self.in_place = out is None
        self.root = source.resolve() if out is None else _find_place(out)
        self._work = self.root.with_name(f".{self.root.name}.curating")
        self.draft, self._previous = self._work / "dataset", self._work / "previous"
        self._lock: IO[str] | None = None
        self._made: list[Path] = []
        if self.in_place:
            if self.root.is_mount():
                raise FolderTaken(
                    f"'{source}' is a mount point, which a dataset can't take the place of. "
                    "Use --out=DIR"
                )
            return
        if os.path.lexists(self.root):
            raise FolderTaken(f"'{out}' exists already. Choose another --out, or delete it")
        for folder in (source, *others):
            held = folder.resolve()
            if self.root.is_relative_to(held):
                raise FolderTaken(
                    f"'{out}' is inside of the dataset '{folder}'. Choose another --out"
                )

    def __enter__(self) -> Path:
        try:
            self._make_parents()
            self._take_lock()
            self._finish_exchange()
            for folder in (self.draft, self._previous):
                shutil.rmtree(folder, ignore_errors=True)
        except XopError:  # FolderTaken is an OSError too
            self._clean_up()
            raise
        except OSError as error:
            self._clean_up()
            raise XopError(f"nothing can be written beside '{self.root}': {error}") from error
        return self.draft

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if error is None:
                try:
                    self._put()
                except XopError:
                    raise
                except OSError as fault:
                    raise XopError(f"'{self.root}' could not be written: {fault}") from fault
        finally:
            self._clean_up(keep_parents=error is None)

    def _make_parents(self) -> None:
        missing = []
        folder = self._work
        while not folder.exists():
            missing.append(folder)
            folder = folder.parent
        for folder in reversed(missing):
            folder.mkdir(exist_ok=True)
            self._made.append(folder)

    def _take_lock(self) -> None:
        path = self._work / "lock"
        lock = path.open("w", encoding="utf-8")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # A run that ends deletes the lock with all the rest; then this one is nobody's.
            is_ours = path.exists() and path.samefile(f"/dev/fd/{lock.fileno()}")
        except BlockingIOError:
            is_ours = False
        if not is_ours:
            lock.close()
            raise FolderTaken(f"another xop-curate is at work on '{self.root}'. Wait for it")
        self._lock = lock

    def _finish_exchange(self) -> None:
        """Put back what a kill between two renames left beside its place."""
        if self._previous.exists() and not self.root.exists():
            os.rename(self._previous, self.root)

    def _put(self) -> None:
        if not self.draft.is_dir():
            raise XopError(f"nothing was written for '{self.root}'")
        sync_tree(self.draft)
        if self.in_place:
            exchange(self.draft, self.root, self._previous)
        elif os.path.lexists(self.root):  # somebody made it meanwhile
            raise FolderTaken(f"'{self.root}' exists already. Choose another --out, or delete it")
        else:
            os.rename(self.draft, self.root)
        sync_folder(self.root.parent)

    def _clean_up(self, keep_parents: bool = False) -> None:
        if self._lock is not None:
            shutil.rmtree(self._work, ignore_errors=True)
            self._lock.close()
            self._lock = None
        if keep_parents:
            return
        for folder in reversed(self._made):
            if not folder.exists():
                continue
            try:
                folder.rmdir()
            except OSError:  # not empty: somebody else's by now
                break


def _find_place(out: Path) -> Path:
    """Resolve all of a path but a link in its last part, which is a thing that is there."""
    return out.parent.resolve() / out.name if out.name not in ("", "..") else out.resolve()


def exchange(new: Path, old: Path, spare: Path) -> None:
    """Let two directories of one file system change names with each other.

    On Linux that is one step, which no kill can cut in two. A file system without it (some network
    ones) takes two renames; a kill between them leaves the old one at `spare`, whole, and the next
    `Destination` of the same place puts it back.

    Args:
        new: Directory that takes the place of `old`.
        old: Directory that is there.
        spare: Where `old` is while it has two names to change, and stays in that case.
    """
    if not _exchange_at_once(new, old):
        os.rename(old, spare)
        os.rename(new, old)


def _exchange_at_once(first: Path, second: Path) -> bool:
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    names = (os.fsencode(first), os.fsencode(second))
    if rename(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in _NOT_SUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(first), None, str(second))
