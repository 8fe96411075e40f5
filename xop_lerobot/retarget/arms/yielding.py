"""Hands that squeeze too hard give way."""

from __future__ import annotations

import numpy as np

MOST_SQUEEZE = 60.0
"""Hands that squeeze harder than so give way [N]: enough for a box of 4 kg with a friction of 0.7
that is accelerated by 0.1 g, and within what the wrists of both robots can do."""
GAIN = 2e-4
"""How fast a hand gives way per newton over the limit [m/s/N]. With arms of up to 10 N/mm and a
force that is felt 0.3 s late, this comes to rest within about a second, without swinging."""
MOST_WAY = 0.06
"""Farthest that a hand gives way [m]."""


class ArmYield:
    r"""Moves the goals of both hands apart while they squeeze what is between them too hard.

    Nobody feels through a headset how hard a robot presses. Arms on stiff servos turn a
    centimetre into a hundred newtons: their wrists reach their largest torque, bend, and let go.
    So each hand gives way by w against the other,

    .. math:: \dot w = k (F - F_{max}), \quad 0 \le w \le w_{max},

    with F the force with which they squeeze. Who squeezes less gets no help: w is never negative.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Give way no more."""
        self.way = 0.0
        """How far each hand has given way [m]."""

    def update(self, squeeze: float, dt: float) -> None:
        """Take up how hard the hands squeeze.

        Args:
            squeeze: Force of either hand towards the other [N].
            dt: Time since the last update [s].
        """
        way = self.way + GAIN * dt * (squeeze - MOST_SQUEEZE)
        self.way = float(np.clip(way, 0.0, MOST_WAY))

    def part(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move the places of the left and the right hand apart [m]. Shapes (3,)."""
        across = right - left
        way = self.way * across / max(float(np.linalg.norm(across)), 1e-6)
        return left - way, right + way
