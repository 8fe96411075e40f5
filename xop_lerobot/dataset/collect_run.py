"""Make the episodes of a dataset that are missing, and put all together."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xop_lerobot.dataset.collect_folder import Attempt, CollectFolder
from xop_lerobot.dataset.collect_jobs import make_attempts

if TYPE_CHECKING:
    from xop_lerobot.dataset.collect_config import CollectConfig


@dataclass(frozen=True)
class Collection:
    """What there is in the end.

    Attributes:
        attempts: Episodes of the dataset, or all that were asked for where there is none.
        wall_s: Time that all runs took, each killed one until its last finished episode [s].
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
    make_jobs: Callable[[Sequence[int]], Iterable[Any]] = iter,
) -> Collection:
    """Make the episodes that are not there yet, and merge all into one dataset.

    Args:
        config: What is collected.
        folder: Where to.
        indices: Which episodes there shall be.
        repo_id: Name of the dataset; empty for `local/` and the directory's name.
        workers: Number of workers; 0 for one for each core.
        ray: Address of a Ray cluster; empty for processes of this machine.
        make_jobs: Makes jobs for those of the indices that are missing, as `config`'s maker
            takes them.

    Raises:
        XopError: If the directory is taken, or an episode fails.
    """
    begin, start = time.time(), time.perf_counter()
    # Read when they are loaded: the merge would draw bars of its own.
    os.environ.setdefault("TQDM_DISABLE", "1")
    settings = config.to_settings()
    with folder.hold(settings):
        done = folder.list_attempts()
        missing = [index for index in indices if index not in done]
        progress = _Progress(len(missing), config.fps)
        if done:
            print(f"{len(done)} episodes are there already", file=sys.stderr)
        # Closed at once, whatever happens: no worker may outlive the hold on the folder.
        jobs = make_jobs(missing)
        with closing(make_attempts(config, folder, jobs, workers, begin, ray)) as attempts:
            for attempt in attempts:
                done[attempt.index] = attempt
                progress.note(attempt)
        walls = _compute_walls(folder, done)

        def note_walls() -> dict[str, float]:
            return walls | {str(begin): time.perf_counter() - start}

        merged = folder.read_dataset()
        if folder.read_attempts().keys() & set(indices):
            from xop_lerobot.dataset.collect_merge import merge_attempts  # noqa: PLC0415 torch

            print("putting the episodes together", file=sys.stderr)
            repo_id = repo_id or f"local/{folder.root.name}"
            merge_attempts(folder, indices, repo_id, settings, note_walls)
            merged, walls = folder.read_dataset(), note_walls()
        counted = [Attempt(**row) for row in merged.get("attempts", ())]
        counted = counted or [done[index] for index in indices]
    return Collection(tuple(counted), sum(walls.values()))


def _compute_walls(folder: CollectFolder, attempts: dict[int, Attempt]) -> dict[str, float]:
    """Compute how long each run took [s], by its start; a killed one until its last episode."""
    walls: dict[str, float] = dict(folder.read_dataset().get("walls", {}))
    for attempt in attempts.values():
        run = str(attempt.run)
        walls[run] = max(walls.get(run, 0.0), attempt.elapsed)
    return walls


class _Progress:
    """Says on standard error how far it is.

    Args:
        missing: How many episodes are still to be made.
        fps: Frames per second of simulated time [Hz].
    """

    def __init__(self, missing: int, fps: int) -> None:
        self._missing, self._fps = missing, fps
        self._start = time.perf_counter()
        self._made = self._frames = self._successes = 0

    def note(self, attempt: Attempt) -> None:
        """Say what came of one episode."""
        self._made += 1
        self._frames += attempt.frames
        self._successes += attempt.success
        elapsed = time.perf_counter() - self._start
        left = elapsed / self._made * (self._missing - self._made)
        outcome = "success" if attempt.success else attempt.failure or "no success"
        print(
            f"episode {attempt.index}: {outcome}, {attempt.frames / self._fps:.1f} s. "
            f"{self._made} of {self._missing} made, {self._successes} succeeded, "
            f"{self._frames / self._fps / elapsed:.2f} x real time, {left / 60:.1f} min left",
            file=sys.stderr,
        )
