"""Makes the retargeter that a configuration names."""

from __future__ import annotations

import mujoco

from xop_lerobot.low_level.policy import LowLevelPolicy
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.costs.collision import Obstacle
from xop_lerobot.retarget.direct import DirectRetargeter
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.plan import Retargeter


def make_retargeter(
    config: RetargeterConfig,
    morphology: Morphology,
    policy: LowLevelPolicy,
    model: mujoco.MjModel,
    obstacles: tuple[Obstacle, ...] | None = None,
) -> Retargeter:
    """Make the retargeter `config.type` (checked when the configuration was made)."""
    if config.type == "direct":
        return DirectRetargeter(morphology, model, config.control_hz or 25.0)
    return MpcRetargeter(morphology, policy, model, config, obstacles=obstacles)
