"""Atomic writes of folders and files, and locks of folders.

A run works in a temporary folder beside the destination and renames it into place when complete.
Everything is flushed to disk before, so a kill or power cut leaves either the old or the new
folder, complete.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from xop_lerobot.core.errors import XopError

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
_NOT_SUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)


class FolderTaken(XopError):
    """The folder contains data that must not be overwritten, or another run is using it."""


def lock_folder(folder: Path, refusal: str) -> IO[str]:
    """Lock a work folder until the returned file is closed or the process ends.

    Raises:
        FolderTaken: With the message `refusal`, if another run holds the lock.
    """
    path = folder / "lock"
    lock = path.open("w", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # A run that ends deletes its work folder, and with it a lock file that we opened before.
        if path.exists() and path.samefile(f"/dev/fd/{lock.fileno()}"):
            return lock
    except BlockingIOError:
        pass
    lock.close()
    raise FolderTaken(refusal)


def check_no_mount(place: Path, remedy: str) -> None:
    """Raise `FolderTaken`, with `remedy`, if `place` is a mount point that can't be replaced."""
    if place.is_mount():
        raise FolderTaken(
            f"'{place}' is a mount point, which a dataset can't take the place of. {remedy}"
        )


def swap_in(new: Path, place: Path, spare: Path) -> None:
    """Move the folder `new` to `place`, on the same file system, replacing any folder there.

    On Linux the two folders exchange their names atomically, so the old one ends up at `new`. File
    systems without that (some network ones) need two renames, and the old one ends up at `spare`.
    """
    sync_tree(new)
    if not place.exists():
        os.rename(new, place)
    elif not _exchange_at_once(new, place):
        os.rename(place, spare)
        os.rename(new, place)
    sync(place.parent)


def finish_swap(place: Path, spare: Path, new: Path | None = None) -> None:
    """Complete a `swap_in` interrupted between its renames: with `new` if it exists, else undo."""
    if spare.exists() and not place.exists():
        os.rename(new if new is not None and new.exists() else spare, place)


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


def write_whole(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file atomically."""
    draft = path.with_name(f"{path.name}.tmp")
    draft.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    os.replace(draft, path)


def append_line(path: Path, line: str) -> None:
    """Append a JSON line and flush it to disk; an incomplete last line is removed first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as file:
        file.seek(0)
        rest = file.read().rpartition(b"\n")[2]
        if _read_line(rest) is None:
            file.truncate(file.tell() - len(rest))
            rest = b""
        file.write((b"\n" if rest else b"") + line.encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def read_lines(path: Path) -> list[dict[str, Any] | None]:
    """Read JSON lines; None for a line that is not an object. A broken last line is dropped."""
    lines = path.read_bytes().split(b"\n") if path.exists() else [b""]
    rows = [_read_line(line) for line in lines]
    return rows if rows[-1] is not None else rows[:-1]


def _read_line(line: bytes) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except ValueError:
        return None
    return row if isinstance(row, dict) else None


def sync_tree(folder: Path) -> None:
    """Flush everything under `folder` to disk."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def sync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
