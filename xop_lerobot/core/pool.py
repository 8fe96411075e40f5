"""Parallel jobs in a fault-tolerant pool of workers.

A worker runs one job after another, so imports are paid once. If a process dies, the standard
library's `ProcessPoolExecutor` loses all running jobs and does not say which one was at fault. Here
a new worker replaces the dead one, and its job is retried or returned with an error. Workers are
processes of this machine (`run_jobs`) or of a cluster (`xop_lerobot.core.pool_ray`); `drive` is
common to both.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.context import ForkServerContext, SpawnContext
from typing import TYPE_CHECKING, Any, Protocol

from xop_lerobot.core.errors import XopError

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

type Context = ForkServerContext | SpawnContext
type Function = Callable[[Any], Any]

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
"""Variables for the number of threads of numerical libraries, which read them on import."""
ENVIRONMENT: Mapping[str, str] = {
    # Each worker has one core; more threads would only compete for it.
    **dict.fromkeys(THREAD_VARIABLES, "1"),
    "LP_NUM_THREADS": "0",
    "TQDM_DISABLE": "1",
}
"""Environment of the workers, which their libraries read on import."""


@dataclass(frozen=True)
class JobResult:
    """Result of one job.

    Attributes:
        job: The job.
        value: Return value of the function; None after an error.
        error: Error text: the message of an error of this project, otherwise one line and the
            traceback; empty on success.
        again: Whether the job is retried, so that another result will follow.
    """

    job: Any
    value: Any = None
    error: str = ""
    again: bool = False


class WorkerDied(Exception):
    """A worker died during a job; the message says how."""


class Worker(Protocol):
    """Runs one job at a time."""

    def do(self, job: Any) -> tuple[Any, str]:
        """Run a job; return its value and its error, as in `JobResult`.

        Raises:
            WorkerDied: If the worker dies during the job.
        """
        ...

    def stop(self) -> None:
        """Kill the worker; a running `do` raises in its thread."""


def run_jobs(
    function: Function,
    jobs: Iterable[Any],
    workers: int,
    *,
    tries: int = 1,
    preload: Sequence[str] = (),
) -> Generator[JobResult]:
    """Run `function(job)` for every job in parallel processes, and yield results as they come.

    Args:
        function: A picklable function, or a callable object, which each worker receives once and
            which may keep state between jobs.
        jobs: Picklable arguments; started in this order, and consumed only when a worker is free.
        workers: Number of processes.
        tries: Number of attempts after which the death of a worker is an error.
        preload: Modules that are imported once for all workers, if processes can be forked.

    Yields:
        One result per job, and one more per retry. The workers end with the iteration, however it
        ends.
    """
    return drive(partial(_Process, function, _make_context(preload)), jobs, workers, tries)


def drive(
    start: Callable[[], Worker], jobs: Iterable[Any], workers: int, tries: int
) -> Generator[JobResult]:
    """Run all jobs with at most `workers` workers, made by `start`; see `run_jobs`."""
    fresh, again = iter(jobs), deque[tuple[Any, int]]()
    idle: list[Worker] = []
    busy: dict[Future[tuple[Any, str]], tuple[Worker, Any, int]] = {}
    with ThreadPoolExecutor(workers) as threads:  # one thread waits for each worker
        try:
            while True:
                while len(busy) < workers and (order := _pick(fresh, again)):
                    worker = idle.pop() if idle else start()
                    busy[threads.submit(worker.do, order[0])] = (worker, *order)
                while idle:  # no jobs are left: release their cores
                    idle.pop().stop()
                if not busy:
                    return
                for future in wait(busy, return_when=FIRST_COMPLETED).done:
                    worker, job, tried = busy[future]
                    is_left = False
                    try:
                        value, error = future.result()
                        idle.append(worker)
                    except WorkerDied as death:
                        worker.stop()
                        value, error, is_left = None, str(death), tried < tries
                        if is_left:
                            again.append((job, tried + 1))
                    del busy[future]
                    yield JobResult(job, value, error, is_left)
        finally:
            for worker in (*idle, *(each for each, _, _ in busy.values())):
                worker.stop()


def _pick(fresh: Iterable[Any], again: deque[tuple[Any, int]]) -> tuple[Any, int] | None:
    """The next job and the number of its attempt; None if there is none."""
    if again:
        return again.popleft()
    for job in fresh:
        return job, 1
    return None


def do_job(function: Function, job: Any) -> tuple[Any, str]:
    """Run one job; return its value and its error, as in `JobResult`."""
    try:
        return function(job), ""
    except XopError as error:
        return None, str(error)
    except Exception as error:  # a failing job must not end the others
        return None, f"{type(error).__name__}: {error}\n{traceback.format_exc()}"


def _make_context(preload: Sequence[str]) -> Context:
    """Start method without a fork of this process, which would share OpenGL and threads."""
    if not preload or "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    return context


class _Process:
    """A worker that is a process of this machine.

    Args:
        function: The function that runs a job.
        context: Start method of processes.
    """

    def __init__(self, function: Function, context: Context) -> None:
        self._pipe, theirs = context.Pipe()
        self._process: BaseProcess = context.Process(
            target=_work, args=(function, theirs), daemon=True
        )
        with set_environment(ENVIRONMENT):
            self._process.start()
        theirs.close()

    def do(self, job: Any) -> tuple[Any, str]:
        try:
            self._pipe.send(job)
            return self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
        code = self._process.exitcode or 0
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        raise WorkerDied(f"the worker process died ({how})")

    def stop(self) -> None:
        self._process.kill()
        self._process.join()


def _work(function: Function, pipe: Connection) -> None:
    """Run jobs until the other end of the pipe is closed, or the parent has ended."""
    # Ctrl-C reaches the whole process group; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    # Standard output of a command is for other programs; video encoders would print to it.
    os.dup2(2, 1)
    with suppress(EOFError, BrokenPipeError):
        while True:
            pipe.send(do_job(function, pipe.recv()))


def _follow_parent() -> None:
    """Exit with the parent, however it ends, so that no two runs work on the same files."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def set_environment(variables: Mapping[str, str]) -> Generator[None]:
    """Set environment variables within a block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
