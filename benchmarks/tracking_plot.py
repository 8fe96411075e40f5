"""Plots of the tracking benchmark; needs matplotlib of the extra `dev`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.tracking_metrics import Trajectory, compute_errors
from benchmarks.tracking_report import Run, select
from benchmarks.tracking_scenarios import SCENARIOS, GoalTrack
from xop_lerobot.core.transforms import quat_to_rpy

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

CHOSEN = {"default": "#1f77b4", "no_sync": "#2ca02c", "table1_equal": "#d95f02"}
"""Variants in `plot_variants` and their colours."""
GOAL, HEAD, BASE = "#888888", "#1f77b4", "#d95f02"


def plot_run(
    path: Path, title: str, track: GoalTrack, trajectory: Trajectory, names: Sequence[str]
) -> None:
    """Plot goal, head, base, commands and errors of a run over time.

    Args:
        path: File to write; its suffix is the format.
        title: Title of the figure.
        track: The goals.
        trajectory: The trajectory.
        names: Names of the command entries. Length k.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(12, 14), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    axes = figure.subplots(6, 2, sharex=False)
    time = trajectory.time
    for i, label in enumerate("xyz"):
        ax = axes[i, 0]
        ax.plot(time, trajectory.goal[:, i], color=GOAL, lw=2, label="goal")
        ax.plot(time, trajectory.head[:, i], color=HEAD, label="head")
        if i < 2:
            ax.plot(time, trajectory.base[:, i], color=BASE, lw=1, label="base")
        ax.set_ylabel(f"{label} [m]")
    for i, label in enumerate(("roll", "pitch", "yaw")):
        ax = axes[i, 1]
        for pose, color, width in (
            (trajectory.goal, GOAL, 2), (trajectory.head, HEAD, 1.5), (trajectory.base, BASE, 1)
        ):  # fmt: skip
            ax.plot(time, np.degrees(_angle(pose, i)), color=color, lw=width)
        ax.set_ylabel(f"{label} [°]")
    _plot_errors(axes[3], track, trajectory)
    _plot_commands((axes[4, 0], axes[4, 1], axes[5, 0]), time, trajectory.command, names)
    plot_floor(axes[5, 1], trajectory)
    axes[0, 0].legend(loc="best", fontsize=8)
    for ax in axes.ravel():
        ax.grid(alpha=0.3)
        if ax is not axes[5, 1]:
            ax.set_xlim(time[0], time[-1])
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)


def _angle(pose: np.ndarray, axis: int) -> np.ndarray:
    return np.unwrap(quat_to_rpy(pose[:, 3:])[:, axis])


def _plot_errors(axes: np.ndarray, track: GoalTrack, trajectory: Trajectory) -> None:
    errors = compute_errors(trajectory, [step.start for step in track.steps])
    pairs = (
        (errors.position * 100, errors.mean_position * 100, "position error [cm]"),
        (np.degrees(errors.angle), np.degrees(errors.mean_angle), "orientation error [°]"),
    )
    for ax, (instant, mean, label) in zip(axes, pairs, strict=True):
        ax.plot(trajectory.time, instant, color=HEAD, lw=1, label="instant")
        ax.plot(trajectory.time, mean, color=BASE, lw=1.5, label="1 s mean")
        for step in track.steps:
            ax.axvline(step.start + step.limit_s, color="k", lw=0.7, ls="--")
        # The axis fits the settled part; the first error, the step itself, would dwarf it.
        settled = instant[trajectory.time > 0.3 * trajectory.time[-1]]
        ax.set_ylim(0, max(2.0, 2 * float(np.percentile(settled, 90))))
        ax.set_ylabel(label)
    axes[0].legend(loc="best", fontsize=8)


def _plot_commands(
    axes: Sequence[Axes], time: np.ndarray, command: np.ndarray, names: Sequence[str]
) -> None:
    """Plot velocity commands, posture commands less their first value, and changes per tick."""
    fast = [i for i, name in enumerate(names) if name in ("vx", "vy", "v", "yaw_rate")]
    for ax, chosen, label in (
        (axes[0], fast, "velocity commands [m/s, rad/s]"),
        (axes[1], [i for i in range(len(names)) if i not in fast], "posture commands [m, rad]"),
    ):
        for i in chosen:
            shown = command[:, i] - (0 if i in fast else command[0, i])
            ax.plot(time, shown, lw=1, label=names[i])
        ax.set_ylabel(label)
        ax.legend(loc="best", fontsize=7, ncols=2)
        ax.set_xlabel("time [s]")
    axes[2].plot(time[1:], np.linalg.norm(np.diff(command, axis=0), axis=1), lw=0.8)
    axes[2].set_ylabel("change of command per tick")
    axes[2].set_xlabel("time [s]")


def plot_floor(ax: Axes, trajectory: Trajectory) -> None:
    """Plot the paths of goal, head and base on the floor."""
    for pose, color, label in (
        (trajectory.goal, GOAL, "goal"), (trajectory.base, BASE, "base"),
        (trajectory.head, HEAD, "head"),
    ):  # fmt: skip
        ax.plot(pose[:, 0], pose[:, 1], color=color, lw=1, label=label)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")


def plot_variants(path: Path, runs: Mapping[str, Run], robot: str, scenarios: Sequence[str]) -> int:
    """Plot the position error of some variants over time: median and range over the seeds.

    Args:
        path: File to write.
        runs: Runs by key, all of one hold.
        robot: Name of the robot.
        scenarios: Names of the scenarios, one chart each.

    Returns:
        Number of curves; with none, no file is written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    columns = 3
    rows = -(-len(scenarios) // columns)
    figure = Figure(figsize=(4 * columns, 2.6 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    drawn = 0
    for ax, scenario in zip(axes, scenarios, strict=False):
        for ablation, color in CHOSEN.items():
            found = select(runs, robot=robot, scenario=scenario, ablation=ablation)
            traces = [run["trace"] for run in found if run.get("trace")]
            if traces:
                _plot_band(ax, traces, color, ablation)
                drawn += 1
        ax.set_title(f"{scenario}: {SCENARIOS[scenario].title}", fontsize=9)
        ax.set_yscale("log")
        ax.set_ylim(0.1, 300)
        ax.grid(alpha=0.3)
        tolerance = SCENARIOS[scenario].get_tolerance(robot).position * 100
        ax.axhline(tolerance, color="k", lw=0.7, ls=":")
    for ax in axes[len(scenarios) :]:
        ax.set_axis_off()
    axes[0].set_ylabel("position error [cm]")
    axes[0].legend(loc="best", fontsize=7)
    figure.supxlabel("time [s]", fontsize=9)
    if drawn:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=80)
    return drawn


def _plot_band(ax: Axes, traces: Sequence[Mapping[str, Any]], color: str, label: str) -> None:
    """Plot the median of traces and their range; traces may have different lengths."""
    longest = max(len(trace["position_cm"]) for trace in traces)
    values = np.full((len(traces), longest), np.nan)
    for row, trace in zip(values, traces, strict=True):
        row[: len(trace["position_cm"])] = trace["position_cm"]
    times = np.arange(longest) * traces[0]["dt"]
    ax.plot(times, np.nanmedian(values, axis=0), color=color, lw=1.2, label=label)
    ax.fill_between(
        times, np.nanmin(values, axis=0), np.nanmax(values, axis=0), color=color, alpha=0.2, lw=0
    )
    for limit in traces[0]["limits"]:
        ax.axvline(limit, color="k", lw=0.7, ls="--")
