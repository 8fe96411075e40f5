"""Jobs in workers all over a Ray cluster; Ray is an optional extra, `pip install …[ray]`.

Nothing but the jobs and their results goes from machine to machine, so they need no common disk.
What they do need is this project in the same versions, which is checked: the same seeds shall
give the same episodes.
"""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Generator, Iterable
from functools import partial
from textwrap import shorten
from typing import Any

from xop_lerobot.core.errors import XopError
from xop_lerobot.core.pool import ENVIRONMENT, Function, JobResult, WorkerDied, do_job, drive
from xop_lerobot.core.versions import read_versions

LOCAL = "local"
"""Address that starts a cluster of this machine alone, for as long as the jobs take."""

_LONGEST = 250
"""Letters of what Ray says of a death that are told."""


class RayUnavailable(XopError):
    """Ray is not installed, or there is no cluster at the address."""


class OtherVersions(XopError):
    """A machine of the cluster has other versions than this one."""


def run_jobs_on_ray(
    function: Function,
    jobs: Iterable[Any],
    workers: int,
    *,
    address: str,
    tries: int = 1,
) -> Generator[JobResult]:
    """Do `function(job)` for every job on a Ray cluster; see `xop_lerobot.core.pool.run_jobs`.

    Args:
        function: As there; its module can be imported on all machines.
        jobs: As there.
        workers: Number of workers, each on a core of its own; 0 for one for each of the
            cluster's cores.
        address: `local`, `auto` for the cluster that this machine is part of, `HOST:PORT`, or
            `ray://HOST:PORT`.
        tries: As in `run_jobs`.

    Raises:
        RayUnavailable: If Ray is not installed, or does not answer there.
        OtherVersions: If a machine of it has other versions than this one.
    """
    ray = _import_ray()
    mine = not ray.is_initialized()
    if mine:
        _connect(ray, address, workers)
    try:
        cores = int(ray.cluster_resources().get("CPU", 0))
        yield from drive(partial(_Actor, ray, function), jobs, workers or cores, tries)
    finally:
        if mine:
            ray.shutdown()


def _import_ray() -> Any:
    # It asks at its first start whether it may tell of its use; nobody is there to answer.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray  # noqa: PLC0415 optional
    except ImportError as error:
        raise RayUnavailable(
            f"--ray needs Ray, which is not installed here ({error}). Install this project's extra "
            "'ray', or: pip install 'ray>=2.40,<3'"
        ) from error
    return ray


def _connect(ray: Any, address: str, workers: int) -> None:
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address == LOCAL:
        # A machine counts as many cores as this process may use, and not as it has.
        cores = workers or len(os.sched_getaffinity(0))
        options |= {"address": LOCAL, "num_cpus": cores, "include_dashboard": False}
    else:
        options["address"] = address
    try:
        ray.init(**options)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        line = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise RayUnavailable(
            f"no Ray cluster at '{address}': {line}. Use '{LOCAL}', 'auto', HOST:PORT or "
            "ray://HOST:PORT, and start one with 'ray start --head'"
        ) from error


class _Hand:
    """What runs in a worker's process.

    Args:
        function: What does a job.
    """

    def __init__(self, function: Function) -> None:
        self._function = function

    def describe(self) -> tuple[str, str]:
        """Return the machine's name and its versions."""
        return platform.node(), read_versions()

    def do(self, job: Any) -> tuple[Any, str]:
        """Do a job; return its value and its error."""
        return do_job(self._function, job)


class _Actor:
    """A worker that is an actor of a Ray cluster, with a core of its own.

    Args:
        ray: The module.
        function: What does a job.
    """

    def __init__(self, ray: Any, function: Function) -> None:
        # Paths of the main process are not the machines'; what is set here holds for the libraries.
        environment = {"env_vars": dict(ENVIRONMENT)}
        make = ray.remote(num_cpus=1, max_restarts=0, runtime_env=environment)(_Hand)
        self._ray, self._hand = ray, make.remote(function)
        self._is_checked = False

    def do(self, job: Any) -> tuple[Any, str]:
        try:
            if not self._is_checked:
                _check_versions(*self._ray.get(self._hand.describe.remote()))
                self._is_checked = True
            return self._ray.get(self._hand.do.remote(job))
        except self._ray.exceptions.RayError as error:
            # The first line says what became of it, and the last why, if anybody knows.
            text = re.sub(r"\x1b\[[\d;]*m", "", str(error))  # without colours
            lines = [line.strip() for line in text.splitlines() if line.strip()]
            why = " ".join(dict.fromkeys(lines[:1] + lines[-1:])) or repr(error)
            raise WorkerDied(f"the Ray worker died ({shorten(why, _LONGEST)})") from error

    def stop(self) -> None:
        self._ray.kill(self._hand)


def _check_versions(machine: str, versions: str) -> None:
    """Check that a machine has the versions that this one has.

    Raises:
        OtherVersions: If it has not.
    """
    theirs, ours = json.loads(versions), json.loads(read_versions())
    wrong = [name for name in ours if theirs.get(name) != ours[name]]
    if wrong:
        named = ", ".join(f"{name} {theirs.get(name)} (here: {ours[name]})" for name in wrong)
        raise OtherVersions(
            f"machine '{machine}' of the Ray cluster has {named}. Install the same versions on all "
            "machines: the same seeds shall give the same episodes"
        )
