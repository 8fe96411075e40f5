"""Cost terms of balance: support, stance, fall, and the heading of a nonholonomic base.

`StanceCost` is the paper's contact point term; the others are ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import quat_yaw, sum_squares, wrap_angle
from xop_lerobot.morphology.contacts import ContactKind
from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.retarget.static_load import StaticLoad


class SupportArea:
    """Convex support area of a robot, shrunk by a margin.

    Args:
        corners: Corners (x, y) in the base's frame, counterclockwise [m]. Shape (c, 2).
        resting: Rest position of the centre of mass in the base's frame [m]. Shape (2,).
        margin: Distance that the area is shrunk by at every edge [m].
        free: Distance from rest up to which a lean is free, for reaching and bending [m].
    """

    def __init__(
        self,
        corners: tuple[tuple[float, float], ...],
        resting: tuple[float, float] = (0.0, 0.0),
        margin: float = 0.1,
        free: float = 0.05,
    ) -> None:
        points = np.array(corners, dtype=float)
        edges = np.roll(points, -1, axis=0) - points
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)  # outwards
        self._normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        self._offsets = (self._normals * points).sum(1) - margin
        self._resting = np.array(resting)
        self._free = free

    def compute_excess(self, base: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Distance of points beyond each edge, 0 inside [m]. (..., 7), (..., 2) -> (..., c)."""
        return np.maximum(_to_base(base, points) @ self._normals.T - self._offsets, 0)

    def compute_lean(
        self, base: np.ndarray, com: np.ndarray, balance: np.ndarray | None = None
    ) -> np.ndarray:
        """Offset of the centre of mass from its rest position, beyond the free distance [m].

        The rest position is `balance`, shape (2,), or that of the standing robot.

        Shapes (..., 7), (..., 2) -> (..., 2).
        """
        offset = _to_base(base, com) - (self._resting if balance is None else balance)
        length = np.sqrt(sum_squares(offset))
        share = np.maximum(0, 1 - self._free / np.maximum(length, 1e-9))
        return offset * share[..., None]

    def linearise_excess(
        self, base: np.ndarray, point: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """`compute_excess` of one point, and its derivative by the point in the base's frame.

        Shapes (7,), (2,) -> (c,), (c, 2).
        """
        excess = self._normals @ _to_base(base, point) - self._offsets
        outside = excess > 0
        return np.where(outside, excess, 0.0), self._normals * outside[:, None]

    def linearise_lean(
        self, base: np.ndarray, com: np.ndarray, balance: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`compute_lean` of one point, and its derivative by the point in the base's frame.

        Shapes (7,), (2,) -> (2,), (2, 2).
        """
        offset = _to_base(base, com) - (self._resting if balance is None else balance)
        length = float(np.linalg.norm(offset))
        if length <= self._free:
            return np.zeros(2), np.zeros((2, 2))
        along = offset / length
        share = 1 - self._free / length
        # Radially the whole change counts (gain 1); tangentially it is scaled by `share`.
        return offset * share, share * np.eye(2) + (1 - share) * np.outer(along, along)


def _to_base(base: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points relative to the base's position and heading. (..., 7), (..., 2) -> (..., 2)."""
    yaw = quat_yaw(base[..., 3:])
    dx, dy = points[..., 0] - base[..., 0], points[..., 1] - base[..., 1]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx], axis=-1)


class SupportCost(Cost):
    r"""Squared distance of the centre of mass beyond the shrunk support area, lean and load.

    All at the end of the extrapolation, where the robot must be able to stand still: the centre of
    mass over the support area, with the weight `support`; its squared distance from its rest
    position beyond a free circle, with the weight `lean`, so that a mobile robot drives to its
    goal instead of bending; and the squared static torques beyond their allowed share of the motor
    limits, with the weight `load`, since a torso whose servos give way folds. Not in the paper.

    Args:
        area: The support area; None for a robot whose policy keeps the balance.
        load: Static loads of the joints; None if they are not limited.
    """

    name = "support"

    def __init__(self, area: SupportArea | None, load: StaticLoad | None = None) -> None:
        self.area, self.load = area, load

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        loaded = np.zeros(len(evaluation.qpos))
        if self.load is not None:
            beyond = self.load.compute_excess(evaluation.terminal_qpos)
            loaded = evaluation.weights.load * sum_squares(beyond)
        if self.area is None:
            return loaded
        base, com = evaluation.terminal_qpos[:, :7], evaluation.terminal_com[:, :2]
        excess = sum_squares(self.area.compute_excess(base, com))
        lean = sum_squares(self.area.compute_lean(base, com, evaluation.balance))
        return evaluation.weights.support * excess + evaluation.weights.lean * lean + loaded


class StanceCost(Cost):
    r"""Mean over steps of :math:`w_s \sum_{i \in C_k} \|\dot p^c_{i,k}\|^2`.

    Points are grouped by foot or wheel; a group counts by the mean of its points. C holds every
    group in stationary mode and, in mobile mode, the lowest group of each step: the stance foot.
    Contacts that must move in a mode, such as rolling wheels, cost nothing in it.

    Args:
        groups: Sites of each group of contact points.
        kind: Kind of the contacts, `Feet` or `Wheels`.
    """

    name = "stance"

    def __init__(self, groups: tuple[tuple[str, ...], ...], kind: ContactKind) -> None:
        self.groups, self.kind = groups, kind

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        if not self.kind.holds_place(evaluation.mode):
            return np.zeros(len(evaluation.qpos))
        speeds = []
        for group in self.groups:
            velocities = np.array([evaluation.velocities[site] for site in group])
            speeds.append(sum_squares(velocities[:, :, 1:]).mean(0))  # (K, H)
        speed = np.array(speeds)  # (groups, K, H)
        if evaluation.mode is Mode.STATIONARY:
            active = speed.sum(axis=0)
        else:
            active = np.take_along_axis(speed, self._find_lowest(evaluation)[None], axis=0)[0]
        return evaluation.weights.stance * active.mean(axis=1)

    def _find_lowest(self, evaluation: Evaluation) -> np.ndarray:
        """The lowest group of each step. Shape (K, H), int."""
        heights = []
        for group in self.groups:
            points = np.array([evaluation.points[site][:, 1:, 2] for site in group])
            heights.append(points.mean(0))
        return np.array(heights).argmin(axis=0)


class FallCost(Cost):
    r"""Mean over steps of :math:`w_{fall}(\max(0, \alpha - \alpha_s)^2 + \max(0, z_s - z)^2)`.

    α is the tilt of the base and z its height. The safe tilt is halfway between that at rest under
    the executed command and that of a fall. The safe height is a quarter of the way from that of a
    fall to standing, or halfway from that of a fall to the lowest that can be commanded, whichever
    is lower. So the cost is zero in ordinary motion, also for a squatting robot. Not in the paper,
    where predicted falls show up in the tracking cost alone.

    Args:
        tilt: Tilt at which the robot counts as fallen [rad].
        height: Base height below which it counts as fallen [m].
        standing_height: Base height when standing [m].
        lowest: Lowest base height that can be commanded [m].
        compute_rest_tilt: Tilt of the base at rest under a command in a mode [rad]; 0 by default.
    """

    name = "fall"

    def __init__(
        self,
        tilt: float,
        height: float,
        standing_height: float,
        lowest: float = math.inf,
        compute_rest_tilt: Callable[[np.ndarray, Mode], float] = lambda _command, _mode: 0.0,
    ) -> None:
        self.tilt, self.height = tilt, height
        self._compute_rest_tilt = compute_rest_tilt
        self.safe_height = min(height + (standing_height - height) / 4, (height + lowest) / 2)

    def find_falls(self, evaluation: Evaluation) -> np.ndarray:
        """Mask of the samples that fall at any predicted step. Shape (K,), bool."""
        base = evaluation.qpos[:, 1:, :7]
        fallen = (_compute_upright(base) < math.cos(self.tilt)) | (base[..., 2] < self.height)
        return np.any(fallen, axis=1)

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        base = evaluation.qpos[:, 1:, :7]
        tilt = np.arccos(np.clip(_compute_upright(base), -1, 1))
        rest_tilt = self._compute_rest_tilt(evaluation.executed, evaluation.mode)
        safe_tilt = (self.tilt + rest_tilt) / 2
        excess = np.square(np.maximum(0, tilt - safe_tilt))
        excess += np.square(np.maximum(0, self.safe_height - base[..., 2]))
        return evaluation.weights.fall * excess.mean(axis=1)


def _compute_upright(base: np.ndarray) -> np.ndarray:
    """Cosine of the angle between the base's Z and the vertical. Shape (..., 7) -> (...)."""
    return 1 - 2 * (base[..., 4] ** 2 + base[..., 5] ** 2)


_LOOKING = 0.1  # u_0: speed at which direction of travel and goal heading weigh the same [m/s]
_REST, _FULL = 0.08, 0.2  # speeds between which the weight of the heading grows from 0 to 1 [m/s]
TWIST_COST = 0.3
"""Cost of a waist twist relative to a turn of the base [1]."""
BACKWARDS_COST = 0.2
"""Turn up to which turning is preferred to driving backwards [rad]."""
_TOO_TWISTED = 10.0  # cost of a twist beyond it, relative to a turn [1]


def compute_facing(
    heading: float, velocity: np.ndarray, look: float, speed: float, max_twist: float
) -> np.ndarray:
    r"""Compute the desired heading of a wheeled base, and its weight.

    .. math:: \psi^\pm = \angle(\pm u + u_0\,(\cos\psi_g, \sin\psi_g))

    for driving forwards (+) or backwards (-), with u the velocity that takes the axle to its
    position when the robot stands straight at its goal, and :math:`\psi_g` the heading of the
    goal. Of the two, the one with the smaller turn and twist is taken; a twist beyond the range of
    the waist is all but excluded, so an operator who walks ahead is never followed backwards. Far
    from its goal the base lines up with its direction of travel, near it with the goal, so that
    driving on converges to the line through the goal, as in parking (path following of a unicycle;
    Siciliano et al., Robotics, 2009, section 11.6). The last centimetres are left to the waist.

    Args:
        heading: Heading of the base [rad].
        velocity: The axle's velocity u [m/s]. Shape (2,).
        look: Heading of the goal [rad].
        speed: Speed with which the tracked frame would reach its goal in time [m/s].
        max_twist: Largest desired twist of the waist [rad].

    Returns:
        Direction in the world, whose length is the weight, 0 to 1. Shape (2,).
    """
    ahead = _LOOKING * np.array([math.cos(look), math.sin(look)])
    best, least = look, math.inf
    for sign, effort in ((1.0, 0.0), (-1.0, BACKWARDS_COST)):
        x, y = sign * velocity + ahead
        facing = math.atan2(y, x)
        effort += abs(float(wrap_angle(facing - heading)))  # noqa: PLW2901
        twist = abs(float(wrap_angle(facing - look)))
        effort += TWIST_COST * twist + _TOO_TWISTED * max(twist - max_twist, 0.0)  # noqa: PLW2901
        if effort < least:
            best, least = facing, effort
    share = min(max((speed - _REST) / (_FULL - _REST), 0.0), 1.0)
    return share * np.array([math.cos(best), math.sin(best)])


def compute_lateral(base: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Heading error of bases from `facing`, times its weight [rad].

    Shapes (..., 7), (2,) -> (...).
    """
    angle = math.atan2(facing[1], facing[0])
    return math.hypot(*facing) * wrap_angle(angle - quat_yaw(base[..., 3:]))


class LateralCost(Cost):
    r""":math:`w_n\,s^2(\psi^* - \psi)^2`, the heading error of a nonholonomic base.

    :math:`\psi^*` is the desired heading and s its weight (`compute_facing`), ψ the heading at the
    end of the extrapolation. A head behind the axle can be moved sideways by turning the base,
    which is right for a few centimetres at rest. While driving, it turns the base further and
    further away from its direction of travel (the zero dynamics of an offset point are unstable
    ahead; Siciliano et al., Robotics, 2009, section 11.5), until the waist is at its limit. Not in
    the paper; zero for robots that can move sideways.

    Args:
        nonholonomic: Whether the robot drives but cannot move sideways.
    """

    name = "lateral"

    def __init__(self, nonholonomic: bool) -> None:
        self.nonholonomic = nonholonomic

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        if not self.nonholonomic:
            return np.zeros(len(evaluation.qpos))
        lateral = compute_lateral(evaluation.terminal_qpos[:, :7], evaluation.facing)
        return evaluation.weights.lateral * np.square(lateral)
