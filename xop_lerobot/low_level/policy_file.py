"""Where FALCON's network comes from: a given file, the cache, or its public repository."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path

from xop_lerobot.errors import PolicyFileError

logger = logging.getLogger(__name__)

FALCON_REVISION = "b29f11a8cca73919b69b6b3edf889c7f68db30fc"
FALCON_URL = (
    f"https://raw.githubusercontent.com/LeCAR-Lab/FALCON/{FALCON_REVISION}"
    "/sim2real/models/falcon/g1_29dof.onnx"
)
FALCON_SHA256 = "8ac8f51875b878a79d9b5782e702b66572697e204ed262e2002b55631f3105d0"
FALCON_FILE = "falcon_g1_29dof.onnx"


def compute_sha256(path: Path) -> str:
    """Compute the SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def falcon_cache_path() -> Path:
    """Return where the downloaded network is kept."""
    import pooch  # noqa: PLC0415

    return Path(pooch.os_cache("xop-lerobot")) / FALCON_FILE


def find_falcon_file(path: str | None = None) -> Path:
    """Find FALCON's network: at `path`, else in the cache, else download it.

    A file given by `path` may have another checksum (one may train one's own); this is
    logged. The cached and the downloaded file must have the known one.

    Raises:
        PolicyFileError: If there is no file at `path`; if the cached or downloaded file is
            altered; if it is absent and cannot be downloaded (names the three ways).
    """
    if path is not None:
        return _check_given_file(Path(path).expanduser())
    cached = falcon_cache_path()
    if not cached.is_file():
        return _download(cached)
    actual = compute_sha256(cached)
    if actual != FALCON_SHA256:
        raise PolicyFileError(
            f"policy file '{cached}' has SHA-256 {actual}, expected {FALCON_SHA256}. "
            "Delete it, and it will be downloaded again."
        )
    return cached


def _check_given_file(path: Path) -> Path:
    if not path.is_file():
        raise PolicyFileError(
            f"policy file '{path}' does not exist. Give FALCON's g1_29dof.onnx with "
            "--robot.low_level.path=FILE, or no path to use the cached or downloaded one."
        )
    actual = compute_sha256(path)
    if actual != FALCON_SHA256:
        logger.warning(
            "policy file '%s' has SHA-256 %s, not that of the released FALCON (%s); using it",
            path,
            actual,
            FALCON_SHA256,
        )
    return path


def _download(target: Path) -> Path:
    import pooch  # noqa: PLC0415
    import requests  # noqa: PLC0415

    downloader = pooch.HTTPDownloader(progressbar=True, timeout=(10, 60))
    try:
        pooch.retrieve(
            FALCON_URL,
            known_hash=f"sha256:{FALCON_SHA256}",
            fname=target.name,
            path=target.parent,
            downloader=downloader,  # pyright: ignore[reportArgumentType] # pooch takes any callable
        )
    except (requests.RequestException, OSError) as error:
        raise PolicyFileError(
            f"FALCON's network is not on this machine and could not be downloaded "
            f"({type(error).__name__}). Three ways to provide it: "
            f"(1) --robot.low_level.path=FILE with a copy of g1_29dof.onnx; "
            f"(2) put it into the cache as '{target}'; "
            f"(3) be online once, it is downloaded from {FALCON_URL}. "
            "Or use --robot.low_level.name=default, which ships with the package."
        ) from error
    except ValueError as error:  # pooch: the download does not have the known hash
        raise PolicyFileError(
            f"the download of {FALCON_URL} does not have SHA-256 {FALCON_SHA256}: {error}"
        ) from error
    return target
