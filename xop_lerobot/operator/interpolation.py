"""Between two poses, and how a hand gets from one to the other."""

from __future__ import annotations

import numpy as np

from xop_lerobot.transforms import (
    make_pose,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_rotate,
)

VERTICAL = 0.3
"""Horizontal part of a forward axis under which it is too steep to tell a heading."""


def interpolate_poses(start: np.ndarray, end: np.ndarray, u: float) -> np.ndarray:
    r"""Pose a fraction u of the way: linear, and :math:`q_0 \exp(u \log(q_0^{-1} q_1))`.

    The turn takes the shorter arc, whichever signs the quaternions have.

    Args:
        start: Poses at u = 0. Shape (..., 7).
        end: Poses at u = 1. Shape (..., 7).
        u: Fraction in [0, 1].

    Returns:
        Poses. Shape (..., 7).
    """
    turn = quat_log(quat_multiply(quat_conjugate(start[..., 3:]), end[..., 3:]))
    quat = quat_multiply(start[..., 3:], quat_exp(u * turn))
    return make_pose((1 - u) * start[..., :3] + u * end[..., :3], quat)


def compute_minimum_jerk(u: float) -> float:
    """Fraction of a reach done at fraction u of its time: 10u³ − 15u⁴ + 6u⁵.

    Velocity and acceleration are zero at both ends; the peak speed is 1.875 times the mean.

    References:
        [1] Flash and Hogan, The coordination of arm movements, J. Neurosci. 5(7), 1985.
    """
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10 + u * (6 * u - 15))


def compute_heading(quat: np.ndarray) -> float:
    """Heading of a head about world Z [rad].

    It is that of the forward axis seen from above; when the person looks almost straight up or
    down, that of the left axis less a quarter turn, which stays level in a nod.

    Args:
        quat: Orientation with X forward, Y left. Shape (4,), wxyz.
    """
    forward = quat_rotate(quat, np.array([1.0, 0, 0]))
    if np.hypot(forward[0], forward[1]) >= VERTICAL:
        return float(np.arctan2(forward[1], forward[0]))
    left = quat_rotate(quat, np.array([0, 1.0, 0]))
    return float(np.arctan2(-left[0], left[1]))
