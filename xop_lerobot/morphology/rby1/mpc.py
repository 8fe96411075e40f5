"""Parameters of the model predictive controller for RB-Y1."""

from __future__ import annotations

import math

from xop_lerobot.core.command import Mode
from xop_lerobot.morphology.effect import Acts, Effect
from xop_lerobot.morphology.tuning import CostWeights, Driving, MpcConfig

PIVOT = 0.228
"""The wheels' axle is this far ahead of the base frame [m]."""

SUPPORT = ((0.228, -0.265), (0.228, 0.265), (-0.275, 0.085), (-0.275, -0.085))
"""Where the wheels and the casters touch the ground, in the base frame [m]."""

HULL = {
    "hull_front_left": 0.17,
    "hull_front_right": 0.17,
    "hull_rear_left": 0.17,
    "hull_rear_right": 0.17,
    "head": 0.15,
    "left_elbow": 0.1,
    "right_elbow": 0.1,
    "left_palm": 0.1,
    "right_palm": 0.1,
}
"""Spheres about these cover the base (to 5 cm beyond its corners), head, elbows and hands [m]."""

EFFECTS = (
    Effect(Acts.FORWARD),
    Effect(Acts.TURN),
    # Leaning sideways (torso 0 and 4) costs stability, turning the chest (torso 5) does not.
    *(
        Effect(Acts.JOINT, f"torso_{i}", lag_s=0.1, effort=effort)
        for i, effort in enumerate((10.0, 4.0, 4.0, 4.0, 10.0, 1.0))
    ),
)

DRIVING = Driving(
    speed=1.2,
    acceleration=1.5,
    braking=1.0,
    turn=1.4,
    turn_acceleration=3.0,
    turn_braking=2.0,
    centripetal=0.6,
    detour_speed=0.5,
    waist=2.2,
    waist_speed=1.5,
    arrival_twist=1.9,
    turning_twist=0.6,
    lean=0.1,
)
"""Braked more gently than the wheels could, for the height of what stands on them; the waist keeps
clear of its joint's limit."""

POSTURE_LIMITS = {"torso_2": (-math.inf, 0.0)}
"""Its knees bend to the front. Bent to the back they take it to places that servos do not hold:
the chest hangs far ahead, and folds."""

STANDING_REACH = 0.3
"""How far a standing robot's head is led from where it rests [m]; the torque may allow less."""

TORSO_NOISE = {f"torso_{i}": 0.05 for i in range(6)}

CONFIGS = {
    Mode.STATIONARY: MpcConfig(
        num_samples=16,
        horizon=8,
        noise_std=TORSO_NOISE,
        weights=CostWeights(orientation=0.2),
    ),
    Mode.MOBILE: MpcConfig(
        num_samples=16,
        # Shorter ones do not see a torso collapse when the base turns at speed.
        horizon=14,
        noise_std={"v": 0.2, "yaw_rate": 0.3, **TORSO_NOISE},
        weights=CostWeights(orientation=0.1, tilt_share=2.0, lean=500.0, lateral=0.4),
        reach=0.4,
    ),
}

V2_CONFIG = MpcConfig(
    num_samples=16,
    horizon=8,
    # The arm reaches where it can; the torso, which carries it, goes on slowly.
    noise_std={
        **{f"torso_{i}": 0.02 for i in range(6)},
        **{f"left_arm_{i}": 0.05 for i in range(7)},
    },
    # Joints follow within 0.1 s: a goal further ahead would be overtaken.
    preview_s=0.1,
    proposal_s=0.3,
    candidates=("proposal", "paced", "previous", "stop"),
    # A change that costs damps the wrist where two of its axes are in line.
    weights=CostWeights(orientation=0.2, change=0.01, upright=3.0),
)
"""Torso and left arm after the left hand; the base stands in either mode."""


def mpc_config(mode: Mode) -> MpcConfig:
    """Parameters in `mode`."""
    return CONFIGS[mode]
