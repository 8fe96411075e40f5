"""Policies in lock-step: an episode of `lerobot-rollout` has a number of frames, not of seconds."""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Callable
from typing import Any

from xop_lerobot.core.errors import BadValue
from xop_lerobot.recording.dataset import XopDataset
from xop_lerobot.recording.lockstep import count_ticks, without_slowness
from xop_lerobot.session import get_session

STRATEGY_MODULE = "lerobot.rollout.strategies.episodic"
STRATEGY = "EpisodicStrategy"
LOOP = "_policy_loop"
_PARAMETERS = ("self", "events", "dataset", "control_time_s")
"""Parameters of the loop that the replacement reads or changes, in 0.6.1 and after it."""


def find_strategy() -> tuple[type | None, str]:
    """Return LeRobot's strategy that records policies in episodes, and what is wrong with it.

    Where something is, episodes end by the wall clock, as LeRobot has it: nothing is lost but the
    same number of frames whatever the machine does meanwhile.

    Returns:
        The strategy and an empty text, or None and what is not as this module expects it.
    """
    try:
        module = importlib.import_module(STRATEGY_MODULE)
    except ImportError:
        return None, f"it has no {STRATEGY_MODULE}"
    strategy = getattr(module, STRATEGY, None)
    if strategy is None:
        return None, f"{STRATEGY_MODULE} has no {STRATEGY}"
    loop = getattr(strategy, LOOP, None)
    if loop is None:
        return None, f"{STRATEGY} has no {LOOP}()"
    known = inspect.signature(getattr(loop, "xop_stock", loop)).parameters
    missing = [name for name in _PARAMETERS if name not in known]
    if missing:
        return None, f"{STRATEGY}.{LOOP}() has no parameter {', '.join(missing)}"
    return strategy, ""


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
        if not isinstance(dataset, XopDataset) or dataset.session_name != session:
            stock(**call)
            return
        if get_session(session).robot.realtime:
            dataset.begin(call["events"], None)
            stock(**call)
            return
        _check_multiplier(call["self"], dataset.fps)
        dataset.begin(call["events"], count_ticks(call["control_time_s"], dataset.fps))
        call["control_time_s"] = math.inf
        with without_slowness():
            stock(**call)

    return policy_loop


def _check_multiplier(strategy: object, fps: int) -> None:
    """Check that each action of the policy is sent once.

    Raises:
        BadValue: If LeRobot sends actions between them: each moves a lock-step robot by a tick.
    """
    multiplier = getattr(getattr(strategy, "_interpolator", None), "multiplier", 1)
    if multiplier != 1:
        raise BadValue(
            f"--interpolation_multiplier must be 1 with a robot in lock-step, got {multiplier}: "
            f"each action that is sent takes 1/{fps} s. Use --robot.clock=realtime for more"
        )
