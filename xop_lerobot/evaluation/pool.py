"""Jobs in parallel processes, of which each may die without taking others along.

A worker is started once and does one job after another, so that imports are paid once. The
standard library's pools lose every pending job when one process dies, and do not say which job
it was; here the dead one's job comes back with an error and a new worker takes its place.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
"""What tells libraries how many threads to start; read when they are loaded."""


@dataclass(frozen=True)
class JobResult:
    """What became of one job.

    Attributes:
        job: The job.
        value: What the function returned, None after an error.
        error: What went wrong, one line and then the traceback; empty where all went well.
    """

    job: Any
    value: Any = None
    error: str = ""


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    job: Any = None


def run_jobs(
    function: Callable[[Any], Any], jobs: Iterable[Any], workers: int
) -> Generator[JobResult]:
    """Do `function(job)` for every job in parallel processes, and yield results as they come.

    Args:
        function: A function of a module, so that workers can import it.
        jobs: Arguments, which can be pickled; started in this order.
        workers: Number of processes.

    Yields:
        One result for each job. Whatever ends the iteration ends the workers too.
    """
    waiting = deque(jobs)
    idle: list[_Worker] = []
    busy: list[_Worker] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                worker = idle.pop() if idle else _start_worker(function)
                worker.job = waiting.popleft()
                busy.append(worker)
                with suppress(OSError):  # it is dead already; seen below
                    worker.pipe.send(worker.job)
            ready = wait([worker.pipe for worker in busy])
            for worker in [each for each in busy if each.pipe in ready]:
                busy.remove(worker)
                try:
                    value, error = worker.pipe.recv()
                    idle.append(worker)
                except (EOFError, OSError):
                    value, error = None, _bury(worker)
                yield JobResult(worker.job, value, error)
    finally:
        for worker in (*idle, *busy):
            _stop(worker)


def _start_worker(function: Callable[[Any], Any]) -> _Worker:
    context = multiprocessing.get_context("spawn")  # a fork would share OpenGL and threads
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(function, theirs), daemon=True)
    with set_environment(dict.fromkeys(THREAD_VARIABLES, "1")):
        process.start()
    theirs.close()
    return _Worker(process, ours)


def _work(function: Callable[[Any], Any], pipe: Connection) -> None:
    """Do jobs until the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's, which ends this one
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        try:
            outcome = function(job), ""
        except Exception as error:  # noqa: BLE001 whatever it is, the other jobs go on
            outcome = None, f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
        try:
            pipe.send(outcome)
        except BrokenPipeError:
            return


def _bury(worker: _Worker) -> str:
    worker.process.join()
    worker.pipe.close()
    code = worker.process.exitcode or 0
    how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return f"the worker process died ({how})"


def _stop(worker: _Worker) -> None:
    worker.pipe.close()
    worker.process.terminate()
    worker.process.join(5)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


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
