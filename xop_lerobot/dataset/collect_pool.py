"""Worker processes that make episodes, replaced when they die and gone when the run is killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections import Counter
from collections.abc import Generator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from typing import TYPE_CHECKING

from xop_lerobot.dataset.collect_config import CollectConfig
from xop_lerobot.errors import XopError

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

    from xop_lerobot.dataset.collect_folder import Attempt, CollectFolder

type Context = ForkServerContext | SpawnContext

_MOST_DEATHS = 2
"""How often a worker may die over one episode before the run is given up."""
_HEAVY = ["lerobot.datasets", "mujoco", "onnxruntime"]
"""What takes the workers long to import; done once where processes can be forked."""
ENVIRONMENT = {
    # Each worker has one core: more threads would only wait for each other.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",
    "TQDM_DISABLE": "1",
}
"""What libraries read when they are loaded, where the user has not set it."""


class WorkerFailed(XopError):
    """A worker could not make an episode; the message says which and why."""


class _Worker:
    """One process, and the episode that it is at."""

    def __init__(self, context: Context, arguments: tuple) -> None:
        self.connection, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(
            target=_work, args=(theirs, *arguments), daemon=True
        )
        self.process.start()
        theirs.close()
        self.index: int | None = None

    def give(self, index: int) -> None:
        self.index = index
        try:
            self.connection.send(index)
        except OSError:
            pass  # it has died; its sentinel says so

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()


def make_episodes(
    config: CollectConfig,
    folder: CollectFolder,
    indices: Sequence[int],
    workers: int,
    run: float,
) -> Generator[Attempt]:
    """Make the episodes `indices` with several processes, and yield each when it counts.

    Closing the iterator kills the workers, which is safe at any moment.

    Args:
        config: What is collected.
        folder: Where to.
        indices: Which episodes.
        workers: Processes.
        run: When this run began [s since the epoch].

    Raises:
        WorkerFailed: If an episode raises, or its worker dies again.
    """
    context = _make_context()
    left, deaths = list(reversed(indices)), Counter[int]()
    arguments = (config, folder, run)
    crew = [_Worker(context, arguments) for _ in range(min(workers, len(left)))]
    try:
        for worker in crew:
            worker.give(left.pop())
        while busy := [worker for worker in crew if worker.index is not None]:
            wait([each for one in busy for each in (one.connection, one.process.sentinel)])
            for worker in busy:
                report = _receive(worker)
                if report is not None:
                    yield report
                    worker.index = None
                elif worker.process.is_alive():
                    continue
                else:
                    left.append(_note_death(worker, deaths))
                    crew.remove(worker)
                    worker.stop()
                    worker = _Worker(context, arguments)  # noqa: PLW2901 takes its place
                    crew.append(worker)
                if left:
                    worker.give(left.pop())
    finally:
        for worker in crew:
            worker.stop()


def _receive(worker: _Worker) -> Attempt | None:
    """The episode that a worker has finished, None if it has not, or has died."""
    try:
        if not worker.connection.poll():
            return None
        report = worker.connection.recv()
    except (EOFError, OSError):
        worker.process.join()
        return None
    if isinstance(report, str):
        where = "" if worker.index is None else f"episode {worker.index}: "
        raise WorkerFailed(where + report)
    return report


def _note_death(worker: _Worker, deaths: Counter[int]) -> int:
    """Count a death and return the episode that it was over.

    Raises:
        WorkerFailed: If it was not the first over this episode.
    """
    index = worker.index
    assert index is not None
    deaths[index] += 1
    code = worker.process.exitcode
    how = f"by signal {-code}" if code is not None and code < 0 else f"with exit code {code}"
    if deaths[index] >= _MOST_DEATHS:
        raise WorkerFailed(
            f"episode {index}: its worker ended {how}, {deaths[index]} times. Memory may be short "
            "(use fewer --workers); run the same command again to go on"
        )
    print(f"episode {index}: its worker ended {how}; once more", file=sys.stderr)
    return index


def _make_context() -> Context:
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_HEAVY)
    return context


def _work(connection: Connection, config: CollectConfig, folder: CollectFolder, run: float) -> None:
    """Make the episodes that come through `connection`, until the parent kills this process."""
    # Ctrl-C reaches the whole process group; the parent alone answers it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    # The result is the last line on standard output, and encoders talk.
    os.dup2(2, 1)
    try:
        from xop_lerobot.dataset.collect_worker import Collector  # noqa: PLC0415 torch

        collector = Collector(config, folder, run)
        while True:
            connection.send(collector.collect(connection.recv()))
    except EOFError:
        return
    except XopError as error:
        connection.send(str(error))
    except Exception:
        connection.send(traceback.format_exc())


def _follow_parent() -> None:
    """End with the parent, however it ends, so that no two runs work on one folder."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
