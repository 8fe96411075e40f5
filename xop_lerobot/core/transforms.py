"""Poses and quaternions as arrays: pose = x y z qw qx qy qz [m, unit quaternion wxyz].

All functions broadcast over leading dimensions, so a batch of rollouts costs one call.
"""

from __future__ import annotations

import numpy as np

IDENTITY_POSE = np.array([0.0, 0, 0, 1, 0, 0, 0])
IDENTITY_POSE.setflags(write=False)
_TINY = 1e-12


def quat_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product a∘b. Shapes (..., 4), wxyz."""
    aw, ax, ay, az = _split(a)
    bw, bx, by, bz = _split(b)
    return _join(
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quat_conjugate(q: np.ndarray) -> np.ndarray:
    """Inverse of a unit quaternion. Shape (..., 4), wxyz."""
    return np.asarray(q, float) * np.array([1.0, -1, -1, -1])


def quat_rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Rotate v (..., 3) by q (..., 4): v + 2w(u×v) + 2u×(u×v)."""
    q, v = np.asarray(q, float), np.asarray(v, float)
    u = q[..., 1:]
    t = 2 * _cross(u, v)
    return v + q[..., :1] * t + _cross(u, t)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product over the last axis; np.cross takes four times as long for small arrays."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return _join(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def _split(q: np.ndarray) -> tuple[np.ndarray, ...]:
    """Components w, x, y, z. Shape (..., 4)."""
    q = np.asarray(q, float)
    return q[..., 0], q[..., 1], q[..., 2], q[..., 3]


def _join(*components: np.ndarray) -> np.ndarray:
    """Stack components along the last axis; np.stack takes three times as long for small arrays."""
    joined = np.empty((*np.shape(components[0]), len(components)))
    for i, component in enumerate(components):
        joined[..., i] = component
    return joined


def sum_squares(vectors: np.ndarray) -> np.ndarray:
    """Squared length of vectors, four times as fast as a sum over a short axis.

    Shape (..., n) -> (...).
    """
    return np.einsum("...i,...i->...", vectors, vectors)


def quat_exp(rotvec: np.ndarray) -> np.ndarray:
    """Quaternion of a rotation vector [rad]. Shape (..., 3) -> (..., 4), wxyz."""
    rotvec = np.asarray(rotvec, float)
    angle = np.linalg.norm(rotvec, axis=-1, keepdims=True)
    # np.sinc(x) = sin(pi x)/(pi x) is smooth through zero.
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * rotvec], axis=-1)


def quat_log(q: np.ndarray) -> np.ndarray:
    """Rotation vector of a unit quaternion, angle in [0, pi] [rad]. Shape (..., 4) -> (..., 3)."""
    q = np.asarray(q, float)
    # Of q and -q, which are the same rotation, the one with w >= 0 has its angle in [0, pi].
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    # 2 is the limit of angle / sine at zero, where the quotient is ill-conditioned.
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0)
    return scale * q[..., 1:]


def quat_from_yaw(yaw: np.ndarray | float) -> np.ndarray:
    """Rotation about world Z by `yaw` [rad]. Shape (...,) -> (..., 4)."""
    half = np.asarray(yaw, float) / 2
    zero = np.zeros_like(half)
    return _join(np.cos(half), zero, zero, np.sin(half))


def quat_yaw(q: np.ndarray) -> np.ndarray:
    """Heading of the X axis about world Z (Tait-Bryan ZYX) [rad]. Shape (..., 4) -> (...)."""
    w, x, y, z = _split(q)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def compute_heading(q: np.ndarray) -> np.ndarray:
    r"""Heading of a head about world Z, smooth over the whole range of human head motion [rad].

    No single axis of a head defines it: the forward axis is vertical when looking straight down
    and points backwards beyond, and the left axis is vertical with the head tilted sideways. This
    heading is the horizontal direction of the sum :math:`f + 2\,R_z(-90°)\,l` of both, which is

    .. math:: \arg\left(3\,(w + iz)^2 + (y - ix)^2\right)

    It is invariant to pitch, and to roll of a head that looks ahead; for a head that looks
    straight down it is the direction of the crown. A rotation about the vertical adds to it.

    Any such function has a singularity; here it is a head that looks ahead, rolled by 120° to
    either side. From straight up to 150° down, with a roll of up to 45°, a rotation changes the
    heading by at most 1.8 times its angle.

    For an upright body, and for Tait-Bryan angles, see `quat_yaw`.

    Args:
        q: Orientation with X forward, Y left, Z up, wxyz. Shape (..., 4).

    Returns:
        Heading in (−π, π]. Shape (...).
    """
    w, x, y, z = _split(q)
    return np.arctan2(2 * (3 * w * z - x * y), 3 * (w + z) * (w - z) + (y + x) * (y - x))


def quat_to_rpy(q: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw [rad] with R = Rz(yaw) Ry(pitch) Rx(roll). Shape (..., 4) -> (..., 3)."""
    w, x, y, z = _split(q)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.stack([roll, pitch, quat_yaw(q)], axis=-1)


def quat_from_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Quaternion of R = Rz(yaw) Ry(pitch) Rx(roll) [rad]. Shape (4,)."""
    yaw_pitch = quat_multiply(quat_from_yaw(yaw), quat_exp(np.array([0, pitch, 0])))
    return quat_multiply(yaw_pitch, quat_exp(np.array([roll, 0, 0])))


def quat_from_matrix(matrix: np.ndarray) -> np.ndarray:
    """Unit quaternion of rotation matrices. Shape (..., 3, 3) -> (..., 4), wxyz, w >= 0.

    The largest of the four squared components is computed from the diagonal, and the others from
    it, which is well conditioned everywhere (Shepperd's method).
    """
    m = np.asarray(matrix, float)
    trace = np.trace(m, axis1=-2, axis2=-1)
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = np.stack([trace, m00, m11, m22], axis=-1)
    a, b, c = (m[..., i, j] for i, j in ((2, 1), (0, 2), (1, 0)))
    ta, tb, tc = (m[..., i, j] for i, j in ((1, 2), (2, 0), (0, 1)))
    candidates = np.stack(
        [
            np.stack([1 + trace, a - ta, b - tb, c - tc], -1),
            np.stack([a - ta, 1 + m00 - m11 - m22, c + tc, b + tb], -1),
            np.stack([b - tb, c + tc, 1 - m00 + m11 - m22, a + ta], -1),
            np.stack([c - tc, b + tb, a + ta, 1 - m00 - m11 + m22], -1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)[..., None, None]
    q = np.take_along_axis(candidates, np.broadcast_to(best, (*best.shape[:-1], 4)), -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def make_pose(position: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Pose of position (..., 3) and quaternion (..., 4). Shape (..., 7)."""
    return np.concatenate([np.asarray(position, float), np.asarray(quat, float)], axis=-1)


def pose_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Composition T_a T_b. Shapes (..., 7)."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    position = a[..., :3] + quat_rotate(a[..., 3:], b[..., :3])
    return make_pose(position, quat_multiply(a[..., 3:], b[..., 3:]))


def pose_inverse(pose: np.ndarray) -> np.ndarray:
    """Inverse T^-1. Shape (..., 7)."""
    pose = np.asarray(pose, float)
    quat = quat_conjugate(pose[..., 3:])
    return make_pose(-quat_rotate(quat, pose[..., :3]), quat)


def level_pose(pose: np.ndarray) -> np.ndarray:
    """Position and heading of a pose, without its tilt. Shape (..., 7)."""
    return make_pose(pose[..., :3], quat_from_yaw(compute_heading(pose[..., 3:])))


def rotation_error(goal: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Rotation vector log(q_goal q^-1) in world axes [rad]. Shapes (..., 4) -> (..., 3)."""
    return quat_log(quat_multiply(goal, quat_conjugate(quat)))


def heading_error(goal: np.ndarray, quat: np.ndarray) -> np.ndarray:
    r"""Tilt and heading components of an orientation error [rad].

    The rotation from `quat` to `goal` is a tilt s about a horizontal axis, then a turn ψ about the
    vertical: :math:`q_{goal} q^{-1} = R_z(\psi)\,s`. The error is :math:`(\log(s)_{x,y},\ \psi)` in
    world axes. For small errors it equals `rotation_error`. For large ones, the same lean in
    another heading has no tilt error, so a robot that faces away from its goal is not made to lean
    sideways because the operator leans forward. No heading of either orientation is needed, so a
    head or hand that points straight down is no special case. ψ is undefined for a tilt of half a
    turn.

    Shapes (..., 4) and (..., 4) -> (..., 3).
    """
    w, x, y, z = _split(quat_multiply(goal, quat_conjugate(quat)))
    upright, level = np.hypot(w, z), np.hypot(x, y)
    angle = 2 * np.arctan2(level, upright)
    scale = np.where(level > _TINY, angle / np.maximum(level, _TINY), 2.0)
    scale = scale / np.maximum(upright, _TINY)
    return _join(scale * (w * x + z * y), scale * (w * y - z * x), _double_angle(z, w))


def compute_heading_squares(goal: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Squared heading error and squared tilt error of `heading_error` [rad²].

    Much faster than `heading_error`, since the vector itself is not computed.

    Shapes (..., 4) and (..., 4) -> (...), (...).
    """
    gw, gx, gy, gz = _split(goal)
    w, x, y, z = _split(quat)
    dw = gw * w + gx * x + gy * y + gz * z
    dx = gx * w - gw * x + gz * y - gy * z
    dy = gy * w - gw * y + gx * z - gz * x
    dz = gz * w - gw * z + gy * x - gx * y
    turn = _double_angle(dz, dw)
    tilt = 2 * np.arctan2(np.sqrt(dx * dx + dy * dy), np.sqrt(dw * dw + dz * dz))
    return turn * turn, tilt * tilt


def _double_angle(sine: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Rotation angle of a quaternion with these entries, of either sign, in [-pi, pi]."""
    return 2 * np.arctan2(np.where(cosine < 0, -sine, sine), np.abs(cosine))


def skew(v: np.ndarray) -> np.ndarray:
    """Skew-symmetric matrix of the cross product with `v`. Shape (3,) -> (3, 3)."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def wrap_angle(angle: np.ndarray | float) -> np.ndarray:
    """Wrap to (-pi, pi] [rad]."""
    return -((-np.asarray(angle, float) + np.pi) % (2 * np.pi) - np.pi)


def compute_projected_gravity(quat: np.ndarray) -> np.ndarray:
    r"""Compute the unit gravity vector in the body frame, :math:`R(q)^T (0, 0, -1)^T`.

    Args:
        quat: Orientation of the base, wxyz. Shape (n, 4).

    Returns:
        Shape (n, 3).
    """
    w, x, y, z = quat.T
    gravity = np.empty((len(quat), 3))
    gravity[:, 0] = 2 * (w * y - x * z)
    gravity[:, 1] = -2 * (w * x + y * z)
    gravity[:, 2] = 2 * (x * x + y * y) - 1
    return gravity


def interpolate_poses(start: np.ndarray, end: np.ndarray, u: float) -> np.ndarray:
    r"""Interpolate poses: linear, and :math:`q_0 \exp(u \log(q_0^{-1} q_1))`.

    The rotation takes the shorter arc, whatever the signs of the quaternions.

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
    """Progress of a minimum-jerk motion at the fraction u of its duration: 10u³ − 15u⁴ + 6u⁵.

    Velocity and acceleration are zero at both ends; the peak speed is 1.875 times the mean.

    References:
        [1] Flash and Hogan, The coordination of arm movements, J. Neurosci. 5(7), 1985.
    """
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10 + u * (6 * u - 15))
