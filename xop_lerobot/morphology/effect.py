"""First-order effect of one entry of a command, for the planner's command model."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from xop_lerobot.core.command import Mode


class Acts(Enum):
    """Quantity that an entry of a command controls."""

    HEIGHT = "height of the base over the ground"
    JOINT = "angle of a joint"
    FORWARD = "velocity of the base along its heading"
    LEFT = "velocity of the base across its heading"
    TURN = "yaw rate of the base"


class Gaze(Enum):
    """Angle of the head's goal."""

    HEADING = "heading of the goal relative to the base"
    PITCH = "pitch of the goal in its heading"
    ROLL = "roll of the goal in its heading"


@dataclass(frozen=True)
class GazeLimit:
    """Limits a joint to between neutral and an angle of the head's goal.

    Attributes:
        angle: The angle.
        margin: How far the joint may exceed it on either side [rad].
        modes: Modes in which it is limited.
    """

    angle: Gaze
    margin: float = 0.0
    modes: tuple[Mode, ...] = (Mode.STATIONARY, Mode.MOBILE)


@dataclass(frozen=True)
class Effect:
    """Effect of one entry of a command.

    Attributes:
        acts: Quantity that the entry controls.
        joint: The joint, for `Acts.JOINT`.
        lag_s: Time constant with which height or joint follow the command [s].
        modes: Modes in which it has an effect.
        sway_s: Weight shift of the base in stationary mode: displacement per velocity, reached
            with `lag_s` [m/(m/s)].
        effort: Relative effort weight of the entry in the kinematic proposal [1].
        gaze: Limit of the joint by the goal of the head; None for none.
        neck: Whether it is a joint of the neck, which turns the head alone.
    """

    acts: Acts
    joint: str = ""
    lag_s: float = 0.15
    modes: tuple[Mode, ...] = (Mode.STATIONARY, Mode.MOBILE)
    sway_s: float = 0.0
    effort: float = 1.0
    gaze: GazeLimit | None = None
    neck: bool = False
