"""LeRobot robots `xop_g1`, `xop_rby1` and `xop_rby1m`, driven by whole-body commands.

Importing this package only registers the configurations. The device classes import MuJoCo, so they
are loaded on first access.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lerobot_robot_xop.config_xop import (
    LowLevelConfig,
    SceneConfig,
    XopG1Config,
    XopRby1Config,
    XopRby1MConfig,
    XopRobotConfig,
)

if TYPE_CHECKING:
    from lerobot_robot_xop.xop_robot import XopG1, XopRby1, XopRby1M, XopRobot

__all__ = [
    "LowLevelConfig",
    "SceneConfig",
    "XopG1",
    "XopG1Config",
    "XopRby1",
    "XopRby1Config",
    "XopRby1M",
    "XopRby1MConfig",
    "XopRobot",
    "XopRobotConfig",
]

_DEVICES = ("XopG1", "XopRby1", "XopRby1M", "XopRobot")


def __getattr__(name: str) -> object:
    if name not in _DEVICES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lerobot_robot_xop import xop_robot  # noqa: PLC0415  imports MuJoCo

    return getattr(xop_robot, name)
