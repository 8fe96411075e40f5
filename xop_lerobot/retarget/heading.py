"""Heading and tilt errors of one orientation, with their derivative; the fast scalar path."""

from __future__ import annotations

import math

import numpy as np


def linearise_heading(goal: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Compute the error of `heading_error` and how the orientation changes it.

    With :math:`R = R_z(\psi)T`, an angular velocity ω (world axes) turns the heading by
    :math:`\dot\psi = \omega_z - b_z(b_x\omega_x + b_y\omega_y)/(b_x^2 + b_y^2)`, b its X axis,
    and the tilt T by :math:`\delta = R_z(-\psi)\omega - e_z\dot\psi`. The tilt's error
    :math:`e = \log(T_{goal}T^{-1})` then changes by :math:`-J_r^{-1}(e)\,\delta`.

    Args:
        goal: Wanted orientation wxyz. Shape (4,).
        quat: Orientation wxyz. Shape (4,).

    Returns:
        Errors of roll, pitch and heading [rad], shape (3,), and the derivative of their
        negative by ω, shape (3, 3).

    References:
        Solà et al., A micro Lie theory for state estimation in robotics, Eq. 144.
    """
    gw, gx, gy, gz = (float(x) for x in goal)
    w, x, y, z = (float(v) for v in quat)
    yaw_goal = math.atan2(2 * (gw * gz + gx * gy), 1 - 2 * (gy * gy + gz * gz))
    bx, by, bz = 1 - 2 * (y * y + z * z), 2 * (w * z + x * y), 2 * (x * z - w * y)
    yaw = math.atan2(by, bx)
    tg, t = _remove_yaw(yaw_goal, gw, gx, gy, gz), _remove_yaw(yaw, w, x, y, z)
    ex, ey, ez = _log(_multiply(tg, (t[0], -t[1], -t[2], -t[3])))
    turn = yaw_goal - yaw
    error = np.array([ex, ey, math.atan2(math.sin(turn), math.cos(turn))])

    planar = max(bx * bx + by * by, 1e-9)
    spin = np.array([-bz * bx / planar, -bz * by / planar, 1.0])  # by which ω turns the heading
    cosine, sine = math.cos(yaw), math.sin(yaw)
    tilt = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    tilt[2] -= spin
    jacobian = _inverse_right_jacobian(ex, ey, ez) @ tilt
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


def _remove_yaw(
    yaw: float, w: float, x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    return _multiply((math.cos(yaw / 2), 0.0, 0.0, -math.sin(yaw / 2)), (w, x, y, z))


def _log(quat: tuple[float, float, float, float]) -> tuple[float, float, float]:
    w, x, y, z = quat if quat[0] >= 0 else tuple(-c for c in quat)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2 * math.atan2(sine, w) / sine if sine > 1e-9 else 2.0
    return scale * x, scale * y, scale * z


def _inverse_right_jacobian(x: float, y: float, z: float) -> np.ndarray:
    r""":math:`J_r^{-1}(e) = I + [e]_\times/2 + c\,[e]_\times^2`. Shape (3, 3)."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < 1e-3:  # the next term of the series is of the order of angle²/720
        factor = 1 / 12
    else:
        factor = 1 / square - (1 + math.cos(angle)) / (2 * angle * math.sin(angle))
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + skew / 2 + factor * (skew @ skew)
