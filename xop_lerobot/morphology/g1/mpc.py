"""Planner parameters of G1."""

from __future__ import annotations

from xop_lerobot.core.command import Mode
from xop_lerobot.morphology.effect import Acts, Effect, Gaze, GazeLimit
from xop_lerobot.morphology.tuning import CostWeights, MpcConfig

STATIONARY = (Mode.STATIONARY,)

MOBILE = (Mode.MOBILE,)

WALKING_LEAN = 0.12
"""How far the waist of a walking robot bends beyond the operator's head [rad]. With more it bows to
a crouching operator, whose height it does not take, and to one who is ahead of it."""

EFFECTS = (
    # While walking the policy neither squats nor turns its waist.
    # It lags behind a height ramp of 0.25 m/s by 0.21 s (default policy) or 0.23 s (FALCON).
    Effect(Acts.HEIGHT, lag_s=0.2, modes=STATIONARY),
    Effect(Acts.JOINT, "waist_yaw_joint", lag_s=0.2, modes=STATIONARY),
    Effect(
        Acts.JOINT,
        "waist_roll_joint",
        lag_s=0.1,
        effort=5.0,
        gaze=GazeLimit(Gaze.ROLL, WALKING_LEAN, MOBILE),
    ),
    Effect(
        Acts.JOINT,
        "waist_pitch_joint",
        lag_s=0.1,
        effort=2.0,
        gaze=GazeLimit(Gaze.PITCH, WALKING_LEAN, MOBILE),
    ),
    # While standing it responds to a small velocity by shifting its weight, 2.4 cm for 0.1 m/s.
    Effect(Acts.FORWARD, lag_s=0.3, sway_s=0.24, effort=0.3),
    Effect(Acts.LEFT, lag_s=0.3, sway_s=0.22, effort=0.3),
    Effect(Acts.TURN),
)

STANDING_REACH = 0.15
"""Largest distance of a standing robot's head goal from rest [m]: weight shift plus waist."""

CONFIGS = {
    Mode.STATIONARY: MpcConfig(
        num_samples=16,
        horizon=8,
        noise_std={"height": 0.03, "waist_yaw": 0.1, "waist_roll": 0.05, "waist_pitch": 0.1,
                   "vx": 0.06, "vy": 0.04},
        weights=CostWeights(orientation=0.2, stance=0.05, change=0.05),
    ),
    Mode.MOBILE: MpcConfig(
        num_samples=12,
        horizon=14,
        noise_std={
            "waist_roll": 0.03, "waist_pitch": 0.05, "vx": 0.25, "vy": 0.2, "yaw_rate": 0.3,
        },
        # Leaning as the operator does costs a walking robot its balance: tilt counts half.
        weights=CostWeights(orientation=0.1, tilt_share=0.5, change=0.05),
    ),
}  # fmt: skip


def mpc_config(mode: Mode) -> MpcConfig:
    """Parameters in `mode`."""
    return CONFIGS[mode]
