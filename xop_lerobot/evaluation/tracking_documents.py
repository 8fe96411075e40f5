"""Fills the tables of docs/benchmarks.md from the results of the benchmarks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from xop_lerobot.errors import BadValue
from xop_lerobot.evaluation.tracking_report import (
    Run,
    fill_document,
    make_ablation_table,
    make_scenario_table,
    read_runs,
)
from xop_lerobot.evaluation.tracking_scenarios import SCENARIO_GROUPS
from xop_lerobot.evaluation.tracking_setup import ABLATIONS, SYNC_VARIANTS

DOCUMENT = Path("docs/benchmarks.md")
ROBOTS = ("g1", "rby1")
LEADS = {
    name: ablation
    for name, ablation in ABLATIONS.items()
    if name not in SYNC_VARIANTS or name == "default"
}
"""Variants of the retargeter itself."""


def write_documents(root: Path, results: Path) -> list[Path]:
    """Put tables of `results` between the markers of docs/benchmarks.md.

    Args:
        root: The repository.
        results: JSON file of scripts/benchmark_tracking.py.

    Returns:
        What was written.

    Raises:
        BadValue: If the file holds no results, or the document lacks a marker.
    """
    if not results.exists():
        raise BadValue(f"there are no results at '{results}'")
    runs = read_runs(results)
    machine = json.loads(results.read_text())["machine"]
    document = root / DOCUMENT
    blocks = make_blocks(runs, machine)
    document.write_text(fill_document(document.read_text(), blocks))
    return [document]


def make_blocks(runs: Mapping[str, Run], machine: Mapping[str, Any]) -> dict[str, str]:
    """Tables by the name of their markers; those without a run are left as they are."""
    blocks = {"machine": describe_conditions(runs, machine)}
    for robot in ROBOTS:
        own = {key: run for key, run in runs.items() if run["robot"] == robot}
        for kind, names in SCENARIO_GROUPS.items():
            if any(
                run["scenario"] in names and run["ablation"] == "default" for run in own.values()
            ):
                blocks[f"{robot} {kind}"] = make_scenario_table(own, robot, names)
        for kind in ("stationary", "mobile", "curve"):
            names = SCENARIO_GROUPS[kind]
            chosen = [run for run in own.values() if run["scenario"] in names]
            if len({run["ablation"] for run in chosen}) > 1:
                blocks[f"{robot} {kind} ablations"] = make_ablation_table(own, robot, names, LEADS)
                blocks[f"{robot} {kind} sync"] = make_ablation_table(
                    own, robot, names, {name: ABLATIONS[name] for name in SYNC_VARIANTS}
                )
    return blocks


def describe_conditions(runs: Mapping[str, Run], machine: Mapping[str, Any]) -> str:
    """Machine, versions and seeds, in one sentence each."""
    seeds = sorted({run["seed"] for run in runs.values()})
    noise = sorted({run["noise"] for run in runs.values() if run["ablation"] == "default"})
    holds = sorted({run["hold"] for run in runs.values()})
    versions = ", ".join(
        f"{name} {value}" for name, value in machine.items() if name != "processor"
    )
    return (
        f"{machine['processor']}; {versions}. {len(runs)} runs; seeds {seeds[0]} to {seeds[-1]}; "
        f"sensor noise: {', '.join(noise)}; goals held for "
        f"{', '.join(f'{hold:g}' for hold in holds)} s."
    )
