r"""Metrics of one trial, those of the paper and further ones: pure functions of arrays.

Arrays have one row per control step ("tick"), `n` in all. A metric whose average has no samples (no
tick in standing mode, no goal) is nan.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.errors import BadShape, BadValue
from xop_lerobot.core.transforms import quat_rotate, rotation_error

JERK_WINDOW_S = 0.24
"""Length of the filter window for jerk [s]."""
JERK_ORDER = 3
"""Polynomial order of the filter."""
NEVER = float("nan")
"""Value of a metric without samples."""

_UP = np.array([0.0, 0.0, 1.0])


class BalancePower(NamedTuple):
    """Average power of the lower body while standing.

    Attributes:
        absolute: Mean magnitude of joint power, the paper's ABP [W].
        signed: Mean joint power, negative while braking [W].
    """

    absolute: float
    signed: float


class TrackingFigures(NamedTuple):
    """Errors of robot frames relative to their goals.

    Attributes:
        mean: Mean distance [m].
        p95: 95th percentile of the distance [m].
        angle_mean: Mean rotation angle to the goal [rad].
        angle_p95: 95th percentile of that angle [rad].
    """

    mean: float
    p95: float
    angle_mean: float
    angle_p95: float


def compute_balance_power(
    effort: np.ndarray, velocity: np.ndarray, standing: np.ndarray
) -> BalancePower:
    r"""Compute :math:`\text{ABP} = \frac1K\sum_{k=1}^K\frac1m\sum_{l=1}^m P_l(t_k)`.

    K are the ticks in standing mode, m the joints of the lower body. The paper's motor power
    :math:`P_l = \tau_l\dot q_l` is taken as a magnitude, :math:`|\tau_l\dot q_l|`: a braking motor
    also works, and over a whole squat the signed power would cancel.

    Args:
        effort: Torque of each lower-body joint [N m]. Shape (n, m).
        velocity: Velocity of each lower-body joint [rad/s]. Shape (n, m).
        standing: Whether the robot is in standing mode. Shape (n,), bool.

    Returns:
        Average power per joint [W], nan if the robot never stands.

    Raises:
        BadShape: If the shapes do not match.
    """
    if effort.ndim != 2 or velocity.shape != effort.shape:
        raise BadShape("velocity", effort.shape, velocity.shape)
    _check_rows("standing", standing, len(effort))
    power = (effort * velocity)[np.asarray(standing, bool)]
    if not power.size:
        return BalancePower(NEVER, NEVER)
    return BalancePower(float(np.abs(power).mean()), float(power.mean()))


def compute_jerk(
    position: np.ndarray,
    dt: float,
    chosen: np.ndarray | None = None,
    window_s: float = JERK_WINDOW_S,
) -> float:
    r"""Compute the mean jerk :math:`\frac1n\sum_k\lVert\dddot p(t_k)\rVert` [m/s³].

    The third derivative is that of a Savitzky-Golay filter: a cubic least-squares fit over
    `window_s` around each tick (7 points at 25 Hz). It passes motion up to about 4 Hz, the band of
    hand motion; a plain third difference would measure rounding and depend on the rate.

    Args:
        position: Position of a point [m]. Shape (n, 3).
        dt: Time between ticks [s].
        chosen: Ticks to use, None for all; the filter never crosses the end of a run of them. Shape
            (n,), bool.
        window_s: Length of the filter window [s].

    Returns:
        Mean jerk, nan if no run of chosen ticks is as long as the filter window.

    Raises:
        BadShape: If the shapes do not match.
        BadValue: If the filter has fewer points than its polynomial needs.
    """
    from scipy.signal import savgol_filter  # noqa: PLC0415 slow import, for this metric only

    if position.ndim != 2 or position.shape[1] != 3:
        raise BadShape("position", ("n", 3), position.shape)
    size = 2 * round(window_s / dt / 2) + 1
    if size <= JERK_ORDER:
        raise BadValue(
            f"a filter of {window_s} s has {size} points at {1 / dt:g} Hz, "
            f"it needs {JERK_ORDER + 1} or more"
        )
    chosen = np.ones(len(position), bool) if chosen is None else np.asarray(chosen, bool)
    _check_rows("chosen", chosen, len(position))
    jerks = [
        np.asarray(savgol_filter(position[first:last], size, JERK_ORDER, deriv=3, delta=dt, axis=0))
        for first, last in find_runs(chosen)
        if last - first >= size
    ]
    if not jerks:
        return NEVER
    return float(np.linalg.norm(np.concatenate(jerks), axis=1).mean())


def compute_tilt(quat: np.ndarray, chosen: np.ndarray | None = None) -> float:
    r"""Compute the mean tilt :math:`\frac1n\sum_k\arccos(s\,e_z^T R(t_k)\,e_z)` of a hand [rad].

    The Z axis of a wrist points out of the back of the hand. s is the side that is up in the first
    of the ticks: 1 for the back, -1 for the palm, so a hand that turns over reaches π.

    Args:
        quat: Orientation of the wrist, wxyz. Shape (n, 4).
        chosen: Ticks to use, None for all. Shape (n,), bool.

    Returns:
        Mean tilt, nan if no tick is chosen.
    """
    cosine = quat_rotate(quat, _UP)[:, 2]
    if chosen is not None:
        _check_rows("chosen", chosen, len(quat))
        cosine = cosine[np.asarray(chosen, bool)]
    if not cosine.size:
        return NEVER
    side = 1.0 if cosine[0] >= 0 else -1.0
    return float(np.arccos(np.clip(side * cosine, -1, 1)).mean())


def compute_pose_errors(pose: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Compute :math:`\lVert p - p^*\rVert` [m] and :math:`\lVert\log(R^* R^T)\rVert` [rad].

    Args:
        pose: Pose of a frame of the robot. Shape (n, 7).
        goal: Its goal. Shape (n, 7).

    Returns:
        Distance and angle in each tick. Shapes (n,).

    Raises:
        BadShape: If the shapes do not match.
    """
    if goal.shape != pose.shape or pose.shape[1:] != (7,):
        raise BadShape("goal", (len(pose), 7), goal.shape)
    distance = np.linalg.norm(pose[:, :3] - goal[:, :3], axis=1)
    angle = np.linalg.norm(rotation_error(goal[:, 3:], pose[:, 3:]), axis=1)
    return distance, angle


def summarise_errors(
    errors: Sequence[tuple[np.ndarray, np.ndarray]], chosen: np.ndarray
) -> TrackingFigures:
    """Summarise `compute_pose_errors` of one or several robot frames, pooled.

    Args:
        errors: Distance and angle of each, from `compute_pose_errors`.
        chosen: Ticks to use. Shape (n,), bool.
    """
    if not errors or not chosen.any():
        return TrackingFigures(NEVER, NEVER, NEVER, NEVER)
    distance = np.concatenate([each[chosen] for each, _ in errors])
    angle = np.concatenate([each[chosen] for _, each in errors])
    return TrackingFigures(
        float(distance.mean()),
        float(np.percentile(distance, 95)),
        float(angle.mean()),
        float(np.percentile(angle, 95)),
    )


def compute_tracking_error(pose: np.ndarray, goal: np.ndarray) -> TrackingFigures:
    """Summarise the errors of one robot frame over the ticks with a goal.

    Args:
        pose: True pose of the frame. Shape (n, 7).
        goal: Its goal; nan in ticks without one. Shape (n, 7).
    """
    known = np.asarray(np.isfinite(goal).all(axis=1))
    return summarise_errors([compute_pose_errors(pose, goal)], known)


def compute_roughness(command: np.ndarray, half_range: np.ndarray, dt: float) -> float:
    r"""Compute the roughness of commands :math:`\sqrt{\overline{(\ddot a_i / \hat a_i)^2}}` [1/s²].

    The second difference :math:`\ddot a_i = (a_{n} - 2a_{n-1} + a_{n-2})/dt^2` of each entry is
    divided by half its range :math:`\hat a_i`; the mean is over entries and ticks.

    Args:
        command: Executed commands. Shape (n, k).
        half_range: Half the range of each entry. Shape (k,).
        dt: Time between ticks [s].

    Returns:
        Roughness, nan with fewer than three ticks.
    """
    if half_range.shape != command.shape[1:]:
        raise BadShape("half_range", command.shape[1:], half_range.shape)
    if len(command) < 3:
        return NEVER
    bends = np.diff(command, n=2, axis=0) / (dt * dt) / half_range
    return float(np.sqrt(np.square(bends).mean()))


def compute_slip(feet: np.ndarray, dt: float, height: float = 0.01) -> float:
    r"""Compute the slip of feet in contact: mean of :math:`\lVert v_{xy}\rVert` [m/s].

    A foot counts as in contact between two ticks if in both its middle is within `height` of the
    lowest height that it ever reached.

    Args:
        feet: Middle of each foot [m]. Shape (n, f, 3).
        dt: Time between ticks [s].
        height: Height above the lowest one up to which a foot is in contact [m].

    Returns:
        Mean speed, nan if no foot is ever in contact for two ticks.
    """
    if feet.ndim != 3 or not feet.size:
        return NEVER
    low = feet[..., 2] < feet[..., 2].min(axis=0) + height
    bears = low[1:] & low[:-1]
    speed = np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=-1) / dt
    return float(speed[bears].mean()) if bears.any() else NEVER


def compute_falls(base_pose: np.ndarray, fall_height: float, fall_tilt: float) -> int:
    r"""Count the falls: base lower than `fall_height` or tilted by more than `fall_tilt`.

    The tilt is :math:`\arccos(e_z \cdot R e_z)`. A robot that stays down counts once.

    Args:
        base_pose: Pose of the base in the world. Shape (T, 7).
        fall_height: Height below which it counts as fallen [m].
        fall_tilt: Tilt above which it counts as fallen [rad].

    Returns:
        Number of falls.
    """
    base_pose = np.asarray(base_pose, float)
    up = quat_rotate(base_pose[:, 3:], _UP)
    tilt = np.arccos(np.clip(up[:, 2], -1.0, 1.0))
    down = (base_pose[:, 2] < fall_height) | (tilt > fall_tilt)
    return int(np.count_nonzero(np.diff(down.astype(int), prepend=0) > 0))


def compute_longest_hold(within: np.ndarray, dt: float) -> float:
    """Compute the longest time for which `within` held without interruption [s].

    A run of k ticks spans k - 1 periods. It detects a touch (both hands within 5 cm for 3 s) from
    trajectories alone, as a check of the simulation's own verdict.
    """
    runs = find_runs(np.asarray(within, bool))
    return max(((last - first - 1) * dt for first, last in runs), default=0.0)


def find_runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """Return the runs of true flags, as first tick and the tick after the last."""
    padded = np.concatenate([[False], np.asarray(flags, bool), [False]])
    edges = np.flatnonzero(padded[1:] != padded[:-1])
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _check_rows(name: str, array: np.ndarray, n: int) -> None:
    if np.shape(array) != (n,):
        raise BadShape(name, (n,), np.shape(array))
