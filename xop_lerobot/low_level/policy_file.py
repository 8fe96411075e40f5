"""Files of policies: given by the user, beside their table, in the cache, or downloaded once."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path

from xop_lerobot.core.errors import PolicyFileError
from xop_lerobot.low_level.description import File

logger = logging.getLogger(__name__)


def compute_sha256(path: Path) -> str:
    """Compute the SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def cache_folder() -> Path:
    """Return the folder of downloaded files."""
    import pooch  # noqa: PLC0415

    return Path(pooch.os_cache("xop-lerobot"))


@dataclass(frozen=True)
class FileFinder:
    """Finds the files of one policy.

    Attributes:
        title: Name of the policy in messages.
        folder: Folder of its table, which may contain its files.
        given: File or folder given by the user; None for none.
        num_files: Number of its files; a single one may be given by its own path.
    """

    title: str
    folder: Path
    given: Path | None
    num_files: int

    def find(self, file: File) -> Path:
        """Find one file.

        A file given by the user, or beside the table, may have another checksum, since it may be
        self-trained; that is logged. A cached or downloaded file must have the expected one.

        Raises:
            PolicyFileError: If the given file is missing; if a cached or downloaded file has
                another checksum; if none is found and the download fails (lists the remedies).
        """
        if self.given is not None:
            return self._take_given(file, self.given)
        beside = self.folder / file.name
        if beside.is_file():
            self._warn_of_another(beside, file)
            return beside
        cached = cache_folder() / file.name
        if not cached.is_file():
            return self._download(file, cached)
        actual = compute_sha256(cached)
        if file.sha256 is not None and actual != file.sha256:
            raise PolicyFileError(
                f"policy file '{cached}' has SHA-256 {actual}, expected {file.sha256}. "
                "Delete it, and it will be downloaded again."
            )
        return cached

    def _take_given(self, file: File, given: Path) -> Path:
        name = Path(file.name).name
        path = given / name if given.is_dir() else given
        if not path.is_file():
            raise PolicyFileError(
                f"policy file '{path}' does not exist. Give {self.title}'s {name}, or the folder "
                "that holds it, with --robot.low_level.path=PATH, or no path"
            )
        if self.num_files > 1 and not given.is_dir():
            raise PolicyFileError(
                f"{self.title} has {self.num_files} files; give their folder with "
                f"--robot.low_level.path=FOLDER, got '{given}'"
            )
        self._warn_of_another(path, file)
        return path

    def _warn_of_another(self, path: Path, file: File) -> None:
        if file.sha256 is None:
            return
        actual = compute_sha256(path)
        if actual != file.sha256:
            logger.warning(
                "policy file '%s' has SHA-256 %s, not that of the released %s (%s); using it",
                path,
                actual,
                self.title,
                file.sha256,
            )

    def _download(self, file: File, target: Path) -> Path:
        import pooch  # noqa: PLC0415
        import requests  # noqa: PLC0415

        ways = (
            f"(1) --robot.low_level.path=PATH with a copy of {target.name}, or its folder; "
            f"(2) put it into the cache as '{target}'"
        )
        if file.url is None:
            raise PolicyFileError(
                f"{self.title}'s {target.name} is not on this machine, and it can't be downloaded. "
                f"Two ways to provide it: {ways}."
            )
        downloader = pooch.HTTPDownloader(progressbar=True, timeout=(10, 60))
        known = None if file.sha256 is None else f"sha256:{file.sha256}"
        try:
            pooch.retrieve(
                file.url,
                known_hash=known,
                fname=target.name,
                path=target.parent,
                downloader=downloader,  # pyright: ignore[reportArgumentType] # takes any callable
            )
        except (requests.RequestException, OSError) as error:
            raise PolicyFileError(
                f"{self.title}'s {target.name} is not on this machine and could not be downloaded "
                f"({type(error).__name__}). Three ways to provide it: {ways}; (3) be online once, "
                f"it is downloaded from {file.url}. "
                "Or use --robot.low_level.name=default, which ships with the package."
            ) from error
        except ValueError as error:  # pooch: the download does not have the known hash
            raise PolicyFileError(
                f"the download of {file.url} does not have SHA-256 {file.sha256}: {error}"
            ) from error
        return target
