"""What one entry of a command does to a robot, to first order."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from xop_lerobot.core.command import Mode


class Acts(Enum):
    """On what an entry of a command acts."""

    HEIGHT = "height of the base over the ground"
    JOINT = "angle of a joint"
    FORWARD = "velocity of the base along its heading"
    LEFT = "velocity of the base across its heading"
    TURN = "yaw rate of the base"


@dataclass(frozen=True)
class Effect:
    """Effect of one entry of a command.

    Attributes:
        acts: On what it acts.
        joint: The joint, where it acts on one.
        lag_s: Time constant with which height or joint follow the command [s].
        modes: Modes in which it has an effect at all.
        sway_s: Where a velocity sways the base in stationary mode, by how much: displacement
            over velocity, taken up with `lag_s` [m/(m/s)].
        effort: How dear the entry is to the kinematic proposal, over the others [1].
    """

    acts: Acts
    joint: str = ""
    lag_s: float = 0.15
    modes: tuple[Mode, ...] = (Mode.STATIONARY, Mode.MOBILE)
    sway_s: float = 0.0
    effort: float = 1.0
