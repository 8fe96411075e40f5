"""Planner parameters of RB-Y1 M."""

from __future__ import annotations

from xop_lerobot.core.command import Mode
from xop_lerobot.morphology.effect import Acts, Effect
from xop_lerobot.morphology.rby1 import mpc as rby1
from xop_lerobot.morphology.tuning import CostWeights, MpcConfig

PIVOT = -0.002
"""Forward distance of the wheels' common centre from the base frame [m]."""

SUPPORT = ((0.243, -0.245), (0.243, 0.245), (-0.247, 0.245), (-0.247, -0.245))
"""Ground contacts of the wheels in the base frame [m]."""

EFFECTS = (
    Effect(Acts.FORWARD),
    Effect(Acts.LEFT),
    Effect(Acts.TURN),
    *(effect for effect in rby1.EFFECTS if effect.acts is Acts.JOINT),
)

CONFIGS = {
    Mode.STATIONARY: rby1.CONFIGS[Mode.STATIONARY],
    Mode.MOBILE: MpcConfig(
        num_samples=16,
        horizon=14,
        noise_std={"vx": 0.2, "vy": 0.2, "yaw_rate": 0.3, **rby1.TORSO_NOISE},
        # The base can turn on the spot to any goal, so heading counts as much as position.
        weights=CostWeights(orientation=1.0, tilt_share=0.3, lean=50.0),
        reach=0.4,
    ),
}
