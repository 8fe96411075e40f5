"""Jobs in workers of a Ray cluster; Ray is an optional extra, `pip install …[ray]`.

Only jobs and their results are sent between machines, so no shared disk is needed. All machines
need the same versions of this project, so that equal seeds give equal episodes; this is checked.
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
"""Address that starts a temporary cluster on this machine."""

_LONGEST = 250
"""Largest number of characters of Ray's message on a dead worker."""


class RayUnavailable(XopError):
    """Ray is not installed, or no cluster answers at the address."""


class OtherVersions(XopError):
    """A machine of the cluster has different versions from this one."""


def run_jobs_on_ray(
    function: Function,
    jobs: Iterable[Any],
    workers: int,
    *,
    address: str,
    tries: int = 1,
) -> Generator[JobResult]:
    """Run `function(job)` for every job on a Ray cluster; see `xop_lerobot.core.pool.run_jobs`.

    Args:
        function: As in `run_jobs`; its module must be importable on all machines.
        jobs: As in `run_jobs`.
        workers: Number of workers, one core each; 0 for one per core of the cluster.
        address: `local`, `auto` for the cluster that this machine is part of, `HOST:PORT`, or
            `ray://HOST:PORT`.
        tries: As in `run_jobs`.

    Raises:
        RayUnavailable: If Ray is not installed, or no cluster answers at the address.
        OtherVersions: If a machine of the cluster has different versions from this one.
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
    # At its first start Ray would ask about usage statistics; there is nobody to answer.
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
        # The cores that this process may use, which can be fewer than the machine has.
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
    """The part of a worker that runs in the actor's process.

    Args:
        function: The function that runs a job.
    """

    def __init__(self, function: Function) -> None:
        self._function = function

    def describe(self) -> tuple[str, str]:
        """Return the machine's name and its versions."""
        return platform.node(), read_versions()

    def do(self, job: Any) -> tuple[Any, str]:
        """Run a job; return its value and its error."""
        return do_job(self._function, job)


class _Actor:
    """A worker that is an actor of a Ray cluster, with a core of its own.

    Args:
        ray: The module.
        function: The function that runs a job.
    """

    def __init__(self, ray: Any, function: Function) -> None:
        # Only these variables: other variables of the main process may hold local paths.
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
            # The first line says what happened; the last one says why, if known.
            text = re.sub(r"\x1b\[[\d;]*m", "", str(error))  # without colours
            lines = [line.strip() for line in text.splitlines() if line.strip()]
            why = " ".join(dict.fromkeys(lines[:1] + lines[-1:])) or repr(error)
            raise WorkerDied(f"the Ray worker died ({shorten(why, _LONGEST)})") from error

    def stop(self) -> None:
        self._ray.kill(self._hand)


def _check_versions(machine: str, versions: str) -> None:
    """Check that a machine has the same versions as this one.

    Raises:
        OtherVersions: If it does not; lists the differences.
    """
    theirs, ours = json.loads(versions), json.loads(read_versions())
    wrong = [name for name in ours if theirs.get(name) != ours[name]]
    if wrong:
        named = ", ".join(f"{name} {theirs.get(name)} (here: {ours[name]})" for name in wrong)
        raise OtherVersions(
            f"machine '{machine}' of the Ray cluster has {named}. Install the same versions on all "
            "machines, so that the same seeds give the same episodes"
        )
