"""Parameters of the model predictive controller for G1."""

from __future__ import annotations

from xop_lerobot.core.command import Mode
from xop_lerobot.morphology.effect import Acts, Effect
from xop_lerobot.morphology.tuning import CostWeights, MpcConfig

STATIONARY = (Mode.STATIONARY,)

EFFECTS = (
    # While walking the policy neither squats nor turns its waist.
    # Behind a ramp of 0.25 m/s the default policy is by 0.21 s, FALCON by 0.23.
    Effect(Acts.HEIGHT, lag_s=0.2, modes=STATIONARY),
    Effect(Acts.JOINT, "waist_yaw_joint", lag_s=0.2, modes=STATIONARY),
    Effect(Acts.JOINT, "waist_roll_joint", lag_s=0.1, effort=5.0),
    Effect(Acts.JOINT, "waist_pitch_joint", lag_s=0.1, effort=2.0),
    # While standing it answers to a small velocity by shifting its weight, 2.4 cm for 0.1 m/s.
    Effect(Acts.FORWARD, lag_s=0.3, sway_s=0.24, effort=0.3),
    Effect(Acts.LEFT, lag_s=0.3, sway_s=0.22, effort=0.3),
    Effect(Acts.TURN),
)

STANDING_REACH = 0.15
"""How far a standing robot's head is led from where it rests [m]: what sway and waist serve."""

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
        # A walking robot that leans as its operator does pays with its balance.
        weights=CostWeights(orientation=0.1, tilt_share=0.5, change=0.05),
    ),
}  # fmt: skip


def mpc_config(mode: Mode) -> MpcConfig:
    """Parameters in `mode`."""
    return CONFIGS[mode]
