"""Metrics of one recorded episode from its columns, their table, and confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import stats

from xop_lerobot.core.command_line import format_table
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.evaluation.metrics import compute_falls, compute_pose_errors

if TYPE_CHECKING:
    from xop_lerobot.morphology.morphology import Morphology

END_S = 0.5
"""Last part of the engaged time over which the error "at the end" is averaged [s]."""
HEALTH = "retargeter.health"
SOLVE_TIME = "solve_time"


@dataclass(frozen=True)
class EpisodeSummary:
    """Metrics of one episode.

    Attributes:
        robot: Name of the robot.
        frames: Number of frames.
        duration_s: Duration, frames over fps [s].
        engaged_s: Time in which the operator was engaged [s].
        head_error_mean: Mean distance of `robot.head` from `goal.head` while engaged [m].
        head_error_end: Mean distance over the last `END_S` of the engaged time [m].
        falls: Number of falls.
        plan_ms_median: Median solve time of the retargeter [ms]; 0 if it never solved.
        plan_ms_p99: 99th percentile of the solve time [ms].
    """

    robot: str
    frames: int
    duration_s: float
    engaged_s: float
    head_error_mean: float
    head_error_end: float
    falls: int
    plan_ms_median: float
    plan_ms_p99: float


def compute_episode_summary(
    columns: Mapping[str, np.ndarray],
    health_names: Sequence[str],
    fps: int,
    robot: str,
    morphology: Morphology,
) -> EpisodeSummary:
    """Compute the metrics of one episode.

    Args:
        columns: The episode's columns by key, one row per frame.
        health_names: Names of the entries of `retargeter.health`.
        fps: Frame rate [Hz].
        robot: Name for the table.
        morphology: The robot, for the limits that define a fall.

    Raises:
        UnknownName: If a column or the solve time is missing; lists the available ones.
        BadValue: If the operator never engaged.
    """
    engaged = np.asarray(_get_column(columns, "operator.engaged")).reshape(-1).astype(bool)
    if not engaged.any():
        raise BadValue(
            f"{robot}: the operator never engaged in {len(engaged) / fps:.1f} s, so there is "
            "nothing to compare. Was the episode too short?"
        )
    head, goal = (_get_column(columns, key)[engaged] for key in ("robot.head", "goal.head"))
    distance, _ = compute_pose_errors(head.astype(float), goal.astype(float))
    if SOLVE_TIME not in health_names:
        raise UnknownName("health figure", SOLVE_TIME, health_names)
    solve = np.asarray(_get_column(columns, HEALTH), float)
    solve_ms = 1e3 * solve[engaged, list(health_names).index(SOLVE_TIME)]
    solve_ms = solve_ms[solve_ms > 0] if (solve_ms > 0).any() else np.zeros(1)
    return EpisodeSummary(
        robot=robot,
        frames=len(engaged),
        duration_s=len(engaged) / fps,
        engaged_s=float(engaged.sum() / fps),
        head_error_mean=float(distance.mean()),
        head_error_end=float(distance[-max(1, round(END_S * fps)) :].mean()),
        falls=compute_falls(
            _get_column(columns, "robot.base_pose"), morphology.fall_height, morphology.fall_tilt
        ),
        plan_ms_median=float(np.median(solve_ms)),
        plan_ms_p99=float(np.percentile(solve_ms, 99)),
    )


def read_columns(dataset: Any, episode: int = 0) -> dict[str, np.ndarray]:
    """Read the one-dimensional columns of an episode of a `LeRobotDataset`.

    Args:
        dataset: A `lerobot.datasets.LeRobotDataset`; videos are not decoded.
        episode: Index of the episode.

    Returns:
        Every numeric column by key. Shapes (T,) or (T, n).

    Raises:
        BadValue: If the dataset has no such episode.
    """
    if not 0 <= episode < dataset.meta.total_episodes:
        raise BadValue(
            f"episode {episode} is not in '{dataset.root}', which has "
            f"{dataset.meta.total_episodes} episodes"
        )
    rows = dataset.hf_dataset.with_format("numpy")
    of_episode = np.flatnonzero(np.asarray(rows["episode_index"][:]).reshape(-1) == episode)
    chosen = rows.select(of_episode)
    skipped = {"image", "video", "string"}
    return {
        key: np.asarray(chosen[key][:])
        for key, feature in dataset.meta.features.items()
        if feature["dtype"] not in skipped and key in chosen.column_names
    }


def format_summaries(summaries: Sequence[EpisodeSummary]) -> str:
    """Format the metrics as a table for a terminal, one row per episode."""
    header = (
        *("robot", "frames", "duration [s]", "engaged [s]", "head error mean [m]"),
        *("at the end [m]", "falls", "plan median [ms]", "plan p99 [ms]"),
    )
    rows = [
        (
            summary.robot,
            str(summary.frames),
            f"{summary.duration_s:.1f}",
            f"{summary.engaged_s:.1f}",
            f"{summary.head_error_mean:.3f}",
            f"{summary.head_error_end:.3f}",
            str(summary.falls),
            f"{summary.plan_ms_median:.1f}",
            f"{summary.plan_ms_p99:.1f}",
        )
        for summary in summaries
    ]
    return format_table(header, rows)


def _get_column(columns: Mapping[str, np.ndarray], key: str) -> np.ndarray:
    try:
        return np.asarray(columns[key])
    except KeyError:
        raise UnknownName("column", key, columns) from None


class Interval(NamedTuple):
    """95% confidence interval of a metric.

    Attributes:
        low: Lower end.
        high: Upper end.
    """

    low: float
    high: float


def compute_rate_interval(count: int, trials: int) -> Interval:
    r"""Compute Wilson's 95% score interval of a rate.

    .. math:: \frac{\hat p + z^2/2n \pm z\sqrt{\hat p(1-\hat p)/n + z^2/4n^2}}{1 + z^2/n}

    It is valid for few trials and for rates of 0 and 1, where the normal approximation has zero
    width.

    Raises:
        BadValue: If `count` is not between 0 and `trials`, or there are no trials.
    """
    if not 0 <= count <= trials or trials < 1:
        raise BadValue(f"a rate needs 0 <= count <= trials and a trial, got {count} of {trials}")
    found = stats.binomtest(count, trials).proportion_ci(0.95, method="wilson")
    return Interval(float(found.low), float(found.high))


def compute_mean_interval(values: Sequence[float], seed: int = 0) -> Interval:
    """Compute the 95% percentile bootstrap interval of a mean, with 2000 resamples.

    Args:
        values: Values; non-finite ones are ignored.
        seed: Seed of the resampling.

    Returns:
        The interval; nan without values, of zero width for a single one.
    """
    known = np.asarray([value for value in values if np.isfinite(value)], float)
    if known.size == 0:
        return Interval(float("nan"), float("nan"))
    if known.size == 1 or np.ptp(known) == 0:
        return Interval(float(known[0]), float(known[0]))
    found = stats.bootstrap(
        (known,),
        np.mean,
        n_resamples=2000,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(float(found.low), float(found.high))
