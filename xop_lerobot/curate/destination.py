"""Atomic output of a dataset: it is built in a work folder and moved into place when complete.

The work folder is a hidden directory beside the destination, `.<name>.curating`:

    lock         held by the running process
    dataset/     the dataset being built
    previous/    the dataset that it replaces, until that is deleted

The last step is one rename. An in-place change exchanges both directories in one step, so one
complete dataset exists at any moment.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO

from xop_lerobot.core.errors import XopError
from xop_lerobot.core.folders import FolderTaken, check_no_mount, finish_swap, lock_folder, swap_in


class Destination:
    """Place of a new dataset; a context manager that yields the directory to build it in.

        with Destination(out, source.root) as draft:
            make_dataset(root=draft)

    On success the draft is flushed to disk and moved into place. On an exception it is removed and
    nothing that existed has changed.

    Args:
        out: Directory of the new dataset; None to replace the source.
        source: Directory of the source dataset.
        others: Directories of further source datasets.

    Attributes:
        root: Final directory.
        in_place: Whether it replaces the source.
        draft: Directory to build it in. It does not exist on entry; its parent does.

    Raises:
        FolderTaken: If `out` exists, or it and a source lie inside each other.
    """

    def __init__(self, out: Path | None, source: Path, *others: Path) -> None:
        self.in_place = out is None
        self.root = source.resolve() if out is None else _find_place(out)
        self._work = self.root.with_name(f".{self.root.name}.curating")
        self.draft, self._previous = self._work / "dataset", self._work / "previous"
        self._lock: IO[str] | None = None
        self._made: list[Path] = []
        if self.in_place:
            check_no_mount(self.root, "Use --out=DIR")
            return
        if os.path.lexists(self.root):
            raise FolderTaken(f"'{out}' exists already. Choose another --out, or delete it")
        for folder in (source, *others):
            held = folder.resolve()
            if self.root.is_relative_to(held):
                raise FolderTaken(f"'{out}' is inside the dataset '{folder}'. Choose another --out")

    def __enter__(self) -> Path:
        try:
            self._make_parents()
            refusal = f"another xop-curate is at work on '{self.root}'. Wait for it"
            self._lock = lock_folder(self._work, refusal)
            finish_swap(self.root, self._previous)
            for folder in (self.draft, self._previous):
                shutil.rmtree(folder, ignore_errors=True)
        except XopError:
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
                except OSError as fault:
                    raise XopError(f"'{self.root}' could not be written: {fault}") from fault
        finally:
            self._clean_up(keep_parents=error is None)

    def _make_parents(self) -> None:
        missing = [each for each in (self._work, *self._work.parents) if not each.exists()]
        for folder in reversed(missing):
            folder.mkdir(exist_ok=True)
            self._made.append(folder)

    def _put(self) -> None:
        if not self.draft.is_dir():
            raise XopError(f"nothing was written for '{self.root}'")
        if not self.in_place and os.path.lexists(self.root):  # created meanwhile
            raise FolderTaken(f"'{self.root}' exists already. Choose another --out, or delete it")
        swap_in(self.draft, self.root, self._previous)

    def _clean_up(self, keep_parents: bool = False) -> None:
        if self._lock is not None:
            shutil.rmtree(self._work, ignore_errors=True)
            self._lock.close()
            self._lock = None
        for folder in () if keep_parents else reversed(self._made):
            with suppress(OSError):  # already removed, or used by another process
                folder.rmdir()


def _find_place(out: Path) -> Path:
    """Resolve a path except for its last part: a link there is an existing file."""
    return out.parent.resolve() / out.name if out.name not in ("", "..") else out.resolve()
