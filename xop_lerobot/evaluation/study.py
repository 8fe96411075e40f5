"""A study: its cells of trials, the store of results, and the table made from them."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import xop_lerobot
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.folders import append_line, read_lines
from xop_lerobot.core.pool import JobResult, run_jobs
from xop_lerobot.core.yaml_words import find_word, load_yaml
from xop_lerobot.evaluation.methods import find_absence, get_method
from xop_lerobot.evaluation.trial import TrialSetup, run_trial
from xop_lerobot.evaluation.trial_metrics import make_record
from xop_lerobot.plant.config import NOISE_PRESETS

TRIALS_FILE = "trials.jsonl"
FILMS_FOLDER = "films"


@dataclass(frozen=True)
class Cell:
    """Trials of one setup with consecutive seeds.

    Attributes:
        setup: Setup of the trials, with resolved names.
        trials: Number of trials.
        seed: Seed of the first trial; the same for every method, so that all get the same scenes
            and the same person.
        absence: Why it cannot run here; empty if it can.
    """

    setup: TrialSetup
    trials: int
    seed: int = 0
    absence: str = ""

    @property
    def seeds(self) -> range:
        """Seeds of the trials."""
        return range(self.seed, self.seed + self.trials)


@dataclass(frozen=True)
class Job:
    """One trial to run.

    Attributes:
        setup: Setup of the trial.
        seed: Seed of the trial.
        folder: Results folder.
    """

    setup: TrialSetup
    seed: int
    folder: str

    @property
    def key(self) -> str:
        """Unique name of the trial."""
        return compute_key(self.setup, self.seed)


def make_cell(setup: TrialSetup, trials: int, seed: int = 0) -> Cell:
    """Make a cell of `setup`, with resolved names.

    Raises:
        UnknownName: If a name is unknown, listing the known ones.
        BadValue: If there are no trials, or the variant contradicts itself or the method.
    """
    if trials < 1:
        raise BadValue(f"trials must be at least 1, got {trials}")
    if seed < 0:
        raise BadValue(f"seed must be 0 or more, got {seed}")
    setup = setup.resolved
    return Cell(setup, trials, seed, _find_absence(setup.low_level, setup.low_level_path))


@cache
def _find_absence(low_level: str, path: str) -> str:
    return find_absence(low_level, path)


def compute_key(setup: TrialSetup, seed: int) -> str:
    """Compute a name of the trial that changes with any of its settings."""
    plain = dataclasses.asdict(dataclasses.replace(setup, low_level_path=""))
    if setup.low_level_path:  # identified by content, not by path
        plain["low_level_path"] = _digest_path(setup.low_level_path)
    if not setup.heights:  # keeps the keys of trials from before heights existed
        del plain["heights"]
    text = json.dumps(plain, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:10]
    parts = (setup.robot, setup.task, setup.method, setup.variant, setup.low_level)
    return f"{'-'.join(part for part in parts if part)}-{seed}-{digest}"


@cache
def _digest_path(path: str) -> str:
    """SHA-256 of a file, or of all files of a folder."""
    place = Path(path).expanduser()
    files = sorted(place.iterdir()) if place.is_dir() else [place]
    digest = hashlib.sha256()
    for file in files:
        if file.is_file():
            digest.update(file.read_bytes())
    return digest.hexdigest()


@cache
def compute_code_digest() -> str:
    """Compute a digest of this package's code."""
    folder = Path(xop_lerobot.__file__).parent
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*.py")):
        digest.update(str(file.relative_to(folder)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:10]


class Results:
    """Store of finished trials in a folder: one JSON object per line, positions in files beside.

    Args:
        folder: The folder; created with the first trial.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._path = folder / TRIALS_FILE

    def load(self) -> dict[str, dict[str, Any]]:
        """Read the finished trials by key, the last of equal ones; failed trials are left out.

        Raises:
            BadValue: If the file is malformed; names file and line.
        """
        found = {}
        for number, record in enumerate(read_lines(self._path), 1):
            if record is None or "key" not in record:
                raise BadValue(f"'{self._path}', line {number}, is no trial")
            if "error" not in record:
                found[record["key"]] = record
        return found

    def append(self, record: Mapping[str, Any]) -> None:
        """Append one trial, flushed to disk."""
        append_line(self._path, json.dumps(record, allow_nan=False))

    def film_path(self, key: str) -> Path:
        """Return the file of the positions of the trial `key`."""
        return self.folder / FILMS_FOLDER / f"{key}.npz"


def plan_jobs(cells: Sequence[Cell], folder: Path, finished: Iterable[str]) -> list[Job]:
    """List the trials still to run, alternating methods within each seed.

    So an interrupted study is balanced: all methods have run the same seeds, up to one.
    """
    done = set(finished)
    jobs: dict[str, Job] = {}
    for index in range(max((cell.trials for cell in cells), default=0)):
        for cell in cells:
            if index < cell.trials and not cell.absence:
                job = Job(cell.setup, cell.seed + index, str(folder))
                if job.key not in done:
                    jobs.setdefault(job.key, job)
    return list(jobs.values())


def run_job(job: Job) -> dict[str, Any]:
    """Run one trial and save its positions in the folder; called by the workers."""
    trial = run_trial(job.setup, job.seed)
    path = Results(Path(job.folder)).film_path(job.key)
    path.parent.mkdir(parents=True, exist_ok=True)
    film = trial.film
    partial = path.with_suffix(".part.npz")
    np.savez_compressed(
        partial,
        fps=film.fps,
        qpos=film.qpos,
        mocap_pos=film.mocap_pos,
        mocap_quat=film.mocap_quat,
    )
    partial.replace(path)
    return {"key": job.key, **make_record(trial), "code": compute_code_digest()}


def run_study(
    cells: Sequence[Cell],
    results: Results,
    workers: int,
    *,
    run: Callable[[Job], dict[str, Any]] = run_job,
    jobs: Sequence[Job] | None = None,
) -> Generator[JobResult]:
    """Run the missing trials, saving each before it is yielded.

    Args:
        cells: The study.
        results: Store of trials; those in it are not repeated.
        workers: Number of processes.
        run: Function that runs a job; it must be importable by the workers.
        jobs: Trials to run, if already known.
    """
    if jobs is None:
        jobs = plan_jobs(cells, results.folder, results.load())
    for result in run_jobs(run, jobs, workers):
        if result.error:
            setting = dataclasses.asdict(result.job.setup)
            failed = {"key": result.job.key, **setting, "seed": result.job.seed}
            results.append({**failed, "error": result.error})
        else:
            results.append(result.value)
        yield result


def collect(cell: Cell, records: Mapping[str, Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the finished trials of a cell, in order of seeds."""
    keys = (compute_key(cell.setup, seed) for seed in cell.seeds) if not cell.absence else ()
    return [records[key] for key in keys if key in records]


def summarise(cell: Cell, trials: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Make one row of the table: counts out of `trials`, means and standard deviations.

    CT is over successful trials, everything else over all. If trials go on beyond their task's time
    limit, `completed` and `ct_any` are over those that ever succeed. A missing value is None.
    """
    setup = cell.setup

    def values(name: str) -> list[float]:
        found = (trial["metrics"].get(name) for trial in trials)
        return [value for value in found if value is not None]

    times = [trial["completion_s"] for trial in trials if trial["success"]]
    ever = [trial["completion_s"] for trial in trials if trial["completion_s"] is not None]
    beyond = setup.goes_beyond and bool(trials)
    row: dict[str, Any] = {
        "robot": setup.robot,
        "task": setup.task,
        "method": setup.method,
        "variant": setup.variant,
        "trials": len(trials),
        "success": sum(trial["success"] for trial in trials),
        "pickup": sum(trial["picked_up"] for trial in trials),
        "collision": sum(trial["collision"] for trial in trials),
        "falls": sum(trial["fallen"] for trial in trials),
        "ct_mean": _mean(times),
        "ct_std": _std(times),
        "abp_mean": _mean(values("abp")),
        "abp_std": _std(values("abp")),
        "tilt_mean": _mean(values("tilt")),
        "jerk_mean": _mean(values("jerk")),
        "seeds": [trial["seed"] for trial in trials],
        "low_level": setup.low_level,
        "noise": setup.noise,
        "scene": setup.scene,
        "heights": setup.heights,
        "fps": setup.fps,
        "tilt_std": _std(values("tilt")),
        "jerk_std": _std(values("jerk")),
        "abp_signed_mean": _mean(values("abp_signed")),
        "time_limit": setup.time_limit,
        "completed": len(ever) if beyond else None,
        "ct_any_mean": _mean(ever) if beyond else None,
        "ct_any_std": _std(ever) if beyond else None,
    }
    for name in ("head_error", "hands_error", "roughness", "slip", "plan_ms", "plan_p99_ms"):
        row[f"{name}_mean"] = _mean(values(name))
    sim, wall = (sum(trial[name] for trial in trials) for name in ("sim_s", "wall_s"))
    row["sim_s"], row["wall_s"] = round(sim, 2), round(wall, 2)
    row["note"] = cell.absence.partition(":")[0]
    return row


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _std(values: Sequence[float]) -> float | None:
    """Population standard deviation: the paper's of one trial is 0.00."""
    return float(np.std(values)) if values else None


_STUDY_KEYS = ("trials", "seed", "noise", "fps", "time_limit", "low_level_paths", "groups")
_LISTS = ("tasks", "methods", "variants", "low_levels")
_GROUP_KEYS = ("robot", *_LISTS, "trials", "noise", "scene", "heights", "time_limit")


def load_study(path: Path, overrides: Mapping[str, Any] | None = None) -> list[Cell]:
    """Read the cells of a study.

    Args:
        path: YAML file with `trials`, `seed`, `noise`, `fps`, `time_limit`, `low_level_paths` (file
            or folder by name of a low-level policy), and a list of `groups`. Each group has a
            `robot` and lists of `tasks` and `methods`; optional are lists of `variants` and
            `low_levels`, and its own `trials`, `noise`, `scene`, `heights` and `time_limit`. Every
            combination within a group is a cell.
        overrides: Values that replace those of the file and of all its groups (`trials`, `seed`,
            `noise`, …); None keeps a value.

    Raises:
        BadValue: If the file is missing or malformed.
        UnknownName: If a key or a name is unknown, listing the known ones.
    """
    try:
        data = load_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadValue(f"study '{path}' cannot be read: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise BadValue(f"study '{path}' is no YAML: {error}") from error
    where = f"study '{path}'"
    _check_keys(where, data, _STUDY_KEYS, ("groups",))
    if not isinstance(data["groups"], list) or not data["groups"]:
        raise BadValue(f"{where}: groups must be a list of at least one group")
    given = {name: value for name, value in (overrides or {}).items() if value is not None}
    common = {name: value for name, value in data.items() if name != "groups"}
    cells: list[Cell] = []
    for number, group in enumerate(data["groups"], 1):
        inside = f"{where}, group {number}"
        _check_keys(inside, group, _GROUP_KEYS, ("robot", "tasks", "methods"))
        for name in _LISTS:
            if name in group and not isinstance(group[name], list):
                raise BadValue(f"{inside}: {name} must be a list, got {group[name]!r}")
        cells += make_cells({**common, **group, **given})
    return cells


def make_cells(group: Mapping[str, Any]) -> list[Cell]:
    """Make a cell for every combination of tasks, low-level policies, methods and variants.

    A method with a fixed low-level policy appears once, whatever policies are requested.

    Raises:
        UnknownName: If a name is unknown, listing the known ones.
        BadValue: If a number is out of its range.
    """
    kept = ("noise", "scene", "fps", "time_limit", "heights")
    common = {name: group[name] for name in kept if group.get(name)}
    if "heights" in common:
        common["heights"] = str(common["heights"])
    if group.get("noise") is not None:
        common["noise"] = find_word(group["noise"], NOISE_PRESETS)
        if common["noise"] not in NOISE_PRESETS:
            raise UnknownName("noise preset", common["noise"], NOISE_PRESETS)
    paths = group.get("low_level_paths") or {}
    combinations = product(
        group["tasks"],
        _get_list(group, "low_levels"),
        group["methods"],
        _get_list(group, "variants"),
    )
    cells: dict[TrialSetup, Cell] = {}
    for task, low_level, method, variant in combinations:
        own = get_method(method).low_level
        policy = own or low_level or ""
        setup = TrialSetup(
            group["robot"],
            task,
            method,
            variant or "",
            low_level=policy,
            low_level_path=str(paths.get(policy, "")),
            **common,
        )
        cell = make_cell(setup, group.get("trials", 20), group.get("seed", 0))
        cells.setdefault(cell.setup, cell)
    return list(cells.values())


def _get_list(group: Mapping[str, Any], name: str) -> Sequence[str]:
    return group.get(name) or [""]


def _check_keys(where: str, data: Any, known: Sequence[str], needed: Sequence[str]) -> None:
    if not isinstance(data, Mapping):
        raise BadValue(f"{where} must be a mapping, got {type(data).__name__}")
    for name in data:
        if name not in known:
            raise UnknownName(f"key of {where}", name, known)
    for name in needed:
        if name not in data:
            raise BadValue(f"{where} lacks '{name}'")
