"""Measure in closed loop how well robots track goals of the head.

    python -m benchmarks.run_tracking --robot g1 --scenarios squat,yaw --seeds 3 --jobs 1
    python -m benchmarks.run_tracking --robot rby1 --scenarios diagonal --plot diagonal.png
    python -m benchmarks.run_tracking --robot g1 --set mobile.horizon=20 --scenarios mobile
    python -m benchmarks.run_tracking --robot all --scenarios all --hold 60 --seeds 10 \
        --ablations default,table1 --jobs 2 --json outputs/tracking.json
    python -m benchmarks.run_tracking --json outputs/tracking.json --write-docs

Errors are those of the head's true pose. Key metrics are printed per run, a table of median / worst
over the seeds at the end. Runs that the JSON file already contains are not run again.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from benchmarks.tracking import make_record, run_scenario, run_trial
from benchmarks.tracking_documents import DOCUMENT, write_documents
from benchmarks.tracking_report import (
    Results,
    describe_run,
    make_ablation_table,
    make_scenario_table,
)
from benchmarks.tracking_scenarios import SCENARIO_GROUPS, SCENARIOS
from benchmarks.tracking_setup import (
    ABLATIONS,
    TrackingSetup,
    get_ablation,
    parse_overrides,
)
from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.errors import UnknownName, XopError
from xop_lerobot.core.pool import run_jobs
from xop_lerobot.morphology.morphology import list_robots, make_morphology, say_robots

ROOT = Path(__file__).resolve().parent.parent
GROUPS = {
    **SCENARIO_GROUPS,
    "all": tuple(
        name for kind in ("stationary", "mobile", "curve") for name in SCENARIO_GROUPS[kind]
    ),
}


def parse_args(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--robot", default="g1", help=f"{say_robots()}, or all (default: g1)")
    add(
        "--scenarios",
        default="all",
        help=f"names, separated by commas: {', '.join(SCENARIOS)}; or groups: "
        f"{', '.join(GROUPS)} (default: all, which is stationary, mobile and curve)",
    )
    add(
        "--ablations",
        default="default",
        help=f"names, separated by commas, or all: {', '.join(ABLATIONS)}",
    )
    add("--seeds", type=int, default=10, help="number of seeds (default: 10)")
    add("--first-seed", type=int, default=0, help="first seed (default: 0)")
    add("--jobs", type=int, default=1, help="parallel processes of one thread (default: 1)")
    add("--noise", default="mild", help="sensor noise: off, mild or harsh (default: mild)")
    add("--preset", default="default", help="preset of the retargeter (default: default)")
    add("--no-sync", action="store_true", help="do not synchronise the state")
    add("--low-level", default="", help="low-level policy (default: the robot's own)")
    add("--low-level-path", default="", help="file of that policy (default: its own)")
    add("--hold", type=float, default=10.0, help="time for which goals are held [s] (default: 10)")
    add("--goals", type=int, default=10, help="goals per run of `room` (default: 10)")
    add("--payload", type=float, default=0.0,
        help="mass in each hand, unknown to the planner [kg] (default: 0)")  # fmt: skip
    add("--set", action="append", default=[], metavar="NAME=VALUE", dest="settings",
        help="override a setting of MpcConfig: horizon=20, mobile.weights.control=0.01, "
        "noise_std.vx=0.2; may be repeated")  # fmt: skip
    add("--json", type=Path, help="file of the results, which is extended; also resumes")
    add("--fresh", action="store_true", help="discard the runs in the JSON file")
    add("--plot", type=Path, help="plot the first run to this file and stop")
    add("--write-docs", action="store_true", help=f"fill {DOCUMENT} from --json and stop")
    add("--bench", type=Path, nargs="+", default=[], metavar="FILE",
        help="JSON files of xop-bench for --write-docs")  # fmt: skip
    args = parser.parse_args(arguments)
    if args.write_docs and args.json is None:
        parser.error("--write-docs needs --json FILE")
    if args.seeds < 1 or args.jobs < 1:
        parser.error("--seeds and --jobs must be at least 1")
    return args


def make_setups(args: argparse.Namespace) -> list[TrackingSetup]:
    """Make the setups of all requested combinations of ablation, robot and scenario.

    Raises:
        UnknownName: If a robot, scenario or ablation is unknown.
    """
    robots = list_robots() if args.robot == "all" else (args.robot,)
    scenarios = [name for each in args.scenarios.split(",") for name in GROUPS.get(each, (each,))]
    for name in scenarios:
        if name not in SCENARIOS:
            raise UnknownName("scenario", name, {*SCENARIOS, *GROUPS})
    ablations = list(ABLATIONS) if args.ablations == "all" else args.ablations.split(",")
    for name in ablations:
        get_ablation(name)
    for robot in robots:
        make_morphology(robot)
    return [
        TrackingSetup(
            robot=robot,
            scenario=scenario,
            ablation=ablation,
            noise=args.noise,
            preset=args.preset,
            sync=not args.no_sync,
            low_level=args.low_level,
            low_level_path=args.low_level_path,
            hold=args.hold,
            goals=args.goals,
            payload=args.payload,
            overrides=parse_overrides(args.settings),
        )
        for ablation in ablations
        for robot in robots
        for scenario in scenarios
    ]


def run_all(args: argparse.Namespace, setups: list[TrackingSetup], results: Results) -> list[str]:
    """Run the missing trials and return the keys of all requested ones.

    Raises:
        XopError: If a run fails.
    """
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    trials = [(setup, seed) for setup in setups for seed in seeds]
    keys = [setup.compute_key(seed) for setup, seed in trials]
    missing = [
        (key, *trial) for key, trial in zip(keys, trials, strict=True) if key not in results.runs
    ]
    done = len(keys) - len(missing)
    if done:
        print(f"{done} of {len(keys)} runs are in {results.path} already", flush=True)

    def keep(key: str, run: dict[str, Any]) -> None:
        nonlocal done
        done += 1
        results.add(key, run)
        print(f"[{done}/{len(keys)}] {describe_run(key, run)}", flush=True)

    if args.jobs == 1:
        for key, setup, seed in missing:
            keep(key, run_trial(setup, seed))
        return keys
    for result in run_jobs(_run, missing, args.jobs):
        if result.error:
            raise XopError(f"{result.job[0]}: {result.error}")
        keep(result.job[0], result.value)
    return keys


def _run(job: tuple[str, TrackingSetup, int]) -> dict[str, Any]:
    _, setup, seed = job
    return run_trial(setup, seed)


def print_tables(setups: list[TrackingSetup], runs: dict[str, dict[str, Any]]) -> None:
    """Print tables of median / worst over the seeds of the requested runs."""
    ablations = list(dict.fromkeys(setup.ablation for setup in setups))
    for robot in dict.fromkeys(setup.robot for setup in setups):
        asked = {setup.scenario for setup in setups}
        for ablation in ablations:
            for group in SCENARIO_GROUPS.values():
                if names := [name for name in group if name in asked]:
                    print(f"\n{robot}, {ablation}; median / worst over the seeds\n")
                    print(make_scenario_table(runs, robot, names, ablation))
        if len(ablations) > 1:
            print(f"\n{robot}, all scenarios; median / worst over the runs\n")
            chosen = {name: ABLATIONS[name] for name in ablations}
            print(make_ablation_table(runs, robot, sorted(asked), chosen))


def plot_first(args: argparse.Namespace, setup: TrackingSetup) -> None:
    """Run the first seed, print its metrics and plot it."""
    from benchmarks.tracking_plot import plot_run

    start = perf_counter()
    track, trajectory = run_scenario(setup, args.first_seed)
    key = setup.compute_key(args.first_seed)
    run = make_record(setup, args.first_seed, track, trajectory, perf_counter() - start)
    names = make_morphology(setup.robot).command_space.names
    plot_run(args.plot, f"{key} ({setup.resolved_noise} noise)", track, trajectory, names)
    print(describe_run(key, run))
    print(f"written: {args.plot}")


def main() -> int:
    """Run the benchmark; returns the exit code."""
    args = parse_args()
    try:
        if args.write_docs:
            print("\n".join(write_documents(ROOT, args.json, args.bench)))
            return 0
        setups = make_setups(args)
        if args.plot is not None:
            plot_first(args, setups[0])
            return 0
        results = Results(args.json, fresh=args.fresh)
        keys = run_all(args, setups, results)
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print_tables(setups, {key: results.runs[key] for key in keys})
    return 0


if __name__ == "__main__":
    make_output_readable()
    sys.exit(main())
