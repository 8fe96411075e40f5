"""Generation of the tables and plots of docs/results/benchmarks.md from result files."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.tracking_plot import plot_variants
from benchmarks.tracking_report import (
    Run,
    fill_document,
    make_ablation_table,
    make_scenario_table,
    read_runs,
)
from benchmarks.tracking_scenarios import SCENARIO_GROUPS
from benchmarks.tracking_setup import (
    ABLATIONS,
    SYNC_VARIANTS,
    TrackingSetup,
)
from xop_lerobot.core.errors import BadValue, XopError
from xop_lerobot.evaluation.bench_report import describe_versions, make_bench_blocks

DOCUMENT = Path("docs/results/benchmarks.md")
ROBOTS = ("g1", "rby1")
PLOTTED = ("stationary", "mobile", "curve")
VARIANTS = {
    "ablations": {
        name: ablation
        for name, ablation in ABLATIONS.items()
        if name not in SYNC_VARIANTS or name == "default"
    },
    "sync": {name: ABLATIONS[name] for name in SYNC_VARIANTS},
}
"""Variants by table: of the retargeter itself, and of state synchronisation and noise."""
ASKED = (
    "g1 stationary ablations",
    "g1 mobile ablations",
    "g1 curve ablations",
    "rby1 mobile ablations",
    "rby1 curve ablations",
    "g1 stationary sync",
    "g1 mobile sync",
    "rby1 mobile sync",
)
"""Tables of variants in the document, by the names of their markers."""


def write_documents(root: Path, results: Path, benches: Sequence[Path] = ()) -> list[str]:
    """Replace the tables of results between the markers of docs/results/benchmarks.md.

    Runs whose settings differ from the robots' current ones are left out.

    Args:
        root: Root of the repository.
        results: JSON file of benchmarks/run_tracking.py.
        benches: JSON files of xop-bench, in the order of the table.

    Returns:
        Messages on what was written and left out.

    Raises:
        BadValue: If a file is missing or contains no results, or the document lacks a marker.
    """
    for path in (results, *benches):
        if not path.exists():
            raise BadValue(f"there are no results at '{path}'")
    everything = read_runs(results)
    runs = {key: run for key, run in everything.items() if is_current(key, run)}
    machine = json.loads(results.read_text())["machine"]
    document = root / DOCUMENT
    blocks = make_blocks(runs, machine) if runs else {}
    if benches:
        blocks |= make_bench_blocks([json.loads(path.read_text()) for path in benches])
    blocks |= draw_plots(root / "docs", runs)
    document.write_text(fill_document(document.read_text(), blocks))
    lines = [f"written: {document} ({', '.join(blocks)})"]
    if len(runs) < len(everything):
        lines.append(f"left out: {len(everything) - len(runs)} runs with other settings")
    return lines


def draw_plots(folder: Path, runs: Mapping[str, Run]) -> dict[str, str]:
    """Plot the errors of each robot's runs over time, at the longest hold its variants have.

    Args:
        folder: Folder of the documents; plots go to ``images``.
        runs: Runs by key.

    Returns:
        Markdown links to the plots, by the name of their markers.
    """
    blocks = {}
    names = [name for kind in PLOTTED for name in SCENARIO_GROUPS[kind]]
    for robot in ROBOTS:
        own = {key: run for key, run in runs.items() if run["robot"] == robot}
        variants = [run for run in own.values() if run["ablation"] != "default"]
        holds = [run["hold"] for run in variants or own.values()]
        if not holds:
            continue
        image = f"images/tracking_{robot}.png"
        if plot_variants(folder / image, _keep_holds(own, {max(holds)}), robot, names):
            blocks[f"{robot} plot"] = f"![Position error over time, {robot}](../{image})"
    return blocks


def is_current(key: str, run: Run) -> bool:
    """Return whether a run was made with the current settings of its ablation, and no others."""
    try:
        setup = TrackingSetup(**run["setup"])
        return setup.is_standard and setup.compute_key(run["seed"]) == key
    except (KeyError, TypeError, XopError):  # made by another version
        return False


def make_blocks(runs: Mapping[str, Run], machine: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables by the names of their markers; tables without a run are omitted.

    Tables of scenarios use the default's runs with the longest hold. Tables of variants use the
    default's runs with the variants' holds, scenarios and seeds.
    """
    blocks = {"machine": describe_conditions(runs, machine)}
    for robot in ROBOTS:
        for kind, names in SCENARIO_GROUPS.items():
            own = {
                key: run
                for key, run in runs.items()
                if run["robot"] == robot and run["scenario"] in names
            }
            if not own:
                continue
            stock = [run for run in own.values() if run["ablation"] == "default"]
            if stock:
                longest = _keep_holds(own, {max(run["hold"] for run in stock)})
                blocks[f"{robot} {kind}"] = make_scenario_table(longest, robot, names)
            for suffix, variants in VARIANTS.items():
                if f"{robot} {kind} {suffix}" in ASKED:
                    others = [run for run in own.values() if run["ablation"] in variants]
                    holds = {run["hold"] for run in others if run["ablation"] != "default"}
                    if holds:
                        alike = _keep_alike(_keep_holds(own, holds), variants)
                        blocks[f"{robot} {kind} {suffix}"] = make_ablation_table(
                            alike, robot, names, variants
                        )
    return blocks


def _keep_holds(runs: Mapping[str, Run], holds: Collection[float]) -> dict[str, Run]:
    return {key: run for key, run in runs.items() if run["hold"] in holds}


def _keep_alike(runs: Mapping[str, Run], variants: Collection[str]) -> dict[str, Run]:
    """Keep the runs of those scenarios and seeds that some variant was run with.

    Rows of one table are compared, so they must have the same goals.
    """
    ran = {
        (run["scenario"], run["seed"])
        for run in runs.values()
        if run["ablation"] in variants and run["ablation"] != "default"
    }
    return {key: run for key, run in runs.items() if (run["scenario"], run["seed"]) in ran}


def describe_conditions(runs: Mapping[str, Run], machine: Mapping[str, Any]) -> str:
    """Describe machine, versions, seeds and holds in two sentences."""
    seeds = sorted({run["seed"] for run in runs.values()})
    stock = [run for run in runs.values() if run["ablation"] == "default"] or list(runs.values())
    holds = sorted({run["hold"] for run in stock})
    noise = sorted({run["noise"] for run in stock})
    return (
        f"{describe_versions(machine)} {len(runs)} runs; seeds {seeds[0]} to {seeds[-1]}; sensor "
        f"noise `{', '.join(noise)}`; goals held for "
        f"{' and '.join(f'{hold:g}' for hold in holds)} s (variants for the shorter)."
    )
