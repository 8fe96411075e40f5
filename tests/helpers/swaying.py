"""A person who stands before the device and sways, as tests of headsets stream one."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.transforms import make_pose, quat_exp
from xop_lerobot.operator.frame import OperatorFrame


def make_person(t: float) -> OperatorFrame:
    """The person at `t` [s]: every limb moves a little, so that nothing counts as frozen."""
    sway = 0.01 * np.array([np.sin(3 * t), np.cos(2 * t), np.sin(5 * t)])
    quat = quat_exp(sway)
    wrists = [make_pose(sway + [0.3, y, 1.1], quat) for y in (0.2, -0.2)]
    return OperatorFrame(
        t, make_pose(sway + [0, 0, 1.6], quat), *wrists, pinch=np.array([0.07, 0.02])
    )
