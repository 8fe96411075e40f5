"""Estimated transform between the robot's world and the person's room."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.transforms import (
    compute_heading,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    wrap_angle,
)


class Belief:
    r"""The person acts as though the robot's body were the own one.

    Believed is a turn :math:`\psi` and an offset o of the floors, and that heights and reaches go
    by the ratio s of the eyes' heights, as they looked when the person put the headset on:

    .. math:: p^{robot}_{xy} = o + R(\psi)\,p^{own}_{xy},\qquad z^{robot} = z_0 + s\,z^{own}

    Where the robot is not where the own body says, the belief is changed; so the next movement
    starts from where the robot is.

    Args:
        own: Own head. Shape (7,).
        robot: The robot's head, as seen. Shape (7,).
    """

    def __init__(self, own: np.ndarray, robot: np.ndarray) -> None:
        self.scale = float(robot[2] / own[2])
        self._lift = 0.0
        self.turn = float(wrap_angle(compute_heading(robot[3:]) - compute_heading(own[3:])))
        self._offset = robot[:2] - self._rotate(own[:2])

    def learn(self, own: np.ndarray, robot: np.ndarray, gain: float) -> None:
        """Take in where the robot's head is seen, and where the own one is. Shapes (7,).

        Args:
            own: Own head.
            robot: The robot's head.
            gain: Share of the difference that is believed.
        """
        turn = compute_heading(robot[3:]) - compute_heading(own[3:])
        self.turn = float(wrap_angle(self.turn + gain * wrap_angle(turn - self.turn)))
        self._offset += gain * (robot[:2] - self._rotate(own[:2]) - self._offset)
        self._lift += gain * (float(robot[2]) - self.scale * float(own[2]) - self._lift)

    def place_to_own(self, place: np.ndarray) -> np.ndarray:
        """Place and heading on the floor, x y yaw, of the robot's world in the own room."""
        xy = self._rotate(place[:2] - self._offset, back=True)
        return np.array([*xy, float(wrap_angle(place[2] - self.turn))])

    def height_to_own(self, height: float) -> float:
        """Own head's height for one of the robot's [m]."""
        return (height - self._lift) / self.scale

    def vector_to_own(self, vector: np.ndarray) -> np.ndarray:
        """A reach in the robot's world as one of the own arm. Shape (3,)."""
        return quat_rotate(quat_from_yaw(-self.turn), vector) / self.scale

    def quat_to_own(self, quat: np.ndarray) -> np.ndarray:
        """An orientation in the robot's world, in the own room. Shape (4,)."""
        return quat_multiply(quat_from_yaw(-self.turn), quat)

    def point_to_robot(self, point: np.ndarray, own_head: np.ndarray) -> np.ndarray:
        """Where the robot's counterpart of a point of the own body is believed to be. (3,)."""
        head = np.array(
            [*(self._offset + self._rotate(own_head[:2])), self._lift + self.scale * own_head[2]]
        )
        reach = self.scale * (point - own_head[:3])
        return head + quat_rotate(quat_from_yaw(self.turn), reach)

    def point_to_own(self, point: np.ndarray, own_head: np.ndarray) -> np.ndarray:
        """Inverse of `point_to_robot`. Shape (3,)."""
        head = self.point_to_robot(own_head[:3], own_head)
        return own_head[:3] + self.vector_to_own(point - head)

    def _rotate(self, xy: np.ndarray, back: bool = False) -> np.ndarray:
        turn = -self.turn if back else self.turn
        cos, sin = np.cos(turn), np.sin(turn)
        return np.array([cos * xy[0] - sin * xy[1], sin * xy[0] + cos * xy[1]])
