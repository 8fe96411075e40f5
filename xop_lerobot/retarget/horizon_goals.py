"""Goal poses over the horizon: limited in distance, levelled, extrapolated at their velocity."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping

import numpy as np

from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import make_pose, quat_from_yaw, quat_multiply
from xop_lerobot.retarget.costs.tracking import make_level

STILL = 0.1
"""Horizontal speed up to which a goal counts as stationary [m/s]."""
TILT_PREVIEW_S = 0.1
"""Longest time for which a goal is assumed to go on tilting [s]. Heads nod up again within tenths
of a second, so that a tilt that is carried on for longer overshoots; turns last longer."""


def is_moving(goal: Goal, name: str) -> bool:
    """Whether the goal of a tracked frame moves horizontally."""
    velocity = goal.velocities.get(name)
    return velocity is not None and math.hypot(velocity[0], velocity[1]) > STILL


def hold_near(goal: Goal, poses: Mapping[str, np.ndarray], reach: float) -> Goal:
    """Limit the horizontal distance of goals from their frames to `reach`.

    A larger error would only make the robot lean towards a goal that it has to walk to.

    Args:
        goal: The goal.
        poses: Present pose of each frame to follow. Shapes (7,).
        reach: Largest horizontal distance [m].
    """
    near = dict(goal.poses)
    for name, pose in poses.items():
        if name in near:
            offset = near[name][:3] - pose[:3]
            share = min(1.0, reach / max(float(np.hypot(offset[0], offset[1])), 1e-9))
            held = pose[:3] + np.array([share, share, 1.0]) * offset
            near[name] = make_pose(held, near[name][3:])
    return dataclasses.replace(goal, poses=near)


def hold_level(goal: Goal, frames: Iterable[str]) -> Goal:
    """Level the goals of `frames`; their angular velocity keeps only its vertical component.

    The tilt of the operator's hand would compete with the constraint that keeps the hand level.
    """
    poses, velocities = dict(goal.poses), dict(goal.velocities)
    for name in frames:
        if name in poses:
            poses[name] = make_level(poses[name])
        if name in velocities:
            velocities[name] = velocities[name] * [1, 1, 1, 0, 0, 1]
    return dataclasses.replace(goal, poses=poses, velocities=velocities)


def preview(
    goal: Goal, frames: tuple[str, ...], ahead: np.ndarray, preview_s: float
) -> dict[str, np.ndarray]:
    """Compute the goals of `frames` at the times `ahead`.

    Args:
        goal: The goal now, with its velocities.
        frames: Tracked frames; those without a goal are left out.
        ahead: Times from now [s]. Shape (n,).
        preview_s: Time after which a goal is assumed to be stationary [s]; it stops tilting after
            `TILT_PREVIEW_S` if that is less.

    Returns:
        Poses. Shapes (n, 7).
    """
    times = np.minimum(ahead, preview_s)[:, None]
    goals = {}
    for name in frames:
        if name not in goal.poses:
            continue
        pose, velocity = goal.poses[name], goal.velocities.get(name)
        if velocity is None or not np.any(velocity):
            goals[name] = np.broadcast_to(pose, (len(times), 7))
            continue
        goals[name] = carry_on(pose, velocity, times)
    return goals


def carry_on(pose: np.ndarray, velocity: np.ndarray, times: np.ndarray) -> np.ndarray:
    r"""Extrapolate a pose: :math:`p + v t,\ e^{\omega_z t/2} \circ e^{\omega_{xy} t'/2} \circ q`.

    t' is t up to `TILT_PREVIEW_S`; a rotation about the vertical goes on for t.

    For a constant axis n, :math:`e^{n\alpha/2} \circ q = \cos\frac\alpha2\,q +
    \sin\frac\alpha2\,(n \circ q)`: one quaternion product serves all times.

    Args:
        pose: Pose at t = 0. Shape (7,).
        velocity: Linear [m/s], then angular [rad/s], world axes. Shape (6,).
        times: Times [s]. Shape (n, 1).

    Returns:
        Poses. Shape (n, 7).
    """
    x, y, z = (float(rate) for rate in velocity[3:])
    rate = math.hypot(x, y)
    axis = np.array([0.0, x, y, 0.0]) / max(rate, 1e-12)
    half = np.minimum(times, TILT_PREVIEW_S) * (rate / 2)
    poses = np.empty((len(times), 7))
    poses[:, :3] = pose[:3] + times * velocity[:3]
    tilted = np.cos(half) * pose[3:] + np.sin(half) * quat_multiply(axis, pose[3:])
    poses[:, 3:] = quat_multiply(quat_from_yaw(times[:, 0] * z), tilted)
    return poses
