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
    r"""Estimate of where the person's body is in the robot's world, which it takes for its own.

    The estimate is a yaw :math:`\psi`, a floor offset o and a vertical offset :math:`z_0`. Heights
    and reaches scale by s, the ratio of eye heights when the person put the headset on:

    .. math:: p^{robot}_{xy} = o + R(\psi)\,p^{own}_{xy},\qquad z^{robot} = z_0 + s\,z^{own}

    `learn` corrects it towards what is seen, so that the next movement starts from where the robot
    really is.

    Args:
        own: The person's head, in the room. Shape (7,).
        robot: The robot's head as seen, in the robot's world. Shape (7,).
    """

    def __init__(self, own: np.ndarray, robot: np.ndarray) -> None:
        self.scale = float(robot[2] / own[2])
        self._lift = 0.0
        self.turn = float(wrap_angle(compute_heading(robot[3:]) - compute_heading(own[3:])))
        self._offset = robot[:2] - self._rotate(own[:2])

    def learn(self, own: np.ndarray, robot: np.ndarray, gain: float) -> None:
        """Correct yaw and offsets by a share of the seen difference.

        Args:
            own: The person's head, in the room. Shape (7,).
            robot: The robot's head as seen, in the robot's world. Shape (7,).
            gain: Share of the difference that is corrected [1].
        """
        turn = compute_heading(robot[3:]) - compute_heading(own[3:])
        self.turn = float(wrap_angle(self.turn + gain * wrap_angle(turn - self.turn)))
        self._offset += gain * (robot[:2] - self._rotate(own[:2]) - self._offset)
        self._lift += gain * (float(robot[2]) - self.scale * float(own[2]) - self._lift)

    def place_to_own(self, place: np.ndarray) -> np.ndarray:
        """Map x y yaw [m, m, rad] on the floor from the robot's world into the room. Shape (3,)."""
        xy = self._rotate(place[:2] - self._offset, back=True)
        return np.array([*xy, float(wrap_angle(place[2] - self.turn))])

    def height_to_own(self, height: float) -> float:
        """Map a head height from the robot's world into the room [m]."""
        return (height - self._lift) / self.scale

    def vector_to_own(self, vector: np.ndarray) -> np.ndarray:
        """Map a reach from the robot's world into the room. Shape (3,)."""
        return quat_rotate(quat_from_yaw(-self.turn), vector) / self.scale

    def quat_to_own(self, quat: np.ndarray) -> np.ndarray:
        """Map an orientation from the robot's world into the room, wxyz. Shape (4,)."""
        return quat_multiply(quat_from_yaw(-self.turn), quat)

    def point_to_robot(self, point: np.ndarray, own_head: np.ndarray) -> np.ndarray:
        """Map a point of the person's body to the robot's world. Shape (3,).

        Args:
            point: In the room [m]. Shape (3,).
            own_head: The person's head, in the room. Shape (7,).
        """
        head = np.array(
            [*(self._offset + self._rotate(own_head[:2])), self._lift + self.scale * own_head[2]]
        )
        reach = self.scale * (point - own_head[:3])
        return head + quat_rotate(quat_from_yaw(self.turn), reach)

    def point_to_own(self, point: np.ndarray, own_head: np.ndarray) -> np.ndarray:
        """Map a robot world point into the room; inverse of `point_to_robot`. Shape (3,)."""
        head = self.point_to_robot(own_head[:3], own_head)
        return own_head[:3] + self.vector_to_own(point - head)

    def _rotate(self, xy: np.ndarray, back: bool = False) -> np.ndarray:
        turn = -self.turn if back else self.turn
        cos, sin = np.cos(turn), np.sin(turn)
        return np.array([cos * xy[0] - sin * xy[1], sin * xy[0] + cos * xy[1]])
