"""The action of a frame is what the robot executes, also where a policy asked for more."""

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
    """Put what the robot executes in the place of the action of a frame.

    LeRobot's loops record the action that was asked for and drop the answer of `send_action`.
    A teleoperator of this project asks for nothing else than what is executed, and a policy may.

    A frame of another tick stays as it is, and so does one with other joints than the robot's,
    as processors of one's own make them.

    Args:
        frame: The frame.
        tick: The session's present tick, None if there is none.
        features: Columns of the dataset.
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
    """Build a column of a frame as LeRobot does; None where it has other entries."""
    names = features.get(column, {}).get("names") or ()
    if not names or any(name not in values for name in names):
        return None
    return np.array([values[name] for name in names], dtype=np.float32)
