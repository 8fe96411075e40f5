"""Plots of a study: rates with Wilson's intervals, means with bootstrap intervals, head paths."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from xop_lerobot.evaluation.summary import compute_mean_interval, compute_rate_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Trials = Sequence[Mapping[str, Any]]

COLOURS = {
    "mpc": "#2166ac",
    "mpc_no_sync": "#92c5de",
    "mpc_table1": "#9970ab",
    "mpc_table1_charitable": "#c2a5cf",
    "direct": "#d6604d",
    "direct_amo": "#b2182b",
}
"""Colour of each method; others are grey."""
RATES = {"success": "success", "picked_up": "picked up", "collision": "collided", "fallen": "fell"}
MEANS: dict[str, tuple[str, float]] = {
    "completion_s": ("completion time [s]", 1.0),
    "abp": ("balance power [W]", 1.0),
    "tilt": ("tilt of the palm [rad]", 1.0),
    "jerk": ("jerk of the palm [m/s³]", 1.0),
    "head_error": ("error of the head [cm]", 100.0),
    "hands_error": ("error of the hands [cm]", 100.0),
    "roughness": ("roughness of commands [1/s²]", 1.0),
    "plan_p99_ms": ("solve, 99th percentile [ms]", 1.0),
}
"""Title and scale of each plotted metric."""


def _make_figure(columns: int, rows: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained", dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.ravel())


def _to_png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def plot_rates(cells: Mapping[str, tuple[str, Trials]]) -> bytes:
    """Plot the rates of each cell, with 95% intervals.

    Args:
        cells: Method and trials of each cell, by label; cells without trials are skipped.

    Returns:
        A PNG image.
    """
    shown = {label: cell for label, cell in cells.items() if cell[1]}
    rates = {
        name: title
        for name, title in RATES.items()
        if name == "success" or any(trial[name] for _, trials in shown.values() for trial in trials)
    }
    figure, axes = _make_figure(len(rates), 1, 3.6, 0.9 + 0.33 * max(len(shown), 1))
    for ax, (name, title) in zip(axes, rates.items(), strict=True):
        for row, (method, trials) in enumerate(shown.values()):
            count = sum(trial[name] for trial in trials)
            low, high = compute_rate_interval(count, len(trials))
            share = count / len(trials)
            colour = COLOURS.get(method, "grey")
            ax.barh(row, share, color=colour, height=0.6)
            ax.errorbar(
                share, row, xerr=[[max(share - low, 0)], [max(high - share, 0)]],
                color="k", capsize=3, lw=1,
            )  # fmt: skip
            ax.text(1.04, row, f"{count}/{len(trials)}", va="center", fontsize=8)
        _label_rows(ax, list(shown) if ax is axes[0] else None, len(shown))
        ax.set_xlim(0, 1.2)
        ax.set_xticks([0, 0.5, 1], ["0", "50%", "100%"])
        ax.set_title(title, fontsize=10)
    return _to_png(figure)


def plot_means(cells: Mapping[str, tuple[str, Trials]]) -> bytes | None:
    """Plot the metrics of every trial, their mean and its 95% interval.

    Completion times are of successful trials only. A metric that no trial has is skipped.

    Args:
        cells: As in `plot_rates`.

    Returns:
        A PNG image, None if there is nothing to plot.
    """
    shown = {label: cell for label, cell in cells.items() if cell[1]}
    names = [
        name for name in MEANS if any(find_values(trials, name) for _, trials in shown.values())
    ]
    if not names:
        return None
    columns = 4
    rows = -(-len(names) // columns)
    figure, axes = _make_figure(columns, rows, 3.3, 0.9 + 0.33 * len(shown))
    rng = np.random.default_rng(0)
    for index, (ax, name) in enumerate(zip(axes, names, strict=False)):
        title, scale = MEANS[name]
        for row, (method, trials) in enumerate(shown.values()):
            values = np.array(find_values(trials, name)) * scale
            if not values.size:
                continue
            colour = COLOURS.get(method, "grey")
            spread = row + rng.uniform(-0.18, 0.18, values.size)
            ax.plot(values, spread, ".", color=colour, alpha=0.45, ms=5)
            low, high = compute_mean_interval(list(values))
            mean = float(values.mean())
            ax.errorbar(
                mean, row, xerr=[[max(mean - low, 0)], [max(high - mean, 0)]],
                fmt="|", color="k", capsize=3, ms=12, lw=1.2,
            )  # fmt: skip
        _label_rows(ax, list(shown) if index % columns == 0 else None, len(shown))
        ax.set_xlim(left=0)
        ax.set_title(title, fontsize=10)
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    return _to_png(figure)


def find_values(trials: Trials, name: str) -> list[float]:
    """Return the values of a metric; completion times of successful trials only."""
    if name == "completion_s":
        return [trial[name] for trial in trials if trial["success"]]
    found = (trial["metrics"].get(name) for trial in trials)
    return [value for value in found if value is not None]


def plot_ways(cells: Mapping[str, tuple[str, Trials]]) -> bytes:
    """Plot the path of the head, seen from above, for every trial of each cell.

    Args:
        cells: As in `plot_rates`.

    Returns:
        A PNG image.
    """
    shown = {label: cell for label, cell in cells.items() if cell[1]}
    return _plot_each(shown, _draw_ways, equal=True)


def plot_errors(cells: Mapping[str, tuple[str, Trials]]) -> bytes:
    """Plot errors of head and hands over time for the first trial of each cell, as PNG."""
    shown = {label: cell for label, cell in cells.items() if cell[1]}
    return _plot_each(shown, _draw_errors, equal=False)


def _plot_each(
    cells: Mapping[str, tuple[str, Trials]],
    draw: Callable[[Axes, str, Trials], None],
    *,
    equal: bool,
) -> bytes:
    columns = min(4, max(len(cells), 1))
    rows = -(-len(cells) // columns) or 1
    figure, axes = _make_figure(columns, rows, 3.4, 3.0 if equal else 2.4)
    for ax, (label, (method, trials)) in zip(axes, cells.items(), strict=False):
        draw(ax, method, trials)
        ax.set_title(label, fontsize=9)
        ax.grid(alpha=0.3)
        if equal:
            ax.set_aspect("equal", adjustable="datalim")
    for ax in axes[len(cells) :]:
        ax.set_axis_off()
    return _to_png(figure)


def _draw_ways(ax: Axes, method: str, trials: Trials) -> None:
    for trial in trials:
        x, y = np.array(trial["plot"]["head_xy"]).T
        good = trial["success"]
        ax.plot(x, y, lw=0.8, alpha=0.7, color=COLOURS.get(method, "grey"))
        ax.plot(x[-1], y[-1], "o" if good else "x", ms=4, color="k" if good else "red")
    ax.set_xlabel("x [m]", fontsize=8)
    ax.set_ylabel("y [m]", fontsize=8)


def _draw_errors(ax: Axes, method: str, trials: Trials) -> None:
    del method
    plot = trials[0]["plot"]
    for name, colour in (("head", "k"), ("left", "#d6604d"), ("right", "#4393c3")):
        values = [math.nan if v is None else v * 100 for v in plot[f"{name}_error"]]
        time = np.arange(len(values)) * plot["dt"]
        ax.plot(time, values, lw=0.9, color=colour, label=name)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("time [s]", fontsize=8)
    ax.set_ylabel("distance from goal [cm]", fontsize=8)
    ax.legend(fontsize=7)


def _label_rows(ax: Axes, labels: Sequence[str] | None, count: int) -> None:
    ax.set_ylim(count - 0.4, -0.6)
    ax.set_yticks(range(count), labels if labels is not None else [""] * count, fontsize=8)
    ax.tick_params(axis="x", labelsize=8)
    ax.grid(axis="x", alpha=0.3)
