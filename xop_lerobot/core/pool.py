"""Jobs in parallel workers, of which each may die without taking others along.

A worker is started once and does one job after another, so that imports are paid once. The
standard library's `ProcessPoolExecutor` loses all jobs that are under way when one process dies,
and does not say which one it was; here a new worker takes the dead one's place, and its job is done
again, or comes back with an error. Workers are processes of this machine (`run_jobs`), or of many
(`xop_lerobot.core.pool_ray`); what is common to both is `drive`.
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
"""What tells libraries how many threads to start; read when they are loaded."""
ENVIRONMENT: Mapping[str, str] = {
    # Each worker has one core: more threads would only wait for each other.
    **dict.fromkeys(THREAD_VARIABLES, "1"),
    "LP_NUM_THREADS": "0",
    "TQDM_DISABLE": "1",
}
"""What the workers' libraries read when they are loaded."""


@dataclass(frozen=True)
class JobResult:
    """What became of one job.

    Attributes:
        job: The job.
        value: What the function returned, None after an error.
        error: What went wrong: the text of an error that the project raises on purpose; of
            others one line and then the traceback; empty where all went well.
        again: Whether the job is being done once more, so that another result will follow.
    """

    job: Any
    value: Any = None
    error: str = ""
    again: bool = False


class WorkerDied(Exception):
    """A worker ended before its job did; the message says how."""


class Worker(Protocol):
    """Does one job at a time."""

    def do(self, job: Any) -> tuple[Any, str]:
        """Do a job; return its value and its error, as in `JobResult`.

        Raises:
            WorkerDied: If the worker ends before the job does.
        """
        ...

    def stop(self) -> None:
        """End it at once, whatever it is at; `do` raises in its thread."""


def run_jobs(
    function: Function,
    jobs: Iterable[Any],
    workers: int,
    *,
    tries: int = 1,
    preload: Sequence[str] = (),
) -> Generator[JobResult]:
    """Do `function(job)` for every job in parallel processes, and yield results as they come.

    Args:
        function: What can be pickled: a function of a module, or an object to be called, which
            each worker gets once and may keep things in from job to job.
        jobs: Arguments, which can be pickled; started in this order, and taken from here when a
            worker is free and not before.
        workers: Number of processes.
        tries: How often a job is begun before its workers' deaths are an error.
        preload: Modules that are imported once for all workers, where processes can be forked.

    Yields:
        One result for each job, and one more for each time that it is begun again. Whatever ends
        the iteration ends the workers too.
    """
    return drive(partial(_Process, function, _make_context(preload)), jobs, workers, tries)


def drive(
    start: Callable[[], Worker], jobs: Iterable[Any], workers: int, tries: int
) -> Generator[JobResult]:
    """Do all jobs with at most so many workers, of which `start` makes each; see `run_jobs`."""
    fresh, again = iter(jobs), deque[tuple[Any, int]]()
    idle: list[Worker] = []
    busy: dict[Future[tuple[Any, str]], tuple[Worker, Any, int]] = {}
    with ThreadPoolExecutor(workers) as threads:  # each waits for a worker
        try:
            while True:
                while len(busy) < workers and (order := _pick(fresh, again)):
                    worker = idle.pop() if idle else start()
                    busy[threads.submit(worker.do, order[0])] = (worker, *order)
                while idle:  # there is nothing left for them, and others may wait for their cores
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
    """The next job, and how often it will have been begun; None if there is none."""
    if again:
        return again.popleft()
    for job in fresh:
        return job, 1
    return None


def do_job(function: Function, job: Any) -> tuple[Any, str]:
    """Do one job; return its value and its error, as in `JobResult`."""
    try:
        return function(job), ""
    except XopError as error:
        return None, str(error)
    except Exception as error:  # whatever it is, the other jobs go on
        return None, f"{type(error).__name__}: {error}\n{traceback.format_exc()}"


def _make_context(preload: Sequence[str]) -> Context:
    """Processes that share nothing with this one: a fork would share OpenGL and threads."""
    if not preload or "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    return context


class _Process:
    """A worker that is a process of this machine.

    Args:
        function: What does a job.
        context: How processes are started.
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
    """Do jobs until the other end of the pipe is closed, or the parent has ended."""
    # Ctrl-C reaches the whole process group; the parent alone answers it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    # What a command prints on standard output is for other programs, and encoders talk.
    os.dup2(2, 1)
    with suppress(EOFError, BrokenPipeError):
        while True:
            pipe.send(do_job(function, pipe.recv()))


def _follow_parent() -> None:
    """End with the parent, however it ends, so that no two runs work on the same files."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def set_environment(variables: Mapping[str, str]) -> Generator[None]:
    """Set environment variables for a while."""
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
