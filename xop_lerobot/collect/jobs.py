"""Episodes made in parallel, by processes of this machine or of a Ray cluster.

A worker of this machine writes into the collection's folder itself. Those of a cluster need no
common disk: their episodes come as bytes, and are written here.
"""

from __future__ import annotations

import dataclasses
import io
import os
import sys
import tarfile
import tempfile
import time
from collections.abc import Generator, Iterable
from contextlib import closing
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from xop_lerobot.core.errors import XopError
from xop_lerobot.core.pool import run_jobs

if TYPE_CHECKING:
    from xop_lerobot.collect.config import CollectConfig
    from xop_lerobot.collect.folder import Attempt, CollectFolder
    from xop_lerobot.collect.worker import Collector

_TRIES = 2
"""How often a worker may die over one episode before the run is given up."""
_HEAVY = ("xop_lerobot.collect.worker", "mujoco", "onnxruntime")
"""What takes the workers long to import; done once where processes can be forked."""


class WorkerFailed(XopError):
    """A worker could not make an episode; the message says which and why."""


def make_attempts(
    config: CollectConfig,
    folder: CollectFolder,
    jobs: Iterable[Any],
    workers: int,
    run: float,
    ray: str = "",
) -> Generator[Attempt]:
    """Make the episodes of `jobs` with several workers, and yield each when it counts.

    Closing the iterator ends the workers, which is safe at any moment.

    Args:
        config: What is collected.
        folder: Where to.
        jobs: What the episodes are made from: their indices, or what `config`'s maker takes.
        workers: Number of workers; 0 for one for each core.
        run: When this run began [s since the epoch].
        ray: Address of a Ray cluster that makes them; empty for processes of this machine.

    Raises:
        WorkerFailed: If an episode raises, or its worker dies again.
        XopError: If the cluster is not there, or not like this machine.
    """
    if ray:
        from xop_lerobot.core.pool_ray import run_jobs_on_ray  # noqa: PLC0415 optional

        ship = _Ship(config, run)
        results = run_jobs_on_ray(ship, jobs, workers, address=ray, tries=_TRIES)
    else:
        crew = workers or len(os.sched_getaffinity(0))
        save = _Save(config, run, folder)
        results = run_jobs(save, jobs, crew, tries=_TRIES, preload=_HEAVY)
    with closing(results):
        for result in results:
            index = get_index(result.job)
            if result.again:
                print(f"episode {index}: {result.error}; once more", file=sys.stderr)
            elif result.error:
                raise WorkerFailed(f"episode {index}: {result.error}")
            else:
                yield result.value if not ray else _unpack(folder, *result.value)


def get_index(job: Any) -> int:
    """Return the index of the episode that a job makes; the job may be that index itself."""
    return job if isinstance(job, int) else job.index


@dataclasses.dataclass
class _Job:
    """Makes episodes in a worker; the robot lives on from one to the next."""

    config: CollectConfig
    run: float

    @cached_property
    def maker(self) -> Collector:
        """What makes them."""
        return resolve_name(self.config.maker)(self.config, self.run)


@dataclasses.dataclass
class _Save(_Job):
    """Writes them into the collection's folder."""

    folder: CollectFolder

    def __call__(self, job: Any) -> Attempt:
        maker = self.maker
        draft = self.folder.open_attempt(get_index(job))
        attempt = maker.make(job, draft)
        self.folder.close_attempt(draft, attempt)
        return attempt


class _Ship(_Job):
    """Returns their files, packed."""

    def __call__(self, job: Any) -> tuple[Attempt, bytes]:
        maker = self.maker
        with tempfile.TemporaryDirectory(prefix="xop-episode-") as draft:
            attempt = maker.make(job, Path(draft))
            packed = io.BytesIO()
            # Not compressed: parquet and video are already.
            with tarfile.open(fileobj=packed, mode="w") as archive:
                archive.add(draft, arcname=".")
        return attempt, packed.getvalue()


def _unpack(folder: CollectFolder, attempt: Attempt, packed: bytes) -> Attempt:
    """Write an episode that came from another machine, and let it count."""
    attempt = dataclasses.replace(attempt, elapsed=time.time() - attempt.run)
    draft = folder.open_attempt(attempt.index)
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        archive.extractall(draft, filter="data")
    folder.close_attempt(draft, attempt)
    return attempt
