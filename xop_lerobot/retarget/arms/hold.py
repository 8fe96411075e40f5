"""What both hands hold between them goes with the body."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from xop_lerobot.core.transforms import (
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_exp,
    quat_multiply,
    rotation_error,
)

HELD = (4.0, 2.0)
"""Force of either hand towards the other from which something is held, and below which it is not
any more [N]."""
CARRYING_S, HOLDING_S, FREE_S = 1.5, 0.6, 0.1
"""Time constants with which hands that carry something, that hold it, and free ones take up where
they shall be against the body [s]; free hands that have once done so are not smoothed at all."""
CAUGHT_UP = 0.003
"""Free hands so near to their goals are no longer smoothed [m]."""


class ArmHold:
    """Smooths the goals of hands that press on each other, as seen from the robot's head.

    A robot that walks sways by centimetres. Hands that stay where they are in the world all the
    while have to swing against the body, neither of them quite in time, and shear what is between
    them until it slips. So their goals against the body change slowly while something is held;
    what they hold sways with the body.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Hold nothing."""
        self.is_holding = False
        self.squeeze = 0.0
        """Force of either hand towards the other, the smaller of both [N]."""
        self._poses: dict[str, np.ndarray] = {}

    def update(self, forces: np.ndarray, across: np.ndarray) -> None:
        """Find out whether something is held.

        Args:
            forces: Of the left and the right hand on what they touch, world [N]. Shape (2, 3).
            across: From the left hand to the right one [m]. Shape (3,).
        """
        way = across / max(float(np.linalg.norm(across)), 1e-6)
        self.squeeze = min(float(forces[0] @ way), -float(forces[1] @ way))
        self.is_holding = self.squeeze > (HELD[1] if self.is_holding else HELD[0])

    def smooth(
        self,
        goals: Mapping[str, np.ndarray],
        head: np.ndarray,
        steady_head: np.ndarray,
        dt: float,
        *,
        walking: bool = False,
    ) -> dict[str, np.ndarray]:
        """Smooth the goals as the hands need it.

        Args:
            goals: Wrist poses in the world. Shapes (7,).
            head: Pose of the robot's head that they belong to. Shape (7,).
            steady_head: Pose of the head of the body that the arms are computed for. What is
                smoothed is put back to there; it would tremble by the difference. Shape (7,).
            dt: Time since the last tick [s].
            walking: Whether the robot may be walking.

        Returns:
            Goals in the world. Shapes (7,).
        """
        back = pose_inverse(head)
        local = {name: pose_multiply(back, pose) for name, pose in goals.items()}
        if not self.is_holding and self._poses.keys() != local.keys():
            self._poses = {}
            return dict(goals)
        held_s = CARRYING_S if walking else HOLDING_S
        share = -np.expm1(-max(dt, 0.0) / (held_s if self.is_holding else FREE_S))
        for name, pose in local.items():
            last = self._poses.get(name, pose)
            turn = quat_exp(share * rotation_error(pose[3:], last[3:]))
            position = last[:3] + share * (pose[:3] - last[:3])
            self._poses[name] = make_pose(position, quat_multiply(turn, last[3:]))
        if not self.is_holding:
            far = max(float(np.linalg.norm(self._poses[n][:3] - local[n][:3])) for n in local)
            if far < CAUGHT_UP:
                self._poses = {}
                return dict(goals)
        return {name: pose_multiply(steady_head, self._poses[name]) for name in local}
