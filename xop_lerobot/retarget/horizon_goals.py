"""Goals over the horizon: held within reach, and carried on at their velocity."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping

import numpy as np

from xop_lerobot.core.state import Goal
from xop_lerobot.core.transforms import make_pose, quat_multiply
from xop_lerobot.retarget.costs.tracking import make_level


def hold_near(goal: Goal, poses: Mapping[str, np.ndarray], reach: float) -> Goal:
    """Move goals that are further than `reach` aside of their frame up to that distance.

    A goal metres away must not bend the robot towards it; walking there is another matter.

    Args:
        goal: The goal.
        poses: Where the frames are that are to be followed. Shapes (7,).
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
    """Turn the goals of `frames` so that they are level, and only turn about the vertical.

    A tilt that is not to be followed shall not compete with the constraint that forbids it.
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
        preview_s: Time after which a goal is assumed to stand still [s].

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
    r"""Carry a pose on at a velocity: :math:`p + v t,\ e^{\omega t/2} \circ q`.

    About an axis n that stays, :math:`e^{n\alpha/2} \circ q = \cos\frac\alpha2\,q +
    \sin\frac\alpha2\,(n \circ q)`: one product for all times.

    Args:
        pose: Pose at t = 0. Shape (7,).
        velocity: Linear [m/s], then angular [rad/s], world axes. Shape (6,).
        times: Times [s]. Shape (n, 1).

    Returns:
        Poses. Shape (n, 7).
    """
    x, y, z = (float(rate) for rate in velocity[3:])
    rate = math.sqrt(x * x + y * y + z * z)
    axis = np.array([0.0, x, y, z]) / max(rate, 1e-12)
    half = times * (rate / 2)
    poses = np.empty((len(times), 7))
    poses[:, :3] = pose[:3] + times * velocity[:3]
    poses[:, 3:] = np.cos(half) * pose[3:] + np.sin(half) * quat_multiply(axis, pose[3:])
    return poses
