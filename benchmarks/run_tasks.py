"""Run a task with the simulated person and with parts of the retargeter removed.

    python -m benchmarks.run_tasks --robot rby1 --task box_pick_and_place --trials 20 \
        --ablations default,no_bias,no_hold,no_yield --json outputs/tasks.json

The trials are those of `xop-eval --methods mpc`, the ablations those of `benchmarks.run_tracking`.
Trials that the JSON file already contains are not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")

from benchmarks.tracking_setup import Ablation, get_ablation, override_config
from xop_lerobot.core.command import Mode
from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.evaluation.cli import describe_outcome
from xop_lerobot.evaluation.trial import TrialSetup, run_trial
from xop_lerobot.evaluation.trial_metrics import make_record
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.tuning import MpcConfig


@contextmanager
def leave_out(ablation: Ablation, robot: str) -> Iterator[None]:
    """Apply an ablation's planner settings and replacements to one robot.

    Raises:
        BadValue: If the ablation changes anything else.
    """
    if ablation.preset or ablation.retargeter or ablation.noise or ablation.equal_compute:
        raise BadValue(f"'{ablation.title}' works only in benchmarks.run_tracking")
    kind = type(make_morphology(robot))
    stock = kind.mpc_config

    def tuned(self: Any, mode: Mode) -> MpcConfig:
        return override_config(stock(self, mode), ablation.mpc, mode)

    with patch.object(kind, "mpc_config", tuned), ablation.replace():
        yield


def summarise(trials: Sequence[dict[str, Any]]) -> str:
    """Format a table row: successes, falls, collisions, mean time of the successes [s]."""
    times = [each["completion_s"] for each in trials if each["success"]]
    mean = f"{sum(times) / len(times):.1f}" if times else "–"
    falls = sum(bool(each["fallen"]) for each in trials)
    collisions = sum(bool(each["collision"]) for each in trials)
    return f"{len(times)} / {len(trials)} | {falls} | {collisions} | {mean}"


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", default="rby1", help="robot (default: rby1)")
    parser.add_argument("--task", default="box_pick_and_place", help="task")
    parser.add_argument("--ablations", default="default", help="names, separated by commas")
    parser.add_argument("--trials", type=int, default=20, help="trials per ablation (default: 20)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default: 0)")
    parser.add_argument("--json", type=Path, help="file of the results, which is extended")
    args = parser.parse_args(arguments)

    records: dict[str, dict[str, Any]] = {}
    if args.json is not None and args.json.exists():
        records = json.loads(args.json.read_text())
    names = args.ablations.split(",")
    try:
        setup = TrialSetup(args.robot, args.task).resolved
        for seed in range(args.seed, args.seed + args.trials):
            for name in names:
                key = f"{args.robot}/{args.task}/{name}/{seed}"
                if key in records:
                    continue
                with leave_out(get_ablation(name), args.robot):
                    records[key] = make_record(run_trial(setup, seed))
                print(f"{key}: {describe_outcome(records[key])}", flush=True)
                if args.json is not None:
                    args.json.parent.mkdir(parents=True, exist_ok=True)
                    args.json.write_text(json.dumps(records))
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print("\n| left out | successes | falls | collisions | mean time [s] |\n|---|---|---|---|---|")
    for name in names:
        keys = [
            f"{args.robot}/{args.task}/{name}/{seed}"
            for seed in range(args.seed, args.seed + args.trials)
        ]
        title = get_ablation(name).title
        print(f"| `{name}`: {title} | {summarise([records[key] for key in keys])} |")
    return 0


if __name__ == "__main__":
    make_output_readable()
    sys.exit(main())
