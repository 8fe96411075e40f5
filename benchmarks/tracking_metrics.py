"""Metrics of one run of the tracking benchmark, of the head's true pose.

A walking robot's head sways with each step. Hence every error is given twice: *instant*, per tick,
and *mean*, the norm of the error vector averaged over the last second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.tracking_scenarios import GoalStep, GoalTrack, Tolerance
from xop_lerobot.core.errors import BadShape
from xop_lerobot.core.transforms import rotation_error

WINDOW_S = 1.0
"""Window of the mean errors [s]."""
MOVING_AFTER_S = 2.0
"""Time after a moving goal's start from which its error counts [s]."""


@dataclass(frozen=True)
class Trajectory:
    """Trajectory of a run, per tick; poses are true, in the world, x y z qw qx qy qz.

    Attributes:
        time: Track's clock [s]. Shape (n,).
        head: Pose of the head. Shape (n, 7).
        goal: Goal of the head. Shape (n, 7).
        base: Pose of the base. Shape (n, 7).
        command: Executed command. Shape (n, k).
        feet: Position of each foot or wheel, the mean of its contact points [m]. Shape (n, f, 3).
        hands: Distance of each wrist from its goal [m]. Shape (n, 2).
        fallen: Whether the robot has fallen. Shape (n,), bool.
        collision: Whether the robot collided in the tick. Shape (n,), bool.
        solve_s: Time of each solve [s]. Shape (m,).
        contacts: Pairs of bodies in collision at any tick.
        failed: Whether each solve had no sample of finite cost. Shape (m,), bool.
        intervened: Whether the retargeter slowed or vetoed each plan. Shape (m,), bool.

    Raises:
        BadShape: If an array does not have an entry per tick.
    """

    time: np.ndarray
    head: np.ndarray
    goal: np.ndarray
    base: np.ndarray
    command: np.ndarray
    feet: np.ndarray
    hands: np.ndarray
    fallen: np.ndarray
    collision: np.ndarray
    solve_s: np.ndarray
    contacts: tuple[tuple[str, str], ...] = ()
    failed: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    intervened: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        for name in ("head", "goal", "base", "command", "feet", "hands", "fallen", "collision"):
            array = getattr(self, name)
            if len(array) != len(self.time):
                raise BadShape(f"trajectory.{name}", (len(self.time), ...), array.shape)


@dataclass(frozen=True)
class Errors:
    """Errors of the head per tick.

    Attributes:
        position: Distance to the goal [m]. Shape (n,).
        angle: Angle of the rotation to the goal [rad]. Shape (n,).
        mean_position: Norm of the position error averaged over `WINDOW_S` [m]. Shape (n,).
        mean_angle: Norm of the rotation error averaged over `WINDOW_S` [rad]. Shape (n,).
    """

    position: np.ndarray
    angle: np.ndarray
    mean_position: np.ndarray
    mean_angle: np.ndarray

    def find_within(self, tolerance: Tolerance, *, mean: bool = False) -> np.ndarray:
        """Return whether each tick's (mean) errors are within `tolerance`. Shape (n,), bool."""
        position, angle = self.position, self.angle
        if mean:
            position, angle = self.mean_position, self.mean_angle
        return (position <= tolerance.position) & (angle <= tolerance.angle)


def compute_errors(trajectory: Trajectory, starts: Sequence[float] = ()) -> Errors:
    """Compute the errors of every tick.

    Mean errors average the error *vectors* over the window before each tick, or the part of it
    with the same goal: a sway about the goal averages out, an offset does not.

    Args:
        trajectory: The trajectory.
        starts: Times at which the goal stepped [s].
    """
    goal, head = trajectory.goal, trajectory.head
    offset = head[:, :3] - goal[:, :3]
    turn = rotation_error(goal[:, 3:], head[:, 3:])
    time = trajectory.time
    firsts = np.searchsorted(time, np.sort([time[0], *starts]) - 1e-9)
    segment = firsts[np.searchsorted(firsts, np.arange(len(time)), side="right") - 1]
    mean_offset = _average_last(time, offset, segment)
    mean_turn = _average_last(time, turn, segment)
    return Errors(
        np.linalg.norm(offset, axis=1),
        np.linalg.norm(turn, axis=1),
        np.linalg.norm(mean_offset, axis=1),
        np.linalg.norm(mean_turn, axis=1),
    )


def _average_last(time: np.ndarray, values: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Average each tick's last `WINDOW_S`, not before tick `first[i]`. Shape (n, d)."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    start = np.maximum(np.searchsorted(time, time - WINDOW_S + 1e-9), first)
    end = np.arange(len(time)) + 1
    return (sums[end] - sums[start]) / (end - start)[:, None]


def compute_step_metrics(
    step: GoalStep, end: float, time: np.ndarray, errors: Errors, tolerance: Tolerance
) -> dict[str, float]:
    """Compute the metrics of one held goal, from its start to `end` [s].

    Args:
        step: The goal.
        end: End of the goal on the track's clock [s].
        time: Track's clock of each tick [s]. Shape (n,).
        errors: Errors of each tick.
        tolerance: Errors that count as arrived.

    Returns:
        ``arrival_s``, ``arrival_mean_s``: time from the step until the errors are first within
        the tolerance, infinite if never; ``late_s``, ``late_mean_s``: the same less the time of
        the direct path; ``at_limit_*``: error at the time limit; ``after_*``: errors from then
        on, as worst (``max``), 95th percentile and median; ``final_*``: last error;
        ``outside_share``: fraction of ticks out of tolerance after the limit. Those of the mean
        errors begin `WINDOW_S` later, when the whole window is past the limit.
    """
    since = (time >= step.start - 1e-9) & (time < end - 1e-9)
    limit = step.start + step.limit_s
    metrics = {}
    for label, mean in (("", False), ("mean_", True)):
        inside = since & errors.find_within(tolerance, mean=mean)
        metrics[f"arrival_{label}s"] = _first(time, inside) - step.start
        after = since & (time >= limit + (WINDOW_S if mean else 0) - 1e-9)
        position = (errors.mean_position if mean else errors.position)[after] * 100
        angle = np.degrees((errors.mean_angle if mean else errors.angle)[after])
        for unit, values in (("cm", position), ("deg", angle)):
            values = values if values.size else np.array([math.nan])  # noqa: PLW2901
            metrics[f"at_limit_{label}{unit}"] = float(values[0])
            metrics[f"after_{label}max_{unit}"] = float(values.max())
            metrics[f"after_{label}p95_{unit}"] = float(np.percentile(values, 95))
            metrics[f"after_{label}median_{unit}"] = float(np.median(values))
            metrics[f"final_{label}{unit}"] = float(values[-1])
    metrics["late_s"] = metrics["arrival_s"] - step.direct_s
    metrics["late_mean_s"] = metrics["arrival_mean_s"] - step.direct_s
    after = since & (time >= limit - 1e-9)
    outside = ~errors.find_within(tolerance)[after]
    metrics["outside_share"] = float(outside.mean()) if outside.size else math.nan
    return metrics


def _first(time: np.ndarray, mask: np.ndarray) -> float:
    return float(time[np.argmax(mask)]) if mask.any() else math.inf


def compute_metrics(
    track: GoalTrack, trajectory: Trajectory, tolerance: Tolerance
) -> dict[str, float]:
    """Compute the metrics of one run.

    Returns:
        For goals that step: the worst of `compute_step_metrics` over the goals, and the numbers
        ``goals``, ``arrived_goals`` and ``collided_goals``. For one that moves, ``moving_*``:
        mean, worst and 95th percentile of the error. For all: ``foot_cm``, the largest
        displacement of a foot from its start; ``hand_cm``, the median distance of the hands from
        their goals; ``tilt_deg``, the largest tilt of the base; ``falls`` and ``collisions``
        (0 or 1); ``failed_percent`` and ``intervened_percent`` of the solves; ``solve_ms`` and
        ``solve_p99_ms``, the median and 99th percentile of the solve time.
    """
    errors = compute_errors(trajectory, [step.start for step in track.steps])
    time = trajectory.time
    metrics: dict[str, float] = {}
    if track.steps:
        ends = [step.start for step in track.steps[1:]] + [track.duration]
        each = [
            compute_step_metrics(step, end, time, errors, tolerance)
            for step, end in zip(track.steps, ends, strict=True)
        ]
        metrics |= {name: float(np.max([figures[name] for figures in each])) for name in each[0]}
        metrics["goals"] = len(each)
        metrics["arrived_goals"] = sum(math.isfinite(figures["arrival_s"]) for figures in each)
        metrics["collided_goals"] = sum(
            bool(trajectory.collision[(time >= step.start) & (time < end)].any())
            for step, end in zip(track.steps, ends, strict=True)
        )
    else:
        moving = time >= track.reach_start + MOVING_AFTER_S
        metrics["moving_whole_mean_cm"] = float(errors.position[time >= track.reach_start].mean())
        metrics["moving_whole_mean_cm"] *= 100
        metrics["moving_mean_cm"] = float(errors.position[moving].mean()) * 100
        metrics["moving_p95_cm"] = float(np.percentile(errors.position[moving], 95)) * 100
        metrics["moving_max_cm"] = float(errors.position[moving].max()) * 100
        metrics["moving_mean_deg"] = math.degrees(float(errors.angle[moving].mean()))
    travel = np.linalg.norm(trajectory.feet - trajectory.feet[0], axis=-1)
    metrics["foot_cm"] = float(travel.max()) * 100 if travel.size else 0.0
    metrics["hand_cm"] = float(np.nanmedian(trajectory.hands)) * 100
    w, x, y, z = trajectory.base[:, 3:].T
    metrics["tilt_deg"] = math.degrees(
        float(np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1)).max())
    )
    metrics["falls"] = float(trajectory.fallen.any())
    metrics["collisions"] = float(trajectory.collision.any())
    if trajectory.solve_s.size:
        metrics["solve_ms"] = float(np.median(trajectory.solve_s)) * 1000
        metrics["solve_p99_ms"] = float(np.percentile(trajectory.solve_s, 99)) * 1000
    for name, flags in (("failed", trajectory.failed), ("intervened", trajectory.intervened)):
        metrics[f"{name}_percent"] = float(flags.mean()) * 100 if flags.size else 0.0
    return metrics
