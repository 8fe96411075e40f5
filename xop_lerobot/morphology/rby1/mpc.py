"""Planner parameters of RB-Y1."""

from __future__ import annotations

import math

from xop_lerobot.core.command import Mode
from xop_lerobot.morphology.effect import Acts, Effect, Gaze, GazeLimit
from xop_lerobot.morphology.tuning import CostWeights, Driving, MpcConfig

PIVOT = 0.228
"""Forward distance of the wheel axle from the base frame [m]."""

SUPPORT = ((0.228, -0.265), (0.228, 0.265), (-0.275, 0.085), (-0.275, -0.085))
"""Ground contacts of wheels and casters in the base frame [m]."""

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
"""Radii of the hull spheres [m]; they cover base (5 cm beyond its corners), head, elbows, hands."""

EFFECTS = (
    Effect(Acts.FORWARD),
    Effect(Acts.TURN),
    # Leaning sideways (torso_0 and torso_4) costs stability, turning the chest (torso_5) does not.
    *(
        Effect(Acts.JOINT, f"torso_{i}", lag_s=0.1, effort=effort)
        for i, effort in enumerate((10.0, 4.0, 4.0, 4.0, 10.0, 1.0))
    ),
    # The neck is quick: it takes the first part of a turn of the head, until the chest has
    # followed, and its share of a nod: at less effort than the torso's, knees stay bent in front of
    # a goal at chest height, with the head 6 cm off.
    Effect(Acts.JOINT, "head_0", lag_s=0.05, effort=20.0, gaze=GazeLimit(Gaze.HEADING), neck=True),
    Effect(Acts.JOINT, "head_1", lag_s=0.05, effort=4.0, gaze=GazeLimit(Gaze.PITCH), neck=True),
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
"""Gentler than the wheels allow, for the tall upper body; `waist` leaves a margin to the limit of
its joint."""

POSTURE_LIMITS = {"torso_2": (-math.inf, 0.0)}
"""Knees bend forward. Bent backward, the chest hangs far ahead and the servos cannot hold it."""

STANDING_REACH = 0.3
"""Largest distance of a standing robot's head goal from rest [m]; torques may allow less."""

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
        # A shorter horizon does not show that the torso collapses when the base turns at speed.
        horizon=14,
        noise_std={"v": 0.2, "yaw_rate": 0.3, **TORSO_NOISE},
        weights=CostWeights(orientation=0.1, tilt_share=2.0, lean=500.0, lateral=0.4),
        reach=0.4,
    ),
}

V2_CONFIG = MpcConfig(
    num_samples=16,
    horizon=8,
    # Less noise on the torso, which carries the arm: the arm does the fast corrections.
    noise_std={
        **{f"torso_{i}": 0.02 for i in range(6)},
        **{f"left_arm_{i}": 0.05 for i in range(7)},
    },
    # Joints follow within 0.1 s: a longer preview would make the hand overtake its goal.
    preview_s=0.1,
    proposal_s=0.3,
    candidates=("proposal", "paced", "previous", "stop"),
    # The cost of change damps the wrist near its singularity, where two of its axes align.
    weights=CostWeights(orientation=0.2, change=0.01, upright=3.0),
)
"""Variant `v2`: torso and left arm follow the left hand; the base stands in either mode."""


def mpc_config(mode: Mode) -> MpcConfig:
    """Parameters in `mode`."""
    return CONFIGS[mode]
