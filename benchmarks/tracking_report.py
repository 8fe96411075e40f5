"""Results of the tracking benchmark: their JSON file, tables of them, and blocks of documents."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tracking_scenarios import SCENARIOS, Scenario
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.evaluation.bench_report import describe_machine, make_table

Run = Mapping[str, Any]


class Results:
    """Runs by key, kept in a JSON file so that an interrupted benchmark can be resumed.

    Args:
        path: The file, rewritten atomically after every run; None for none.
        fresh: Whether to discard the runs in the file.

    Raises:
        BadValue: If the file contains no results.
    """

    def __init__(self, path: Path | None, *, fresh: bool = False) -> None:
        self.path = path
        self.runs: dict[str, dict[str, Any]] = {}
        if path is not None and path.exists() and not fresh:
            self.runs = read_runs(path)

    def add(self, key: str, run: dict[str, Any]) -> None:
        """Add a run and write the file."""
        self.runs[key] = run
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_suffix(".part")
        machine = json.dumps(describe_machine())
        lines = ",\n".join(
            f"{json.dumps(name)}: {json.dumps(each, allow_nan=False)}"
            for name, each in self.runs.items()
        )
        part.write_text(f'{{"machine": {machine}, "runs": {{\n{lines}\n}}}}\n')
        part.replace(self.path)


def read_runs(path: Path) -> dict[str, dict[str, Any]]:
    """Read the runs of a results file.

    Raises:
        BadValue: If the file is not a results file.
    """
    try:
        return json.loads(path.read_text())["runs"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise BadValue(f"'{path}' holds no results of the tracking benchmark: {error!r}") from error


# -- tables --------------------------------------------------------------------------------------

STATIONARY_COLUMNS = {
    "at 1.5 s [cm]": "at_limit_cm",
    "[°]": "at_limit_deg",
    "after, p95 [cm]": "after_p95_cm",
    "p95 [°]": "after_p95_deg",
    "1 s mean, worst [cm]": "after_mean_max_cm",
    "worst [°]": "after_mean_max_deg",
    "foot [cm]": "foot_cm",
}
MOBILE_COLUMNS = {
    "late [s]": "late_s",
    "after, p95 [cm]": "after_p95_cm",
    "worst [cm]": "after_max_cm",
    "p95 [°]": "after_p95_deg",
    "1 s mean, worst [cm]": "after_mean_max_cm",
    "worst [°]": "after_mean_max_deg",
}
CURVE_COLUMNS = {
    "mean [cm]": "moving_mean_cm",
    "p95 [cm]": "moving_p95_cm",
    "worst [cm]": "moving_max_cm",
    "whole run, mean [cm]": "moving_whole_mean_cm",
    "mean [°]": "moving_mean_deg",
}
ROOM_COLUMNS = {
    "goals": "goals",
    "with contact": "collided_goals",
    "arrived": "arrived_goals",
}
ARMS_COLUMNS = {
    "after, p95 [cm]": "after_p95_cm",
    "final [cm]": "final_cm",
    "hands, median [cm]": "hand_cm",
    "foot [cm]": "foot_cm",
    "tilt, worst [°]": "tilt_deg",
}
BEYOND_COLUMNS = {
    "missed by [cm]": "final_cm",
    "missed by [°]": "final_deg",
    "foot [cm]": "foot_cm",
    "tilt, worst [°]": "tilt_deg",
}
SUMMED = ("falls", "collisions", "goals", "collided_goals", "arrived_goals")
ABLATION_COLUMNS = {
    "final [cm]": "final_mean_cm",
    "final [°]": "final_mean_deg",
    "after, p95 [cm]": "after_p95_cm",
    "after, p95 [°]": "after_p95_deg",
    "mean [cm]": "moving_mean_cm",
    "worst [cm]": "moving_max_cm",
    "mean [°]": "moving_mean_deg",
    "failed solves [%]": "failed_percent",
    "vetoed [%]": "intervened_percent",
}


def get_columns(scenario: Scenario) -> dict[str, str]:
    """Return the metrics that describe a run of `scenario`, by column heading."""
    special = {
        "curve": CURVE_COLUMNS,
        "room": ROOM_COLUMNS,
        "arms": ARMS_COLUMNS,
        "beyond": BEYOND_COLUMNS,
    }
    if scenario.name in special:
        return special[scenario.name]
    return STATIONARY_COLUMNS if scenario.mode is Mode.STATIONARY else MOBILE_COLUMNS


def compute_median_and_worst(runs: Sequence[Run], metric: str) -> tuple[float, float]:
    """Compute the median and the maximum of a metric over runs; None counts as infinite."""
    values = [run["metrics"].get(metric) for run in runs]
    numbers = np.array([math.inf if value is None else value for value in values], dtype=float)
    if not numbers.size:
        return math.nan, math.nan
    return float(np.median(numbers)), float(numbers.max())


def format_number(value: float) -> str:
    """Format a number with one decimal below 100; ``never`` for infinity, ``–`` for NaN."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "never"
    return f"{value:.0f}" if abs(value) >= 100 or value == round(value) else f"{value:.1f}"


def format_cell(runs: Sequence[Run], metric: str) -> str:
    """Format ``median / worst`` of a metric, or its sum if it is a count."""
    if metric in SUMMED:
        return format_number(sum(run["metrics"][metric] for run in runs))
    if all(metric not in run["metrics"] for run in runs):
        return "–"
    median, worst = compute_median_and_worst(runs, metric)
    return f"{format_number(median)} / {format_number(worst)}"


def format_ratio(runs: Sequence[Run], base: Sequence[Run], metric: str) -> str:
    """Format the ratio of a metric's median to that of the runs `base`."""
    median, _ = compute_median_and_worst(runs, metric)
    reference, _ = compute_median_and_worst(base, metric)
    if not (math.isfinite(median) and math.isfinite(reference) and reference > 0):
        return "–"
    return f"{median / reference:.1f}"


def select(runs: Mapping[str, Run], **wanted: Any) -> list[Run]:
    """Return the runs whose entries equal `wanted`, ordered by seed."""
    found = [run for run in runs.values() if all(run[k] == v for k, v in wanted.items())]
    return sorted(found, key=lambda run: run["seed"])


def make_scenario_table(
    runs: Mapping[str, Run], robot: str, names: Sequence[str], ablation: str = "default"
) -> str:
    """Make a table of scenarios of one kind, a row each, of ``median / worst`` over the seeds.

    Raises:
        UnknownName: If there is no such scenario.
    """
    rows, columns = [], {}
    for name in names:
        if name not in SCENARIOS:
            raise UnknownName("scenario", name, SCENARIOS)
        scenario = SCENARIOS[name]
        columns = get_columns(scenario)
        found = select(runs, robot=robot, scenario=name, ablation=ablation)
        if found:
            cells = [format_cell(found, metric) for metric in columns.values()]
            falls, seeds = format_cell(found, "falls"), str(len(found))
            rows.append([scenario.title, *cells, falls, seeds])
    return make_table(["goal", *columns, "falls", "seeds"], rows)


def make_ablation_table(
    runs: Mapping[str, Run], robot: str, scenarios: Sequence[str], ablations: Mapping[str, Any]
) -> str:
    """Make a table of variants, a row each, of ``median / worst`` over all runs of `scenarios`.

    A column omits scenarios that lack its metric. The column "× default" is the ratio of the
    first metric's median to that of the default.
    """
    groups = {
        name: [
            run
            for scenario in scenarios
            for run in select(runs, robot=robot, scenario=scenario, ablation=name)
        ]
        for name in ablations
    }
    columns = {
        heading: metric
        for heading, metric in ABLATION_COLUMNS.items()
        if any(metric in run["metrics"] for found in groups.values() for run in found)
    }
    rows = []
    for name, found in groups.items():
        if not found:
            continue
        cells = [
            format_cell([run for run in found if metric in run["metrics"]], metric)
            for metric in columns.values()
        ]
        steps = sorted({round(run["physics_steps_per_s"]) for run in found})
        rows.append(
            [
                f"`{name}`: {ablations[name].title}",
                *cells,
                format_ratio(found, groups.get("default", []), next(iter(columns.values()), "")),
                format_cell(found, "falls"),
                " and ".join(str(step) for step in steps),
                str(len(found)),
            ]
        )
    return make_table(["variant", *columns, "× default", "falls", "physics steps/s", "runs"], rows)


# -- documents -----------------------------------------------------------------------------------


def fill_document(text: str, blocks: Mapping[str, Callable[[], str] | str]) -> str:
    """Replace the text between the markers ``<!-- begin NAME -->`` and ``<!-- end NAME -->``.

    Raises:
        BadValue: If a block has no pair of markers in `text`.
    """
    for name, block in blocks.items():
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        head, found, rest = text.partition(begin)
        _, closed, tail = rest.partition(end)
        if not (found and closed):
            raise BadValue(f"the document has no '{begin}' with '{end}' after it")
        content = block if isinstance(block, str) else block()
        text = f"{head}{begin}\n{content}\n{end}{tail}"
    return text


def describe_run(key: str, run: Run) -> str:
    """Describe a run's key metrics in one line."""
    columns = get_columns(SCENARIOS[run["scenario"]])
    cells = []
    for heading, metric in {**columns, "falls": "falls", "solve [ms]": "solve_ms"}.items():
        value = run["metrics"].get(metric)
        number = "never" if value is None and metric in run["metrics"] else value
        text = format_number(number) if isinstance(number, int | float) else str(number)
        cells.append(f"{heading} {text}")
    name = "/".join(key.split("/")[:-1])
    for kind in ("failed", "intervened"):
        if share := run["metrics"].get(f"{kind}_percent"):
            cells.append(f"{kind.upper()} SOLVES {share:.0f} %")
    touched = f"; touched {', '.join(run['contacts'][:4])}" if run["contacts"] else ""
    return f"{name}: {', '.join(cells)}{touched} ({run['wall_s']:.0f} s)"
