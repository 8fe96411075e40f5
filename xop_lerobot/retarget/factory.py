"""Makes the retargeter that a configuration names."""

from __future__ import annotations

import mujoco

from xop_lerobot.low_level.policy import LowLevelPolicy
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.retarget.changes import make_settings
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.direct import DirectRetargeter
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.obstacle_file import load_obstacles
from xop_lerobot.retarget.obstacles import Obstacle, make_obstacles
from xop_lerobot.retarget.plan import Retargeter
from xop_lerobot.retarget.presets import build_configs


def make_retargeter(
    config: RetargeterConfig,
    morphology: Morphology,
    policy: LowLevelPolicy,
    model: mujoco.MjModel,
    obstacles: tuple[Obstacle, ...] | None = None,
) -> Retargeter:
    """Make the retargeter `config.type` (checked when the configuration was made).

    Args:
        config: Its settings; a file of obstacles adds to the others.
        morphology: The robot.
        policy: Its low-level policy.
        model: Its planning model.
        obstacles: What stands around it; by default what is fixed in `model`.

    Raises:
        BadObstacles: If the file of obstacles is missing or malformed.
    """
    if config.type == "direct":
        return DirectRetargeter(morphology, model, config.control_hz or 25.0)
    obstacles = make_obstacles(model) if obstacles is None else obstacles
    if config.obstacles:
        obstacles += load_obstacles(config.obstacles)
    retargeter = MpcRetargeter(morphology, policy, model, config, obstacles=obstacles)
    settings = make_settings(morphology, config)
    retargeter.configure(
        build_configs(morphology, config, settings),
        settings.targets,
        settings.body,
        settings.constraints,
    )
    return retargeter
