"""Lateral cost: wheels cannot go sideways, so the base shall face where it has to go."""

from __future__ import annotations

import math

import numpy as np

from xop_lerobot.core.transforms import quat_yaw, wrap_angle
from xop_lerobot.retarget.costs.cost import Cost, Evaluation

_LOOKING = 0.1  # speed at which the way to go and where the goal looks count alike [m/s]
_REST, _FULL = 0.08, 0.2  # speeds of the head from which on the base is to face so [m/s]
_TWIST = 0.3  # how much a twist of the waist counts beside a turn of the base
_BACKWARDS = 0.2  # turn that is preferred to driving backwards [rad]
_MAX_TWIST = 1.9  # twist of the waist beyond which the base does not face so [rad]
_TOO_TWISTED = 10.0  # how much a twist beyond it counts


def compute_facing(
    heading: float, velocity: np.ndarray, look: float, speed: float, room: float = math.inf
) -> np.ndarray:
    r"""Compute where a base on wheels shall face, and how much that counts.

    .. math:: \psi^\pm = \angle(\pm u + u_0\,(\cos\psi_g, \sin\psi_g))

    for driving forwards (+) and backwards (-), with u the velocity that takes the axle to where
    it will be when the robot stands straight at its goal, and :math:`\psi_g` where the goal
    looks; of the two that with less of a turn and less of a twist is taken, and none that twists
    the waist further than it can: who walks ahead is never followed backwards. Far from its goal
    the base lines up with the way there, near it with the goal, so that driving on closes in on
    the line through the goal, as in parking (path following of a unicycle; Siciliano et al.,
    Robotics, 2009, section 11.6). The last centimetres are left to the waist.

    Args:
        heading: Heading of the base [rad].
        velocity: The axle's velocity u [m/s]. Shape (2,).
        look: Heading of the goal [rad].
        speed: Speed at which what is tracked would be at its goal in time [m/s].
        room: How far the arms let the waist twist [rad].

    Returns:
        Direction in the world, as long as it counts: 0 to 1. Shape (2,).
    """
    ahead = _LOOKING * np.array([math.cos(look), math.sin(look)])
    best, least, most = look, math.inf, min(_MAX_TWIST, room)
    for sign, effort in ((1.0, 0.0), (-1.0, _BACKWARDS)):
        x, y = sign * velocity + ahead
        facing = math.atan2(y, x)
        effort += abs(float(wrap_angle(facing - heading)))  # noqa: PLW2901
        twist = abs(float(wrap_angle(facing - look)))
        effort += _TWIST * twist + _TOO_TWISTED * max(twist - most, 0.0)  # noqa: PLW2901
        if effort < least:
            best, least = facing, effort
    share = min(max((speed - _REST) / (_FULL - _REST), 0.0), 1.0)
    return share * np.array([math.cos(best), math.sin(best)])


def compute_lateral(base: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Angle of bases to where they shall face, times how much it counts [rad].

    Shapes (..., 7), (2,) -> (...).
    """
    angle = math.atan2(facing[1], facing[0])
    return math.hypot(*facing) * wrap_angle(angle - quat_yaw(base[..., 3:]))


class LateralCost(Cost):
    r""":math:`w_n\,s^2(\psi^* - \psi)^2`, the heading of a base that cannot go sideways.

    :math:`\psi^*` is where it shall face and s how much that counts (`compute_facing`), ψ its
    heading at the end of the extrapolation. A head that sits behind the axle can be moved
    sideways by turning the base, which is right for a few centimetres at rest. Done while
    driving it turns the base away from where it drives, ever further (the zero dynamics of an
    offset point are unstable ahead; Siciliano et al., Robotics, 2009, section 11.5), until the
    waist is at its limit. Only mobile robots on wheels have the term.

    Args:
        nonholonomic: Whether the robot drives but cannot go sideways.
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
