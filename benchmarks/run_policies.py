"""Compare G1's low-level policies, alone and under the model-predictive retargeter.

    python -m benchmarks.run_policies --policies default falcon openwbt=FOLDER
    python -m benchmarks.run_policies --policies all=FOLDER \
        --docs docs/results/low_level_policies.md --json outputs/policies.json

A policy is a name or the path of a policy table, optionally followed by `=` and its file or folder.
Parts: `speed` of one call; plain `commands` held for 10 s; `arms` held in postures; random
`sequences`; `mpc`, the scenarios of benchmarks/run_tracking.py with the policy in the planner's
rollouts. Results that the JSON file already contains are not run again. `--parts rest` prints each
policy's uncommanded pitch and forward shift at rest, in the format of its table.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import mujoco
import numpy as np

from benchmarks.low_level_comparison import (
    ARMS,
    FAR,
    RESPONSES,
    SEQUENCES,
    SPEED,
    MeasuredRest,
    hold_arms,
    make_named_arms,
    make_random_arms,
    measure_responses,
    measure_rest,
    measure_sequences,
    measure_speeds,
    replace_table,
)
from benchmarks.tracking import run_trial
from benchmarks.tracking_setup import TrackingSetup
from xop_lerobot.core.command import Mode
from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.errors import UnknownName, XopError
from xop_lerobot.low_level.factory import list_policies, make_policy
from xop_lerobot.low_level.policy import LowLevelPolicy
from xop_lerobot.morphology.morphology import make_morphology

PARTS = ("speed", "commands", "arms", "sequences", "mpc")
REST = "rest"
"""The part that measures values for a policy's table instead of comparing policies."""
HEIGHTS = (0.75, 0.55, 0.45)
"""Pelvis heights at which arm postures are held [m]."""
SCENARIOS = ("squat", "yaw", "pitch", "diagonal", "sideways", "quarter", "curve", "arms")
"""Scenarios of the part `mpc`."""

type Results = dict[str, dict[str, Any]]
"""Metrics by policy and part."""


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--policies", nargs="+", default=["default"], help="NAME, NAME=PATH, or all=FOLDER")
    add("--parts", default=",".join(PARTS), help="parts, separated by commas (default: all)")
    add("--trials", type=int, default=100, help="random sequences and postures (default: 100)")
    add("--seconds", type=float, default=20.0, help="duration of a sequence [s] (default: 20)")
    add("--seeds", type=int, default=3, help="number of seeds of `mpc` (default: 3)")
    add("--scenarios", default=",".join(SCENARIOS), help="scenarios of `mpc`, separated by commas")
    add("--seed", type=int, default=0, help="first seed (default: 0)")
    add("--threads", type=int, default=2, help="threads of the simulation (default: 2)")
    add("--json", type=Path, help="file of the results, which is extended")
    add("--docs", type=Path, help="Markdown page whose table is replaced")
    return parser.parse_args()


def find_policies(words: Iterable[str]) -> dict[str, str | None]:
    """Return policies' names and paths; for ``all`` those whose files exist."""
    found: dict[str, str | None] = {}
    for word in words:
        name, _, path = word.partition("=")
        if name != "all":
            found[name] = path or None
            continue
        for each in list_policies(make_morphology("g1")):
            for place in (path or None, None):
                try:
                    make_policy(each, place)
                except XopError:
                    continue
                found[each] = place
                break
    return found


def run_part(
    part: str, name: str, path: str | None, policy: LowLevelPolicy, arguments: argparse.Namespace
) -> Any:
    """Run one part with one policy; returns its metrics."""
    trials, seed, threads = arguments.trials, arguments.seed, arguments.threads
    if part == "commands":
        return measure_responses(policy, threads)
    if part == "sequences":
        return {
            title: asdict(
                measure_sequences(
                    policy,
                    config,
                    seed=seed,
                    trials=trials,
                    seconds=arguments.seconds,
                    threads=threads,
                )
            )
            for title, config in SEQUENCES.items()
        }
    if part == "arms":
        return measure_arms(policy, trials, seed, threads)
    return {
        scenario: [
            run_trial(
                TrackingSetup("g1", scenario, low_level=name, low_level_path=path or ""), each
            )
            for each in range(seed, seed + arguments.seeds)
        ]
        for scenario in arguments.scenarios.split(",")
    }


def measure_arms(policy: LowLevelPolicy, trials: int, seed: int, threads: int) -> dict[str, Any]:
    """Hold the arms in the postures of `ARMS`, and in random ones over 90 % of the ranges."""
    named = hold_arms(policy, make_named_arms(), Mode.STATIONARY, threads=threads)
    figures: dict[str, Any] = {
        name: None if fell else float(travel)
        for name, fell, travel in zip(ARMS, named.fell, named.travel, strict=True)
    }
    arms = make_random_arms(policy, np.random.default_rng(seed), trials, 0.9)
    for height in HEIGHTS:
        stood = hold_arms(policy, arms, Mode.STATIONARY, height, threads)
        figures[f"stand at {height:g} m"] = {
            "fell": int(stood.fell.sum()),
            "moved": int(stood.strayed.sum()),
            "median": float(np.nanmedian(stood.travel)) if not stood.fell.all() else None,
        }
    walked = hold_arms(policy, arms, Mode.MOBILE, threads=threads)
    velocity = walked.velocity[~walked.fell]
    figures["walk"] = {
        "fell": int(walked.fell.sum()),
        "error": float((velocity[:, 0] - SPEED).mean()) if len(velocity) else None,
        "turn": float(np.abs(velocity[:, 2]).mean()) if len(velocity) else None,
    }
    return figures


def run_all(policies: Mapping[str, str | None], arguments: argparse.Namespace) -> Results:
    """Run the parts missing in the results file, and return all results.

    Raises:
        UnknownName: If there is no such part.
    """
    file: Path | None = arguments.json
    kept = json.loads(file.read_text()) if file is not None and file.is_file() else {}
    results: Results = {name: kept.get(name, {}) for name in policies}
    made = {name: make_policy(name, path) for name, path in policies.items()}
    for part in arguments.parts.split(","):
        if part not in PARTS:
            raise UnknownName("part", part, PARTS)
        missing = [name for name in policies if part not in results[name]]
        if part == "speed" and missing:  # policies are timed alternately, so all of them again
            for name, speeds in measure_speeds(made).items():
                results[name][part] = speeds
            missing = []
        for name in missing:
            results[name][part] = run_part(part, name, policies[name], made[name], arguments)
            print(f"{name}: {part} done", file=sys.stderr, flush=True)
            save(arguments.json, kept | results)
    save(arguments.json, kept | results)
    return results


def save(file: Path | None, results: Results) -> None:
    """Write the results to `file`, if given."""
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(results, indent=1) + "\n")


def write_table(results: Results, arguments: argparse.Namespace) -> str:
    """Format the results as Markdown tables, one column per policy."""
    lines = [
        f"Planning model, MuJoCo {mujoco.__version__}; {arguments.trials} random sequences of "
        f"{arguments.seconds:g} s and {arguments.trials} postures a row, seed {arguments.seed}. "
        "Commands are the same for all, also beyond what a policy's table says it can do.",
    ]
    writers: dict[str, tuple[str, Callable[[Any], dict[str, str]]]] = {
        "commands": ("Plain commands, held for 10 s", _write_commands),
        "arms": (f"Arms held for 8 s; random ones over 90 % of the ranges, {FAR} m is moved",
                 _write_arms),
        "sequences": ("Random sequences: falls · height RMSE in stance [m] · planar velocity RMSE "
                      "[m/s] · yaw rate RMSE [rad/s]", _write_sequences),
        "mpc": (f"Under the controller, mild noise, {arguments.seeds} seeds: head's 95th "
                "percentile after arrival, of the curve its mean, median / worst [cm] (falls)",
                _write_mpc),
        "speed": ("One call [ms]", _write_speed),
    }  # fmt: skip
    for part, (title, write) in writers.items():
        columns = {name: write(figures[part]) for name, figures in results.items()
                   if part in figures}  # fmt: skip
        if not columns:
            continue
        rows = list(next(iter(columns.values())))
        lines += ["", f"{title}:", "", f"| | {' | '.join(columns)} |"]
        lines.append("|---|" + "---|" * len(columns))
        for row in rows:
            cells = (column.get(row, "") for column in columns.values())
            lines.append(f"| {row} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def write_rest(rest: MeasuredRest) -> str:
    """Format a measured rest as the section `[rest]` of a policy's table."""

    def write(rows: np.ndarray) -> str:
        return "".join(f"    [{', '.join(f'{value:.3f}' for value in row)}],\n" for row in rows)

    axes = ", ".join(f"{name} = {list(values)}" for name, values in rest.axes.items())
    return (
        f"[rest]\naxes = {{ {axes} }}\n"
        f"pitch = [\n{write(rest.pitch)}]\nforward = [\n{write(rest.forward)}]\n"
    )


def _write_commands(figures: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    cells = {}
    for name, one in figures.items():
        walks = RESPONSES[name][1] is Mode.MOBILE
        if one["falls"]:
            cells[name] = "falls"
        elif walks:
            cells[name] = f"{one['vx']:z.2f}, {one['vy']:z.2f}, {one['yaw_rate']:z.2f}"
        else:
            cells[name] = f"{one['height']:.2f} m, moved {one['travel']:.2f}"
    return cells


def _write_arms(figures: Mapping[str, Any]) -> dict[str, str]:
    cells = {
        f"{name}: moved [m]": "falls" if figures[name] is None else f"{figures[name]:.2f}"
        for name in ARMS
    }
    for height in HEIGHTS:
        one = figures[f"stand at {height:g} m"]
        median = "" if one["median"] is None else f", {one['median']:.2f}"
        cells[f"random, {height:g} m: fell, moved, median [m]"] = (
            f"{one['fell']}, {one['moved']}{median}"
        )
    walk = figures["walk"]
    numbers = "" if walk["turn"] is None else f", {walk['error']:+.2f}, {walk['turn']:.2f}"
    name = f"random, walking at {SPEED} m/s: fell, error [m/s], unasked turn [rad/s]"
    cells[name] = f"{walk['fell']}{numbers}"
    return cells


def _write_sequences(figures: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    keys = ("height_rmse", "planar_rmse", "yaw_rate_rmse")
    return {
        name: " · ".join([f"{one['falls']:g}", *(f"{one[key]:.3f}" for key in keys)])
        for name, one in figures.items()
    }


def _write_mpc(figures: Mapping[str, list[Mapping[str, Any]]]) -> dict[str, str]:
    cells = {}
    for scenario, runs in figures.items():
        key = next(
            key for key in ("after_p95_cm", "moving_mean_cm", "p95_cm") if key in runs[0]["metrics"]
        )
        values = [run["metrics"][key] for run in runs if run["metrics"][key] is not None]
        falls = sum(bool(run["metrics"]["falls"]) for run in runs)
        fallen = f" ({falls})" if falls else ""
        spread = f"{np.median(values):.1f} / {max(values):.1f}" if values else "lost"
        cells[scenario] = spread + fallen
    return cells


def _write_speed(figures: Mapping[str, float]) -> dict[str, str]:
    return {f"batch of {n}": f"{ms:.2f}" for n, ms in figures.items()}


def main() -> int:
    """Run the benchmark; returns the exit code."""
    arguments = parse_arguments()
    try:
        if arguments.parts == REST:
            for name, path in find_policies(arguments.policies).items():
                print(f"# {name}\n{write_rest(measure_rest(make_policy(name, path)))}")
            return 0
        results = run_all(find_policies(arguments.policies), arguments)
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    table = write_table(results, arguments)
    print(table)
    if arguments.docs:
        replace_table(arguments.docs, table, "policies")
    return 0


if __name__ == "__main__":
    make_output_readable()
    sys.exit(main())
