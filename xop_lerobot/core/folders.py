"""Folders and files that a kill cannot leave half written, and the lock of who writes them.

A run works in a folder beside the place and renames the finished one into it. Everything is on the
disk before it is renamed, so a kill or a power cut leaves the old folder or the new one, whole.
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
    """The folder holds something that must not be touched, or another run works on it."""


def lock_folder(folder: Path, refusal: str) -> IO[str]:
    """Lock a work folder, until the file that is returned is closed or the process ends.

    Raises:
        FolderTaken: With `refusal`, if another run holds the lock.
    """
    path = folder / "lock"
    lock = path.open("w", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # A run that ends deletes its work folder, and with it a lock that was opened before.
        if path.exists() and path.samefile(f"/dev/fd/{lock.fileno()}"):
            return lock
    except BlockingIOError:
        pass
    lock.close()
    raise FolderTaken(refusal)


def check_no_mount(place: Path, remedy: str) -> None:
    """Raise `FolderTaken`, ending in `remedy`, if no folder can be renamed to `place`."""
    if place.is_mount():
        raise FolderTaken(
            f"'{place}' is a mount point, which a dataset can't take the place of. {remedy}"
        )


def swap_in(new: Path, place: Path, spare: Path) -> None:
    """Put the folder `new` at `place`, which is on the same file system and may hold another.

    The old folder ends up at `new`: on Linux, two folders exchange their names in one step. Where
    the file system cannot do that (some network ones), two renames put it to `spare`.
    """
    sync_tree(new)
    if not place.exists():
        os.rename(new, place)
    elif not _exchange_at_once(new, place):
        os.rename(place, spare)
        os.rename(new, place)
    sync(place.parent)


def finish_swap(place: Path, spare: Path, new: Path | None = None) -> None:
    """Mend a `swap_in` that was cut between its two renames, with `new` if given, else `spare`."""
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
    """Write a JSON file that is there as a whole or not at all."""
    draft = path.with_name(f"{path.name}.tmp")
    draft.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    os.replace(draft, path)


def append_line(path: Path, line: str) -> None:
    """Append a JSON line and see it on the disk; what a kill has left of one before it goes."""
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
    """Read a file of JSON lines, None for a line that is no object; one cut off at the end goes."""
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
    """See everything under `folder` on the disk."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def sync(path: Path) -> None:
    """See a file, or the names in a folder, on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
