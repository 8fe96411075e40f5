"""One sample of a headset's stream, in the convention of all devices."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from xop_lerobot.core.command import Mode


@dataclass(frozen=True)
class OperatorFrame:
    """Head, wrists and pinches of the operator at one instant.

    Operator world: Z up, metres, heading arbitrary (alignment removes it). Head: X forward,
    Y left, Z up. Wrist: X towards the middle knuckle, Z out of the back of the hand,
    Y = Z × X; with palms down and fingers forward all three are parallel to the world.

    Attributes:
        time: Stamp on the device's clock [s].
        head: Pose x y z qw qx qy qz. Shape (7,).
        left_wrist: Pose. Shape (7,).
        right_wrist: Pose. Shape (7,).
        pinch: Distance of thumb and index tip, left and right [m]. Shape (2,).
        tracked: Whether head, left and right wrist are tracked. Shape (3,), bool.
        mode: Mode stated by the device itself (as a recording may); None: gestures decide.
    """

    time: float
    head: np.ndarray
    left_wrist: np.ndarray
    right_wrist: np.ndarray
    pinch: np.ndarray
    tracked: np.ndarray = field(default_factory=lambda: np.ones(3, dtype=bool))
    mode: Mode | None = None

    def pose(self, name: str) -> np.ndarray:
        """Pose of the frame `name` (`head`, `left_wrist` or `right_wrist`). Shape (7,)."""
        return getattr(self, name)
