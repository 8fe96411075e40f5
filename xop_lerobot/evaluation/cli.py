"""`xop-eval`: the paper's simulation study, with a simulated person in the headset.

    xop-eval --robot g1 --task dual_point_touch --methods mpc,mpc_no_sync,direct --json out.json
    xop-eval --config configs/paper_tables.yaml --report outputs/paper_tables

Trials run in parallel processes, and each is saved when it ends. The same command resumes an
interrupted study and repeats no finished trial.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from xop_lerobot.core.command_line import (
    INTERRUPTED,
    CommandParser,
    format_table,
    make_output_readable,
    split_pair,
)
from xop_lerobot.core.errors import BadValue, UnknownName, XopError
from xop_lerobot.morphology.morphology import read_robot, say_robots

logger = logging.getLogger(__name__)

DEFAULT_TRIALS = 20


def make_parser() -> CommandParser:
    """Make the parser of the command line."""
    parser = CommandParser("xop-eval", __doc__)
    add = parser.add_argument
    add("--config", type=Path, help="YAML file of a study; --robot, --task, --methods, "
        "--variant and --low-level then select from it (default: none)")  # fmt: skip
    add("--robot", type=read_robot, help=say_robots())
    add("--task", help="dual_point_touch, box_pick_and_place or non_prehensile_transport")
    add("--methods", help="methods, comma-separated: mpc, mpc_no_sync, mpc_table1, "
        "mpc_table1_charitable, direct, direct_amo (default: mpc,direct)")  # fmt: skip
    add("--variant", help="variants of the methods, comma-separated; each joins a binding of the "
        "robot (v1, v2), upright and a preset (conservative, aggressive) by underscores, "
        "such as v2_upright (default: the robot's own)")  # fmt: skip
    add("--low-level", help="low-level policies, comma-separated: default, falcon, "
        "diff_drive (default: the robot's own)")  # fmt: skip
    add("--low-level-path", help="files of low-level policies, such as falcon=FILE,amo=FOLDER "
        "(default: their own)")  # fmt: skip
    add("--trials", type=int, help=f"trials per cell (default: {DEFAULT_TRIALS})")
    add("--seed", type=int, help="seed of the first trial; the same for every method (default: 0)")
    add("--noise", help="sensor noise: off, mild or harsh (default: mild)")
    add("--scene", help="scene (default: the task's own)")
    add("--heights", help="heights that override the task's, support=0.35,table=0.6:0.7 or "
        "points=0.3:0.5 [m] (default: the task's own)")  # fmt: skip
    add("--fps", type=int, help="rate of the control loop, divides 50 [Hz] (default: 25)")
    add("--time-limit", type=float,
        help="time after which a trial ends [s]; beyond the task's own limit it has failed, and "
        "only its completion time is still measured (default: the task's own limit)")  # fmt: skip
    add("--workers", type=int, default=0, help="parallel processes; 0: cores (default: 0)")
    add("--out", type=Path, default=Path("outputs/eval"),
        help="folder of the results; a study resumes from it (default: outputs/eval)")  # fmt: skip
    add("--fresh", action="store_true", help="run all trials again, including finished ones")
    add("--no-run", action="store_true", help="only make tables of finished trials")
    add("--json", type=Path, help="write the table as a JSON list (default: none)")
    add("--csv", type=Path, help="write the table as CSV (default: none)")
    add(
        "--report",
        type=Path,
        help="folder for a page with tables, plots and videos (default: none)",
    )
    add("--videos", type=int, default=1, help="videos per cell in the report (default: 1)")
    return parser


def parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line.

    Raises:
        BadValue: If a flag is missing or malformed.
        UnknownName: If a flag is unknown, listing the known ones.
    """
    args = make_parser().parse(arguments)
    if args.config is None:
        for name in ("robot", "task"):
            if getattr(args, name) is None:
                raise BadValue(f"xop-eval needs --{name}, or a study with --config=FILE")
    for name in ("workers", "videos"):
        if getattr(args, name) < 0:
            raise BadValue(f"--{name} must be 0 or more, got {getattr(args, name)}")
    if args.time_limit is not None and not args.time_limit > 0:
        raise BadValue(f"--time-limit must be above 0 s, got {args.time_limit}")
    if args.fps is not None and (args.fps < 1 or 50 % args.fps):
        raise BadValue(f"--fps must divide the low-level policy's 50 Hz, got {args.fps}")
    return args


def make_study(args: argparse.Namespace) -> list[Any]:
    """Make the cells of the study from the arguments.

    Raises:
        UnknownName: If a name is unknown, listing the known ones.
        BadValue: If no cell is left of a study, or a value is out of its range.
    """
    from xop_lerobot.evaluation.study import load_study, make_cells  # noqa: PLC0415
    from xop_lerobot.plant.config import NOISE_PRESETS  # noqa: PLC0415

    if args.noise is not None and args.noise not in NOISE_PRESETS:
        raise UnknownName("noise preset", args.noise, NOISE_PRESETS)
    names = ("trials", "seed", "noise", "fps", "time_limit", "scene", "heights")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.low_level_path is not None:
        given["low_level_paths"] = _parse_paths(args.low_level_path)
    lists = {
        name: None if value is None else [part.strip() for part in value.split(",")]
        for name, value in (
            ("methods", args.methods), ("variants", args.variant), ("low_levels", args.low_level)
        )
    }  # fmt: skip
    if args.config is not None:
        return _choose(load_study(args.config, given), args, lists)
    group = {
        "robot": args.robot,
        "tasks": [args.task],
        "methods": lists["methods"] or ["mpc", "direct"],
        "variants": lists["variants"],
        "low_levels": lists["low_levels"],
        "trials": DEFAULT_TRIALS,
        **given,
    }
    return make_cells(group)


def _parse_paths(text: str) -> dict[str, str]:
    """Parse comma-separated `name=path` pairs."""
    return dict(split_pair(part, "--low-level-path must be NAME=PATH") for part in text.split(","))


def _choose(
    cells: list[Any], args: argparse.Namespace, lists: Mapping[str, list[str] | None]
) -> list[Any]:
    """Select the cells of a study by robot, task, methods, variants and policies."""
    wanted = {
        "robot": None if args.robot is None else [args.robot],
        "task": None if args.task is None else [args.task],
        "method": lists["methods"],
        "variant": lists["variants"],
        "low_level": lists["low_levels"],
    }
    for name, values in wanted.items():
        known = {getattr(cell.setup, name) for cell in cells}
        for value in values or ():
            if value not in known:
                raise UnknownName(f"{name} of the study", value, known)
    chosen = [
        cell
        for cell in cells
        if all(v is None or getattr(cell.setup, name) in v for name, v in wanted.items())
    ]
    if not chosen:
        raise BadValue("no cell of the study matches all given names")
    return chosen


def run(args: argparse.Namespace) -> int:
    """Run the study; returns the exit code."""
    from xop_lerobot.evaluation.study import Results, collect, plan_jobs, summarise  # noqa: PLC0415

    cells = make_study(args)
    results = Results(args.out)
    finished = results.load()
    jobs = plan_jobs(cells, args.out, () if args.fresh else finished)
    for name, why in {cell.setup.low_level: cell.absence for cell in cells if cell.absence}.items():
        print(f"low-level policy '{name}': {why}", file=sys.stderr)
    interrupted, failed = False, 0
    if jobs and not args.no_run:
        try:
            failed = _run_jobs(cells, results, jobs, args.workers)
        except KeyboardInterrupt:
            interrupted = True
            print(
                f"interrupted; finished trials are in '{args.out}'. Run the same command again to "
                "resume",
                file=sys.stderr,
            )
    records = results.load()
    found = [collect(cell, records) for cell in cells]
    rows = [summarise(cell, trials) for cell, trials in zip(cells, found, strict=True)]
    _warn_of_mixture(found, args.out)
    print(format_rows(rows))
    write_tables(rows, args.json, args.csv)
    if args.report is not None and not interrupted:
        from xop_lerobot.evaluation.report import write_report  # noqa: PLC0415

        page = write_report(args.report, cells, found, rows, results, args.videos)
        print(f"report: {page}")
    if interrupted:
        return INTERRUPTED
    if failed:
        print(f"{failed} trials ended in an error; see '{args.out}'", file=sys.stderr)
    return 1 if failed else 0


def _run_jobs(cells: Sequence[Any], results: Any, jobs: Sequence[Any], workers: int) -> int:
    """Run the jobs with a progress bar; returns the number of failures."""
    from tqdm import tqdm  # noqa: PLC0415

    from xop_lerobot.evaluation.study import run_study  # noqa: PLC0415

    workers = workers or len(os.sched_getaffinity(0))
    workers = min(workers, len(jobs))
    failed = 0
    with tqdm(total=len(jobs), unit="trial", disable=None, smoothing=0.1) as bar:
        for result in run_study(cells, results, workers, jobs=jobs):
            job = result.job
            what = f"{describe(job.setup)}, seed {job.seed}"
            if result.error:
                failed += 1
                text = f"{what}: {result.error.splitlines()[0]}"
            else:
                text = f"{what}: {describe_outcome(result.value)}"
            bar.update()
            if bar.disable:
                print(text, file=sys.stderr, flush=True)
            else:
                bar.write(text, file=sys.stderr)
    return failed


def describe(setup: Any) -> str:
    """Robot, task, method, variant and low-level policy as text."""
    method = f"{setup.method} {setup.variant}".strip()
    return f"{setup.robot} {setup.place} {method} ({setup.low_level})"


def describe_outcome(record: Mapping[str, Any]) -> str:
    """Outcome of a trial in one line."""
    if record["success"]:
        text = f"success after {record['completion_s']:.1f} s"
    else:
        text = record["failure"] or "time is up"
        if record["completion_s"] is not None:
            text += f", success after {record['completion_s']:.1f} s"
    if record["collision"]:
        text += f", {len(record['collisions'])} collisions"
    return f"{text} ({record['sim_s']:.0f} s in {record['wall_s']:.0f} s)"


def _warn_of_mixture(found: Sequence[Sequence[Mapping[str, Any]]], folder: Path) -> None:
    """Warn of trials that were run with another version of the code."""
    from xop_lerobot.evaluation.study import compute_code_digest  # noqa: PLC0415

    others = {record["code"] for trials in found for record in trials} - {compute_code_digest()}
    if others:
        count = sum(record["code"] in others for trials in found for record in trials)
        print(
            f"{count} trials in '{folder}' were run with another version of the code "
            f"({', '.join(sorted(others))}); --fresh runs them again",
            file=sys.stderr,
        )


def format_rows(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format the rows as a table for a terminal."""
    head = ("robot", "task", "method", "low level", "success", "pickup", "collis.", "falls",
            "CT [s]", "CT, any [s]", "ABP [W]", "tilt [rad]", "jerk [m/s3]", "note")  # fmt: skip
    lines: list[tuple[str, ...]] = []
    for row in rows:
        trials = row["trials"]
        counts = [f"{row[n]}/{trials}" for n in ("success", "pickup", "collision", "falls")]
        lines.append(
            (
                row["robot"],
                f"{row['task']} {row['heights']}".strip(),
                f"{row['method']} {row['variant']}".strip(),
                row["low_level"],
                *counts,
                format_spread(row["ct_mean"], row["ct_std"], 1),
                format_any(row),
                format_spread(row["abp_mean"], row["abp_std"], 2),
                format_spread(row["tilt_mean"], row["tilt_std"], 2),
                format_spread(row["jerk_mean"], row["jerk_std"], 0),
                row["note"],
            )
        )
    return format_table(head, lines)


def format_any(row: Mapping[str, Any]) -> str:
    """Completion time of all trials that ever succeed, and how many do; a dash if not measured."""
    if row["completed"] is None:
        return "-"
    spread = format_spread(row["ct_any_mean"], row["ct_any_std"], 1)
    return f"{spread} ({row['completed']}/{row['trials']})"


def format_spread(mean: float | None, std: float | None, digits: int) -> str:
    """Mean ± standard deviation; a dash without any."""
    if mean is None or std is None:
        return "-"
    return f"{mean:.{digits}f} ± {std:.{digits}f}"


def write_tables(
    rows: Sequence[Mapping[str, Any]], json_file: Path | None, csv_file: Path | None
) -> None:
    """Write the rows as JSON and as CSV, if files are given."""
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    if csv_file is not None:
        csv_file.parent.mkdir(parents=True, exist_ok=True)
        with csv_file.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            for row in rows:
                writer.writerow({**row, "seeds": " ".join(map(str, row["seeds"]))})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `xop-eval`; returns the exit code."""
    make_output_readable()
    try:
        return run(parse_arguments(sys.argv[1:] if arguments is None else arguments))
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
