"""Policies in lock-step: an episode of `lerobot-rollout` has a number of frames, not of seconds."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from xop_lerobot.dataset.host import count_ticks, without_slowness
from xop_lerobot.dataset.xop_dataset import XopDataset
from xop_lerobot.link import get_session

if TYPE_CHECKING:
    from types import ModuleType

STRATEGY_MODULE = "lerobot.rollout.strategies.episodic"
LOOP = "_policy_loop"
_PARAMETERS = ("self", "robot", "events", "fps", "dataset", "control_time_s")
"""Parameters of the loop that the replacement reads or changes."""


def find_strategy(module: ModuleType | None) -> type | None:
    """Return LeRobot's strategy that records policies in episodes, if it is as expected here.

    Where it is not, episodes end by the wall clock, as LeRobot has it: nothing is lost but the
    same number of frames whatever the machine does meanwhile.
    """
    strategy = getattr(module, "EpisodicStrategy", None)
    loop = getattr(strategy, LOOP, None)
    if strategy is None or loop is None:
        return None
    known = inspect.signature(getattr(loop, "xop_stock", loop)).parameters
    return strategy if all(name in known for name in _PARAMETERS) else None


def count_in_frames(stock: Callable[..., None], session: str) -> Callable[..., None]:
    """Make LeRobot's loop of one episode end by its number of frames, for a lock-step robot.

    Args:
        stock: `EpisodicStrategy._policy_loop`.
        session: Session whose robot is driven.
    """
    signature = inspect.signature(stock)

    def policy_loop(*args: Any, **kwargs: Any) -> None:
        """Run LeRobot's loop; the episode's time passes on the robot's clock."""
        call = signature.bind(*args, **kwargs).arguments
        dataset = call["dataset"]
        is_ours = isinstance(dataset, XopDataset) and dataset.session_name == session
        if is_ours and not get_session(session).robot.realtime:
            dataset.begin(call["events"], count_ticks(call["control_time_s"], call["fps"]))
            call["control_time_s"] = math.inf
            with without_slowness(STRATEGY_MODULE):
                stock(**call)
            return
        stock(**call)

    return policy_loop
