"""Make the missing episodes of a dataset in parallel, and merge all of them.

Episodes are made by processes of this machine or of a Ray cluster. A local worker writes into the
collection's folder itself. Workers of a cluster need no shared disk: their episodes are sent as
bytes and written here.
"""

from __future__ import annotations

import dataclasses
import io
import os
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Self

from tqdm import tqdm

from xop_lerobot.collect.folder import Attempt, CollectFolder
from xop_lerobot.core.command_line import say_count
from xop_lerobot.core.errors import XopError
from xop_lerobot.core.pool import run_jobs

if TYPE_CHECKING:
    from xop_lerobot.collect.config import CollectConfig
    from xop_lerobot.collect.worker import Collector

_TRIES = 2
"""Number of times a worker may die over one episode before the run is aborted."""
_HEAVY = ("xop_lerobot.collect.worker", "mujoco", "onnxruntime")
"""Slow imports of the workers, done once in the parent if processes can be forked."""


class WorkerFailed(XopError):
    """A worker failed to make an episode; the message names it and the reason."""


def make_attempts(
    config: CollectConfig,
    folder: CollectFolder,
    jobs: Iterable[Any],
    workers: int,
    run: float,
    ray: str = "",
) -> Generator[Attempt]:
    """Make the episodes of `jobs` with several workers, and yield each when finished.

    Closing the iterator ends the workers, which is safe at any time.

    Args:
        config: Configuration of the collection.
        folder: Files of the collection.
        jobs: Episode indices, or the jobs that `config`'s maker takes.
        workers: Number of workers; 0 for one per core.
        run: Start time of this run [s since the epoch].
        ray: Address of a Ray cluster; empty for processes of this machine.

    Raises:
        WorkerFailed: If an episode raises, or its worker dies `_TRIES` times.
        XopError: If the cluster cannot be reached, or differs from this machine.
    """
    if ray:
        from xop_lerobot.core.pool_ray import run_jobs_on_ray  # noqa: PLC0415 optional

        ship = _Ship(config, run)
        results = run_jobs_on_ray(ship, jobs, workers, address=ray, tries=_TRIES)
    else:
        count = workers or len(os.sched_getaffinity(0))
        save = _Save(config, run, folder)
        results = run_jobs(save, jobs, count, tries=_TRIES, preload=_HEAVY)
    with closing(results):
        for result in results:
            index = get_index(result.job)
            if result.again:
                print(f"episode {index}: {result.error}; retrying", file=sys.stderr)
            elif result.error:
                raise WorkerFailed(f"episode {index}: {result.error}")
            else:
                yield result.value if not ray else _unpack(folder, *result.value)


def get_index(job: Any) -> int:
    """Return the episode index of a job, which may be the index itself."""
    return job if isinstance(job, int) else job.index


@dataclasses.dataclass
class _Job:
    """Makes episodes in a worker process; the robot is reused between them."""

    config: CollectConfig
    run: float

    @cached_property
    def maker(self) -> Collector:
        """The maker of the episodes, created on first use in the worker."""
        return resolve_name(self.config.maker)(self.config, self.run)


@dataclasses.dataclass
class _Save(_Job):
    """Writes episodes into the collection's folder."""

    folder: CollectFolder

    def __call__(self, job: Any) -> Attempt:
        maker = self.maker
        draft = self.folder.open_attempt(get_index(job))
        attempt = maker.make(job, draft)
        self.folder.close_attempt(draft, attempt)
        return attempt


class _Ship(_Job):
    """Returns the files of episodes as a tar archive."""

    def __call__(self, job: Any) -> tuple[Attempt, bytes]:
        maker = self.maker
        with tempfile.TemporaryDirectory(prefix="xop-episode-") as draft:
            attempt = maker.make(job, Path(draft))
            packed = io.BytesIO()
            # Not compressed: Parquet and video already are.
            with tarfile.open(fileobj=packed, mode="w") as archive:
                archive.add(draft, arcname=".")
        return attempt, packed.getvalue()


def _unpack(folder: CollectFolder, attempt: Attempt, packed: bytes) -> Attempt:
    """Unpack an episode from another machine, and mark it as finished."""
    attempt = dataclasses.replace(attempt, elapsed=time.time() - attempt.run)
    draft = folder.open_attempt(attempt.index)
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        archive.extractall(draft, filter="data")
    folder.close_attempt(draft, attempt)
    return attempt


@dataclass(frozen=True)
class Collection:
    """Outcome of a collection.

    Attributes:
        attempts: Episodes of the dataset and all that were requested.
        wall_s: Duration of all runs, each killed one until its last finished episode [s].
    """

    attempts: tuple[Attempt, ...]
    wall_s: float


def run_collection(
    config: CollectConfig,
    folder: CollectFolder,
    indices: Sequence[int],
    *,
    repo_id: str = "",
    workers: int = 0,
    ray: str = "",
    quiet: bool = False,
    make_jobs: Callable[[Sequence[int]], Iterable[Any]] = iter,
) -> Collection:
    """Make the missing episodes, and merge all into one dataset.

    Args:
        config: Configuration of the collection.
        folder: Files of the collection.
        indices: Episodes that the dataset should have.
        repo_id: Name of the dataset; empty for `local/` and the directory's name.
        workers: Number of workers; 0 for one per core.
        ray: Address of a Ray cluster; empty for processes of this machine.
        quiet: Whether to hide the progress.
        make_jobs: Makes the jobs for missing indices that `config`'s maker takes.

    Raises:
        XopError: If the directory is taken, or an episode fails.
    """
    begin, start = time.time(), time.perf_counter()
    settings = config.to_settings()
    with folder.hold(settings):
        done = folder.list_attempts()
        missing = [index for index in indices if index not in done]
        # `closing`: no worker may outlive the lock on the folder.
        made = make_attempts(config, folder, make_jobs(missing), workers, begin, ray)
        with _Progress(config, len(missing), quiet=quiet) as progress, closing(made):
            if done:
                progress.say(f"{say_count(len(done), 'episode')} already done, skipping")
            for attempt in made:
                done[attempt.index] = attempt
                progress.note(attempt)
            are_new = bool(folder.read_attempts().keys() & set(indices))
            if are_new:
                progress.say("merging the episodes")
        walls = _compute_walls(folder, done)

        def note_walls() -> dict[str, float]:
            return walls | {str(begin): time.perf_counter() - start}

        merged = folder.read_dataset()
        if are_new:
            from xop_lerobot.collect.merge import merge_attempts  # noqa: PLC0415 torch

            repo_id = repo_id or f"local/{folder.root.name}"
            merge_attempts(folder, indices, repo_id, settings, note_walls)
            merged, walls = folder.read_dataset(), note_walls()
        counted = [Attempt(**row) for row in merged.get("attempts", ())]
        held = {attempt.index for attempt in counted}
        counted += [done[index] for index in indices if index not in held]
    return Collection(tuple(counted), sum(walls.values()))


def _compute_walls(folder: CollectFolder, attempts: dict[int, Attempt]) -> dict[str, float]:
    """Duration of each run [s], by its start; of a killed run until its last episode."""
    walls: dict[str, float] = dict(folder.read_dataset().get("walls", {}))
    for attempt in attempts.values():
        run = str(attempt.run)
        walls[run] = max(walls.get(run, 0.0), attempt.elapsed)
    return walls


class _Progress:
    """Reports progress on stderr: a line per episode, and a bar on a terminal.

    Args:
        config: What is collected.
        missing: Number of episodes to make.
        quiet: Whether to print nothing.
    """

    def __init__(self, config: CollectConfig, missing: int, *, quiet: bool) -> None:
        self._config, self._missing, self._quiet = config, missing, quiet
        self._start = time.perf_counter()
        self._made = self._frames = self._successes = 0
        # None: hide the bar if stderr is not a terminal.
        self._bar = tqdm(total=missing, unit="episode", disable=quiet or None, leave=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        if self._quiet:
            return
        if self._bar.disable:
            print(text, file=sys.stderr, flush=True)
        else:
            self._bar.write(text, file=sys.stderr)

    def note(self, attempt: Attempt) -> None:
        """Print the outcome of one episode."""
        self._made += 1
        self._frames += attempt.frames
        self._successes += attempt.success
        elapsed = time.perf_counter() - self._start
        left = elapsed / self._made * (self._missing - self._made)
        seconds = 1 / self._config.fps
        succeeded = f"{self._successes} succeeded, " if self._config.task else ""
        self._bar.update()
        self.say(
            f"episode {attempt.index}: {self._config.describe(attempt)}, "
            f"{attempt.frames * seconds:.1f} s. {self._made} of {self._missing} made, {succeeded}"
            f"{self._frames * seconds / elapsed:.2f} x real time, {left / 60:.1f} min left"
        )
