"""Factory of the retargeter that a configuration names, and of the obstacles that it avoids."""

from __future__ import annotations

import functools
import logging

import mujoco

from xop_lerobot.core.command_line import say_count
from xop_lerobot.core.errors import BadValue
from xop_lerobot.low_level.policy import LowLevelPolicy
from xop_lerobot.morphology.morphology import MORPHOLOGIES, Morphology, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.changes import Settings, make_settings
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.direct import DirectRetargeter
from xop_lerobot.retarget.mpc import MpcRetargeter
from xop_lerobot.retarget.obstacles import Obstacle, load_obstacles, make_obstacles
from xop_lerobot.retarget.plan import Retargeter
from xop_lerobot.retarget.plan_follower import PlanFollower
from xop_lerobot.retarget.presets import build_configs

logger = logging.getLogger(__name__)


def explain_blindness(kind: str, morphology: Morphology) -> str:
    """Reason why this retargeter and robot ignore obstacles; empty if they avoid them.

    Args:
        kind: Type of the retargeter.
        morphology: The robot.
    """
    if kind != "mpc":
        return f"retargeter {kind!r} does not avoid obstacles. Retargeters that do: mpc"
    if not morphology.hull_points:
        able = [name for name in MORPHOLOGIES if make_morphology(name).hull_points]
        return (
            f"robot {morphology.name!r} does not avoid obstacles. Robots that do: {', '.join(able)}"
        )
    return ""


def check_obstacles(config: RetargeterConfig, morphology: Morphology) -> None:
    """Check that an obstacle file, if one is given, is not ignored.

    Raises:
        BadValue: If robot or retargeter would ignore it; names those that would not.
    """
    reason = explain_blindness(config.type, morphology) if config.obstacles else ""
    if reason:
        raise BadValue(f"obstacles '{config.obstacles}' would be ignored: {reason}")


def warn_of_scene(kind: str, morphology: Morphology, scene: str) -> None:
    """Warn, once, if the planner ignores the fixed obstacles of a scene.

    Args:
        kind: Type of the retargeter.
        morphology: The robot.
        scene: Name of the scene.
    """
    if explain_blindness(kind, morphology) and scene != "empty":
        warn_of_obstacles(kind, morphology, scene, _count_obstacles(morphology.name, scene))


def warn_of_obstacles(kind: str, morphology: Morphology, scene: str, count: int) -> None:
    """Warn, once, if the planner ignores the `count` obstacles of a scene."""
    reason = explain_blindness(kind, morphology)
    if reason and count:
        _warn_once(f"{say_count(count, 'obstacle')} in scene {scene!r} ignored: {reason}.")


def find_obstacles(morphology: Morphology, scene: str) -> tuple[Obstacle, ...] | None:
    """Walls and furniture of a scene; None for a robot that does not avoid obstacles.

    They are read from the full model: the planning model contains only the floor.
    """
    if not morphology.hull_points:
        return None
    return make_obstacles(build_model(morphology, "full", scene=scene))


def gather_obstacles(
    config: RetargeterConfig,
    morphology: Morphology,
    scene: str,
    obstacles: tuple[Obstacle, ...],
) -> tuple[Obstacle, ...] | None:
    """Add the obstacles of the configured file; None for a robot that does not avoid obstacles.

    Warns, once, if the planner ignores them.
    """
    warn_of_obstacles(config.type, morphology, scene, len(obstacles))
    if not morphology.hull_points:
        return None
    return obstacles + (load_obstacles(config.obstacles) if config.obstacles else ())


@functools.cache
def _count_obstacles(robot: str, scene: str) -> int:
    return len(make_obstacles(build_model(make_morphology(robot), "full", scene=scene)))


@functools.cache
def _warn_once(text: str) -> None:
    logger.warning(text)


def make_retargeter(
    config: RetargeterConfig,
    morphology: Morphology,
    policy: LowLevelPolicy,
    model: mujoco.MjModel,
    obstacles: tuple[Obstacle, ...] | None = None,
) -> Retargeter:
    """Make the retargeter `config.type` (checked when the configuration was made).

    Args:
        config: Its settings; obstacles of a file add to the others.
        morphology: The robot.
        policy: Its low-level policy.
        model: Its planning model.
        obstacles: Obstacles around the robot; by default the geoms that are fixed in `model`.

    Raises:
        BadObstacles: If the obstacle file is missing or malformed.
        BadValue: If there is one, but robot or retargeter would ignore it.
    """
    check_obstacles(config, morphology)
    if config.type == "direct":
        return DirectRetargeter(morphology, model, config.control_hz or 25.0)
    obstacles = make_obstacles(model) if obstacles is None else obstacles
    if config.obstacles:
        obstacles += load_obstacles(config.obstacles)
    retargeter = MpcRetargeter(morphology, policy, model, config, obstacles=obstacles)
    apply_settings(retargeter, morphology, config, make_settings(morphology, config))
    return retargeter


def apply_settings(
    planner: Retargeter | PlanFollower,
    morphology: Morphology,
    config: RetargeterConfig,
    settings: Settings,
) -> None:
    """Apply the settings in force to a planner, from its next solve on."""
    planner.configure(
        configs=build_configs(morphology, config, settings),
        targets=settings.targets,
        body=settings.body,
        constraints=settings.constraints,
    )
