"""Heading and tilt errors of a single orientation, with their Jacobian, in fast scalar code."""

from __future__ import annotations

import math

import numpy as np

_TINY = 1e-12


def linearise_heading(goal: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Compute `heading_error` of one orientation, and its Jacobian.

    With :math:`d = q_{goal} q^{-1} = R_z(\psi)\,s`, an angular velocity ω (world axes) changes the
    heading error by :math:`\dot\psi = -h^\top\omega`, with :math:`h = (-u_y, u_x, 1)` and
    :math:`u = s_{x,y}/s_w`, and the tilt error :math:`e = \log s` by
    :math:`-(J_r^{-1}(e) - J_l^{-1}(e)\,e_z h^\top)\,\omega`.

    Args:
        goal: Desired orientation wxyz. Shape (4,).
        quat: Orientation wxyz. Shape (4,).

    Returns:
        Tilt errors about X and Y and heading error [rad], shape (3,), and the negative of their
        derivative by ω, shape (3, 3).

    References:
        Solà et al., A micro Lie theory for state estimation in robotics, Eq. 144.
    """
    gw, gx, gy, gz = (float(x) for x in goal)
    qw, qx, qy, qz = (float(v) for v in quat)
    w, x, y, z = _multiply((gw, gx, gy, gz), (qw, -qx, -qy, -qz))
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    upright, level = max(math.hypot(w, z), _TINY), math.hypot(x, y)
    sx, sy = (w * x + z * y) / upright, (w * y - z * x) / upright
    scale = 2 * math.atan2(level, upright) / level if level > _TINY else 2.0
    ex, ey = scale * sx, scale * sy
    error = np.array([ex, ey, 2 * math.atan2(z, w)])
    spin = np.array([-sy / upright, sx / upright, 1.0])  # h: rate of the heading per ω
    by_rotation = _inverse_right_jacobian(ex, ey)
    jacobian = by_rotation - np.outer(by_rotation[2], spin)  # J_l^{-1} e_z is a row of J_r^{-1}
    jacobian[2] = spin
    return error, jacobian


def _multiply(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _inverse_right_jacobian(x: float, y: float) -> np.ndarray:
    r""":math:`J_r^{-1}(e) = I + [e]_\times/2 + c\,[e]_\times^2` of e = (x, y, 0). Shape (3, 3)."""
    square = x * x + y * y
    angle = math.sqrt(square)
    if angle < 1e-3:  # limit of the series; its next term is angle²/720
        factor = 1 / 12
    else:
        factor = 1 / square - (1 + math.cos(angle)) / (2 * angle * math.sin(angle))
    return np.array(
        [
            [1 - factor * y * y, factor * x * y, y / 2],
            [factor * x * y, 1 - factor * x * x, -x / 2],
            [-y / 2, x / 2, 1 - factor * square],
        ]
    )
