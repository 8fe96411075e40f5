"""Check that a trained policy gets images of the size it was trained with.

LeRobot's rollout compares camera names but not image sizes: a policy that does not resize its
images runs on others and silently performs badly. While a robot of this project is configured,
`lerobot-rollout` therefore compares sizes before it loads or connects anything. Robots of other
projects are not affected.
"""

from __future__ import annotations

import functools
import logging
from typing import TYPE_CHECKING, Any

from xop_lerobot.core.command_line import report_mistakes
from xop_lerobot.core.errors import BadValue
from xop_lerobot.recording.lerobot_patches import (
    ROLLOUT_MODULE,
    ROLLOUT_PICTURES,
    Patched,
    fits,
    get_signature,
    get_stock,
    is_patched,
    runs,
)

if TYPE_CHECKING:
    from lerobot_robot_xop.config_xop import XopRobotConfig

logger = logging.getLogger(__name__)

_RESIZING = (
    "resize_shape", "image_resize_shape", "resize_imgs_with_padding", "resize_images_to",
    "image_resolution", "image_size",
)  # fmt: skip
"""Settings of LeRobot's policies that resize images of any size."""


def watch_rollouts(ours: type[XopRobotConfig]) -> Patched:
    """Make `lerobot-rollout`, if it is running, check image sizes first.

    Args:
        ours: Configuration class of the robots to check.

    Returns:
        The patches, which can be undone; empty if already installed.
    """
    patched = Patched()
    if not (runs(ROLLOUT_MODULE) and fits(ROLLOUT_PICTURES)) or is_patched(ROLLOUT_PICTURES):
        return patched
    report_mistakes()
    stock = get_stock(ROLLOUT_PICTURES)
    signature = get_signature(stock)

    @functools.wraps(stock)
    def build(*args: Any, **kwargs: Any) -> Any:
        """Check the images of an xop robot, then do what LeRobot does."""
        cfg = signature.bind(*args, **kwargs).arguments["cfg"]
        if isinstance(cfg.robot, ours):
            check_pictures(cfg.robot, cfg.policy, getattr(cfg, "rename_map", None) or {})
        return stock(*args, **kwargs)

    patched.put(ROLLOUT_PICTURES, build)
    return patched


def check_pictures(robot: XopRobotConfig, policy: Any, names: dict[str, str]) -> None:
    """Check that a policy was trained with images of the robot's size.

    Args:
        robot: The robot.
        policy: LeRobot's configuration of the policy.
        names: The policy's camera keys by the robot's, where renamed.

    Raises:
        BadValue: If it was trained with another size and does not resize images.
    """
    inputs = getattr(policy, "input_features", None) or {}
    for camera in robot.cameras:
        key = f"observation.images.{camera}"
        feature = inputs.get(names.get(key, key))
        if feature is None or len(feature.shape) != 3:
            continue
        _, height, width = feature.shape
        if (height, width) == (robot.height, robot.width):
            continue
        fault = (
            f"the policy was trained with images of {width} x {height} of camera '{camera}', "
            f"and the robot's are {robot.width} x {robot.height}"
        )
        if not any(getattr(policy, name, None) for name in _RESIZING):
            raise BadValue(f"{fault}. Use --robot.width={width} --robot.height={height}")
        logger.warning("%s%s; it resizes them itself.", fault[0].upper(), fault[1:])
