"""Between two poses, and how a hand gets from one to the other."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.transforms import (
    compute_heading,
    make_pose,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
)

__all__ = ["compute_heading", "compute_minimum_jerk", "interpolate_poses"]


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
