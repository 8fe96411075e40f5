"""Records the executed action in place of the requested one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE

if TYPE_CHECKING:
    from xop_lerobot.session import Tick


def put_executed(
    frame: Mapping[str, Any], tick: Tick | None, features: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Replace the action of a frame by the action that the robot executes.

    LeRobot's loops record the requested action and drop the return value of `send_action`. This
    project's teleoperator only requests what is executable, but a policy may request more.

    A frame of another control step is returned unchanged, as is one whose entries do not match the
    robot's, as custom processors may produce.

    Args:
        frame: The frame.
        tick: The session's current tick, None if there is none.
        features: Features of the dataset.
    """
    frame = dict(frame)
    if tick is None or tick.executed is None:
        return frame
    state = _build(OBS_STATE, tick.proprioception, features)
    action = _build(ACTION, tick.executed, features)
    if state is None or action is None or OBS_STATE not in frame:
        return frame
    if np.array_equal(state, frame[OBS_STATE]):
        frame[ACTION] = action
    return frame


def _build(
    column: str, values: Mapping[str, float], features: Mapping[str, Mapping[str, Any]]
) -> np.ndarray | None:
    """Build a column of a frame as LeRobot does; None if its entries do not match `values`."""
    names = features.get(column, {}).get("names") or ()
    if not names or any(name not in values for name in names):
        return None
    return np.array([values[name] for name in names], dtype=np.float32)
