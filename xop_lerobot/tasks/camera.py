"""The camera that shows a robot and its task as a whole, for videos."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.transforms import quat_from_matrix

if TYPE_CHECKING:
    import mujoco

NAME = "task"
OPEN = ((2.6, -2.2, 1.9), (0.2, 0.1, 0.6), 45.0)
"""Where the camera is, what it looks at [m], and its vertical field of view [deg]."""
IN_ROOM = ((2.1, -2.1, 2.4), (0.0, 0.0, 0.5), 66.0)
"""The same in a room of 4.4 m and more: in its corner, under the ceiling."""


def add_task_camera(spec: mujoco.MjSpec) -> None:
    """Add the camera `task`, which stands still."""
    has_walls = any(geom.name.startswith("wall_") for geom in spec.geoms)
    position, target, fovy = IN_ROOM if has_walls else OPEN
    # MuJoCo's cameras look along -Z with Y up.
    back = np.subtract(position, target)
    back = back / np.linalg.norm(back)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    spec.worldbody.add_camera(name=NAME, pos=position, quat=quat_from_matrix(axes), fovy=fovy)
