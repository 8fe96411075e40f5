"""Metrics of one trial: which ticks and joints enter each of the paper's formulas."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.state import FRAMES
from xop_lerobot.evaluation.metrics import (
    compute_balance_power,
    compute_jerk,
    compute_longest_hold,
    compute_roughness,
    compute_slip,
    compute_tilt,
    compute_tracking_error,
)
from xop_lerobot.evaluation.trial import Trace, Trial
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.model.kinematics import SiteKinematics

TOUCH = 0.05
"""Distance at which a palm touches its point, as in the paper [m]."""
RELEASE_RADIUS = 0.10
"""Horizontal distance from the opening within which a carried object is being released [m]."""
LOST_DISTANCE = 0.08
"""Increase of an object's distance from the palm from which it has left the palm [m]."""
TRACE_DT = 0.2
"""Time step of the data kept for plots [s]."""


def compute_metrics(trial: Trial) -> dict[str, float]:
    """Compute the metrics of a trial; nan for metrics without samples.

    Returns:
        ``abp`` and ``abp_signed`` [W]; ``tilt`` [rad] and ``jerk`` [m/s³] of the carrying palm
        before the release, if something is carried on it, else ``jerk`` of both palms;
        ``head_error``, ``hands_error`` [m], their ``_p95`` and ``head_angle`` [rad]; ``roughness``
        of the commands [1/s²]; ``slip`` of feet in contact [m/s]; ``standing``, the share of time
        in standing mode; ``plan_ms`` and ``plan_p99_ms``; ``touch_s``, the longest time for which
        both palms were within 5 cm of their points [s].
    """
    morphology = make_morphology(trial.setup.robot)
    trace, dt = trial.trace, trial.dt
    lower, dofs = find_lower_body(morphology)
    standing = trace.engaged & (trace.mode == Mode.STATIONARY)
    power = compute_balance_power(trace.effort[:, lower], trace.qvel[:, dofs], standing)
    space = morphology.command_space
    half = (space.high - space.low) / 2
    head = compute_tracking_error(trace.frames["head"], trace.goals["head"])
    hands = [compute_tracking_error(trace.frames[n], trace.goals[n]) for n in FRAMES[1:]]
    solves = trace.solve_s * 1000
    return {
        "abp": power.absolute,
        "abp_signed": power.signed,
        **_compute_palm_metrics(trial),
        "head_error": head.mean,
        "head_error_p95": head.p95,
        "head_angle": head.angle_mean,
        "hands_error": float(np.mean([each.mean for each in hands])),
        "hands_error_p95": float(np.mean([each.p95 for each in hands])),
        "roughness": compute_roughness(trace.command[trace.engaged], half, dt),
        "slip": compute_slip(compute_feet(morphology, trace.qpos), dt)
        if morphology.contact_kind.holds_place(Mode.MOBILE)
        else math.nan,  # wheels roll
        "standing": float(standing.sum() / max(trace.engaged.sum(), 1)),
        "plan_ms": float(np.median(solves)) if solves.size else math.nan,
        "plan_p99_ms": float(np.percentile(solves, 99)) if solves.size else math.nan,
        "touch_s": _compute_touch(trace, dt),
    }


def find_lower_body(morphology: Morphology) -> tuple[np.ndarray, np.ndarray]:
    """Find the actuated joints that support the robot: legs (or wheels) and waist (or torso).

    These are the joints between the base and a contact point or a hand, other than arm joints: for
    G1 twelve of the legs and three of the waist.

    Returns:
        Actuators, and their degrees of freedom. Shapes (m,).
    """
    model = morphology.build_spec("planning").compile()
    sites = (*morphology.contact_points, *(morphology.frames[arm.frame] for arm in morphology.arms))
    carrying: set[int] = set()
    for site in sites:
        body = int(model.site(site).bodyid[0])
        while body:
            carrying.add(body)
            body = int(model.body_parentid[body])
    actuators, dofs = [], []
    for index in range(model.nu):
        if model.actuator_trntype[index] != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        joint = int(model.actuator_trnid[index, 0])
        is_arm = model.joint(joint).name in morphology.arm_names
        if int(model.jnt_bodyid[joint]) in carrying and not is_arm:
            actuators.append(index)
            dofs.append(int(model.jnt_dofadr[joint]))
    return np.array(actuators, int), np.array(dofs, int)


def find_transport(
    trace: Trace, figures: Mapping[str, float] | None = None
) -> tuple[str, np.ndarray] | None:
    """Find the palm that carries an object to an opening, and the ticks before the release.

    Transport starts when the object lies free on the palm. The release starts when it is within 10
    cm of the opening, seen from above, or has left the palm; for every method, and whether or not
    it falls in.

    Args:
        trace: Trajectory of the trial.
        figures: Results of the task: `free_time_s`, when the object was no longer held, and
            `let_go_time_s`, when it left the palm [s]; both optional.

    Returns:
        Frame of the palm, and the ticks of shape (n,); None if nothing is carried to an opening.
    """
    if "toy" not in trace.objects or "opening" not in trace.objects:
        return None
    toy, opening = trace.objects["toy"][:, :3], trace.objects["opening"][:, :3]
    gaps = {
        name: np.linalg.norm(trace.frames[name][:, :3] - toy, axis=1)
        for name in ("left_palm", "right_palm")
    }
    palm = min(gaps, key=lambda name: float(gaps[name][0]))
    over = np.linalg.norm((toy - opening)[:, :2], axis=1) < RELEASE_RADIUS
    lost = gaps[palm] > gaps[palm][0] + LOST_DISTANCE
    figures = figures or {}
    lost |= trace.time >= figures.get("let_go_time_s", math.inf)
    ended = np.logical_or.accumulate(over | lost)
    begun = trace.time >= figures.get("free_time_s", -math.inf)
    return palm, trace.engaged & begun & ~ended


def _compute_palm_metrics(trial: Trial) -> dict[str, float]:
    trace, dt = trial.trace, trial.dt
    transport = find_transport(trace, trial.status.figures)
    if transport is None:
        jerks = [
            compute_jerk(trace.frames[name][:, :3], dt, trace.engaged)
            for name in ("left_palm", "right_palm")
        ]
        return {"tilt": math.nan, "jerk": float(np.mean(jerks))}
    palm, ticks = transport
    wrist = palm.replace("palm", "wrist")  # `compute_tilt` is about the wrist's Z axis
    return {
        "tilt": compute_tilt(trace.frames[wrist][:, 3:], ticks),
        "jerk": compute_jerk(trace.frames[palm][:, :3], dt, ticks),
    }


def compute_feet(morphology: Morphology, qpos: np.ndarray) -> np.ndarray:
    """Compute the middle of each foot or wheel. Shape (n, nq) -> (n, f, 3)."""
    model, groups = build_model(morphology, "planning"), morphology.contact_groups
    points = tuple(point for group in groups for point in group)
    poses = SiteKinematics(model, points).compute_poses(qpos)
    feet = [np.mean([poses[point][:, :3] for point in group], axis=0) for group in groups]
    return np.stack(feet, axis=1) if feet else np.zeros((len(qpos), 0, 3))


def _compute_touch(trace: Trace, dt: float) -> float:
    within = np.ones(len(trace.time), bool)
    for side in ("left", "right"):
        point = trace.objects.get(f"{side}_point")
        if point is None:
            return math.nan
        palm = trace.frames[f"{side}_palm"]
        within &= np.linalg.norm(palm[:, :3] - point[:, :3], axis=1) <= TOUCH
    return compute_longest_hold(within, dt)


def make_plot_trace(trial: Trial) -> dict[str, Any]:
    """Extract the data for plots: path of the head, and errors of head and hands."""
    trace = trial.trace
    step = max(1, round(TRACE_DT * trial.setup.fps))
    rows = slice(None, None, step)

    def distance(name: str) -> list[float | None]:
        gap = np.linalg.norm(trace.frames[name][rows, :3] - trace.goals[name][rows, :3], axis=1)
        return [round(float(each), 4) if np.isfinite(each) else None for each in gap]

    return {
        "dt": step * trial.dt,
        "head_xy": trace.frames["head"][rows, :2].round(3).tolist(),
        "head_error": distance("head"),
        "left_error": distance("left_wrist"),
        "right_error": distance("right_wrist"),
    }


def make_record(trial: Trial) -> dict[str, Any]:
    """Collect settings, outcome and metrics of a trial, as plain values for JSON."""
    status = trial.status
    figures = {**compute_metrics(trial), **{f"task_{k}": v for k, v in status.figures.items()}}
    return {
        **{name: getattr(trial.setup, name) for name in _SETTINGS},
        "seed": trial.seed,
        "success": bool(status.success),
        "picked_up": bool(status.picked_up),
        "collision": bool(status.collisions),
        "collisions": [" - ".join(pair) for pair in status.collisions],
        "fallen": bool(trial.fallen),
        "failure": status.failure,
        "completion_s": _to_json(trial.completion_s),
        "sim_s": round(trial.sim_s, 3),
        "wall_s": round(trial.wall_s, 2),
        "metrics": {name: _to_json(value) for name, value in figures.items()},
        "plot": make_plot_trace(trial),
    }


_SETTINGS = (
    "robot",
    "task",
    "method",
    "variant",
    "low_level",
    "noise",
    "scene",
    "heights",
    "fps",
    "time_limit",
)


def _to_json(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
