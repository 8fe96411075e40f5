"""LeRobot teleoperator `xop`: XR device, alignment and retargeter in one.

LeRobot imports this package because the distribution has its name; the import also registers the
robots of `lerobot_robot_xop`. The device class imports MuJoCo, so it is loaded on first access.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lerobot_robot_xop  # noqa: F401  registers the robots
from lerobot_teleoperator_xop.config_xop import RecordingConfig, XopConfig

if TYPE_CHECKING:
    from lerobot_teleoperator_xop.xop import Xop

__all__ = ["RecordingConfig", "Xop", "XopConfig"]


def __getattr__(name: str) -> object:
    if name != "Xop":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lerobot_teleoperator_xop.xop import Xop  # noqa: PLC0415  imports MuJoCo

    return Xop
